"""Gravity outside the Earth as a series of solid spherical harmonics: what unit coefficients do to a satellite."""

import math

import torch
from torch import Tensor

from torchfilt.models.relative_motion.gravity import EARTH_RADIUS_M

# Unnormalised functions grow like (2 l)! / l!, the factors that undo it shrink alike: both stay inside float64 to here.
MAX_DEGREE = 80


def coefficient_degrees(degree: int) -> Tensor:
    """Degree l of each coefficient (W,), W = (degree + 1)^2 - 4.

    Order: l = 2 ... degree; in each l, C_l0 ... C_ll, then S_l1 ... S_ll.

    Raises:
        ValueError: degree outside 2 ... 80.
    """
    if not 2 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be from 2 to {MAX_DEGREE}, got {degree}")
    return torch.cat([torch.full((2 * l + 1,), l) for l in range(2, degree + 1)])


def kaula_deviation(degree: int) -> Tensor:
    """Size 1e-5 / l^2 of the Earth's normalised coefficients by degree, (W,), float64.

    Source: Kaula, Theory of Satellite Geodesy (1966), section 5.2.
    """
    return 1e-5 / coefficient_degrees(degree).double().square()


def gradient_basis(position_m: Tensor, degree: int, mu_m3_s2: float, radius_m: float = EARTH_RADIUS_M) -> Tensor:
    """Accelerations that unit coefficients (normalised to 4 pi) cause.

    Args:
        position_m: Earth-fixed, outside the Earth, (n, 3).
        degree: highest degree; W = (degree + 1)^2 - 4 coefficients in the order of `coefficient_degrees`.
        mu_m3_s2, radius_m: what the coefficients refer to.

    Returns:
        (n, 3, W) in m/s^2, Earth-fixed axes.

    Source: Cunningham (1970), Celestial Mechanics 2, 207; recursions and derivatives as in Montenbruck and Gill,
        Satellite Orbits, eqs. 3.29 to 3.33.
    """
    coefficient_degrees(degree)
    v, w = _solid(position_m, degree + 1, radius_m)
    blocks = []
    for l in range(2, degree + 1):
        blocks.append(_degree_block(v[l + 1], w[l + 1], l))
    return torch.cat(blocks, -1) * (mu_m3_s2 / radius_m**2)


def _solid(position_m: Tensor, degree: int, radius_m: float) -> tuple[list[Tensor], list[Tensor]]:
    """V and W (n, l + 1) for l = 0 ... degree: (R / r)^(l + 1) P_lm(sin latitude) times cos or sin of m longitude."""
    square = position_m.square().sum(-1, keepdim=True)
    x, y, z = (position_m * (radius_m / square)).split(1, -1)
    shrink = radius_m**2 / square
    first = radius_m / square.sqrt()
    v, w = [first], [torch.zeros_like(first)]
    for l in range(1, degree + 1):
        m = torch.arange(l, dtype=position_m.dtype, device=position_m.device)
        ahead = (2 * l - 1) / (l - m) * z
        rows = []
        for part in (v, w):
            below = ahead * part[l - 1]
            if l > 1:
                back = (l + m[:-1] - 1) / (l - m[:-1]) * shrink
                below = below - torch.nn.functional.pad(back * part[l - 2], (0, 1))
            rows.append(below)
        corner_v, corner_w = v[l - 1][:, -1:], w[l - 1][:, -1:]
        rows[0] = torch.cat([rows[0], (2 * l - 1) * (x * corner_v - y * corner_w)], -1)
        rows[1] = torch.cat([rows[1], (2 * l - 1) * (x * corner_w + y * corner_v)], -1)
        v.append(rows[0])
        w.append(rows[1])
    return v, w


def _degree_block(v: Tensor, w: Tensor, l: int) -> Tensor:
    """Gradients (n, 3, 2 l + 1) of degree l from the functions of degree l + 1, (n, l + 2); unit of mu / R^2."""
    m = torch.arange(1, l + 1, dtype=v.dtype, device=v.device)
    lower = (l - m + 2) * (l - m + 1)
    up_v, up_w, low_v, low_w = v[:, 2:], w[:, 2:], lower * v[:, :-2], lower * w[:, :-2]
    cosine = torch.stack([(low_v - up_v) / 2, -(up_w + low_w) / 2, -(l - m + 1) * v[:, 1:-1]], 1)
    sine = torch.stack([(low_w - up_w) / 2, (up_v + low_v) / 2, -(l - m + 1) * w[:, 1:-1]], 1)
    zonal = torch.stack([-v[:, 1], -w[:, 1], -(l + 1) * v[:, 0]], -1).unsqueeze(-1)
    scale = _normalisation(l, v)
    return torch.cat([scale[0] * zonal, scale[1:] * cosine, scale[1:] * sine], -1)


def _normalisation(l: int, like: Tensor) -> Tensor:
    """Factors (l + 1,) from normalised to plain functions: sqrt((2 - [m = 0]) (2 l + 1) (l - m)! / (l + m)!)."""
    logs = [
        math.log((2 if m else 1) * (2 * l + 1)) + math.lgamma(l - m + 1) - math.lgamma(l + m + 1) for m in range(l + 1)
    ]
    return like.new_tensor([math.exp(0.5 * value) for value in logs])
