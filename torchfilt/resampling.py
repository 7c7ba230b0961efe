"""Resamplers, from weights to ancestor indices: pure functions, because the uniforms come in as an argument."""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchfilt.particles import Particles
from torchfilt.spaces import steady_sum


@dataclass(frozen=True)
class Resampler:
    """A scheme with its policy.

    ancestors: maps weights (*batch, n) and uniforms (*batch, k) to indices (*batch, n), ascending; a scheme that also
    takes counts (*batch) and a width gives (*batch, width), of which each row's first ``counts`` are its ancestors.
    one_uniform: k is 1 instead of n. threshold: resample a row when its effective sample size is below this fraction
    of n; infinity means always, 0 never. size: how many particles a row needs; None for as many as before.
    """

    name: str
    ancestors: Callable[..., Tensor]
    one_uniform: bool = False
    threshold: float = float("inf")
    size: "KldSize | None" = None

    def uniforms(self, n: int) -> int:
        """How many uniforms a row needs."""
        return 1 if self.one_uniform else n

    def __call__(
        self, weights: Tensor, uniforms: Tensor, counts: Tensor | None = None, width: int | None = None
    ) -> Tensor:
        """Ancestor indices (*batch, n), ascending.

        Weights need not sum to one, but must be finite and not negative with a positive sum: of others the indices are
        in range and mean nothing, and it is for the caller to look.

        Args:
            weights: (*batch, n).
            uniforms: (*batch, k), k of `uniforms` for n or, if that is more, for the width.
            counts: (*batch) int64, how many ancestors each row gets; None for n.
            width: of the result (*batch, width), at least the largest count; what is beyond a row's own count is in
                range and means nothing.
        """
        return self.ancestors(weights, uniforms) if counts is None else self.ancestors(weights, uniforms, counts, width)


def _positions(weights: Tensor, counts: Tensor | None, width: int | None) -> tuple[Any, int]:
    """How many positions a row has, a number or (*batch, 1), and the width of the result."""
    n = weights.shape[-1]
    return (n, n) if counts is None or width is None else (counts.unsqueeze(-1), width)


def _up_to(values: Tensor, limit: Any) -> Tensor:
    """Values in [0, limit], in place; the limit a number or (*batch, 1)."""
    return values.clamp_(0, limit) if isinstance(limit, int) else values.clamp_(min=0).clamp_(max=limit)


def _counts_to_ancestors(ends: Tensor, width: int) -> Tensor:
    """Ancestor of each position from ``ends`` (*batch, n): how many positions lie below each cumulative weight.

    ancestor(i) = number of particles j < n - 1 with ends(j) <= i, a running sum of a histogram: O(n), no search.
    """
    n = ends.shape[-1]
    if ends.dim() == 1 and not torch.compiler.is_compiling():
        return torch.bincount(ends[:-1], minlength=width + 1)[:width].cumsum(0)
    rows = ends.numel() // n
    flat = ends[..., :-1].reshape(rows, n - 1)
    if torch.compiler.is_compiling():  # bincount has no static shape
        histogram = torch.zeros(rows, width + 1, dtype=torch.int64, device=ends.device)
        histogram = histogram.scatter_add(1, flat, torch.ones_like(flat))
    else:
        if rows > 1:
            flat = flat + torch.arange(rows, device=ends.device).unsqueeze(-1) * (width + 1)
        histogram = torch.bincount(flat.reshape(-1), minlength=rows * (width + 1)).view(rows, width + 1)
    return histogram[:, :width].cumsum(-1).view(*ends.shape[:-1], width)


def _ordered(weights: Tensor, many: Any, width: int, positions_below: Callable[[Tensor], Tensor]) -> Tensor:
    cumulative = weights.cumsum(-1, dtype=torch.float64)
    cumulative *= many / cumulative[..., -1:]
    return _counts_to_ancestors(_up_to(positions_below(cumulative), many), width)


def _systematic(weights: Tensor, u: Tensor, counts: Tensor | None = None, width: int | None = None) -> Tensor:
    # Positions (i + u) below c: i < c - u.
    many, wide = _positions(weights, counts, width)
    if weights.dim() == 1 and not torch.compiler.is_compiling():  # one row: the same numbers with fewer calls
        ends = weights.cumsum(0, dtype=torch.float64)
        ends = _up_to(ends.mul_(many / ends[-1]).sub_(u).ceil_(), many)
        return torch.bincount(ends[:-1].long(), minlength=wide + 1)[:wide].cumsum(0)
    return _ordered(weights, many, wide, lambda c: c.sub_(u).ceil_().long())


def _stratified(weights: Tensor, u: Tensor, counts: Tensor | None = None, width: int | None = None) -> Tensor:
    # Position i + u_i lies below c for every i < floor(c), and for i = floor(c) when u_i is below the fraction.
    many, wide = _positions(weights, counts, width)

    def below(c: Tensor) -> Tensor:
        whole = _up_to(c.floor().long(), many)
        inside = whole.clamp_max(many - 1)
        return whole + (u.gather(-1, inside) < c - whole).long()

    return _ordered(weights, many, wide, below)


