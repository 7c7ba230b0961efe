"""Errors of an inertial navigation system as a state of their own, without small angles.

The state (..., 16) is what the computed navigation differs from the true one by, computed minus true, on `ERROR_SPACE`:
error quaternion dq with C_computed = C(dq) C_true (left, ENU axes), velocity (3) m/s, position (3) in the metres of a
`LocalMetres`, gyro drift (3) rad/s and accelerometer bias (3) m/s^2. Both biases: measured = true + bias + noise.

The motion of the errors depends on what the system itself computed over a step of the filter; `sins_inputs` runs it
and condenses each step into a control u (..., 20), see `SinsStep`.
"""

import math
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from torchfilt.gaussian import LOG_2PI, Gaussian
from torchfilt.laws import hold
from torchfilt.models import attitude
from torchfilt.models.inertial.earth import (
    WGS84,
    LocalMetres,
    earth_rate_enu,
    gravity,
    gravity_at,
    radii,
    radii_at,
    slopes,
    transport_rate_enu,
)
from torchfilt.models.inertial.imu import ImuGrade, StartErrors
from torchfilt.models.inertial.strapdown import Navigation, increments, navigate
from torchfilt.quaternions import (
    Quaternion,
    Vector,
    apply,
    cross,
    exponential,
    minus,
    product,
    quaternion,
    rotate,
    rotate_back,
    stack,
    vector,
)
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion, wrap_angle

ERROR_SPACE = Product(UnitQuaternion("left"), Euclidean(12))
FIX_SPACE = Product(Angle(1), Euclidean(3))
CONTROL_SIZE = 20

Step = Tensor | float | None


# ----------------------------------------------------------------------------------------------------------------------
# The state: from and to navigation


def no_error(dtype: torch.dtype = torch.float64) -> Tensor:
    """The error state (16,) of a perfect system."""
    return torch.cat([attitude.from_rotation_vector(torch.zeros(3, dtype=dtype)), torch.zeros(12, dtype=dtype)])


def error_of(
    computed: Navigation, true: Navigation, origin: LocalMetres, gyro_drift_rad_s: Tensor, accel_bias_m_s2: Tensor
) -> Tensor:
    """Error state (..., 16) of a computed navigation; biases (..., 3); leading dims broadcast."""
    turn = attitude.multiply(*torch.broadcast_tensors(computed.quaternion, attitude.inverse(true.quaternion)))
    parts = [turn, computed.velocity - true.velocity, _metres(computed, origin) - _metres(true, origin)]
    parts += [gyro_drift_rad_s, accel_bias_m_s2]
    lead = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*lead, -1) for part in parts], -1)


def add_error(true: Navigation, x: Tensor, origin: LocalMetres) -> Navigation:
    """What a system with error x (..., 16) computes."""
    turned = attitude.multiply(*torch.broadcast_tensors(x[..., :4], true.quaternion))
    place = origin.to_geodetic(_metres(true, origin) + x[..., 7:10])
    return Navigation(turned, true.velocity + x[..., 4:7], *place)


def remove_error(computed: Navigation, x: Tensor, origin: LocalMetres) -> Navigation:
    """The true navigation of a system with error x (..., 16); the inverse of `add_error`."""
    turned = attitude.multiply(*torch.broadcast_tensors(attitude.inverse(x[..., :4]), computed.quaternion))
    place = origin.to_geodetic(_metres(computed, origin) - x[..., 7:10])
    return Navigation(turned, computed.velocity - x[..., 4:7], *place)


def _metres(navigation: Navigation, origin: LocalMetres) -> Tensor:
    return origin.to_metres(navigation.latitude, navigation.longitude, navigation.height)


def start_law(start: StartErrors, grade: ImuGrade) -> Gaussian:
    """Law of the error state at the start: unbiased, independent, float64."""
    deviation = [*start.attitude_sd_rad, *[start.velocity_sd_m_s] * 3, *start.position_sd_m]
    deviation += [grade.gyro_bias_sd_rad_s] * 3 + [grade.accel_bias_sd_m_s2] * 3
    return Gaussian(no_error(), torch.tensor(deviation, dtype=torch.float64), ERROR_SPACE, is_diagonal=True)


