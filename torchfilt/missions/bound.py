"""Posterior Cramér-Rao bound: what no filter can beat on given true states."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import triangularize
from torchfilt.moments import lift


def cramer_rao_bound(
    transition: Callable[..., Gaussian],
    observation: Callable[..., Gaussian],
    prior_scale_tril: Tensor,
    states: Tensor,
    controls: Tensor | None,
    dt: float,
) -> Tensor:
    """Least covariance of an estimate after each measurement, the motion being known.

    The recursion is the Kalman filter's, linearised about the true states; for a law without process noise it is the
    inverse of the information that the prior and all measurements so far hold.

    Args:
        transition: the true motion, called as law(x, u, dt), Gaussian on Euclidean axes.
        observation: the true measurement law.
        prior_scale_tril: (d, d) factor of the prior covariance.
        states: true states (t + 1, d), the first at the time of the prior.
        controls: (t, k) or None.
        dt: step, s.

    Returns:
        (t, d, d).

    Source: Tichavsky, Muravchik, Nehorai, Posterior Cramér-Rao bounds for discrete-time nonlinear filtering, IEEE TSP
    46 (1998), recursion 21 with the expectations taken at the given states.
    """
    before, after = states[:-1], states[1:]
    motion, law = transition(before, controls, dt), observation(after)
    jacobian, slope = _jacobian(transition, motion, before, controls, dt), _jacobian(observation, law, after)
    count = len(after)
    noise = motion.factor().expand(count, *motion.factor().shape[-2:])
    own = law.factor().expand(count, *law.factor().shape[-2:])
    size = own.shape[-1]
    factor, result = prior_scale_tril, []
    empty = torch.zeros(len(factor), size, dtype=factor.dtype)
    for k in range(count):
        predicted = triangularize(torch.cat([jacobian[k] @ factor, noise[k]], -1))
        # One triangularisation of [[R, H S], [0, S]]: its last block is the factor after the measurement.
        top = torch.cat([own[k], slope[k] @ predicted], -1)
        factor = triangularize(torch.cat([top, torch.cat([empty, predicted], -1)]))[size:, size:]
        result.append(factor @ factor.mT)
    return torch.stack(result)


def _jacobian(law: Callable[..., Gaussian], at_x: Gaussian, x: Tensor, *arguments: Tensor | float | None) -> Tensor:
    """Derivative (t, e, d) of a law's mean, as an error on its space, by one forward-mode sweep over all times."""
    lifted = [lift(value) for value in arguments]
    directions = torch.eye(x.shape[-1], dtype=x.dtype).expand(len(x), -1, -1).contiguous()

    def response(error: Tensor) -> Tensor:
        result = law(x.unsqueeze(-2) + error, *lifted)
        return at_x.space.local(at_x.mean.unsqueeze(-2), result.mean)

    columns: Tensor = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1]
    return columns.mT
