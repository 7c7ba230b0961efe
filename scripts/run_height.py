#!/usr/bin/env python
"""Height of a multirotor from inertial sensors, a barometer that drifts and a
range finder, on a real log: the range finder is withheld for 10, 30 and 60 s
again and again, and for good.

Four filters differ in what they hold of the barometer. The run folder receives
metrics.json, table.txt, figures and the stages from which an interrupted run
goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

FILTERS = ("inertial", "fixed", "walk", "wander")

EXAMPLES = """\
examples:
  all filters on the whole flight
    run_height.py
  the first five minutes, with the times of the log as they are
    run_height.py --stop-s 300 --range-delay-s 0 --baro-delay-s 0
  one filter, from the original archive of the log
    run_height.py --filters wander --data quadOptFlowLogData.zip

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_height.py", __doc__, EXAMPLES)
    group = parser.add_argument_group("Study")
    group.add_argument(
        "--filters",
        type=str | None,
        metavar="A,B",
        help="inertial: no barometer; fixed: a constant offset of it; walk: a random walk; wander: a slow walk and a "
        "Gauss-Markov process; default all",
    )
    group.add_argument("--data", type=str | None, metavar="PATH", help="the log; data/ of the repository")
    group.add_argument("--stop-s", type=float | None, metavar="S", help="the log is filtered up to there")
    group.add_argument("--range-delay-s", type=float | None, metavar="S", help="by which ranges are late; 0.24")
    group.add_argument("--baro-delay-s", type=float | None, metavar="S", help="by which the barometer is late; 0.35")
    add_output_options(parser, "runs/height")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_height.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    names = None if options["filters"] is None else chosen(options["filters"], FILTERS)
    folder = check_folder(options)
    from torchfilt.missions.quad_height import HeightSettings, run_height

    keys = ("data", "stop_s", "range_delay_s", "baro_delay_s")
    try:
        settings = HeightSettings(**{name: options[name] for name in keys if options[name] is not None})
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run_height(settings, folder, names, say=say, progress=not options["quiet"], figures=options["figures"])


if __name__ == "__main__":
    sys.exit(main())
