"""The landing study as a run: convergence after the beacon is seen, errors, consistency, time; table and figures."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilt.filters.gaussian import ErrorStateKalmanFilter, GaussianFilter, UnscentedKalmanFilter
from torchfilt.filters.particle_methods import BootstrapFilter, LocallyLinearizedParticleFilter
from torchfilt.gates import Gate
from torchfilt.gaussian import Gaussian
from torchfilt.missions.landing.scene import SCENARIOS, LandingSettings, Scene, make_scene
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import run_study
from torchfilt.model import StateSpaceModel
from torchfilt.moments import taylor
from torchfilt.particles import Particles
from torchfilt.robust import Reacquire
from torchfilt.run import Filter
from torchfilt.symmetry import gauge_first_order
from torchfilt.types import trusted

# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 2
# A run has converged where it is within both, as far after the beacon was first seen.
CONVERGED_M, CONVERGED_RAD, AFTER_S = 1.0, np.radians(5.0), 10.0
_PASS, _PATIENCE_S, _REFUSED_SHARE = 0.9999, 0.5, 0.02
_BOOTSTRAP = 2000

Maker = Callable[[StateSpaceModel], Filter[Any]]


def _gate(model: StateSpaceModel) -> Gate:
    """Tests the beacon; a refused sighting weighs as one of those that may lie anywhere in the field of view."""
    beacon: Any = model.observation.law("beacon")  # type: ignore[attr-defined]
    density = float(np.log(_REFUSED_SHARE)) + beacon.outlier_log_density
    return Gate(_PASS, {"beacon": density}, ("beacon",))


def _bank(particles: int, **options: Any) -> Maker:
    return lambda model: LocallyLinearizedParticleFilter(model, particles, gate=_gate(model), **options)


def _restarted(maker: Maker) -> Maker:
    return lambda model: Reacquire(maker(model), "beacon", _PATIENCE_S)  # type: ignore[arg-type]


def _literal(model: StateSpaceModel) -> Filter[Any]:
    """As printed: drawn anew at each step, the whole covariance kept; such weights know no gate."""
    return LocallyLinearizedParticleFilter(model, 50, redraw="always", split=None, weights="joint")


_UKF: Maker = lambda model: UnscentedKalmanFilter(model, gate=_gate(model))  # noqa: E731
_MAKERS: dict[str, Maker] = {
    "ukf": _UKF,
    "ukf-restart": _restarted(_UKF),
    "mekf": lambda model: ErrorStateKalmanFilter(model, gate=_gate(model)),
    "iekf": lambda model: GaussianFilter(model, taylor(), 4, _gate(model)),
    "bootstrap": lambda model: BootstrapFilter(model, _BOOTSTRAP),
    "llpf-50": _restarted(_bank(50)),
    "llpf-200": _restarted(_bank(200)),
    "llpf-1000": _restarted(_bank(1000)),
    "llpf-50-iterated": _restarted(_bank(50, iterations=3)),
    "llpf-50-no-restart": _bank(50),
    "llpf-50-redraw": _bank(50, redraw="always", split=0.99),
    "llpf-50-keep": _bank(50, redraw="always", split=None),
    "llpf-50-literal": _literal,
}
_WORLD = ("ukf", "mekf", "bootstrap", "llpf-50", "llpf-200", "llpf-1000")
FILTERS = (*_MAKERS, *(f"{name}-no-gauge" for name in _WORLD))
DEFAULT = ("ukf", "ukf-restart", "ukf-no-gauge", "mekf", "iekf", "bootstrap", "llpf-50", "llpf-50-no-gauge", "llpf-200")


def make_filter(name: str, scene: Scene) -> Filter[Any]:
    """The filter called ``name``, one of `FILTERS`; "-no-gauge" leaves the heading in the state.

    Raises:
        ValueError: unknown name.
    """
    check_names([name], FILTERS, "filters")
    own = name.removesuffix("-no-gauge")
    return _MAKERS[own](scene.model if own == name else scene.world_model)


def run_filter(name: str, scene: Scene, seed: int, progress: bool = False) -> Arrays:
    """Filter all runs of a scene, a step at a time.

    Returns:
        error (t, R, e) from estimate to truth, both at heading zero, tangent; nees (t, R) over all components but the
        heading's; ok (t, R); restarts (R,); position (t, R, 3) estimated, at heading zero; cpu_s (t,).
    """
    from tqdm import tqdm

    tracker, runs = make_filter(name, scene), scene.truth.shape[1]
    state = tracker.init((runs,), seed)
    truth = scene.model.representative(scene.truth)
    rows: dict[str, list[Tensor]] = {}
    restarts = torch.zeros(runs)
    for k in tqdm(range(len(truth)), unit="step", disable=None if progress else True):
        begin = time.process_time()
        with torch.no_grad():
            state, info = tracker.step(state, scene.measurements[k], scene.controls[k], scene.dt, throw=False)
            seconds = time.process_time() - begin
            mean, error, nees = compare(scene, trusted(state.belief), truth[k])
            step = {
                "error": error,
                "nees": nees,
                "ok": info.ok,
                "position": mean[..., 7:10],
                "cpu_s": torch.tensor(seconds),
            }
        if info.restarted is not None:
            restarts = restarts + info.restarted
        for key, value in step.items():
            rows.setdefault(key, []).append(value)
    return {key: torch.stack(values).numpy() for key, values in rows.items()} | {"restarts": restarts.numpy()}


def compare(scene: Scene, belief: Gaussian | Particles, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean (R, d) of a belief at heading zero, error (R, e) from there to the truth, NEES (R,) without the heading.

    The covariance is turned along with the mean: a filter that keeps a heading states it in axes of its own.

    Args:
        scene: of the runs. belief: of any filter. truth: (R, d) at heading zero.

    Returns:
        Mean, error and NEES, in the state's units.
    """
    gauge = scene.model.gauge
    assert gauge is not None
    mean, turn = gauge_first_order(gauge, belief.mean, belief.space)
    error = belief.space.local(mean, truth)
    return mean, error, _nees(error, turn @ belief.covariance @ turn.mT)


