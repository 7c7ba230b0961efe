"""The GRACE task from settings to numbers and figures."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchfilt.history import History
from torchfilt.missions.grace.data import build_data
from torchfilt.missions.grace.learning import POTENTIAL, learn
from torchfilt.missions.grace.prediction import gains, prediction_errors
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.grace.tracking import (
    FILTERS,
    NOMINAL,
    Case,
    CaseName,
    bias_of_record,
    score,
    simulate_case,
    track,
)

Say = Callable[[str], None]
_CASES: tuple[CaseName, ...] = ("kband", "radar")
# Learned dynamics beside the nominal law whose residual they hold.
_GAINS = (("two-body", "two-body + phase GP"), ("J2", "J2 + phase GP"), (NOMINAL, POTENTIAL))


def run(
    settings: GraceSettings | None = None,
    *,
    out: str | Path | None = None,
    figures: bool = True,
    say: Say = lambda line: None,
    progress: bool = False,
) -> dict[str, Any]:
    """Learn, predict, track; the same settings give the same numbers, times apart.

    Args:
        settings: None for the defaults.
        out: folder for figures, checkpoints and logs; None writes nothing.
        figures: draw them, where matplotlib is installed and ``out`` is given.
        say: receives the report line by line.
        progress: show a bar for each filter.

    Returns:
        JSON-ready: for "nominal-ukf", "gp-ukf" and "mf-upf" the scores of `tracking.score` with the K-band range and,
        under "radar", with a simulated one; "prediction" with an entry for each law and the gains of the learned ones;
        "settings", "seconds".
    """
    settings = settings or GraceSettings()
    begin = time.perf_counter()
    data = build_data(settings)
    dynamics = learn(data, settings, out=out, say=say)
    entries, growth = prediction_errors(data, dynamics, settings)
    prediction: dict[str, Any] = {
        **entries,
        "gains": {learned: gains(entries, *pair) for pair in _GAINS for learned in pair[1:]},
    }
    _say_prediction(prediction, say)
    result: dict[str, Any] = {name: {} for name in FILTERS}
    cases: dict[str, tuple[Case, dict[str, History]]] = {}
    for case_name in _CASES:
        case = simulate_case(data, settings, case_name)
        histories = {}
        for name in FILTERS:
            histories[name], milliseconds = track(name, case, dynamics, settings, progress=progress)
            own = {**score(histories[name], case, settings), "ms_per_step": milliseconds}
            result[name].update(own if case_name == "kband" else {case_name: own})
        cases[case_name] = (case, histories)
    recorded = bias_of_record(data, settings)
    _say_tracking(result, recorded, say)
    if figures and out is not None:
        _draw(Path(out) / "figures", settings, growth, cases, recorded, say)
    result |= {
        "prediction": prediction,
        "recorded_bias_m": recorded,
        "settings": settings.to_dict(),
        "seconds": time.perf_counter() - begin,
    }
    return result


def _draw(folder: Path, settings: GraceSettings, growth: Any, cases: Any, recorded: float, say: Say) -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        say("no figures: matplotlib is not installed (pip install 'torchfilt[plot]')")
        return
    from torchfilt.missions.grace.figures import draw

    for path in draw(folder, settings, growth, cases, recorded):
        say(f"figure {path}")


def _say_prediction(prediction: dict[str, Any], say: Say) -> None:
    say("")
    say(f"{'prediction, held out':<22}{'one step':>24}{'z':>12}{'15 min':>10}{'94 min':>10}  median")
    for name, entry in prediction.items():
        if name == "gains":
            continue
        position, velocity = entry["one_step"]["position_m"], entry["one_step"]["velocity_m_s"]
        step = f"{position['rms']:.2e} m {velocity['rms']:.2e} m/s"
        honest = f"{position['z']:.2f} {velocity['z']:.2f}"
        medians = "".join(f"{value:>8.3g} m" for value in entry["median_m"].values())
        say(f"{name:<20}{step:>26}{honest:>12}{medians}")
    for name, gain in prediction["gains"].items():
        words = ", ".join(f"{key.replace('_', ' ')} {value:.1f}" for key, value in gain.items())
        say(f"{name}, error of its nominal law over its own: {words}")


def _say_tracking(result: dict[str, Any], recorded: float, say: Say) -> None:
    for title, pick in (("K-band range + angles", None), ("simulated range + angles", "radar")):
        say("")
        say(
            f"{title:<26}{'position':>10}{'(sd)':>8}{'velocity':>11}{'radial':>9}{'along':>8}{'across':>8}"
            f"{'NEES':>7}{'ESS':>6}{'ms':>7}{'after outage':>14}"
        )
        for name in FILTERS:
            own = result[name] if pick is None else result[name][pick]
            axes = own["axes_rmse_m"]
            ess = "-" if own["ess"] is None else f"{own['ess']:.0f}"
            outage = own.get("outage_end")
            after = "" if outage is None else f"{outage['position_rmse_m']:.3g} m"
            say(
                f"{name:<26}{own['position_rmse_m']:>8.3g} m{own['position_rmse_sd_m']:>8.2g}"
                f"{own['velocity_rmse_m_s']:>11.2e}{axes['radial']:>9.3g}{axes['along']:>8.2g}{axes['across']:>8.3g}"
                f"{own['nees']:>7.2f}{ess:>6}{own['ms_per_step']:>7.2f}{after:>14}"
            )
        band = result["gp-ukf"]["nees_band_95"]
        say(f"NEES: 6 is ideal, 95 % band of its mean over the runs at one epoch {band[0]:.1f} to {band[1]:.1f}")
    bias = result["gp-ukf"]["bias"]
    say(
        f"bias of the K-band range: {recorded:.3f} m against the orbits; "
        f"gp-ukf {bias['estimate_m']:.3f} m, sd {bias['sd_m']:.3f} m"
    )
