"""What a linear system's measurements say about its state: stacked powers, rank, Gramians, modes.

A pair (a, c) is given as two matrices or as one system; every function takes leading batch dims. A rank is a decision
about singular values, and these depend on the units of state and time: each function that takes it says by which
tolerance, takes scales, and gives the singular values back.
"""

import math
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.laws import check_finite
from torchfilt.models.control.systems import as_system, integrate_noise

Pair = tuple[Tensor, Tensor]
Scale = Tensor | Literal["columns"] | None


def obsv(a: Any, c: Tensor | None = None, *, time_scale: float = 1.0) -> Tensor:
    """Observability matrix: c, c a s, ..., c (a s)^(d-1) on top of each other, s the time scale.

    The state that is looked for changes at most one of these rows where it is seen at all. In seconds the higher powers
    of slow systems vanish beside the lower ones; with s as long as the observation they compare as they do in the data.
    Where a s is much larger than one, the higher powers drown the lower ones instead: take s no longer than the fastest
    mode lasts.

    Args:
        a: (*batch, d, d), or a system with both matrices (`StateSpace`, `control.StateSpace`).
        c: (*batch, m, d).
        time_scale: s, positive; leave it at 1 for discrete systems.

    Returns:
        (*batch, d m, d).

    Raises:
        TypeError: not tensors of one floating dtype. ValueError: shapes, NaN, a time scale that is not positive.

    Source: Kalman, On the general theory of control systems (1960).
    """
    a, c = check_pair(a, c, "c")
    if not 0 < time_scale < math.inf:
        raise ValueError(f"time_scale must be positive and finite, got {time_scale}")
    step, row, rows = a * time_scale, c, [c]
    for _ in range(a.shape[-1] - 1):
        row = row @ step
        rows.append(row)
    lead = rows[-1].shape[:-2]
    return torch.cat([part.expand(*lead, *part.shape[-2:]) for part in rows], -2)


def ctrb(a: Any, b: Tensor | None = None, *, time_scale: float = 1.0) -> Tensor:
    """Controllability matrix: b, a s b, ..., (a s)^(d-1) b side by side; the dual of `obsv`.

    Args:
        a: (*batch, d, d), or a system. b: (*batch, d, k). time_scale: as in `obsv`.

    Returns:
        (*batch, d, d k).

    Raises:
        As `obsv`.
    """
    a, b = check_pair(a, b, "b")
    return obsv(a.mT, b.mT, time_scale=time_scale).mT


class Rank(NamedTuple):
    """Rank (*batch) of a matrix, its singular values (*batch, k) from the largest down, and the tolerance (*batch).

    Counted are the singular values above the tolerance.
    """

    rank: Tensor
    singular_values: Tensor
    tolerance: Tensor


def rank(matrix: Tensor, tolerance: float | None = None, scale: Scale = None) -> Rank:
    """Numerical rank, with what it was decided from.

    Args:
        matrix: (*batch, m, n).
        tolerance: singular values up to here count as zero; default max(m, n) * eps * the largest one, what rounding
            can make of a zero.
        scale: sizes (n,) that the columns' states have, so that a column is multiplied by its own (an attitude of
            0.01 rad then weighs as much as a position of 10 m); "columns" divides each column by its length.

    Returns:
        `Rank`.

    Raises:
        TypeError: not a floating-point tensor. ValueError: shape, NaN, a negative tolerance, scales that are not n
            positive numbers.

    Source: Golub and Van Loan, Matrix Computations (2013), section 5.4.1.
    """
    scaled = scale_columns(matrix, scale)
    values = torch.linalg.svdvals(scaled)
    limit = zero_below(scaled, values, tolerance)
    return Rank((values > limit.unsqueeze(-1)).sum(-1), values, limit)


def scale_columns(matrix: Tensor, scale: Scale) -> Tensor:
    """The matrix (*batch, m, n) with its columns scaled, see `rank`; a column of zeros stays one.

    Raises:
        TypeError, ValueError: as `rank`, but for the tolerance.
    """
    if not isinstance(matrix, Tensor) or not matrix.is_floating_point():
        raise TypeError(
            f"matrix must be a floating-point tensor, got {getattr(matrix, 'dtype', type(matrix).__name__)}"
        )
    if matrix.dim() < 2 or 0 in matrix.shape[-2:]:
        raise ValueError(f"matrix must be (*batch, m, n), got shape {tuple(matrix.shape)}")
    check_finite(matrix, "matrix")
    if scale is None:
        return matrix
    if isinstance(scale, str):
        if scale != "columns":
            raise ValueError(f"scale must be sizes of the states or 'columns', got {scale!r}")
        length = torch.linalg.vector_norm(matrix, dim=-2, keepdim=True)
        return matrix / torch.where(length > 0, length, 1)
    if scale.shape != matrix.shape[-1:] or not bool(((scale > 0) & torch.isfinite(scale)).all()):
        raise ValueError(f"scale must be {matrix.shape[-1]} positive finite numbers, got {scale.tolist()}")
    return matrix * scale.to(matrix)


