"""What the command lines of this folder share: help, exit codes, interruption, the run folder. Loads nothing heavy."""

import signal
import sys
from argparse import RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from jsonargparse import ArgumentParser, DefaultHelpFormatter

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


class UsageError(Exception):
    """Options that make no sense, or would destroy something."""


class HelpFormatter(DefaultHelpFormatter, RawDescriptionHelpFormatter):
    """Keeps the lines of the description and the examples; gives a default where there is one to give."""

    def _get_help_string(self, action: Any) -> str:
        text = action.help or ""
        if not action.option_strings or action.default in (None, "==SUPPRESS==", [], ()) or action.nargs == 0:
            return text
        return f"{text} (default: %(default)s)"


def new_parser(program: str, description: str | None, examples: str) -> ArgumentParser:
    """A parser that also reads its options from a file."""
    parser = ArgumentParser(
        prog=program,
        usage="%(prog)s [options]",
        description=description,
        epilog=examples,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--config", action="config", metavar="FILE", help="YAML or JSON file with any of these options")
    return parser


def add_output_options(parser: ArgumentParser, out: str) -> Any:
    """Where results go and what is printed; returns the group for more."""
    group = parser.add_argument_group("Output")
    group.add_argument("--out", default=out, type=str, metavar="DIR", help="run folder")
    group.add_argument("--resume", action="store_true", help="go on with the run in the run folder")
    group.add_argument("--force", action="store_true", help="overwrite the run in the run folder")
    group.add_argument("--figures", default=True, type=bool, metavar="BOOL", help="draw figures")
    group.add_argument("--threads", type=int | None, metavar="N", help="CPU threads; as many as torch likes")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return group


def check_folder(options: dict[str, Any]) -> Path:
    """The run folder, if the options may use it.

    Raises:
        UsageError: it holds a run that would be lost, it is no folder, or the options contradict each other.
    """
    folder = Path(options["out"])
    if options["resume"] and options["force"]:
        raise UsageError("--resume goes on with a run and --force overwrites it: give one of them")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()) and not (options["resume"] or options["force"]):
        raise UsageError(f"--out {folder} is not empty: --resume goes on with it, --force overwrites it")
    if options["threads"] is not None and options["threads"] < 1:
        raise UsageError(f"--threads must be at least 1, got {options['threads']}")
    return folder


def chosen(text: str, known: Sequence[str]) -> list[str]:
    """Names of ``--filters``, separated by commas.

    Raises:
        UsageError: none, one that is not known, one twice.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise UsageError(f"--filters takes {','.join(known)}; got {','.join(unknown) or 'none'}")
    twice = [name for k, name in enumerate(names) if name in names[:k]]
    if twice:
        raise UsageError(f"--filters takes each name once; got {','.join(twice)} again")
    return names


def prepare(options: dict[str, Any], folder: Path) -> Callable[[str], None]:
    """Set the threads, clear what ``--force`` overwrites; returns what a study tells its lines to."""
    import torch

    from torchfilt.missions.stages import Stages

    if options["threads"] is not None:
        torch.set_num_threads(options["threads"])
    if options["force"]:
        Stages(folder / "stages").clear()
    return (lambda line: None) if options["quiet"] else (lambda line: print(line, flush=True))


class Signals:
    """While entered, SIGINT and SIGTERM end the run at once, as Ctrl-C does; ``received`` is the signal's number."""

    def __init__(self) -> None:
        self.received = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self.receive)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def receive(self, number: int, frame: FrameType | None) -> None:
        """Called by the system."""
        self.received = number
        raise KeyboardInterrupt


def run_command(program: str, options: dict[str, Any], run: Callable[[dict[str, Any]], None]) -> int:
    """Run and return the exit code: 0 done, 1 failed, 2 wrong use, 128 + signal when interrupted."""
    debug, stop = options["debug"], Signals()
    try:
        with stop:
            run(dict(options))  # a copy: what it takes out is still needed here
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second during a fit
        if not stop.received:
            raise
        print(f"{program}: stopped; go on with --resume --out {options['out']}", file=sys.stderr)
        return 128 + stop.received
    except UsageError as error:
        return fail(program, error, debug, EXIT_USAGE)
    except Exception as error:
        return fail(program, error, debug, EXIT_FAILED)
    return EXIT_OK


def fail(program: str, error: Exception, debug: bool, code: int) -> int:
    """One line about an error, or its traceback; returns the exit code."""
    if debug:
        raise error
    print(f"{program}: {(str(error) or type(error).__name__).splitlines()[0]}", file=sys.stderr)
    return code
