"""Resamplers, from weights to ancestor indices: pure functions, because the uniforms come in as an argument."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilt.particles import Particles
from torchfilt.spaces import steady_sum


@dataclass(frozen=True)
class Resampler:
    """A scheme with its policy.

    ancestors: maps weights (*batch, n) and uniforms (*batch, k) to indices (*batch, n), ascending.
    one_uniform: k is 1 instead of n. threshold: resample a row when its effective sample size is below this fraction
    of n; infinity means always, 0 never.
    """

    name: str
    ancestors: Callable[[Tensor, Tensor], Tensor]
    one_uniform: bool = False
    threshold: float = float("inf")

    def uniforms(self, n: int) -> int:
        """How many uniforms a row needs."""
        return 1 if self.one_uniform else n

    def __call__(self, weights: Tensor, uniforms: Tensor) -> Tensor:
        """Ancestor indices (*batch, n), ascending.

        Weights need not sum to one, but must be finite and not negative with a positive sum: of others the indices are
        in range and mean nothing, and it is for the caller to look.
        """
        return self.ancestors(weights, uniforms)


def _counts_to_ancestors(ends: Tensor) -> Tensor:
    """Ancestor of each of n positions from ``ends`` (*batch, n): how many positions lie below each cumulative weight.

    ancestor(i) = number of particles j < n - 1 with ends(j) <= i, a running sum of a histogram: O(n), no search.
    """
    n = ends.shape[-1]
    if ends.dim() == 1 and not torch.compiler.is_compiling():
        return torch.bincount(ends[:-1], minlength=n + 1)[:n].cumsum(0)
    rows = ends.numel() // n
    flat = ends[..., :-1].reshape(rows, n - 1)
    if torch.compiler.is_compiling():  # bincount has no static shape
        histogram = torch.zeros(rows, n + 1, dtype=torch.int64, device=ends.device)
        histogram = histogram.scatter_add(1, flat, torch.ones_like(flat))
    else:
        if rows > 1:
            flat = flat + torch.arange(rows, device=ends.device).unsqueeze(-1) * (n + 1)
        histogram = torch.bincount(flat.reshape(-1), minlength=rows * (n + 1)).view(rows, n + 1)
    return histogram[:, :n].cumsum(-1).view(ends.shape)


def _ordered(weights: Tensor, positions_below: Callable[[Tensor, int], Tensor]) -> Tensor:
    n = weights.shape[-1]
    cumulative = weights.cumsum(-1, dtype=torch.float64)
    cumulative *= n / cumulative[..., -1:]
    return _counts_to_ancestors(positions_below(cumulative, n).clamp_(0, n))


def _systematic(weights: Tensor, u: Tensor) -> Tensor:
    # Positions (i + u) below c: i < c - u.
    if weights.dim() == 1 and not torch.compiler.is_compiling():  # one row: the same numbers with fewer calls
        n = len(weights)
        ends = weights.cumsum(0, dtype=torch.float64)
        ends = ends.mul_(n / ends[-1]).sub_(u).ceil_().clamp_(0, n)
        return torch.bincount(ends[:-1].long(), minlength=n + 1)[:n].cumsum(0)
    return _ordered(weights, lambda c, n: c.sub_(u).ceil_().long())


def _stratified(weights: Tensor, u: Tensor) -> Tensor:
    # Position i + u_i lies below c for every i < floor(c), and for i = floor(c) when u_i is below the fraction.
    def below(c: Tensor, n: int) -> Tensor:
        whole = c.floor().long().clamp_(0, n)
        inside = whole.clamp_max(n - 1)
        return whole + (u.gather(-1, inside) < c - whole).long()

    return _ordered(weights, below)


def _multinomial(weights: Tensor, u: Tensor) -> Tensor:
    # Sorted uniforms from sums of exponentials are not needed: sorting n numbers is cheap beside the model.
    n = weights.shape[-1]
    cumulative = weights.to(torch.float64).cumsum(-1)
    sorted_u = u.sort(-1).values * cumulative[..., -1:]
    return torch.searchsorted(cumulative.contiguous(), sorted_u.contiguous(), right=True).clamp_max(n - 1)


def _residual(weights: Tensor, u: Tensor) -> Tensor:
    """Whole copies first, the rest drawn from the fractional parts."""
    n = weights.shape[-1]
    scaled = weights.to(torch.float64)
    scaled = scaled * (n / steady_sum(scaled, -1).unsqueeze(-1))
    # Rounding must not turn a whole copy into a draw: equal weights give n ones, and 49 * (1 / 49) is below one.
    copies = (scaled * (1 + 64 * torch.finfo(scaled.dtype).eps)).floor()
    fraction = (scaled - copies).clamp_min(0)
    kept = copies.sum(-1, keepdim=True)
    # The first n - kept uniforms are used; the rest draw as well, and count for nothing.
    index = torch.arange(n, device=weights.device)
    cumulative = fraction.cumsum(-1)
    total = cumulative[..., -1:]
    picks = torch.searchsorted(cumulative.contiguous(), (u * total).contiguous(), right=True).clamp_max(n - 1)
    used = (index < n - kept).to(torch.float64)
    counts = copies.scatter_add(-1, picks, used)
    return _counts_to_ancestors(counts.cumsum(-1).round().long().clamp_(0, n))


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
    """Rows ``ancestors`` (*batch, n) of values (*batch, n, *rest) along n.

    The copy is made component by component in flat memory: 2 to 9 times faster than a general gather.
    """
    if ancestors.dim() == 1 and values.dim() == 2:
        return values.mT.index_select(-1, ancestors).mT
    batch_dims = ancestors.dim()
    n = ancestors.shape[-1]
    rest = values.shape[batch_dims:]
    by_component = values.reshape(-1, *rest).movedim(0, -1)
    flat = ancestors.reshape(-1)
    rows = flat.numel() // n
    if rows > 1:
        offset = torch.arange(rows, device=flat.device) * n
        flat = (ancestors.reshape(rows, n) + offset.unsqueeze(-1)).reshape(-1)
    picked = by_component.index_select(-1, flat)
    return picked.movedim(-1, 0).reshape(*ancestors.shape, *rest)