def _multinomial(weights: Tensor, u: Tensor, counts: Tensor | None = None, width: int | None = None) -> Tensor:
    # Sorted uniforms from sums of exponentials are not needed: sorting n numbers is cheap beside the model.
    n = weights.shape[-1]
    cumulative = weights.to(torch.float64).cumsum(-1)
    if counts is not None:  # what a row does not use goes to the end
        u = u[..., :width]
        u = torch.where(torch.arange(u.shape[-1], device=u.device) < counts.unsqueeze(-1), u, 1.0)
    sorted_u = u.sort(-1).values * cumulative[..., -1:]
    return torch.searchsorted(cumulative.contiguous(), sorted_u.contiguous(), right=True).clamp_max(n - 1)


def _residual(weights: Tensor, u: Tensor, counts: Tensor | None = None, width: int | None = None) -> Tensor:
    """Whole copies first, the rest drawn from the fractional parts."""
    n = weights.shape[-1]
    many, wide = _positions(weights, counts, width)
    u = u[..., :wide]
    scaled = weights.to(torch.float64)
    scaled = scaled * (many / steady_sum(scaled, -1).unsqueeze(-1))
    # Rounding must not turn a whole copy into a draw: equal weights give n ones, and 49 * (1 / 49) is below one.
    copies = (scaled * (1 + 64 * torch.finfo(scaled.dtype).eps)).floor()
    fraction = (scaled - copies).clamp_min(0)
    kept = copies.sum(-1, keepdim=True)
    # The first n - kept uniforms are used; the rest draw as well, and count for nothing.
    index = torch.arange(wide, device=weights.device)
    cumulative = fraction.cumsum(-1)
    total = cumulative[..., -1:]
    picks = torch.searchsorted(cumulative.contiguous(), (u * total).contiguous(), right=True).clamp_max(n - 1)
    used = (index < many - kept).to(torch.float64)
    total_copies = copies.scatter_add(-1, picks, used)
    return _counts_to_ancestors(_up_to(total_copies.cumsum(-1).round().long(), many), wide)


systematic = Resampler("systematic", _systematic, one_uniform=True)
stratified = Resampler("stratified", _stratified)
multinomial = Resampler("multinomial", _multinomial)
residual = Resampler("residual", _residual)


