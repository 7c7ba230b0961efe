"""Markov moves: particles walk on the target itself, so that copies made by resampling part again."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import apply_factor, steady_triangularize
from torchfilt.model import StateSpaceModel, as_gaussian, log_likelihood, log_prob
from torchfilt.particles import Particles
from torchfilt.types import StepInput


class Moved(NamedTuple):
    """Particles x (*batch, n, d) after the moves and the accepted share (*batch)."""

    x: Tensor
    acceptance_rate: Tensor


@dataclass(frozen=True)
class MetropolisHastings:
    """Random walk of each particle on its own target, accepted or refused; weights stay as they are.

    Args:
        steps: walks in a row.
        scale: size of a step as a share of the cloud's covariance factor; None takes 2.38 / sqrt(e), optimal for a
            Gaussian target.
        target: "transition" is p(y|x) p(x|x_{t-1}), which needs process noise of full rank: where it is singular every
            walk leaves the law's support and is refused. "predictive" is p(y|x) N(x; predicted cloud), a Gaussian fit.

    Raises:
        ValueError: steps below 1, scale not positive, unknown target.

    Sources: Gilks and Berzuini, Following a moving target, JRSS B 63 (2001); Roberts and Rosenthal, Optimal scaling for
    various Metropolis-Hastings algorithms (2001), for the scale.
    """

    steps: int = 1
    scale: float | None = None
    target: Literal["transition", "predictive"] = "transition"

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")
        if self.scale is not None and not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")
        if self.target not in ("transition", "predictive"):
            raise ValueError(f"target must be 'transition' or 'predictive', got {self.target!r}")

    def __call__(self, model: StateSpaceModel, before: Particles, particles: Particles, step: StepInput) -> Moved:
        """Walk.

        Args:
            model: the three laws.
            before: particles of the step before, in the order of their children.
            particles: weighted by the measurement, x (*batch, n, d).
            step: noise.move_normal (steps, *batch, n, e), noise.move_uniform (steps, *batch, n).
        """
        noise = step.noise
        assert noise.move_normal is not None and noise.move_uniform is not None
        space, x = particles.space, particles.x
        arrival = model.conditional("transition", before.x, step.u, step.dt)
        if self.target == "predictive":
            arrival = _predictive(as_gaussian(arrival), before.weights)
        factor = _cloud_factor(particles)
        size = self.scale if self.scale is not None else 2.38 / factor.shape[-1] ** 0.5

        def target(points: Tensor) -> Tensor:
            return log_likelihood(model, points, step) + log_prob(arrival, points, "none")

        here = target(x)
        rates = []
        for normal, uniform in zip(noise.move_normal, noise.move_uniform, strict=True):
            there = space.retract(x, size * apply_factor(factor, normal))
            level = target(there)
            # A comparison with NaN is False: what has no density is never accepted.
            accepted = uniform.log().to(level.dtype) < level - here
            x = torch.where(accepted.unsqueeze(-1), there, x)
            here = torch.where(accepted, level, here)
            rates.append(accepted.to(x.dtype).mean(-1))
        return Moved(x, torch.stack(rates).mean(0))


def _cloud_factor(particles: Particles) -> Tensor:
    """Factor (*batch, 1, e, e) of the weighted covariance; one triangularisation, so singular clouds are no trouble."""
    weights = particles.weights
    mean = particles.space.mean(particles.x, weights)
    apart = particles.space.local(mean.unsqueeze(-2), particles.x)
    return steady_triangularize((apart * weights.sqrt().unsqueeze(-1)).mT).unsqueeze(-3)


def _predictive(law: Gaussian, weights: Tensor) -> Gaussian:
    """One Gaussian (*batch, 1, ...) with the moments of the mixture of the particles' transition laws."""
    mean = law.space.mean(law.mean, weights)
    root = weights.sqrt().unsqueeze(-1)
    apart = law.space.local(mean.unsqueeze(-2), law.mean) * root
    factor = law.factor()
    if factor.dim() > 2 and factor.shape[-3] > 1:
        own = (factor * root.unsqueeze(-1)).movedim(-3, -2).flatten(-2)
    else:
        own = factor if factor.dim() == 2 else factor.squeeze(-3)
        own = own.expand(*apart.shape[:-2], -1, -1)
    return Gaussian(mean.unsqueeze(-2), steady_triangularize(torch.cat([apart.mT, own], -1)).unsqueeze(-3), law.space)
