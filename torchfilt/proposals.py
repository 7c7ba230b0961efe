"""How particles reach the next step: from the motion alone, or each by its own Gaussian filter."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfilt.gates import Gate
from torchfilt.gaussian import Gaussian
from torchfilt.linalg import apply_factor, steady_triangularize
from torchfilt.model import Conditional, StateSpaceModel, as_gaussian, log_likelihood, log_prob, sample
from torchfilt.moments import Rule, check_rule_type, check_transition_space, predict, update
from torchfilt.particles import Particles, uniform_log_weights
from torchfilt.spaces import EUCLIDEAN, Space, transport, weighted_sum
from torchfilt.types import StepInput

Evidence = Literal["unbiased", "linearized", "approximate"]
Redraw = Literal["never", "resample", "always"]
Weights = Literal["marginal", "joint"]


class Proposed(NamedTuple):
    """Particles after the measurement, x (*batch, n, d), with factors or None, and what their log-weights gain.

    arrival: the transition law at the particles before; log_likelihood (*batch, n) of x. Where a proposal has made
    them, nobody needs to make them again.
    """

    x: Tensor
    scale_tril: Tensor | None
    log_weight: Tensor
    space: Space
    arrival: Conditional | None = None
    log_likelihood: Tensor | None = None
    accepted: Tensor | None = None
    gate_nis: Tensor | None = None


class Proposal(Protocol):
    """How particles reach the next step; `Prior` and `Local` ship.

    evidence: what the log-likelihood is worth. draws_at_once: the call draws. needs_redraw_noise: `refresh` draws.
    leaves_points: particles carry no covariance after a step.
    """

    @property
    def evidence(self) -> Evidence: ...

    @property
    def draws_at_once(self) -> bool: ...

    @property
    def needs_redraw_noise(self) -> bool: ...

    @property
    def leaves_points(self) -> bool: ...

    def start(self, initial: Conditional, draws: Tensor, noise: Tensor) -> Particles:
        """Particles for draws (*batch, n, d) of the initial law."""
        ...

    def refresh(self, particles: Particles, noise: Tensor | None, resampled: Tensor | None) -> Particles:
        """Share uncertainty anew between particles and their covariances, after resampling."""
        ...

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Proposed:
        """Move, measure and weight; shapes as in `Local`."""
        ...


@dataclass(frozen=True)
class Prior:
    """Particles move by the transition law; the measurement only weights them.

    Source: Gordon, Salmond, Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation (1993).
    """

    evidence: Evidence = "unbiased"
    draws_at_once: bool = True
    needs_redraw_noise: bool = False
    leaves_points: bool = True

    def start(self, initial: Conditional, draws: Tensor, noise: Tensor) -> Particles:
        """Particles for draws (*batch, n, d) of the initial law."""
        return _equal_weights(draws, None, _space_of(initial))

    def refresh(self, particles: Particles, noise: Tensor | None, resampled: Tensor | None) -> Particles:
        """Points have no uncertainty of their own to share."""
        return particles

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Proposed:
        """Shapes as in `Local`."""
        x, space, law = particles.x, particles.space, None
        if step.move:
            assert step.noise.proposal is not None
            law = model.conditional("transition", x, step.u, step.dt)
            x, space = sample(law, step.noise.proposal, step.noise.seed), _next_space(law, space)
        likelihood = log_likelihood(model, x, step)
        return Proposed(x, None, likelihood, space, law, likelihood)


@dataclass(frozen=True)
class LookAhead:
    """First-stage weights: each particle's own times p(y | mean of its transition) ** power.

    Args:
        power: 1 is the auxiliary filter as printed, 0 no look ahead at all.

    Raises:
        ValueError: power outside [0, 1].

    Source: Pitt and Shephard, Filtering via simulation: auxiliary particle filters, JASA 94 (1999).
    """

    power: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.power <= 1:
            raise ValueError(f"power must be in [0, 1], got {self.power}")

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Tensor:
        """Log-weights (*batch, n), not normalised; where the look ahead has no density at all, the particle's own."""
        law = model.conditional("transition", particles.x, step.u, step.dt)
        ahead = self.power * log_likelihood(model, law.mean, step)
        preferred = particles.log_weights + ahead
        # A row in which nothing looks likely, or something is not a number, is resampled as any other filter would.
        usable = torch.isfinite(torch.logsumexp(preferred, -1, keepdim=True))
        return torch.where(usable, preferred, particles.log_weights)


