"""Figures of a training run, drawn without pyplot: no global figure state. Matplotlib loads when called."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = np.ndarray


def plot_one_step(error: Array, deviation: Array, angle: Array | None, label: str, ax: "Axes") -> "Axes":
    """Errors of one output with the predicted two-sigma band, against the phase in degrees (or the sample number).

    Args:
        error: (S,). deviation: (S,) predicted standard deviations. angle: (S,) rad or None. label: name with unit.
    """
    x = np.arange(len(error)) if angle is None else np.degrees(np.mod(angle, 2 * np.pi))
    order = np.argsort(x)
    ax.fill_between(
        x[order], -2 * deviation[order], 2 * deviation[order], color="0.85", lw=0, label="predicted 2 sigma"
    )
    ax.plot(x[order], error[order], ".", ms=3, label="error")
    ax.set_xlabel("sample" if angle is None else "argument of latitude, deg")
    ax.set_ylabel(label)
    return ax


def plot_roll_out(time_s: Array, distance_m: dict[str, Array], ax: "Axes") -> "Axes":
    """Distance of free roll-outs from the truth (t,) over time, one line a law."""
    for name, values in distance_m.items():
        ax.semilogy(time_s[1:], np.maximum(values[1:], 1e-12), label=name)
    ax.set_xlabel("time, s")
    ax.set_ylabel("position error of the roll-out, m")
    ax.legend()
    return ax


def plot_loss(loss: Array, ax: "Axes") -> "Axes":
    """Negative log marginal likelihood per sample by epoch."""
    ax.plot(np.arange(1, len(loss) + 1), loss, ".-")
    ax.set_xlabel("epoch")
    ax.set_ylabel("negative log marginal likelihood a sample")
    return ax


def new_axes(rows: int = 1, title: str = "") -> tuple[Any, Any]:
    """A figure outside pyplot and its axes, one column."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 2.2 * rows + 1.4), layout="constrained")
    if title:
        figure.suptitle(title)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def save_figure(figure: Any, path: str | Path) -> None:
    """Write one PNG; the folder is made."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
