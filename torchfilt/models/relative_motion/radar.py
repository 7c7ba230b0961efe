"""Rendezvous radar on the deputy, looking at the chief."""

import math

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.spaces import Angle, Euclidean, Product

RADAR_SPACE = Product(Euclidean(1), Angle(2))
_ANGLE_SD_RAD = math.radians(0.05) / 3


def line_of_sight(position_m: Tensor, chief_radius_m: Tensor | float) -> Tensor:
    """Chief as seen from the deputy, in the deputy's own local axes.

    These are the chief's Hill axes turned about z by the deputy's longitude and about y by its latitude, so that x
    points from the Earth's centre to the deputy.

    Args:
        position_m: deputy in the chief's Hill axes, (..., >= 3).
        chief_radius_m: number or (...).

    Returns:
        (..., 3): (x_c, y_c, z_c) in m, as long as the separation.
    """
    x, y, z = position_m[..., 0], position_m[..., 1], position_m[..., 2]
    a = chief_radius_m + x
    plane2 = a * a + y * y
    plane, far = plane2.sqrt(), (plane2 + z * z).sqrt()
    return torch.stack(
        [
            -(x * a + y * y + z * z) / far,  # the large terms R_c^2 have been cancelled by hand
            -y * chief_radius_m / plane,
            -z * chief_radius_m * a / (far * plane),
        ],
        -1,
    )


class RendezvousRadar(nn.Module):
    """Range, alpha and beta of the chief on ``Product(Euclidean(1), Angle(2))``.

    With (x_c, y_c, z_c) of `line_of_sight`: range = |.|, alpha = atan2(x_c, y_c),
    beta = atan2(z_c, sqrt(x_c^2 + y_c^2)).

    Args:
        chief_radius_m: distance of the chief from the Earth's centre, number or (...).
        range_sd_m, azimuth_sd_rad, elevation_sd_rad: standard deviations of range, alpha, beta; the formation study
            gives three of them as 0.1 m, 0.05 deg, 0.05 deg. Numbers or scalar tensors.
        field_of_view_rad: half-angle for alpha and beta, used by `in_view` and `hide`; None sees everything.

    Raises:
        ValueError: a radius, deviation or field of view that is not positive.

    Source: Wei, Song, Zhang (2012), equation 4, with its axes made consistent, a lost square restored and quadrants
        resolved by atan2.
    """

    chief_radius_m: Tensor
    standard_deviation: Tensor

    def __init__(
        self,
        chief_radius_m: Tensor | float,
        range_sd_m: Tensor | float = 0.1 / 3,
        azimuth_sd_rad: Tensor | float = _ANGLE_SD_RAD,
        elevation_sd_rad: Tensor | float = _ANGLE_SD_RAD,
        field_of_view_rad: float | None = None,
    ) -> None:
        super().__init__()
        given = (range_sd_m, azimuth_sd_rad, elevation_sd_rad)
        parts = [v if isinstance(v, Tensor) else torch.tensor(v, dtype=torch.float64) for v in given]
        deviation = torch.stack(parts)
        radius = chief_radius_m if isinstance(chief_radius_m, Tensor) else torch.tensor(chief_radius_m).double()
        named = {"standard deviations": deviation, "chief_radius_m": radius}
        for name, value in named.items():
            if not bool((value.detach() > 0).all()):
                raise ValueError(f"{name} must be positive, got {value.tolist()}")
        if field_of_view_rad is not None and not field_of_view_rad > 0:
            raise ValueError(f"field_of_view_rad must be positive, got {field_of_view_rad}")
        hold(self, "chief_radius_m", radius)
        hold(self, "standard_deviation", deviation)
        self.field_of_view_rad = field_of_view_rad
        self.space = RADAR_SPACE

    def measure(self, x: Tensor) -> Tensor:
        """Noise-free measurement (..., 3) of relative states or positions (..., >= 3)."""
        sight = line_of_sight(x, self.chief_radius_m.to(x.dtype))
        across, along, up = sight.unbind(-1)
        plane2 = across.square() + along.square()
        distance = (plane2 + up.square()).sqrt()
        return torch.stack([distance, torch.atan2(across, along), torch.atan2(up, plane2.sqrt())], -1)

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the measurement given relative states (..., >= 3)."""
        return Gaussian(self.measure(x), self.standard_deviation.to(x.dtype), self.space, is_diagonal=True)

    def invert(self, y: Tensor) -> Tensor:
        """Relative position (..., 3), Hill axes, from one measurement (..., 3); |beta| < 90 deg, range < radius."""
        distance, alpha, beta = y.unbind(-1)
        plane = distance * beta.cos()
        across, along, up = plane * alpha.sin(), plane * alpha.cos(), distance * beta.sin()
        radius = self.chief_radius_m.to(y.dtype)
        far = (radius.square() - along.square() - up.square()).sqrt() - across
        # Chief at (R_c, 0, 0): sin(longitude) = -y_c / R_c, sin(latitude) = -z_c / (R_c cos(longitude)).
        sin_t = -along / radius
        cos_t = (1 - sin_t.square()).sqrt()
        sin_p = -up / (radius * cos_t)
        cos_p = (1 - sin_p.square()).sqrt()
        # x R_c + range^2 = -x_c R_d holds exactly and subtracts no radii.
        x = -(across * far + distance.square()) / radius
        return torch.stack([x, far * cos_p * sin_t, far * sin_p], -1)

    def in_view(self, y: Tensor) -> Tensor:
        """Which measurements (..., 3) have both angles inside the field of view; (...), bool."""
        if self.field_of_view_rad is None:
            return torch.ones(y.shape[:-1], dtype=torch.bool, device=y.device)
        return (y[..., 1:].abs() <= self.field_of_view_rad).all(-1)

    def hide(self, y: Tensor) -> Tensor:
        """Measurements (..., 3) with NaN (not measured) where the chief is out of view."""
        return torch.where(self.in_view(y).unsqueeze(-1), y, torch.nan)
