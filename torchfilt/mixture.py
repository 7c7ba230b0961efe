"""Mixtures of Gaussians: a wide Gaussian split into narrow ones, many merged into few, laws that are one of several.

The value is `Particles` with a factor for each particle: components x with log-weights and covariances, on any space.
A component's covariance seen from another point is carried there, as `Particles.moments` does.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from torchfilt.gaussian import Gaussian
from torchfilt.laws import call_style, check_factor, check_finite, hold
from torchfilt.linalg import apply_factor, for_points, triangularize
from torchfilt.particles import Particles
from torchfilt.spaces import Euclidean, Space, centred, transport

__all__ = ["InitialMixture", "MixtureLaw", "check_probabilities", "factors_of", "merge", "reduce", "split_gaussian"]


# ----------------------------------------------------------------------------------------------------------------------
# From many to few


def merge(mixture: Particles) -> Gaussian:
    """The Gaussian (*batch) with mean and covariance of a mixture of components x (*batch, n, d).

    One triangularisation of the errors' and the components' own columns: nothing is squared.

    Raises:
        ValueError: particles without covariances.
    """
    factor, space, weights = factors_of(mixture), mixture.space, mixture.weights
    mean, errors = centred(space, mixture.x, weights)
    root = _root(weights).unsqueeze(-1)
    own = space.carry_back(errors, factor).expand(*errors.shape, -1) * root.unsqueeze(-1)
    columns = torch.cat([(errors * root).mT, own.movedim(-3, -2).flatten(-2)], -1)
    return Gaussian(mean, triangularize(columns), space)


def reduce(mixture: Particles, count: int) -> Particles:
    """Merge pairs until ``count`` components are left; mean and covariance of the mixture stay what they are.

    That is exact on flat spaces; on curved ones a pair is merged in the tangent space at its own mean.

    The next pair is the one of the smallest B = (w_ij log|P_ij| - w_i log|P_i| - w_j log|P_j|) / 2, an upper bound on
    what its merger changes, in Kullback-Leibler divergence. Each row chooses its own pairs; no shape depends on
    numbers. The work is n^2 determinants of e x e at first, and n for each merger.

    Args:
        mixture: components x (*batch, n, d) with factors.
        count: how many are left at most; a mixture that has no more comes back as it is.

    Raises:
        ValueError: a count below 1, particles without covariances.

    Source: Runnalls, Kullback-Leibler approach to Gaussian mixture reduction, IEEE TAES 43 (2007), equation 21.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    factor, space, n = factors_of(mixture), mixture.space, mixture.x.shape[-2]
    if n <= count:
        return mixture
    factor = factor.expand(*mixture.x.shape[:-1], *factor.shape[-2:])
    mixture = mixture._replace(scale_tril=factor, held=None, centre=None)
    scale = _deviations(mixture)
    alive = torch.ones_like(mixture.log_weights, dtype=torch.bool)
    places = torch.arange(n, device=factor.device)
    ahead = torch.ones((n, n), dtype=torch.bool, device=factor.device).triu(1)  # each pair once
    cost = _bound(_ranked(mixture, -2), _ranked(mixture, -3), space, scale.unsqueeze(-2).unsqueeze(-2))
    for _ in range(n - count):
        pairs = ahead & alive.unsqueeze(-1) & alive.unsqueeze(-2)
        best = torch.where(pairs, cost, math.inf).flatten(-2).argmin(-1, keepdim=True)
        first, second = best // n, best % n
        into, gone = places == first, places == second
        alive = alive & ~gone
        pair = _pick(mixture, torch.cat([first, second], -1))
        weight = torch.logaddexp(*pair.log_weights.split(1, -1))
        one = merge(pair._replace(log_weights=_shares(pair.log_weights)))
        factor = torch.where(into[..., None, None], one.scale_tril.unsqueeze(-3), factor)
        mixture = mixture._replace(
            x=torch.where(into.unsqueeze(-1), one.mean.unsqueeze(-2), mixture.x),
            scale_tril=factor,
            log_weights=torch.where(into, weight, mixture.log_weights.masked_fill(gone, -math.inf)),
        )
        merged = Particles(one.mean.unsqueeze(-2), weight, one.scale_tril.unsqueeze(-3), space)
        fresh = _bound(_ranked(merged), _ranked(mixture), space, scale.unsqueeze(-2))
        cost = torch.where(into.unsqueeze(-1), fresh.unsqueeze(-2), cost)
        cost = torch.where(into.unsqueeze(-2), fresh.unsqueeze(-1), cost)
    kept = (~alive).to(torch.int8).argsort(stable=True, dim=-1)[..., :count]
    return _pick(mixture, kept)


