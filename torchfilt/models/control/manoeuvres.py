"""What a manoeuvre makes observable: systems that are constant piece by piece."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilt.linalg import matrix_exp
from torchfilt.models.control.observability import Pair, check_pair, obsv, scale_columns, zero_below
from torchfilt.models.control.systems import as_system


def stripped_observability(pieces: Sequence[Any], *, time_scale: float = 1.0) -> Tensor:
    """Observability matrices of the pieces of a piecewise constant system on top of each other, motion left out.

    The shortest way to ask what a manoeuvre adds. Its null space is that of `total_observability` where
    `stripping_defect` is zero; elsewhere compare the two.

    Args:
        pieces: pairs (a, c), or systems, in the order in which they are flown; continuous.
        time_scale: as in `obsv`.

    Returns:
        (*batch, rows, d).

    Raises:
        TypeError, ValueError: no pieces, pieces of different state size, a discrete system; as `obsv`.

    Source: Goshen-Meskin and Bar-Itzhack, Observability analysis of piece-wise constant systems, part I: theory
        (1992).
    """
    return _stack([obsv(a, c, time_scale=time_scale) for a, c in _pieces(pieces)])


def total_observability(pieces: Sequence[Any], durations_s: Sequence[float], *, time_scale: float = 1.0) -> Tensor:
    """Observability matrix of the state at the start of a piecewise constant system, exact for any durations.

    The rows of each piece are carried back over the pieces before it.

    Args:
        pieces: as in `stripped_observability`. durations_s: of each piece but the last.
        time_scale: as in `obsv`.

    Returns:
        (*batch, rows, d).

    Raises:
        TypeError, ValueError: as `stripped_observability`; durations that are not one positive number a piece but the
            last.

    Source: Goshen-Meskin and Bar-Itzhack, part I (1992).
    """
    pairs = _pieces(pieces)
    if len(durations_s) != len(pairs) - 1 or not all(0 < time < math.inf for time in durations_s):
        raise ValueError(
            f"durations_s must be {len(pairs) - 1} positive finite times, one a piece but the last, got {durations_s}"
        )
    blocks = [obsv(*pairs[0], time_scale=time_scale)]
    past = torch.eye(pairs[0][0].shape[-1], dtype=pairs[0][0].dtype, device=pairs[0][0].device)
    for (before, _), (a, c), time in zip(pairs, pairs[1:], durations_s, strict=False):
        past = matrix_exp(before * time) @ past
        blocks.append(obsv(a, c, time_scale=time_scale) @ past)
    return _stack(blocks)


def stripping_defect(
    pieces: Sequence[Any], *, time_scale: float = 1.0, tolerance: float | None = None, scale: Tensor | None = None
) -> Tensor:
    """How far each piece is from what the stripped matrix takes for granted: what it doesn't see, it doesn't move.

    Largest length that a * time_scale makes of a unit state in the null space of the piece's own observability matrix,
    in scaled states. Where it is zero but for rounding in all pieces, null(Q_j) in null(a_j), the stripped matrix may
    stand for the total one. That is sufficient, not necessary.

    Args:
        pieces: as in `stripped_observability`. time_scale: as in `obsv`. tolerance, scale: as in `rank`.

    Returns:
        (*batch, pieces).

    Raises:
        TypeError, ValueError: as `stripped_observability` and `rank`.

    Source: Goshen-Meskin and Bar-Itzhack, part I (1992).
    """
    defects = []
    for a, c in _pieces(pieces):
        matrix = scale_columns(obsv(a, c, time_scale=time_scale), scale)
        _, values, right = torch.linalg.svd(matrix, full_matrices=False)
        unseen = right * (values <= zero_below(matrix, values, tolerance).unsqueeze(-1)).unsqueeze(-1)
        moved = scale_columns(a * time_scale, scale) @ unseen.mT
        moved = moved if scale is None else moved / scale.to(moved).unsqueeze(-1)
        defects.append(torch.linalg.matrix_norm(moved, 2))
    return torch.stack(torch.broadcast_tensors(*defects), -1)


def _pieces(pieces: Sequence[Any]) -> list[Pair]:
    pairs = []
    for k, piece in enumerate(pieces):
        if isinstance(piece, tuple | list):
            a, c = piece
            pairs.append(check_pair(a, c, "c"))
            continue
        system = as_system(piece)
        if system.is_discrete:
            raise ValueError(f"pieces must be continuous, piece {k} is discrete with dt = {system.dt}")
        pairs.append(check_pair(system.a, system.c, "c"))
    sizes = [a.shape[-1] for a, _ in pairs]
    if len(set(sizes)) != 1:
        raise ValueError(f"pieces must be at least one pair (a, c), all of one state size, got sizes {sizes}")
    return pairs


def _stack(blocks: list[Tensor]) -> Tensor:
    lead = torch.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    return torch.cat([block.expand(*lead, *block.shape[-2:]) for block in blocks], -2)
