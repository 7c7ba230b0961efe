"""The true motion of an aircraft that flies a plan: analytic velocity and attitude, position on the ellipsoid.

Speed, climb angle and heading follow a plan of segments. Position, and what an ideal IMU senses, come from them by
Gauss-Legendre quadrature, so the truth shares no integration scheme with the mechanisation it judges.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfilt.models import attitude
from torchfilt.models.inertial.earth import earth_rate_enu, gravity, radii, transport_rate_enu
from torchfilt.models.inertial.strapdown import Navigation

STANDARD_GRAVITY_M_S2 = 9.80665
# Longest interval of the quadrature: with four nodes what it leaves out is below the rounding of a position.
_LONGEST_S = 0.1
_NODES = 4


@dataclass(frozen=True)
class Segment:
    """A part of a flight over which speed, climb angle and heading change smoothly; zeros fly straight on."""

    duration_s: float
    speed_change_m_s: float = 0.0
    climb_change_rad: float = 0.0
    heading_change_rad: float = 0.0


@dataclass(frozen=True)
class FlightPlan:
    """Start of a flight and the segments that follow.

    ``latitude_rad``, ``longitude_rad``, ``height_m``, ``speed_m_s`` over the ground, ``climb_rad`` of the velocity
    above the horizon and ``heading_rad`` clockwise from north hold at time zero.

    Raises:
        ValueError: no segments, a duration that is not positive, a speed that does not stay positive, a climb angle
            that reaches the vertical.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float
    speed_m_s: float
    segments: tuple[Segment, ...]
    climb_rad: float = 0.0
    heading_rad: float = 0.0

    def __post_init__(self) -> None:
        if not self.segments:
            raise ValueError("a flight plan needs at least one segment")
        speed, climb = self.speed_m_s, self.climb_rad
        for k, segment in enumerate((Segment(1.0), *self.segments)):
            speed, climb = speed + segment.speed_change_m_s, climb + segment.climb_change_rad
            where = "at the start" if k == 0 else f"at the end of segment {k - 1}"
            if not segment.duration_s > 0:
                raise ValueError(f"duration_s of segment {k - 1} must be positive, got {segment.duration_s}")
            if not speed > 0:
                raise ValueError(f"the speed must stay positive, it is {speed} m/s {where}")
            if not abs(climb) < math.pi / 2:
                raise ValueError(f"the climb angle must stay below a right angle, it is {climb} rad {where}")

    @property
    def duration_s(self) -> float:
        """Of the whole flight."""
        return math.fsum(segment.duration_s for segment in self.segments)


class Flight(NamedTuple):
    """A true flight at t times.

    time_s (t,); navigation with leading dim t; gyro_rad_s, accel_m_s2 (t, 3): angular rate against inertial space and
    specific force in body axes at these times; dtheta_rad, dvelocity_m_s (t - 1, 3): their integrals from each time to
    the next, which is what an ideal IMU puts out.
    """

    time_s: Tensor
    navigation: Navigation
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    dtheta_rad: Tensor
    dvelocity_m_s: Tensor


def reconnaissance() -> FlightPlan:
    """The 1000 s flight of the SINS/SAR study: climb, descent, turns both ways, a braking.

    The study gives the start, 34.2 deg N, 108.9 deg E, 2000 m, 100 m/s to the north, the end near 34.8 deg N,
    110.6 deg E, 2748 m, the top of 5875 m, and a top speed of 190, whose printed unit of km/h contradicts the speed at
    the start: m/s. The segments are ours, chosen to meet these numbers.
    """
    segments = (
        _segment(34),
        _segment(50, speed_change_m_s=90),
        _segment(40, heading_change_deg=71.6),
        _segment(20, climb_change_deg=8),
        _segment(126.52),
        _segment(20, climb_change_deg=-8),
        _segment(60),
        _segment(30, heading_change_deg=-30),
        _segment(40),
        _segment(40, heading_change_deg=60),
        _segment(40),
        _segment(30, heading_change_deg=-30),
        _segment(60),
        _segment(30, speed_change_m_s=-40),
        _segment(30),
        _segment(30, speed_change_m_s=40),
        _segment(60),
        _segment(20, climb_change_deg=-6),
        _segment(137.44),
        _segment(20, climb_change_deg=6),
        _segment(82.04),
    )
    return FlightPlan(math.radians(34.2), math.radians(108.9), 2000.0, 100.0, segments)


def _segment(
    duration_s: float, speed_change_m_s: float = 0, climb_change_deg: float = 0, heading_change_deg: float = 0
) -> Segment:
    return Segment(duration_s, speed_change_m_s, math.radians(climb_change_deg), math.radians(heading_change_deg))