class _Ranked(NamedTuple):
    """Centres (..., d), factors (..., e, e) and weights (...) that only choose: they are not differentiated."""

    x: Tensor
    factor: Tensor
    weights: Tensor


def _ranked(mixture: Particles, partners: int | None = None) -> _Ranked:
    """A mixture's components, with an axis of partners after (-2) or before (-3) that of the components if asked."""
    assert mixture.scale_tril is not None
    parts = _Ranked(mixture.x.detach(), mixture.scale_tril.detach(), mixture.log_weights.detach().exp())
    if partners is None:
        return parts
    return _Ranked(
        parts.x.unsqueeze(partners), parts.factor.unsqueeze(partners - 1), parts.weights.unsqueeze(partners + 1)
    )


def _bound(one: _Ranked, other: _Ranked, space: Space, scale: Tensor) -> Tensor:
    """Runnalls' B of each pair (...), in tangent components divided by ``scale`` (..., e)."""
    apart = space.local(one.x, other.x)
    whole = one.weights + other.weights
    share = torch.where(whole > 0, other.weights / torch.where(whole > 0, whole, 1), 0.5)
    scaled = (factor / scale.unsqueeze(-1) for factor in (one.factor, space.carry_back(apart, other.factor)))
    own, theirs = (factor @ factor.mT for factor in scaled)
    apart = apart / scale
    between = (share * (1 - share))[..., None, None] * apart.unsqueeze(-1) * apart.unsqueeze(-2)
    share = share[..., None, None]
    merged = (1 - share) * own + share * theirs + between
    return 0.5 * (whole * _log_det(merged) - one.weights * _log_det(own) - other.weights * _log_det(theirs))


def _log_det(covariance: Tensor) -> Tensor:
    """Of scaled covariances that may be singular: a rounding's worth of the identity lets those be ranked as well."""
    size = covariance.shape[-1]
    least = 64 * size * torch.finfo(covariance.dtype).eps
    floor = least * torch.eye(size, dtype=covariance.dtype, device=covariance.device)
    factor = torch.linalg.cholesky_ex(covariance + floor)[0]
    return 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _deviations(mixture: Particles) -> Tensor:
    """Standard deviations (*batch, e) that components have on average; 1 where none has any."""
    assert mixture.scale_tril is not None
    variance = (mixture.scale_tril.detach().square().sum(-1) * mixture.weights.detach().unsqueeze(-1)).sum(-2)
    return torch.where(variance > 0, variance, 1).sqrt()


def _shares(log_weights: Tensor) -> Tensor:
    """Log-weights (..., 2) of a pair among themselves; equal where neither has any."""
    none = torch.isinf(log_weights).all(-1, keepdim=True)
    return torch.log_softmax(torch.where(none, 0, log_weights), -1)


def _pick(mixture: Particles, index: Tensor) -> Particles:
    """Components (*batch, k) of a mixture whose factors are one a component."""
    assert mixture.scale_tril is not None
    return mixture._replace(
        x=torch.take_along_dim(mixture.x, index.unsqueeze(-1), -2),
        log_weights=torch.take_along_dim(mixture.log_weights, index, -1),
        scale_tril=torch.take_along_dim(mixture.scale_tril, index[..., None, None], -3),
    )


def _root(weights: Tensor) -> Tensor:
    """Square root whose derivative at zero is zero: a component without weight has none."""
    present = weights > 0
    return torch.where(present, torch.where(present, weights, 1).sqrt(), weights)


def factors_of(mixture: Particles) -> Tensor:
    """Factors (*batch, n or 1, e, e) of the components.

    Raises:
        ValueError: points without covariances.
    """
    if mixture.scale_tril is None:
        raise ValueError("a mixture of Gaussians needs a factor for its components, these particles are points")
    return mixture.scale_tril


# ----------------------------------------------------------------------------------------------------------------------
# From one to many


