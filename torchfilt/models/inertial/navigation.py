"""Laws on the total navigation state: motion by inertial increments, and fixes of every usual kind.

A state is 16 numbers on `NAVIGATION_SPACE`: quaternion body (RFU) to ENU [0:4], velocity over the ground, ENU, m/s
[4:7], position east, north, up of an origin in `LocalMetres` [7:10], gyro bias in rad/s [10:13], accelerometer bias in
m/s^2 [13:16]. Its error is 15 numbers in the same order, the quaternion's on the left: a rotation vector in ENU axes.
Biases are what the sensors show too much: measured = true + bias + noise.

Both laws give their first derivative by closed form (``first_order``), which `torchfilt.moments.taylor` uses.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.models.attitude import inverse, mean_rotation, rotate, skew, to_matrix
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.strapdown import Advance, Navigation, advance, advance_slopes
from torchfilt.spaces import Angle, Euclidean, Product, Space, UnitQuaternion

NAVIGATION_SPACE = Product(UnitQuaternion("left"), Euclidean(12))
CONTROL_SIZE = 6
_PARTS = (4, 3, 3, 3, 3)

Step = Tensor | float | None


def navigation_state(
    nav: Navigation, origin: LocalMetres, gyro_bias: Tensor | None = None, accel_bias: Tensor | None = None
) -> Tensor:
    """State (..., 16) of a navigation and biases (..., 3) in rad/s and m/s^2, zero where none are given."""
    position = origin.to_metres(nav.latitude, nav.longitude, nav.height)
    zero = torch.zeros_like(nav.velocity)
    biases = (zero if bias is None else bias for bias in (gyro_bias, accel_bias))
    parts = (nav.quaternion, nav.velocity, position, *biases)
    lead = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*lead, -1) for part in parts], -1)


def state_navigation(x: Tensor, origin: LocalMetres) -> Navigation:
    """Navigation of states (..., 16); the biases are ``x[..., 10:13]`` and ``x[..., 13:16]``."""
    quaternion, velocity, position, _, _ = x.split(_PARTS, -1)
    return Navigation(quaternion, velocity, *origin.to_geodetic(position))


class StrapdownTransition(nn.Module):
    """Motion of the total state by inertial increments; the control u (..., 6) is (dtheta, dv) over the step.

    Mean: the biases are taken out of the increments, to second order in the turn; one step of
    `torchfilt.models.inertial.strapdown.advance`; biases stay, or decay as first-order Gauss-Markov processes.
    Noise: white noise of the sensors turns with the axes into itself, so its factor is diagonal: attitude, velocity,
    biases; position has none of its own. It is singular: nine of fifteen directions or fewer are driven.

    Args:
        origin: of the position's metres; latitude inside +-90 degrees.
        angle_random_walk_rad_sqrt_s, velocity_random_walk_m_s_sqrt_s: roots of the spectral densities of the white
            noise of gyros and accelerometers, all axes alike.
        gyro_bias_walk_rad_s_sqrt_s, accel_bias_walk_m_s2_sqrt_s: the same of what drives the biases.
        gyro_bias_time_s, accel_bias_time_s: times in which a bias decays to 1/e; its standard deviation settles at
            walk sqrt(time / 2). None: a random walk.

        The four densities are numbers or scalar tensors (a parameter trains).

    Raises:
        ValueError: an origin that is no place, a density that is negative or not one finite number, a time that is not
            positive; when called, no control or time step, a control or state of another size, a negative step.
    """

    densities: Tensor

    def __init__(
        self,
        origin: LocalMetres,
        *,
        angle_random_walk_rad_sqrt_s: Tensor | float,
        velocity_random_walk_m_s_sqrt_s: Tensor | float,
        gyro_bias_walk_rad_s_sqrt_s: Tensor | float = 0.0,
        accel_bias_walk_m_s2_sqrt_s: Tensor | float = 0.0,
        gyro_bias_time_s: float | None = None,
        accel_bias_time_s: float | None = None,
    ) -> None:
        super().__init__()
        _check_origin(origin)
        densities = {
            "angle_random_walk_rad_sqrt_s": angle_random_walk_rad_sqrt_s,
            "velocity_random_walk_m_s_sqrt_s": velocity_random_walk_m_s_sqrt_s,
            "gyro_bias_walk_rad_s_sqrt_s": gyro_bias_walk_rad_s_sqrt_s,
            "accel_bias_walk_m_s2_sqrt_s": accel_bias_walk_m_s2_sqrt_s,
        }
        values = {name: _number(value) for name, value in densities.items()}
        for name, value in values.items():
            if value.dim() != 0 or not bool((value.detach() >= 0) & (value.detach() < math.inf)):
                raise ValueError(f"{name} must be one finite number >= 0, got {densities[name]}")
        for name, time in (("gyro_bias_time_s", gyro_bias_time_s), ("accel_bias_time_s", accel_bias_time_s)):
            if time is not None and not 0 < time < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {time}")
        angle, push, gyro, accel = values.values()
        each = (angle, push, torch.zeros_like(angle), gyro, accel)
        hold(self, "densities", torch.stack([value for value in each for _ in range(3)]))
        self.origin = origin
        self.bias_times_s = (gyro_bias_time_s, accel_bias_time_s)
        self.space = NAVIGATION_SPACE

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 16) after a step of dt (number or (..., 1)), s, with increments u (..., 6)."""
        _check_state(x)
        control, dt = _check_control(u, dt)
        quaternion, velocity, position, gyro_bias, accel_bias = x.split(_PARTS, -1)
        dtheta, dv = _without_biases(control, gyro_bias, accel_bias, dt)
        place = self._place(position)
        return self._law(x, advance(quaternion, velocity, *place, dtheta, dv, dt), dt)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., 15, 15) of its mean's error by the error of x."""
        _check_state(x)
        control, dt = _check_control(u, dt)
        quaternion, velocity, position, gyro_bias, accel_bias = x.split(_PARTS, -1)
        dtheta, dv = _without_biases(control, gyro_bias, accel_bias, dt)
        step, slopes = advance_slopes(quaternion, velocity, *self._place(position), dtheta, dv, dt)
        span = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt
        axes = to_matrix(quaternion)
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        # The force in ENU axes by attitude, gyro bias and accelerometer bias.
        by_gyro = axes @ skew(control[..., 3:] - accel_bias * dt) * (span / 2)
        by_accel = (axes + axes @ skew(dtheta) / 2) * -span
        force = torch.cat(torch.broadcast_tensors(-skew(slopes.force), by_gyro, by_accel), -1)
        # Attitude, velocity, position at the end by (force, velocity, latitude, height). ENU turns by 1e-3 rad in a
        # long step, so that the mean of its rotations may stop at the second order.
        turn = skew(slopes.enu_turn)
        back = eye - turn + turn @ turn / 2
        by_turn = -slopes.turn + turn @ (slopes.turn / 2 - turn @ slopes.turn / 6)
        scale = x.new_tensor([[self.origin.east_m], [self.origin.north_m], [1.0]])
        ends = torch.cat([by_turn, slopes.velocity, scale * slopes.position], -2)
        by_force = ends[..., :3] @ force
        by_north, by_up = ends[..., 6:7] / self.origin.north_m, ends[..., 7:]
        rows = [by_force[..., :3], ends[..., 3:6], torch.zeros_like(by_up), by_north, by_up, by_force[..., 3:]]
        attitude, moving, place = torch.cat(rows, -1).split(3, -2)
        # What does not pass through the force: attitude turned back with ENU, the turn by the gyro's bias, the place.
        turned = back @ (axes @ mean_rotation(dtheta)) * -span
        attitude = attitude + pad(back, (0, 12)) + pad(turned, (9, 3))
        place = place + pad(eye, (6, 6))
        biases = pad(torch.diag_embed(self._decay(x, dt)), (9, 0)).expand(*x.shape[:-1], 6, 15)
        return self._law(x, step, dt), torch.cat([attitude, moving, place, biases], -2)

    def _place(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Latitude and height; longitude takes no part in the motion."""
        return (
            self.origin.latitude_rad + position[..., 1] / self.origin.north_m,
            self.origin.height_m + position[..., 2],
        )

    def _decay(self, x: Tensor, dt: Tensor | float) -> Tensor:
        """What is left of the six biases after a step, (6,) or (..., 6)."""
        if not any(self.bias_times_s):
            return x.new_ones(6)
        step = (dt if dt.dim() > 0 else dt.reshape(1)) if isinstance(dt, Tensor) else x.new_tensor([dt])
        left = [torch.ones_like(step) if time is None else torch.exp(-step / time) for time in self.bias_times_s]
        return torch.cat([part.expand(*step.shape[:-1], 3) for part in left], -1)

    def _law(self, x: Tensor, step: Advance, dt: Tensor | float) -> Gaussian:
        metres = torch.stack(
            [step.longitude_rad * self.origin.east_m, step.latitude_rad * self.origin.north_m, step.height_m], -1
        )
        biases = x[..., 10:]
        if any(self.bias_times_s):
            biases = biases * self._decay(x, dt)
        mean = torch.cat([step.quaternion, step.velocity, x[..., 7:10] + metres, biases], -1)
        densities = self.densities.to(x.dtype)
        if not any(self.bias_times_s):
            return Gaussian(mean, densities * dt**0.5, self.space, is_diagonal=True)
        spans = [dt, dt, dt, *(_driven_span(dt, time) for time in self.bias_times_s)]
        parts = [part * span**0.5 for part, span in zip(densities.split(3), spans, strict=True)]
        return Gaussian(mean, torch.cat(parts, -1), self.space, is_diagonal=True)


def _driven_span(dt: Tensor | float, time_s: float | None) -> Tensor | float:
    """Integral of the squared decay over a step: variance a unit of density, s."""
    if time_s is None:
        return dt
    if isinstance(dt, Tensor):
        return -time_s / 2 * torch.expm1(-2 * dt / time_s)
    return -time_s / 2 * math.expm1(-2 * dt / time_s)


def _without_biases(u: Tensor, gyro_bias: Tensor, accel_bias: Tensor, dt: Tensor | float) -> tuple[Tensor, Tensor]:
    """Increments of sensors without biases.

    The force was turned by angles that the gyro's bias made too large, and the accelerometer's bias turned with the
    body: both are taken out of dv to first order in the bias and second in the turn.
    """
    dtheta, dv = u.split(3, -1)
    turn, push = gyro_bias * dt, accel_bias * dt
    dtheta, dv = torch.broadcast_tensors(dtheta, turn)[0], dv - push
    return dtheta - turn, dv - (torch.linalg.cross(turn, dv) + torch.linalg.cross(dtheta, push)) / 2


def _check_state(x: Tensor) -> None:
    if x.shape[-1] != sum(_PARTS):
        raise ValueError(f"the state must be (..., {sum(_PARTS)}), got {tuple(x.shape)}")


def _check_control(u: Tensor | None, dt: Step) -> tuple[Tensor, Tensor | float]:
    if u is None or u.shape[-1] != CONTROL_SIZE:
        got = "none" if u is None else f"shape {tuple(u.shape)}"
        raise ValueError(f"this law needs increments (dtheta, dv) as a control u (..., {CONTROL_SIZE}), got {got}")
    if dt is None:
        raise ValueError("this law needs the time step dt over which the increments were taken")
    if not isinstance(dt, Tensor) and not dt >= 0:
        raise ValueError(f"dt must be >= 0, got {dt}")
    return u, dt


def _check_origin(origin: LocalMetres) -> None:
    values = tuple(float(value) for value in origin)
    if not all(map(math.isfinite, values)) or abs(values[0]) >= math.pi / 2:
        raise ValueError(f"origin must be a finite place with its latitude inside +-pi/2 rad, got {values}")


def _number(value: Tensor | float) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)


# Fixes ----------------------------------------------------------------------------------------------------------------


class _Seen(NamedTuple):
    """A state as fixes see it: its parts, and what arms add (None where there is no arm)."""

    quaternion: Tensor
    velocity: Tensor
    position: Tensor
    antenna_m: Tensor | None = None  # in body axes, (..., 3)
    axle_m: Tensor | None = None
    antenna: Tensor | None = None  # in ENU axes
    antenna_velocity: Tensor | None = None  # by the angular rate, ENU
    axle_velocity: Tensor | None = None  # by the angular rate, body axes


def _plus(value: Tensor, arm: Tensor | None) -> Tensor:
    return value if arm is None else value + arm


def _ahead(seen: _Seen) -> Tensor:
    """Forward axis in ENU."""
    return rotate(seen.quaternion, seen.velocity.new_tensor([0.0, 1.0, 0.0]))


def _heading(seen: _Seen) -> Tensor:
    ahead = _ahead(seen)
    return torch.atan2(ahead[..., :1], ahead[..., 1:2])


_VALUES: dict[str, Callable[[_Seen], Tensor]] = {
    "position": lambda seen: _plus(seen.position, seen.antenna),
    "velocity": lambda seen: _plus(seen.velocity, seen.antenna_velocity),
    "height": lambda seen: seen.position[..., 2:],
    "heading": _heading,
    "body_velocity": lambda seen: _plus(rotate(inverse(seen.quaternion), seen.velocity), seen.axle_velocity),
}
_SIZES = {"position": 3, "velocity": 3, "height": 1, "heading": 1, "body_velocity": 3}


class _Blocks(NamedTuple):
    """Derivative of a part, three columns each; None is zero."""

    attitude: Tensor | None = None
    velocity: Tensor | None = None
    position: Tensor | None = None
    gyro_bias: Tensor | None = None


def _position_slope(seen: _Seen) -> _Blocks:
    turned = None if seen.antenna is None else -skew(seen.antenna)
    return _Blocks(attitude=turned, position=_eye(seen))


def _velocity_slope(seen: _Seen) -> _Blocks:
    if seen.antenna_velocity is None or seen.antenna_m is None:
        return _Blocks(velocity=_eye(seen))
    by_rate = to_matrix(seen.quaternion) @ skew(seen.antenna_m)
    return _Blocks(-skew(seen.antenna_velocity), _eye(seen), gyro_bias=by_rate)


def _heading_slope(seen: _Seen) -> _Blocks:
    """A turn about up takes off heading; about a horizontal axis it counts with the tangent of the pitch."""
    east, north, up = _ahead(seen).unbind(-1)
    square = east.square() + north.square()
    row = torch.stack([up * east / square, up * north / square, -torch.ones_like(up)], -1)
    return _Blocks(attitude=row.unsqueeze(-2))


def _body_velocity_slope(seen: _Seen) -> _Blocks:
    to_body = to_matrix(seen.quaternion).mT
    by_rate = None if seen.axle_m is None else skew(seen.axle_m)
    return _Blocks(to_body @ skew(seen.velocity), to_body, gyro_bias=by_rate)


_SLOPES: dict[str, Callable[[_Seen], _Blocks]] = {
    "position": _position_slope,
    "velocity": _velocity_slope,
    "height": lambda seen: _Blocks(position=_eye(seen)[2:]),
    "heading": _heading_slope,
    "body_velocity": _body_velocity_slope,
}


def _eye(seen: _Seen) -> Tensor:
    return torch.eye(3, dtype=seen.velocity.dtype, device=seen.velocity.device)


class NavigationFixes(nn.Module):
    """Measurements of the total state: as many kinds as have a standard deviation, in the order of the arguments.

    Give NaN for what is not measured at a time: `assemble` does. That a vehicle stands still is a velocity of zeros;
    that a car neither slides nor jumps is a body velocity (0, NaN, 0), with an odometer (0, speed, 0).

    Args:
        position_sd_m: of (east, north, up) in metres of the origin, (3,) or one number for all.
        velocity_sd_m_s: of the velocity over the ground, ENU, (3,) or one number.
        height_sd_m: of a height above the origin (barometer), one number.
        heading_sd_rad: clockwise from north, an `Angle`, one number; not for a nose that points straight up or down.
        body_velocity_sd_m_s: of the velocity over the ground in body axes (right, forward, up), (3,) or one number.
        antenna_m: place (3,) in body axes of what measures position and velocity, seen from the inertial sensors.
        axle_m: place (3,) in body axes of the point whose body velocity is measured, such as the middle of the rear
            axle, which does not slide sideways in a turn.

        Standard deviations are numbers or tensors. An arm adds to a velocity by the mean angular rate over the step,
        from u and dt, zero where dt is zero; the Earth's rate is left in, 7e-5 m/s a metre. The metres of an arm are
        taken as metres of the position, whose scale is off by 1 % some 100 km from the origin.

    Raises:
        ValueError: nothing to measure, a deviation that is not positive or of another size, an arm that is not three
            finite numbers or has nothing to belong to; when called, an arm of a velocity without u and dt, a state or
            control of another size.
    """

    standard_deviation: Tensor
    antenna_m: Tensor | None
    axle_m: Tensor | None

    def __init__(
        self,
        *,
        position_sd_m: Tensor | float | None = None,
        velocity_sd_m_s: Tensor | float | None = None,
        height_sd_m: Tensor | float | None = None,
        heading_sd_rad: Tensor | float | None = None,
        body_velocity_sd_m_s: Tensor | float | None = None,
        antenna_m: Tensor | None = None,
        axle_m: Tensor | None = None,
    ) -> None:
        super().__init__()
        given = (position_sd_m, velocity_sd_m_s, height_sd_m, heading_sd_rad, body_velocity_sd_m_s)
        deviations = [_deviation(part, value) for part, value in zip(_SIZES, given, strict=True) if value is not None]
        parts = [part for part, value in zip(_SIZES, given, strict=True) if value is not None]
        if not parts:
            raise ValueError(f"give the standard deviation of at least one of {', '.join(_SIZES)}")
        hold(self, "standard_deviation", torch.cat(deviations))
        self._hold_arm("antenna_m", antenna_m, {"position", "velocity"} & set(parts))
        self._hold_arm("axle_m", axle_m, {"body_velocity"} & set(parts))
        self.parts: dict[str, slice] = {}
        """Where each part lies in a measurement."""
        start = 0
        for part in parts:
            self.parts[part] = slice(start, start + _SIZES[part])
            start += _SIZES[part]
        self.space = _fix_space(self.parts, start)
        self.takes_controls = axle_m is not None or (antenna_m is not None and "velocity" in parts)
        """Whether the law looks at u: only arms of velocities do."""

    def _hold_arm(self, name: str, arm: Tensor | None, owners: set[str]) -> None:
        if arm is None:
            setattr(self, name, None)
            return
        if arm.shape != (3,) or not bool(torch.isfinite(arm.detach()).all()):
            raise ValueError(f"{name} must be three finite numbers (3,), got {arm.tolist()}")
        if not owners:
            raise ValueError(f"{name} was given, but nothing that is measured there")
        hold(self, name, arm)

    def assemble(self, **parts: Tensor) -> Tensor:
        """A measurement (..., m) of some of the parts, (..., size) each; NaN in the place of the others.

        Raises:
            ValueError: no part, one that this law does not measure, or one of another size.
        """
        for name, value in parts.items():
            if name not in self.parts:
                raise ValueError(f"this law measures {', '.join(self.parts)}, not {name}")
            if value.dim() < 1 or value.shape[-1] != _SIZES[name]:
                raise ValueError(f"{name} must be (..., {_SIZES[name]}), got {tuple(value.shape)}")
        if not parts:
            raise ValueError(f"give at least one of {', '.join(self.parts)}")
        lead = torch.broadcast_shapes(*(value.shape[:-1] for value in parts.values()))
        silent = next(iter(parts.values())).new_full((*lead, 3), torch.nan)
        each = [parts.get(name, silent[..., : _SIZES[name]]).expand(*lead, -1) for name in self.parts]
        return torch.cat(each, -1)

    def measure(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Tensor:
        """Noise-free measurement (..., m) of states (..., 16)."""
        return self._measure(self._see(x, u, dt))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the measurement given states (..., 16), and increments u (..., 6) over dt where an arm needs them."""
        return self._law(self._see(x, u, dt))

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., m, 15) of its mean's error by the error of x."""
        seen = self._see(x, u, dt)
        lead, rows = x.shape[:-1], []
        for part in self.parts:
            blocks = [*_SLOPES[part](seen), None]
            none = x.new_zeros(*lead, _SIZES[part], 3)
            rows.append(torch.cat([none if block is None else block.expand_as(none) for block in blocks], -1))
        return self._law(seen), torch.cat(rows, -2)

    def _measure(self, seen: _Seen) -> Tensor:
        return torch.cat([_VALUES[part](seen) for part in self.parts], -1)

    def _law(self, seen: _Seen) -> Gaussian:
        deviation = self.standard_deviation.to(seen.velocity.dtype)
        return Gaussian(self._measure(seen), deviation, self.space, is_diagonal=True)

    def _see(self, x: Tensor, u: Tensor | None, dt: Step) -> _Seen:
        _check_state(x)
        quaternion, velocity, position, gyro_bias, _ = x.split(_PARTS, -1)
        seen = _Seen(quaternion, velocity, position)
        antenna, axle = (
            None if arm is None else arm.to(x.dtype).expand_as(velocity) for arm in (self.antenna_m, self.axle_m)
        )
        if antenna is not None:
            seen = seen._replace(antenna_m=antenna, antenna=rotate(quaternion, antenna))
        if not self.takes_controls:
            return seen
        control, dt = _check_control(u, dt)
        rate = (_mean_rate(control[..., :3], dt) - gyro_bias).expand_as(velocity)
        if antenna is not None and "velocity" in self.parts:
            seen = seen._replace(antenna_velocity=rotate(quaternion, torch.linalg.cross(rate, antenna)))
        if axle is not None:
            seen = seen._replace(axle_m=axle, axle_velocity=torch.linalg.cross(rate, axle))
        return seen


def _mean_rate(dtheta: Tensor, dt: Tensor | float) -> Tensor:
    """Angular rate over a step; a step of no length has none to tell, and no turn either."""
    if isinstance(dt, Tensor):
        return dtheta / torch.where(dt == 0, 1, dt)
    return dtheta / (dt or 1.0)


def _deviation(part: str, value: Tensor | float) -> Tensor:
    """Standard deviations (size,) of a part."""
    size = _SIZES[part]
    deviation = _number(value)
    if deviation.dim() > 1 or (deviation.dim() == 1 and len(deviation) != size):
        raise ValueError(f"the deviation of {part} must be one number or ({size},), got {tuple(deviation.shape)}")
    inside = (deviation.detach() > 0) & (deviation.detach() < math.inf)
    if not bool(inside.all()):
        raise ValueError(f"the deviation of {part} must be positive and finite, got {deviation.tolist()}")
    return deviation.expand(size)


def _fix_space(parts: dict[str, slice], size: int) -> Space:
    if "heading" not in parts:
        return Euclidean(size)
    place = parts["heading"]
    spaces = [Euclidean(n) if n else None for n in (place.start, size - place.stop)]
    around = [space for space in (spaces[0], Angle(1), spaces[1]) if space is not None]
    return Product(*around)
