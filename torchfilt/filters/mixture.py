"""Mixtures of the Gaussian recursion: many Gaussians under one model, or one under each of several models."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.distributions import MixtureSameFamily

from torchfilt.gates import Gate, by_sensor
from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.linalg import matrix_exp
from torchfilt.mixture import InitialMixture, MixtureLaw, check_probabilities, factors_of, merge, reduce
from torchfilt.model import StateSpaceModel, as_gaussian, check_batch
from torchfilt.moments import Rule, Update, check_rule_type, unscented, update
from torchfilt.moments import predict as predicted
from torchfilt.particles import Particles
from torchfilt.run import Filter, check_model
from torchfilt.spaces import Euclidean
from torchfilt.symmetry import GaugedInitial, GaugedTransition, into_gauge
from torchfilt.types import FilterState, Missing, Step, StepInfo, StepNoise


class GaussianSumFilter(Filter[Particles]):
    """Several Gaussians under one model, each predicted, updated and weighted by how well it foretold the measurement.

    The initial law may be a mixture: an `InitialMixture`, on any space, or a torch `MixtureSameFamily`. So may
    transition and measurement, as `MixtureLaw`: each component then goes on as one for each of the law's, and pairs are
    merged after the measurement until ``components`` are left, by Runnalls' bound (`torchfilt.mixture.reduce`).
    On linear laws all is exact as long as nothing is merged. The belief is `Particles` with a factor for each; a row in
    which a component fails reports ``ok = False``.

    Args:
        model: the three laws.
        rule: how moments go through a law; default `unscented()`.
        components: the most that a step leaves.
        gate: a `Gate` with ``outlier_log_density``, by which each component decides for itself; or None.

    Raises:
        ValueError: components below 1, a gate without outlier_log_density.
        TypeError: not a model, not a moment rule, not a gate.

    Source: Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE TAC 17 (1972).
    """

    carries = Particles

    def __init__(
        self, model: StateSpaceModel, rule: Rule | None = None, components: int = 32, gate: Gate | None = None
    ) -> None:
        super().__init__(model)
        self.rule = _rule(rule)
        if components < 1:
            raise ValueError(f"components must be at least 1, got {components}")
        self.components, self.gate = components, _bank_gate(gate)
        self._motions, self._sensors = _alternatives(model, "transition"), _alternatives(model, "observation")
        many = len(self._motions) * len(self._sensors) > 1 or _mixture_of(model).x.shape[-2] > components
        self.evidence = "approximate" if many or gate is not None else "exact" if model.is_linear() else "linearized"

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Particles]:
        """The components of the prior, x (*batch, n, d); ``seed`` is carried along unused.

        Raises:
            ValueError: the prior has a batch of its own, which is another one.
        """
        mixture = _mixture_of(self.model)
        check_batch(mixture.x.shape[:-2], batch_shape)
        lead = (*batch_shape, mixture.x.shape[-2])
        factor = factors_of(mixture)
        belief = Particles(
            mixture.x.expand(*lead, -1),
            mixture.log_weights.expand(lead),
            factor.expand(*batch_shape, *factor.shape[-3:]),
            mixture.space,
        )
        return FilterState(reduce(belief, self.components), 0, seed)

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
        """See `Filter.advance`; noise is not used."""
        u = u.unsqueeze(-2) if u is not None and u.dim() > 1 else u
        dt = dt.unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        weights = belief.log_weights
        bank = Gaussian(belief.x, factors_of(belief), belief.space)
        if predict:
            bank, weights = self._predict(bank, weights, u, dt)
        results = [
            update(model.moments("observation"), bank, y.unsqueeze(-2), self.rule, missing, 1, u, dt, self.gate)
            for model in self._sensors
        ]
        weights = _multiplied(weights, _log_chances(self.model.observation, weights))
        after, info = _weigh(results, weights, self.evidence, self.model)
        after = reduce(after, self.components)
        return after, info._replace(ess=after.ess)

    def _predict(self, bank: Gaussian, log_weights: Tensor, u: Tensor | None, dt: Step) -> tuple[Gaussian, Tensor]:
        """Every component by every motion."""
        moved = [predicted(model.moments("transition"), bank, self.rule, u, dt) for model in self._motions]
        law = self.model.transition
        law = law.law if isinstance(law, GaugedTransition) else law
        return _side_by_side(moved), _multiplied(log_weights, _log_chances(law, log_weights))


class InteractingMultipleModel(Filter[Particles]):
    """One Gaussian for each of several models, between which the truth jumps as a Markov chain does.

    A step mixes the modes' Gaussians by the probability of having come from each of them (mean and covariance on the
    space), predicts and updates each by its own model and weighs it by its likelihood. The belief is `Particles`: one
    component a mode, in the order of ``models``; their weights are the modes' probabilities, in a history recorded as
    "beliefs" ``history.beliefs.weights``. No mode changes in a step without a motion or over dt = 0.

    Args:
        models: m models of one state; each may have an initial law of its own.
        transition_probabilities: (m, m), row i from mode i, for one step whatever its length.
        rule: how moments go through a law; default `unscented()`.
        initial_probabilities: (m,), of the modes before the first step; default equal.
        rates_per_s: (m, m), in place of transition_probabilities where steps differ in length: the generator of the
            chain, rows that sum to zero, 1/s. A step over dt jumps by its matrix exponential.
        gate: a `Gate` with ``outlier_log_density``, by which each mode decides for itself; or None.

    Raises:
        ValueError: no model, models of other sizes or on other spaces, matrices of another shape, rows that are no
            probabilities or rates, both or neither of the two; in a step, rates without dt.
        TypeError: not a model, not a moment rule, not a gate; models or matrices of another dtype.

    Source: Blom and Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching
        coefficients, IEEE TAC 33 (1988).
    """

    carries = Particles
    transition_probabilities: Tensor | None
    rates_per_s: Tensor | None
    initial_probabilities: Tensor

    def __init__(
        self,
        models: Sequence[StateSpaceModel],
        transition_probabilities: Tensor | None = None,
        rule: Rule | None = None,
        initial_probabilities: Tensor | None = None,
        *,
        rates_per_s: Tensor | None = None,
        gate: Gate | None = None,
    ) -> None:
        if isinstance(models, StateSpaceModel):
            raise TypeError("models must be a sequence of models, got a single one")
        models = list(models)
        if not models:
            raise ValueError("models must hold one model or more, got none")
        for model in models:
            check_model(model)
        super().__init__(models[0])
        self.models, m = nn.ModuleList(models), len(models)
        self.rule, self.gate = _rule(rule), _bank_gate(gate)
        like = _check_alike(models)
        if (transition_probabilities is None) == (rates_per_s is None):
            raise ValueError("give exactly one of transition_probabilities= and rates_per_s=")
        if initial_probabilities is None:
            initial_probabilities = like.new_full((m,), 1 / m)
        for name, given, shape in (
            ("transition_probabilities", transition_probabilities, (m, m)),
            ("rates_per_s", rates_per_s, (m, m)),
            ("initial_probabilities", initial_probabilities, (m,)),
        ):
            if given is None:
                setattr(self, name, None)
                continue
            if not isinstance(given, Tensor):
                raise TypeError(f"{name} must be a tensor, got {type(given).__name__}")
            if given.shape != shape:
                raise ValueError(f"{name} must be {shape} for {m} models, got {tuple(given.shape)}")
            if given.dtype != like.dtype:
                raise TypeError(f"{name} must have the models' dtype {like.dtype}, got {given.dtype}")
            if name == "rates_per_s":
                _check_rates(given)
            else:
                rows = "rows of " if given.dim() == 2 else ""
                check_probabilities(given, f"{rows}{name}")
            hold(self, name, given)
        linear = all(model.is_linear() for model in models)
        # With one mode there is nothing to mix.
        self.evidence = "approximate" if m > 1 or gate is not None else "exact" if linear else "linearized"

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Particles]:
        """Each model's prior, x (*batch, m, d); ``seed`` is carried along unused.

        Raises:
            ValueError: a prior has a batch of its own, which is another one.
        """
        priors = [model.prior(batch_shape) for model in self._each()]
        means = [prior.mean.expand(*batch_shape, prior.mean.shape[-1]) for prior in priors]
        factors = [prior.factor().expand(*batch_shape, *prior.factor().shape[-2:]) for prior in priors]
        weights = _log(self.initial_probabilities).expand(*batch_shape, len(priors))
        return FilterState(
            Particles(torch.stack(means, -2), weights, torch.stack(factors, -3), priors[0].space), 0, seed
        )

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
        """See `Filter.advance`; noise is not used."""
        if predict:
            belief = self._mix(belief, dt)
        u = u.unsqueeze(-2) if u is not None and u.dim() > 1 else u
        dt = dt.unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        factor, results = factors_of(belief), []
        for k, model in enumerate(self._each()):
            one = Gaussian(belief.x[..., k : k + 1, :], factor[..., k : k + 1, :, :], belief.space)
            if predict:
                one = predicted(model.moments("transition"), one, self.rule, u, dt)
            law = model.moments("observation")
            results.append(update(law, one, y.unsqueeze(-2), self.rule, missing, 1, u, dt, self.gate))
        return _weigh(results, belief.log_weights, self.evidence, self.model)

    def _each(self) -> list[StateSpaceModel]:
        return [model for model in self.models if isinstance(model, StateSpaceModel)]

    def _mix(self, belief: Particles, dt: Step) -> Particles:
        """Each mode's Gaussian as that of where it may have come from, and the modes' probabilities after the jump."""
        jump = self._jump(dt)
        if jump is None:
            return belief
        own = _log(torch.eye(jump.shape[-1], dtype=jump.dtype, device=jump.device))
        joint = belief.log_weights.unsqueeze(-1) + _log(jump)
        reached = torch.isfinite(joint).any(-2, keepdim=True) | torch.isnan(joint).any(-2, keepdim=True)
        joint = torch.where(reached, joint, own)  # a mode that can't be reached keeps what it has
        ahead = torch.where(reached.squeeze(-2), torch.logsumexp(joint, -2), -math.inf)
        mixture = Particles(
            belief.x.unsqueeze(-3), torch.log_softmax(joint.mT, -1), factors_of(belief).unsqueeze(-4), belief.space
        )
        shape = mixture.log_weights.shape
        mixed = merge(mixture._replace(x=mixture.x.expand(*shape, -1)))
        return Particles(mixed.mean, ahead, mixed.scale_tril, belief.space)

    def _jump(self, dt: Step) -> Tensor | None:
        """Probabilities (m, m) or (*batch, m, m) of the modes after the motion; None where none can change."""
        if isinstance(dt, int | float) and dt == 0:
            return None
        length = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() else dt
        if self.rates_per_s is not None:
            if length is None:
                raise ValueError("rates_per_s need the length of the step: give dt")
            return matrix_exp(self.rates_per_s * length)
        assert self.transition_probabilities is not None
        jump = self.transition_probabilities
        if isinstance(length, Tensor):
            jump = torch.where(length == 0, torch.eye(len(jump), dtype=jump.dtype, device=jump.device), jump)
        return jump

    def _check_taken(self, u: Tensor, name: str) -> None:
        if not any(model.takes_controls() for model in self._each()):
            super()._check_taken(u, name)


# ----------------------------------------------------------------------------------------------------------------------
# What both share


def _rule(rule: Rule | None) -> Rule:
    rule = unscented() if rule is None else rule
    check_rule_type(rule)
    return rule


def _bank_gate(gate: Gate | None) -> Gate | None:
    if gate is not None and not isinstance(gate, Gate):
        raise TypeError(f"gate must be a Gate or None, got {type(gate).__name__}")
    if gate is not None and gate.outlier_log_density is None:
        raise ValueError("a gate of several Gaussians needs outlier_log_density, what a refused measurement weighs")
    return gate


def _log(probabilities: Tensor) -> Tensor:
    """Logarithm with -inf, and no derivative, at zero."""
    positive = probabilities > 0
    return torch.where(positive, torch.where(positive, probabilities, 1).log(), -math.inf)


def _weigh(
    results: list[Update], log_weights: Tensor, evidence: str, model: StateSpaceModel
) -> tuple[Particles, StepInfo]:
    """Components (*batch, n) after a measurement, weighted by their likelihoods, and the report."""
    posterior = _side_by_side([result.belief for result in results])
    joint = log_weights + torch.cat([result.log_likelihood for result in results], -1)
    log_likelihood = torch.logsumexp(joint, -1)
    after = Particles(posterior.mean, torch.log_softmax(joint, -1), posterior.scale_tril, posterior.space)
    # As in `GaussianFilter`: what is not finite survives the sum.
    probe = log_likelihood + after.x.sum((-2, -1)) + posterior.scale_tril.sum((-3, -2, -1))
    accepted = nis = None
    if results[0].accepted is not None:
        weights = after.weights.unsqueeze(-1)
        told = torch.cat([result.accepted for result in results if result.accepted is not None], -2)
        accepted = (weights * told).sum(-2) >= 0.5
        nis = (weights * torch.cat([r.gate_nis for r in results if r.gate_nis is not None], -2)).sum(-2)
    info = StepInfo(
        log_likelihood,
        probe - probe == 0,
        ess=after.ess,
        accepted=by_sensor(accepted, model),
        gate_nis=by_sensor(nis, model),
        evidence=evidence,
    )
    return after, info


def _side_by_side(banks: list[Gaussian]) -> Gaussian:
    """Banks (*batch, n_i, d) as one; a single bank keeps a factor that its members share."""
    if len(banks) == 1:
        return banks[0]
    factors = [bank.scale_tril.expand(*bank.mean.shape[:-1], *bank.scale_tril.shape[-2:]) for bank in banks]
    return Gaussian(torch.cat([bank.mean for bank in banks], -2), torch.cat(factors, -3), banks[0].space)


# ----------------------------------------------------------------------------------------------------------------------
# Mixtures in the three laws


def _mixture_of(model: StateSpaceModel) -> Particles:
    """The initial law as a mixture, by its representatives where the model has a symmetry."""
    initial = model.initial
    if isinstance(initial, GaugedInitial):
        initial = initial.law
    law = None if isinstance(initial, InitialMixture) else initial()
    if isinstance(initial, InitialMixture):
        mixture = initial.mixture()
    elif isinstance(law, MixtureSameFamily):
        if len(law.event_shape) != 1:
            raise ValueError(f"a mixture as initial law draws states (d,), this one has {tuple(law.event_shape)}")
        parts = as_gaussian(law.component_distribution)
        mixture = Particles(parts.mean, law.mixture_distribution.logits, parts.factor(), parts.space)
    else:
        prior = model.prior()
        factor = prior.factor().unsqueeze(-3)
        return Particles(prior.mean.unsqueeze(-2), torch.zeros_like(prior.mean[..., :1]), factor, prior.space)
    if model.gauge is None:
        return mixture
    turned = into_gauge(model.gauge, Gaussian(mixture.x, factors_of(mixture), mixture.space))
    return mixture._replace(x=turned.mean, scale_tril=turned.scale_tril)


def _alternatives(model: StateSpaceModel, name: str) -> list[StateSpaceModel]:
    """One model for each law of a mixture; they share the laws with the model, and are no parts of the filter."""
    laws = {"transition": model.transition, "observation": model.observation}
    if isinstance(laws["transition"], GaugedTransition):
        laws["transition"] = laws["transition"].law
    law = laws[name]
    if not isinstance(law, MixtureLaw):
        return [model]
    initial = model.initial.law if isinstance(model.initial, GaugedInitial) else model.initial
    return [StateSpaceModel(initial, **(laws | {name: each}), gauge=model.gauge) for each in law.laws]


def _log_chances(law: object, like: Tensor) -> Tensor | None:
    """Of a mixture's laws; normalised, as `torch.distributions.Categorical` does for the other filters."""
    return _log((law.weights / law.weights.sum()).to(like.dtype)) if isinstance(law, MixtureLaw) else None


