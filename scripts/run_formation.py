#!/usr/bin/env python
"""Track a satellite relative to another from radar, with learned and with known dynamics, and compare the filters.

The formation of Wei, Song and Zhang (2012) is simulated with J2-J4 and drag; a Gaussian process learns the one-step map
from 500 pairs; all Monte-Carlo runs go through each filter as one batch. The run folder receives metrics.json, figures
and the stages from which an interrupted run goes on.
"""

import signal
import sys
from types import FrameType
from typing import Any

from jsonargparse import ArgumentParser

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2
FILTERS = ("cw-pf", "cw-pf-paper-noise", "cw-ukf", "gp-ukf", "mf-upf", "mf-upf-literal", "exact-ukf")
CASES = ("nominal", "moved", "wide", "control", "leak")


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = ArgumentParser(prog="run_formation.py", description=__doc__)
    parser.add_argument("--config", action="config", help="YAML file with any of these options")

    group = parser.add_argument_group("Study")
    group.add_argument(
        "--case",
        default="nominal",
        choices=CASES,
        help="nominal: as in the study; moved: start 20 m away from what was learned; wide: prior of 100 m and 1 m/s; "
        "control: known thrust; leak: training on the tracked trajectory itself, shown as the fault it is",
    )
    group.add_argument(
        "--filters", default=",".join(FILTERS), type=str, metavar="A,B", help="which, separated by commas"
    )
    group.add_argument("--runs", default=10, type=int, metavar="R", help="Monte-Carlo runs, one batch")
    group.add_argument("--seed", default=0, type=int, help="of radar noise, initial errors and particles")
    group.add_argument("--steps", default=1166, type=int, help="measurements, 10 s apart; 1166 are two revolutions")
    group.add_argument("--particles", default=100, type=int, metavar="N", help="of the unscented particle filters")
    group.add_argument("--bootstrap-particles", default=2000, type=int, metavar="N", help="of the bootstrap filters")

    group = parser.add_argument_group("Learning and noise")
    group.add_argument("--samples", default=500, type=int, metavar="S", help="training pairs")
    group.add_argument("--training-seed", default=0, type=int, help="of the training pairs")
    group.add_argument(
        "--gp-psd-m2-s3",
        default=1e-16,
        type=float,
        metavar="Q",
        help="acceleration noise beside the GP's variance, m^2/s^3",
    )
    group.add_argument(
        "--cw-psd-m2-s3", default=3e-9, type=float, metavar="Q", help="acceleration noise of Clohessy-Wiltshire motion"
    )

    group = parser.add_argument_group("Output")
    group.add_argument("--out", default="runs/formation", type=str, metavar="DIR", help="run folder")
    group.add_argument("--resume", action="store_true", help="go on with what the run folder holds")
    group.add_argument("--force", action="store_true", help="overwrite what the run folder holds")
    group.add_argument("--figures", default=True, type=bool, help="draw figures")
    group.add_argument("--threads", default=1, type=int, help="CPU threads; small tensors gain nothing from more")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


class Stop:
    """Ends the run at the next step: stages that are done are kept. SIGTERM is treated as Ctrl-C is."""

    def __init__(self) -> None:
        self.received = 0
        signal.signal(signal.SIGINT, self._receive)
        signal.signal(signal.SIGTERM, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        raise KeyboardInterrupt


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code: 0 done, 1 failed, 2 wrong use, 128 + signal (130 for Ctrl-C) when interrupted."""
    options = build_parser().parse_args(arguments).as_dict()
    stop = Stop()
    try:
        _run(options)
    except KeyboardInterrupt:
        print(f"\nstopped; go on with --resume --out {options['out']}", file=sys.stderr)
        return 128 + (stop.received or signal.SIGINT)
    except UsageError as error:
        return _fail(error, options["debug"], EXIT_USAGE)
    except (OSError, ValueError, TypeError, RuntimeError, ArithmeticError) as error:
        return _fail(error, options["debug"], EXIT_FAILED)
    return EXIT_OK


class UsageError(Exception):
    """Options that make no sense, or would destroy something."""


def _run(options: dict[str, Any]) -> None:
    from pathlib import Path

    names = [name.strip() for name in options["filters"].split(",") if name.strip()]
    unknown = [name for name in names if name not in FILTERS]
    if unknown or not names:
        raise UsageError(f"--filters takes {','.join(FILTERS)}; got {','.join(unknown) or 'none'}")
    if options["threads"] < 1:
        raise UsageError(f"--threads must be at least 1, got {options['threads']}")
    if options["resume"] and options["force"]:
        raise UsageError("--resume goes on with a run and --force overwrites it: give one of them")
    folder = Path(options["out"])
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file, not a folder")
    if folder.is_dir() and any(folder.iterdir()) and not (options["resume"] or options["force"]):
        raise UsageError(f"--out {folder} is not empty: --resume goes on with it, --force overwrites it")

    import torch

    from torchfilt.missions.formation import StudySettings, run_formation
    from torchfilt.missions.stages import Stages

    own = ("runs", "seed", "case", "particles", "bootstrap_particles", "samples", "training_seed", "steps")
    try:
        settings = StudySettings(**{name: options[name] for name in (*own, "gp_psd_m2_s3", "cw_psd_m2_s3")})
    except ValueError as error:
        raise UsageError(str(error)) from None
    torch.set_num_threads(options["threads"])
    if options["force"]:
        Stages(folder / "stages").clear()
    quiet = options["quiet"]
    run_formation(
        settings,
        folder,
        names,
        say=(lambda line: None) if quiet else (lambda line: print(line, flush=True)),
        progress=not quiet,
        figures=options["figures"],
    )


def _fail(error: Exception, debug: bool, code: int) -> int:
    if debug:
        raise error
    print(f"run_formation.py: {(str(error) or type(error).__name__).splitlines()[0]}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
