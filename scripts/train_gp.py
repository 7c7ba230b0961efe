#!/usr/bin/env python
"""Learn one-step dynamics with a Gaussian process, and tell how good and how
honest they are.

Pairs of states one time step apart come from a simulated formation of two
satellites or from an NPZ file. The learned law is tested on pairs that it never
saw: the error of one step, and that error over the standard deviation that the
GP predicted (z: 1 is honest, above 1 overconfident). The run folder receives
settings, versions, metrics, checkpoint, frozen GP and figures.
"""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

from _command import EXIT_FAILED, EXIT_OK, EXIT_USAGE, Signals, add_output_options, fail, new_parser
from jsonargparse import ArgumentParser

EXAMPLES = """\
examples:
  the defaults: 500 pairs around the orbit, residual to two-body motion
    train_gp.py
  residual to Clohessy-Wiltshire motion
    train_gp.py --nominal cw --out runs/cw
  one trajectory is a curve, not a region: z tells
    train_gp.py --source trajectory --nominal cw --kernel ard --phase false
  a log of your own, tested on another day
    train_gp.py --source log.npz --test other_day.npz --phase-column 0
  sparse GP by minibatches
    train_gp.py --inducing 64 --batch-size 128 --noise-floor 1e-3
  go on with a run that was stopped or killed
    train_gp.py --resume --out runs/cw
  the same run with another seed
    train_gp.py --config runs/cw/settings.json --seed 1 --out runs/cw-1

an NPZ file holds x (S, d) and x_next (S, d), and may hold u (S, k), dt (in s)
and group (S,), integers that tell which trajectory a pair comes from. SI units,
float32 or float64, all finite.

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM after saving.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("train_gp.py", __doc__, EXAMPLES)

    group = parser.add_argument_group("Data")
    group.add_argument(
        "--source",
        default="cloud",
        type=str,
        metavar="KIND|FILE",
        help="simulated formation: 'cloud' (states spread around the orbit by 20 m, 0.02 m/s), 'arcs' (ten short "
        "trajectories) or 'trajectory' (one); or an NPZ file",
    )
    group.add_argument("--samples", type=int | None, metavar="N", help="training pairs; 500, or all of a file")
    group.add_argument("--dt", type=float | None, metavar="S", help="time step in s; the file's own, or 10")
    group.add_argument(
        "--held-out", default=0.2, type=float, metavar="SHARE", help="last part of a file's rows, kept for testing"
    )
    group.add_argument("--test", type=str | None, metavar="FILE", help="another NPZ file to test on")
    group.add_argument("--seed", default=0, type=int, metavar="N", help="of data, subset and minibatches")
    group.add_argument(
        "--phase-column",
        type=int | None,
        metavar="N",
        help="column of a file's u that holds the phase in rad; otherwise u is a chief-orbit control (21 columns)",
    )
    group.add_argument(
        "--control-columns",
        default=[],
        type=list[int],
        metavar="[N,...]",
        help="columns of u given to the GP",
    )

    group = parser.add_argument_group("Model")
    group.add_argument(
        "--nominal",
        choices=["two-body", "ltv", "cw", "none", None],
        metavar="LAW",
        help="known dynamics whose residual is learned: 'two-body' motion about the known chief orbit, the same "
        "linearised ('ltv'), Clohessy-Wiltshire ('cw'), or 'none'; two-body where the data allow it",
    )
    group.add_argument(
        "--mean-motion", type=float | None, metavar="RAD_S", help="of 'cw' in rad/s; from the chief's orbit"
    )
    group.add_argument(
        "--target",
        choices=["residual", "identity", "next_state", None],
        metavar="WHAT",
        help="what is learned: 'residual' to the nominal law or, without one, 'identity' (the change of the state) or "
        "'next_state'",
    )
    group.add_argument(
        "--kernel",
        choices=["structured", "ard", "isotropic", None],
        metavar="NAME",
        help="'structured' (affine in the state, periodic in the phase), or a squared exponential with a length-scale "
        "for each input ('ard') or one for all ('isotropic'); structured where there is a phase",
    )
    group.add_argument("--phase", default=True, type=bool, metavar="BOOL", help="give the orbit phase to the GP")
    group.add_argument(
        "--shared", default=False, type=bool, metavar="BOOL", help="one set of hyperparameters for all outputs"
    )
    group.add_argument("--standardize", default=True, type=bool, metavar="BOOL", help="scale inputs and outputs")
    group.add_argument(
        "--noise-floor",
        type=float | None,
        metavar="SHARE",
        help="least noise, relative to the output's standard deviation; 1e-5, sparse 1e-4",
    )
    group.add_argument(
        "--psd",
        type=float | None,
        metavar="M2_S3",
        help="acceleration noise of the nominal law in m^2/s^3; 1e-15, for cw 1e-13",
    )
    group.add_argument("--inducing", type=int | None, metavar="N", help="sparse GP with N inducing points")

    group = parser.add_argument_group("Training")
    group.add_argument(
        "--optimizer",
        choices=["lbfgs", "adam", None],
        metavar="NAME",
        help="'lbfgs' (exact GP, joint over the outputs, line search) or 'adam' (sparse GP)",
    )
    group.add_argument(
        "--epochs", type=int | None, metavar="N", help="at most; 20 of L-BFGS (ten iterations each), 300 of Adam"
    )
    group.add_argument("--learning-rate", default=0.02, type=float, metavar="RATE", help="of Adam")
    group.add_argument("--batch-size", type=int | None, metavar="N", help="minibatch of the sparse GP; all pairs")
    group.add_argument(
        "--hyperparameter-samples",
        default=250,
        type=int,
        metavar="N",
        help="pairs that the hyperparameters are fitted on; the posterior always uses all",
    )
    group.add_argument("--device", default="cpu", type=str, metavar="DEVICE", help="cpu, cuda or cuda:N")
    group.add_argument(
        "--dtype",
        default="float64",
        choices=["float64", "float32"],
        metavar="TYPE",
        help="of the learned law, float64 or float32; training is in double precision",
    )

    group = add_output_options(parser, "runs/gp")
    group.add_argument("--tensorboard", action="store_true", help="log for TensorBoard beside the CSV file")
    return parser


class AfterEpoch(Signals):
    """Remembers the first signal so that the epoch can end and be saved; a second one ends at once."""

    def receive(self, number: int, frame: FrameType | None) -> None:
        if self.received:
            raise SystemExit(128 + number)
        self.received = number
        print("stopping after this epoch; once more to stop now", file=sys.stderr)

    def __call__(self) -> bool:
        return self.received != 0


def parse(arguments: list[str]) -> dict[str, Any]:
    """Options by name; a resumed run has those that it began with, unless they are given again."""
    options = build_parser().parse_args(arguments).as_dict()
    stored = Path(options["out"]) / "settings.json"
    if options["resume"] and stored.is_file():
        # --out again at the end: the folder may have been moved since.
        again = [f"--config={stored}", *arguments, f"--out={options['out']}"]
        options = build_parser().parse_args(again).as_dict()
    options.pop("config", None)
    options["control_columns"] = tuple(options["control_columns"])
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code: 0 done, 1 failed, 2 wrong use, 128 + signal after an orderly stop."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    quiet, debug, threads = (options.pop(name) for name in ("quiet", "debug", "threads"))
    with AfterEpoch() as stop:
        import torch

        from torchfilt.learning.run import RunSettings, UsageError, run_training

        if threads is not None:
            torch.set_num_threads(threads)
        try:
            summary = run_training(
                RunSettings(**options),
                stop=stop,
                say=(lambda line: None) if quiet else print,
                progress=False if quiet else None,
            )
        except UsageError as error:
            return fail("train_gp.py", error, debug, EXIT_USAGE)
        except Exception as error:
            return fail("train_gp.py", error, debug, EXIT_FAILED)
    if summary["interrupted"]:
        print(f"stopped; go on with --resume --out {options['out']}", file=sys.stderr)
        return 128 + stop.received
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
