"""The SINS/SAR study as a run: stages that are kept, errors by group, consistency, a table, figures."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilt.metrics import chi_square_band, nees
from torchfilt.missions.inertial.scene import (
    ARC_MINUTE,
    DEFAULT,
    FILTERS,
    SCENARIOS,
    InertialSettings,
    Scene,
    make_filter,
    make_scene,
)
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import run_study
from torchfilt.models.inertial.error_model import ERROR_SPACE
from torchfilt.particles import Particles
from torchfilt.recording import Series

# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 2
# Tangent components of the error, and what they are told in. Position, velocity and biases are lengths of vectors, tilt
# is an angle about one horizontal axis.
GROUPS = {
    "position_m": ((6, 7, 8), 1.0),
    "velocity_m_s": ((3, 4, 5), 1.0),
    "tilt_arcmin": ((0, 1), ARC_MINUTE * 2**0.5),
    "heading_arcmin": ((2,), ARC_MINUTE),
    "drift_deg_h": ((9, 10, 11), np.radians(1) / 3600),
    "bias_ug": ((12, 13, 14), 9.80665e-6),
}
# Until then the start errors of attitude and velocity are found out, not yet tracked.
SETTLED_S = 200


def run_filter(name: str, scene: Scene, settings: InertialSettings, progress: bool = False) -> Arrays:
    """Filter all runs of a scene, a step at a time.

    Args:
        name: one of `FILTERS`. scene, settings: see `make_filter`. progress: show a bar on a terminal.

    Returns:
        error (t, R, 15) from truth to estimate, tangent; deviation (t, R, 15) claimed; nees, ok (t, R); where the
        filter has them, NaN elsewhere: nis, ess, unique (different ancestors of a step's particles), roots (different
        ancestors among the first step's particles), acceptance (t, R); cpu_s (t,), of all runs together.
    """
    from tqdm import tqdm

    tracker = make_filter(name, scene, settings)
    runs = scene.truth.shape[1]
    state = tracker.init((runs,), settings.seed)
    steps = len(scene.fixes)
    rows: dict[str, Series] = {}
    roots = None
    for k in tqdm(range(steps), unit="step", disable=None if progress else True):
        begin = time.process_time()
        with torch.no_grad():
            state, info = tracker.step(state, scene.fixes[k], scene.controls[k], 1.0, throw=False)
        seconds = time.process_time() - begin
        belief = state.belief
        mean, covariance = belief.moments() if isinstance(belief, Particles) else (belief.mean, belief.covariance)
        absent = torch.full((runs,), torch.nan, dtype=torch.float64)
        if info.ancestors is not None:
            roots = info.ancestors if roots is None else roots.gather(-1, info.ancestors)
        step = {
            "error": ERROR_SPACE.local(scene.truth[k], mean),
            "deviation": covariance.diagonal(dim1=-2, dim2=-1).sqrt(),
            "nees": nees(mean, scene.truth[k], covariance, ERROR_SPACE),
            "ok": info.ok,
            "nis": absent if info.nis is None else info.nis,
            "ess": absent if info.ess is None else info.ess,
            "acceptance": absent if info.acceptance_rate is None else info.acceptance_rate,
            "unique": absent if info.ancestors is None else different(info.ancestors),
            "roots": absent if roots is None else different(roots),
            "cpu_s": torch.tensor(seconds),
        }
        for key, value in step.items():
            rows.setdefault(key, Series(steps, at_once=True)).add(value)
    return {key: series.stacked().numpy() for key, series in rows.items()}


def different(indices: Tensor) -> Tensor:
    """How many different numbers (...) there are in each row (..., n), as floating point."""
    ordered = indices.sort(-1).values
    return 1.0 + (ordered[..., 1:] != ordered[..., :-1]).double().sum(-1)


def summarize(result: Arrays, measured: int) -> dict[str, Any]:
    """Numbers of one filter.

    Args:
        result: of `run_filter`. measured: components of a fix.

    Returns:
        For each of `GROUPS` the RMSE over all runs after `SETTLED_S` (over everything where less was flown), of the
        worst run as ``worst_...``, over the whole flight as ``whole_...``; as a share of their degrees of freedom nees
        and nis, means over the same time, and nees_end, over the last tenth, with the 95 % band of a mean over as many
        runs; means of ess, unique, acceptance; roots at the end; ms_per_step, CPU time of all runs together; failed,
        runs with a failed step.
    """
    error, ok = result["error"], result["ok"]
    lost = ~np.isfinite(error).all((0, 2)) | ~ok.all(0)
    begin = SETTLED_S if len(error) > SETTLED_S else 0
    summary: dict[str, Any] = {}
    for name, (index, unit) in GROUPS.items():
        square = np.sum((error[..., list(index)] / unit) ** 2, -1)
        square = np.where(np.isfinite(square), square, np.inf)
        summary[name] = _plain(np.sqrt(np.mean(square[begin:])))
        summary[f"worst_{name}"] = _plain(np.sqrt(np.mean(square[begin:], 0)).max())
        summary[f"whole_{name}"] = _plain(np.sqrt(np.mean(square)))
    band = chi_square_band(15, error.shape[1])
    last = max(1, len(error) // 10)
    summary["nees"] = _plain(result["nees"][begin:].mean() / 15)
    summary["nees_end"] = _plain(result["nees"][-last:].mean() / 15)
    summary["nees_band_95"] = [band.low / 15, band.high / 15]
    summary["nis"] = _plain(result["nis"][begin:].mean() / measured)
    for name in ("ess", "unique", "acceptance"):
        summary[name] = _plain(result[name].mean())
    summary["roots"] = _plain(result["roots"][-1].mean())
    summary["ms_per_step"] = _plain(1e3 * np.median(result["cpu_s"]))
    summary["failed"] = int(lost.sum())
    return summary


def run_inertial(
    settings: InertialSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `InertialSettings`.
        out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default those the scenario is about.
        say: told what happens, a line each.
        progress: show bars on a terminal.
        figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), open_loop_m (error of the system without fixes at
        the end), scenario, settings, versions.

    Raises:
        ValueError: unknown filter.
    """
    names = DEFAULT[settings.scenario] if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    say(f"{settings.scenario}: {SCENARIOS[settings.scenario]}; {settings.runs} runs of {settings.steps} s")
    scene = make_scene(settings)
    away = torch.linalg.vector_norm(scene.truth[-1, :, 7:10], dim=-1)
    open_loop_m = float(away.square().mean().sqrt())
    say(f"without fixes the system is off by {open_loop_m:.0f} m at the end (rms of the runs)")
    measured = 3 if settings.scenario == "heading-unknown" else 4

    def draw(results: dict[str, Arrays], folder: Path) -> list[Path]:
        from torchfilt.missions.inertial.figures import inertial_figures

        return inertial_figures(results, scene, settings, folder)

    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: _recipe(name, settings),
        follow=lambda name: run_filter(name, scene, settings, progress),
        summarize=lambda name, result: summarize(result, measured),
        table=table,
        draw=draw if figures else None,
        say=say,
        more={"scenario": settings.scenario, "open_loop_m": open_loop_m},
    )


