#!/usr/bin/env python
"""Navigate a slow indoor airship: alignment at the mast, cruise, approach.

Inertial sensors, magnetometer, a barometer that lags and drifts, ranges to
beacons and a sonar whose readings come late. A state machine selects sensors
and filter and logs why. The indirect filter is compared with direct ones, and
with itself without modes or with late readings taken for new, on the same
data. The run folder receives metrics.json, table.txt, figures and the stages
from which an interrupted run goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

FILTERS = (
    *("indirect", "indirect-ukf", "direct-ekf", "direct-ukf", "indirect-no-modes", "indirect-late-as-new"),
    *("indirect-no-lag", "indirect-no-gate", "indirect-no-modes-no-gate"),
)

EXAMPLES = """\
examples:
  the study: six filters, 20 missions of 225 s
    run_airship.py
  a steel pillar beside the way, with and without a gate
    run_airship.py --pillar-moment-a-m2 30 --filters \\
      indirect,indirect-no-gate --out runs/pillar
  a slow sonar
    run_airship.py --ultrasonic-delay-s 0.3 --filters \\
      indirect,indirect-late-as-new --out runs/slow-sonar

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_airship.py", __doc__, EXAMPLES)
    group = parser.add_argument_group("Study")
    group.add_argument(
        "--filters", type=str | None, metavar="A,B", help=f"out of {', '.join(FILTERS)}; default the first six"
    )
    group.add_argument("--runs", default=20, type=int, metavar="R", help="missions, one batch")
    group.add_argument("--seed", default=0, type=int, help="of flights and sensor noise")
    group.add_argument("--anchored-s", default=30.0, type=float, metavar="S", help="at the mast")
    group.add_argument("--cruise-s", default=120.0, type=float, metavar="S", help="along the waypoints")
    group.add_argument("--approach-s", default=75.0, type=float, metavar="S", help="to the landing spot")
    group.add_argument("--gust-sd-m-s", default=0.05, type=float, metavar="V", help="of the air's velocity")
    group.add_argument("--ultrasonic-delay-s", default=0.1, type=float, metavar="S", help="of the sonar's readings")
    group.add_argument("--barometer-lag-s", default=0.5, type=float, metavar="S", help="time constant")
    group.add_argument("--clutter-m", default=0.8, type=float, metavar="H", help="height of tables in the hall")
    group.add_argument(
        "--pillar-moment-a-m2", default=0.0, type=float, metavar="M", help="magnetic moment of a steel pillar"
    )
    add_output_options(parser, "runs/airship")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_airship.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    names = None if options["filters"] is None else chosen(options["filters"], FILTERS)
    folder = check_folder(options)

    from torchfilt.missions.airship.scene import AirshipSettings
    from torchfilt.missions.airship.study import run_airship

    own = ("runs", "seed", "anchored_s", "cruise_s", "approach_s", "gust_sd_m_s", "ultrasonic_delay_s")
    own += ("barometer_lag_s", "clutter_m", "pillar_moment_a_m2")
    try:
        settings = AirshipSettings(**{name: options[name] for name in own})
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run_airship(settings, folder, names, say=say, progress=not options["quiet"], figures=options["figures"])


if __name__ == "__main__":
    sys.exit(main())
