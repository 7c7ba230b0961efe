"""Strapdown mechanisation in ENU axes on the rotating ellipsoid, and what makes sensor samples fit for it.

An increment pair over an interval is (dtheta, dv): the rotation vector of the body axes at its end seen from those at
its start (rad), and the integral of the specific force in body axes at the start (m/s). Raw samples are the plain
integrals of angular rate and specific force in the turning axes; coning, sculling and rotation are the differences.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfilt.models.attitude import from_rotation_vector, mean_rotation, multiply, rotate, to_rotation_vector
from torchfilt.models.inertial.earth import WGS84, gravity, radii, radii_slopes, slopes

_LARGEST_FIT = 4


class Navigation(NamedTuple):
    """Where a vehicle is and how it moves.

    quaternion (..., 4) from body (RFU) to ENU; velocity (..., 3) over the ground, ENU, m/s; latitude and longitude in
    rad and height in m above the ellipsoid, each (...).
    """

    quaternion: Tensor
    velocity: Tensor
    latitude: Tensor
    longitude: Tensor
    height: Tensor


# Samples --------------------------------------------------------------------------------------------------------------


def increments(gyro_rad_s: Tensor, accel_m_s2: Tensor, dt_s: Tensor | float, group: int = 2) -> tuple[Tensor, Tensor]:
    """Compensated increments of groups of samples.

    The largest blocks of at most four samples that fill a group go through `compensate`, and `join` puts the blocks
    together. A sample is the mean over its interval; all samples of a block have the same length.

    Args:
        gyro_rad_s, accel_m_s2: (t, *batch, 3), body axes. A rest that does not fill a group is left out.
        dt_s: length of a sample's interval; number or broadcast with the samples.
        group: samples in an increment.

    Returns:
        dtheta in rad and dv in m/s, (t // group, *batch, 3).

    Raises:
        ValueError: a group below 1, samples of other shapes or fewer than a group.
    """
    if group < 1:
        raise ValueError(f"group must be at least 1 sample, got {group}")
    if gyro_rad_s.shape != accel_m_s2.shape or gyro_rad_s.dim() < 2 or gyro_rad_s.shape[-1] != 3:
        shapes = f"{tuple(gyro_rad_s.shape)} and {tuple(accel_m_s2.shape)}"
        raise ValueError(f"gyro_rad_s and accel_m_s2 must both be (t, *batch, 3), got {shapes}")
    count = len(gyro_rad_s) // group
    if count < 1:
        raise ValueError(f"a group of {group} samples needs at least as many, got {len(gyro_rad_s)}")
    size = next(n for n in range(_LARGEST_FIT, 0, -1) if group % n == 0)

    def blocks(samples: Tensor) -> Tensor:
        whole = (samples * dt_s)[: count * group]
        return whole.unflatten(0, (count, group // size, size)).movedim(1, -2).movedim(1, -2)

    return join(*compensate(blocks(gyro_rad_s), blocks(accel_m_s2)))


def compensate(dtheta_rad: Tensor, dv_m_s: Tensor) -> tuple[Tensor, Tensor]:
    """Increment pair of a few raw samples of equal length: coning, sculling and rotation taken into account.

    Rate and force are taken as the polynomials that have the samples as their integrals. The drift of a coning motion
    falls with the second, fourth, fourth, sixth power of the sample's length for g = 1, 2, 3, 4; one sample alone shows
    no coning. A turn at a constant rate is exact; beside it the third order in the turn is left out.

    Args:
        dtheta_rad, dv_m_s: (..., g, 3), g from 1 to 4.

    Returns:
        dtheta in rad, dv in m/s, (..., 3).

    Raises:
        ValueError: more than four samples.

    Source: Bortz, A new mathematical formulation for strapdown inertial navigation, IEEE TAES 7 (1971), equation 10,
        to second order; Savage, Strapdown inertial navigation integration algorithm design, JGCD 21 (1998), parts 1, 2.
    """
    samples = dtheta_rad.shape[-2]
    if samples > _LARGEST_FIT:
        raise ValueError(f"at most {_LARGEST_FIT} samples make a block, got {samples}; join several blocks")
    weights = dtheta_rad.new_tensor(_fit_weights(samples))
    partial = weights.mT @ dtheta_rad
    dtheta = dtheta_rad.sum(-2) + torch.linalg.cross(partial, dtheta_rad).sum(-2) / 2
    sculling = torch.linalg.cross(partial, dv_m_s).sum(-2)
    return dtheta, _apply(mean_rotation(dtheta), dv_m_s.sum(-2)) + sculling


@lru_cache(maxsize=_LARGEST_FIT)
def _fit_weights(samples: int) -> tuple[tuple[float, ...], ...]:
    """D with ``integral of A x b = sum_ij D_ij a_i x b_j + a x b / 2``, A being the running integral of the rate.

    a_i and b_i are the integrals of rate and force over interval i, a and b their sums. D is antisymmetric.
    """
    starts, powers = np.arange(samples)[:, None], np.arange(samples)[None]
    integrals = ((starts + 1.0) ** (powers + 1) - starts ** (powers + 1.0)) / (powers + 1)
    coefficients = np.linalg.inv(integrals)  # column i: the polynomial of a unit sample i
    total = powers + powers.T + 2
    moments = float(samples) ** total / ((powers.T + 1) * total)
    weights = coefficients.T @ moments @ coefficients
    return tuple(map(tuple, ((weights - weights.T) / 2).tolist()))


def join(dtheta_rad: Tensor, dv_m_s: Tensor) -> tuple[Tensor, Tensor]:
    """One increment pair of s successive ones, exactly.

    Args:
        dtheta_rad, dv_m_s: (..., s, 3); zeros at the end change nothing.

    Returns:
        dtheta in rad (at most pi long), dv in m/s, (..., 3).
    """
    if dtheta_rad.shape[-2] == 1:
        return dtheta_rad.squeeze(-2), dv_m_s.squeeze(-2)
    turns = from_rotation_vector(dtheta_rad)
    q, dv = turns[..., 0, :], dv_m_s[..., 0, :]
    for k in range(1, turns.shape[-2]):
        dv = dv + rotate(q, dv_m_s[..., k, :])
        q = multiply(q, turns[..., k, :])
    return to_rotation_vector(q), dv


# Mechanisation --------------------------------------------------------------------------------------------------------


class Advance(NamedTuple):
    """One step of the mechanisation: quaternion (..., 4) and velocity (..., 3) at its end, m/s; position's change.

    latitude_rad, longitude_rad, height_m: changes, each (...).
    """

    quaternion: Tensor
    velocity: Tensor
    latitude_rad: Tensor
    longitude_rad: Tensor
    height_m: Tensor


class _Middle(NamedTuple):
    """What the middle of a step looks like; scalars (...), vectors (..., 3), the step's length as a scalar (...)."""

    step: Tensor | float
    first_meridian: Tensor  # M + h at the start, which leads to the middle
    latitude: Tensor
    height: Tensor
    sine: Tensor
    cosine: Tensor
    by_meridian: Tensor  # 1 / (M + h)
    by_transverse: Tensor  # 1 / (N + h)
    scale: Tensor  # transport rate = scale * (north, east, east)
    earth: Tensor
    first_rate: Tensor  # Earth's and transport rate of the velocity at the start
    rate: Tensor  # the same of the velocity in the middle
    velocity: Tensor
    force: Tensor  # dv in ENU axes at the start
    weight: Tensor  # (0, 0, g dt)


def _middle(
    quaternion: Tensor, velocity: Tensor, latitude: Tensor, height: Tensor, dv: Tensor, dt: Tensor | float
) -> _Middle:
    step = dt.squeeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt
    east, north, up = velocity.unbind(-1)
    first_meridian = radii(latitude)[0] + height
    middle_latitude = latitude + step / 2 * north / first_meridian
    middle_height = height + step / 2 * up
    sine, cosine = middle_latitude.sin(), middle_latitude.cos()
    meridian, transverse = radii(middle_latitude)
    x, y = 1 / (meridian + middle_height), 1 / (transverse + middle_height)
    scale = torch.stack(torch.broadcast_tensors(-x, y, y * sine / cosine), -1)
    earth = WGS84.rate_rad_s * torch.stack([torch.zeros_like(sine), cosine, sine], -1)
    weight = pad((gravity(middle_latitude, middle_height) * step).unsqueeze(-1), (2, 0))
    force = rotate(quaternion, dv)
    first_rate = earth + scale * torch.stack([north, east, east], -1)
    middle_velocity = velocity + _change(force, weight, earth * dt, first_rate * dt, velocity) / 2
    east, north, _ = middle_velocity.unbind(-1)
    rate = earth + scale * torch.stack([north, east, east], -1)
    return _Middle(
        step, first_meridian, middle_latitude, middle_height, sine, cosine, x, y, scale, earth, first_rate, rate,
        middle_velocity, force, weight,
    )  # fmt: skip


def _change(force: Tensor, weight: Tensor, earth: Tensor, turn: Tensor, velocity: Tensor) -> Tensor:
    """Change of velocity in a step: force turned half way with ENU, weight, Coriolis by (2 Earth + transport) dt."""
    return force - _cross(turn, force) / 2 - weight - _cross(earth + turn, velocity)


def advance(
    quaternion: Tensor,
    velocity: Tensor,
    latitude: Tensor,
    height: Tensor,
    dtheta: Tensor,
    dv: Tensor,
    dt: Tensor | float,
) -> Advance:
    """One step of second order in dt; the turn of the body is exact, whatever its size.

    Rates, radii and gravity are those of the mid-point, which a first estimate of the step gives. The increment is
    turned by half of the navigation axes' own turn; position takes the mean velocity of both ends; the quaternion
    becomes exp(-turn of ENU) q exp(dtheta).

    Args:
        quaternion, velocity, latitude, height: as in `Navigation`; not at a pole.
        dtheta, dv: compensated increments (..., 3), rad and m/s.
        dt: length of the step in s, number or (..., 1).
    """
    return _advance(quaternion, velocity, _middle(quaternion, velocity, latitude, height, dv, dt), dtheta, dt)


def _advance(quaternion: Tensor, velocity: Tensor, mid: _Middle, dtheta: Tensor, dt: Tensor | float) -> Advance:
    turn = mid.rate * dt
    end = velocity + _change(mid.force, mid.weight, mid.earth * dt, turn, mid.velocity)
    before, after = from_rotation_vector(torch.stack(torch.broadcast_tensors(-turn, dtheta), -2)).unbind(-2)
    q = multiply(multiply(before, quaternion), after)
    east, north, up = ((velocity + end) / 2).unbind(-1)
    return Advance(
        q / torch.linalg.vector_norm(q, dim=-1, keepdim=True),
        end,
        mid.step * north * mid.by_meridian,
        mid.step * east * mid.by_transverse / mid.cosine,
        mid.step * up,
    )


def mechanize(nav: Navigation, dtheta: Tensor, dv: Tensor, dt: Tensor | float) -> Navigation:
    """Navigation after one step of length dt (s, number or (..., 1)); arguments and order of accuracy as in `advance`.

    In float32 latitude and longitude resolve 0.4 m and the small steps of a fast mechanisation are lost in them: there,
    hold positions as metres from an origin, as `torchfilt.models.inertial.navigation.StrapdownTransition` does.
    """
    q, velocity, latitude, longitude, height = advance(
        nav.quaternion, nav.velocity, nav.latitude, nav.height, dtheta, dv, dt
    )
    return Navigation(q, velocity, nav.latitude + latitude, nav.longitude + longitude, nav.height + height)


def navigate(start: Navigation, dtheta: Tensor, dv: Tensor, dt: Tensor | float) -> Navigation:
    """The whole path of an unaided mechanisation.

    Args:
        start: with leading dims (...).
        dtheta, dv: (t, ..., 3), rad and m/s.
        dt: length of each step in s, number, or (t,) for steps of their own.

    Returns:
        Navigation with leading dims (t, ...), after each step.
    """
    nav, path = start, []
    for k in range(len(dtheta)):
        nav = mechanize(nav, dtheta[k], dv[k], dt[k] if isinstance(dt, Tensor) and dt.dim() > 0 else dt)
        path.append(nav)
    return Navigation(*(torch.stack(part) for part in zip(*path, strict=True)))


# First order ----------------------------------------------------------------------------------------------------------


class AdvanceSlopes(NamedTuple):
    """Derivatives of one step by (dv in ENU axes, velocity, latitude, height), the eight columns of each.

    turn (..., 3, 8) of the ENU axes' turn, velocity (..., 3, 8) of the velocity at the end, position (..., 3, 8) of the
    changes of longitude, latitude and height. Beside them two values: force (..., 3), the increment in ENU axes at the
    start, and enu_turn (..., 3), the turn of these axes in rad.
    """

    turn: Tensor
    velocity: Tensor
    position: Tensor
    force: Tensor
    enu_turn: Tensor


def advance_slopes(
    quaternion: Tensor,
    velocity: Tensor,
    latitude: Tensor,
    height: Tensor,
    dtheta: Tensor,
    dv: Tensor,
    dt: Tensor | float,
) -> tuple[Advance, AdvanceSlopes]:
    """A step with its derivatives, line by line those of `advance`; arguments as there."""
    mid = _middle(quaternion, velocity, latitude, height, dv, dt)
    result = _advance(quaternion, velocity, mid, dtheta, dt)
    step = mid.step
    span = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt  # beside matrices
    zero, one = torch.zeros_like(mid.sine), torch.ones_like(mid.sine)
    d_force, d_velocity = torch.eye(6, 8, dtype=velocity.dtype, device=velocity.device).split(3)
    # Latitude and height of the middle, rows (..., 8).
    by_meridian = step / 2 / mid.first_meridian + zero
    lead = by_meridian * velocity[..., 1] / mid.first_meridian
    curved = 1 - lead * radii_slopes(latitude)[0]
    d_latitude = torch.stack([zero, zero, zero, zero, by_meridian, zero, curved, -lead], -1)
    d_height = torch.stack([zero, zero, zero, zero, zero, step / 2 + zero, zero, one], -1)
    meridian, transverse, gravity_latitude, gravity_height = (
        value.unsqueeze(-1) for value in slopes(mid.latitude, mid.height)
    )
    x, y, sine, cosine = (value.unsqueeze(-1) for value in (mid.by_meridian, mid.by_transverse, mid.sine, mid.cosine))
    # 1 / (M + h), 1 / (N + h) and what becomes of them in the transport rate.
    d_x = -x.square() * (meridian * d_latitude + d_height)
    d_y = -y.square() * (transverse * d_latitude + d_height)
    tangent, d_tangent = sine / cosine, d_latitude / cosine.square()
    d_scale = torch.stack([-d_x, d_y, d_y * tangent + y * d_tangent], -2)
    axis = torch.cat([torch.zeros_like(sine), -sine, cosine], -1)
    d_earth = (WGS84.rate_rad_s * axis * dt).unsqueeze(-1) * d_latitude.unsqueeze(-2)
    d_gravity = gravity_latitude * d_latitude + gravity_height * d_height
    d_push = d_force - pad(d_gravity.unsqueeze(-2), (0, 0, 2, 0)) * span

    def d_turn(v: Tensor, d_v: Tensor) -> Tensor:
        """Of (Earth's and transport rate of the velocity v) dt."""
        east, north, d_east, d_north = v[..., 0], v[..., 1], d_v[..., 0, :], d_v[..., 1, :]
        moved = mid.scale.unsqueeze(-1) * torch.stack([d_north, d_east, d_east], -2)
        return d_earth + (moved + d_scale * torch.stack([north, east, east], -1).unsqueeze(-1)) * span

    def d_change(turn: Tensor, d_turn: Tensor, v: Tensor, d_v: Tensor) -> Tensor:
        """Of `_change`."""
        turned = (_cross_columns(turn, d_force) - _cross_columns(mid.force, d_turn)) / 2
        return d_push - turned - _cross_columns(earth + turn, d_v) + _cross_columns(v, d_earth + d_turn)

    turn, earth = mid.rate * dt, mid.earth * dt
    first = d_turn(velocity, d_velocity)
    d_middle = d_velocity + d_change(mid.first_rate * dt, first, velocity, d_velocity) / 2
    last = d_turn(mid.velocity, d_middle)
    d_end = d_velocity + d_change(turn, last, mid.velocity, d_middle)
    d_east, d_north, d_up = ((d_velocity + d_end) / 2).unbind(-2)
    east, north, _ = ((velocity + result.velocity) / 2).split(1, -1)
    longitude = (y * d_east + east * (d_y + y * tangent * d_latitude)) / cosine
    d_position = torch.stack([longitude, x * d_north + north * d_x, d_up], -2) * span
    return result, AdvanceSlopes(last, d_end, d_position, mid.force, turn)


def _cross_columns(a: Tensor, columns: Tensor) -> Tensor:
    """Vector (..., 3) cross each column (..., 3, k)."""
    return torch.linalg.cross(*torch.broadcast_tensors(a.unsqueeze(-1), columns), dim=-2)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