_PARTICLES = ("sir", "rpf-plain", "rpf", "mpf", "mpf-window", "mpf-literal")


def _recipe(name: str, settings: InertialSettings) -> dict[str, Any]:
    """What the result of a stage depends on."""
    own = {"version": _VERSION, **settings.to_dict()}
    if name not in _PARTICLES:
        del own["particles"]
    if not name.startswith("rbpf"):
        del own["conditional_particles"]
    if name not in ("mpf-window", "mpf-literal"):
        del own["window"]
    return own


_COLUMNS = (
    ("position_m", "position, m", ".3g"),
    ("velocity_m_s", "velocity, m/s", ".2g"),
    ("tilt_arcmin", "tilt, '", ".2g"),
    ("heading_arcmin", "heading, '", ".2g"),
    ("nees", "NEES/15", ".2g"),
    ("nees_end", "at the end", ".2g"),
    ("nis", "NIS/m", ".3g"),
    ("ess", "ESS", ".0f"),
    ("unique", "unique", ".0f"),
    ("roots", "roots", ".0f"),
    ("acceptance", "accepted", ".2g"),
    ("whole_position_m", "whole flight", ".3g"),
    ("ms_per_step", "ms/step", ".1f"),
    ("worst_position_m", "worst, m", ".3g"),
    ("failed", "failed", "d"),
)


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a table, a filter a row."""
    head = f"{'filter':12s} " + " ".join(f"{title:>13s}" for _, title, _ in _COLUMNS)
    lines = [
        "",
        f"RMSE over all runs after {SETTLED_S} s (tilt: of an axis); roots: what is left of the first particles",
        head,
    ]
    for name, entry in summary["filters"].items():
        cells = ["-" if entry[key] is None else format(entry[key], form) for key, _, form in _COLUMNS]
        lines.append(f"{name:12s} " + " ".join(f"{cell:>13s}" for cell in cells))
    return lines


def _plain(value: Any) -> float | None:
    """JSON-ready: None where there is no finite number."""
    number = float(value)
    return number if np.isfinite(number) else None
