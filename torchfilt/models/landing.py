"""Landing of a multirotor on a pad with an infrared beacon: inertial motion, barometer, downward camera.

A state is 16 numbers in the pad's frame, whose origin is the pad and whose z axis points up: quaternion body (RFU) to
pad frame [0:4], velocity in m/s [4:7], position in m [7:10], gyro bias in rad/s [10:13], accelerometer bias in m/s^2
[13:16]; where the pad's elevation is unknown, a 17th: what the barometer shows above the true height, m. Its error is
15 or 16 numbers in the same order, the quaternion's on the left: a rotation vector in the pad's axes. Biases are what
the sensors show too much.

Nothing here tells where the horizontal axes point: a turn of the whole state about the vertical through the pad changes
no measurement and commutes with the motion. `HeadingGauge` picks one state out of each such orbit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold, one_number
from torchfilt.model import StateSpaceModel
from torchfilt.models.attitude import mean_rotation, skew, to_matrix
from torchfilt.models.inertial.imu import ImuGrade
from torchfilt.quaternions import (
    Quaternion,
    Vector,
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
from torchfilt.sensors import Sensors
from torchfilt.spaces import Euclidean, Product, UnitQuaternion

LANDING_SPACE = Product(UnitQuaternion("left"), Euclidean(12))
PAD_HEIGHT_SPACE = Product(UnitQuaternion("left"), Euclidean(13))
"""The same with the barometer's offset."""
CONTROL_SIZE = 6
GRAVITY_M_S2 = 9.80665
_SIZE = 16

ROTOR_IMU = ImuGrade(
    gyro_bias_sd_rad_s=math.radians(0.05),
    angle_random_walk_rad_sqrt_s=math.radians(0.02),
    accel_bias_sd_m_s2=0.03,
    velocity_random_walk_m_s_sqrt_s=0.010,
)
"""Micromachined sensors on a frame that rotors shake."""

Step = Tensor | float | None


# Start ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LandingStart:
    """What is known of the vehicle before the beacon is seen; the heading is anywhere.

    horizontal_sd_m, vertical_sd_m: of the position about the point height_m above the pad; speed_sd_m_s: of each axis
    of the velocity about rest; tilt_sd_rad: about each horizontal axis; pad_height_sd_m: of the barometer's offset,
    None where the pad's elevation is known.

    Raises:
        ValueError: a number that is negative or not finite.
    """

    height_m: float = 15.0
    horizontal_sd_m: float = 15.0
    vertical_sd_m: float = 5.0
    speed_sd_m_s: float = 2.0
    tilt_sd_rad: float = math.radians(3.0)
    pad_height_sd_m: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {value}")


# Standard deviation of an angle that may be anywhere on the circle.
_ANY_HEADING_RAD = math.pi / math.sqrt(3)


def landing_prior(start: LandingStart | None = None, imu: ImuGrade = ROTOR_IMU) -> Gaussian:
    """Law of the state at the start: level, at rest, nose along y, independent errors, float64.

    Args:
        start: see `LandingStart`; default its defaults. imu: gives the biases' deviations.

    Returns:
        Gaussian of 16 numbers on `LANDING_SPACE`, or of 17 on `PAD_HEIGHT_SPACE` where ``pad_height_sd_m`` is given.
    """
    start = LandingStart() if start is None else start
    deviation = [start.tilt_sd_rad] * 2 + [_ANY_HEADING_RAD] + [start.speed_sd_m_s] * 3
    deviation += [start.horizontal_sd_m] * 2 + [start.vertical_sd_m]
    deviation += [imu.gyro_bias_sd_rad_s] * 3 + [imu.accel_bias_sd_m_s2] * 3
    mean = [0.0, 0.0, 0.0, 1.0, *[0.0] * 5, start.height_m, *[0.0] * 6]
    space = LANDING_SPACE
    if start.pad_height_sd_m is not None:
        deviation, mean, space = [*deviation, start.pad_height_sd_m], [*mean, 0.0], PAD_HEIGHT_SPACE
    return Gaussian(
        torch.tensor(mean, dtype=torch.float64), torch.tensor(deviation, dtype=torch.float64), space, is_diagonal=True
    )


# Motion ---------------------------------------------------------------------------------------------------------------


