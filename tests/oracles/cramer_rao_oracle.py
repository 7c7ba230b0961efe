"""Bound of tracking a satellite by radar, from scratch: absolute orbits, batch information, finite differences.

Both satellites move under J2 and are integrated in inertial axes by SciPy. For known motion without process noise the
information about the state at time zero adds up measurement by measurement, and the bound at a later time is its
inverse carried there: no recursion, no filter.
"""

import numpy as np
from scipy.integrate import solve_ivp

MU, RADIUS, J2 = 3.986004e14, 6378136.3, 1.0826261738522227e-3


def gravity(position):
    """(3, n) inertial positions to accelerations, point mass and J2."""
    r2 = (position**2).sum(0)
    r = np.sqrt(r2)
    sine2 = position[2] ** 2 / r2
    factor = np.stack([1 - 5 * sine2, 1 - 5 * sine2, 3 - 5 * sine2])
    return -MU * position / r**3 * (1 + 1.5 * J2 * (RADIUS / r) ** 2 * factor)


def orbits(position, velocity, times):
    """Positions and velocities (t, 3, n) of n satellites from (3, n)."""
    count = position.shape[1]

    def rates(_, y):
        p, v = y.reshape(2, 3, count)
        return np.concatenate([v.ravel(), gravity(p).ravel()])

    start = np.concatenate([position.ravel(), velocity.ravel()])
    solution = solve_ivp(rates, (0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-6, max_step=60)
    states = solution.y.T.reshape(len(times), 2, 3, count)
    return states[:, 0], states[:, 1]


def hill_frame(position, velocity):
    """Rows of the chief's axes (3, 3) and their angular rate (3,), inertial components."""
    momentum = np.cross(position, velocity)
    x, z = position / np.linalg.norm(position), momentum / np.linalg.norm(momentum)
    axes = np.stack([x, np.cross(z, x), z])
    out_of_plane = gravity(position[:, None])[:, 0] @ z
    h, r = np.linalg.norm(momentum), np.linalg.norm(position)
    rate = axes.T @ np.array([r * out_of_plane / h, 0, h / r**2])
    return axes, rate


def to_hill(chief_p, chief_v, p, v):
    """Hill states (6, n) of satellites (3, n)."""
    axes, rate = hill_frame(chief_p, chief_v)
    apart, drift = p - chief_p[:, None], v - chief_v[:, None]
    return np.concatenate([axes @ apart, axes @ (drift - np.cross(rate, apart.T).T)])


def radar(hill, chief_radius):
    """Range and two angles (3, n) at which the deputy sees the chief, in axes turned to the deputy's own place."""
    deputy = hill[:3] + np.array([[chief_radius], [0], [0]])
    longitude = np.arctan2(deputy[1], deputy[0])
    latitude = np.arctan2(deputy[2], np.hypot(deputy[0], deputy[1]))
    line = np.array([[chief_radius], [0], [0]]) - deputy
    c, s = np.cos(longitude), np.sin(longitude)
    x, y, z = c * line[0] + s * line[1], -s * line[0] + c * line[1], line[2]
    c, s = np.cos(latitude), np.sin(latitude)
    x, z = c * x + s * z, -s * x + c * z
    return np.stack([np.linalg.norm(line, axis=0), np.arctan2(x, y), np.arctan2(z, np.hypot(x, y))])


def radar_slope(hill, chief_radius, step=0.05):
    """Derivative (3, 6) of the radar's numbers at one Hill state (6,)."""
    moved = hill[:, None] + np.concatenate([step * np.eye(6), -step * np.eye(6)], 1)
    seen = radar(moved, chief_radius)
    change = seen[:, :6] - seen[:, 6:]
    change[1:] = np.angle(np.exp(1j * change[1:]))  # the first angle goes round once a revolution
    return change / (2 * step)


def bound(position, velocity, hill_start, prior_deviation, noise_deviation, times, chief_radius):
    """Covariances (t, 6, 6) of the Hill state after the measurements up to each of ``times`` (t,), increasing.

    position, velocity (3,): chief at time zero. hill_start (6,). prior_deviation (6,), noise_deviation (3,).
    chief_radius: what the radar takes for it.
    """
    # Orbits bend over thousands of kilometres: steps of 1 m and 1 mm/s leave 1e-13 and keep eight digits. The radar's
    # angles bend over 500 m and take smaller ones of their own.
    step = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
    axes, rate = hill_frame(position, velocity)
    states = hill_start[:, None] + np.concatenate([np.diag(step), -np.diag(step), np.zeros((6, 1))], 1)
    apart = axes.T @ states[:3]
    p = position[:, None] + apart
    v = velocity[:, None] + axes.T @ states[3:] + np.cross(rate, apart.T).T
    path_p, path_v = orbits(np.c_[position, p], np.c_[velocity, v], np.concatenate([[0.0], times]))
    information = np.diag(1 / prior_deviation**2)
    result = []
    for k in range(1, len(times) + 1):
        hill = to_hill(path_p[k, :, 0], path_v[k, :, 0], path_p[k, :, 1:], path_v[k, :, 1:])
        transition = (hill[:, :6] - hill[:, 6:12]) / (2 * step)
        slope = radar_slope(hill[:, 12], chief_radius) @ transition / noise_deviation[:, None]
        information = information + slope.T @ slope
        result.append(transition @ np.linalg.inv(information) @ transition.T)
    return np.stack(result)
