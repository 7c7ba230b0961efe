"""Figures of navigation on real logs: the track with its gaps, growth of errors, attitude, consistency."""

from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfilt.learning.figures import save_figure
from torchfilt.missions.figures import COLOURS, TRUTH, new_figure, plot_error_band
from torchfilt.missions.inertial.log_scene import LOGS, TUNING, LogSettings
from torchfilt.missions.stages import Arrays
from torchfilt.models.attitude import to_euler
from torchfilt.spaces import wrap_angle

Array = np.ndarray
# Gaps drawn on the track, and fixes that a running mean of the NIS looks at.
_SHOWN, _WINDOW = 6, 25


def log_figures(results: dict[str, Arrays], settings: LogSettings, folder: Path) -> list[Path]:
    """Draw everything about one log.

    Args:
        results: by variant, of `run_variant`. settings: of the run. folder: receives PNG files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with_gaps = {name: result for name, result in results.items() if len(result["gap_before"])}
    with_nis = {name: result for name, result in results.items() if "nis" in result}
    drawn = {"attitude": _attitude(results, settings)}
    if with_gaps:
        drawn["gaps"] = _growth(with_gaps, settings)
        drawn["track"] = _track(with_gaps, settings)
    if with_nis:
        drawn["consistency"] = _consistency(with_nis, settings)
    for name, figure in drawn.items():
        save_figure(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in drawn]


def growth(result: Arrays, gap: int) -> tuple[Array, Array, Array]:
    """Time since the last fix, horizontal error and its claimed rms, each (k,), along one gap."""
    rows = slice(result["gap_before"][gap], result["gap_last"][-1, gap] + 1)
    elapsed = result["time_s"][rows] - result["time_s"][rows][0]
    error = np.sqrt((result["gap_error_m"][rows, gap, :2] ** 2).sum(-1))
    claimed = np.sqrt(np.trace(result["gap_covariance_m2"][rows, gap, :2, :2], axis1=-2, axis2=-1))
    return elapsed[1:], error[1:], claimed[1:]


def _growth(results: dict[str, Arrays], settings: LogSettings) -> Any:
    """Median and quartiles over the gaps, a panel a variant, with what the covariance claims."""
    title = f"Horizontal error without fixes, all gaps ({settings.log})"
    figure, axes = new_figure(1, len(results), (3.4 * len(results) + 1, 4.2), title, sharex=True, sharey=True)
    for ax, colour, (name, result) in zip(axes[0], cycle(COLOURS), results.items(), strict=False):
        curves = [growth(result, gap) for gap in range(len(result["gap_before"]))]
        length = min(len(time) for time, _, _ in curves)
        time, error, claimed = (np.stack([part[:length] for part in parts]) for parts in zip(*curves, strict=True))
        elapsed = np.median(time, 0)
        low, middle, high = np.quantile(error, [0.25, 0.5, 0.75], axis=0)
        ax.fill_between(elapsed, low, high, color=colour, alpha=0.25, lw=0, label="quartiles")
        ax.semilogy(elapsed, middle, color=colour, label="median")
        ax.semilogy(elapsed, np.sqrt((error**2).mean(0)), "-.", color=colour, lw=1, label="rms")
        ax.semilogy(elapsed, error.max(0), color=colour, lw=0.6, label="largest")
        ax.semilogy(elapsed, np.sqrt((claimed**2).mean(0)), "--", color="0.25", lw=1.2, label="rms claimed")
        ax.set_title(name, fontsize=10)
        ax.set_xlabel("time without fixes, s")
        ax.grid(alpha=0.25, lw=0.5, which="both")
        ax.legend(fontsize=7)
    axes[0, 0].set_ylabel("error against the withheld fix, m")
    return figure


def _track(results: dict[str, Arrays], settings: LogSettings) -> Any:
    """Fixes, and what came out of some gaps, of each variant."""
    title = f"Track, and {settings.gaps_s[-1]:g} s without fixes from some starts ({settings.log})"
    columns = min(2, len(results))
    rows = -(-len(results) // columns)
    figure, axes = new_figure(rows, columns, (5.4 * columns, 5 * rows), title)
    for ax in axes.flat[len(results) :]:
        ax.set_visible(False)
    for ax, (name, result) in zip(axes.flat, results.items(), strict=False):
        fixes = result["position_m"]
        ax.plot(*fixes[:, :2].T, color=TRUTH, lw=2.5, alpha=0.5, label="fixes")
        count = len(result["gap_before"])
        for colour, gap in zip(cycle(COLOURS), range(0, count, -(-count // _SHOWN)), strict=False):
            inside = slice(result["gap_before"][gap] + 1, result["gap_last"][-1, gap] + 1)
            path = fixes[inside, :2] + result["gap_error_m"][inside, gap, :2]
            ax.plot(*path.T, lw=1.1, color=colour)
            ax.plot(*path[-1], "o", ms=4, color=colour)
            ax.plot(*np.stack([path[-1], fixes[inside][-1, :2]]).T, ":", lw=1, color=colour)
        ax.set_title(name, fontsize=10)
        ax.set_xlabel("east, m")
        ax.set_ylabel("north, m")
        ax.set_aspect("equal")
        ax.grid(alpha=0.25, lw=0.5)
    axes[0, 0].legend(fontsize=8)
    return figure


def _attitude(results: dict[str, Arrays], settings: LogSettings) -> Any:
    """Difference to the log's reference over time; the band belongs to the first variant."""
    figure, axes = new_figure(3, 1, (10, 7), f"Attitude minus the log's own solution ({settings.log})", sharex=True)
    tuning = TUNING[settings.log]
    for k, (ax, angle) in enumerate(zip(axes[:, 0], ("heading", "pitch", "roll"), strict=True)):
        reach = []
        for number, (colour, (name, result)) in enumerate(zip(cycle(COLOURS), results.items(), strict=False)):
            own = torch.stack(to_euler(torch.from_numpy(result["mean"][:, :4])), -1)
            off = torch.rad2deg(wrap_angle(own - torch.from_numpy(result["attitude_rad"])))[:, k].numpy()
            time, settled = result["time_s"], result["time_s"] > tuning.score_from_s
            if number == 0:
                plot_error_band(time, off, np.degrees(result["angle_sd_rad"][:, k]), "", ax, colour)
                ax.lines[0].set_label(name)
            else:
                ax.plot(time, off, lw=0.7, color=colour, label=name)
            reach.append(np.nanmax(np.abs(off[settled])))
        ax.set_ylabel(f"{angle}, deg")
        ax.set_ylim(-1.3 * max(reach), 1.3 * max(reach))
        ax.axvline(tuning.tuned_to_s, color="0.5", lw=0.8, ls=":")
    axes[-1, 0].set_xlabel("time, s (dotted: end of the part that was tuned on)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _consistency(results: dict[str, Arrays], settings: LogSettings) -> Any:
    """Running mean of the NIS of each part of the fixes, a degree of freedom; one is right."""
    parts = [key for key in max(results.values(), key=len) if key.startswith("nis_")]
    title = f"NIS a degree of freedom, mean over {_WINDOW} fixes ({settings.log}: {LOGS[settings.log].split(',')[0]})"
    figure, axes = new_figure(len(parts), 1, (10, 2 * len(parts) + 1.2), title, sharex=True)
    for ax, key in zip(axes[:, 0], parts, strict=True):
        for colour, (name, result) in zip(cycle(COLOURS), results.items(), strict=False):
            if key not in result:
                continue
            freedom = result[key.replace("nis", "freedom")]
            kernel = np.ones(_WINDOW)
            total = np.convolve(freedom, kernel, "valid")
            mean = np.convolve(result[key], kernel, "valid") / np.maximum(total, 1)
            time = np.convolve(result["time_s"], kernel / _WINDOW, "valid")
            ax.semilogy(time, np.maximum(mean, 1e-3), lw=1, color=colour, label=name)
        ax.axhline(1, color="0.4", lw=0.8)
        ax.axvline(TUNING[settings.log].tuned_to_s, color="0.5", lw=0.8, ls=":")
        ax.set_ylabel(key.removeprefix("nis_").replace("_", " "))
        ax.grid(alpha=0.25, lw=0.5, which="both")
    axes[-1, 0].set_xlabel("time, s (dotted: end of the part that was tuned on)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure
