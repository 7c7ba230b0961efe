"""The Earth by other means: 40-digit geodesy, and normal gravity as the gradient of its potential. No torch."""

import mpmath as mp

A = mp.mpf(6378137)
F = 1 / mp.mpf("298.257223563")
E2 = F * (2 - F)
B = A * (1 - F)
GM = mp.mpf("3.986004418e14")
RATE = mp.mpf("7.292115e-5")


def ecef(latitude, longitude, height):
    """Position in 40 digits, rounded to floats."""
    with mp.workdps(40):
        lat, lon, h = (mp.mpf(float(v)) for v in (latitude, longitude, height))
        n = A / mp.sqrt(1 - E2 * mp.sin(lat) ** 2)
        out = (n + h) * mp.cos(lat)
        return [float(out * mp.cos(lon)), float(out * mp.sin(lon)), float((n * (1 - E2) + h) * mp.sin(lat))]


def radii(latitude):
    """Radii of curvature of the ellipse itself, from its parametrisation by the reduced latitude."""
    with mp.workdps(40):
        beta = mp.atan((1 - F) * mp.tan(mp.mpf(float(latitude))))
        meridian = (A**2 * mp.sin(beta) ** 2 + B**2 * mp.cos(beta) ** 2) ** mp.mpf(1.5) / (A * B)
        # The normal meets the axis at a distance from the surface of p / cos(latitude).
        transverse = A * mp.cos(beta) / mp.cos(mp.mpf(float(latitude)))
        return float(meridian), float(transverse)


def potential(p, z):
    """Gravity potential of the level ellipsoid at distance p from the axis, in ellipsoidal-harmonic coordinates.

    Source: Heiskanen and Moritz, Physical Geodesy (1967), equation 2-62.
    """
    e = mp.sqrt(A**2 - B**2)
    r2 = p**2 + z**2 - e**2
    u = mp.sqrt((r2 + mp.sqrt(r2**2 + 4 * e**2 * z**2)) / 2)
    sin2 = (z / u) ** 2

    def q(x):
        return ((1 + 3 * x**2 / e**2) * mp.atan(e / x) - 3 * x / e) / 2

    spin = RATE**2 / 2
    return GM / e * mp.atan(e / u) + spin * A**2 * q(u) / q(B) * (sin2 - mp.mpf(1) / 3) + spin * p**2


def gravity(latitude, height):
    """Normal gravity (down, south) in m/s^2 along and across the ellipsoid's normal: differences of the potential."""
    with mp.workdps(40):
        lat, h = mp.mpf(float(latitude)), mp.mpf(float(height))
        n = A / mp.sqrt(1 - E2 * mp.sin(lat) ** 2)
        p, z = (n + h) * mp.cos(lat), (n * (1 - E2) + h) * mp.sin(lat)

        def slope(dp, dz):
            step = mp.mpf("1e-6")
            return (potential(p + step * dp, z + step * dz) - potential(p - step * dp, z - step * dz)) / (2 * step)

        down = -slope(mp.cos(lat), mp.sin(lat))
        south = slope(mp.sin(lat), -mp.cos(lat))
        return float(down), float(south)