# ----------------------------------------------------------------------------------------------------------------------
# What the system computed: the control


class SinsStep(NamedTuple):
    """A control vector u (..., 20) by its parts; the field order is the layout.

    rotation_s (..., 9): integral of the computed attitude matrix over the step, row by row; force_m_s (..., 3):
    integral of the computed specific force in ENU axes; at the middle of the step velocity_m_s (..., 3), latitude_rad
    and height_m (..., 1); forward (..., 3): the forward axis at the end of the step, ENU.
    """

    rotation_s: Tensor
    force_m_s: Tensor
    velocity_m_s: Tensor
    latitude_rad: Tensor
    height_m: Tensor
    forward: Tensor


def split_control(u: Tensor | None) -> SinsStep:
    """Parts of a control.

    Raises:
        ValueError: no control, or another number of entries.
    """
    if u is None or u.shape[-1] != CONTROL_SIZE:
        got = "none" if u is None else f"shape {tuple(u.shape)}"
        raise ValueError(f"this law reads what the SINS computed from a control u (..., {CONTROL_SIZE}), got {got}")
    return SinsStep(*u.split([9, 3, 3, 1, 1, 3], -1))


class SinsRun(NamedTuple):
    """An open-loop run over t steps of a filter: controls u (t, *batch, 20) and the navigation after each step."""

    u: Tensor
    navigation: Navigation


