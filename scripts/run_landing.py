#!/usr/bin/env python
"""Land a multirotor on an infrared beacon, with inertial sensors, a barometer
and a camera that sees the beacon now and then.

Quaternion Kalman filters, particle filters and banks of Gaussian filters get
the same data, all Monte-Carlo runs as one batch, with and without the symmetry
about the vertical through the pad. The run folder receives metrics.json,
table.txt, figures and the stages from which an interrupted run goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

SCENARIOS = ("nominal", "false-source", "no-barometer", "pad-height", "wide-start")
FILTERS = (
    *("ukf", "ukf-restart", "mekf", "iekf", "bootstrap", "llpf-50", "llpf-200", "llpf-1000", "llpf-50-iterated"),
    *("llpf-50-no-restart",),
    *("llpf-50-redraw", "llpf-50-keep", "llpf-50-literal", "ukf-no-gauge", "mekf-no-gauge", "bootstrap-no-gauge"),
    *("llpf-50-no-gauge", "llpf-200-no-gauge", "llpf-1000-no-gauge"),
)

EXAMPLES = """\
examples:
  the study: nine filters, 50 runs of 22 s
    run_landing.py
  a second of a false source before the beacon, with and without starting over
    run_landing.py --scenario false-source --filters ukf,ukf-restart,llpf-50 \\
      --out runs/false-source
  a pad of unknown height
    run_landing.py --scenario pad-height --out runs/pad-height

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_landing.py", __doc__, EXAMPLES)
    group = parser.add_argument_group("Study")
    group.add_argument("--scenario", default="nominal", choices=SCENARIOS, help="what happens")
    group.add_argument(
        "--filters", type=str | None, metavar="A,B", help=f"out of {', '.join(FILTERS)}; default nine of them"
    )
    group.add_argument("--runs", default=50, type=int, metavar="R", help="Monte-Carlo runs, one batch")
    group.add_argument("--seed", default=0, type=int, help="of flights, sensor noise and particles")
    group.add_argument("--duration-s", default=22.0, type=float, metavar="S", help="of a flight")
    group.add_argument("--dropout", default=0.1, type=float, metavar="P", help="share of pictures that are lost")
    group.add_argument("--outlier-share", default=0.02, type=float, metavar="P", help="of wrong sightings")
    add_output_options(parser, "runs/landing")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_landing.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    names = None if options["filters"] is None else chosen(options["filters"], FILTERS)
    folder = check_folder(options)

    from torchfilt.missions.landing.scene import LandingSettings
    from torchfilt.missions.landing.study import run_landing

    own = ("scenario", "runs", "seed", "duration_s", "dropout", "outlier_share")
    try:
        settings = LandingSettings(**{name: options[name] for name in own})
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run_landing(settings, folder, names, say=say, progress=not options["quiet"], figures=options["figures"])


if __name__ == "__main__":
    sys.exit(main())
