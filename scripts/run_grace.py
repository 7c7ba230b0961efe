#!/usr/bin/env python
"""Learn the relative motion of two real satellites from hours of their log, and
track them through the hours that follow.

GRACE A and B on 27 July 2010. Gaussian processes learn what a nominal law of
motion misses; predictions without measurements and three filters are compared
with the precise orbits of hours that were not learned from. The run folder
receives settings, metrics, figures and the checkpoints of the training.
"""

import json
import sys
from argparse import RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, DefaultHelpFormatter

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_STOPPED = 0, 1, 2, 130
SETTINGS, METRICS = "settings.json", "metrics.json"

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

exit codes: 0 done, 1 failed, 2 wrong use, 130 stopped by SIGINT.
"""


class HelpFormatter(DefaultHelpFormatter, RawDescriptionHelpFormatter):
    """Keeps the lines of the description and the examples; gives a default where there is one to give."""

    def _get_help_string(self, action: Any) -> str:
        text = action.help or ""
        if not action.option_strings or action.default in (None, "==SUPPRESS==") or action.nargs == 0:
            return text
        return f"{text} (default: %(default)s)"


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = ArgumentParser(
        prog="run_grace.py",
        usage="%(prog)s [options]",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--config", action="config", metavar="FILE", help="YAML or JSON file with any of these options")

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

    group = parser.add_argument_group("Output")
    group.add_argument("--out", default="runs/grace", type=str, metavar="DIR", help="run folder")
    group.add_argument("--force", action="store_true", help="overwrite the run in the run folder")
    group.add_argument("--figures", default=True, type=bool, metavar="BOOL", help="draw figures")
    group.add_argument("--threads", type=int | None, metavar="N", help="CPU threads; as many as torch likes")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    options.pop("config", None)
    out, force, figures, threads, quiet, debug = (
        options.pop(name) for name in ("out", "force", "figures", "threads", "quiet", "debug")
    )
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        return _fail(ValueError(f"--out {out}: not a folder"), debug, EXIT_USAGE)
    if (folder / METRICS).exists() and not force:
        return _fail(ValueError(f"{out} holds a run already: give --force or another --out"), debug, EXIT_USAGE)

    import torch

    from torchfilt.missions.grace.campaign import run
    from torchfilt.missions.grace.settings import GraceSettings
    from torchfilt.storage import atomic_write

    try:
        starts = options.pop("outage_starts_h")
        settings = GraceSettings(**options, outage_starts_h=None if starts is None else tuple(starts))
    except ValueError as error:
        return _fail(error, debug, EXIT_USAGE)
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        (folder / METRICS).unlink(missing_ok=True)
        atomic_write(folder / SETTINGS, _json(settings.to_dict()))
        say = (lambda line: None) if quiet else print
        result = run(settings, out=folder, figures=figures, say=say, progress=not quiet)
        # Written last: a folder with metrics is a finished run.
        atomic_write(folder / METRICS, _json({"grace": result}))
    except KeyboardInterrupt:
        print("run_grace.py: stopped", file=sys.stderr)
        return EXIT_STOPPED
    except Exception as error:
        return _fail(error, debug, EXIT_FAILED)
    return EXIT_OK


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()


def _fail(error: Exception, debug: bool, code: int) -> int:
    if debug:
        raise error
    print(f"run_grace.py: {(str(error) or type(error).__name__).splitlines()[0]}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