@dataclass(frozen=True)
class Local:
    """Each particle is a Gaussian that is predicted and updated by a moment rule of its own.

    Between two measurements uncertainty can be shared anew between the particles' spread and their own covariances:

    * ``split`` s: draw x ~ N(x_i, (1 - s) P_i) and keep s P_i, which leaves the mixture as it is. 0 makes points.
      None is the literature's literal form: draw from all of P_i and keep all of P_i, counting it twice.
    * ``pooled``: the fraction s is taken of the whole cloud's covariance V, not of P_i: draws are matched to the
      cloud's mean m and covariance V, shrunk to m + sqrt(1 - s) (x - m), and every particle gets s V. Mean and
      covariance of the cloud stay as they are; its shape becomes smoother, so the evidence is approximate.
    * ``redraw``: "never" again after the start, "resample" in rows that were just resampled, or "always".

    Weights: "marginal" is each particle's innovation likelihood N(y; y_i, S_i), with the draw put off to the next
    step; "joint" draws x at once from N(x_i+, P_i+) and weights by p(y|x) N(x; x_i-, P_i-) / N(x; x_i+, P_i+). With
    split 0 particles are points, the transition law itself takes the place of N(x_i-, P_i-) in the ratio, and joint
    weights are proper importance weights. On linear-Gaussian models both are the same number.

    Args:
        rule: moment rule.
        redraw, split, pooled, weights: see above.
        gate: each particle decides for itself whether it takes a measurement in; one that refuses it is weighted by the
            gate's ``outlier_log_density``. With marginal weights only.
        iterations: linearisations of the measurement law, as in `torchfilt.moments.update`.

    Raises:
        ValueError: split outside [0, 1], iterations below 1, combinations that have no meaning.

    Sources: van der Merwe, Doucet, de Freitas, Wan, The unscented particle filter, NIPS 13 (2000); Liu and West,
    Combined parameter and state estimation (2001), for the pooled kernel.
    """

    rule: Rule
    redraw: Redraw = "never"
    split: float | None = 0.5
    pooled: bool = False
    weights: Weights = "marginal"
    gate: Gate | None = None
    iterations: int = 1

    def __post_init__(self) -> None:
        check_rule_type(self.rule)
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        if self.gate is not None and self.gate.outlier_log_density is None:
            raise ValueError("a gate of many particles needs outlier_log_density, what a refused measurement weighs")
        if self.gate is not None and self.weights == "joint":
            raise ValueError("a gate goes with marginal weights: joint ones weigh points by the measurement law itself")
        if self.redraw not in ("never", "resample", "always"):
            raise ValueError(f"redraw must be 'never', 'resample' or 'always', got {self.redraw!r}")
        if self.weights not in ("marginal", "joint"):
            raise ValueError(f"weights must be 'marginal' or 'joint', got {self.weights!r}")
        if self.split is not None and not 0 <= self.split <= 1:
            raise ValueError(f"split must be in [0, 1] or None, got {self.split}")
        if self.weights == "joint" and (self.split not in (0.0, None) or self.pooled):
            raise ValueError(
                "joint weights draw from the whole of P_i: they need split=0 (points) or split=None (literal)"
            )
        if self.weights == "joint" and self.redraw != "always":
            raise ValueError(f"joint weights draw at every step: they need redraw='always', got {self.redraw!r}")
        if self.pooled and (self.split is None or not 0 < self.split < 1):
            raise ValueError(f"a pooled redraw needs 0 < split < 1, got {self.split}")

    @property
    def evidence(self) -> Evidence:
        """What the log-likelihood is worth, see `torchfilt.run.Filter`."""
        if self.pooled or self.split is None or self.gate is not None:
            return "approximate"
        return "unbiased" if self.weights == "joint" else "linearized"

    @property
    def draws_at_once(self) -> bool:
        """Whether the step itself draws."""
        return self.weights == "joint"

    @property
    def needs_redraw_noise(self) -> bool:
        """Whether `refresh` draws."""
        return self.weights == "marginal" and self.redraw != "never"

    @property
    def leaves_points(self) -> bool:
        """Whether particles are points after a step."""
        return self.weights == "joint" and self.split is not None

    def start(self, initial: Conditional, draws: Tensor, noise: Tensor) -> Particles:
        """The initial law's moments as n equal Gaussians, then split between spread and local covariance.

        With split 0 the particles are the draws themselves, whatever the law.
        """
        if self.split == 0 and not self.pooled:
            return _equal_weights(draws, None, _space_of(initial))
        prior = as_gaussian(initial)
        mean = prior.mean.unsqueeze(-2).expand_as(draws)
        factor = prior.factor().unsqueeze(-3).expand(*draws.shape[:-2], 1, -1, -1)
        return self._share(_equal_weights(mean, factor, prior.space), noise)

    def refresh(self, particles: Particles, noise: Tensor | None, resampled: Tensor | None) -> Particles:
        """Share uncertainty anew, by the redraw policy.

        Args:
            particles: after resampling.
            noise: (*batch, n, e) standard normals.
            resampled: (*batch), which rows were resampled; None for all.
        """
        if particles.scale_tril is None or not self.needs_redraw_noise:
            return particles
        assert noise is not None
        fresh = self._share(particles, noise)
        if self.redraw == "always" or resampled is None:
            return fresh
        chosen = resampled.unsqueeze(-1).unsqueeze(-1)
        kept = fresh.scale_tril if fresh.scale_tril is not None else torch.zeros_like(particles.scale_tril)
        factor = torch.where(chosen.unsqueeze(-1), kept, particles.scale_tril)
        return fresh._replace(x=torch.where(chosen, fresh.x, particles.x), scale_tril=factor)

    def _share(self, particles: Particles, noise: Tensor) -> Particles:
        if self.pooled:
            return self._pool(particles, noise)
        factor, space = particles.scale_tril, particles.space
        assert factor is not None
        drawn = 1.0 if self.split is None else (1 - self.split) ** 0.5
        away = drawn * apply_factor(factor, noise)
        x = particles.x if drawn == 0 else space.retract(particles.x, away)
        if self.split == 0:
            return particles._replace(x=x, scale_tril=None)
        kept = 1.0 if self.split is None else self.split**0.5
        return particles._replace(x=x, scale_tril=transport(space, away, factor * kept))

    def _pool(self, particles: Particles, noise: Tensor) -> Particles:
        assert self.split is not None and particles.scale_tril is not None
        space, weights = particles.space, particles.weights
        mean = space.mean(particles.x, weights)
        apart = space.local(mean.unsqueeze(-2), particles.x)
        # Cloud's covariance by one triangularisation of its columns, so that nothing is squared.
        root = weights.sqrt().unsqueeze(-1)
        factor = space.carry_back(apart, particles.scale_tril)
        own = factor if factor.shape[-3] == 1 else factor * root.unsqueeze(-1)
        columns = torch.cat([(apart * root).mT, own.movedim(-3, -2).flatten(-2)], -1)
        whole = steady_triangularize(columns)
        drawn = apart + apply_factor(factor, noise)
        drawn = drawn - weighted_sum(drawn, weights).unsqueeze(-2)
        found = steady_triangularize((drawn * root).mT)
        # Directions without any spread, such as an orbit in its gauge, keep what they have: nothing.
        flat = found.diagonal(dim1=-2, dim2=-1) <= 64 * torch.finfo(found.dtype).eps * found.norm(dim=-1)
        found = found + torch.diag_embed(flat.to(found.dtype))
        # whole found^-1 takes the draws' covariance to the cloud's.
        matched = whole @ torch.linalg.solve_triangular(found, drawn.mT, upper=False)
        away = ((1 - self.split) ** 0.5 * matched).mT
        factor = transport(space, away, (self.split**0.5 * whole).unsqueeze(-3))
        return particles._replace(x=space.retract(mean.unsqueeze(-2), away), scale_tril=factor)

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Proposed:
        """One predicted and updated Gaussian a particle.

        Args:
            model: the three laws.
            particles: x (*batch, n, d).
            step: noise.proposal (*batch, n, e) for joint weights.
        """
        if not step.move and particles.scale_tril is None:
            # Points that stand still have no law to be drawn from again: the measurement weights them.
            return Prior()(model, particles, step)
        predicted, arrival = self._predict(model, particles, step)
        sensor = model.moments("observation")
        result = update(sensor, predicted, step.y, self.rule, step.missing, self.iterations, step.u, step.dt, self.gate)
        posterior = result.belief
        if self.weights == "marginal":
            return Proposed(
                posterior.mean,
                posterior.scale_tril,
                result.log_likelihood,
                posterior.space,
                accepted=result.accepted,
                gate_nis=result.gate_nis,
            )
        assert step.noise.proposal is not None
        x = posterior.sample(step.noise.proposal)
        ratio = log_prob(arrival, x, "none") - posterior.log_prob(x)
        likelihood = log_likelihood(model, x, step)
        factor = None if self.split == 0 else posterior.scale_tril
        return Proposed(x, factor, likelihood + ratio, posterior.space, arrival, likelihood)

    def _predict(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> tuple[Gaussian, Conditional]:
        """Predicted Gaussians, and the law that joint weights are made with: the transition itself for points."""
        if particles.scale_tril is not None:
            bank = Gaussian(particles.x, particles.scale_tril, particles.space)
            if not step.move:
                return bank, bank
            predicted = predict(model.moments("transition"), bank, self.rule, step.u, step.dt)
            return predicted, predicted
        law = model.conditional("transition", particles.x, step.u, step.dt)
        ahead = as_gaussian(law)
        space = _next_space(law, particles.space)
        factor = ahead.factor()
        if factor.dim() == 2:  # shared by everyone: what particles carry has a row and a particle axis
            factor = factor.expand(*particles.x.shape[:-2], 1, -1, -1)
        return Gaussian(ahead.mean, factor, space), law


def _equal_weights(x: Tensor, factor: Tensor | None, space: Space) -> Particles:
    return Particles(x, uniform_log_weights(x.shape[:-1], x), factor, space)


def _space_of(law: Conditional) -> Space:
    return law.space if isinstance(law, Gaussian) else EUCLIDEAN


def _next_space(law: Conditional, before: Space) -> Space:
    """Space after the motion; a torch Distribution knows of none and leaves particles where they are."""
    if not isinstance(law, Gaussian):
        return before
    check_transition_space(law.space, before)
    return law.space
