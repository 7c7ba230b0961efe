"""The direct form: inertial sensors measure a state of motion whose law is a guess, instead of driving its motion.

An indirect filter takes increments of the inertial sensors as the motion itself and estimates its errors. A direct one
holds rate and acceleration in the state, as Gauss-Markov processes, and takes both sensors for measurements of them.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.models.attitude import from_rotation_vector, inverse, mean_rotation, multiply, rotate, skew, to_matrix
from torchfilt.models.landing import GRAVITY_M_S2
from torchfilt.spaces import Euclidean, Product, UnitQuaternion

DIRECT_SPACE = Product(UnitQuaternion("left"), Euclidean(18))
"""Attitude, velocity, position, gyro and accelerometer bias as `torchfilt.models.landing` has them, then rate in body
axes, rad/s, [16:19] and acceleration in world axes, m/s^2, [19:22]: the means over the step that has just ended.
"""
_RATE, _ACCELERATION = slice(16, 19), slice(19, 22)

Step = Tensor | float | None


class DirectTransition(nn.Module):
    """Motion of states (..., 22) on `DIRECT_SPACE` over steps of one length.

    Rate and acceleration are first-order Gauss-Markov processes, constant over a step: the new ones turn the attitude,
    change the velocity and move the position. Their driving noise is the same in all directions, so that that of the
    rate may be drawn in world axes, where the factor is triangular; it reaches the attitude to first order in the turn
    of a step. Biases are random walks.

    Args:
        step_s: length of a step. rate_sd_rad_s, rate_time_s, acceleration_sd_m_s2, acceleration_time_s: standard
            deviation of each axis, and time in which it decays to 1/e.
        gyro_bias_walk_rad_s_sqrt_s, accel_bias_walk_m_s2_sqrt_s: roots of the spectral densities of what drives them.

    Raises:
        ValueError: a number that is negative or not finite, a step or time that is zero; when called, a time step other
            than step_s, one a row, a state of another size.

    Source: Maybeck, Stochastic Models, Estimation, and Control 1 (1979), section 6.3: direct and indirect filters;
        Singer, IEEE TAES 6 (1970), for the processes.
    """

    densities: Tensor

    def __init__(
        self,
        step_s: float,
        *,
        rate_sd_rad_s: float,
        rate_time_s: float,
        acceleration_sd_m_s2: float,
        acceleration_time_s: float,
        gyro_bias_walk_rad_s_sqrt_s: float = 0.0,
        accel_bias_walk_m_s2_sqrt_s: float = 0.0,
    ) -> None:
        super().__init__()
        _check_positive(step_s=step_s, rate_time_s=rate_time_s, acceleration_time_s=acceleration_time_s)
        sizes = {
            "rate_sd_rad_s": rate_sd_rad_s,
            "acceleration_sd_m_s2": acceleration_sd_m_s2,
            "gyro_bias_walk_rad_s_sqrt_s": gyro_bias_walk_rad_s_sqrt_s,
            "accel_bias_walk_m_s2_sqrt_s": accel_bias_walk_m_s2_sqrt_s,
        }
        for name, value in sizes.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {value}")
        self.step_s, self.space = step_s, DIRECT_SPACE
        self.decays = tuple(math.exp(-step_s / time_s) for time_s in (rate_time_s, acceleration_time_s))
        rate, push = (
            sd * math.sqrt(1 - decay**2)
            for sd, decay in zip((rate_sd_rad_s, acceleration_sd_m_s2), self.decays, strict=True)
        )
        walks = [gyro_bias_walk_rad_s_sqrt_s * step_s**0.5, accel_bias_walk_m_s2_sqrt_s * step_s**0.5]
        hold(self, "densities", torch.tensor([rate, push, *walks], dtype=torch.float64))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 22) a step later."""
        return self._law(x, self._move(x, dt))

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., 21, 21) of its mean's error by the error of x."""
        mean, h = self._move(x, dt), self.step_s
        keep, hold_on = self.decays
        eye = torch.eye(21, dtype=x.dtype, device=x.device)
        attitude, velocity, position, rate, push = eye[:3], eye[3:6], eye[6:9], eye[15:18], eye[18:21]
        # The turn's derivative by its vector, seen in world axes.
        turn = mean_rotation(h * keep * x[..., _RATE])
        turned = attitude + h * keep * (to_matrix(x[..., :4]) @ turn) @ rate
        driven = h * hold_on * push
        rows = [turned, velocity + driven, position + h * velocity + h / 2 * driven, eye[9:15], keep * rate]
        lead = turned.shape[:-2]
        jacobian = torch.cat([row.expand(*lead, *row.shape[-2:]) for row in (*rows, hold_on * push)], -2)
        return self._law(x, mean), jacobian

    def _move(self, x: Tensor, dt: Step) -> Tensor:
        if x.shape[-1] != self.space.size:
            raise ValueError(f"the state must be (..., {self.space.size}), got {tuple(x.shape)}")
        if isinstance(dt, Tensor):
            raise ValueError(f"dt must be one number, the step the law was made for, {self.step_s}, got a tensor")
        if dt is not None and not abs(dt - self.step_s) <= 1e-9 * self.step_s:
            raise ValueError(f"dt must be the step the law was made for, {self.step_s}, got {dt}")
        h = self.step_s
        rate, push = self.decays[0] * x[..., _RATE], self.decays[1] * x[..., _ACCELERATION]
        q = multiply(x[..., :4], from_rotation_vector(h * rate))
        velocity = x[..., 4:7] + h * push
        position = x[..., 7:10] + h * x[..., 4:7] + h * h / 2 * push
        return torch.cat([q, velocity, position, x[..., 10:16], rate, push], -1)

    def _law(self, x: Tensor, mean: Tensor) -> Gaussian:
        # Columns of the noise: that of the rate, in world axes, at the attitude's; that of the acceleration, at the
        # velocity's; the walks' own.
        h = self.step_s
        rate, push, gyro, accel = self.densities.to(x.dtype).unbind()
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        by_rate = to_matrix(x[..., :4]).mT * rate
        lead = by_rate.shape[:-2]
        blocks = [
            (h * rate * eye, 0),
            (h * push * eye, 3),
            (h * h / 2 * push * eye, 3),
            (gyro * eye, 9),
            (accel * eye, 12),
            (by_rate, 0),
            (push * eye, 3),
        ]
        rows = [pad(block.expand(*lead, 3, 3), (at, 18 - at)) for block, at in blocks]
        return Gaussian(mean, torch.cat(rows, -2), self.space)


