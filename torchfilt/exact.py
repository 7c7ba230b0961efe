"""Rows without noise in a measurement update: which of them say something, and what keeps them true to rounding."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.linalg import triangularize

# A row's spread is zero where it is below this many eps of the terms that it is the sum of: |row of H L| <= 128 eps
# |H| |L|. A dozen roundings a term, and those of a few steps.
SPREAD = 128.0


class Verdict(NamedTuple):
    """What k exact rows can tell: idle (..., k), nothing new is in it; contradicted (...), one of these is not met.

    limit (..., k): up to which a residual is zero.
    """

    idle: Tensor
    contradicted: Tensor
    limit: Tensor


def examine(rows: Tensor, residual: Tensor, present: Tensor, spread_floor: Tensor, residual_terms: Tensor) -> Verdict:
    """Rows that are known for certain already, from the prior or from the exact rows above them.

    Modified Gram-Schmidt over the rows: what is left of a row that those above determine is rounding, as is all of one
    that the prior is sure of. Its residual may be larger than its own terms' rounding, since the mean was perhaps
    larger before it came here: eps^(2/3) of the terms is still zero.

    Args:
        rows: (..., k, n) whose product is the covariance of the predicted rows.
        residual: (..., k) from the predicted rows to their values.
        present: (..., k) rows that are there.
        spread_floor: (..., k) below which a row's length is rounding.
        residual_terms: (..., k) size of what the residual is the difference of.

    Returns:
        A `Verdict`.
    """
    idle = []
    for j in range(rows.shape[-2]):
        row = rows[..., j, :]
        size = row.norm(dim=-1)
        known = size <= spread_floor[..., j]
        skipped = known | ~present[..., j]
        inverse = torch.where(skipped, 0, 1 / torch.where(skipped, 1, size))
        unit = row * inverse.unsqueeze(-1)
        share = (rows @ unit.unsqueeze(-1)).squeeze(-1)
        told = share * (residual[..., j] * inverse).unsqueeze(-1)
        rows = rows - share.unsqueeze(-1) * unit.unsqueeze(-2)
        residual, residual_terms = residual - told, residual_terms + told.abs()
        idle.append(known & present[..., j])
    dropped = torch.stack(idle, -1)
    limit = torch.finfo(rows.dtype).eps ** (2 / 3) * residual_terms
    return Verdict(dropped, (dropped & (residual.abs() > limit)).any(-1), limit)


def keep_true(factor: Tensor, rows: Tensor, residual: Tensor, present: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """Factor (..., e, e) with rounding along the rows removed, and the move (..., e) that meets them again.

    What a measurement leaves of a wide prior still carries the rounding of that prior along the constraint, and each
    motion adds to it; divided by the narrow factor it would no longer look like zero. Rows along which the factor is
    not zero to the rounding ``floor`` (..., k), those of a law that is not linear, are left alone.

    Args:
        factor: lower triangular.
        rows: (..., k, e) derivatives of the exact rows.
        residual: (..., k) of rounding size, that the move takes away.
        present: (..., k) rows that hold.

    Returns:
        The factor (..., e, e), lower triangular, and the move (..., e).
    """
    scale = factor.norm(dim=-1)
    scaled = factor / torch.where(scale > 0, scale, 1).unsqueeze(-1)
    rest = rows * scale.unsqueeze(-2)
    present = present & ((rows @ factor).norm(dim=-1) <= floor)
    small = SPREAD * torch.finfo(factor.dtype).eps * rest.abs().sum(-1)
    move = torch.zeros_like(scale)
    for j in range(rows.shape[-2]):
        row = rest[..., j, :]
        size = row.norm(dim=-1)
        used = present[..., j] & (size > small[..., j])
        inverse = torch.where(used, 1 / torch.where(used, size, 1), 0)
        unit = row * inverse.unsqueeze(-1)
        rest = rest - (rest @ unit.unsqueeze(-1)) * unit.unsqueeze(-2)
        scaled = scaled - unit.unsqueeze(-1) * (unit.unsqueeze(-2) @ scaled)
        left = residual[..., j] - (rows[..., j, :] * scale * move).sum(-1)
        move = move + unit * (left * inverse).unsqueeze(-1)
    return triangularize(scaled * scale.unsqueeze(-1)), scale * move


def filled(factor: Tensor, prior: Tensor) -> Tensor:
    """Factor (..., e, e) with a little spread where it has none, so that a quadrature sees a slope there.

    eps^(1/3) of the prior's: a central difference over it is right to eps^(2/3).
    """
    size, eps = prior.norm(dim=-1), torch.finfo(factor.dtype).eps
    flat = factor.diagonal(dim1=-2, dim2=-1).abs() <= eps**0.5 * size
    return factor + torch.diag_embed(torch.where(flat, eps ** (1 / 3) * size, 0))
