#!/usr/bin/env python
"""Learn one-step dynamics with a Gaussian process and report how good and how honest they are.

Pairs of states one time step apart come from a simulated two-satellite formation or from an NPZ file. The run folder
receives settings, versions, metrics, checkpoint, the frozen GP and figures.
"""

import signal
import sys
from types import FrameType

from jsonargparse import ArgumentParser

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = ArgumentParser(prog="train_gp.py", description=__doc__)
    parser.add_argument("--config", action="config", help="YAML file with any of these options")

    group = parser.add_argument_group("Data")
    group.add_argument(
        "--source",
        default="cloud",
        type=str,
        metavar="KIND|FILE",
        help="simulated formation: 'cloud' (states spread around the orbit), 'arcs' (several trajectories) or 'trajectory' "
        "(one); or an NPZ file with x (S, d), x_next (S, d) and, if the model needs them, controls u (S, k)",
    )
    group.add_argument("--samples", default=500, type=int, help="training pairs")
    group.add_argument("--dt", default=10.0, type=float, metavar="S", help="time step in seconds")
    group.add_argument("--seed", default=0, type=int, help="seed of data, subset and minibatches")
    group.add_argument(
        "--phase-column",
        default=None,
        type=int,
        metavar="N",
        help="NPZ only: column of u that holds the phase angle in rad; default: u is a chief-orbit control",
    )

    group = parser.add_argument_group("Model")
    group.add_argument(
        "--nominal",
        default="two-body",
        choices=["two-body", "ltv", "cw", "none"],
        help="known dynamics whose residual is learned: motion about the known chief orbit (full or linearised), "
        "Clohessy-Wiltshire, or none",
    )
    group.add_argument("--target", default=None, choices=["residual", "identity", "next_state"], help="what is learned")
    group.add_argument(
        "--kernel",
        default="structured",
        choices=["structured", "ard", "isotropic"],
        help="affine in the state and periodic in the orbit phase, or a squared exponential",
    )
    group.add_argument("--phase", default=True, type=bool, help="give the orbit phase to the GP")
    group.add_argument("--shared", default=False, type=bool, help="one set of hyperparameters for all outputs")
    group.add_argument("--standardize", default=True, type=bool, help="scale inputs and outputs")
    group.add_argument(
        "--noise-floor", default=1e-5, type=float, help="least noise, relative to the output's deviation"
    )
    group.add_argument("--psd", default=None, type=float, metavar="M2_S3", help="acceleration noise of the nominal law")
    group.add_argument("--inducing", default=None, type=int, metavar="N", help="sparse GP with N inducing points")

    group = parser.add_argument_group("Training")
    group.add_argument("--optimizer", default=None, choices=["lbfgs", "adam"], help="default by model")
    group.add_argument("--epochs", default=None, type=int, help="at most this many; default by optimizer")
    group.add_argument("--learning-rate", default=0.02, type=float, help="of Adam")
    group.add_argument("--batch-size", default=None, type=int, help="minibatch of the sparse GP")
    group.add_argument(
        "--hyperparameter-samples", default=250, type=int, help="pairs that hyperparameters are fitted on"
    )
    group.add_argument("--device", default="cpu", type=str, help="cpu, cuda or cuda:N")
    group.add_argument("--dtype", default="float64", choices=["float64", "float32"], help="floating-point precision")
    group.add_argument("--threads", default=None, type=int, help="CPU threads; default as torch chooses")

    group = parser.add_argument_group("Output")
    group.add_argument("--out", default="runs/gp", type=str, metavar="DIR", help="run folder")
    group.add_argument("--resume", action="store_true", help="go on from the checkpoint in the run folder")
    group.add_argument("--force", action="store_true", help="overwrite an existing run")
    group.add_argument("--figures", default=True, type=bool, help="draw figures")
    group.add_argument("--tensorboard", action="store_true", help="log for TensorBoard beside the CSV file")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


class Stop:
    """Remembers the first SIGINT or SIGTERM so that the epoch can end and be saved; a second one ends at once."""

    def __init__(self) -> None:
        self.received = 0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received:
            raise SystemExit(128 + number)
        self.received = number
        print("stopping after this epoch; once more to stop now", file=sys.stderr)

    def __call__(self) -> bool:
        return self.received != 0


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code: 0 done, 1 failed, 2 wrong use, 128 + signal after an orderly stop."""
    options = build_parser().parse_args(arguments).as_dict()
    options.pop("config", None)
    quiet, debug = options.pop("quiet"), options.pop("debug")
    stop = Stop()
    from torchfilt.learning.run import RunSettings, UsageError, run_training

    try:
        summary = run_training(
            RunSettings(**options), stop=stop, say=(lambda line: None) if quiet else print, progress=None
        )
    except UsageError as error:
        return _fail(error, debug, EXIT_USAGE)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        return _fail(error, debug, EXIT_FAILED)
    if summary["interrupted"]:
        print(f"stopped; go on with --resume --out {options['out']}", file=sys.stderr)
        return 128 + stop.received
    return EXIT_OK


def _fail(error: Exception, debug: bool, code: int) -> int:
    if debug:
        raise error
    print(f"train_gp.py: {str(error).splitlines()[0]}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