def _multiplied(log_weights: Tensor, log_chances: Tensor | None) -> Tensor:
    """Log-weights (*batch, k n) of n components under each of k laws."""
    if log_chances is None:
        return log_weights
    return (log_weights.unsqueeze(-2) + log_chances.unsqueeze(-1)).flatten(-2)


def _check_alike(models: Sequence[StateSpaceModel]) -> Tensor:
    """Raise unless all states have one dtype, size and space; a tensor like them."""
    first = models[0].prior()
    for k, model in enumerate(models[1:], 1):
        prior = model.prior()
        if prior.mean.dtype != first.mean.dtype:
            raise TypeError(f"model {k} has dtype {prior.mean.dtype}, model 0 {first.mean.dtype}")
        if prior.mean.shape[-1] != first.mean.shape[-1]:
            raise ValueError(f"model {k} has {prior.mean.shape[-1]} state numbers, model 0 {first.mean.shape[-1]}")
        if prior.space != first.space and not type(prior.space) is type(first.space) is Euclidean:
            raise ValueError(f"model {k} lives on {prior.space!r}, model 0 on {first.space!r}")
    return first.mean


def _check_rates(rates: Tensor) -> None:
    """Raise a ValueError unless this is the generator (m, m) of a Markov chain."""
    given = rates.detach()
    if not torch.isfinite(given).all():
        raise ValueError("rates_per_s must be finite")
    off = given - torch.diag_embed(given.diagonal())
    if (off < 0).any():
        raise ValueError(f"rates_per_s off the diagonal must not be negative, got {off.min().item():.6g}")
    total = given.sum(-1).abs()
    if (total > 1e-6 * given.abs().amax(-1).clamp_min(1)).any():
        raise ValueError(f"rows of rates_per_s must sum to zero, one sums to {total.max().item():.6g}")
