#!/usr/bin/env python
"""Track a satellite relative to another from radar, with learned and with known
dynamics, and compare the filters.

The formation of Wei, Song and Zhang (2012) is simulated with J2-J4 and drag; a
Gaussian process learns the one-step map from 500 pairs; all Monte-Carlo runs go
through each filter as one batch. The run folder receives metrics.json,
table.txt, figures and the stages from which an interrupted run goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

FILTERS = (
    "cw-pf",
    "cw-pf-paper-noise",
    "cw-ukf",
    "gp-ukf",
    "mf-upf",
    "mf-upf-literal",
    "latent-force-ukf",
    "exact-ukf",
)
CASES = ("nominal", "moved", "wide", "control", "leak")


EXAMPLES = """\
examples:
  the study: seven filters and a radar-only one, 10 runs, two revolutions
    run_formation.py
  more runs, only the learned filters and their bound
    run_formation.py --runs 40 --filters gp-ukf,mf-upf,exact-ukf
  a wide prior, where the bootstrap filter fails
    run_formation.py --case wide --filters cw-pf,mf-upf --out runs/wide
  what training on the tracked trajectory itself pretends
    run_formation.py --case leak --filters gp-ukf,exact-ukf --out runs/leak
  a third revolution, learned from radar alone
    run_formation.py --steps 1749 --filters latent-force-ukf --out runs/latent

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_formation.py", __doc__, EXAMPLES)

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

    add_output_options(parser, "runs/formation")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_formation.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    names = chosen(options["filters"], FILTERS)
    folder = check_folder(options)

    from torchfilt.missions.formation import StudySettings, run_formation

    own = ("runs", "seed", "case", "particles", "bootstrap_particles", "samples", "training_seed", "steps")
    try:
        settings = StudySettings(**{name: options[name] for name in (*own, "gp_psd_m2_s3", "cw_psd_m2_s3")})
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run_formation(
        settings,
        folder,
        names,
        say=say,
        progress=not options["quiet"],
        figures=options["figures"],
    )


if __name__ == "__main__":
    sys.exit(main())
