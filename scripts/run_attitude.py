#!/usr/bin/env python
"""Attitude filters on real logs: a hand-moved inertial sensor with magnetometer,
a stereo camera over known beacons, a rocket's descent by parachute.

Quaternion Kalman filters and a bank of them (LLPF) go through the same log. The
run folder receives metrics.json, table.txt, figures and the stages from which
an interrupted run goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

# Of each log: the names of its filters.
FILTERS = {
    "imu-mag": ("mekf", "ukf", "llpf"),
    "stars": ("mekf", "ukf", "llpf"),
    "descent": ("baro-ekf", "baro-ukf", "imu-mekf", "imu-ukf", "imu-llpf"),
}
SCENARIOS = tuple(FILTERS)

EXAMPLES = """\
examples:
  attitude from gyro, specific force and field, from wrong starts
    run_attitude.py
  pose of a camera over beacons from any start, the bank alone
    run_attitude.py --scenario stars --filters llpf --out runs/stars
  a descent by parachute whose barometer is withheld for 5, 10 and 30 s
    run_attitude.py --scenario descent --out runs/descent

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_attitude.py", __doc__, EXAMPLES)
    group = parser.add_argument_group("Study")
    group.add_argument(
        "--scenario",
        default="imu-mag",
        choices=SCENARIOS,
        help="imu-mag: a sensor moved by hand, against cameras; stars: a stereo camera over beacons, against motion "
        "capture; descent: a rocket under its parachute, without a truth",
    )
    group.add_argument(
        "--filters",
        type=str | None,
        metavar="A,B",
        help=f"out of {', '.join(FILTERS['imu-mag'])}; of descent out of {', '.join(FILTERS['descent'])}; default all",
    )
    group.add_argument("--data", type=str | None, metavar="DIR", help="folder of the log; default: in ./data")
    group.add_argument("--stop-s", type=float | None, metavar="S", help="the log is filtered up to there; to its end")
    group.add_argument("--particles", type=int | None, metavar="N", help="of the bank; what the scenario takes")
    group.add_argument("--seed", default=0, type=int, help="of the bank and of random starts")
    add_output_options(parser, "runs/attitude")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_attitude.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    scenario, names = options["scenario"], None
    if options["filters"] is not None:
        names = chosen(options["filters"], FILTERS[scenario])
    folder = check_folder(options)
    make, run = _study(scenario)
    given = {name: options[name] for name in ("data", "stop_s", "particles") if options[name] is not None}
    try:
        settings = make(seed=options["seed"], **given)
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run(settings, folder, names, say=say, progress=not options["quiet"], figures=options["figures"])


def _study(scenario: str) -> tuple[Any, Any]:
    """Settings and study of a scenario."""
    if scenario == "stars":
        from torchfilt.missions.attitude.stars import StarsSettings, run_stars

        return StarsSettings, run_stars
    if scenario == "descent":
        from torchfilt.missions.attitude.descent import DescentSettings, run_descent

        return DescentSettings, run_descent
    from torchfilt.missions.attitude.imu_mag import ImuMagSettings, run_imu_mag

    return ImuMagSettings, run_imu_mag


if __name__ == "__main__":
    sys.exit(main())