def zero_below(matrix: Tensor, values: Tensor, tolerance: float | None) -> Tensor:
    """Limit (*batch) up to which singular values (*batch, k) of a matrix count as zero, see `rank`.

    Raises:
        ValueError: a tolerance that is negative or not finite.
    """
    if tolerance is None:
        return max(matrix.shape[-2:]) * torch.finfo(matrix.dtype).eps * values[..., 0]
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be finite and not negative, got {tolerance}")
    return torch.full_like(values[..., 0], tolerance)


# Gramians -------------------------------------------------------------------------------------------------------------


def observability_gramian(
    a: Any, c: Tensor | None = None, horizon: float | None = None, *, discrete: bool = False
) -> Tensor:
    """Energy of the output that a state leaves behind: x^T W x, with no input and no noise.

    Continuous: the integral of exp(a^T t) c^T c exp(a t) over the horizon; discrete: the sum of (a^T)^k c^T c a^k for k
    below it. A finite one is exact for any system, by the matrix exponential.

    Args:
        a: (*batch, d, d), or a system, whose dt says whether it is discrete. c: (*batch, m, d); whiten it by the noise,
            and W is the information in the measurements.
        horizon: seconds, or a whole number of steps; None for ever, by the Lyapunov equation (SciPy; no gradients).
        discrete: whether (a, c) is a discrete pair; an error beside a continuous system.

    Returns:
        (*batch, d, d), symmetric.

    Raises:
        TypeError, ValueError: as `obsv`; a horizon that is not positive; no horizon and a system that is not stable:
            the mode is named.

    Source: Van Loan, Computing integrals involving the matrix exponential (1978), theorem 1.
    """
    discrete = _in_steps(a, c, discrete)
    a, c = check_pair(a, c, "c")
    weight = c.mT @ c
    if horizon is None:
        return _forever(a, weight, discrete)
    if not 0 < horizon < math.inf or (discrete and horizon != int(horizon)):
        rule = "a positive whole number of steps" if discrete else "positive and finite"
        raise ValueError(f"horizon must be {rule}, got {horizon}")
    return _steps(a, weight, int(horizon)) if discrete else integrate_noise(a.mT, weight, horizon)


def controllability_gramian(
    a: Any, b: Tensor | None = None, horizon: float | None = None, *, discrete: bool = False
) -> Tensor:
    """Where inputs of unit energy reach; the dual of `observability_gramian`.

    Args:
        a: (*batch, d, d), or a system. b: (*batch, d, k). horizon, discrete: as there.

    Returns:
        (*batch, d, d), symmetric.

    Raises:
        As `observability_gramian`.
    """
    discrete = _in_steps(a, b, discrete)
    a, b = check_pair(a, b, "b")
    return observability_gramian(a.mT, b.mT, horizon, discrete=discrete)


def _steps(a: Tensor, weight: Tensor, count: int) -> Tensor:
    """Sum of the first ``count`` terms, by the binary digits of the count."""
    total, past = torch.zeros_like(weight), torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    part, power = weight, a  # sums over 1, 2, 4, ... steps
    while count:
        if count % 2:
            total = total + past.mT @ part @ past
            past = power @ past
        part, power, count = part + power.mT @ part @ power, power @ power, count // 2
    return (total + total.mT) / 2


def _forever(a: Tensor, weight: Tensor, discrete: bool) -> Tensor:
    from scipy import linalg

    eigenvalues = torch.linalg.eigvals(a.detach())
    margin = a.shape[-1] * torch.finfo(a.dtype).eps * torch.linalg.matrix_norm(a.detach(), 2)
    unstable = _lasting(eigenvalues, discrete, margin)
    if unstable.any():
        rule = "|z| >= 1" if discrete else "Re >= 0"
        worst = eigenvalues[unstable][0].item()
        raise ValueError(f"a Gramian for ever needs a stable system, this one has a mode with {rule}: {worst:.6g}")
    size, lead = a.shape[-1], torch.broadcast_shapes(a.shape[:-2], weight.shape[:-2])
    rows = []
    for one, right in zip(
        a.detach().expand(*lead, size, size).reshape(-1, size, size).double().cpu().numpy(),
        weight.detach().expand(*lead, size, size).reshape(-1, size, size).double().cpu().numpy(),
        strict=True,
    ):
        if discrete:
            solution = linalg.solve_discrete_lyapunov(one.T, right)
        else:
            solution = linalg.solve_continuous_lyapunov(one.T, -right)
        rows.append(torch.from_numpy((solution + solution.T) / 2))
    return torch.stack(rows).reshape(*lead, size, size).to(a)


def _lasting(eigenvalues: Tensor, discrete: bool, margin: Tensor) -> Tensor:
    """Which modes do not die out, by more than rounding makes of a mode that lasts: margin (*batch)."""
    growth = eigenvalues.abs() - 1 if discrete else eigenvalues.real
    return growth >= -margin.unsqueeze(-1)


