"""The GRACE task from settings to numbers and figures."""

import json
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchfilt.missions.grace.data import build_data
from torchfilt.missions.grace.learning import J2, PHASE, POTENTIAL, learn
from torchfilt.missions.grace.prediction import gains, prediction_errors
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.grace.tracking import (
    FILTERS,
    Case,
    CaseName,
    Tracked,
    bias_of_record,
    score,
    simulate_case,
    track,
)
from torchfilt.missions.stages import Stages
from torchfilt.storage import atomic_write

SETTINGS, METRICS, TABLE = "settings.json", "metrics.json", "table.txt"
Say = Callable[[str], None]
_CASES: tuple[CaseName, ...] = ("kband", "radar")
# Learned dynamics beside the nominal law whose residual they hold.
_GAINS = (*PHASE.items(), (J2, POTENTIAL))


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
        out: run folder; receives settings.json, stages/ (finished parts, which the same settings find again),
            table.txt, figures/ and at last metrics.json. None writes nothing.
        figures: draw them, where matplotlib is installed.
        say: receives the report line by line.
        progress: show bars on a terminal.

    Returns:
        JSON-ready: for "nominal-ukf", "gp-ukf" and "mf-upf" the scores of `tracking.score` with the K-band range and,
        under "radar", with a simulated one; "prediction" with an entry for each law and the gains of the learned ones;
        "recorded_bias_m", "settings", "seconds". metrics.json has it under "grace", with "seeds" and "versions".
    """
    settings = settings or GraceSettings()
    begin = time.perf_counter()
    folder = None if out is None else Path(out)
    stages = Stages(None if folder is None else folder / "stages", say)
    if folder is not None:
        (folder / METRICS).unlink(missing_ok=True)
        atomic_write(folder / SETTINGS, _json(settings.to_dict()))
    data = build_data(settings)
    dynamics = learn(data, settings, stages=stages, say=say, progress=None if progress else False)
    entries, growth = prediction_errors(data, dynamics, settings)
    prediction: dict[str, Any] = {
        **entries,
        "gains": {learned: gains(entries, nominal, learned) for nominal, learned in _GAINS},
    }
    result: dict[str, Any] = {name: {} for name in FILTERS}
    cases: dict[str, tuple[Case, dict[str, Tracked]]] = {}
    for case_name in _CASES:
        case = simulate_case(data, settings, case_name)
        found = {}
        for name in FILTERS:
            found[name] = track(name, case, dynamics, settings, stages=stages, progress=progress)
            own = score(found[name], case, settings)
            result[name].update(own if case_name == "kband" else {case_name: own})
            say(f"{name}, {case_name}: {found[name].cpu_s:.1f} s of CPU")
        cases[case_name] = (case, found)
    result |= {
        "prediction": prediction,
        "recorded_bias_m": bias_of_record(data, settings),
        "settings": settings.to_dict(),
        "seconds": time.perf_counter() - begin,
    }
    lines = table(result)
    for line in lines:
        say(line)
    if folder is not None:
        if figures:
            _draw(folder / "figures", settings, growth, cases, result["recorded_bias_m"], say)
        atomic_write(folder / TABLE, ("\n".join(lines).strip("\n") + "\n").encode())
        # Written last: a folder with metrics is a finished run.
        numbers = {"grace": result, "seeds": [settings.seed], "versions": _versions()}
        atomic_write(folder / METRICS, _json(numbers))
    return result


def table(result: dict[str, Any]) -> list[str]:
    """The numbers that matter, as lines of text."""
    return [*_prediction_lines(result["prediction"]), *_tracking_lines(result)]


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def _versions() -> dict[str, str]:
    names = ("torchfilt", "torch", "gpytorch", "pytorch-lightning", "numpy", "scipy")
    return {"python": platform.python_version()} | {name: version(name) for name in names}


def _draw(folder: Path, settings: GraceSettings, growth: Any, cases: Any, recorded: float, say: Say) -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        say("no figures: matplotlib is not installed (pip install 'torchfilt[plot]')")
        return
    from torchfilt.missions.grace.figures import draw

    for path in draw(folder, settings, growth, cases, recorded):
        say(f"figure {path}")


def _prediction_lines(prediction: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    say = lines.append
    say("")
    say(f"{'held-out hours':<20}{'one step, rms':>25}{'z':>12}{'15 min':>11}{'94 min':>11}  (median)")
    for name, entry in prediction.items():
        if name == "gains":
            continue
        position, velocity = entry["one_step"]["position_m"], entry["one_step"]["velocity_m_s"]
        step = f"{position['rms']:.2g} m {velocity['rms']:.2g} m/s"
        honest = f"{position['z']:.2f} {velocity['z']:.2f}"
        medians = "".join(f"{value:>9.3g} m" for value in entry["median_m"].values())
        say(f"{name:<20}{step:>25}{honest:>12}{medians}")
    say("z: error of one step over its predicted deviation, position and velocity; 1 is honest")
    for nominal, name in _GAINS:
        gain = prediction["gains"][name]
        say(
            f"{name}: errors smaller than those of {nominal} by a factor of {gain['one_step_velocity_m_s']:.1f} (one "
            f"step, velocity), {gain['median_15_min']:.1f} (15 min), {gain['median_94_min']:.1f} (94 min)"
        )
    return lines


def _tracking_lines(result: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    say = lines.append
    for title, pick in (("K-band range, angles", None), ("simulated range, angles", "radar")):
        say("")
        say(
            f"{title:<24}{'position':>10}{'(sd)':>7}{'velocity':>14}{'radial':>8}{'along':>7}{'across':>8}"
            f"{'NEES':>6}{'ESS':>5}{'ms':>7}{'' if pick else '  end of outage, in plane'}"
        )
        for name in FILTERS:
            own = result[name] if pick is None else result[name][pick]
            axes = own["axes_rmse_m"]
            spread = "-" if own["position_rmse_sd_m"] is None else f"{own['position_rmse_sd_m']:.2g}"
            ess = "-" if own["ess"] is None else f"{own['ess']:.0f}"
            outage = own.get("outage_end")
            after = "" if outage is None else f"{outage['position_rmse_m']:>9.3g} m {outage['in_plane_rmse_m']:>9.3g} m"
            say(
                f"{name:<24}{own['position_rmse_m']:>8.3g} m{spread:>7}"
                f"{own['velocity_rmse_m_s']:>10.2g} m/s"
                f"{axes['radial']:>8.2g}{axes['along']:>7.2g}{axes['across']:>8.3g}"
                f"{own['nees']:>6.1f}{ess:>5}{own['ms_per_step']:>7.2f}{after}"
            )
    band = result["gp-ukf"]["nees_band_95"]
    say(f"NEES: 6 is ideal; 95 % band of its mean over the runs at one epoch {band[0]:.1f} to {band[1]:.1f}")
    bias = result["gp-ukf"]["bias"]
    say(
        f"bias of the K-band range: {result['recorded_bias_m']:.3f} m against the orbits; "
        f"gp-ukf {bias['estimate_m']:.3f} m, sd {bias['sd_m']:.3f} m"
    )
    return lines