def sins_inputs(
    start: Navigation,
    dtheta_rad: Tensor,
    dvelocity_m_s: Tensor,
    interval_s: float,
    samples: int = 100,
    group: int = 10,
) -> SinsRun:
    """Run the SINS without corrections and condense it for `InertialErrorTransition`.

    Args:
        start: computed navigation at the start, leading dims (*batch).
        dtheta_rad, dvelocity_m_s: IMU increments (t * samples, *batch, 3).
        interval_s: time of an increment.
        samples: increments in a step of the filter.
        group: increments in a step of the mechanisation, see `strapdown.increments`; an odd one joins them without
            coning and sculling terms.

    Raises:
        ValueError: increments that do not fill whole steps, a group that does not divide a step.
    """
    if samples < 1 or group < 1 or samples % group or (samples // group) % 2:
        raise ValueError(f"a step of {samples} samples must hold an even number of groups, got groups of {group}")
    if len(dtheta_rad) == 0 or len(dtheta_rad) % samples:
        raise ValueError(f"increments must fill steps of {samples} samples, got {len(dtheta_rad)}")
    count, step_s = samples // group, group * interval_s
    path = navigate(start, *increments(dtheta_rad, dvelocity_m_s, 1.0, group), step_s)
    path = Navigation(*(torch.cat([a.expand_as(b[0]).unsqueeze(0), b]) for a, b in zip(start, path, strict=True)))
    first = torch.arange(0, len(dtheta_rad) // group, count).unsqueeze(-1)
    within = Navigation(*(part[first + torch.arange(count + 1)] for part in path))  # (t, count + 1, *batch, ...)
    middle, end = (Navigation(*(part[:, k] for part in within)) for k in (count // 2, count))
    # Simpson's rule over the steps of the mechanisation.
    weights = torch.tensor([1.0, *[4.0, 2.0] * (count // 2 - 1), 4.0, 1.0], dtype=dtheta_rad.dtype) * (step_s / 3)

    def integral(values: Tensor) -> Tensor:
        return (values.movedim(1, -1) * weights).sum(-1)

    # Of the velocity gained, what Coriolis and gravity do not explain is specific force.
    gained = end.velocity - within.velocity[:, 0]
    parts = [
        integral(attitude.to_matrix(within.quaternion).flatten(-2)),
        gained - integral(_without_force(within)),
        middle.velocity,
        middle.latitude.unsqueeze(-1),
        middle.height.unsqueeze(-1),
        attitude.to_matrix(end.quaternion)[..., 1],  # the second body axis is the forward one
    ]
    return SinsRun(torch.cat(parts, -1), end)


def _without_force(navigation: Navigation) -> Tensor:
    """Acceleration (..., 3) by Coriolis and gravity, ENU, m/s^2."""
    velocity, latitude, height = navigation.velocity, navigation.latitude, navigation.height
    rate = 2 * earth_rate_enu(latitude) + transport_rate_enu(latitude, height, velocity)
    weight = torch.nn.functional.pad(gravity(latitude, height).unsqueeze(-1), (2, 0))
    return -torch.linalg.cross(rate, velocity) - weight


# ----------------------------------------------------------------------------------------------------------------------
# Motion of the errors


class InertialErrorTransition(nn.Module):
    """Motion of the error state over a step; u as made by `sins_inputs`, dt its length in s.

    Exact in the attitude error. The Earth's terms are those of the middle of the step, and the force counts as even
    over it: in a manoeuvre the position lags by dt^2 / 12 of the error's acceleration.

    White noise of gyros and accelerometers reaches attitude and velocity only, so that the noise has rank 6 of 15; what
    the gyros' noise of a step does to the velocity in the same step is left to the next one. Both are alike in all
    directions, hence it does not matter through which attitude they enter.

    Args:
        origin: where the metres of the position are counted from.
        angle_random_walk_rad_sqrt_s, velocity_random_walk_m_s_sqrt_s: roots of the spectral densities, as in
            `ImuGrade`; numbers or scalar tensors (a parameter trains).

    Raises:
        ValueError: a negative density.

    Source: Titterton and Weston, Strapdown Inertial Navigation Technology (2004), chapter 12, before linearisation.
    """

    angle_random_walk_rad_sqrt_s: Tensor
    velocity_random_walk_m_s_sqrt_s: Tensor
    noise_in = slice(0, 6)

    def __init__(
        self,
        origin: LocalMetres,
        angle_random_walk_rad_sqrt_s: Tensor | float,
        velocity_random_walk_m_s_sqrt_s: Tensor | float,
    ) -> None:
        super().__init__()
        given = {
            "angle_random_walk_rad_sqrt_s": angle_random_walk_rad_sqrt_s,
            "velocity_random_walk_m_s_sqrt_s": velocity_random_walk_m_s_sqrt_s,
        }
        for name, value in given.items():
            density = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
            if density.dim() != 0 or not bool(density.detach() >= 0):
                raise ValueError(f"{name} must be one number >= 0, got {value}")
            hold(self, name, density)
        self.origin = origin
        self.space = ERROR_SPACE

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the errors (..., 16) after a step."""
        motion = _propagate(x, split_control(u), _scalar_step(dt), self.origin)
        return Gaussian(motion.mean(x), self._deviation(x, dt), ERROR_SPACE, is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its Jacobian (..., 15, 15) from tangent vectors at x to tangent vectors at its mean."""
        sins, step = split_control(u), _scalar_step(dt)
        motion = _propagate(x, sins, step, self.origin)
        law = Gaussian(motion.mean(x), self._deviation(x, dt), ERROR_SPACE, is_diagonal=True)
        return law, _slopes(x, sins, step, self.origin, motion)

    def _deviation(self, x: Tensor, dt: Step) -> Tensor:
        """Standard deviations (15,), or (*lead, 15) for time steps of their own."""
        walks = [self.angle_random_walk_rad_sqrt_s] * 3 + [self.velocity_random_walk_m_s_sqrt_s] * 3
        each = torch.nn.functional.pad(torch.stack(walks).to(x.dtype), (0, 9))
        return each * (dt.sqrt() if isinstance(dt, Tensor) else float(dt or 0) ** 0.5)


def _scalar_step(dt: Step) -> Tensor | float:
    """The time step without the last dim of a (*lead, 1)."""
    if dt is None:
        raise ValueError("no time step: give dt to the call, in s")
    return dt.squeeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt


class _Motion(NamedTuple):
    """Errors after a step, and what its derivatives need of the way there.

    turn: rotation vector of the attitude error over the step. middle: attitude error half-way. felt: integral of the
    specific force without its bias, computed axes. true_velocity, true_latitude, true_height: half-way. turned_rate:
    true rate of the ENU axes, turned by the attitude error. mean_velocity: error, mean of both ends. scale: as in
    `_EarthTerms`, at the true place.
    """

    attitude: Quaternion
    velocity: Vector
    position: Vector
    turn: Vector
    middle: Quaternion
    felt: Vector
    true_velocity: Vector
    true_latitude: Tensor
    true_height: Tensor
    turned_rate: Vector
    mean_velocity: Vector
    scale: tuple[Tensor, Tensor]

    def mean(self, x: Tensor) -> Tensor:
        """The state (..., 16); biases as in x."""
        return stack([*self.attitude.parts(), *self.velocity, *self.position, *x[..., 10:].unbind(-1)])


def _propagate(x: Tensor, u: SinsStep, dt: Tensor | float, origin: LocalMetres) -> _Motion:
    """Errors after a step of the mid-point rule."""
    error = quaternion(x[..., :4])
    velocity, position, drift, bias = (vector(part.unbind(-1)) for part in x[..., 4:].split(3, -1))
    attitude_s, force, computed = (
        u.rotation_s.unbind(-1),
        vector(u.force_m_s.unbind(-1)),
        vector(u.velocity_m_s.unbind(-1)),
    )
    latitude, height = u.latitude_rad.squeeze(-1), u.height_m.squeeze(-1)

    # Specific force less the bias, in computed axes: turned back by the attitude error it is the true one.
    felt = minus(force, apply(attitude_s, bias))
    gained = minus(force, rotate_back(error, felt))
    # Half-way, the Earth's terms left out: there they would change nothing that counts.
    half_velocity = vector([torch.add(v, g, alpha=0.5) for v, g in zip(velocity, gained, strict=True)])
    north, up = _after(position[1], velocity[1], 0.5 * dt), _after(position[2], velocity[2], 0.5 * dt)
    true_velocity = minus(computed, half_velocity)
    true_latitude, true_height = torch.sub(latitude, north, alpha=1 / origin.north_m), height - up
    seen = _earth_terms(computed, latitude, height, origin)
    real = _earth_terms(true_velocity, true_latitude, true_height, origin)

    # d/dt C(dq) = [(C_computed drift - w_computed + C(dq) w_true) x] C(dq), w the rate of the ENU axes.
    turned_rate = rotate(error, real.rate)
    turning = zip(apply(attitude_s, drift), seen.rate, turned_rate, strict=True)
    turn = vector([_after(d, r - s, dt) for d, s, r in turning])
    half_turn = exponential(turn, 0.5)
    middle = product(half_turn, error)

    pushed = minus(force, rotate_back(middle, felt))
    pushing = zip(velocity, pushed, seen.acceleration, real.acceleration, strict=True)
    after = vector([_after(v + p, s - r, dt) for v, p, s, r in pushing])
    mean_velocity = vector([torch.lerp(v, a, 0.5) for v, a in zip(velocity, after, strict=True)])
    # The computed position moves by seen.scale * computed, the true one by real.scale * (computed - mean_velocity).
    ground = zip(position[:2], seen.scale, real.scale, computed[:2], mean_velocity[:2], strict=True)
    moved = [_after(p, torch.addcmul((s - r) * c, r, m), dt) for p, s, r, c, m in ground]
    return _Motion(
        product(half_turn, middle), after, vector([*moved, _after(position[2], mean_velocity[2], dt)]), turn, middle,
        felt, true_velocity, true_latitude, true_height, turned_rate, mean_velocity, real.scale,
    )  # fmt: skip


def _after(start: Tensor, rate: Tensor, dt: Tensor | float) -> Tensor:
    """Where a constant rate leads to."""
    return torch.addcmul(start, rate, dt) if isinstance(dt, Tensor) else torch.add(start, rate, alpha=dt)


class _EarthTerms(NamedTuple):
    """Rate of the ENU axes (rad/s) and acceleration by Coriolis and gravity (m/s^2), both ENU; metres of a
    `LocalMetres` per metre on the ground, east and north.
    """

    rate: Vector
    acceleration: Vector
    scale: tuple[Tensor, Tensor]


def _earth_terms(velocity: Vector, latitude: Tensor, height: Tensor, origin: LocalMetres) -> _EarthTerms:
    """As `earth.earth_rate_enu` and `earth.transport_rate_enu`, by components."""
    east, north, _ = velocity
    sine, cosine = latitude.sin(), latitude.cos()
    sine2 = sine.square()
    meridian, transverse = radii_at(sine2)
    per_north, per_east = (meridian + height).reciprocal(), (transverse + height).reciprocal()
    turn = east * per_east
    spin_north, spin_up = WGS84.rate_rad_s * cosine, WGS84.rate_rad_s * sine
    rate = (-north * per_north, spin_north + turn, torch.addcmul(spin_up, turn, sine / cosine))
    coriolis = cross(velocity, (rate[0], rate[1] + spin_north, rate[2] + spin_up))
    acceleration = (coriolis[0], coriolis[1], coriolis[2] - gravity_at(sine2, height, transverse))
    return _EarthTerms(rate, acceleration, (origin.east_m * per_east / cosine, origin.north_m * per_north))


# First derivatives ----------------------------------------------------------------------------------------------------


def _slopes(x: Tensor, u: SinsStep, dt: Tensor | float, origin: LocalMetres, motion: _Motion) -> Tensor:
    """Derivative (..., 15, 15) of `_propagate` in tangent coordinates: the same steps on 15 columns at once."""
    dt = dt[..., None, None] if isinstance(dt, Tensor) else dt
    error, velocity, position, drift, bias = torch.eye(15, dtype=x.dtype, device=x.device).split(3)
    before, middle = (attitude.to_matrix(q) for q in (x[..., :4], stack(motion.middle.parts())))
    rotation = u.rotation_s.unflatten(-1, (3, 3))
    felt, d_felt = attitude.skew(stack(motion.felt)), -rotation @ bias

    gained = before.mT @ (felt @ error + d_felt)
    halfway = torch.cat([velocity - gained / 2, (position + dt * velocity / 2).expand_as(gained)], -2)
    rate, acceleration, scale = (-_earth_slopes(motion, origin) @ halfway).split(3, -2)

    turn = rotation @ drift + dt * (before @ rate - attitude.skew(stack(motion.turned_rate)) @ error)
    half_turn = attitude.mean_rotation(stack(motion.turn) / 2) @ turn / 2
    by_half = middle @ before.mT
    error_middle = half_turn + by_half @ error
    error_after = half_turn + by_half @ error_middle

    pushed = middle.mT @ (felt @ error_middle + d_felt)
    after = velocity - pushed - dt * acceleration
    ground = stack([*motion.scale, torch.ones_like(motion.scale[0])]).unsqueeze(-1)
    apart = u.velocity_m_s - stack(motion.mean_velocity)
    stretched = apart.unsqueeze(-1) * torch.nn.functional.pad(scale, (0, 0, 0, 1))
    moved = position + dt * (ground * (velocity + after) / 2 - stretched)
    rows = [error_after, after, moved, drift, bias]
    lead = torch.broadcast_shapes(*(row.shape[:-2] for row in rows))
    return torch.cat([row.expand(*lead, 3, 15) for row in rows], -2)


def _earth_slopes(motion: _Motion, origin: LocalMetres) -> Tensor:
    """Derivative (..., 8, 6) of `_earth_terms` at the true place with respect to velocity and metres of position."""
    velocity, latitude, height = stack(motion.true_velocity), motion.true_latitude, motion.true_height
    east, north, _ = motion.true_velocity
    sine, cosine = latitude.sin(), latitude.cos()
    tangent, zero = sine / cosine, torch.zeros_like(east)
    meridian, transverse = radii(latitude)
    per_north, per_east = (meridian + height).reciprocal(), (transverse + height).reciprocal()
    # d(1/r)/dr, and the radii's growth with latitude.
    fall_north, fall_east = -per_north.square(), -per_east.square()
    by_meridian, by_transverse, by_latitude, by_height = slopes(latitude, height)
    bend_north, bend_east = by_meridian * fall_north, by_transverse * fall_east
    spin_north, spin_up = WGS84.rate_rad_s * cosine, WGS84.rate_rad_s * sine
    up_bend = bend_east * tangent + per_east / cosine.square()
    # Columns: velocity east, north, up; position east, north (by latitude, scaled below), up.
    rate = _rows(
        [zero, -per_north, zero, zero, -north * bend_north, -north * fall_north],
        [per_east, zero, zero, zero, east * bend_east - spin_up, east * fall_east],
        [per_east * tangent, zero, zero, zero, east * up_bend + spin_north, east * tangent * fall_east],
    )
    spin = torch.nn.functional.pad(stack([zero, -spin_up, spin_north]).unsqueeze(-1), (4, 1))
    turn = east * per_east
    whole = stack([-north * per_north, 2 * spin_north + turn, 2 * spin_up + turn * tangent])
    by_velocity = torch.nn.functional.pad(attitude.skew(whole), (0, 3))
    weight = torch.nn.functional.pad(stack([by_latitude, by_height]).unsqueeze(-2), (4, 0, 2, 0))
    acceleration = attitude.skew(velocity) @ (rate + spin) - by_velocity - weight
    scale = _rows(
        [origin.east_m * (bend_east + per_east * tangent) / cosine, origin.east_m * fall_east / cosine],
        [origin.north_m * bend_north, origin.north_m * fall_north],
    )
    scale = torch.nn.functional.pad(scale, (4, 0))
    per_metre = rate.new_tensor([1, 1, 1, 1, 1 / origin.north_m, 1])
    return torch.cat([rate, acceleration, scale], -2) * per_metre


def _rows(*rows: list[Tensor]) -> Tensor:
    return torch.stack([stack(row) for row in rows], -2)


# ----------------------------------------------------------------------------------------------------------------------
# Measurements


def computed_minus_fix(computed: Navigation, origin: LocalMetres, heading_rad: Tensor, position_m: Tensor) -> Tensor:
    """Measurement (..., 4) for `InertialErrorFixes`: differences in heading (rad), east, north, height (m).

    Args:
        computed: what the system computed, leading dims broadcast with those of the fixes.
        origin: of the metres.
        heading_rad: heading fix (...), clockwise from north.
        position_m: position fix (..., 3) in metres of the origin.
    """
    heading, _, _ = attitude.to_euler(computed.quaternion)
    apart = _metres(computed, origin) - position_m
    turned = wrap_angle(heading - heading_rad).unsqueeze(-1)
    return torch.cat([turned.expand(*apart.shape[:-1], 1), apart], -1)


class InertialErrorFixes(nn.Module):
    """Heading, east, north and height as computed minus those of a fix; u as made by `sins_inputs`.

    The heading is that of the true attitude C(dq)^T C_computed, for errors of any size.

    Args:
        heading_sd_rad, position_sd_m, height_sd_m: standard deviations of the fixes; position means each of east and
            north. Numbers or scalar tensors.
        outlier_share: of fixes that are outliers, all four components at once, with ``outlier_factor`` times these
            deviations. The law is then a `ContaminatedNormal`, with none a `Gaussian`.

    Raises:
        ValueError: a deviation that is not positive, a share outside [0, 1), a factor not above 1.
    """

    standard_deviation: Tensor

    def __init__(
        self,
        heading_sd_rad: Tensor | float,
        position_sd_m: Tensor | float,
        height_sd_m: Tensor | float,
        outlier_share: float = 0.0,
        outlier_factor: float = 10.0,
    ) -> None:
        super().__init__()
        given = (heading_sd_rad, position_sd_m, position_sd_m, height_sd_m)
        deviation = torch.stack([v if isinstance(v, Tensor) else torch.tensor(v, dtype=torch.float64) for v in given])
        if not bool((deviation.detach() > 0).all()):
            raise ValueError(f"standard deviations must be positive, got {deviation.tolist()}")
        if not 0 <= outlier_share < 1:
            raise ValueError(f"outlier_share must be in [0, 1), got {outlier_share}")
        if not outlier_factor > 1:
            raise ValueError(f"outlier_factor must be above 1, got {outlier_factor}")
        hold(self, "standard_deviation", deviation)
        self.outlier_share, self.outlier_factor = outlier_share, outlier_factor
        self.space = FIX_SPACE

    def forward(self, x: Tensor, u: Tensor | None = None) -> "Gaussian | ContaminatedNormal":
        """Law of the differences (..., 4) given errors (..., 16)."""
        ahead = vector(split_control(u).forward.unbind(-1))
        good = self._good(x, ahead, _truly_ahead(x, ahead))
        return ContaminatedNormal(good, self.outlier_share, self.outlier_factor) if self.outlier_share else good

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x, by its moments, and its Jacobian (..., 4, 15) from tangent vectors at x."""
        forward = split_control(u).forward
        ahead = vector(forward.unbind(-1))
        east, north, _ = true = _truly_ahead(x, ahead)
        moved = attitude.to_matrix(x[..., :4]).mT @ attitude.skew(forward)
        level = (east.square() + north.square()).unsqueeze(-1)
        heading = (east.unsqueeze(-1) * moved[..., 1, :] - north.unsqueeze(-1) * moved[..., 0, :]) / level
        heading = torch.nn.functional.pad(heading, (0, 12)).unsqueeze(-2)
        position = torch.eye(15, dtype=x.dtype, device=x.device)[6:9].expand(*heading.shape[:-2], 3, 15)
        law = self._good(x, ahead, true)
        law = law._replace(scale_tril=law.scale_tril * _inflation(self.outlier_share, self.outlier_factor) ** 0.5)
        return law, torch.cat([heading, position], -2)

    def _good(self, x: Tensor, ahead: Vector, true: Vector) -> Gaussian:
        """Law of a fix that is no outlier."""
        # The angle from the true to the computed direction, without a difference of two headings.
        across = torch.addcmul(ahead[0] * true[1], ahead[1], true[0], value=-1)
        along = torch.addcmul(ahead[1] * true[1], ahead[0], true[0])
        mean = stack([torch.atan2(across, along), *x[..., 7:10].unbind(-1)])
        return Gaussian(mean, self.standard_deviation.to(x.dtype), FIX_SPACE, is_diagonal=True)


def _inflation(share: float, factor: float) -> float:
    """Variance of a contaminated law over that of its good part."""
    return 1 - share + share * factor**2


def _truly_ahead(x: Tensor, ahead: Vector) -> Vector:
    """Forward axis of the true attitude."""
    return rotate_back(quaternion(x[..., :4]), ahead)


class ContaminatedNormal(Distribution):
    """Mixture of a normal law and, for a ``share`` of outliers, one with deviations ``factor`` times as large.

    An outlier spoils all components at once.

    Args:
        law: `Gaussian` with is_diagonal, on any space.
        share: of outliers, above 0 and below 1.
        factor: ratio of the deviations.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(self, law: Gaussian, share: float, factor: float) -> None:
        self.law, self.share, self.factor = law, share, factor
        super().__init__(law.mean.shape[:-1], law.mean.shape[-1:], validate_args=False)

    @property
    def mean(self) -> Tensor:
        """Of both parts."""
        return self.law.mean

    @property
    def variance(self) -> Tensor:
        """Of the mixture."""
        return (self.law.variance * _inflation(self.share, self.factor)).expand_as(self.mean)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density of points (..., d)."""
        law, size = self.law, self.law.tangent_size
        half = (law.space.local(law.mean, value) / law.scale_tril).square().sum(-1) / -2
        good = math.log1p(-self.share) + half
        outlier = math.log(self.share) - size * math.log(self.factor) + half / self.factor**2
        return torch.logaddexp(good, outlier) - (0.5 * size * LOG_2PI + law.scale_tril.log().sum(-1))

    def sample(self, sample_shape: torch.Size | list[int] | tuple[int, ...] = ()) -> Tensor:
        """Draws (*sample_shape, ..., d), by the global generator as all torch distributions do."""
        like, lead = self.law.mean, (*sample_shape, *self.batch_shape)
        with torch.no_grad():
            outlier = torch.rand(*lead, 1, dtype=like.dtype, device=like.device) < self.share
            noise = torch.randn(*lead, self.law.tangent_size, dtype=like.dtype, device=like.device)
            return self.law.sample(torch.where(outlier, self.factor * noise, noise))
