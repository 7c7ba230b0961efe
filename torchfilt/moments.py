"""Moment rules: how a Gaussian goes through a law.

Every rule turns (law, Gaussian) into one `Linearization`; one square-root recursion (`predict`, `update`) does the
rest. A quadrature is data; Taylor is the exact derivative. For laws that are linear in the state all rules agree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfilt.exact import SPREAD, Verdict, examine, filled, keep_true
from torchfilt.gaussian import LOG_2PI, Gaussian, cat_columns, mask_rows
from torchfilt.linalg import apply_factor, cholesky_downdate, for_points, log_abs_diagonal, triangularize, whiten
from torchfilt.spaces import EUCLIDEAN, Euclidean, Space, transport
from torchfilt.types import Missing

Law = Callable[..., Gaussian]


class Linearization(NamedTuple):
    """A law seen from a Gaussian N(m, S S^T): ``y = mean + slope e + residual r + noise w``, (e, r, w) standard normal.

    mean (..., d_y); slope (..., e_y, e_x), the response to the whitened error e where x = retract(m, S e);
    residual (..., e_y, k) what no linear map explains, or None; noise (..., e_y, e_y) the mean conditional covariance's
    factor; negative (..., e_y): a column to be subtracted, for quadratures with a negative weight.
    """

    mean: Tensor
    slope: Tensor
    residual: Tensor | None
    noise: Tensor
    space: Space
    negative: Tensor | None = None

    def spread(self) -> Tensor:
        """Columns whose product is the part of the covariance that does not come from the slope."""
        return self.noise if self.residual is None else cat_columns(self.residual, self.noise)


class Rule(Protocol):
    """A moment rule."""

    def linearize(self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None) -> Linearization:
        """See `Linearization`."""
        ...


def check_rule_type(rule: object) -> None:
    """Raise a TypeError unless this is a moment rule."""
    if not hasattr(rule, "linearize"):
        shown = rule if isinstance(rule, str) else getattr(rule, "__name__", type(rule).__name__)
        raise TypeError(f"rule must be a moment rule, such as taylor() or unscented(), got {shown!r}")


def lift(value: Tensor | float | None) -> Tensor | float | None:
    """Make room for the sigma-point axis in a control or time step; unbatched values broadcast as they are."""
    return value.unsqueeze(-2) if isinstance(value, Tensor) and value.dim() > 1 else value


@dataclass(frozen=True)
class Taylor:
    """First-order expansion about the mean (the extended Kalman filter's rule), exact derivatives on any space.

    ``about``: a fixed point (d numbers) to expand about instead, as a filter does that is linearised once.
    """

    about: tuple[float, ...] | None = None

    def linearize(self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None) -> Linearization:
        """One evaluation and one forward-mode sweep; no sweep for laws that give their linear form or first order."""
        linear_form = getattr(law, "linear_form", None)
        if linear_form is not None:
            matrix, offset, noise = linear_form(u, dt)
            lead = belief.mean.dim() - 1  # one matrix a run may meet several Gaussians a run
            matrix, noise = for_points(matrix, 2, lead), for_points(noise, 2, lead)
            offset = offset if offset is None else for_points(offset, 1, lead)
            mean = apply_factor(matrix, belief.mean)
            return Linearization(
                mean if offset is None else mean + offset, matrix @ belief.factor(), None, noise, law_space(law)
            )
        centre = belief.mean
        if self.about is not None:
            centre = centre.new_tensor(self.about).expand_as(centre)
        columns = belief.factor().expand(*centre.shape[:-1], -1, -1)
        if self.about is not None:  # how far the mean lies from the point, as one more column
            columns = cat_columns(columns, belief.space.local(centre, belief.mean).unsqueeze(-1))
        at, slope = _first_order(law, centre, columns, belief.space, u, dt)
        mean = at.mean
        if self.about is not None:
            mean, slope = at.space.retract(mean, slope[..., -1]), slope[..., :-1]
        return Linearization(mean, slope, None, at.factor(), at.space)


def _first_order(
    law: Law, centre: Tensor, columns: Tensor, space: Space, u: Tensor | None, dt: Tensor | float | None
) -> tuple[Gaussian, Tensor]:
    """The law at ``centre`` and its derivative along each of ``columns`` (..., e, k): (..., e_y, k)."""
    own = getattr(law, "first_order", None)
    if own is not None:
        at, jacobian = own(centre, u, dt)
        return at, jacobian @ columns
    at = law(centre, u, dt)
    u_points, dt_points = lift(u), lift(dt)

    def response(error: Tensor) -> Tensor:
        points = space.retract(centre.unsqueeze(-2), error)
        return at.space.local(at.mean.unsqueeze(-2), law(points, u_points, dt_points).mean)

    # One row per direction, so a single forward-mode sweep over the batch gives the whole Jacobian.
    directions = columns.mT.contiguous()
    slope: Tensor = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1]
    return at, slope.mT


class Quadrature(NamedTuple):
    """Nodes (s, e) for a standard normal with weights (s,) of the mean and of the covariance.

    ``paired``: nodes are [+c I, -c I], or these after a centre, so slope and residual split without a matrix product;
    ``central`` is then the centre's covariance weight, ``negative`` says whether its mean weight is below zero and
    ``reach`` is c, all as plain values, so that a compiled step does not branch on tensors.
    """

    nodes: Tensor
    mean_weights: Tensor
    covariance_weights: Tensor
    paired: bool
    central: float = 0.0
    negative: bool = False
    reach: float = 0.0


@dataclass(frozen=True)
class SigmaPoints:
    """Statistical linearisation with a quadrature that is built for each dimension.

    ``made_by``: function and arguments that give this rule again in another process; without it, ``build`` itself must
    be found by its name there.
    """

    name: str
    build: Callable[[int], Quadrature]
    made_by: tuple[Callable[..., "SigmaPoints"], tuple[Any, ...]] | None = field(
        default=None, repr=False, compare=False
    )

    def __reduce__(self) -> tuple[Any, ...]:
        return self.made_by or (SigmaPoints, (self.name, self.build))

    def linearize(self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None) -> Linearization:
        """One batched evaluation of the law at all nodes."""
        rule = _quadrature(self.build, belief.tangent_size, belief.mean.dtype, belief.mean.device)
        offsets = _offsets(rule, belief.factor())
        points = belief.space.retract(belief.mean.unsqueeze(-2), offsets)
        at_points, noise = _evaluate(law, points, rule, lift(u), lift(dt))
        space = at_points.space
        mean = space.mean(at_points.mean, rule.mean_weights)
        deviation = space.local(mean.unsqueeze(-2), at_points.mean)
        split = _split_paired if rule.paired else _split
        slope, residual, negative = split(rule, deviation)
        return Linearization(mean, slope, residual, noise, space, negative)


def _offsets(rule: Quadrature, factor: Tensor) -> Tensor:
    """Errors (..., s, e) of the nodes; of paired ones without a product, which would be mostly zeros."""
    if not rule.paired:
        return rule.nodes @ factor.mT
    columns = rule.reach * factor.mT
    centre = [torch.zeros_like(columns[..., :1, :])] * (len(rule.nodes) - 2 * columns.shape[-1])
    return torch.cat([*centre, columns, -columns], -2)


def _split_paired(rule: Quadrature, deviation: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Rotate each +- pair of columns into its odd part (the slope, exactly) and its even part (the residual)."""
    size = rule.nodes.shape[-1]
    weight, central = rule.covariance_weights[-1], rule.central
    plus, minus = deviation[..., -2 * size : -size, :], deviation[..., -size:, :]
    half = torch.sqrt(weight / 2)
    slope = (half * (plus - minus)).mT
    even = half * (plus + minus)
    if central > 0:
        even = torch.cat([even, central**0.5 * deviation[..., :1, :]], -2)
    negative = (-central) ** 0.5 * deviation[..., 0, :] if central < 0 else None
    return slope, even.mT, negative


def _split(rule: Quadrature, deviation: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Project the weighted columns on the weighted nodes; the rest is residual."""
    root = rule.covariance_weights.sqrt().unsqueeze(-1)
    columns, nodes = root * deviation, root * rule.nodes
    slope = columns.mT @ nodes
    return slope, columns.mT - slope @ nodes.mT, None


def _evaluate(law: Law, points: Tensor, rule: Quadrature, u: Any, dt: Any) -> tuple[Gaussian, Tensor]:
    """Conditional means at the points and the factor of the weighted mean of the conditional covariances."""
    weights = rule.mean_weights
    pooled = getattr(law, "pooled", None)
    if pooled is not None:  # the law averages its own noise, cheaper than one factor a point
        result = pooled(points, weights, u, dt)
        factor = result.factor()
        return result, factor.squeeze(-3) if factor.dim() > 2 else factor
    result = law(points, u, dt)
    scale = result.scale_tril
    if result.is_diagonal:
        varies = scale.dim() > 1 and scale.shape[-2] > 1
        if varies:
            # A negative centre weight can make the mean variance negative: its root is NaN, and the row fails.
            scale = (scale.square() * weights.unsqueeze(-1)).sum(-2).sqrt()
        elif scale.dim() > 1:
            scale = scale.squeeze(-2)
        return result, torch.diag_embed(scale)
    if scale.dim() == 2:
        return result, scale
    if scale.shape[-3] == 1:
        return result, scale.squeeze(-3)
    if rule.negative:
        covariance = (scale @ scale.mT * weights[:, None, None]).sum(-3)
        factor, failed = torch.linalg.cholesky_ex(covariance)
        return result, torch.where((failed > 0)[..., None, None], torch.nan, factor)
    columns = (scale * weights.sqrt()[:, None, None]).movedim(-3, -2)
    return result, triangularize(columns.flatten(-2))


_QUADRATURES: dict[tuple[object, ...], Quadrature] = {}


def _quadrature(build: Callable[[int], Quadrature], size: int, dtype: torch.dtype, device: torch.device) -> Quadrature:
    """The rule in this precision; made once."""
    key = (build, size, dtype, device)
    held = _QUADRATURES.get(key)
    if held is None:
        rule = build(size)
        nodes, mean_weights, spread = (part.to(dtype=dtype, device=device) for part in rule[:3])
        held = rule._replace(nodes=nodes, mean_weights=mean_weights, covariance_weights=spread)
        if not torch.compiler.is_compiling():
            _QUADRATURES[key] = held
    return held


def taylor(about: Tensor | Sequence[float] | None = None) -> Taylor:
    """First-order Taylor rule; ``about`` fixes the point of expansion (d numbers), default the mean of the moment.

    Raises:
        ValueError: a point that is not finite or not a vector.
    """
    if about is None:
        return Taylor()
    point = torch.as_tensor(about)
    if point.dim() != 1 or not bool(torch.isfinite(point).all()):
        raise ValueError(f"about must be one finite point of d numbers, got {about}")
    return Taylor(tuple(point.tolist()))


@lru_cache(maxsize=32)
def unscented(alpha: float = 1.0, beta: float = 0.0, kappa: float | None = None) -> SigmaPoints:
    """Unscented transform with 2e + 1 points.

    The default (alpha 1, beta 0, kappa max(3 - e, 1)) keeps every weight positive. Small alpha makes the central weight
    negative; that is done by a Cholesky downdate, which can fail and then says so in the row's status. It also rounds
    the mean by eps |x| / alpha^2: in float32 keep alpha near 1.

    Raises:
        ValueError: alpha is not positive.

    Source: Julier, The scaled unscented transformation, ACC 2002.
    """
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, got {alpha}")

    def build(size: int) -> Quadrature:
        shape = max(3.0 - size, 1.0) if kappa is None else kappa
        reach = alpha**2 * (size + shape)
        if reach <= 0:
            raise ValueError(f"size + kappa must be positive, got {size} + {shape}")
        side = torch.full((2 * size,), 1 / (2 * reach), dtype=torch.float64)
        central = 1 - size / reach
        eye = torch.eye(size, dtype=torch.float64) * reach**0.5
        nodes = torch.cat([torch.zeros(1, size, dtype=torch.float64), eye, -eye])
        mean_weights = torch.cat([torch.tensor([central], dtype=torch.float64), side])
        central_spread = central + 1 - alpha**2 + beta
        spread = torch.cat([torch.tensor([central_spread], dtype=torch.float64), side])
        return Quadrature(nodes, mean_weights, spread, True, central_spread, central < 0, reach**0.5)

    return SigmaPoints("unscented", build, (unscented, (alpha, beta, kappa)))


@lru_cache(maxsize=1)
def cubature() -> SigmaPoints:
    """Third-degree spherical-radial cubature with 2e points. Source: Arasaratnam and Haykin, IEEE TAC 54 (2009)."""

    def build(size: int) -> Quadrature:
        eye = torch.eye(size, dtype=torch.float64) * size**0.5
        weights = torch.full((2 * size,), 0.5 / size, dtype=torch.float64)
        return Quadrature(torch.cat([eye, -eye]), weights, weights, True, reach=size**0.5)

    return SigmaPoints("cubature", build, (cubature, ()))


@lru_cache(maxsize=16)
def gauss_hermite(order: int = 3) -> SigmaPoints:
    """Product Gauss-Hermite rule with ``order ** e`` points, exact to degree 2 order - 1 in each axis.

    Raises:
        ValueError: order below 2, or more than 100,000 points.

    Source: Ito and Xiong, IEEE TAC 45 (2000).
    """
    if order < 2:
        raise ValueError(f"order must be at least 2, got {order}")

    def build(size: int) -> Quadrature:
        if order**size > 100_000:
            raise ValueError(f"{order} ** {size} points are too many; lower the order or take cubature()")
        # Eigenvalues of the Jacobi matrix of the probabilists' Hermite polynomials (Golub and Welsch).
        off = torch.arange(1, order, dtype=torch.float64).sqrt()
        nodes, vectors = torch.linalg.eigh(torch.diag(off, 1) + torch.diag(off, -1))
        weights = vectors[0].square()
        grid = torch.cartesian_prod(*[nodes] * size).reshape(-1, size)
        product = torch.cartesian_prod(*[weights] * size).reshape(-1, size).prod(-1)
        return Quadrature(grid, product, product, False)

    return SigmaPoints("gauss_hermite", build, (gauss_hermite, (order,)))


def law_space(law: object) -> Space:
    """Space of a law that gives a linear form: Euclidean unless it says otherwise."""
    return getattr(law, "space", EUCLIDEAN)


def check_transition_space(after: Space, before: Space) -> None:
    """Raise a ValueError where the state would leave its space."""
    if after != before and not type(after) is type(before) is Euclidean:
        raise ValueError(f"the transition law gives a state on {after!r}, the belief lives on {before!r}")


def predict(law: Law, belief: Gaussian, rule: Rule, u: Tensor | None, dt: Tensor | float | None) -> Gaussian:
    """Belief pushed through a transition law."""
    line = rule.linearize(law, belief, u, dt)
    check_transition_space(line.space, belief.space)
    if line.mean.shape[-1] != belief.mean.shape[-1]:
        raise ValueError(f"the transition law turns {belief.mean.shape[-1]} state numbers into {line.mean.shape[-1]}")
    factor = triangularize(cat_columns(line.slope, line.spread()))
    if line.negative is not None:
        factor = cholesky_downdate(factor, line.negative)
    return Gaussian(line.space.project(line.mean), factor, line.space)


class Update(NamedTuple):
    """What a measurement did: posterior, log-likelihood (...), innovation (..., e) and its factor, NIS (...).

    freedom: how many components were taken in, (...), or one number for all. accepted, gate_nis: of a gate, one entry a
    sensor, (..., sensors); None without one.
    """

    belief: Gaussian
    log_likelihood: Tensor
    innovation: Tensor
    innovation_scale_tril: Tensor
    nis: Tensor
    freedom: Tensor | int
    accepted: Tensor | None = None
    gate_nis: Tensor | None = None


class GateDecision(NamedTuple):
    """What a gate lets through.

    kept (..., e): components of the measurement that are taken in; accepted, nis (..., sensors); log_density (...):
    what the refused ones add to the log-likelihood.
    """

    kept: Tensor
    accepted: Tensor
    nis: Tensor
    log_density: Tensor


class GateRule(Protocol):
    """Decides about a measurement before it is taken in; `torchfilt.gates.Gate` is one."""

    def __call__(self, law: Any, line: Linearization, innovation: Tensor, observed: Tensor | None) -> GateDecision: ...


def update(
    law: Law,
    prior: Gaussian,
    y: Tensor,
    rule: Rule,
    missing: Missing = "rows",
    iterations: int = 1,
    u: Tensor | None = None,
    dt: Tensor | float | None = None,
    gate: GateRule | None = None,
) -> Update:
    """Belief given a measurement y (..., d_y), whose NaN components are marginalised exactly.

    Args:
        law: measurement law.
        prior: belief before the measurement.
        y: broadcasts with the leading dims of the belief.
        rule: how the law is linearised.
        missing: what is known of the NaNs: "none" there are none, "shared" all rows miss the same components (a factor
            that the rows share then stays shared), "rows" anything may be missing anywhere.
        iterations: above 1 the law is linearised again about the posterior: the iterated extended filter for `Taylor`,
            iterated posterior linearisation for quadratures.
        u, dt: control and time step of the motion that led here, for measurement laws that look at them.
        gate: decides, at the first linearisation, what of the measurement is taken in.

    A law may name components of its error that have no noise by construction, ``exact``, a tuple of indices. One whose
    predicted spread is zero to rounding is judged at the first linearisation, before the gate: where its residual is
    zero to rounding too it counts as not measured; where it is not, the log-likelihood is -inf.

    Source: Garcia-Fernandez, Svensson, Morelande, Särkkä, IEEE TSP 63 (2015), for the iterated form.
    """
    line = rule.linearize(law, prior, u, dt)
    if y.shape[-1] != line.mean.shape[-1]:
        raise ValueError(f"the measurement has {y.shape[-1]} numbers, the observation law gives {line.mean.shape[-1]}")
    observed, decision, exact = _observed(line.space, y, missing), None, None
    if getattr(law, "exact", ()):
        exact = _exact_rows(law, prior, line, y, observed, rule, u, dt)
        observed = exact.observed
    if gate is not None:
        decision = gate(law, line, _innovation(line, y, observed), observed)
        observed = decision.kept
    result = _condition(prior, line, None, y, observed)
    for _ in range(iterations - 1):
        line, back = _again(law, prior, result.belief, rule, u, dt, exact is not None)
        result = _condition(prior, line, back, y, observed)
    if exact is not None:
        result = _held(law, line, result, exact, y, u, dt)
    if decision is None:
        return result
    log_likelihood = result.log_likelihood + decision.log_density
    return result._replace(log_likelihood=log_likelihood, accepted=decision.accepted, gate_nis=decision.nis)


def _again(
    law: Law,
    prior: Gaussian,
    posterior: Gaussian,
    rule: Rule,
    u: Tensor | None,
    dt: Tensor | float | None,
    may_be_singular: bool = False,
) -> tuple[Linearization, Tensor]:
    """Linearised about the posterior, by the prior's whitened error; and what that says of the prior's own mean."""
    space = prior.space
    away = space.local(posterior.mean, prior.mean)
    columns = space.carry(-away, prior.factor())
    if isinstance(rule, Taylor):  # a derivative, which takes any columns: the way back is one more
        line = rule.linearize(law, posterior._replace(scale_tril=cat_columns(columns, away.unsqueeze(-1))), u, dt)
        return line._replace(slope=line.slope[..., :-1]), line.slope[..., -1]
    if may_be_singular:
        posterior = posterior._replace(scale_tril=filled(posterior.factor(), columns))
    line = rule.linearize(law, posterior, u, dt)
    # slope S_posterior^-1 is the law's Jacobian; carry it back to the prior's own factor and mean.
    jacobian = torch.linalg.solve_triangular(posterior.factor(), line.slope, upper=False, left=False)
    return line._replace(slope=jacobian @ columns), apply_factor(jacobian, away)


class _Exact(NamedTuple):
    """Exact rows of a measurement: components there and those still to be taken in (..., e), and for `keep_true`."""

    picked: tuple[int, ...]
    there: Tensor
    observed: Tensor
    verdict: Verdict
    rows: Tensor
    floor: Tensor


def _exact_rows(
    law: Any,
    prior: Gaussian,
    line: Linearization,
    y: Tensor,
    observed: Tensor | None,
    rule: Rule,
    u: Tensor | None,
    dt: Tensor | float | None,
) -> _Exact:
    """Judge the exact rows. All are thresholds and rounding: nothing here carries a derivative."""
    picked = list(law.exact)
    innovation = _innovation(line, y, observed)
    there = innovation.new_ones(innovation.shape[-1], dtype=torch.bool) if observed is None else observed
    present, residual = there[..., picked], innovation.detach()[..., picked]
    eps, root = torch.finfo(y.dtype).eps, prior.factor().detach()
    # Each row by one error of the state at a time, as large as the prior knows it: |J_i| |S_i|.
    size = root.norm(dim=-1)
    apart = Gaussian(prior.mean.detach(), torch.diag_embed(size), prior.space)
    slopes = _by_derivative(rule).linearize(law, apart, u, dt).slope.detach()[..., picked, :]
    magnitude = _magnitude(law, line, prior.mean.detach(), u, dt)[..., picked] + residual.abs()
    floor = SPREAD * eps * slopes.abs().sum(-1)
    differences = _differences(rule, prior)
    if differences > 0:
        floor = floor + 16 * eps * differences * magnitude
    top = cat_columns(line.slope, line.spread()).detach()[..., picked, :]
    verdict = examine(top, residual, present, floor, magnitude)
    member = torch.nn.functional.one_hot(torch.tensor(picked, device=y.device), there.shape[-1]).to(torch.bool)
    idle = (verdict.idle.unsqueeze(-1) & member).any(-2)
    rows = slopes / torch.where(size > 0, size, 1).unsqueeze(-2)
    return _Exact(law.exact, there, there & ~idle, verdict, rows, floor)


def _by_derivative(rule: Any) -> Rule:
    """The rule, or in place of a quadrature, whose slopes are rounded by what it is spread over, the derivative."""
    if isinstance(rule, SigmaPoints):
        return Taylor()
    inner = getattr(rule, "rule", None)
    return rule._replace(rule=Taylor()) if isinstance(inner, SigmaPoints) else rule


def _magnitude(law: Any, line: Linearization, x: Tensor, u: Tensor | None, dt: Tensor | float | None) -> Tensor:
    """Size of the terms that a predicted measurement is the sum of, (..., e): sum_i |dh/dx_i x_i| + |h|."""
    linear_form = getattr(law, "linear_form", None)
    if linear_form is not None:
        terms = for_points(linear_form(u, dt).matrix, 2, x.dim() - 1) * x.unsqueeze(-2)
    else:
        terms = _first_order(lambda *at: law(*at), x, torch.diag_embed(x), EUCLIDEAN, u, dt)[1]
    own = line.space.local(torch.zeros_like(line.mean), line.mean)  # an exact component is Euclidean: h itself
    return (terms.abs().sum(-1) + own.abs()).detach()


def _differences(rule: Any, prior: Gaussian) -> float:
    """How much a rule that takes differences of law values enlarges their rounding; 0 for derivatives."""
    rule = getattr(rule, "rule", rule)
    if not isinstance(rule, SigmaPoints):
        return 0.0
    reach = _quadrature(rule.build, prior.tangent_size, prior.mean.dtype, prior.mean.device).reach
    return max(1.0, 1 / reach) if reach > 0 else 1.0


def _held(
    law: Law,
    line: Linearization,
    result: Update,
    exact: _Exact,
    y: Tensor,
    u: Tensor | None,
    dt: Tensor | float | None,
) -> Update:
    """The posterior with its exact rows kept true to its own rounding, and impossible where they contradict it."""
    belief, verdict = result.belief, exact.verdict
    factor, mean = belief.factor(), belief.mean
    held, x = factor.detach(), mean.detach()
    left = _innovation(line._replace(mean=law(x, u, dt).mean.detach()), y, exact.there)[..., list(exact.picked)]
    left = torch.where(left.abs() <= verdict.limit, left, 0)
    kept, move = keep_true(held, exact.rows, left, exact.there[..., list(exact.picked)], exact.floor)
    # Only rounding is taken away: the derivative stays that of the update.
    mean = mean + (belief.space.retract(x, move) - x).detach()
    belief = Gaussian(mean, factor + (kept - held).detach(), belief.space)
    log_likelihood = torch.where(verdict.contradicted, -torch.inf, result.log_likelihood)
    return result._replace(belief=belief, log_likelihood=log_likelihood)


def _innovation(line: Linearization, y: Tensor, observed: Tensor | None) -> Tensor:
    """Error (..., e) from the expected measurement to y, zero where nothing was observed."""
    if observed is None:
        return line.space.local(line.mean, y)
    filled = torch.where(torch.isnan(y), line.mean, y)
    return torch.where(observed, line.space.local(line.mean, filled), 0)


def _observed(space: Space, y: Tensor, missing: Missing) -> Tensor | None:
    """Mask of the observed tangent components (..., e), (e,) where rows share it; None where nothing is missing."""
    if missing == "none":
        return None
    observed = space.observed(y)
    return observed.reshape(-1, observed.shape[-1])[0] if missing == "shared" else observed


def _condition(
    prior: Gaussian, line: Linearization, shift: Tensor | None, y: Tensor, observed: Tensor | None
) -> Update:
    """Square-root measurement update: one triangularisation gives innovation factor, gain and posterior factor.

    Source: Kailath, Sayed, Hassibi, Linear Estimation (2000), section 12.3, the array form.
    """
    top, negative = cat_columns(line.slope, line.spread()), line.negative
    innovation = _innovation(line, y, observed)
    if shift is not None:
        innovation = innovation - shift
    m = top.shape[-2]
    counted: Tensor | int = m
    if observed is not None:
        innovation = torch.where(observed, innovation, 0)
        top = mask_rows(top, observed)
        negative = None if negative is None else torch.where(observed, negative, 0)
        counted = observed.sum(-1).to(y.dtype)
    root = prior.factor()
    factor = triangularize(_stack_rows(top, root))
    if negative is not None:
        factor = cholesky_downdate(factor, torch.nn.functional.pad(negative, (0, root.shape[-1])))
    innovation_factor, gain, posterior_factor = factor[..., :m, :m], factor[..., m:, :m], factor[..., m:, m:]
    z = whiten(innovation_factor, innovation)
    nis = z.square().sum(-1)
    constant = -0.5 * LOG_2PI * counted - log_abs_diagonal(innovation_factor)
    log_likelihood = torch.sub(constant, nis, alpha=0.5)
    move = apply_factor(gain, z)
    mean = prior.space.retract(prior.mean, move)
    posterior_factor = transport(prior.space, move, posterior_factor)
    if observed is not None:  # rows without any measurement keep the prior to the bit
        seen = observed.any(-1)
        mean = torch.where(seen.unsqueeze(-1), mean, prior.mean)
        posterior_factor = torch.where(seen[..., None, None], posterior_factor, root)
    posterior = Gaussian(mean, posterior_factor, prior.space)
    return Update(posterior, log_likelihood, innovation, innovation_factor, nis, counted)


def _stack_rows(top: Tensor, root: Tensor) -> Tensor:
    """``[[top], [root, 0]]`` with leading dims broadcast."""
    bottom = torch.nn.functional.pad(root, (0, top.shape[-1] - root.shape[-1]))
    lead = torch.broadcast_shapes(top.shape[:-2], bottom.shape[:-2])
    return torch.cat([top.expand(*lead, *top.shape[-2:]), bottom.expand(*lead, *bottom.shape[-2:])], -2)
