"""Figures of the landing study: paths before and after the beacon is seen, errors and convergence against time."""

from pathlib import Path

import numpy as np

from torchfilt.learning.figures import save_figure
from torchfilt.missions.figures import new_figure
from torchfilt.missions.landing.scene import Scene
from torchfilt.missions.stages import Arrays
from torchfilt.particles import Particles

_BEFORE_S, _AFTER_S = 2.0, 11.0


def landing_figures(results: dict[str, Arrays], scene: Scene, folder: Path) -> list[Path]:
    """Draw them; returns the files."""
    drawn = [_errors(results, scene, folder / "errors.png"), _paths(results, scene, folder / "paths.png")]
    return [*drawn, _particles(scene, folder / "particles.png")]


def _since_sight(values: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Seconds since the first sight while a run is under way, and values (t, R) by that clock, NaN where one is not."""
    first, last = int(scene.acquired.max()), len(values) - int(scene.acquired.min())
    clock = np.arange(max(-round(_BEFORE_S / scene.dt), -first), min(round(_AFTER_S / scene.dt), last))
    shifted = np.full((len(clock), values.shape[1]), np.nan)
    for run, first in enumerate(scene.acquired.tolist()):
        at = clock + first
        inside = (at >= 0) & (at < len(values))
        shifted[inside, run] = values[at[inside], run]
    return clock * scene.dt, shifted


def _errors(results: dict[str, Arrays], scene: Scene, path: Path) -> Path:
    """Medians with the middle 80 %, and the share of the runs that are near; of the first ten filters."""
    figure, axes = new_figure(2, 2, (11, 7), "Errors at heading zero: median, 10 % to 90 % of the runs")
    parts = (("horizontal, m", slice(6, 8), 1.0), ("vertical, m", slice(8, 9), 1.0), ("tilt, deg", slice(0, 2), 57.3))
    for k, (name, result) in enumerate(list(results.items())[:10]):
        for axis, (title, part, unit) in zip(axes.flat, parts, strict=False):
            size = unit * np.linalg.norm(result["error"][..., part], axis=-1)
            seconds, shifted = _since_sight(size, scene)
            low, middle, high = np.nanquantile(shifted, [0.1, 0.5, 0.9], axis=1)
            axis.plot(seconds, middle, color=f"C{k}", label=name)
            axis.fill_between(seconds, low, high, color=f"C{k}", alpha=0.06, linewidth=0)
            axis.set(title=title, yscale="log")
        away = np.linalg.norm(result["error"][..., 6:9], axis=-1)
        seconds, shifted = _since_sight(np.where(np.isfinite(away), away, np.inf), scene)
        near = np.where(np.isnan(shifted), np.nan, shifted < 1.0)
        axes.flat[3].plot(seconds, np.nanmean(near, 1), color=f"C{k}")
    axes.flat[3].set(title="share of the runs within 1 m")
    for axis in axes[1]:
        axis.set_xlabel("s since the beacon was first seen")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)
    return path


def _particles(scene: Scene, path: Path) -> Path:
    """Paths of the particles of one vehicle, each line from a particle to its child."""
    from matplotlib.collections import LineCollection

    from torchfilt.filters.particle_methods import BootstrapFilter, LocallyLinearizedParticleFilter

    trackers = {
        "bootstrap, 200 particles": BootstrapFilter(scene.model, 200),
        "LLPF, 50 Gaussians": LocallyLinearizedParticleFilter(scene.model, 50),
    }
    figure, axes = new_figure(
        1,
        len(trackers),
        (11, 5.5),
        "Particles of one vehicle at heading zero: before (orange) and after (blue) it sees the beacon",
    )
    truth = scene.model.representative(scene.truth[:, 0])[..., 7:9].numpy()
    first = max(int(scene.acquired[0]), 1)
    last = min(first + round(3 / scene.dt), len(truth))
    for axis, (name, tracker) in zip(axes[0], trackers.items(), strict=True):
        history = tracker(
            scene.measurements[:last, :1], scene.controls[:last, :1], scene.dt, record="beliefs", throw=False
        )
        assert isinstance(history.beliefs, Particles) and history.diagnostics.ancestors is not None
        places = scene.model.representative(history.beliefs.x[:, 0])[..., 7:9].numpy()
        parents = history.diagnostics.ancestors[:, 0].numpy()
        shown = slice(None, None, places.shape[1] // 50)
        born = np.stack([places[k - 1][parents[k]] for k in range(1, last)])
        lines = np.stack([born, places[1:]], 2)[:, shown]
        for part, colour in ((lines[: first - 1], "C1"), (lines[first - 1 :], "C0")):
            axis.add_collection(LineCollection(list(part.reshape(-1, 2, 2)), colors=colour, linewidths=0.5, alpha=0.5))
        axis.plot(*truth[:last].T, color="0.3", linewidth=2)
        axis.plot(0, 0, "k+", markersize=12)
        axis.set(title=name, xlim=(-50, 50), ylim=(-50, 50), aspect="equal", xlabel="right, m", ylabel="forward, m")
    save_figure(figure, path)
    return path


def _paths(results: dict[str, Arrays], scene: Scene, path: Path) -> Path:
    names = list(results)[:8]
    rows = 1 + (len(names) > 4)
    figure, axes = new_figure(
        rows,
        -(-len(names) // rows),
        (12, 3.4 * rows),
        "Pad frame turned to heading zero: truth grey, estimate dotted before the beacon is seen",
    )
    truth = scene.model.representative(scene.truth)[..., 7:10].numpy()
    for axis, name in zip(axes.flat, names, strict=False):
        for run in range(min(6, truth.shape[1])):
            first = int(scene.acquired[run])
            axis.plot(*truth[:, run, :2].T, color="0.6", linewidth=2.5)
            position = results[name]["position"][:, run, :2]
            axis.plot(*position[:first].T, ":", color="C1", linewidth=0.8)
            axis.plot(*position[first:].T, color="C0", linewidth=0.8)
        axis.plot(0, 0, "k+")
        axis.set(title=name, xlim=(-40, 40), ylim=(-40, 40), aspect="equal", xlabel="right, m")
        axis.set_ylabel("forward, m")
    save_figure(figure, path)
    return path
