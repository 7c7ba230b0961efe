"""The Earth of inertial navigation: the WGS-84 ellipsoid, its normal gravity and rotation, and positions on it.

Angles in rad, lengths in m. ENU axes point east, north and along the ellipsoid's outward normal; ECEF axes turn with
the Earth, x through latitude 0 and longitude 0, z through the north pole. Functions of tensors broadcast over leading
dims and are differentiable. In float32 a latitude resolves 0.4 m and an ECEF coordinate 0.5 m: hold positions as
metres from an origin (`LocalMetres`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.spaces import wrap_angle


@dataclass(frozen=True)
class Ellipsoid:
    """A level ellipsoid that rotates with the Earth.

    Defined by the first four numbers; the normal gravity at equator and pole follows from them, but is kept as a number
    because its closed form cancels digits.
    """

    semi_major_m: float
    flattening: float
    rate_rad_s: float
    gm_m3_s2: float
    gravity_equator_m_s2: float
    gravity_pole_m_s2: float

    @property
    def semi_minor_m(self) -> float:
        """Distance of the poles from the centre."""
        return self.semi_major_m * (1 - self.flattening)

    @property
    def eccentricity2(self) -> float:
        """Square of the first eccentricity."""
        return self.flattening * (2 - self.flattening)

    @property
    def centrifugal_ratio(self) -> float:
        """Centrifugal over gravitational acceleration at the equator, nearly: the letter m of the normal field."""
        return self.rate_rad_s**2 * self.semi_major_m**2 * self.semi_minor_m / self.gm_m3_s2


# NGA.STND.0036 (2014), tables 3.1 and 3.5, 3.6.
WGS84 = Ellipsoid(
    semi_major_m=6378137.0,
    flattening=1 / 298.257223563,
    rate_rad_s=7.292115e-5,
    gm_m3_s2=3.986004418e14,
    gravity_equator_m_s2=9.7803253359,
    gravity_pole_m_s2=9.8321849378,
)
# k of Somigliana's formula.
_SOMIGLIANA = (1 - WGS84.flattening) * WGS84.gravity_pole_m_s2 / WGS84.gravity_equator_m_s2 - 1


def radii(latitude_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Radii of curvature of the meridian and of the prime vertical (across it), each (...), m."""
    return radii_at(latitude_rad.sin().square())


def radii_at(sine2: Tensor) -> tuple[Tensor, Tensor]:
    """`radii` where the square of the latitude's sine is known, (...)."""
    w2 = 1 - WGS84.eccentricity2 * sine2
    transverse = WGS84.semi_major_m / w2.sqrt()
    return transverse * (1 - WGS84.eccentricity2) / w2, transverse


def gravity(latitude_rad: Tensor, height_m: Tensor) -> Tensor:
    """Normal gravity, positive down along the ellipsoid's normal, (...), m/s^2.

    Somigliana's closed form on the ellipsoid, above it second order in height and first order in the flattening: off
    by at most 1e-10 m/s^2 for each metre of height and, at 6 km, 3e-8 m/s^2 of the third order. The horizontal part
    that normal gravity has above the ellipsoid is left out (at most 5e-5 m/s^2 at 6 km).

    Source: NGA.STND.0036 (2014), equations 4-1 and 4-3.
    """
    sine2 = latitude_rad.sin().square()
    return gravity_at(sine2, height_m, radii_at(sine2)[1])


def gravity_at(sine2: Tensor, height_m: Tensor, transverse_m: Tensor) -> Tensor:
    """`gravity` where the square of the latitude's sine and the radius across the meridian are known, (...)."""
    a, f = WGS84.semi_major_m, WGS84.flattening
    surface = (WGS84.gravity_equator_m_s2 / a) * (1 + _SOMIGLIANA * sine2) * transverse_m
    ratio = height_m / a
    falls = 2 * (1 + f + WGS84.centrifugal_ratio) - 4 * f * sine2
    return surface * (1 + ratio * (3 * ratio - falls))


def radii_slopes(latitude_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of both `radii` by latitude, each (...), m/rad."""
    e2 = WGS84.eccentricity2
    sine = latitude_rad.sin()
    w2 = 1 - e2 * sine.square()
    transverse = e2 * WGS84.semi_major_m * sine * latitude_rad.cos() * w2**-1.5
    return 3 * (1 - e2) * transverse / w2, transverse


def gravity_slopes(latitude_rad: Tensor, height_m: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of `gravity` by latitude (m/s^2/rad) and by height (1/s^2), each (...)."""
    a, f, e2 = WGS84.semi_major_m, WGS84.flattening, WGS84.eccentricity2
    sine = latitude_rad.sin()
    sin2, double = sine.square(), 2 * sine * latitude_rad.cos()
    w2, grown = 1 - e2 * sin2, 1 + _SOMIGLIANA * sin2
    surface = WGS84.gravity_equator_m_s2 * grown / w2.sqrt()
    surface_slope = surface * double * (_SOMIGLIANA / grown + e2 / (2 * w2))
    ratio = height_m / a
    falls = 2 * (1 + f + WGS84.centrifugal_ratio) - 4 * f * sin2
    by_latitude = surface_slope * (1 - falls * ratio + 3 * ratio.square()) + surface * double * ratio * (4 * f)
    return by_latitude, surface * (6 * ratio - falls) / a


def slopes(latitude_rad: Tensor, height_m: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`radii_slopes` and `gravity_slopes`: automatic differentiation at a fraction of its price."""
    return (*radii_slopes(latitude_rad), *gravity_slopes(latitude_rad, height_m))


def earth_rate_enu(latitude_rad: Tensor) -> Tensor:
    """Angular rate of the Earth in ENU axes, (..., 3), rad/s."""
    north, up = latitude_rad.cos(), latitude_rad.sin()
    return WGS84.rate_rad_s * torch.stack([torch.zeros_like(north), north, up], -1)


def transport_rate_enu(latitude_rad: Tensor, height_m: Tensor, velocity_enu_m_s: Tensor) -> Tensor:
    """Angular rate of the ENU axes against the Earth as the vehicle moves, in ENU axes, (..., 3), rad/s.

    Args:
        latitude_rad, height_m: (...); not a pole, where east is undefined.
        velocity_enu_m_s: (..., 3).
    """
    meridian, transverse = radii(latitude_rad)
    east, north = velocity_enu_m_s[..., 0], velocity_enu_m_s[..., 1]
    turn = east / (transverse + height_m)
    return torch.stack(torch.broadcast_tensors(-north / (meridian + height_m), turn, turn * latitude_rad.tan()), -1)


def geodetic_to_ecef(latitude_rad: Tensor, longitude_rad: Tensor, height_m: Tensor) -> Tensor:
    """ECEF position (..., 3), m."""
    sine, cosine = latitude_rad.sin(), latitude_rad.cos()
    transverse = WGS84.semi_major_m / (1 - WGS84.eccentricity2 * sine.square()).sqrt()
    from_axis = (transverse + height_m) * cosine
    along_axis = (transverse * (1 - WGS84.eccentricity2) + height_m) * sine
    x, y = from_axis * longitude_rad.cos(), from_axis * longitude_rad.sin()
    return torch.stack(torch.broadcast_tensors(x, y, along_axis), -1)


def ecef_to_geodetic(position_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Latitude, longitude and height, each (...), of ECEF positions (..., 3), by Bowring's iteration.

    Exact to the rounding of the position from 1000 km below the ground to 40,000 km above it and beyond, poles included
    (2e-9 m near the ground, 2e-8 m at 40,000 km). On the axis the longitude is arbitrary and there are no derivatives.
    Longitude in [-pi, pi].

    Source: Bowring, Transformation from spatial to geographical coordinates, Survey Review 23 (1976).
    """
    a, b, e2 = WGS84.semi_major_m, WGS84.semi_minor_m, WGS84.eccentricity2
    x, y, z = position_m.unbind(-1)
    p = torch.hypot(x, y)
    # Sine and cosine of the reduced latitude; of the geodetic one after each round.
    sine, cosine = _direction(z * a, p * b)
    for _ in range(3):  # two suffice at every height of the range
        up, out = z + e2 / (1 - e2) * b * sine**3, p - e2 * a * cosine**3
        sine, cosine = _direction(up * b, out * a)
    sine, cosine = _direction(up, out)
    height = p * cosine + z * sine - a * (1 - e2 * sine.square()).sqrt()
    return torch.atan2(up, out), torch.atan2(y, x), height


def _direction(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Sine and cosine of the direction of (x, y)."""
    length = torch.hypot(x, y)
    return y / length, x / length


def enu_from_ecef_matrix(latitude_rad: Tensor, longitude_rad: Tensor) -> Tensor:
    """Rotation (..., 3, 3) whose rows are east, north and up in ECEF axes: ``matrix @ ecef`` has ENU components."""
    latitude_rad, longitude_rad = torch.broadcast_tensors(latitude_rad, longitude_rad)
    s, c = latitude_rad.sin(), latitude_rad.cos()
    sl, cl = longitude_rad.sin(), longitude_rad.cos()
    zero = torch.zeros_like(s)
    return torch.stack([-sl, cl, zero, -s * cl, -s * sl, c, c * cl, c * sl, s], -1).unflatten(-1, (3, 3))


class LocalMetres(NamedTuple):
    """Positions as metres east, north and up of an origin, at a scale that is fixed there.

    Not a tangent plane but a linear, exactly invertible map of latitude, longitude and height:
    latitude = latitude_0 + north / (M_0 + h_0), longitude = longitude_0 + east / ((N_0 + h_0) cos latitude_0),
    height = h_0 + up, with the radii M_0 and N_0 at the origin. Away from the origin a metre of it is not exactly a
    metre on the ground (nor need it be: the laws use the true radii). The origin is a plain number in each field.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float

    @property
    def north_m(self) -> float:
        """Metres north in a radian of latitude."""
        w2 = 1 - WGS84.eccentricity2 * math.sin(self.latitude_rad) ** 2
        return WGS84.semi_major_m * (1 - WGS84.eccentricity2) / w2**1.5 + self.height_m

    @property
    def east_m(self) -> float:
        """Metres east in a radian of longitude."""
        w2 = 1 - WGS84.eccentricity2 * math.sin(self.latitude_rad) ** 2
        return (WGS84.semi_major_m / w2**0.5 + self.height_m) * math.cos(self.latitude_rad)

    def to_metres(self, latitude_rad: Tensor, longitude_rad: Tensor, height_m: Tensor) -> Tensor:
        """East, north, up (..., 3) in m; the shorter way round in longitude."""
        east = wrap_angle(longitude_rad - self.longitude_rad) * self.east_m
        north = (latitude_rad - self.latitude_rad) * self.north_m
        return torch.stack(torch.broadcast_tensors(east, north, height_m - self.height_m), -1)

    def to_geodetic(self, metres: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Latitude, longitude (in [-pi, pi]) and height, each (...), of metres (..., 3)."""
        east, north, up = metres.unbind(-1)
        longitude = wrap_angle(self.longitude_rad + east / self.east_m)
        return self.latitude_rad + north / self.north_m, longitude, self.height_m + up