def _nees(error: Tensor, covariance: Tensor) -> Tensor:
    """Squared error in units of its covariance, without the heading, which the gauge holds at zero; NaN if singular."""
    seen = [k for k in range(error.shape[-1]) if k != 2]
    part = covariance[..., seen, :][..., seen]
    factor, failed = torch.linalg.cholesky_ex(part)
    z = torch.linalg.solve_triangular(factor, error[..., seen].unsqueeze(-1), upper=False).squeeze(-1)
    return torch.where(failed > 0, torch.nan, z.square().sum(-1))


def summarize(result: Arrays, acquired: Tensor, dt: float) -> dict[str, Any]:
    """Numbers of one filter, `AFTER_S` after the beacon was first seen; at the end where a run has ended before.

    Returns:
        converged: share of the runs; seconds_to_converge: median over these of the time after which they stay so;
        horizontal_m, vertical_m, attitude_deg: [median, 90 %] over all runs, attitude without the heading; nees: mean
        per degree of freedom of the converged runs; restarts, failed: runs with any; ms_per_step: CPU, all runs.
    """
    error, runs = result["error"], np.arange(result["error"].shape[1])
    at = np.minimum(acquired.numpy() + round(AFTER_S / dt), len(error) - 1)
    size = {
        "horizontal_m": np.linalg.norm(error[..., 6:8], axis=-1),
        "vertical_m": np.abs(error[..., 8]),
        "attitude_deg": np.degrees(np.linalg.norm(error[..., :2], axis=-1)),
    }
    size = {name: np.where(np.isfinite(values), values, np.inf) for name, values in size.items()}
    near = np.hypot(size["horizontal_m"], size["vertical_m"]) < CONVERGED_M
    near &= np.radians(size["attitude_deg"]) < CONVERGED_RAD
    converged = near[at, runs]
    summary: dict[str, Any] = {"converged": float(converged.mean())}
    # Time after the last step that is not near, counted from the first sight.
    last_away = len(near) - np.argmax(~near[::-1], 0)
    last_away = np.where((~near).any(0), last_away, 0)
    waited = np.maximum(last_away - acquired.numpy(), 0) * dt
    summary["seconds_to_converge"] = _plain(np.median(waited[converged])) if converged.any() else None
    for name, values in size.items():
        summary[name] = [_plain(np.quantile(values[at, runs], q, method="inverted_cdf")) for q in (0.5, 0.9)]
    freedom = error.shape[-1] - 1
    nees = result["nees"][at, runs][converged]
    summary["nees"] = _plain(np.nanmean(nees) / freedom) if np.isfinite(nees).any() else None
    summary["restarts"] = int((result["restarts"] > 0).sum())
    summary["failed"] = int((~result["ok"]).any(0).sum())
    summary["ms_per_step"] = _plain(1e3 * np.median(result["cpu_s"]))
    return summary


