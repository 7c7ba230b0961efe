"""How far predictions without measurements go wrong in the held-out hours."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfilt.learning.evaluate import one_step_error
from torchfilt.missions.grace.data import GraceData
from torchfilt.missions.grace.learning import Dynamics
from torchfilt.missions.grace.settings import GraceSettings

HORIZONS_MIN = (15, 94)
_BETWEEN_STARTS_S = 600.0
_GROUPS = {"position_m": slice(0, 3), "velocity_m_s": slice(3, 6)}


class Growth(NamedTuple):
    """Median position error of predictions over time: minutes (h,), error_m (h,)."""

    minutes: Tensor
    error_m: Tensor


@torch.no_grad()
def predict_from(dynamics: Dynamics, states: Tensor, starts: Tensor, steps: int, step_s: float) -> Tensor:
    """Mean roll-outs (steps, n, 6) from the log's states (s, 6) at steps ``starts`` (n,), all at once."""
    x, result = states[starts], []
    for k in range(steps):
        x = dynamics.law(x, dynamics.controls[starts + k], step_s).mean
        result.append(x)
    return torch.stack(result)


def held_out_starts(settings: GraceSettings, steps: int, ahead: int) -> Tensor:
    """Starts (n,) with ``ahead`` steps after them, 10 minutes apart, from the end of the training hours on."""
    return torch.arange(settings.training_steps, steps - ahead + 1, max(1, round(_BETWEEN_STARTS_S / settings.step_s)))


def prediction_errors(
    data: GraceData, dynamics: dict[str, Dynamics], settings: GraceSettings
) -> tuple[dict[str, Any], dict[str, Growth]]:
    """Errors of each law over the held-out hours.

    Returns:
        A JSON-ready entry for each law: ``one_step`` rms in m and m/s with z (error over predicted deviation, 1 is
        honest) and the median velocity error, ``median_m`` and ``p90_m`` of the position error at 15 and 94 minutes;
        and the growth of the median for figures.
    """
    first, count = settings.training_steps, len(data.controls)
    marks = {f"{minutes}_min": round(minutes * 60 / settings.step_s) for minutes in HORIZONS_MIN}
    longest = max(marks.values())
    starts = held_out_starts(settings, count, longest)
    truth = torch.stack([data.states[starts + k + 1] for k in range(longest)])
    minutes = torch.arange(1, longest + 1) * (settings.step_s / 60)
    entries: dict[str, Any] = {}
    growth: dict[str, Growth] = {}
    for name, own in dynamics.items():
        x, u, following = data.states[first:count], own.controls[first:], data.states[first + 1 :]
        one = one_step_error(own.law, x, u, following, settings.step_s)
        with torch.no_grad():
            velocity = (following - own.law(x, u, settings.step_s).mean)[:, 3:]
        summary: dict[str, Any] = {
            group: {key: value for key, value in values.items() if key != "z_model"}
            for group, values in one.summary(_GROUPS).items()
        }
        summary["velocity_median_m_s"] = float(torch.linalg.vector_norm(velocity, dim=-1).median())
        apart = predict_from(own, data.states, starts, longest, settings.step_s) - truth
        distance = torch.linalg.vector_norm(apart[..., :3], dim=-1)
        entries[name] = {
            "one_step": summary,
            "median_m": {mark: float(distance[k - 1].median()) for mark, k in marks.items()},
            "p90_m": {mark: float(distance[k - 1].quantile(0.9)) for mark, k in marks.items()},
            "training": own.training,
        }
        growth[name] = Growth(minutes, distance.median(1).values)
    return entries, growth


def gains(entries: dict[str, Any], nominal: str, learned: str) -> dict[str, float]:
    """Error of the nominal law over that of the learned one, quantity by quantity."""
    before, after = entries[nominal], entries[learned]
    result = {
        f"one_step_{group}": before["one_step"][group]["rms"] / after["one_step"][group]["rms"] for group in _GROUPS
    }
    key = "velocity_median_m_s"
    result[f"one_step_{key}"] = before["one_step"][key] / after["one_step"][key]
    for mark in before["median_m"]:
        result[f"median_{mark}"] = before["median_m"][mark] / after["median_m"][mark]
    return result