class InertialMeasurement(nn.Module):
    """Mean rate and mean specific force over the step that has just ended, with their biases: (..., 6).

    The force is told in the axes of the step's middle.

    Args:
        step_s: length of the step. angle_random_walk_rad_sqrt_s, velocity_random_walk_m_s_sqrt_s: as in `ImuGrade`.

    Raises:
        ValueError: a number that is not positive and finite; when called, a state without rate and acceleration.
    """

    deviation: Tensor
    size = 6

    def __init__(
        self, step_s: float, angle_random_walk_rad_sqrt_s: float, velocity_random_walk_m_s_sqrt_s: float
    ) -> None:
        super().__init__()
        _check_positive(
            step_s=step_s,
            angle_random_walk_rad_sqrt_s=angle_random_walk_rad_sqrt_s,
            velocity_random_walk_m_s_sqrt_s=velocity_random_walk_m_s_sqrt_s,
        )
        self.step_s = step_s
        sizes = [angle_random_walk_rad_sqrt_s] * 3 + [velocity_random_walk_m_s_sqrt_s] * 3
        hold(self, "deviation", torch.tensor(sizes, dtype=torch.float64) / step_s**0.5)

    def forward(self, x: Tensor) -> Gaussian:
        """Law of rate, rad/s, and specific force, m/s^2, both in body axes, at states (..., 22 or more)."""
        force, _, _ = self._sensed(x)
        return self._law(x, force)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 6, d - 1)."""
        force, push, middle = self._sensed(x)
        to_body, half = to_matrix(middle).mT, self.step_s / 2
        # A turn e of the world changes the force by the middle's axes of push x e; one of the rate, by half a step's
        # turn of these axes.
        by_rate = -half * (skew(force) @ mean_rotation(half * x[..., _RATE]))
        eye = torch.eye(3, dtype=x.dtype, device=x.device).expand_as(to_body)
        rest = x.shape[-1] - DIRECT_SPACE.size
        rates = pad(torch.cat([eye, torch.zeros_like(eye), eye], -1), (9, 3 + rest))
        forces = torch.cat([pad(to_body @ skew(push), (0, 9)), eye, by_rate, to_body], -1)
        return self._law(x, force), torch.cat([rates, pad(forces, (0, rest))], -2)

    def _sensed(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Specific force in body and in world axes, attitude in the middle of the step."""
        if x.shape[-1] < DIRECT_SPACE.size:
            raise ValueError(f"the state must have {DIRECT_SPACE.size} numbers or more, got {tuple(x.shape)}")
        middle = multiply(x[..., :4], from_rotation_vector(-self.step_s / 2 * x[..., _RATE]))
        push = x[..., _ACCELERATION] + x.new_tensor([0, 0, GRAVITY_M_S2])
        return rotate(inverse(middle), push), push, middle

    def _law(self, x: Tensor, force: Tensor) -> Gaussian:
        mean = torch.cat([x[..., _RATE] + x[..., 10:13], force + x[..., 13:16]], -1)
        return Gaussian(mean, self.deviation.to(x.dtype), is_diagonal=True)


def to_rates(controls: Tensor, dt: float) -> Tensor:
    """Compensated increments (dtheta, dv) (..., 6) as mean rate and mean specific force in the axes of the middle.

    dv is told in the axes at the start, half a turn before the middle.

    Returns:
        (..., 6): rad/s and m/s^2, body axes.
    """
    dtheta, dv = controls.split(3, -1)
    return torch.cat([dtheta, rotate(from_rotation_vector(-dtheta / 2), dv)], -1) / dt


def _check_positive(**given: float) -> None:
    for name, value in given.items():
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be finite and positive, got {value}")
