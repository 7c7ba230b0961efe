"""Figures of the studies, drawn without pyplot: no global figure state. Matplotlib loads when called."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchfilt.learning.figures import save_figure
from torchfilt.missions.formation.scene import Scene, StudySettings
from torchfilt.missions.stages import Arrays

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = np.ndarray
# Okabe-Ito colours and a brown: told apart without red and green.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C5A2B")
TRUTH = "0.45"


def new_figure(rows: int, columns: int, size: tuple[float, float], title: str = "", **options: Any) -> tuple[Any, Any]:
    """Figure outside pyplot and its axes (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    if title:
        figure.suptitle(title)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def plot_error_band(
    time_h: Array,
    error: Array,
    deviation: Array,
    label: str,
    ax: "Axes",
    colour: str = COLOURS[0],
    limit: float | None = None,
) -> "Axes":
    """One coordinate's error with the claimed +-3 sigma band.

    Args:
        time_h: (t,). error, deviation: (t,). label: of the y axis, with its unit. limit: half-height of the axis.
    """
    ax.fill_between(time_h, -3 * deviation, 3 * deviation, color=colour, alpha=0.18, lw=0, label="±3 sigma claimed")
    ax.plot(time_h, error, lw=0.7, color=colour, label="error")
    ax.axhline(0, lw=0.5, color="0.5")
    ax.set_ylabel(label)
    ax.set_xlim(time_h[0], time_h[-1])
    if limit is not None:
        ax.set_ylim(-limit, limit)
    return ax


def plot_error_norms(
    time_h: Array, errors: dict[str, Array], label: str, ax: "Axes", bound: Array | None = None, window: int = 15
) -> "Axes":
    """Length of the error over time, one line a filter, on a logarithmic axis.

    Args:
        time_h: (t,). errors: name -> (t, R, k), drawn as the root mean square over runs and over ``window`` epochs.
        bound: (t,) root of the trace of a bound. label: of the y axis.
    """
    for k, (colour, (name, error)) in enumerate(zip(cycle(COLOURS), errors.items(), strict=False)):
        square = np.mean(np.sum(error**2, -1), 1)
        kernel = np.ones(window)
        smooth = np.convolve(square, kernel, "same") / np.convolve(np.ones_like(square), kernel, "same")
        # Filters of equal accuracy lie on each other: later ones are thinner, so that earlier ones show beside them.
        ax.semilogy(time_h, np.sqrt(smooth), lw=max(1.0, 2.2 - 0.2 * k), color=colour, label=name)
    if bound is not None:
        ax.semilogy(time_h, bound, lw=1.4, ls=(0, (2, 1.5)), color="0.35", label="Cramér-Rao bound", zorder=9)
    ax.set_ylabel(label)
    ax.set_xlim(time_h[0], time_h[-1])
    ax.grid(alpha=0.25, lw=0.5)
    return ax


def plot_path(
    truth: Array, estimates: dict[str, Array], axes: tuple[int, int], ax: "Axes", names: Sequence[str] = ("x", "y", "z")
) -> "Axes":
    """Projection of the true path (t, 3) and of estimated ones, equal scales."""
    first, second = axes
    ax.plot(truth[:, first], truth[:, second], color=TRUTH, lw=3, alpha=0.6, label="true path")
    for colour, (name, path) in zip(cycle(COLOURS), estimates.items(), strict=False):
        ax.plot(path[:, first], path[:, second], lw=0.8, color=colour, label=name)
    ax.plot(*truth[0, [first, second]], "o", ms=5, color="0.2", label="start")
    # A square window around the truth: a filter that lost its satellite must not shrink the picture to a point.
    low, high = truth.min(0), truth.max(0)
    half = 0.58 * max((high - low)[[first, second]].max(), 1.0)
    for index, limit in ((first, ax.set_xlim), (second, ax.set_ylim)):
        middle = (low[index] + high[index]) / 2
        limit(middle - half, middle + half)
    ax.set_xlabel(f"{names[first]}, m")
    ax.set_ylabel(f"{names[second]}, m")
    ax.set_aspect("equal")
    ax.grid(alpha=0.25, lw=0.5)
    return ax


def mark_revolutions(ax: "Axes", period_h: float, last_h: float) -> None:
    """Dotted lines between the revolutions."""
    for k in range(1, int(last_h / period_h + 0.01) + 1):
        ax.axvline(k * period_h, color="0.6", lw=0.8, ls=":")


def formation_figures(
    results: dict[str, Arrays], scene: Scene, settings: StudySettings, bound: Tensor, folder: str | Path
) -> list[Path]:
    """Figures of the formation study: paths, errors of all filters, errors of each filter with its band.

    Args:
        results: by filter, of `run_filter`. scene, settings: of the run. bound: (t, 6, 6). folder: where they go.

    Returns:
        Paths of the PNG files.
    """
    folder = Path(folder)
    title = f"case {settings.case}"
    written = []
    for name, figure in (
        ("path", _path_figure(results, scene, title)),
        ("errors", _comparison(results, scene, bound, title)),
        *((f"error-{name}", _bands(name, result, scene, title)) for name, result in results.items()),
    ):
        save_figure(figure, folder / f"{name}.png")
        written.append(folder / f"{name}.png")
    return written


def _hours(scene: Scene) -> tuple[Array, float]:
    return scene.time_s.numpy() / 3600, scene.formation.period_s / 3600


def _path_figure(results: dict[str, Arrays], scene: Scene, title: str) -> Any:
    """Three projections of the first run and, because errors are far below the line's width there, a closer look."""
    shown = [name for name in ("mf-upf", "cw-pf") if name in results] or list(results)[:2]
    truth = scene.truth.numpy()[:, :3]
    estimates = {name: truth + results[name]["error"][:, 0, :3] for name in shown}
    figure, axes = new_figure(2, 2, (9, 8.4), f"Deputy's path in the chief's Hill frame, run 1 ({title})")
    names = ("x (radial)", "y (along track)", "z (orbit normal)")
    for ax, pair in zip(axes.flat, ((1, 0), (1, 2), (0, 2)), strict=False):
        plot_path(truth, estimates, pair, ax, names)
    close = axes[1, 1]
    rows = slice(max(0, len(truth) // 2 - 6), len(truth) // 2 + 6)
    centre = truth[rows][len(truth[rows]) // 2]
    near = {name: path[rows] - centre for name, path in estimates.items()}
    close.plot(truth[rows, 1] - centre[1], truth[rows, 0] - centre[0], ".-", color=TRUTH, lw=2.5, alpha=0.6, ms=9)
    for colour, path in zip(cycle(COLOURS), near.values(), strict=False):
        close.plot(path[:, 1], path[:, 0], ".-", lw=0.8, ms=5, color=colour)
    span = 1.3 * np.median([np.abs(path[:, 0]).max() for path in near.values()])
    close.set_title(f"x over y, close up at {scene.time_s[rows][len(truth[rows]) // 2] / 3600:.2f} h", fontsize=10)
    close.set_xlabel("y, m from there")
    close.set_ylabel("x, m from there")
    close.set_ylim(-max(span, 0.2), max(span, 0.2))
    close.grid(alpha=0.25, lw=0.5)
    axes[0, 0].legend(fontsize=8)
    return figure


def _comparison(results: dict[str, Arrays], scene: Scene, bound: Tensor, title: str) -> Any:
    time, period = _hours(scene)
    variance = bound.diagonal(dim1=-2, dim2=-1)
    runs = next(iter(results.values()))["error"].shape[1]
    figure, axes = new_figure(2, 1, (9, 7), f"Root mean square error of {runs} runs ({title})", sharex=True)
    for ax, part, label in (
        (axes[0, 0], slice(0, 3), "position, m"),
        (axes[1, 0], slice(3, 6), "velocity, m/s"),
    ):
        errors = {name: result["error"][..., part] for name, result in results.items()}
        plot_error_norms(time, errors, label, ax, variance[:, part].sum(-1).sqrt().numpy())
        mark_revolutions(ax, period, time[-1])
    axes[1, 0].set_xlabel("time, h (dotted: a revolution)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _bands(name: str, result: Arrays, scene: Scene, title: str) -> Any:
    """Six coordinates of the first run; the scale is that of the time after the transient."""
    time, period = _hours(scene)
    figure, axes = new_figure(3, 2, (10, 7), f"{name}: error of run 1 and claimed ±3 sigma ({title})", sharex=True)
    late = time > 0.4 * min(period, time[-1])
    for k, axis in enumerate("xyz"):
        for column, unit in ((0, "m"), (1, "m/s")):
            ax, index = axes[k, column], k + 3 * column
            error, deviation = result["error"][:, 0, index], result["deviation"][:, 0, index]
            reach = np.concatenate([np.abs(error[late]), 3 * deviation[late]])
            reach = reach[np.isfinite(reach)]
            limit = 1.15 * float(reach.max()) if len(reach) else None
            label = f"{axis}, {unit}" if column == 0 else f"d{axis}/dt, {unit}"
            plot_error_band(time, error, deviation, label, ax, limit=limit)
            if column:
                ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
            mark_revolutions(ax, period, time[-1])
    axes[0, 0].legend(fontsize=8, loc="upper right")
    for ax in axes[-1]:
        ax.set_xlabel("time, h (dotted: a revolution)")
    return figure
