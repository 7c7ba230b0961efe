#!/usr/bin/env python
"""Navigate by inertial sensors and fixes, with classical, regularised and
Metropolis-Hastings particle filters on the same data, or on real logs.

A simulated reconnaissance flight (sins-sar and its variants) or a logged one
goes through each filter, all Monte-Carlo runs as one batch. The run folder
receives metrics.json, table.txt, figures and the stages from which an
interrupted run goes on.
"""

import sys
from typing import Any

from _command import UsageError, add_output_options, check_folder, chosen, new_parser, prepare, run_command
from jsonargparse import ArgumentParser

SCENARIOS = ("sins-sar", "mems", "heading-unknown", "outliers", "uav", "car")
FILTERS = (
    "es-kf",
    "es-kf-gated",
    "es-kf-open",
    "ckf",
    "bank-36",
    "sir",
    "rpf-plain",
    "rpf",
    "mpf",
    "mpf-window",
    "mpf-literal",
    "rbpf",
    "rbpf-shared",
)
# Of the logged drives: filters with and without what helps them.
VARIANTS = {
    "uav": ("es-kf", "es-kf-barometer", "es-kf-undelayed", "ckf-barometer", "rpf-barometer"),
    "car": ("es-kf", "es-kf-constraint", "ckf-constraint"),
}

# A log has its own length and one run.
FLIGHT_OPTIONS = ("runs", "steps", "conditional_particles", "window")

EXAMPLES = """\
examples:
  the study: ten filters, 8 runs of 1000 s
    run_inertial.py
  where particles earn their keep: heading off by 60 deg, no heading fix
    run_inertial.py --scenario heading-unknown --particles 5000 \\
      --out runs/heading
  only two filters, more particles
    run_inertial.py --filters es-kf,rpf --particles 10000 --out runs/many
  a logged drive whose fixes are withheld for 10, 30 and 60 s
    run_inertial.py --scenario car --out runs/car

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("run_inertial.py", __doc__, EXAMPLES)

    group = parser.add_argument_group("Study")
    group.add_argument(
        "--scenario",
        default="sins-sar",
        choices=SCENARIOS,
        help="sins-sar: tactical sensors, as in the study; mems: micromachined ones; heading-unknown: heading off by "
        "60 deg and no heading fix; outliers: 15 in 100 fixes with ten times their noise; uav, car: real logs, fixes "
        "withheld",
    )
    group.add_argument(
        "--filters",
        type=str | None,
        metavar="A,B",
        help=f"out of {', '.join(FILTERS)}; of a log out of {', '.join(VARIANTS['uav'])} or "
        f"{', '.join(VARIANTS['car'][1:])}; default what the scenario is about",
    )
    group.add_argument("--data", type=str | None, metavar="DIR", help="folder of the log; data/ of the repository")
    group.add_argument("--runs", default=8, type=int, metavar="R", help="Monte-Carlo runs, one batch")
    group.add_argument("--seed", default=0, type=int, help="of sensor noise, start errors and particles")
    group.add_argument("--steps", default=1000, type=int, help="fixes, a second apart; at most 1000")
    group.add_argument(
        "--particles", type=int | None, metavar="N", help="of the particle filters; 2000, on a log 10000"
    )
    group.add_argument(
        "--conditional-particles", default=1000, type=int, metavar="N", help="of the Rao-Blackwellised one"
    )
    group.add_argument("--window", default=5, type=int, metavar="L", help="states that trajectory moves look back on")

    add_output_options(parser, "runs/inertial")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code."""
    options = build_parser().parse_args(sys.argv[1:] if arguments is None else arguments).as_dict()
    return run_command("run_inertial.py", options, _run)


def _run(options: dict[str, Any]) -> None:
    scenario, names = options["scenario"], None
    if options["filters"] is not None:
        names = chosen(options["filters"], VARIANTS.get(scenario, FILTERS))
    if options["data"] is not None and scenario not in VARIANTS:
        raise UsageError(f"--data belongs to a log, the scenario {scenario} is simulated")
    usual = build_parser().get_defaults()
    given = [name for name in FLIGHT_OPTIONS if options[name] != usual[name]]
    if given and scenario in VARIANTS:
        option = given[0].replace("_", "-")
        raise UsageError(f"--{option} belongs to a simulated flight, the scenario {scenario} is a log")
    folder = check_folder(options)

    from torchfilt.missions.inertial import InertialSettings, LogSettings, run_inertial, run_log

    particles = {} if options["particles"] is None else {"particles": options["particles"]}
    own = ("scenario", "seed", *FLIGHT_OPTIONS)
    settings: InertialSettings | LogSettings
    try:
        if scenario in VARIANTS:
            settings = LogSettings(scenario, options["data"], seed=options["seed"], **particles)
        else:
            settings = InertialSettings(**{name: options[name] for name in own}, **particles)
    except ValueError as error:
        raise UsageError(str(error)) from None
    say = prepare(options, folder)
    run: Any = run_log if isinstance(settings, LogSettings) else run_inertial
    run(
        settings,
        folder,
        names,
        say=say,
        progress=not options["quiet"],
        figures=options["figures"],
    )


if __name__ == "__main__":
    sys.exit(main())
