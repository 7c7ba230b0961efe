"""Markov moves: particles walk on the target itself, so that copies made by resampling part again."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.kernels import optimal_bandwidth
from torchfilt.linalg import apply_factor, steady_triangularize
from torchfilt.model import Conditional, StateSpaceModel, as_gaussian, log_likelihood, log_prob
from torchfilt.particles import Particles, PastStep
from torchfilt.resampling import gather_particles
from torchfilt.spaces import Space, centred, steady_sum
from torchfilt.types import StepInput

Target = Literal["transition", "predictive"]


class Moved(NamedTuple):
    """Particles after the moves, with the past that the next step's window needs, and the accepted share (*batch)."""

    particles: Particles
    acceptance_rate: Tensor


class _Trajectory(NamedTuple):
    """States of a window, oldest first, each (*batch, n, d), and what each step adds to the target (w, *batch, n)."""

    states: tuple[Tensor, ...]
    levels: Tensor


_Propose = Callable[[tuple[Tensor, ...], Tensor], _Trajectory]


@dataclass(frozen=True)
class MetropolisHastings:
    """Move the last states of each particle together, accepted or refused as one; weights stay as they are.

    Two targets for the states x_s ... x_k of the window:

    * "transition": p(x_s|x_{s-1}) ... p(x_k|x_{k-1}) p(y_s|x_s) ... p(y_k|x_k), with the state before the window where
      it is. Every state takes a step of its own, a share of its cloud's covariance factor. It needs process noise of
      full rank: where that is singular, every proposal leaves the law's support and is refused, and the filter is the
      one without a move. On curved spaces it is right to the square of a step's noise in radians.
    * "predictive": the Gaussian N(m, P) that fits the predicted cloud at s stands for the law of x_s, and the states
      after it follow by the transition with the process noise they were made with. x_s takes a Crank-Nicolson step in
      the tangent space at m, ``v -> sqrt(1 - h^2) v + h A xi`` with ``A A' = P``, which leaves N(m, P) as it is, so
      that the product of the likelihoods alone decides. Any rank of noise will do, but it must be a Gaussian's; the fit
      is an approximation, so the evidence becomes one, and of a cloud in pieces it knows mean and covariance only.

    The window grows from the first predicted state until it is full, and starts anew after a step without a motion. A
    row whose measurement no particle could explain leaves it out, as its weights do.

    Args:
        steps: moves in a row.
        scale: size of a step: "transition", share of the covariance factor, None for 2.38 / sqrt(numbers moved), the
            best for a Gaussian target; "predictive", h, None for `torchfilt.kernels.optimal_bandwidth`.
        target: see above.
        window: states that move together, L.
        matched: the normals xi of all particles are made free of weighted mean and of correlation with the particles,
            and of unit covariance: such a move adds no noise of its own to the cloud's mean and covariance, which long
            runs would sum up. Particles then know of each other, an effect of order 1/n. Rows with too few effective
            particles for it, about 5 e, or with a cloud that lacks a dimension, take the normals as they are.

    Raises:
        ValueError: steps or window below 1, scale not positive or, for "predictive", above 1, unknown target,
            ``matched`` for "transition".

    Sources: Gilks and Berzuini, Following a moving target, JRSS B 63 (2001); Roberts and Rosenthal, Optimal scaling for
    various Metropolis-Hastings algorithms (2001); Cotter, Roberts, Stuart, White, MCMC methods for functions (2013),
    for the reversible step.
    """

    steps: int = 1
    scale: float | None = None
    target: Target = "transition"
    window: int = 1
    matched: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")
        if self.window < 1:
            raise ValueError(f"window must be at least 1, got {self.window}")
        if self.target not in ("transition", "predictive"):
            raise ValueError(f"target must be 'transition' or 'predictive', got {self.target!r}")
        if self.scale is not None and not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")
        if self.target == "predictive" and self.scale is not None and self.scale > 1:
            rule = "in (0, 1], as a predictive step keeps sqrt(1 - scale^2) of the state"
            raise ValueError(f"scale must be {rule}, got {self.scale}")
        if self.target == "transition" and self.matched:
            raise ValueError("matched normals belong to the one kernel step of target='predictive'")

    def drawn_states(self, past: int) -> int:
        """How many states of a particle take a random step of their own, ``past`` steps being known."""
        return min(past + 1, self.window) if self.target == "transition" else 1

    def follow(self, past: tuple[PastStep, ...], ancestors: Tensor) -> tuple[PastStep, ...]:
        """The part of the past that the next window reaches over, in the order of the ``ancestors`` (*batch, n).

        Raises:
            ValueError: it was kept by a move on another target.
        """
        if self.window == 1:
            return ()
        past = past[-(self.window - 1) :]
        if any((part.mean is None) != (self.target == "transition") for part in past):
            raise ValueError(
                f"the belief's past was kept by a move on another target than {self.target!r}; "
                "belief._replace(past=()) starts a window anew"
            )
        return tuple(_gathered(part, ancestors) for part in past)

    def __call__(
        self,
        model: StateSpaceModel,
        before: Particles,
        after: Particles,
        step: StepInput,
        arrival: Conditional | None = None,
        likelihood: Tensor | None = None,
        used: Tensor | None = None,
    ) -> Moved:
        """Move.

        Args:
            model: the three laws.
            before: particles of the step before, in the order of their children, with their past of `follow`.
            after: weighted by the measurement, x (*batch, n, d).
            step: noise.move_normal (steps, states, *batch, n, e) with the states of `drawn_states`, noise.move_uniform
                (steps, *batch, n); noise.proposal (*batch, n, e) that x was drawn with, for a predictive window.
            arrival: transition law at ``before``, and
            likelihood: log-likelihood (*batch, n) of ``after``, where they are known already.
            used: (*batch), rows that took the measurement in; None for all.

        Raises:
            TypeError: a predictive window of several states, and a transition law that is no `Gaussian`.
        """
        normals, uniforms = step.noise.move_normal, step.noise.move_uniform
        assert normals is not None and uniforms is not None
        law = model.conditional("transition", before.x, step.u, step.dt) if arrival is None else arrival
        window = (*before.past, self._this_step(model, before, after, step, law, likelihood, used))
        states = (*(part.origin for part in window[1:]), after.x)
        here = _Trajectory(states, torch.stack([part.level for part in window]))
        prepare = self._walk if self.target == "transition" else self._shift
        propose = prepare(model, window, here.states, after, law)
        rates = []
        for normal, uniform in zip(normals, uniforms, strict=True):
            there = propose(here.states, normal)
            gain = (there.levels - here.levels).sum(0)
            # A comparison with NaN is False: what has no density is never accepted.
            accepted = uniform.log().to(gain.dtype) < gain
            chosen = accepted.unsqueeze(-1)
            states = tuple(torch.where(chosen, a, b) for a, b in zip(there.states, here.states, strict=True))
            here = _Trajectory(states, torch.where(accepted, there.levels, here.levels))
            rates.append(accepted.to(gain.dtype).mean(-1))
        moved = after._replace(x=here.states[-1], past=self._past(window, here))
        return Moved(moved, torch.stack(rates).mean(0))

    def _this_step(
        self,
        model: StateSpaceModel,
        before: Particles,
        after: Particles,
        step: StepInput,
        law: Conditional,
        likelihood: Tensor | None,
        used: Tensor | None,
    ) -> PastStep:
        """The newest step of the window."""
        if used is None:
            used = torch.ones(after.x.shape[:-2], dtype=torch.bool, device=after.x.device)
        level = log_likelihood(model, after.x, step) if likelihood is None else likelihood
        level = torch.where(used.unsqueeze(-1), level, 0)
        mean = factor = noise = None
        if self.target == "transition":
            level = level + log_prob(law, after.x, "none")
        else:
            mean, factor = _fit(as_gaussian(law), before.weights)
            noise = step.noise.proposal
        # What a file brings back is laid out like this as well, and matrix products round by the layout.
        y, u = step.y.contiguous(), None if step.u is None else step.u.contiguous()
        dt = step.dt.contiguous() if isinstance(step.dt, Tensor) else step.dt
        return PastStep(before.x, noise, level, mean, factor, used.unsqueeze(-1), y, u, dt, step.missing)

    def _walk(
        self,
        model: StateSpaceModel,
        window: tuple[PastStep, ...],
        states: tuple[Tensor, ...],
        after: Particles,
        law: Conditional,
    ) -> _Propose:
        """Each state by a step of its own."""
        space = after.space
        factors = [_cloud_factor(space, x, after.weights) for x in states]
        size = self.scale if self.scale is not None else 2.38 / (len(states) * factors[0].shape[-1]) ** 0.5
        first = window[0]
        if len(window) > 1:
            law = model.conditional("transition", first.origin, first.u, first.dt)

        def propose(states: tuple[Tensor, ...], normal: Tensor) -> _Trajectory:
            steps = (size * apply_factor(factor, own) for factor, own in zip(factors, normal, strict=True))
            moved = tuple(space.retract(x, v) for x, v in zip(states, steps, strict=True))
            levels = []
            for k, (part, x) in enumerate(zip(window, moved, strict=True)):
                arrival = law if k == 0 else model.conditional("transition", moved[k - 1], part.u, part.dt)
                levels.append(_likelihood(model, x, part) + log_prob(arrival, x, "none"))
            return _Trajectory(moved, torch.stack(levels))

        return propose

    def _shift(
        self,
        model: StateSpaceModel,
        window: tuple[PastStep, ...],
        states: tuple[Tensor, ...],
        after: Particles,
        law: Conditional,
    ) -> _Propose:
        """The first state by a reversible step, the later ones by their old noise."""
        space, mean, factor = after.space, window[0].mean, window[0].factor
        assert mean is not None and factor is not None
        size = self.scale if self.scale is not None else optimal_bandwidth(factor.shape[-1], after.x.shape[-2])
        kept = (1 - size**2) ** 0.5

        def propose(states: tuple[Tensor, ...], normal: Tensor) -> _Trajectory:
            error, drawn = space.local(mean, states[0]), normal[0]
            if self.matched:
                drawn = _matched(drawn, error, after.weights)
            moved = [space.retract(mean, kept * error + size * apply_factor(factor, drawn))]
            for part in window[1:]:
                moved.append(_replayed(model, moved[-1], part))
            levels = [_likelihood(model, x, part) for x, part in zip(moved, window, strict=True)]
            return _Trajectory(tuple(moved), torch.stack(levels))

        return propose

    def _past(self, window: tuple[PastStep, ...], here: _Trajectory) -> tuple[PastStep, ...]:
        """What the next window reaches back over."""
        if self.window == 1:
            return ()
        origins = (window[0].origin, *here.states[:-1])
        parts = zip(window, origins, here.levels, strict=True)
        return tuple(part._replace(origin=x, level=level) for part, x, level in parts)[-(self.window - 1) :]


