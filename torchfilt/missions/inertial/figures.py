"""Figures of the SINS/SAR study: errors with what the filter claims, filters beside each other, the flight."""

from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from torchfilt.learning.figures import save_figure
from torchfilt.missions.figures import COLOURS, new_figure, plot_error_band
from torchfilt.missions.inertial.scene import ARC_MINUTE, InertialSettings, Scene
from torchfilt.missions.inertial.study import GROUPS
from torchfilt.missions.stages import Arrays

_LABELS = {
    "position_m": "position, m",
    "velocity_m_s": "velocity, m/s",
    "tilt_arcmin": "tilt, arcmin",
    "heading_arcmin": "heading, arcmin",
}


def inertial_figures(results: dict[str, Arrays], scene: Scene, settings: InertialSettings, folder: Path) -> list[Path]:
    """Draw the flight, the errors of run 1 by filter, and all filters beside each other.

    Args:
        results: by filter, of `run_filter`. scene, settings: what they were made on. folder: receives PNG files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {"flight": _flight(scene), "errors": _comparison(results, settings)}
    for name, result in results.items():
        drawn[f"attitude-{name}"] = _bands(name, result, settings, ATTITUDE)
        drawn[f"motion-{name}"] = _bands(name, result, settings, MOTION)
    for name, figure in drawn.items():
        save_figure(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in drawn]


# Tangent component, unit, label; a column each.
ATTITUDE = (
    ((0, ARC_MINUTE, "about east, arcmin"), (1, ARC_MINUTE, "about north, arcmin"), (2, ARC_MINUTE, "heading, arcmin")),
)
MOTION = (
    ((3, 1.0, "east, m/s"), (4, 1.0, "north, m/s"), (5, 1.0, "up, m/s")),
    ((6, 1.0, "east, m"), (7, 1.0, "north, m"), (8, 1.0, "up, m")),
)


def _bands(name: str, result: Arrays, settings: InertialSettings, columns: Any) -> Any:
    time = np.arange(1, len(result["error"]) + 1.0)
    title = f"{name}: error of run 1 and claimed ±3 sigma ({settings.scenario})"
    figure, axes = new_figure(3, len(columns), (5.2 * len(columns) + 2.4, 7), title, sharex=True)
    late = time > min(100, 0.2 * len(time))
    for column, parts in enumerate(columns):
        for row, (index, unit, label) in enumerate(parts):
            error, deviation = result["error"][:, 0, index] / unit, result["deviation"][:, 0, index] / unit
            reach = np.concatenate([np.abs(error[late]), 3 * deviation[late]])
            reach = reach[np.isfinite(reach)]
            limit = 1.3 * float(reach.max()) if len(reach) else None
            plot_error_band(time, error, deviation, label, axes[row, column], limit=limit)
        axes[-1, column].set_xlabel("time, s")
    axes[0, 0].legend(fontsize=8, loc="upper right")
    return figure


def _comparison(results: dict[str, Arrays], settings: InertialSettings) -> Any:
    runs = next(iter(results.values()))["error"].shape[1]
    title = f"Root mean square error of {runs} runs ({settings.scenario})"
    figure, axes = new_figure(2, 2, (11, 7), title, sharex=True)
    for ax, (group, label) in zip(axes.flat, _LABELS.items(), strict=True):
        index, unit = GROUPS[group]
        for k, (colour, (name, result)) in enumerate(zip(cycle(COLOURS), results.items(), strict=False)):
            rms = np.sqrt(np.mean(np.sum((result["error"][..., list(index)] / unit) ** 2, -1), 1))
            style = "-" if k < len(COLOURS) else "--"
            ax.semilogy(np.arange(1, len(rms) + 1), rms, style, lw=1.1, color=colour, label=name)
        ax.set_ylabel(label)
        ax.grid(alpha=0.25, lw=0.5)
    for ax in axes[-1]:
        ax.set_xlabel("time, s")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _flight(scene: Scene) -> Any:
    """True path, and how far the unaided system goes astray."""
    flight, away = scene.flight, scene.truth[..., 7:10].norm(dim=-1).numpy()
    figure, axes = new_figure(1, 3, (12, 3.6), "The flight, and the inertial system without fixes")
    path, height, drift = axes[0]
    path.plot(np.degrees(flight.longitude.numpy()), np.degrees(flight.latitude.numpy()), color=COLOURS[0])
    path.set_xlabel("longitude, deg")
    path.set_ylabel("latitude, deg")
    time = np.arange(1, len(away) + 1)
    height.plot(time, flight.height.numpy(), color=COLOURS[0])
    height.set_ylabel("height, m")
    drift.semilogy(time, away, lw=0.8, color=COLOURS[1])
    drift.set_ylabel("position error without fixes, m")
    for ax in (height, drift):
        ax.set_xlabel("time, s")
    for ax in axes.flat:
        ax.grid(alpha=0.25, lw=0.5)
    return figure