def fly(plan: FlightPlan, time_s: Tensor) -> Flight:
    """True flight at given times.

    Body axes lie along the path: pitch is the climb angle, and turns are coordinated, so that the specific force has no
    part to the side but for the Earth's rotation and curvature.

    Args:
        plan: what to fly.
        time_s: (t,), float64, increasing, from 0 to the plan's duration.

    Raises:
        TypeError: times that are not float64.
        ValueError: times that are not one increasing row inside the flight.
    """
    _check_times(plan, time_s)
    time_s = time_s.contiguous()
    knots = _knots(plan, time_s)
    points, weights, inside = _gauss_legendre()
    length = knots.diff()
    motion = _path(plan, knots[:-1, None] + length[:, None] * points)
    latitude, longitude, height = _positions(plan, motion.velocity_m_s, length, weights, inside)
    sensed = torch.cat(_sensed(motion, latitude.nodes, height.nodes), -1)
    total = _running(length.unsqueeze(-1) * (weights.unsqueeze(-1) * sensed).sum(-2))
    at = torch.searchsorted(knots, time_s)
    here = _path(plan, time_s)
    place = [part.ends[at] for part in (latitude, longitude, height)]
    navigation = Navigation(here.quaternion, here.velocity_m_s, *place)
    dtheta, dvelocity = total[at].diff(dim=0).split(3, -1)
    return Flight(time_s, navigation, *_sensed(here, place[0], place[2]), dtheta, dvelocity)


def _check_times(plan: FlightPlan, time_s: Tensor) -> None:
    if time_s.dtype != torch.float64:
        raise TypeError(f"time_s must be float64, got {time_s.dtype}")
    if time_s.dim() != 1 or len(time_s) == 0:
        raise ValueError(f"time_s must be one row of times (t,), got shape {tuple(time_s.shape)}")
    rising = time_s.diff() > 0
    if not rising.all():
        k = int(rising.logical_not().nonzero()[0])
        raise ValueError(f"time_s must increase, entries {k} and {k + 1} are {time_s[k]} and {time_s[k + 1]}")
    if not (time_s[0] >= 0 and time_s[-1] <= plan.duration_s * (1 + 1e-12)):  # sums of durations round
        raise ValueError(
            f"time_s must lie inside the flight, 0 to {plan.duration_s} s, got {time_s[0]} to {time_s[-1]} s"
        )


def _knots(plan: FlightPlan, time_s: Tensor) -> Tensor:
    """Ends of the intervals of the quadrature: the times, the joints of the segments, and enough between them."""
    joints = torch.tensor([segment.duration_s for segment in plan.segments], dtype=torch.float64).cumsum(0)
    even = torch.arange(0, float(time_s[-1]), _LONGEST_S, dtype=torch.float64)
    knots = torch.cat([even, joints[joints < time_s[-1]], time_s]).unique()
    return torch.cat([knots.new_zeros(1), knots]) if len(knots) == 1 else knots


def _gauss_legendre() -> tuple[Tensor, Tensor, Tensor]:
    """Nodes (s,) and weights (s,) on [0, 1], and the matrix (s, s) that integrates from 0 to each node."""
    points, weights = np.polynomial.legendre.leggauss(_NODES)
    points, weights = (points + 1) / 2, weights / 2
    powers = np.arange(_NODES)
    # Exact for the polynomials through the nodes.
    inside = (points[:, None] ** (powers + 1) / (powers + 1)) @ np.linalg.inv(points[:, None] ** powers)
    return torch.from_numpy(points), torch.from_numpy(weights), torch.from_numpy(inside)


# Path: velocity and attitude with their derivatives ------------------------------------------------------------------


class _Motion(NamedTuple):
    """Attitude, velocity, their derivatives: acceleration of the ENU components, turn rate of body against ENU axes."""

    quaternion: Tensor
    velocity_m_s: Tensor
    acceleration_m_s2: Tensor
    turn_rad_s: Tensor


