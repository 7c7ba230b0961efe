"""Magnetometer: the field in body axes through hard and soft iron, and the fit of both to what a turn shows."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import check_finite, hold
from torchfilt.models.attitude import VectorMeasurement

Step = Tensor | float | None


def field_enu(strength: float, inclination_rad: float, declination_rad: float) -> Tensor:
    """Field of the Earth (3,) in ENU, in the unit of its strength, float64.

    Args:
        strength: length. inclination_rad: below the horizon, positive in the north. declination_rad: of its horizontal
            part, east of north.

    Raises:
        ValueError: a strength that is not positive and finite, angles beyond pi / 2 and pi.

    Source: Chulliat et al., The US/UK World Magnetic Model for 2020-2025 (NOAA, 2020), section 1.2: the elements.
    """
    if not 0 < strength < math.inf:
        raise ValueError(f"strength must be positive and finite, got {strength}")
    for name, angle, most in (("inclination_rad", inclination_rad, 0.5), ("declination_rad", declination_rad, 1.0)):
        if not abs(angle) <= most * math.pi:
            raise ValueError(f"{name} must be within {most} pi, got {angle}")
    level = strength * math.cos(inclination_rad)
    parts = [
        level * math.sin(declination_rad),
        level * math.cos(declination_rad),
        -strength * math.sin(inclination_rad),
    ]
    return torch.tensor(parts, dtype=torch.float64)


class Magnetometer(nn.Module):
    """Field in body axes as the sensor shows it: y = soft iron R(q)^T field + hard iron + noise.

    Magnets on board add the hard iron; iron that the field magnetises, scale factors and axes that are not square make
    the soft iron. The hard iron is a constant, three numbers of the state, or both: then the state holds the rest.

    Args:
        field: (3,) or (*batch, 3) in world axes, such as `field_enu` gives, any unit.
        sd: standard deviation of each axis of the sensor, number or (3,), in that unit.
        hard_iron: (3,) constant; None for zero. soft_iron: (3, 3) that can be inverted; None for none.
        hard_iron_at: index of the first of the three numbers in the state; None: not in the state.

    Raises:
        ValueError: what `torchfilt.models.attitude.VectorMeasurement` refuses of field and sd, shapes, numbers that are
            not finite, a soft iron that is singular to rounding, an index below 4; when called, a state without a
            quaternion or the three numbers.

    Source: Renaudin, Afzal and Lachapelle, Complete triaxis magnetometer calibration in the magnetic domain, Journal of
    Sensors (2010), section 2.
    """

    hard_iron: Tensor
    soft_iron: Tensor

    def __init__(
        self,
        field: Tensor,
        sd: Tensor | float,
        *,
        hard_iron: Tensor | None = None,
        soft_iron: Tensor | None = None,
        hard_iron_at: int | None = None,
    ) -> None:
        super().__init__()
        self.seen = VectorMeasurement(field, sd)
        hard = field.new_zeros(3) if hard_iron is None else hard_iron
        soft = torch.eye(3, dtype=field.dtype, device=field.device) if soft_iron is None else soft_iron
        for name, given, shape in (("hard_iron", hard, (3,)), ("soft_iron", soft, (3, 3))):
            if given.shape != shape:
                raise ValueError(f"{name} must be {shape}, got shape {tuple(given.shape)}")
            check_finite(given, name)
        values = torch.linalg.svdvals(soft.detach())
        if values[-1] <= 16 * torch.finfo(soft.dtype).eps * values[0]:
            raise ValueError(f"soft_iron must not be singular, its singular values are {values.tolist()}")
        if hard_iron_at is not None and hard_iron_at < 4:
            raise ValueError(f"hard_iron_at must be an index behind the quaternion, 4 or more, got {hard_iron_at}")
        hold(self, "hard_iron", hard)
        hold(self, "soft_iron", soft)
        self.hard_iron_at = hard_iron_at
        self.size = 3

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the reading (..., 3), body axes, at states (..., d)."""
        return self._through_iron(x, self.seen(x))

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 3, d - 1)."""
        seen, slope = self.seen.first_order(x)
        slope = self.soft_iron.to(x.dtype) @ slope
        if self.hard_iron_at is not None:
            at = self.hard_iron_at - 1
            slope = slope + torch.eye(x.shape[-1] - 1, dtype=x.dtype, device=x.device)[at : at + 3]
        return self._through_iron(x, seen), slope

    def _through_iron(self, x: Tensor, seen: Gaussian) -> Gaussian:
        soft, hard = self.soft_iron.to(x.dtype), self.hard_iron.to(x.dtype)
        mean = (soft * seen.mean.unsqueeze(-2)).sum(-1) + hard
        if self.hard_iron_at is not None:
            at = self.hard_iron_at
            if x.shape[-1] < at + 3:
                raise ValueError(f"the state must have {at + 3} numbers or more, got {tuple(x.shape)}")
            mean = mean + x[..., at : at + 3]
        return seen._replace(mean=mean)


# Calibration ----------------------------------------------------------------------------------------------------------

# Row and column of the six numbers of a symmetric matrix.
_ROWS, _COLUMNS = (0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)
_WORST_CONDITION = 100.0
_ROUNDS = 50


@dataclass(frozen=True)
class IronFit:
    """Hard and soft iron of a magnetometer with their uncertainty.

    hard_iron (3,), hard_iron_sd (3,): in the unit of the samples. soft_iron (3, 3), soft_iron_sd (3, 3): symmetric.
    noise_sd: of each axis of the sensor, in that unit too, as the distances from the ellipsoid show it.
    condition: of the linearised fit.
    """

    hard_iron: Tensor
    soft_iron: Tensor
    hard_iron_sd: Tensor
    soft_iron_sd: Tensor
    noise_sd: float
    condition: float

    def correct(self, samples: Tensor) -> Tensor:
        """Field (..., 3) in body axes that the sensor showed as samples (..., 3)."""
        centred = (samples - self.hard_iron.to(samples.dtype)).unsqueeze(-1)
        return torch.linalg.solve(self.soft_iron.to(samples.dtype), centred).squeeze(-1)


def fit_iron(samples: Tensor, field_strength: float) -> IronFit:
    """Hard and soft iron from readings at many attitudes in one and the same field.

    Readings lie on an ellipsoid: |S^-1 (y - b)| = field strength. It is fitted as a quadric by linear least squares and
    then by Gauss-Newton on the distances from it. An ellipsoid looks the same after any turn of the field before it, so
    that only the symmetric S can be found: a turn of the sensor's axes against the body needs a known attitude. Noise
    of sd s makes the ellipsoid too large by a share of about (s / strength)^2; nothing is done about that.

    Args:
        samples: (n, 3), n >= 10. field_strength: of the field, in any unit; S is in units of the samples over it.

    Returns:
        The fit, in the dtype of the samples; deviations hold for independent noise that is equal in all axes.

    Raises:
        ValueError: shapes, numbers that are not finite, a strength that is not positive; samples that do not cover
            enough directions for the nine unknowns, or do not lie on an ellipsoid.

    Source: Renaudin, Afzal and Lachapelle (2010), section 3, for the quadric; Gauss-Newton: Bjorck, Numerical Methods
    for Least Squares Problems (1996), section 9.2.
    """
    if samples.dim() != 2 or samples.shape[-1] != 3 or len(samples) < 10:
        raise ValueError(f"samples must be (n, 3) with n >= 10, got shape {tuple(samples.shape)}")
    check_finite(samples, "samples")
    if not 0 < field_strength < math.inf:
        raise ValueError(f"field_strength must be positive and finite, got {field_strength}")
    given = samples.detach().double()
    # About the middle and in units of the spread, where the nine unknowns have one size.
    middle = given.mean(0)
    spread = (given - middle).square().sum(-1).mean().sqrt().clamp_min(torch.finfo(torch.float64).tiny)
    points = (given - middle) / spread
    centre, shape = _quadric(points)
    for _ in range(_ROUNDS):
        residual, jacobian = _distances(points, centre, shape)
        step = torch.linalg.lstsq(jacobian, -residual.unsqueeze(-1)).solution.squeeze(-1)
        centre, shape = centre + step[:3], shape + _symmetric(step[3:])
        if step.abs().max() < 1e-12:
            break
    residual, jacobian = _distances(points, centre, shape)
    condition = _check_cover(jacobian)
    if not bool((torch.linalg.eigvalsh(shape) > 0).all()) or step.abs().max() > 1e-6:
        raise ValueError("samples do not lie on an ellipsoid: the fit does not converge")
    noise = (residual.square().sum() / (len(points) - 9)).sqrt()
    deviation = noise * torch.linalg.inv(jacobian.mT @ jacobian).diagonal().sqrt()
    scale = spread / field_strength
    parts = middle + spread * centre, scale * shape, spread * deviation[:3], scale * _symmetric(deviation[3:])
    hard, soft, hard_sd, soft_sd = (part.to(samples.dtype) for part in parts)
    return IronFit(hard, soft, hard_sd, soft_sd, float(noise * spread), condition)


def _quadric(points: Tensor) -> tuple[Tensor, Tensor]:
    """Centre b (3,) and symmetric S (3, 3) with |S^-1 (y - b)| = 1, by y' A y + 2 g' y = 1, least squares."""
    squares = points[:, _ROWS] * points[:, _COLUMNS] * points.new_tensor([1, 1, 1, 2, 2, 2])
    design = torch.cat([squares, 2 * points], -1)
    _check_cover(design)
    solution = torch.linalg.lstsq(design, points.new_ones(len(points), 1)).solution.squeeze(-1)
    matrix, slope = _symmetric(solution[:6]), solution[6:]
    centre = -torch.linalg.solve(matrix, slope)
    values, axes = torch.linalg.eigh(matrix / (1 + centre @ matrix @ centre))
    if not bool((values > 0).all()):
        raise ValueError(f"samples do not lie on an ellipsoid: the quadric through them has the axes {values.tolist()}")
    return centre, axes @ torch.diag(values.rsqrt()) @ axes.mT


def _distances(points: Tensor, centre: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """Distance (n,) of points from the ellipsoid, to first order, and its derivative (n, 9) by b and S's six numbers.

    With v = W (y - b), W = S^-1, and n along v: d|v| = n' W dy and dW = -W dS W. The derivative is that at the surface,
    where v = n: at the points themselves it would hold their noise, which goes with the distance's own.
    """
    field = torch.linalg.solve(shape, (points - centre).mT).mT
    length = torch.linalg.vector_norm(field, dim=-1, keepdim=True)
    normal = torch.linalg.solve(shape.mT, (field / length).mT).mT
    steepness = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    outward = normal / steepness
    by_shape = -outward.unsqueeze(-1) * (field / length).unsqueeze(-2)
    both = by_shape[:, _ROWS, _COLUMNS] + by_shape[:, _COLUMNS, _ROWS]
    both = both * points.new_tensor([0.5, 0.5, 0.5, 1, 1, 1])
    return ((length - 1) / steepness).squeeze(-1), torch.cat([-outward, both], -1)


def _symmetric(six: Tensor) -> Tensor:
    xx, yy, zz, yz, xz, xy = six.unbind()
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3)


def _check_cover(design: Tensor) -> float:
    """Condition number of the nine columns."""
    values = torch.linalg.svdvals(design)
    condition = float(values[0] / values[-1])
    if not condition < _WORST_CONDITION:
        raise ValueError(
            f"samples do not cover enough directions: the condition number of the fit's nine unknowns is "
            f"{condition:.3g}, at most {_WORST_CONDITION:g} is taken; turn the sensor about all of its axes"
        )
    return condition
