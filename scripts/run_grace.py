#!/usr/bin/env python
"""Learn the relative motion of two real satellites from hours of their log, and
track them through the hours that follow.

GRACE A and B on 27 July 2010. Gaussian processes learn what a nominal law of
motion misses; predictions without measurements and three filters are compared
with the precise orbits of hours that were not learned from. The run folder
receives settings, metrics, a table, figures and the finished parts.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

EXAMPLES = """\
examples:
  the defaults: 9 hours of training, 6 hours of tracking, 5 runs
    run_grace.py
  more runs, more particles, the rest of the day
    run_grace.py --runs 20 --particles 200 --tracking-hours 15
  less to learn from
    run_grace.py --training-hours 6 --out runs/grace-6h
  the same run with another seed
    run_grace.py --config runs/grace/settings.json --seed 1 --out runs/grace-1

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM, finished parts kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_grace.py", __doc__, EXAMPLES)

    group = parser.add_argument_group("Data")
    group.add_argument("--folder", default="data/grace_2010", type=str, metavar="DIR", help="the log")
    group.add_argument("--training-hours", default=9.0, type=float, metavar="H", help="learned from, from midnight on")
    group.add_argument("--tracking-hours", default=6.0, type=float, metavar="H", help="filtered, after the training")
    group.add_argument(
        "--step-s", default=60.0, type=float, metavar="S", help="between measurements, a multiple of 20 s"
    )
    group.add_argument("--seed", default=0, type=int, metavar="N", help="of noise, priors and particles")
    group.add_argument("--runs", default=5, type=int, metavar="N", help="noise seeds, filtered as one batch")

    group = parser.add_argument_group("Model")
    group.add_argument("--degree", default=36, type=int, metavar="N", help="highest degree of the learned potential")
    group.add_argument("--particles", default=100, type=int, metavar="N", help="of the particle filter")

    group = parser.add_argument_group("Measurements")
    group.add_argument("--range-sd-m", default=0.01, type=float, metavar="M", help="K-band range beside its bias, in m")
    group.add_argument("--radar-range-sd-m", default=1.0, type=float, metavar="M", help="simulated range, in m")
    group.add_argument(
        "--angle-3sigma-deg", default=0.05, type=float, metavar="DEG", help="three sigma of the angles, in deg"
    )
    group.add_argument("--prior-sd-m", default=100.0, type=float, metavar="M", help="prior position, each axis, in m")
    group.add_argument(
        "--prior-sd-m-s", default=0.1, type=float, metavar="M_S", help="prior velocity, each axis, in m/s"
    )
    group.add_argument("--bias-sd-m", default=0.1, type=float, metavar="M", help="prior bias of the K-band range, in m")
    group.add_argument(
        "--outage-minutes", default=45.0, type=float, metavar="MIN", help="gaps without measurements, in min"
    )
    group.add_argument(
        "--outage-starts-h",
        type=list[float] | None,
        metavar="[H,...]",
        help="hours after the start of tracking at which they begin; a third and three quarters of it",
    )
    group.add_argument(
        "--settle-minutes", default=94.0, type=float, metavar="MIN", help="first part that no error is counted in"
    )

    add_output_options(parser, "runs/grace")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_grace.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    folder = check_folder(options)
    options.pop("config", None)
    output = {name: options.pop(name) for name in ("out", "force", "resume", "figures", "threads", "quiet", "debug")}

    from torchfilt.missions.grace.campaign import run
    from torchfilt.missions.grace.settings import GraceSettings

    starts = options.pop("outage_starts_h")
    try:
        settings = GraceSettings(**options, outage_starts_h=None if starts is None else tuple(starts))
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(output, folder)
    run(settings, out=folder, figures=output["figures"], say=say, progress=not output["quiet"])


if __name__ == "__main__":
    sys.exit(main())
