"""The Earth and motion on it by other means. No torch.

40-digit geodesy, normal gravity as the gradient of its potential, Newton's law in inertial axes.
"""

import math

import mpmath as mp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

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


# A flight through inertial space -------------------------------------------------------------------------------------


def _normal(r):
    """Latitude, sine, cosine, height and up vector of an ECEF position, plain floats."""
    a, e2 = float(A), float(E2)
    x, y, z = r
    p = math.hypot(x, y)
    lat = math.atan2(z, p * (1 - e2))
    for _ in range(5):
        n = a / math.sqrt(1 - e2 * math.sin(lat) ** 2)
        lat = math.atan2(z + e2 * n * math.sin(lat), p)
    s, c = math.sin(lat), math.cos(lat)
    n = a / math.sqrt(1 - e2 * s * s)
    h = p * c + z * s - a * a / n
    return lat, s, c, h, np.array([c * x / p, c * y / p, s])


def _gravity(s, h):
    a, f = float(A), float(F)
    k = float(B) * 9.8321849378 / (a * 9.7803253359) - 1
    m = float(RATE**2 * A**2 * B / GM)
    surface = 9.7803253359 * (1 + k * s * s) / math.sqrt(1 - float(E2) * s * s)
    return surface * (1 - 2 / a * (1 + f + m - 2 * f * s * s) * h + 3 * h * h / a**2)


def _spin(t):
    angle = float(RATE) * t
    return np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def _axes(lat, lon):
    s, c, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array([[-sl, cl, 0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])


def flight(start, velocity_enu, quaternion, rate, rate_integral, acceleration, times):
    """Fly a body whose angular rate is given and whose thrust gives about the asked acceleration.

    Newton's law in inertial axes by DOP853, where gravitation is gravity without the centrifugal part; no navigation
    frame takes part in the motion.

    Args:
        start: latitude, longitude (rad), height (m); velocity_enu (3,), quaternion (4,) body to ENU at time 0.
        rate, rate_integral: functions of time, body rate against inertial space (3,) and its integral from 0.
        acceleration: function of time, ENU (3,): the specific force is that much above gravity.
        times: (t,) increasing, from 0.

    Returns:
        Running integrals of rate and specific force (t, 3) in turning body axes; latitude, longitude, height (t,),
        velocity (t, 3) ENU and rotation body to ENU (t, 3, 3).
    """
    spin = np.array([0, 0, float(RATE)])
    axes = _axes(start[0], start[1])
    r = np.array(ecef(*start))
    q = (Rotation.from_matrix(axes.T) * Rotation.from_quat(quaternion)).as_quat()
    y0 = np.concatenate([r, axes.T @ velocity_enu + np.cross(spin, r), q, np.zeros(3)])

    def slope(t, y):
        earth = _spin(t)
        r = earth @ y[:3]
        _, s, _, h, up = _normal(r)
        east = np.array([-r[1], r[0], 0]) / math.hypot(r[0], r[1])
        north = np.cross(up, east)
        g = _gravity(s, h)
        a = acceleration(t)
        force = earth.T @ (a[0] * east + a[1] * north + (a[2] + g) * up)
        gravitation = earth.T @ (np.cross(spin, np.cross(spin, r)) - g * up)
        x, w = y[6:9], y[9]
        turn = rate(t)
        u = np.concatenate([w * turn + np.cross(x, turn), [-x @ turn]]) / 2
        unit = y[6:10] / math.sqrt(y[6:10] @ y[6:10])
        x, w = -unit[:3], unit[3]
        body = force + 2 * (w * np.cross(x, force) + np.cross(x, np.cross(x, force)))
        return np.concatenate([y[3:6], force + gravitation, u, body])

    atol = np.repeat([1e-7, 1e-10, 1e-14, 1e-11], [3, 3, 4, 3])
    solution = solve_ivp(slope, (0, times[-1]), y0, "DOP853", times, rtol=3e-14, atol=atol, max_step=1.0)
    assert solution.success
    places, velocities, rotations = [], [], []
    for t, y in zip(times, solution.y.T, strict=True):
        earth = _spin(t)
        r = earth @ y[:3]
        lat, _, _, h, _ = _normal(r)
        lon = math.atan2(r[1], r[0])
        axes = _axes(lat, lon)
        places.append([lat, lon, h])
        velocities.append(axes @ (earth @ y[3:6] - np.cross(spin, r)))
        rotations.append(axes @ earth @ Rotation.from_quat(y[6:10]).as_matrix())
    turned = np.array([rate_integral(t) for t in times])
    return turned, solution.y[10:13].T, np.array(places), np.array(velocities), np.array(rotations)


def plain_gravity(latitude, height):
    """Somigliana's formula with height, plain floats."""
    return _gravity(math.sin(latitude), height)
