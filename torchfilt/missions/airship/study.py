"""Run the filters of the airship's navigation over a scene, sum up errors by phase, write tables and figures."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilt.delays import DelayedMeasurements
from torchfilt.gaussian import Gaussian
from torchfilt.missions.airship.navigation import (
    DEFAULT,
    FILTERS,
    VARIANTS,
    late_readings,
    make_filter,
    readings,
)
from torchfilt.missions.airship.scene import FILTER_RATE_HZ, AirshipSettings, Scene, make_scene
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import run_study
from torchfilt.models.landing import LANDING_SPACE
from torchfilt.modes import NavigationModes
from torchfilt.types import Moded, StepInfo, trusted

# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 3
PHASES = ("anchored", "cruise", "approach")
SETTLE_S = 5.0
"""So much of each phase, at its start, is not scored."""
# Tangent components of the 15 errors that all forms share, and what they are told in.
GROUPS = {
    "tilt_deg": (slice(0, 2), 180 / np.pi),
    "heading_deg": (slice(2, 3), 180 / np.pi),
    "velocity_m_s": (slice(3, 6), 1.0),
    "horizontal_m": (slice(6, 8), 1.0),
    "height_m": (slice(8, 9), 1.0),
}
_SHARED = 15


def run_filter(name: str, scene: Scene, progress: bool = False) -> Arrays:
    """Filter all runs of a scene, a step at a time, the sonar's readings when they come.

    Returns:
        error (t, R, 15) of attitude, velocity, position and biases, tangent, from estimate to truth; deviation (t, R,
        15) that the filter claims; nees (t, R) of the 15; mode, switch (t, R), -1 without modes; accepted (t, R,
        sensors) of the measurements in time, all true without a gate; ok (t, R); refiltered, number of steps that were
        run again; cpu_s (t,).
    """
    from tqdm import tqdm

    variant, filter = VARIANTS[name], make_filter(name, scene)
    runs = scene.truth.shape[1]
    law: Any = filter.model.observation
    measured = law.pack(readings(scene, variant), None, scene.truth)
    controls = None if variant.direct else scene.controls
    sonar, late_by = late_readings(scene)
    stream: DelayedMeasurements[Any] = DelayedMeasurements(filter, (late_by + 1) * scene.dt)
    state, rows = stream.init((runs,)), []
    refiltered = 0
    for k in tqdm(range(len(measured)), unit="step", disable=None if progress else True):
        begin = time.process_time()
        with torch.no_grad():
            u = None if controls is None else controls[k]
            state, info = stream.step(state, measured[k], u, scene.dt, throw=False)
            report = info.steps[-1]
            if variant.delay and k >= late_by and not bool(torch.isnan(sonar[k]).all()):
                state, again = stream.late(state, {"ultrasonic": sonar[k]}, (k + 1 - late_by) * scene.dt, throw=False)
                refiltered += len(again.steps)
            seconds = time.process_time() - begin
            row = compare(trusted(state.belief), scene.truth[k])
            rows.append((*row, *_decisions(state.belief, report, len(law.names)), torch.tensor(seconds)))
    names = ("error", "deviation", "nees", "mode", "switch", "accepted", "ok", "cpu_s")
    found = {name: torch.stack(column).numpy() for name, column in zip(names, zip(*rows, strict=True), strict=True)}
    return found | {"refiltered": np.array(refiltered)}


def compare(belief: Any, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Error (R, 15) from estimate to truth, claimed deviation (R, 15) and NEES (R,) of the numbers all forms share."""
    assert isinstance(belief, Gaussian)
    error = LANDING_SPACE.local(belief.mean[..., :16], truth[..., :16])
    factor = belief.scale_tril[..., :_SHARED, :]
    covariance = factor @ factor.mT
    root, failed = torch.linalg.cholesky_ex(covariance)
    z = torch.linalg.solve_triangular(root, error.unsqueeze(-1), upper=False).squeeze(-1)
    nees = torch.where(failed > 0, torch.nan, z.square().sum(-1))
    return error, covariance.diagonal(dim1=-2, dim2=-1).sqrt(), nees