def time_one_vehicle(name: str, settings: LandingSettings, steps: int = 80) -> float:
    """Median wall time of a step in ms for one vehicle, eager, with the threads that torch has, the beacon in view."""
    scene = make_scene(LandingSettings(settings.scenario, 1, settings.seed))
    tracker, first = make_filter(name, scene), max(int(scene.acquired[0]) - 10, 0)
    state, seconds = tracker.init((1,), settings.seed), []
    with torch.no_grad():
        for k in range(first, first + steps):
            begin = time.perf_counter()
            state, _ = tracker.step(state, scene.measurements[k], scene.controls[k], scene.dt, throw=False)
            seconds.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(seconds[20:]))


def run_landing(
    settings: LandingSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `LandingSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default `DEFAULT`. say: told what happens, a line each.
        progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`, with ms_one_vehicle), scenario, settings, versions.

    Raises:
        ValueError: unknown filter.
    """
    names = DEFAULT if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    say(f"{settings.scenario}: {SCENARIOS[settings.scenario]}; {settings.runs} runs of {settings.duration_s:g} s")
    scene = make_scene(settings)

    def numbers(name: str, result: Arrays) -> dict[str, Any]:
        alone = {"ms_one_vehicle": time_one_vehicle(name, settings)}
        return summarize(result, scene.acquired, scene.dt) | alone

    def draw(results: dict[str, Arrays], folder: Path) -> list[Path]:
        from torchfilt.missions.landing.figures import landing_figures

        return landing_figures(results, scene, folder)

    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **settings.to_dict()},
        follow=lambda name: run_filter(name, scene, settings.seed, progress),
        summarize=numbers,
        table=table,
        draw=draw if figures else None,
        say=say,
        more={"scenario": settings.scenario},
    )


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a table, a filter a row."""
    head = ("converged", "after, s", "horizontal, m", "vertical, m", "attitude, deg", "NEES/dof", "restarts", "failed")
    lines = [
        "",
        f"{AFTER_S:g} s after the beacon is first seen, or at the end of a shorter run; errors: median / 90 %; "
        "ms: a step of one vehicle",
        f"{'filter':18s} " + " ".join(f"{title:>15s}" for title in (*head, "ms")),
    ]
    for name, entry in summary["filters"].items():
        cells = [f"{entry['converged']:.2f}", _cell(entry["seconds_to_converge"], ".2g")]
        cells += [" / ".join(_cell(v, ".2g") for v in entry[k]) for k in ("horizontal_m", "vertical_m", "attitude_deg")]
        cells += [_cell(entry["nees"], ".3g"), str(entry["restarts"]), str(entry["failed"])]
        cells.append(f"{entry['ms_one_vehicle']:.1f}")
        lines.append(f"{name:18s} " + " ".join(f"{cell:>15s}" for cell in cells))
    return lines


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _plain(value: Any) -> float | None:
    """JSON-ready: None where there is no finite number."""
    number = float(value)
    return number if np.isfinite(number) else None