def ess_below(fraction: float, resampler: Resampler = systematic) -> Resampler:
    """The same scheme, used only for rows whose effective sample size is below ``fraction`` of n.

    Raises:
        ValueError: fraction outside [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"fraction must be in [0, 1], got {fraction}")
    return replace(resampler, threshold=fraction)


def never() -> Resampler:
    """No resampling at all: plain sequential importance sampling."""
    return ess_below(0.0)


def kld_bound(bins: Tensor, epsilon: float = 0.05, delta: float = 0.01) -> Tensor:
    """Particles with which a sampled histogram is within ``epsilon`` of the truth, with probability 1 - ``delta``.

    Args:
        bins: how many bins have support, any shape.
        epsilon: largest Kullback-Leibler divergence of the histogram from the distribution it is drawn of.
        delta: probability of being further away.

    Returns:
        The quantile of chi-square with bins - 1 degrees of freedom by Wilson and Hilferty, over 2 epsilon: float64, 0
        for a single bin.

    Source: Fox, Adapting the sample size in particle filters through KLD-sampling, IJRR 22 (2003), equation 7.
    """
    freedom = (bins - 1).clamp_min(1).to(torch.float64)
    part = 2 / (9 * freedom)
    deviations = torch.special.ndtri(part.new_full((), 1 - delta))
    quantile = freedom * (1 - part + part.sqrt() * deviations) ** 3
    return torch.where(bins > 1, quantile / (2 * epsilon), 0)


@dataclass(frozen=True)
class KldSize:
    """How many particles a row needs, by the bins that its weighted cloud occupies; see `kld_adaptive`."""

    bin_widths: float | tuple[float, ...]
    epsilon: float
    delta: float
    minimum: int

    def __call__(self, particles: Particles, weights: Tensor, maximum: int) -> Tensor:
        """Counts (*batch), int64, from ``minimum`` to ``maximum``; no random numbers enter.

        Args:
            particles: x (*batch, n, d).
            weights: (*batch, n), which need not be those of the particles.
            maximum: the most.
        """
        bound = kld_bound(self.bins(particles, weights, maximum), self.epsilon, self.delta)
        return bound.ceil().clamp(self.minimum, maximum).long()

    def bins(self, particles: Particles, weights: Tensor, positions: int) -> Tensor:
        """How many bins (*batch) hold one of so many evenly spaced positions on the cumulative weights.

        Those are the bins that ``positions`` particles would be drawn in; the draw itself must not decide, or the
        evidence would be biased.
        """
        many = torch.full(weights.shape[:-1], positions, device=weights.device)
        middle = torch.full((), 0.5, dtype=torch.float64, device=weights.device)
        reached = _systematic(weights, middle.expand(*weights.shape[:-1], 1), many, positions)
        key = self._keys(particles, weights)
        chosen = torch.zeros_like(key, dtype=torch.bool).scatter(-1, reached, True)
        key = torch.where(chosen, key, key.gather(-1, reached[..., :1]))
        return 1 + (key.sort(-1).values.diff(dim=-1) != 0).sum(-1)

    def _keys(self, particles: Particles, weights: Tensor) -> Tensor:
        """One number a bin: places on a grid around the heaviest particle, read as digits.

        Where there are more bins in the box around the cloud than int64 has numbers, the product wraps, and two bins
        are one with a probability of about 2^-64.
        """
        heaviest = weights.argmax(-1, keepdim=True).unsqueeze(-1)
        centre = particles.x.gather(-2, heaviest.expand(*heaviest.shape[:-1], particles.x.shape[-1]))
        error = particles.space.local(centre, particles.x)
        key = torch.zeros(weights.shape, dtype=torch.int64, device=weights.device)
        widths = self.bin_widths
        for k, width in enumerate(widths if isinstance(widths, tuple) else (widths,) * error.shape[-1]):
            if width < math.inf:
                place = (error[..., k] / width + 0.5).floor().long()
                place = place - place.amin(-1, keepdim=True)
                key = key * (place.amax(-1, keepdim=True) + 1) + place
        return key


def kld_adaptive(
    bin_widths: float | Sequence[float] | Tensor,
    epsilon: float = 0.05,
    delta: float = 0.01,
    minimum: int = 50,
    resampler: Resampler = systematic,
) -> Resampler:
    """The same scheme with as many particles as the cloud's spread asks for; the filter's own number is the maximum.

    At a resampling each row gets so many particles that their histogram over the bins would be within ``epsilon`` of
    the weighted cloud's own, in Kullback-Leibler divergence, with probability 1 - ``delta``. Tensors shrink and grow
    to the largest count of the batch; what is beyond a row's own count has log-weight -inf. The number depends on the
    cloud before the motion and not on the draw: the evidence stays unbiased. Goes with `ess_below`, whose n is then a
    row's own count; moves and kernels need a fixed number.

    Args:
        bin_widths: of each error component, in its own unit, or one for all; infinity leaves a component out.
        epsilon, delta: see `kld_bound`.
        minimum: the fewest particles of a row.
        resampler: scheme and policy.

    Raises:
        TypeError: a resampler that can't give another number of particles.
        ValueError: widths that are not positive or all infinite, epsilon not positive, delta outside (0, 1), minimum
            below 2.

    Sources: Fox, Adapting the sample size in particle filters through KLD-sampling, IJRR 22 (2003); Li, Sun, Sattar,
        Adapting sample size in particle filters through KLD-resampling, Electronics Letters 49 (2013).
    """
    listed = torch.as_tensor(bin_widths, dtype=torch.float64)
    widths = tuple(listed.reshape(-1).tolist())
    if listed.dim() > 1 or not widths or not all(width > 0 for width in widths) or min(widths) == math.inf:
        raise ValueError(f"bin_widths must be positive, one or one a component, and not all infinite, got {widths}")
    if not 0 < epsilon < math.inf:
        raise ValueError(f"epsilon must be positive, got {epsilon}")
    if not 0 < delta < 1:
        raise ValueError(f"delta must be in (0, 1), got {delta}")
    if minimum < 2:
        raise ValueError(f"minimum must be at least 2, got {minimum}")
    if len(inspect.signature(resampler.ancestors).parameters) < 4:
        raise TypeError(f"the scheme {resampler.name!r} must take counts and a width to give another number of them")
    return replace(resampler, size=KldSize(widths[0] if listed.dim() == 0 else widths, epsilon, delta, minimum))


def by_component(particles: Particles) -> Particles:
    """The same particles, component by component in memory: the order that `gather_particles` leaves.

    Sums and products round by the order in memory, so a cloud that was just read from a file, or one whose neighbours
    in the batch were resampled, must lie as any other does.
    """
    x = particles.x.movedim(-1, 0).contiguous().movedim(0, -1)
    factor = particles.scale_tril
    if factor is not None:
        factor = factor.movedim((-2, -1), (0, 1)).contiguous().movedim((0, 1), (-2, -1))
    return particles._replace(x=x, scale_tril=factor)


def gather_particles(values: Tensor, ancestors: Tensor) -> Tensor:
    """Rows ``ancestors`` (*batch, m) of values (*batch, n, *rest) along n, copied component by component in memory.

    Along the last dim of memory a gather with one index for all components is five times faster than `index_select` in
    double precision; in single both are as fast, and `index_select` takes fewer calls.
    """
    if ancestors.dim() == 1 and values.dim() == 2 and values.element_size() == 4:
        return values.mT.index_select(-1, ancestors).mT
    dims = tuple(range(ancestors.dim(), values.dim()))
    front = tuple(range(len(dims)))
    by_component = values.movedim(dims, front)
    picked = by_component.gather(-1, ancestors.expand(*by_component.shape[: len(dims)], *ancestors.shape))
    return picked.movedim(front, dims)
