"""Laws of an attitude and its gyro bias: motion by a gyro, and sensors that see a known vector of the world.

A state is 7 numbers on `ATTITUDE_SPACE`: quaternion from body to world axes [0:4] and gyro bias in rad/s, body axes,
[4:7]: measured = true + bias + noise. Its error is 6 numbers, the quaternion's on the left: a rotation vector in world
axes. World axes are any whose third points up where gravity is measured, such as ENU.

Both laws give their first derivative by closed form (``first_order``), which `torchfilt.moments.taylor` uses.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.models.attitude.rotations import mean_rotation, skew, to_matrix
from torchfilt.quaternions import exponential, product, quaternion, rotate_back, stack, vector
from torchfilt.spaces import EUCLIDEAN, Euclidean, Product, UnitQuaternion

ATTITUDE_SPACE = Product(UnitQuaternion("left"), Euclidean(3))
_SIZE = 7

Step = Tensor | float | None


class GyroTransition(nn.Module):
    """Attitude and gyro bias after a step at a constant rate; the control u (..., 3) is the measured rate in rad/s.

    Mean: the body turns by (u - bias) dt, exactly; the bias stays, or decays as a first-order Gauss-Markov process.
    Noise: white noise of the gyro turns with the axes into itself, so the factor is diagonal.

    Args:
        angle_random_walk_rad_sqrt_s: root of the spectral density of the gyro's white noise, rad/s/sqrt(Hz).
        gyro_bias_walk_rad_s_sqrt_s: the same of what drives the bias.
        gyro_bias_time_s: time in which the bias decays to 1/e; its standard deviation settles at
            walk sqrt(time / 2). None: a random walk.

        The densities are numbers or scalar tensors (a parameter trains); all axes alike.

    Raises:
        ValueError: a density that is negative or not one finite number, a time that is not positive; when called, no
            control or time step, a control or state of another size, a number below zero as a step.
    """

    densities: Tensor

    def __init__(
        self,
        angle_random_walk_rad_sqrt_s: Tensor | float,
        gyro_bias_walk_rad_s_sqrt_s: Tensor | float = 0.0,
        gyro_bias_time_s: float | None = None,
    ) -> None:
        super().__init__()
        named = {
            "angle_random_walk_rad_sqrt_s": angle_random_walk_rad_sqrt_s,
            "gyro_bias_walk_rad_s_sqrt_s": gyro_bias_walk_rad_s_sqrt_s,
        }
        values = [_number(value) for value in named.values()]
        for (name, given), value in zip(named.items(), values, strict=True):
            if value.dim() != 0 or not bool((value.detach() >= 0) & (value.detach() < math.inf)):
                raise ValueError(f"{name} must be one finite number >= 0, got {given}")
        if gyro_bias_time_s is not None and not 0 < gyro_bias_time_s < math.inf:
            raise ValueError(f"gyro_bias_time_s must be positive and finite, got {gyro_bias_time_s}")
        hold(self, "densities", torch.stack([value for value in values for _ in range(3)]))
        self.gyro_bias_time_s = gyro_bias_time_s
        self.space = ATTITUDE_SPACE

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 7) after a step of dt (number or (..., 1)), s, at the measured rate u (..., 3)."""
        control, dt = _check_call(x, u, dt)
        turn = (control - x[..., 4:]) * dt
        parts = product(quaternion(x[..., :4]), exponential(vector(turn.unbind(-1)))).parts()
        # A product of unit quaternions is one but for rounding, which a million steps would add up.
        scale = torch.stack(parts).square().sum(0).rsqrt()
        bias, span = x[..., 4:], dt
        if self.gyro_bias_time_s is not None:
            bias = bias * self._decay(dt)
            span = self._driven(dt)
        mean = stack([*(part * scale for part in parts), *bias.unbind(-1)])
        densities = self.densities.to(x.dtype)
        if span is dt:
            return Gaussian(mean, densities * dt**0.5, self.space, is_diagonal=True)
        factor = torch.cat([densities[:3] * dt**0.5, densities[3:] * span**0.5], -1)
        return Gaussian(mean, factor, self.space, is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., 6, 6) of its mean's error by the error of x."""
        control, step = _check_call(x, u, dt)
        law = self(x, control, step)
        span = step.unsqueeze(-1) if isinstance(step, Tensor) and step.dim() > 0 else step
        # exp(v + d) = exp(J(v) d) exp(v): a bias too large turns the body too little, seen in world axes.
        by_bias = to_matrix(x[..., :4]) @ mean_rotation((control - x[..., 4:]) * step) * -span
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        left = eye if self.gyro_bias_time_s is None else eye * self._decay(span)
        rows = torch.cat([eye.expand_as(by_bias), by_bias], -1), pad(left, (3, 0)).expand(*by_bias.shape[:-1], 6)
        return law, torch.cat(rows, -2)

    def _decay(self, dt: Tensor | float) -> Tensor | float:
        """What is left of the bias after a step."""
        assert self.gyro_bias_time_s is not None
        share = -dt / self.gyro_bias_time_s
        return share.exp() if isinstance(share, Tensor) else math.exp(share)

    def _driven(self, dt: Tensor | float) -> Tensor | float:
        """Integral of the squared decay over a step, s."""
        assert self.gyro_bias_time_s is not None
        share = -2 * dt / self.gyro_bias_time_s
        grown = torch.expm1(share) if isinstance(share, Tensor) else math.expm1(share)
        return -self.gyro_bias_time_s / 2 * grown