# Modes ----------------------------------------------------------------------------------------------------------------


class Modes(NamedTuple):
    """Popov-Belevitch-Hautus test of each mode.

    eigenvalues (*batch, d), complex; singular_values (*batch, d): the smallest of [lambda - a; c], zero where the mode
    never shows; directions (*batch, d, d), complex, a row a mode: the unit state that shows least; unobservable
    (*batch, d): singular value within the tolerance (*batch); undetectable (*batch, d): of these, the ones that last
    (Re >= 0, or |z| >= 1, but for sqrt(eps) of the norm of a): no observer can bring their error down.

    A mode that occurs k times is marked k times where one of its directions is not seen: count directions by `rank`.
    """

    eigenvalues: Tensor
    singular_values: Tensor
    directions: Tensor
    unobservable: Tensor
    undetectable: Tensor
    tolerance: Tensor


def pbh(a: Any, c: Tensor | None = None, *, discrete: bool = False, tolerance: float | None = None) -> Modes:
    """Which modes of a pair are seen, one by one.

    Args:
        a: (*batch, d, d), or a system, whose dt says whether it is discrete. c: (*batch, m, d).
        discrete: whether (a, c) is a discrete pair; an error beside a continuous system.
        tolerance: default sqrt(eps) times the norm of [a; c]: far above d * eps, because rounding moves a k-fold
            eigenvalue by as much as the k-th root of eps, and a mode is tested at its computed eigenvalue.

    Returns:
        `Modes`.

    Raises:
        TypeError, ValueError: as `obsv`; a negative tolerance.

    Source: Hautus, Controllability and observability conditions of linear autonomous systems (1969).
    """
    discrete = _in_steps(a, c, discrete)
    a, c = check_pair(a, c, "c")
    size, lead = a.shape[-1], torch.broadcast_shapes(a.shape[:-2], c.shape[:-2])
    a, c = a.expand(*lead, size, size), c.expand(*lead, *c.shape[-2:])
    if tolerance is None:
        limit = torch.finfo(a.dtype).eps ** 0.5 * torch.linalg.matrix_norm(torch.cat([a, c], -2), 2)
    else:
        limit = zero_below(a, a[..., 0], tolerance)
    eigenvalues = torch.linalg.eigvals(a)
    margin = torch.finfo(a.dtype).eps ** 0.5 * torch.linalg.matrix_norm(a, 2)
    shifted = eigenvalues[..., None, None] * torch.eye(size, dtype=a.dtype, device=a.device) - a.unsqueeze(-3)
    tall = torch.cat([shifted, c.unsqueeze(-3).expand(*lead, size, *c.shape[-2:]).to(shifted.dtype)], -2)
    _, values, right = torch.linalg.svd(tall, full_matrices=False)
    unseen = values[..., -1] <= limit.unsqueeze(-1)
    undetectable = unseen & _lasting(eigenvalues, discrete, margin)
    return Modes(eigenvalues, values[..., -1], right[..., -1, :].conj(), unseen, undetectable, limit)


# Arguments ------------------------------------------------------------------------------------------------------------


def _in_steps(a: Any, other: Tensor | None, discrete: bool) -> bool:
    """Whether time goes in steps: as it is said of a pair, by the period of a system."""
    if other is not None:
        return discrete
    system = as_system(a)
    if discrete and not system.is_discrete:
        raise ValueError("discrete=True is said of a pair of matrices; this system is continuous, its dt is None")
    return system.is_discrete


def check_pair(a: Any, other: Tensor | None, name: Literal["b", "c"]) -> Pair:
    """The two matrices, checked; ``other`` None takes both from the system a.

    Raises:
        TypeError: no floating-point tensors, or of two dtypes. ValueError: shapes that do not fit, NaN.
    """
    if other is None:
        system = as_system(a)
        a, other = system.a, getattr(system, name)
    for label, matrix in (("a", a), (name, other)):
        if not isinstance(matrix, Tensor) or not matrix.is_floating_point():
            got = matrix.dtype if isinstance(matrix, Tensor) else type(matrix).__name__
            raise TypeError(f"{label} must be a floating-point tensor, got {got}")
        check_finite(matrix, label)
    assert other is not None
    if a.dtype != other.dtype:
        raise TypeError(f"a and {name} must have one dtype, got {a.dtype} and {other.dtype}")
    if a.dim() < 2 or a.shape[-1] != a.shape[-2] or a.shape[-1] == 0:
        raise ValueError(f"a must be (*batch, d, d), got shape {tuple(a.shape)}")
    axis, want = (-1, f"(*batch, m, {a.shape[-1]})") if name == "c" else (-2, f"(*batch, {a.shape[-1]}, k)")
    if other.dim() < 2 or other.shape[axis] != a.shape[-1] or 0 in other.shape:
        raise ValueError(f"{name} must be {want} to fit a {tuple(a.shape)}, got {tuple(other.shape)}")
    return a, other
