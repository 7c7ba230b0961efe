"""Figures of the airship study: the path of a mission, errors with what is claimed, and the time line of the modes."""

from pathlib import Path
from typing import Any

import numpy as np

from torchfilt.learning.figures import save_figure
from torchfilt.missions.airship.navigation import MODES
from torchfilt.missions.airship.scene import BEACONS_M, HALL_M, LANDING_M, MAST_M, WAYPOINTS_M, Scene
from torchfilt.missions.figures import COLOURS, new_figure
from torchfilt.missions.stages import Arrays

_MODE_COLOURS = (COLOURS[2], COLOURS[0], COLOURS[1])


def airship_figures(results: dict[str, Arrays], scene: Scene, folder: Path) -> list[Path]:
    """Draw the study's figures into a folder, as PNG files; needs matplotlib.

    The first filter is the one that is shown alone, of the first run.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    first = next(iter(results.values()))
    drawn = [_mission(first, scene, folder / "mission.png"), _errors(first, scene, folder / "errors.png")]
    drawn.append(_modes(first, scene, folder / "modes.png"))
    if len(results) > 1:
        drawn.append(_compare(results, scene, folder / "compare.png"))
    return drawn


def _mission(result: Arrays, scene: Scene, path: Path) -> Path:
    """Truth and estimate from above, and the height along time, coloured by mode."""
    figure, axes = new_figure(2, 1, (10, 8), height_ratios=(1.6, 1))
    above, side = axes[:, 0]
    truth, time = scene.truth[:, 0, 7:10].numpy(), scene.time.numpy()
    estimate = truth - result["error"][:, 0, 6:9]
    above.plot(*truth[:, :2].T, color="0.7", linewidth=4, label="truth")
    side.plot(time, truth[:, 2], color="0.7", linewidth=4)
    titles, colours = (*MODES, "without modes"), (*_MODE_COLOURS, COLOURS[3])  # -1: none
    for k in np.unique(result["mode"][:, 0]):
        within = np.where((result["mode"][:, 0] == k)[:, None], estimate, np.nan)
        above.plot(*within[:, :2].T, color=colours[k], linewidth=1.2, label=titles[k])
        side.plot(time, within[:, 2], color=colours[k], linewidth=1.2)
    above.plot(*np.array(BEACONS_M)[:, :2].T, "k^", label="beacons")
    above.plot(*np.array(WAYPOINTS_M)[:, :2].T, "x", color="0.4", label="waypoints")
    above.plot(*MAST_M[:2], "ks", label="mast")
    above.plot(*LANDING_M, "k*", markersize=12, label="landing spot")
    above.set(xlim=(0, HALL_M[0]), ylim=(0, HALL_M[1]), aspect="equal", xlabel="east, m", ylabel="north, m")
    figure.legend(*above.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    side.set(xlabel="time, s", ylabel="height of the gondola, m")
    figure.suptitle("A mission: from the mast along waypoints to the landing spot")
    save_figure(figure, path)
    return path


def _errors(result: Arrays, scene: Scene, path: Path) -> Path:
    """Errors of one run with three claimed deviations to either side."""
    parts = [
        ("tilt about east, deg", 0, 57.296),
        ("tilt about north, deg", 1, 57.296),
        ("heading, deg", 2, 57.296),
        ("velocity east, m/s", 3, 1.0),
        ("velocity north, m/s", 4, 1.0),
        ("velocity up, m/s", 5, 1.0),
        ("east, m", 6, 1.0),
        ("north, m", 7, 1.0),
        ("height, m", 8, 1.0),
        ("gyro bias up, mrad/s", 11, 1e3),
        ("accelerometer bias ahead, mm/s2", 13, 1e3),
        ("accelerometer bias up, mm/s2", 14, 1e3),
    ]
    figure, axes = new_figure(4, 3, (13, 10), sharex=True)
    time = scene.time.numpy()
    for axis, (title, k, unit) in zip(axes.flat, parts, strict=True):
        claim = 3 * unit * result["deviation"][:, 0, k]
        axis.fill_between(time, -claim, claim, color="0.85", linewidth=0)
        axis.plot(time, unit * result["error"][:, 0, k], color=COLOURS[0], linewidth=0.7)
        widest = np.quantile(claim, 0.9)
        axis.set(title=title, ylim=(-1.5 * widest, 1.5 * widest))
        _shade(axis, result["mode"][:, 0], time)
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    figure.suptitle("Errors of one run, three claimed standard deviations grey; dotted lines: a new mode")
    save_figure(figure, path)
    return path


def _shade(axis: Any, mode: np.ndarray, time: np.ndarray) -> None:
    """Where the mode changes."""
    for k in np.flatnonzero(np.diff(mode)):
        axis.axvline(time[k + 1], color="0.3", linestyle=":", linewidth=0.8)


def _modes(result: Arrays, scene: Scene, path: Path) -> Path:
    """The modes of each run along time, and what the sonar and the claimed height say meanwhile."""
    from matplotlib.colors import ListedColormap

    figure, axes = new_figure(3, 1, (10, 7), sharex=True, height_ratios=(1.2, 1, 1))
    lines, sonar, claim = axes[:, 0]
    time = scene.time.numpy()
    edges = np.append(0, time)
    mode = np.maximum(result["mode"], -1).T
    shown = ListedColormap(["0.8", *_MODE_COLOURS])
    lines.pcolormesh(edges, np.arange(len(mode) + 1), mode, cmap=shown, vmin=-1.5, vmax=2.5)
    lines.set(ylabel="run")
    lines.yaxis.get_major_locator().set_params(integer=True)
    for k, name in enumerate(MODES):
        lines.plot([], [], "s", color=_MODE_COLOURS[k], label=name)
    lines.legend(loc="upper left", ncols=3, fontsize=8)
    heard = scene.measurements["ultrasonic"][:, 0, 0].numpy()
    sonar.plot(time, heard, ".", markersize=2, color="0.4")
    sonar.plot(time, scene.truth[:, 0, 9], color=COLOURS[1], linewidth=0.8)
    sonar.set(ylabel="sonar (dots) and\nheight of run 0, m")
    claim.semilogy(time, result["deviation"][:, 0, 8], label="height, m")
    claim.semilogy(time, result["deviation"][:, 0, 2], label="heading, rad")
    claim.set(ylabel="claimed deviation", xlabel="time, s")
    claim.legend(fontsize=8)
    figure.suptitle("Modes of navigation")
    save_figure(figure, path)
    return path


def _compare(results: dict[str, Arrays], scene: Scene, path: Path) -> Path:
    """Rms over the runs, along time, of all filters."""
    figure, axes = new_figure(2, 2, (12, 7), sharex=True)
    parts = (
        ("heading, deg", slice(2, 3), 57.296),
        ("velocity, m/s", slice(3, 6), 1.0),
        ("horizontal, m", slice(6, 8), 1.0),
        ("height, m", slice(8, 9), 1.0),
    )
    time = scene.time.numpy()
    every = max(round(1 / scene.dt), 1)
    count = len(time) // every * every
    for axis, (title, at, unit) in zip(axes.flat, parts, strict=True):
        for k, (name, result) in enumerate(results.items()):
            square = (result["error"][:count, :, at] ** 2).sum(-1).mean(1)
            smooth = unit * np.sqrt(square.reshape(-1, every).mean(1))
            axis.semilogy(time[every - 1 : count : every], smooth, color=COLOURS[k], linewidth=0.9, label=name)
        axis.set(title=title)
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.suptitle("Rms error of all runs, a second at a time")
    save_figure(figure, path)
    return path