def split_gaussian(
    gaussian: Gaussian, count: int, axis: int, *, reach: float | None = None, width: float = 0.6
) -> Particles:
    """A wide Gaussian as ``count`` Gaussians in a row along one error component.

    Centres are evenly spaced along the regression of all components on component ``axis``; each member keeps what that
    component does not explain, and of it a deviation of ``width`` cells (at 0.6 the sum of equal members ripples by
    0.2 %). Weights fall off as a normal density whose spread is chosen such that mean and covariance of the mixture are
    those of the Gaussian: exactly, in the tangent space at its mean. On a curved space each member's covariance is
    carried to its centre.

    Args:
        gaussian: mean (*batch, d).
        count: members, 1 or at least 3; with one the Gaussian itself is the mixture.
        axis: which tangent component, -e to e - 1; its variance is not zero.
        reach: half-length of the row in standard deviations of the component; default 3, or 0.6 count if that is less.
        width: standard deviation of a member along the component, in cells of 2 reach / count.

    Returns:
        Mixture with x (*batch, count, d).

    Raises:
        ValueError: arguments out of range; a row too short, or members too wide, for the spread of the Gaussian.
    """
    size = gaussian.tangent_size
    if count < 1 or count == 2:
        raise ValueError(f"count must be 1 or at least 3, got {count}")
    if not -size <= axis < size:
        raise ValueError(f"axis must be from {-size} to {size - 1}, got {axis}")
    factor, mean, space = gaussian.factor(), gaussian.mean, gaussian.space
    if count == 1:
        return Particles(mean.unsqueeze(-2), torch.zeros_like(mean[..., :1]), factor.unsqueeze(-3), space)
    centres, weights, spread = _row(count, min(3.0, 0.6 * count) if reach is None else reach, width)
    # Of x = S e the unit vector u of e alone moves component ``axis``: S (I - (1 - spread) u u') shrinks along it.
    row = factor[..., axis, :]
    deviation = torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    if not (deviation.detach() > 0).all():
        raise ValueError(f"component {axis} must have a variance above zero to be split along")
    unit = row / deviation
    along = apply_factor(factor, unit) if factor.dim() == 2 else (factor @ unit.unsqueeze(-1)).squeeze(-1)
    offsets = mean.new_tensor(centres).unsqueeze(-1) * along.unsqueeze(-2)
    own = triangularize(factor - (1 - spread) * along.unsqueeze(-1) * unit.unsqueeze(-2)).unsqueeze(-3)
    x = space.retract(mean.unsqueeze(-2), offsets)
    return Particles(x, mean.new_tensor(weights).log().expand(x.shape[:-1]), transport(space, offsets, own), space)


def _row(count: int, reach: float, width: float) -> tuple[list[float], list[float], float]:
    """Centres, weights and deviation of members whose mixture has mean 0 and variance 1.

    The variance of the centres falls as the weights concentrate: bisection for the one that is left to them.
    """
    if not 0 < reach < math.inf or not 0 < width < math.inf:
        raise ValueError(f"reach and width must be positive, got {reach} and {width}")
    cell = 2 * reach / count
    spread, centres = width * cell, [(k + 0.5) * cell - reach for k in range(count)]

    def weigh(precision: float) -> tuple[list[float], float]:
        nearest = min(abs(c) for c in centres)
        raw = [math.exp(-0.5 * precision * (c * c - nearest * nearest)) for c in centres]
        weights = [value / sum(raw) for value in raw]
        return weights, sum(w * c * c for w, c in zip(weights, centres, strict=True))

    wanted, low, high = 1 - spread**2, 0.0, 1e3 / cell**2
    if not weigh(high)[1] < wanted < weigh(low)[1]:
        raise ValueError(
            f"{count} members over {reach} deviations to either side, each {width} cells wide, can't have the variance "
            "of the whole: take another reach or width, or more members"
        )
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if weigh(middle)[1] > wanted else (low, middle)
    return centres, weigh(0.5 * (low + high))[0], spread


# ----------------------------------------------------------------------------------------------------------------------
# Laws


class InitialMixture(nn.Module):
    """An initial law that is a mixture of Gaussians, on any space.

    Called, it gives the Gaussian with its mean and covariance, from which filters set out that carry one Gaussian or
    draw points; `GaussianSumFilter` takes the `mixture` itself.

    Args:
        mixture: x (*batch, n, d), normalised log-weights (*batch, n), factors (*batch, n or 1, e, e).

    Raises:
        TypeError: not `Particles`.
        ValueError: points without covariances, shapes that do not fit, numbers that are not finite, weights that do not
            sum to one.
    """

    x: Tensor
    log_weights: Tensor
    scale_tril: Tensor

    def __init__(self, mixture: Particles) -> None:
        super().__init__()
        if not isinstance(mixture, Particles):
            raise TypeError(f"mixture must be Particles with factors, got {type(mixture).__name__}")
        factor, lead = factors_of(mixture), mixture.x.shape[:-1]
        check_finite(mixture.x, "x")
        check_factor(factor, "scale_tril")
        check_probabilities(mixture.log_weights.exp(), "weights")
        size = mixture.space.tangent_size if mixture.space.tangent_size is not None else mixture.x.shape[-1]
        members = factor.shape[:-2] in (lead, (*lead[:-1], 1), lead[-1:], (1,))
        if mixture.log_weights.shape != lead or not members or factor.shape[-1] != size:
            raise ValueError(
                f"a mixture has x (*batch, n, d), log_weights (*batch, n) and factors (*batch, n or 1, e, e), got "
                f"{tuple(mixture.x.shape)}, {tuple(mixture.log_weights.shape)} and {tuple(factor.shape)}"
            )
        for name, tensor in (("x", mixture.x), ("log_weights", mixture.log_weights), ("scale_tril", factor)):
            hold(self, name, tensor)
        self.space = mixture.space

    def mixture(self) -> Particles:
        """The mixture."""
        return Particles(self.x, self.log_weights, self.scale_tril, self.space)

    def forward(self) -> Gaussian:
        """The Gaussian with its moments."""
        return merge(self.mixture())


