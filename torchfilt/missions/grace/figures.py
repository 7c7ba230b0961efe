"""Figures of the GRACE run; matplotlib loads when called, and no global figure state exists."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilt.learning.figures import new_axes, save_figure
from torchfilt.missions.grace.prediction import Growth
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.grace.tracking import Case, Tracked

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {"nominal-ukf": "C1", "gp-ukf": "C0", "mf-upf": "C2"}
_LABELS = {
    "position": ("radial, m", "along track, m", "across, m"),
    "velocity": ("radial, m/s", "along track, m/s", "across, m/s"),
}


def draw(
    folder: str | Path,
    settings: GraceSettings,
    growth: dict[str, Growth],
    cases: dict[str, tuple[Case, dict[str, Tracked]]],
    recorded_bias_m: float,
) -> list[Path]:
    """Write all figures; returns their paths."""
    folder = Path(folder)
    paths = [_prediction(folder / "prediction.png", growth)]
    for name, (case, found) in cases.items():
        for quantity in ("position", "velocity"):
            paths.append(_errors(folder / f"{quantity}_{name}.png", quantity, settings, case, found))
    case, found = cases["kband"]
    paths.append(_bias(folder / "bias.png", settings, found, recorded_bias_m))
    if case.outages:
        paths.append(_outages(folder / "outages.png", settings, case, found))
    return paths


def _prediction(path: Path, growth: dict[str, Growth]) -> Path:
    figure, axes = new_axes(1, "prediction of the relative position in the held-out hours")
    ax: Axes = axes[0]
    for name, (minutes, error) in growth.items():
        ax.loglog(minutes.numpy(), error.numpy(), "-" if name.endswith("gp") else "--", label=name)
    ax.set_xlabel("time without measurements, min")
    ax.set_ylabel("median position error, m")
    ax.legend()
    save_figure(figure, path)
    return path


def _hours(settings: GraceSettings) -> Any:
    return settings.training_hours + np.arange(1, settings.tracking_steps + 1) * settings.step_s / 3600


def _errors(path: Path, quantity: str, settings: GraceSettings, case: Case, found: dict[str, Tracked]) -> Path:
    """Errors of the first run with the learned filter's three-sigma band."""
    title = {"kband": "K-band range and angles", "radar": "simulated range and angles"}[case.name]
    figure, axes = new_axes(3, f"{quantity} error: {title}")
    hours, shift = _hours(settings), 0 if quantity == "position" else 3
    for k, ax in enumerate(axes):
        column = shift + k
        deviation = _deviation(found["gp-ukf"], column)
        ax.fill_between(hours, -3 * deviation, 3 * deviation, color="0.85", lw=0, label="gp-ukf, 3 sigma")
        settled = deviation[settings.settle_steps :]
        limit = 0.0
        for name, own in found.items():
            error = (own.mean[:, 0, column] - case.truth[:, column]).numpy()
            ax.plot(hours, error, color=_COLOURS[name], lw=1, label=name)
            limit = max(limit, float(np.abs(error[settings.settle_steps :]).max()))
        limit = 1.2 * max(limit, 3 * float(settled.max()))
        ax.set_ylim(-limit, limit)
        ax.set_ylabel(_LABELS[quantity][k])
    axes[0].legend(ncols=4, fontsize="small")
    axes[-1].set_xlabel("hour of the day")
    save_figure(figure, path)
    return path


def _deviation(tracked: Tracked, column: int) -> Any:
    return tracked.covariance[:, 0, column, column].sqrt().numpy()


def _bias(path: Path, settings: GraceSettings, found: dict[str, Tracked], recorded_bias_m: float) -> Path:
    figure, axes = new_axes(1, "bias of the K-band range")
    hours, ax = _hours(settings), axes[0]
    deviation = _deviation(found["gp-ukf"], 6)
    middle = found["gp-ukf"].mean[:, 0, 6].numpy()
    ax.fill_between(hours, middle - 3 * deviation, middle + 3 * deviation, color="0.85", lw=0, label="gp-ukf, 3 sigma")
    for name, own in found.items():
        ax.plot(hours, own.mean[:, 0, 6].numpy(), color=_COLOURS[name], lw=1, label=name)
    ax.axhline(recorded_bias_m, color="k", ls=":", label="range minus precise orbits, mean")
    ax.set_xlabel("hour of the day")
    ax.set_ylabel("m")
    ax.legend(fontsize="small")
    save_figure(figure, path)
    return path


def _outages(path: Path, settings: GraceSettings, case: Case, found: dict[str, Tracked]) -> Path:
    figure, axes = new_axes(2, f"{settings.outage_minutes:g} minutes without any measurement")
    hours = _hours(settings)
    parts = (slice(0, 2), slice(0, 3))
    for ax, part, label in zip(axes, parts, ("radial and along, m", "position, m"), strict=True):
        for rows in case.outages:
            ax.axvspan(hours[rows.start - 1], hours[rows.stop - 1], color="0.9", lw=0)
        for name, own in found.items():
            error = own.mean[:, case.runs :, :6] - case.truth.unsqueeze(1)
            rms = error[..., part].square().sum(-1).mean(1).sqrt().numpy()
            ax.semilogy(hours, rms, color=_COLOURS[name], lw=1, label=name)
        ax.set_ylabel(f"rms error, {label}")
    axes[0].legend(fontsize="small")
    axes[-1].set_xlabel("hour of the day")
    save_figure(figure, path)
    return path
