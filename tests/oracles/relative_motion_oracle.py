"""Relative motion by other means: matrix exponentials, rotation matrices, two absolute orbits. numpy and SciPy only."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation


def cw_step(angle):
    """Transition, input matrix and noise covariance for n = 1 and unit spectral density, by matrix exponentials.

    Time is counted in radians of the orbit: in SI units the blocks of the exponent differ by 1e6 and cost digits.
    """
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4], a[4, 3], a[5, 2] = 3, 2, -2, -1
    b = np.vstack([np.zeros((3, 3)), np.eye(3)])
    held = expm(np.block([[a, b], [np.zeros((3, 9))]]) * angle)
    van_loan = expm(np.block([[-a, b @ b.T], [np.zeros((6, 6)), a.T]]) * angle)
    transition = van_loan[6:, 6:].T
    noise = transition @ van_loan[:6, 6:]
    return transition, held[:6, 6:], (noise + noise.T) / 2


def hill_matrix(r, v):
    """Rows: radial, along track, orbit normal."""
    z = np.cross(r, v)
    x, z = r / np.linalg.norm(r), z / np.linalg.norm(z)
    return np.array([x, np.cross(z, x), z])


def two_body(state, t, mu, j2=0.0, radius=6378136.3):
    """One absolute orbit under a point mass (and J2), DOP853 at 1e-13."""

    def rates(_, y):
        r = np.linalg.norm(y[:3])
        acceleration = -mu * y[:3] / r**3
        if j2:
            s = (y[2] / r) ** 2
            k = 1.5 * j2 * mu * radius**2 / r**5
            acceleration = acceleration - k * y[:3] * np.array([1 - 5 * s, 1 - 5 * s, 3 - 5 * s])
        return np.concatenate([y[3:], acceleration])

    scale = np.repeat([1e-13 * 7e6, 1e-13 * 7e3], 3)
    return solve_ivp(rates, (0, t), state, method="DOP853", rtol=1e-13, atol=scale).y[:, -1]


def radar(position, chief_radius):
    """Range, alpha, beta by rotating the line of sight into the deputy's local axes."""
    chief = np.array([chief_radius, 0.0, 0.0])
    deputy = chief + position
    longitude = np.arctan2(deputy[1], deputy[0])
    latitude = np.arcsin(deputy[2] / np.linalg.norm(deputy))
    local = Rotation.from_euler("y", latitude) * Rotation.from_euler("z", -longitude)
    x, y, z = local.apply(chief - deputy)
    return np.array([np.linalg.norm(position), np.arctan2(x, y), np.arctan2(z, np.hypot(x, y))])
