"""Gravity of the Earth and its change over a short distance, without differences of large numbers."""

from typing import NamedTuple

import torch
from torch import Tensor

# WGS-84's own value is 3.986004418e14; the formation study this package follows rounds it.
MU_M3_S2 = 3.986004e14
EARTH_RADIUS_M = 6378136.3
# EGM2008: J_n = -sqrt(2 n + 1) C_n0, with the radius above.
J2_EARTH = 1.0826261738522227e-3


class Field(NamedTuple):
    """Central body: mu in m^3/s^2, J2 (0 for a point mass) and the radius in m that J2 refers to; pole along z."""

    mu_m3_s2: float = MU_M3_S2
    j2: float = 0.0
    radius_m: float = EARTH_RADIUS_M


def acceleration(position_m: Tensor, field: Field) -> Tensor:
    """Gravity at an inertial position (..., 3), m/s^2."""
    radius = torch.linalg.vector_norm(position_m, dim=-1, keepdim=True)
    central = -(field.mu_m3_s2 / radius**3) * position_m
    return central if field.j2 == 0 else central + j2_acceleration(position_m, field)


def j2_acceleration(position_m: Tensor, field: Field) -> Tensor:
    """Part of the acceleration (..., 3) due to the flattening, m/s^2, inertial axes with z along the pole."""
    square = position_m.square().sum(-1, keepdim=True)
    radius = square.sqrt()
    sine = position_m[..., 2:] / radius
    # In this order no power of the radius overflows float32.
    strength = (1.5 * field.j2 * field.mu_m3_s2) / square * (field.radius_m / radius) ** 2
    along_radius = strength * (5 * sine * sine - 1) / radius
    pole = position_m.new_tensor([0.0, 0.0, 1.0])
    return along_radius * position_m - (2 * strength * sine) * pole


def gradient(position_m: Tensor, field: Field) -> Tensor:
    """Derivative of the acceleration with respect to position (..., 3): (..., 3, 3), 1/s^2, symmetric."""
    radius = torch.linalg.vector_norm(position_m, dim=-1, keepdim=True).unsqueeze(-1)
    unit = position_m.unsqueeze(-1) / radius
    outer = unit * unit.mT
    identity = torch.eye(3, dtype=position_m.dtype, device=position_m.device)
    central = -(field.mu_m3_s2 / radius**3) * (identity - 3 * outer)
    if field.j2 == 0:
        return central
    sine = unit[..., 2:, :]
    pole = identity[2:]
    mixed = unit * pole
    strength = (1.5 * field.j2 * field.mu_m3_s2) / radius**3 * (field.radius_m / radius) ** 2
    bracket = (
        (1 - 5 * sine**2) * identity
        - 5 * (1 - 7 * sine**2) * outer
        - 10 * sine * (mixed + mixed.mT)
        + 2 * pole.mT * pole
    )
    return central - strength * bracket


def central_difference(separation_m: Tensor, position_m: Tensor, mu_m3_s2: float) -> Tensor:
    """Two-body gravity at ``position + separation`` minus that at ``position``, (..., 3), m/s^2.

    Source: Battin, An Introduction to the Mathematics and Methods of Astrodynamics, section 8.7: with
    q = s.(s + 2 r) / r^2 the ratio of cubed radii is 1 + F, F = q (3 + 3 q + q^2) / (1 + (1 + q)^(3/2)).
    """
    square = position_m.square().sum(-1, keepdim=True)
    q = (separation_m * (separation_m + 2 * position_m)).sum(-1, keepdim=True) / square
    ratio = 1 + q
    cubed = ratio * ratio.sqrt()
    f = q * (3 + q * (3 + q)) / (1 + cubed)
    return (separation_m - f * position_m) * (-mu_m3_s2 / (square * square.sqrt()) / cubed)


def difference(separation_m: Tensor, position_m: Tensor, field: Field) -> Tensor:
    """Gravity at ``position + separation`` minus that at ``position``, both (..., 3), m/s^2."""
    central = central_difference(separation_m, position_m, field.mu_m3_s2)
    if field.j2 == 0:
        return central
    # The J2 acceleration is a thousandth of gravity: its plain difference loses 1e-18 m/s^2 in float64 and 1e-9 in
    # float32, less than the rounding of a relative position.
    oblate = j2_acceleration(position_m + separation_m, field) - j2_acceleration(position_m, field)
    return central + oblate