class MixtureLaw(nn.Module):
    """A conditional law that is one of several, by chance: noise with outliers, a push that may come or not.

    `GaussianSumFilter` follows each of them; other filters get a `MixtureSameFamily`, Gaussian filters of it the
    moments. Where all laws are `Sensors` of the same names, sizes and constraints, measurements may come by name.

    Args:
        laws: k laws of a transition or of a measurement, each giving a `Gaussian`; short cuts that they offer are used.
        weights: their probabilities (k,).

    Raises:
        TypeError: a law that can't be called; when called, one that gives no `Gaussian` on a Euclidean space.
        ValueError: fewer than two laws, another number of weights, weights that are no probabilities.
    """

    weights: Tensor

    def __init__(self, laws: Sequence[Callable[..., Gaussian]], weights: Tensor | Sequence[float]) -> None:
        super().__init__()
        laws = list(laws)
        if len(laws) < 2:
            raise ValueError(f"a mixture needs two laws or more, got {len(laws)}")
        for law in laws:
            if not callable(law):
                raise TypeError(f"a law is called as law(x) or law(x, u, dt), got {type(law).__name__}")
        given = weights if isinstance(weights, Tensor) else torch.tensor(weights, dtype=torch.float64)
        if given.shape != (len(laws),):
            raise ValueError(f"weights must be ({len(laws)},), one a law, got {tuple(given.shape)}")
        check_probabilities(given, "weights")
        hold(self, "weights", given)
        self.laws = laws
        for k, law in enumerate(laws):  # so that they move and train with the mixture
            if isinstance(law, nn.Module):
                self.add_module(f"law_{k}", law)
        self._styles = [call_style(law) for law in laws]
        first: Any = laws[0]
        if hasattr(first, "pack") and all(_same_sensors(first, law, given) for law in laws[1:]):
            self.names, self.columns, self.parts, self.pack = first.names, first.columns, first.parts, first.pack

    @property
    def takes_controls(self) -> bool:
        """Whether one of the laws has a place for a control u."""
        return any(
            getattr(law, "takes_controls", style.takes_u) for law, style in zip(self.laws, self._styles, strict=True)
        )

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> MixtureSameFamily:
        """Law given x (..., d)."""
        parts = [style.call(law, x, u, dt) for law, style in zip(self.laws, self._styles, strict=True)]
        for part in parts:
            if not isinstance(part, Gaussian) or not isinstance(part.space, Euclidean):
                kind = f"one on {part.space!r}" if isinstance(part, Gaussian) else type(part).__name__
                raise TypeError(f"only Gaussians on a Euclidean space make a MixtureSameFamily, got {kind}")
        lead = x.shape[:-1]
        mean = torch.stack([part.mean.expand(*lead, -1) for part in parts], -2)
        factor = torch.stack([for_points(part.factor(), 2, len(lead)).expand(*lead, -1, -1) for part in parts], -3)
        components = MultivariateNormal(mean, scale_tril=factor, validate_args=False)
        chances = Categorical(probs=self.weights.to(mean.dtype).expand(mean.shape[:-1]), validate_args=False)
        return MixtureSameFamily(chances, components, validate_args=False)


def _same_sensors(one: Any, other: Any, like: Tensor) -> bool:
    """Whether both are `torchfilt.Sensors` for which a measurement by name is the same tensor."""
    if not hasattr(other, "pack") or (one.names, one.sizes, one.parts) != (other.names, other.sizes, other.parts):
        return False
    # Where no sensor says anything, what is there are the values of constraints.
    silent, also = (law.pack({}, (), like.detach()) for law in (one, other))
    return torch.allclose(silent, also, rtol=0, atol=0, equal_nan=True)


def check_probabilities(values: Tensor, name: str) -> None:
    """Raise a ValueError unless the last dim of (..., k) holds probabilities: finite, none negative, sum one."""
    check_finite(values, name)
    given = values.detach()
    if (given < 0).any():
        raise ValueError(f"{name} must not be negative, got {given.min().item():.6g}")
    total = given.sum(-1)
    away = (total - 1).abs()
    if (away > 64 * torch.finfo(given.dtype).eps * given.shape[-1]).any():
        raise ValueError(f"{name} must sum to one, they sum to {total.flatten()[away.argmax()].item():.9g}")
