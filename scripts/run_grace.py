#!/usr/bin/env python
"""Learn the relative motion of two real satellites from hours of their log, and
track them through the hours that follow.

GRACE A and B on 27 July 2010. Gaussian processes learn what a nominal law of
motion misses; predictions without measurements and three filters are compared
with the precise orbits of hours that were not learned from. The run folder
receives settings, metrics, a table, figures and the finished parts.
"""

import signal
import sys
from argparse import RawDescriptionHelpFormatter
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from jsonargparse import ArgumentParser, DefaultHelpFormatter

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2

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
    group.add_argument("--resume", action="store_true", help="keep the finished parts that the run folder holds")
    group.add_argument("--force", action="store_true", help="overwrite the run in the run folder")
    group.add_argument("--figures", default=True, type=bool, metavar="BOOL", help="draw figures")
    group.add_argument("--threads", type=int | None, metavar="N", help="CPU threads; as many as torch likes")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


class UsageError(Exception):
    """Options that make no sense, or would destroy something."""


class Stop:
    """SIGINT and SIGTERM end the run at once; finished parts are kept."""

    def __init__(self) -> None:
        self.received = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Stop":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        raise KeyboardInterrupt


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    out, debug = options["out"], options["debug"]
    stop = Stop()
    try:
        with stop:
            _run(options)
    except (KeyboardInterrupt, SystemExit):  # a training turns the first into the second
        if not stop.received:
            raise
        print(f"run_grace.py: stopped; go on with --resume --out {out}", file=sys.stderr)
        return 128 + stop.received
    except UsageError as error:
        return _fail(error, debug, EXIT_USAGE)
    except Exception as error:
        return _fail(error, debug, EXIT_FAILED)
    return EXIT_OK


def _run(options: dict[str, Any]) -> None:
    options.pop("config", None)
    out, force, resume, figures, threads, quiet, _ = (
        options.pop(name) for name in ("out", "force", "resume", "figures", "threads", "quiet", "debug")
    )
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {out}: not a folder")
    if resume and force:
        raise UsageError("--resume goes on with a run and --force overwrites it: give one of them")
    if (folder / "settings.json").exists() and not (resume or force):
        raise UsageError(f"--out {out} holds a run already: --resume goes on with it, --force overwrites it")

    import torch

    from torchfilt.missions.grace.campaign import run
    from torchfilt.missions.grace.settings import GraceSettings
    from torchfilt.missions.stages import Stages

    starts = options.pop("outage_starts_h")
    try:
        settings = GraceSettings(**options, outage_starts_h=None if starts is None else tuple(starts))
    except ValueError as error:
        raise UsageError(str(error)) from None
    if threads is not None:
        torch.set_num_threads(threads)
    if force:
        Stages(folder / "stages").clear()

    def say(line: str) -> None:
        if not quiet:
            print(line, flush=True)

    run(settings, out=folder, figures=figures, say=say, progress=not quiet)


def _fail(error: Exception, debug: bool, code: int) -> int:
    if debug:
        raise error
    print(f"run_grace.py: {(str(error) or type(error).__name__).splitlines()[0]}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