def _gathered(part: PastStep, ancestors: Tensor) -> PastStep:
    return part._replace(
        origin=gather_particles(part.origin, ancestors),
        noise=None if part.noise is None else gather_particles(part.noise, ancestors),
        level=part.level.gather(-1, ancestors),
    )


def _likelihood(model: StateSpaceModel, x: Tensor, part: PastStep) -> Tensor:
    """Log-density (*batch, n) of a step's measurement at x; none where its row left it out."""
    law = model.conditional("observation", x, part.u, part.dt)
    return torch.where(part.used, log_prob(law, part.y, part.missing), 0)


def _replayed(model: StateSpaceModel, x: Tensor, part: PastStep) -> Tensor:
    """Where the step would have led from x with the noise it had."""
    law = model.conditional("transition", x, part.u, part.dt)
    if not isinstance(law, Gaussian):
        raise TypeError(
            f"a predictive window of several states replays the noise of a Gaussian transition, this one is a "
            f"{type(law).__name__}; take window=1 or target='transition'"
        )
    assert part.noise is not None
    return law.sample(part.noise)


def _cloud_factor(space: Space, x: Tensor, weights: Tensor) -> Tensor:
    """Factor (*batch, 1, e, e) of the weighted covariance; one triangularisation, so singular clouds are no trouble."""
    _, apart = centred(space, x, weights)
    return steady_triangularize((apart * weights.sqrt().unsqueeze(-1)).mT).unsqueeze(-3)