def _decisions(belief: Any, info: StepInfo, sensors: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mode after the step, switch in it, what the gate took in, status."""
    none = torch.full_like(info.ok, -1, dtype=torch.long)
    accepted = torch.ones(*info.ok.shape, sensors, dtype=torch.bool) if info.accepted is None else info.accepted
    if not isinstance(belief, Moded):
        return none, none, accepted, info.ok
    assert info.switch is not None
    return belief.mode, info.switch, accepted, info.ok


# Numbers --------------------------------------------------------------------------------------------------------------


def summarize(result: Arrays, scene: Scene, name: str) -> dict[str, Any]:
    """Numbers of one filter.

    Returns:
        By phase of the mission: rms over runs and time of each group of `GROUPS`; heading_z, rms of the heading's error
        over its claimed deviation; nees, its mean per degree of freedom over runs and time. landing_height_m: rms of
        the height over the last second. aligned_s: median time from which the heading stays within 5 deg while the ship
        is moored. switches: by reason, in how many runs.
        refused: by sensor that is given in time, share of its readings. failed: runs with any failed step. refiltered;
        ms_per_step: CPU, all runs.
    """
    error, phase = result["error"], scene.phase.numpy()
    summary: dict[str, Any] = {}
    for number, title in enumerate(PHASES):
        rows = np.flatnonzero(phase == number)[round(SETTLE_S / scene.dt) :]
        if len(rows) == 0:
            continue
        part = {key: _rms(error[rows][..., at]) * unit for key, (at, unit) in GROUPS.items()}
        heading_z = _rms(error[rows][..., 2:3] / result["deviation"][rows][..., 2:3])
        summary[title] = part | {"heading_z": heading_z, "nees": float(np.nanmean(result["nees"][rows]) / _SHARED)}
    summary["landing_height_m"] = _rms(error[-round(1 / scene.dt) :, :, 8:9])
    summary["aligned_s"] = _aligned(error, phase, scene.dt)
    filter = make_filter(name, scene)
    ways = filter.switches if isinstance(filter, NavigationModes) else ()
    summary["switches"] = {way.reason: int((result["switch"] == k).any(0).sum()) for k, way in enumerate(ways)}
    law: Any = filter.model.observation
    given = {sensor: (~torch.isnan(y)).any(-1).sum().item() for sensor, y in readings(scene, VARIANTS[name]).items()}
    summary["refused"] = {
        sensor: float((~result["accepted"][..., k]).sum() / given[sensor])
        for k, sensor in enumerate(law.names)
        if sensor != "mast" and given.get(sensor)
    }
    summary["failed"] = int((~result["ok"]).any(0).sum())
    summary["refiltered"] = int(result["refiltered"])
    summary["ms_per_step"] = 1e3 * float(np.median(result["cpu_s"]))
    return summary


def _rms(error: np.ndarray) -> float:
    """Root of the mean square length over all axes but the last."""
    return float(np.sqrt((error**2).sum(-1).mean()))


def _aligned(error: np.ndarray, phase: np.ndarray, dt: float) -> float | None:
    """Median time after which the heading stays within 5 deg at the mast; None where half of the runs never do."""
    away = np.degrees(np.abs(error[phase == 0][..., 2])) > 5
    if len(away) == 0:
        return None
    after = np.where(away.any(0), len(away) - np.argmax(away[::-1], 0), 0).astype(float)
    after[after >= len(away)] = np.inf
    middle = float(np.median(after)) * dt
    return middle if np.isfinite(middle) else None


def log_lines(result: Arrays, scene: Scene, name: str, runs: int = 3) -> list[str]:
    """The mode log of the first runs, a switch a line: run, time, from where to where, why."""
    filter = make_filter(name, scene)
    if not isinstance(filter, NavigationModes):
        return []
    lines = []
    for run in range(min(runs, result["switch"].shape[1])):
        for k in np.flatnonzero(result["switch"][:, run] >= 0):
            way = filter.switches[int(result["switch"][k, run])]
            lines.append(f"run {run}, {(k + 1) * scene.dt:6.2f} s: {way.source} -> {way.target}: {way.reason}")
    return lines


# The study ------------------------------------------------------------------------------------------------------------


def run_airship(
    settings: AirshipSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `AirshipSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default `DEFAULT`. say: told what happens, a line each.
        progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), settings, versions.

    Raises:
        ValueError: unknown filter.
    """
    names = DEFAULT if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    say(f"{settings.runs} missions of {settings.steps / FILTER_RATE_HZ:g} s: {', '.join(PHASES)}")
    scene = make_scene(settings)

    def draw(results: dict[str, Arrays], folder: Path) -> list[Path]:
        from torchfilt.missions.airship.figures import airship_figures

        return airship_figures(results, scene, folder)

    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **settings.to_dict()},
        follow=lambda name: run_filter(name, scene, progress),
        summarize=lambda name, result: summarize(result, scene, name),
        table=table,
        notes=lambda results: ["", *log_lines(results[names[0]], scene, names[0])],
        draw=draw if figures else None,
        say=say,
    )


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of tables, one a phase, a filter a row."""
    head = ("tilt, deg", "heading, deg", "velocity, m/s", "horizontal, m", "height, m", "heading z", "NEES/dof")
    lines = [
        "",
        f"rms over runs and time, the first {SETTLE_S:g} s of each phase left out; ms: CPU of a step of all runs",
    ]
    for title in PHASES:
        rows = {name: entry[title] for name, entry in summary["filters"].items() if title in entry}
        if rows:
            lines += ["", f"{title:22s} " + " ".join(f"{part:>14s}" for part in head)]
        for name, entry in rows.items():
            cells = [f"{entry[key]:.3g}" for key in (*GROUPS, "heading_z", "nees")]
            lines.append(f"{name:22s} " + " ".join(f"{cell:>14s}" for cell in cells))
    more = ("landing, m", "aligned, s", "refiltered", "failed", "ms")
    lines += ["", f"{'':22s} " + " ".join(f"{part:>14s}" for part in more)]
    for name, entry in summary["filters"].items():
        aligned = "-" if entry["aligned_s"] is None else f"{entry['aligned_s']:.3g}"
        cells = [f"{entry['landing_height_m']:.3g}", aligned, str(entry["refiltered"]), str(entry["failed"])]
        lines.append(f"{name:22s} " + " ".join(f"{cell:>14s}" for cell in (*cells, f"{entry['ms_per_step']:.1f}")))
    return lines
