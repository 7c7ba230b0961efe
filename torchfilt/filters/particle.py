"""Particle filters: one loop of resampling, proposal, weights and moves; the named methods differ by the parts."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchfilt.gates import by_sensor
from torchfilt.gaussian import Gaussian
from torchfilt.kernels import Regularize, check_kernel
from torchfilt.linalg import for_points
from torchfilt.model import Conditional, StateSpaceModel, check_batch
from torchfilt.moves import MetropolisHastings
from torchfilt.noise import NoiseSource
from torchfilt.particles import Particles
from torchfilt.proposals import LookAhead, Prior, Proposal, Proposed
from torchfilt.resampling import KldSize, Resampler, by_component, gather_particles, systematic
from torchfilt.run import Filter
from torchfilt.types import FilterState, Missing, Step, StepInfo, StepInput, StepNoise

# Purposes of random numbers: each has a sequence of its own.
_INITIAL, _INITIAL_SPLIT, _STEP, _MOVE, _ACCEPT, _OWN, _KERNEL, _RESTART = range(8)


class ParticleFilter(Filter[Particles]):
    """Weighted particles: resample, smooth by a kernel, propose, weight, move.

    Resampling comes first in a step, so the belief that a step returns is the weighted one. A row in which no particle
    can explain the measurement keeps its particles and the weights they had, reports ``log_likelihood = -inf`` and
    ``ok = False``, and can recover; single particles without a density get weight zero.

    Gradients: draws are differentiated through (they are functions of noise), resampling by the score of the chosen
    ancestors, carried in the new weights (the stop-gradient estimator): the gradient of the evidence is unbiased, that
    of its logarithm consistent in n.

    A transition law may name the error components that its noise reaches by ``noise_in``, a slice or their indices: a
    `Prior` proposal then draws no numbers for the others.

    Args:
        model: the three laws.
        particles: n; the maximum where the resampler says how many are needed (`kld_adaptive`).
        proposal: `Prior`, `Local` or anything that is a `Proposal`.
        resampler: scheme and policy, such as ``ess_below(0.5)`` or ``systematic`` (always).
        move: `MetropolisHastings`, for proposals that leave points; or None. A window of several states goes with no
            kernel, which would break the link between a state and the one before, and on the predictive target with
            `Prior` only, whose noise it replays.
        kernel: `Regularize`, which draws resampled particles anew; for proposals that leave points; or None.
        look_ahead: `LookAhead`, resample by the measurement that comes next; or None.
        fast_normals: draw float64 normals as float32 and cast them: 2.7 times cheaper, 24 bits fine.

    Raises:
        ValueError: fewer than two particles (pooled redraw: than e + 2; matched move: than 2 e + 2), a move or a kernel
            on particles with covariances, a window of several states with a kernel or another proposal (see ``move``),
            an adaptive number of particles that does not go with the other parts.
        TypeError: not a model, not a resampler.

    Source: Scibior and Wood, Differentiable particle filtering without modifying the forward pass (2021), for the
        gradients.
    """

    carries = Particles

    def __init__(
        self,
        model: StateSpaceModel,
        particles: int,
        proposal: Proposal,
        resampler: Resampler = systematic,
        move: MetropolisHastings | None = None,
        fast_normals: bool = False,
        *,
        kernel: Regularize | None = None,
        look_ahead: LookAhead | None = None,
    ) -> None:
        super().__init__(model)
        if not isinstance(resampler, Resampler):
            raise TypeError(f"resampler must be a Resampler, such as systematic or ess_below(0.5), got {resampler!r}")
        if particles < 2:
            raise ValueError(f"particles must be at least 2, got {particles}")
        size = self.tangent_size = _tangent_size(model.initial())
        if getattr(proposal, "pooled", False) and particles < size + 2:
            raise ValueError(
                f"a pooled redraw in {size} dimensions needs at least {size + 2} particles, got {particles}"
            )
        check_kernel(kernel)
        if (move is not None or kernel is not None) and not proposal.leaves_points:
            raise ValueError(
                "a move or a kernel walks on points, this proposal leaves a Gaussian for each particle; "
                "take Prior() or Local(..., redraw='always', split=0.0, weights='joint')"
            )
        if resampler.size is not None:
            fewest = size + 2 if getattr(proposal, "pooled", False) else 2
            _check_size(resampler.size, particles, size, fewest, move is None and kernel is None)
        if move is not None:
            _check_move(move, proposal, kernel, particles, size)
        self.particles, self.proposal, self.resampler, self.move = particles, proposal, resampler, move
        self.kernel, self.look_ahead, self.fast_normals = kernel, look_ahead, fast_normals
        own = getattr(proposal, "is_exact", None)
        linear = own(model, size) if own else model.is_linear() and isinstance(model.initial(), Gaussian)
        # Where linearisation leaves nothing out, a bank of Gaussians is a proper importance sampler.
        self.evidence = "unbiased" if linear and proposal.evidence == "linearized" else proposal.evidence
        if kernel is not None or (move is not None and move.target == "predictive"):
            self.evidence = "approximate"

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Particles]:
        """Particles of the initial law for ``batch_shape`` independent runs, x (*batch, n, d).

        Raises:
            ValueError: the prior has a batch of its own, which is another one.
        """
        initial = self.model.initial()
        if isinstance(initial, Gaussian):
            self.model.prior(batch_shape)
        else:
            check_batch(initial.batch_shape[: None if initial.event_shape else -1], batch_shape)
        shape = (*batch_shape, self.particles)
        source = NoiseSource(seed, self.fast_normals)
        like = initial.mean
        noise = source.normal((*shape, self.tangent_size), 0, _INITIAL, like)
        draws = _draw_initial(initial, noise, shape, source.seed_of(0, _OWN))
        split = source.normal((*shape, self.tangent_size), 0, _INITIAL_SPLIT, like)
        return FilterState(self.proposal.start(initial, draws, split), 0, seed)

    def around(self, belief: Gaussian, normals: Tensor) -> Particles:
        """Particles of a Gaussian with mean (*batch, d), by normals (2, *batch, n, e)."""
        draws = _draw_initial(belief, normals[0], tuple(normals.shape[1:-1]), 0)
        return self.proposal.start(belief, draws, normals[1])

    def draw(self, belief: Particles, step: int, seed: int) -> StepNoise:
        """Random numbers of a step, a function of (seed, step) alone."""
        source = NoiseSource(seed, self.fast_normals)
        like, shape = belief.x, belief.x.shape[:-1]
        if self.resampler.size is not None:  # how many will be used shows only in the step
            shape = torch.Size([*shape[:-1], self.particles])
        step = step + 1  # zero is the initial draw
        full = (*shape, self.tangent_size)
        generator = source.generator(step, _STEP, like.device)
        count = self.resampler.uniforms(shape[-1]) if self.resampler.threshold > 0 else 0
        uniforms = torch.rand((*shape[:-1], count), generator=generator, dtype=torch.float64, device=like.device)
        redraw = source.next_normal(full, generator, like) if self.proposal.needs_redraw_noise else None
        normal = uniform = kernel = None
        if self.kernel is not None:
            kernel = source.normal((*shape, self.kernel.normals(self.tangent_size)), step, _KERNEL, like)
        if self.move is not None:
            states = self.move.drawn_states(len(belief.past))
            normal = source.normal((self.move.steps, states, *full), step, _MOVE, like)
            uniform = source.uniform((self.move.steps, *shape), step, _ACCEPT, like)
        return StepNoise(
            self._draw_motion(full, source, generator, like) if self.proposal.draws_at_once else None,
            uniforms,
            redraw,
            normal,
            uniform,
            kernel,
            source.seed_of(step, _OWN),
        )

    def draw_with_restart(self, belief: Particles, step: int, seed: int) -> StepNoise:
        """As `draw`, with the normals that `around` takes."""
        source = NoiseSource(seed, self.fast_normals)
        shape = (2, *belief.x.shape[:-2], self.particles, self.tangent_size)
        return self.draw(belief, step, seed)._replace(restart=source.normal(shape, step + 1, _RESTART, belief.x))

    def _draw_motion(
        self, shape: tuple[int, ...], source: NoiseSource, generator: torch.Generator, like: Tensor
    ) -> Tensor:
        """Normals of ``shape`` (*batch, n, e) for the motion, zero where the law's noise does not reach."""
        reached = getattr(self.model.transition, "noise_in", None)
        if reached is None or not isinstance(self.proposal, Prior):
            return source.next_normal(shape, generator, like)
        noise = like.new_zeros((shape[-1], *shape[:-1])).movedim(0, -1)
        count = len(range(shape[-1])[reached]) if isinstance(reached, slice) else len(reached)
        noise[..., reached] = source.next_normal((*shape[:-1], count), generator, like)
        return noise

    def advance(
        self,
        belief: Particles,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Particles, StepInfo]:
        """See `Filter.advance`.

        Raises:
            ValueError: no noise.
        """
        if noise is None:
            raise ValueError("a particle filter's step needs its random numbers: noise=filter.draw(belief, step, seed)")
        u = u.unsqueeze(-2) if u is not None and u.dim() > 1 else u
        dt = dt.unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        step = StepInput(y.unsqueeze(-2), u, dt, noise, missing, predict)
        if predict:
            belief, ancestors = self._select(belief, step)
        else:
            belief = by_component(belief)
            ancestors = torch.arange(belief.x.shape[-2], device=belief.x.device).expand_as(belief.log_weights)
        alive = None
        if self.resampler.size is not None:
            alive = _alive(belief)
            step = step._replace(noise=noise._replace(proposal=_first(noise.proposal, belief)))
        proposed = self.proposal(self.model, belief, step)
        after, log_likelihood, ok = _reweight(belief, proposed)
        rate = None
        if self.move is not None and predict:
            known = proposed.arrival, proposed.log_likelihood
            after, rate = self.move(self.model, belief, after, step, *known, used=ok)
        if self.kernel is not None:
            after = after.with_centre()  # the next step needs it, as whoever records the mean does
        accepted, gate_nis = _verdict(proposed, after.weights)
        info = StepInfo(
            log_likelihood,
            ok,
            ess=after.ess,
            ancestors=ancestors,
            acceptance_rate=rate,
            accepted=by_sensor(accepted, self.model),
            gate_nis=by_sensor(gate_nis, self.model),
            particles=alive,
            evidence=self.evidence,
        )
        return after, info

    def _select(self, belief: Particles, step: StepInput) -> tuple[Particles, Tensor]:
        """Resampled, smoothed and refreshed particles and their ancestors (*batch, n)."""
        cloud, preferred = belief, belief.log_weights
        if self.look_ahead is not None:
            preferred = self.look_ahead(self.model, belief, step)
        belief, ancestors, chosen = self._resample(belief, preferred, step.noise.resampling)
        if self.move is not None:
            belief = belief._replace(past=self.move.follow(cloud.past, ancestors))
        if self.kernel is not None:
            assert step.noise.kernel is not None
            belief = self.kernel(cloud, belief, step.noise.kernel, chosen, ancestors)
        return self.proposal.refresh(belief, _first(step.noise.redraw, belief), chosen), ancestors

    def _resample(
        self, belief: Particles, preferred: Tensor, uniforms: Tensor
    ) -> tuple[Particles, Tensor, Tensor | None]:
        """Particles drawn by the log-weights ``preferred`` (*batch, n), with weights that make up for it.

        Also their ancestors (*batch, n), and the rows that were resampled; None for all.
        """
        n = belief.log_weights.shape[-1]
        weights = belief.weights if preferred is belief.log_weights else torch.softmax(preferred, -1)
        weights = weights.detach() if weights.requires_grad else weights
        policy, counts = self.resampler, None
        held: Tensor | int = n if policy.size is None else _alive(belief)
        if policy.threshold == math.inf:
            if policy.size is not None:
                counts = policy.size(belief, weights, self.particles)
            ancestors = policy(weights, uniforms, counts, self._width(counts))
            return _copies(belief, preferred, ancestors, None, counts, self.particles), ancestors, None
        everyone = torch.arange(n, device=belief.x.device)
        few = 1 / weights.square().sum(-1) < policy.threshold * held
        if policy.threshold == 0 or not (torch.compiler.is_compiling() or bool(few.any())):
            return by_component(belief), everyone.expand_as(belief.log_weights), torch.zeros_like(few)
        if policy.size is not None:
            counts = torch.where(few, policy.size(belief, weights, self.particles), held)
        ancestors = policy(weights, uniforms, counts, self._width(counts))
        if counts is not None:
            everyone = torch.arange(ancestors.shape[-1], device=belief.x.device).clamp_max(n - 1)
        ancestors = torch.where(few.unsqueeze(-1), ancestors, everyone)
        return _copies(belief, preferred, ancestors, few, counts, self.particles), ancestors, few

    def _width(self, counts: Tensor | None) -> int | None:
        """Particles that the fullest row has; under the compiler, where no shape may hang on numbers, the maximum."""
        if counts is None:
            return None
        return self.particles if torch.compiler.is_compiling() else int(counts.max())


