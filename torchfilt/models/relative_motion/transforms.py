"""Small shared matrices applied to many states, and the process noise of a random acceleration."""

import torch
from torch import Tensor


def apply_matrix(matrix: Tensor, x: Tensor) -> Tensor:
    """``matrix @ x`` for each state; one matrix product wherever rows of x share a matrix.

    Args:
        matrix: (*lead, m, d), lead broadcasts with the leading dims of x.
        x: (..., d).

    Returns:
        (..., m).
    """
    lead = matrix.shape[:-2]
    shared = 0
    while shared < len(lead) and lead[-1 - shared] == 1:
        shared += 1
    if len(lead) == shared:
        flat = matrix.reshape(matrix.shape[-2:])
        result = x @ flat.mT
        missing = len(lead) - (x.dim() - 1)
        return result.reshape(*lead[:missing], *result.shape) if missing > 0 else result
    if shared == 0 or x.dim() - 1 < len(lead):
        return (matrix * x.unsqueeze(-2)).sum(-1)
    rows = x.flatten(-1 - shared, -2)
    result = rows @ matrix.reshape(*lead[: len(lead) - shared], *matrix.shape[-2:]).mT
    return result.unflatten(-2, x.shape[-1 - shared : -1])


def rate_matrix(rate_rad_s: Tensor) -> Tensor:
    """Matrix (..., 6, 6) that takes inertial to rotating velocities at equal axes: v - w x p; w is (..., 3)."""
    zero = torch.zeros_like(rate_rad_s[..., 0])
    wx, wy, wz = rate_rad_s.unbind(-1)
    minus_cross = torch.stack([zero, wz, -wy, -wz, zero, wx, wy, -wx, zero], -1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=rate_rad_s.dtype, device=rate_rad_s.device).expand_as(minus_cross)
    top = torch.cat([identity, torch.zeros_like(minus_cross)], -1)
    return torch.cat([top, torch.cat([minus_cross, identity], -1)], -2)


def rotate_columns(matrix: Tensor, rotation: Tensor) -> Tensor:
    """``matrix @ blockdiag(rotation, rotation)``; shapes (..., 6, 6) and (..., 3, 3)."""
    return torch.cat([matrix[..., :3] @ rotation, matrix[..., 3:] @ rotation], -1)


def white_acceleration_factor(psd_m2_s3: Tensor, dt: Tensor | float, rate_rad_s: Tensor) -> Tensor:
    """Factor of the noise that a white acceleration adds to a rotating-frame state over a step.

    Gravity's change over the step is left out, a relative error of (n dt)^2; the frame's rotation is kept.

    Args:
        psd_m2_s3: spectral density of each axis, a scalar tensor.
        dt: step in s, number or (..., 1).
        rate_rad_s: Hill frame rate at the end of the step, (..., 3).

    Returns:
        (..., 6, 6) lower triangular.
    """
    step = dt if isinstance(dt, Tensor) else psd_m2_s3.new_tensor(dt)
    step = (step * torch.ones_like(rate_rad_s[..., :1])).squeeze(-1)
    root = (psd_m2_s3 * step).sqrt()
    identity = torch.eye(3, dtype=rate_rad_s.dtype, device=rate_rad_s.device)
    position = (root * step / 3**0.5)[..., None, None] * identity
    half = (root / 2)[..., None, None] * identity
    factor = torch.cat(
        [torch.cat([position, torch.zeros_like(position)], -1), torch.cat([3**0.5 * half, half], -1)], -2
    )
    return rate_matrix(rate_rad_s) @ factor


def block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """Block-diagonal matrix (..., m + n, m + n) of (..., m, m) and (..., n, n), leading dims broadcast."""
    lead = torch.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    m, n = first.shape[-1], second.shape[-1]
    top = torch.nn.functional.pad(first, (0, n)).expand(*lead, first.shape[-2], m + n)
    bottom = torch.nn.functional.pad(second, (m, 0)).expand(*lead, second.shape[-2], m + n)
    return torch.cat([top, bottom], -2)