class VectorMeasurement(nn.Module):
    """A sensor with three axes that sees a known vector of the world: y = R(q)^T reference + noise.

    An accelerometer at rest sees the specific force (0, 0, +g), a magnetometer the field of the place; y and reference
    are in the same unit, and only the direction tells the attitude. The state is any whose first four numbers are a
    quaternion with its error on the left.

    What disturbs such a sensor is seldom white: a body's acceleration lasts as long as the motion, a steel beam stays
    where it is. A deviation as large as the disturbance itself (several m/s^2 for a body that is thrown about) lets a
    good gyro carry the attitude, and the accelerations, which sum to a velocity that stays small, average out;
    `plausible` drops single vectors that cannot be the reference.

    Args:
        reference: (3,) or (*batch, 3) in world axes.
        sd: standard deviation of each axis, number or (3,), in the same unit.

    Raises:
        ValueError: a reference that is not finite or zero, a deviation that is not positive and finite, shapes that do
            not fit; when called, a state without a quaternion.
    """

    reference: Tensor
    deviation: Tensor

    def __init__(self, reference: Tensor, sd: Tensor | float) -> None:
        super().__init__()
        if reference.dim() < 1 or reference.shape[-1] != 3:
            raise ValueError(f"reference must be (*batch, 3) in world axes, got shape {tuple(reference.shape)}")
        length = torch.linalg.vector_norm(reference.detach(), dim=-1)
        if not bool((torch.isfinite(length) & (length > 0)).all()):
            raise ValueError(f"reference must be finite and not zero, got {reference.tolist()}")
        deviation = _number(sd)
        if deviation.shape not in ((), (3,)):
            raise ValueError(f"sd must be one number or (3,), got shape {tuple(deviation.shape)}")
        if not bool((torch.isfinite(deviation.detach()) & (deviation.detach() > 0)).all()):
            raise ValueError(f"sd must be positive and finite, got {sd}")
        hold(self, "reference", reference)
        hold(self, "deviation", deviation.to(reference.dtype).expand(3))
        self.size = 3

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the measured vector (..., 3), body axes, given the state x (..., d)."""
        if x.shape[-1] < 4:
            raise ValueError(f"the state must begin with a quaternion, (..., 4 or more), got {tuple(x.shape)}")
        reference = self._for(x)
        seen = stack(rotate_back(quaternion(x[..., :4]), vector(reference.unbind(-1))))
        return Gaussian(seen, self.deviation.to(x.dtype), EUCLIDEAN, is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 3, d - 1) by the error of x."""
        law = self(x)
        # exp(-e) r = r + r x e to first order, seen in body axes.
        by_turn = to_matrix(x[..., :4]).mT @ skew(self._for(x))
        return law, pad(by_turn, (0, x.shape[-1] - 4))

    def _for(self, x: Tensor) -> Tensor:
        """References with room for the points of a row."""
        reference = self.reference.to(x.dtype)
        lead = x.dim() - reference.dim()
        if reference.dim() == 1 or lead <= 0:
            return reference
        return reference.reshape(*reference.shape[:-1], *[1] * lead, 3)


def plausible(measured: Tensor, length: Tensor | float, tolerance: float) -> Tensor:
    """Measured vectors (..., 3) with NaN, which filters take as not measured, where they cannot be the reference.

    Args:
        measured: in any unit; rows with a NaN stay as they are.
        length: of the reference, number or (...).
        tolerance: share of it by which the length of a vector may differ.

    Raises:
        ValueError: a tolerance or a length that is not positive.
    """
    lengths = torch.as_tensor(length)
    if not tolerance > 0 or not bool((lengths > 0).all()):
        raise ValueError(f"tolerance and length must be positive, got {tolerance} and {length}")
    off = (torch.linalg.vector_norm(measured, dim=-1) - lengths).abs() > tolerance * lengths
    return torch.where(off.unsqueeze(-1), torch.nan, measured)


def _check_call(x: Tensor, u: Tensor | None, dt: Step) -> tuple[Tensor, Tensor | float]:
    if x.shape[-1] != _SIZE:
        raise ValueError(f"the state must be (..., {_SIZE}), got {tuple(x.shape)}")
    if u is None or u.shape[-1] != 3:
        got = "none" if u is None else f"shape {tuple(u.shape)}"
        raise ValueError(f"this law needs the measured rate as a control u (..., 3), got {got}")
    if dt is None:
        raise ValueError("this law needs the time step dt")
    if not isinstance(dt, Tensor) and not dt >= 0:
        raise ValueError(f"dt must be >= 0, got {dt}")
    return u, dt


def _number(value: Tensor | float) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