def _check_size(policy: KldSize, most: int, size: int, fewest: int, alone: bool) -> None:
    """Raise a ValueError where an adaptive number of particles does not go with the filter's other parts."""
    if not alone:
        raise ValueError("a move or a kernel needs a fixed number of particles, kld_adaptive gives a number a row")
    if not fewest <= policy.minimum <= most:
        raise ValueError(f"kld_adaptive's minimum must be from {fewest} to particles = {most}, got {policy.minimum}")
    if isinstance(policy.bin_widths, tuple) and len(policy.bin_widths) != size:
        raise ValueError(f"bin_widths must be one or one for each of {size} components, got {len(policy.bin_widths)}")


def _check_move(
    move: MetropolisHastings, proposal: Proposal, kernel: Regularize | None, particles: int, size: int
) -> None:
    """Raise a ValueError where a window's states would not follow from one another, or a match is impossible."""
    if move.matched and particles < 2 * size + 2:
        raise ValueError(
            f"a matched move in {size} dimensions needs at least {2 * size + 2} particles, got {particles}"
        )
    if move.window == 1:
        return
    if kernel is not None:
        raise ValueError(
            f"a kernel breaks the link between a state and the one before, which a window of {move.window} states "
            "needs: take window=1 or kernel=None"
        )
    if move.target == "predictive" and not isinstance(proposal, Prior):
        raise ValueError(
            f"a predictive window of {move.window} states replays the noise that Prior() drew with, the proposal is "
            f"{proposal!r}: take Prior(), window=1 or target='transition'"
        )