def _smooth_step(s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """From 0 at s = 0 to 1 at s = 1 with three vanishing derivatives at both ends; with the first two derivatives."""
    rest = 1 - s
    value = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    return value, 140 * (s * rest) ** 3, 420 * (s * rest) ** 2 * (1 - 2 * s)


def _profiles(plan: FlightPlan, time_s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Speed, climb angle and heading (..., 3) at times (...), with first and second derivatives."""
    parts = plan.segments
    duration = torch.tensor([p.duration_s for p in parts], dtype=torch.float64)
    change = torch.tensor(
        [(p.speed_change_m_s, p.climb_change_rad, p.heading_change_rad) for p in parts], dtype=torch.float64
    )
    first = torch.tensor([plan.speed_m_s, plan.climb_rad, plan.heading_rad], dtype=torch.float64)
    start, before = duration.cumsum(0) - duration, first + change.cumsum(0) - change
    which = (torch.searchsorted(start, time_s.contiguous(), right=True) - 1).clamp(0, len(parts) - 1)
    length = duration[which]
    value, rate, curvature = _smooth_step((time_s - start[which]) / length)
    change = change[which]
    return (
        before[which] + change * value.unsqueeze(-1),
        change * (rate / length).unsqueeze(-1),
        change * (curvature / length**2).unsqueeze(-1),
    )


def _path(plan: FlightPlan, time_s: Tensor) -> _Motion:
    """Motion at times (...)."""
    (v, climb, heading), (dv, dclimb, dheading), (_, ddclimb, ddheading) = (
        part.unbind(-1) for part in _profiles(plan, time_s)
    )
    sc, cc, sh, ch = climb.sin(), climb.cos(), heading.sin(), heading.cos()
    level, dlevel = v * cc, dv * cc - v * sc * dclimb  # horizontal speed and its derivative
    velocity = torch.stack([level * sh, level * ch, v * sc], -1)
    acceleration = torch.stack(
        [dlevel * sh + level * ch * dheading, dlevel * ch - level * sh * dheading, dv * sc + v * cc * dclimb], -1
    )
    # Roll turns the top of the vehicle along the specific force across the path.
    g = STANDARD_GRAVITY_M_S2
    side, top = level * dheading, g * cc + v * dclimb
    dside, dtop = dlevel * dheading + level * ddheading, -g * sc * dclimb + dv * dclimb + v * ddclimb
    roll, droll = torch.atan2(side, top), (dside * top - side * dtop) / (side**2 + top**2)
    # Heading turns about -up, pitch about right, roll about forward: each rate in the axes after the later turns.
    sr, cr = roll.sin(), roll.cos()
    turn = torch.stack([cr * dclimb + sr * cc * dheading, droll - sc * dheading, sr * dclimb - cr * cc * dheading], -1)
    return _Motion(attitude.from_euler(heading, climb, roll), velocity, acceleration, turn)


def _sensed(motion: _Motion, latitude_rad: Tensor, height_m: Tensor) -> tuple[Tensor, Tensor]:
    """Angular rate against inertial space and specific force, body axes, (..., 3) each."""
    earth = earth_rate_enu(latitude_rad)
    transport = transport_rate_enu(latitude_rad, height_m, motion.velocity_m_s)
    to_body = attitude.inverse(motion.quaternion)
    force = motion.acceleration_m_s2 + torch.linalg.cross(2 * earth + transport, motion.velocity_m_s)
    force = torch.cat([force[..., :2], force[..., 2:] + gravity(latitude_rad, height_m).unsqueeze(-1)], -1)
    return attitude.rotate(to_body, earth + transport) + motion.turn_rad_s, attitude.rotate(to_body, force)


# Position -------------------------------------------------------------------------------------------------------------


class _Integral(NamedTuple):
    """A coordinate at the knots (intervals + 1,) and at the nodes between them (intervals, s)."""

    ends: Tensor
    nodes: Tensor


def _running(steps: Tensor) -> Tensor:
    """Running sums of steps (k, ...) from zero, (k + 1, ...)."""
    return torch.cat([steps.new_zeros(1, *steps.shape[1:]), steps.cumsum(0)])


def _integrate(start: float, rate: Tensor, length: Tensor, weights: Tensor, inside: Tensor) -> _Integral:
    """Integral of rates (intervals, s) at the nodes."""
    ends = start + _running(length * (rate * weights).sum(-1))
    return _Integral(ends, ends[:-1, None] + length[:, None] * (rate.unsqueeze(-2) * inside).sum(-1))


def _positions(
    plan: FlightPlan, velocity: Tensor, length: Tensor, weights: Tensor, inside: Tensor
) -> tuple[_Integral, _Integral, _Integral]:
    """Latitude, longitude and height from the velocity (intervals, s, 3) at the nodes."""
    east, north, up = velocity.unbind(-1)
    height = _integrate(plan.height_m, up, length, weights, inside)
    # The meridian's radius hardly depends on the latitude: a round divides the error by the flight's share of the
    # radius times the eccentricity squared, 3e-4 for a flight of 200 km.
    latitude = _Integral(length, torch.full_like(north, plan.latitude_rad))
    for _ in range(8):
        before = latitude.nodes
        latitude = _integrate(plan.latitude_rad, north / (radii(before)[0] + height.nodes), length, weights, inside)
        if (latitude.nodes - before).abs().max() < 1e-15:
            break
    across = (radii(latitude.nodes)[1] + height.nodes) * latitude.nodes.cos()
    return latitude, _integrate(plan.longitude_rad, east / across, length, weights, inside), height
