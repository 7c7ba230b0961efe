"""How good a learned transition is: one-step errors, their honesty, free roll-outs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian

Law = Callable[..., Gaussian]


class OneStepError(NamedTuple):
    """One-step errors of a law on pairs with known next states.

    rms (d,): root mean square of the error a coordinate. z (d,): rms of error / predicted standard deviation; 1 is
        honest,
    above 1 overconfident. predicted (d,): root mean predicted variance. z_model (d,): the same as z against the GP's
    own
    deviation, without the process-noise floor of the nominal law; NaN for laws that are not a GP.
    """

    rms: Tensor
    z: Tensor
    predicted: Tensor
    z_model: Tensor

    def summary(self, groups: dict[str, slice]) -> dict[str, dict[str, float]]:
        """Root mean square over groups of coordinates, such as position_m and velocity_m_s: 3-D norms and pooled z."""
        result = {}
        for name, part in groups.items():
            result[name] = {
                "rms": float(self.rms[part].square().sum().sqrt()),
                "predicted": float(self.predicted[part].square().sum().sqrt()),
                "z": float(self.z[part].square().mean().sqrt()),
                "z_model": float(self.z_model[part].square().mean().sqrt()),
            }
        return result


@torch.no_grad()
def one_step_error(law: Law, x: Tensor, u: Tensor | None, x_next: Tensor, dt: float) -> OneStepError:
    """Errors of ``law`` from x (S, d) with controls u (S, k) to x_next (S, d)."""
    predicted = law(x, u, dt)
    error = x_next - predicted.mean
    variance = predicted.variance.expand_as(error)
    own = _model_variance(law, x, u)
    return OneStepError(
        rms=error.square().mean(0).sqrt(),
        z=(error.square() / variance).mean(0).sqrt(),
        predicted=variance.mean(0).sqrt(),
        z_model=torch.full_like(error[0], torch.nan) if own is None else (error.square() / own).mean(0).sqrt(),
    )


def _model_variance(law: Any, x: Tensor, u: Tensor | None) -> Tensor | None:
    """The GP's own variance (..., d), floor of the nominal law left out."""
    method = getattr(law, "model_variance", None)
    return None if method is None else method(x, u)


@torch.no_grad()
def roll_out(law: Law, start: Tensor, controls: Tensor | None, dt: float, steps: int | None = None) -> Tensor:
    """Mean of the law applied to its own output, no measurements.

    Args:
        start: (..., d). controls: (t, k) one row a step, or None with ``steps``. dt: s.

    Returns:
        (t + 1, ..., d), the start first.
    """
    count = len(controls) if controls is not None else steps
    if count is None:
        raise ValueError("roll_out needs controls or a number of steps")
    states = [start]
    for i in range(count):
        states.append(law(states[-1], None if controls is None else controls[i], dt).mean)
    return torch.stack(states)


def roll_out_error(law: Law, truth: Tensor, controls: Tensor | None, dt: float, part: slice = slice(0, 3)) -> float:
    """Largest distance between a free roll-out and the truth (t + 1, d) over the coordinates of ``part``."""
    states = roll_out(law, truth[0], controls, dt, len(truth) - 1)
    return float(torch.linalg.vector_norm((states - truth)[..., part], dim=-1).max())