def _first(noise: Tensor | None, belief: Particles) -> Tensor | None:
    """The numbers (*batch, n, e) that the particles there are use; they were drawn for the most there can be."""
    n = belief.x.shape[-2]
    return noise if noise is None or noise.shape[-2] == n else noise[..., :n, :]


def _alive(belief: Particles) -> Tensor:
    """How many particles (*batch) a row has, up to the last with a weight."""
    places = torch.arange(1, belief.log_weights.shape[-1] + 1, device=belief.x.device)
    return torch.where(belief.log_weights > -math.inf, places, 1).amax(-1)


def _copies(
    belief: Particles, preferred: Tensor, ancestors: Tensor, chosen: Tensor | None, counts: Tensor | None, most: int
) -> Particles:
    """The ancestors' copies, weighted by what they were preferred beyond their own weight.

    ``counts`` (*batch): how many of a row's ancestors count, None for all; ``most``: the largest count there can be.
    """
    x = gather_particles(belief.x, ancestors)
    factor = belief.scale_tril
    if factor is not None and factor.shape[-3] > 1:
        factor = gather_particles(factor, ancestors)
    log_weights = belief.log_weights.new_full((), -math.log(ancestors.shape[-1] if counts is None else most))
    if counts is not None:
        log_weights = torch.where(counts == most, log_weights, -counts.to(log_weights.dtype).log()).unsqueeze(-1)
    log_weights = log_weights.expand(ancestors.shape)
    if preferred is not belief.log_weights:
        # Constant in the gradient: what the weights lose by it, the score of the choice gives back.
        choice = torch.log_softmax(preferred, -1).detach()
        log_weights = log_weights + (belief.log_weights - choice).gather(-1, ancestors)
    elif preferred.requires_grad and torch.is_grad_enabled():
        score = preferred.gather(-1, ancestors)
        # A particle of weight zero has no ancestor but may stand in the unchosen rows.
        log_weights = log_weights + torch.where(torch.isfinite(score), score - score.detach(), 0)
    if chosen is not None:
        own = belief.log_weights if counts is None else belief.log_weights.gather(-1, ancestors)
        log_weights = torch.where(chosen.unsqueeze(-1), log_weights, own)
    if counts is not None:
        places = torch.arange(ancestors.shape[-1], device=x.device)
        log_weights = torch.where(places < counts.unsqueeze(-1), log_weights, -math.inf)
    return Particles(x, log_weights, factor, belief.space)