class LandingTransition(nn.Module):
    """Motion over flat ground that does not turn; the control u (..., 6) is (dtheta, dv) over the step.

    Increments are compensated ones, as `torchfilt.models.inertial.strapdown.increments` makes them of raw samples: the
    rotation vector in rad and the integral of the specific force in body axes at the start, m/s.
    Mean: the biases are taken out of the increments, to second order in the turn; the attitude turns by dtheta, the
    velocity grows by the turned dv less gravity, the position moves by the mean of both velocities; biases and offset
    stay. The position lags by dt^3 / 12 of the jerk a step.
    Noise: white noise of the sensors turns with the axes into itself, so its factor is diagonal: attitude, velocity,
    biases. Position and offset have none of their own.

    Args:
        angle_random_walk_rad_sqrt_s, velocity_random_walk_m_s_sqrt_s: roots of the spectral densities of the white
            noise of gyros and accelerometers, all axes alike.
        gyro_bias_walk_rad_s_sqrt_s, accel_bias_walk_m_s2_sqrt_s: the same of what drives the biases.
        unknown_pad_height: whether states have 17 numbers.

        The four densities are numbers or scalar tensors (a parameter trains).

    Raises:
        ValueError: a density that is negative or not one finite number; when called, no control or time step, a control
            or state of another size, a number below zero as a step.

    Source: Titterton and Weston, Strapdown Inertial Navigation Technology (2004), chapter 3, without Earth's rate.
    """

    densities: Tensor

    def __init__(
        self,
        angle_random_walk_rad_sqrt_s: Tensor | float,
        velocity_random_walk_m_s_sqrt_s: Tensor | float,
        gyro_bias_walk_rad_s_sqrt_s: Tensor | float = 0.0,
        accel_bias_walk_m_s2_sqrt_s: Tensor | float = 0.0,
        *,
        unknown_pad_height: bool = False,
    ) -> None:
        super().__init__()
        given = {
            "angle_random_walk_rad_sqrt_s": angle_random_walk_rad_sqrt_s,
            "velocity_random_walk_m_s_sqrt_s": velocity_random_walk_m_s_sqrt_s,
            "gyro_bias_walk_rad_s_sqrt_s": gyro_bias_walk_rad_s_sqrt_s,
            "accel_bias_walk_m_s2_sqrt_s": accel_bias_walk_m_s2_sqrt_s,
        }
        values = []
        for name, value in given.items():
            density = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
            if density.dim() != 0 or not bool((density.detach() >= 0) & (density.detach() < math.inf)):
                raise ValueError(f"{name} must be one finite number >= 0, got {value}")
            values.append(density)
        angle, push, gyro, accel = values
        still = torch.zeros_like(angle)
        each = [value for value in (angle, push, still, gyro, accel) for _ in range(3)]
        hold(self, "densities", torch.stack(each + [still] * unknown_pad_height))
        self.space = PAD_HEIGHT_SPACE if unknown_pad_height else LANDING_SPACE
        driven = (True, True, False, *(bool(value.detach() > 0) or value.requires_grad for value in (gyro, accel)))
        self.noise_in = [k for k in range(15) if driven[k // 3]]

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 16 or 17) after a step of dt (number or (..., 1)), s, with increments u (..., 6)."""
        return self._law(x, self._move(x, u, dt), dt)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., e, e) of its mean's error by the error of x, e = 15 or 16."""
        motion = self._move(x, u, dt)
        assert dt is not None
        step = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt
        axes = to_matrix(x[..., :4])
        eye = torch.eye(x.shape[-1] - 1, dtype=x.dtype, device=x.device)
        attitude, velocity, position, gyro, accel = eye[:15].split(3)
        turn = stack(motion.turn)
        by_gyro = axes @ skew(stack(motion.push)) @ gyro / 2
        by_accel = (axes + axes @ skew(turn) / 2) @ accel
        pushed = step * (by_gyro - by_accel) - skew(stack(motion.force)) @ attitude
        turned = attitude - step * (axes @ mean_rotation(turn)) @ gyro
        moved = position + step * (velocity + pushed / 2)
        rows = [turned, velocity + pushed, moved, eye[9:]]
        lead = torch.broadcast_shapes(*(row.shape[:-2] for row in rows))
        jacobian = torch.cat([row.expand(*lead, *row.shape[-2:]) for row in rows], -2)
        return self._law(x, motion, dt), jacobian

    def _move(self, x: Tensor, u: Tensor | None, dt: Step) -> "_Motion":
        if x.shape[-1] != self.space.size:
            raise ValueError(f"the state must be (..., {self.space.size}), got {tuple(x.shape)}")
        if u is None or u.shape[-1] != CONTROL_SIZE:
            got = "none" if u is None else f"shape {tuple(u.shape)}"
            raise ValueError(f"this law needs increments (dtheta, dv) as a control u (..., {CONTROL_SIZE}), got {got}")
        if dt is None:
            raise ValueError("this law needs the time step dt over which the increments were taken")
        if not isinstance(dt, Tensor) and not dt >= 0:
            raise ValueError(f"dt must be >= 0, got {dt}")
        return _propagate(x, u, dt.squeeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt)

    def _law(self, x: Tensor, motion: "_Motion", dt: Step) -> Gaussian:
        parts = [*motion.attitude.parts(), *motion.velocity, *motion.position, *x[..., 10:].unbind(-1)]
        assert dt is not None
        return Gaussian(stack(parts), self.densities.to(x.dtype) * dt**0.5, self.space, is_diagonal=True)


class _Motion(NamedTuple):
    """State after a step and what its derivatives need.

    turn: increment without the gyro's bias; push: increment without the accelerometer's, body axes at the start;
    force: that increment, free of both, in the pad's axes.
    """

    attitude: Quaternion
    velocity: Vector
    position: Vector
    turn: Vector
    push: Vector
    force: Vector


def _propagate(x: Tensor, u: Tensor, dt: Tensor | float) -> _Motion:
    """State after a step, by components."""
    before = quaternion(x[..., :4])
    velocity, position, gyro_bias, accel_bias = (vector(part.unbind(-1)) for part in x[..., 4:_SIZE].split(3, -1))
    dtheta, dv = (vector(part.unbind(-1)) for part in u.split(3, -1))
    spin, shove = ((b[0] * dt, b[1] * dt, b[2] * dt) for b in (gyro_bias, accel_bias))
    turn, push = minus(dtheta, spin), minus(dv, shove)
    # The force was turned by angles that the gyro's bias made too large, and the accelerometer's bias turned along.
    too_much = zip(cross(spin, push), cross(dtheta, shove), strict=True)
    free = vector([torch.sub(p, a + b, alpha=0.5) for p, (a, b) in zip(push, too_much, strict=True)])
    force = rotate(before, free)
    after = (velocity[0] + force[0], velocity[1] + force[1], velocity[2] + force[2] - GRAVITY_M_S2 * dt)
    moved = vector([p + (v + a) * (0.5 * dt) for p, v, a in zip(position, velocity, after, strict=True)])
    return _Motion(product(before, exponential(turn)), after, moved, turn, push, force)


# Measurements ---------------------------------------------------------------------------------------------------------


class Barometer(nn.Module):
    """Height above the pad, m; of a state with 17 numbers, height plus the barometer's offset.

    Args:
        sd_m: standard deviation, number or scalar tensor (a parameter trains).

    Raises:
        ValueError: a deviation that is not one positive finite number.
    """

    deviation: Tensor
    size = 1

    def __init__(self, sd_m: Tensor | float) -> None:
        super().__init__()
        hold(self, "deviation", one_number(sd_m, "sd_m").reshape(1))

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the reading (..., 1) at states (..., 16 or 17)."""
        height = x[..., 9:10]
        mean = height if x.shape[-1] == _SIZE else height + x[..., _SIZE:]
        return Gaussian(mean, self.deviation.to(x.dtype), is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 1, e)."""
        row = x.new_zeros(1, x.shape[-1] - 1)
        row[0, 8] = 1
        row[0, 15:] = 1
        return self(x), row.expand(*x.shape[:-1], *row.shape)


class Beacon(nn.Module):
    """Downward infrared camera: where in its picture the pad is, tangents of the direction's angles off the body's -z.

    With r the vector to the pad in body axes (x right, y forward, z up) the tangents are (r_x, r_y) / -r_z. They are
    finite for every state: where the direction is more than ``edge_rad`` off the optical axis, or the pad is not below
    the camera at all, the direction is brought back to that edge, straight towards the axis. The law is continuous
    there and says less and less about distance; inside the edge it is exact. Sigma points reach such places, pictures
    do not.

    Args:
        sd_rad: standard deviation of each tangent, number or scalar tensor (a parameter trains).
        field_of_view_rad: half angles along body x and y. range_m: to the farthest pad that is seen.
        edge_rad: see above.

    Raises:
        ValueError: a deviation that is not one positive finite number, an angle outside (0, pi/2), an edge inside the
            field of view, a range that is not positive.
    """

    deviation: Tensor
    size = 2

    def __init__(
        self,
        sd_rad: Tensor | float,
        *,
        field_of_view_rad: Sequence[float] = (math.radians(30), math.radians(17.5)),
        range_m: float = 15.0,
        edge_rad: float = math.radians(80),
    ) -> None:
        super().__init__()
        angles = tuple(float(angle) for angle in field_of_view_rad)
        if len(angles) != 2 or not all(0 < angle < math.pi / 2 for angle in angles):
            raise ValueError(f"field_of_view_rad must be two angles in (0, pi/2), got {field_of_view_rad}")
        limits = tuple(math.tan(angle) for angle in angles)
        if not math.atan(math.hypot(*limits)) < edge_rad < math.pi / 2:
            corner = math.atan(math.hypot(*limits))
            raise ValueError(f"edge_rad must lie between the picture's corner, {corner:.4g}, and pi/2, got {edge_rad}")
        if not range_m > 0:
            raise ValueError(f"range_m must be positive, got {range_m}")
        hold(self, "deviation", torch.stack([one_number(sd_rad, "sd_rad")] * 2))
        self.limits, self.range_m, self.edge = limits, range_m, math.tan(edge_rad)

    @property
    def outlier_log_density(self) -> float:
        """Logarithm of the density of a false reading, uniform over the field of view."""
        return -math.log(4 * self.limits[0] * self.limits[1])

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the tangents (..., 2) at states (..., 16 or 17)."""
        right, forward, up = _to_pad(x)
        depth = torch.maximum(-up, self._least_depth(right, forward))
        return Gaussian(stack([right / depth, forward / depth]), self.deviation.to(x.dtype), is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 2, e)."""
        right, forward, up = _to_pad(x)
        least = self._least_depth(right, forward)
        depth = torch.maximum(-up, least)
        tangents = stack([right / depth, forward / depth])
        # Derivative of the depth by the vector to the pad.
        inside = stack([torch.zeros_like(up), torch.zeros_like(up), -torch.ones_like(up)])
        square = least * self.edge**2
        at_edge = stack([right / square, forward / square, torch.zeros_like(up)])
        by_depth = torch.where((-up >= least).unsqueeze(-1), inside, at_edge)
        eye = torch.eye(2, 3, dtype=x.dtype, device=x.device)
        slope = (eye - tangents.unsqueeze(-1) * by_depth.unsqueeze(-2)) / depth[..., None, None]
        to_body = to_matrix(x[..., :4]).mT
        by_position = -slope @ to_body
        by_attitude = by_position @ skew(x[..., 7:10])
        jacobian = torch.cat([by_attitude, pad(by_position, (3, x.shape[-1] - 10))], -1)
        return Gaussian(tangents, self.deviation.to(x.dtype), is_diagonal=True), jacobian

    def in_view(self, x: Tensor) -> Tensor:
        """Whether the camera sees the pad from states (..., 16 or 17): inside field of view and range, (...)."""
        right, forward, up = _to_pad(x)
        near = stack([right, forward, up]).square().sum(-1) <= self.range_m**2
        wide, long = self.limits
        return (up < 0) & (right.abs() <= -wide * up) & (forward.abs() <= -long * up) & near

    def _least_depth(self, right: Tensor, forward: Tensor) -> Tensor:
        """Depth at which the direction is on the edge; never zero, so that a pad at the camera has no direction."""
        tiny = torch.finfo(right.dtype).tiny ** 0.5
        return (right.square() + forward.square() + tiny).sqrt() / self.edge


def _to_pad(x: Tensor) -> Vector:
    """Vector from the vehicle to the pad in body axes, m."""
    across, along, up = rotate_back(quaternion(x[..., :4]), vector(x[..., 7:10].unbind(-1)))
    return -across, -along, -up


# Symmetry -------------------------------------------------------------------------------------------------------------


class HeadingGauge(nn.Module):
    """Turns a state about the vertical through the pad until the forward axis points along y: heading zero.

    Position, velocity and attitude turn, biases and the barometer's offset do not. It is smooth wherever the nose is
    not straight up or down, above the pad too. A gauge that fixes the bearing to the pad, as the literature suggests
    for the first sight of the beacon, is singular right above it, where the vehicle ends up: there the bearing, and
    with it every error in the gauge, turns by any amount for a step of a few centimetres.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Representative (..., d) of the orbits of states (..., d), d = 16 or 17."""
        return self._turned(x)[0]

    def first_order(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Representative x' and the derivative (..., e, e) of its error by the error of x.

        The turn depends on the state: an error e of the attitude changes it by -e_z + f_z (f_x e_x + f_y e_y) /
        (f_x^2 + f_y^2), f being the forward axis, and what turns turns by that too. One direction of the error, that
        along the orbit, is lost.
        """
        after, (sine, cosine), (across, along, up) = self._turned(x)
        zero, one = torch.zeros_like(sine), torch.ones_like(sine)
        turn = torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], -1).unflatten(-1, (3, 3))
        level = _level(across, along)
        by_attitude = torch.stack([up * across / level, up * along / level, -one], -1)
        # What an error of the turn does to each part: z for the rotation vector, z x v for the vectors.
        vx, vy, _, px, py, _ = after[..., 4:10].unbind(-1)
        swing = torch.stack([zero, zero, one, -vy, vx, zero, -py, px, zero], -1)
        turned = turn + pad(by_attitude.unsqueeze(-2), (0, 0, 2, 0))
        follows = swing[..., 3:].unsqueeze(-1) * by_attitude.unsqueeze(-2)
        rest = x.shape[-1] - 10
        eye = torch.eye(rest, dtype=x.dtype, device=x.device).expand(*turn.shape[:-2], rest, rest)
        rows = [
            pad(turned, (0, 6 + rest)),
            torch.cat([follows[..., :3, :], pad(turn, (0, 3 + rest))], -1),
            torch.cat([follows[..., 3:, :], pad(turn, (3, rest))], -1),
            pad(eye, (9, 0)),
        ]
        return after, torch.cat(rows, -2)

    def _turned(self, x: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor], Vector]:
        """State in the gauge, sine and cosine of the turn, forward axis before it."""
        before = quaternion(x[..., :4])
        ahead = _forward(before)
        length = _level(ahead[0], ahead[1]).sqrt()
        sine, cosine = ahead[0] / length, ahead[1] / length
        # Half of the turn, from the quarter where its formula does not cancel.
        large = ((1 + cosine.abs()) / 2).sqrt()
        small, back = sine / (2 * large), cosine < 0
        sign = torch.copysign(torch.ones_like(sine), sine.detach())
        scalar = torch.where(back, small * sign, large)
        axis = torch.where(back, large * sign, small)
        zero = torch.zeros_like(axis)
        attitude = product(Quaternion((zero, zero, axis), scalar), before)
        vx, vy, vz, px, py, pz = x[..., 4:10].unbind(-1)
        parts = [*attitude.parts(), cosine * vx - sine * vy, sine * vx + cosine * vy, vz]
        parts += [cosine * px - sine * py, sine * px + cosine * py, pz, *x[..., 10:].unbind(-1)]
        return stack(parts), (sine, cosine), ahead


def _forward(q: Quaternion) -> Vector:
    """Second column of the rotation matrix."""
    (x, y, z), w = q
    return 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)


def _level(across: Tensor, along: Tensor) -> Tensor:
    """Square of the horizontal part of the forward axis, kept off zero."""
    return across.square() + along.square() + torch.finfo(across.dtype).tiny ** 0.5


# Model ----------------------------------------------------------------------------------------------------------------


def landing_model(
    start: LandingStart | None = None,
    imu: ImuGrade = ROTOR_IMU,
    *,
    barometer_sd_m: float | None = 0.4,
    beacon_sd_rad: float = math.radians(0.4),
    gauge: bool = True,
) -> StateSpaceModel:
    """The three laws of the landing; sensors are named "barometer" and "beacon", in this order.

    Args:
        start: what is known before; a ``pad_height_sd_m`` puts the barometer's offset into the state.
        imu: white noise of the transition and deviations of the biases, which stay as they are.
        barometer_sd_m: None where there is no barometer. beacon_sd_rad: of each tangent.
        gauge: whether states are turned to heading zero, see `HeadingGauge`.
    """
    start = LandingStart() if start is None else start
    transition = LandingTransition(
        imu.angle_random_walk_rad_sqrt_s,
        imu.velocity_random_walk_m_s_sqrt_s,
        unknown_pad_height=start.pad_height_sd_m is not None,
    )
    sensors: dict[str, nn.Module] = {} if barometer_sd_m is None else {"barometer": Barometer(barometer_sd_m)}
    sensors["beacon"] = Beacon(beacon_sd_rad)
    return StateSpaceModel(
        landing_prior(start, imu), transition, Sensors(sensors), gauge=HeadingGauge() if gauge else None
    )