def _fit(law: Gaussian, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (*batch, 1, d) and factor (*batch, 1, e, e) of the mixture of the particles' transition laws."""
    mean, apart = centred(law.space, law.mean, weights)
    root = weights.sqrt().unsqueeze(-1)
    apart = apart * root
    factor = law.factor()
    if factor.dim() > 2 and factor.shape[-3] > 1:
        own = (factor * root.unsqueeze(-1)).movedim(-3, -2).flatten(-2)
    else:
        own = factor if factor.dim() == 2 else factor.squeeze(-3)
        own = own.expand(*apart.shape[:-2], -1, -1)
    whole = steady_triangularize(torch.cat([apart.mT, own], -1))
    return mean.contiguous().unsqueeze(-2), whole.contiguous().unsqueeze(-3)


def _matched(normals: Tensor, errors: Tensor, weights: Tensor) -> Tensor:
    """Normals (*batch, n, e) of mean zero and covariance one that are not correlated with errors (*batch, n, e).

    Numbers that are given, like any noise: no derivative goes through them.
    """
    e = normals.shape[-1]
    both = torch.cat([errors.detach().mT, normals.mT], -2)
    both = both - steady_sum(both * weights.detach().unsqueeze(-2), -1).unsqueeze(-1)
    factor = steady_triangularize(both * weights.detach().sqrt().unsqueeze(-2))
    cloud, cross, rest = factor[..., :e, :e], factor[..., e:, :e], factor[..., e:, e:]
    # In units of the cloud's own deviations: against a dimension without spread nothing can be made uncorrelated.
    spread = cloud.square().sum(-1).sqrt()
    flat = cloud.diagonal(dim1=-2, dim2=-1) <= 1e3 * torch.finfo(cloud.dtype).eps * spread
    # Few effective particles leave little of the normals once their share in the errors is gone.
    plain = (flat | (rest.diagonal(dim1=-2, dim2=-1) < 0.5)).any(-1)[..., None, None]
    identity = torch.eye(e, dtype=normals.dtype, device=normals.device)
    cloud, rest = torch.where(plain, identity, cloud), torch.where(plain, identity, rest)
    share = torch.linalg.solve_triangular(cloud, cross, upper=False, left=False)
    turn = torch.linalg.solve_triangular(rest, torch.cat([-share, identity.expand_as(share)], -1), upper=False)
    return torch.where(plain, normals, (turn @ both).mT)