def _normalise(log_weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised log-weights, their sum's logarithm (*batch) and the weights; NaN in rows without any weight."""
    normalised = torch.log_softmax(log_weights, -1)
    # Both largest entries belong to the same particle; one pass less over the particles than logsumexp takes.
    return normalised, log_weights.amax(-1) - normalised.amax(-1), torch.softmax(log_weights, -1)


def _reweight(belief: Particles, proposed: Proposed) -> tuple[Particles, Tensor, Tensor]:
    """Normalised posterior, log-likelihood (*batch) and status (*batch)."""
    log_weights = belief.log_weights + proposed.log_weight
    normalised, log_likelihood, weights = _normalise(log_weights)
    ok = log_likelihood - log_likelihood == 0  # neither NaN nor infinite
    after = Particles(proposed.x, normalised, proposed.scale_tril, proposed.space, (normalised, weights))
    if not torch.compiler.is_compiling() and bool(ok if ok.dim() == 0 else ok.all()):
        return after, log_likelihood, ok
    return _mend(belief, proposed, log_weights)


def _mend(belief: Particles, proposed: Proposed, log_weights: Tensor) -> tuple[Particles, Tensor, Tensor]:
    """Rows with weights that are not numbers: such particles get weight zero, rows without any keep what they had."""
    sick = torch.isnan(log_weights) | (log_weights == math.inf)
    normalised, log_likelihood, weights = _normalise(torch.where(sick, -math.inf, log_weights))
    alive = torch.isfinite(log_likelihood)
    log_likelihood = torch.where(alive, log_likelihood, -math.inf)
    kept = torch.where(alive.unsqueeze(-1), normalised, belief.log_weights)
    weights = torch.where(alive.unsqueeze(-1), weights, belief.weights)
    # A sick particle must not reach the moments: zero times NaN is NaN.
    bad = (sick | ~torch.isfinite(proposed.x).all(-1)).unsqueeze(-1)
    x = _laid_out_as(proposed.x, torch.where(bad, belief.x, proposed.x))
    factor = proposed.scale_tril
    if factor is not None:
        before = belief.scale_tril if belief.scale_tril is not None else torch.zeros_like(factor)
        lost = bad.unsqueeze(-1)
        if factor.shape[-3] == 1:  # all particles' own, which one that is sick says nothing about
            lost = ~torch.isfinite(factor).all(-1, keepdim=True).all(-2, keepdim=True)
        factor = _laid_out_as(factor, torch.where(lost, before, factor))
    after = Particles(x, kept, factor, proposed.space, (kept, weights))
    return after, log_likelihood, alive & torch.isfinite(x).all(-1).all(-1)


def _laid_out_as(like: Tensor, values: Tensor) -> Tensor:
    """The same values in the memory order of ``like``: sums round by it, and no row may notice another one's fate."""
    if torch.compiler.is_compiling() or values.shape != like.shape or values.stride() == like.stride():
        return values
    return torch.empty_like(like).copy_(values)


def _verdict(proposed: Proposed, weights: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """What the heavier half of the particles took in, and the mean of what they decided by, (*batch, sensors)."""
    if proposed.accepted is None or proposed.gate_nis is None:
        return None, None
    share = weights.unsqueeze(-1)
    return (share * proposed.accepted).sum(-2) >= 0.5, (share * proposed.gate_nis).sum(-2)


def _tangent_size(initial: Conditional) -> int:
    if isinstance(initial, Gaussian):
        return initial.tangent_size
    return (*initial.batch_shape, *initial.event_shape)[-1] if initial.batch_shape or initial.event_shape else 1


def _draw_initial(initial: Conditional, noise: Tensor, shape: tuple[int, ...], seed: int) -> Tensor:
    if isinstance(initial, Gaussian):
        mean = initial.mean if initial.mean.dim() == 1 else initial.mean.unsqueeze(-2)
        factor = for_points(initial.factor(), 2, len(shape))
        return Gaussian(mean.expand(*shape, -1), factor, initial.space).sample(noise)
    return _draw_distribution(initial, shape, seed)


def _draw_distribution(law: Distribution, shape: tuple[int, ...], seed: int) -> Tensor:
    """Draws (*shape, d) of a torch Distribution under its own seed; the global generator is put back."""
    own = law.batch_shape[-1:] if not law.event_shape else torch.Size()
    wide: Any = law.expand(torch.Size((*shape[:-1], *own)))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        draws: Tensor = wide.rsample(shape[-1:]) if wide.has_rsample else wide.sample(shape[-1:])
    draws = draws if law.event_shape or law.batch_shape else draws.unsqueeze(-1)
    return draws.movedim(0, -2)
