"""Inertial navigation with fixes by an error-state Kalman filter in plain NumPy and SciPy. No torch.

Biases are taken out of each sample, attitude is a matrix, derivatives are central differences, covariances are plain
matrices in Joseph's form. States are tuples (c, v, p, bg, ba) with leading dims: body to ENU, velocity, metres east,
north, up, biases; an error turns c from the left.
"""

import math
from itertools import pairwise

import numpy as np
from oracles import inertial_oracle
from scipy.spatial.transform import Rotation

A, E2, RATE = (float(value) for value in (inertial_oracle.A, inertial_oracle.E2, inertial_oracle.RATE))
# Steps of the differences: attitude, velocity, position, biases.
_STEPS = np.repeat([1e-5, 1e-3, 1.0, 1e-5, 1e-3], 3)


def radii(latitude):
    w2 = 1 - E2 * np.sin(latitude) ** 2
    return A * (1 - E2) / w2**1.5, A / w2**0.5


def turn(vector):
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)


def angle(matrix):
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def apply(matrix, vector):
    return (matrix @ vector[..., None])[..., 0]


def retract(x, error):
    d = np.split(error, 5, -1)
    return (turn(d[0]) @ x[0], *(a + b for a, b in zip(x[1:], d[1:], strict=True)))


def local(x, y):
    rest = [b - a for a, b in zip(x[1:], y[1:], strict=True)]
    return np.concatenate([angle(y[0] @ np.swapaxes(x[0], -1, -2)), *rest], -1)


def compose(gyro, accel, dt, bg, ba):
    """Turn (..., 3, 3) and velocity increment (..., 3) in the axes at the start, of samples (s, 3) without biases."""
    c, dv = np.broadcast_to(np.eye(3), (*bg.shape, 3)), np.zeros(bg.shape)
    for w, f, span in zip(gyro, accel, dt, strict=True):
        a, b = (w - bg) * span, (f - ba) * span
        once = np.cross(a, b)
        dv = dv + apply(c, b + once / 2 + np.cross(a, once) / 6)
        c = c @ turn(a)
    return c, dv


def move(x, gyro, accel, dt, origin):
    """One step of navigation; the Earth's and the transport rate are those at its start."""
    c, v, p, bg, ba = x
    span = dt.sum()
    body, dv = compose(gyro, accel, dt, bg, ba)
    m0, n0 = radii(origin[0])
    north_m, east_m = m0 + origin[2], (n0 + origin[2]) * math.cos(origin[0])
    latitude, height = origin[0] + p[..., 1] / north_m, origin[2] + p[..., 2]
    m, n = radii(latitude)
    earth = RATE * np.stack([0 * latitude, np.cos(latitude), np.sin(latitude)], -1)
    east, north = v[..., 0], v[..., 1]
    across = east / (n + height)
    rate = earth + np.stack([-north / (m + height), across, across * np.tan(latitude)], -1)
    weight = np.zeros(v.shape)
    weight[..., 2] = span * np.vectorize(inertial_oracle.plain_gravity)(latitude, height)
    force = apply(c, dv)
    push = force - np.cross(rate * span, force) / 2 - weight
    after = v + push - span * np.cross(earth + rate, v + push / 2)
    mean = span * (v + after) / 2
    moved = [
        mean[..., 0] / ((n + height) * np.cos(latitude)) * east_m,
        mean[..., 1] / (m + height) * north_m,
        mean[..., 2],
    ]
    return turn(-rate * span) @ c @ body, after, p + np.stack(moved, -1), bg, ba


def see(x, gyro, accel, dt, arm):
    """Position, velocity, and velocity in body axes of a point at ``arm``."""
    c, v, p, bg, ba = x
    rate = angle(compose(gyro, accel, dt, bg, ba)[0]) / dt.sum()
    return np.concatenate([p, v, apply(np.swapaxes(c, -1, -2), v) + np.cross(rate, arm)], -1)


def _around(x):
    """x and its neighbours (31, ...)."""
    errors = np.concatenate([np.zeros((1, 15)), np.diag(_STEPS), -np.diag(_STEPS)])
    return retract(tuple(np.broadcast_to(part, (31, *part.shape)) for part in x), errors)


def _split(values):
    """Centre and central differences, rows of the derivative."""
    return (values[1:16] - values[16:]).T / (2 * _STEPS)


def navigate(x, p, samples, densities, measurements, deviation, origin, arm):
    """Filter steps of raw samples.

    Args:
        x: start; p: its covariance (15, 15).
        samples: a step: gyro (s, 3), accel (s, 3), dt (s,). densities (15,): roots of spectral densities.
        measurements: a step: (9,), NaN for what is not measured. deviation (9,).

    Returns:
        State and covariance after each step.
    """
    out = []
    for (gyro, accel, dt), y in zip(samples, measurements, strict=True):
        cloud = move(_around(x), gyro, accel, dt, origin)
        x = tuple(part[0] for part in cloud)
        f = _split(local(x, cloud))
        p = f @ p @ f.T + np.diag(densities**2 * dt.sum())
        seen = ~np.isnan(y)
        if seen.any():
            cloud = see(_around(x), gyro, accel, dt, arm)
            h, r = _split(cloud)[seen], np.diag(deviation[seen] ** 2)
            gain = np.linalg.solve(h @ p @ h.T + r, h @ p).T
            keep = np.eye(15) - gain @ h
            p = keep @ p @ keep.T + gain @ r @ gain.T
            before, shift = x, gain @ (y - cloud[0])[seen]
            x = retract(before, shift)
            # The reset: errors about the state before, seen from the state after.
            ends = [retract(before, shift + step) for step in (0 * _STEPS, *np.diag(_STEPS), *-np.diag(_STEPS))]
            reset = _split(np.stack([local(x, end) for end in ends]))
            p = reset @ p @ reset.T
        out.append((x, p))
    return out


def cut(time, gyro, accel, edges):
    """Samples of each step between edges; the sample at time[i] stands for the interval that ends there."""
    steps = []
    for a, b in pairwise(edges):
        first, last = np.searchsorted(time, a, side="right"), np.searchsorted(time, b)
        bounds = np.concatenate([[a], time[first:last], [b]])
        spans = np.diff(bounds)
        rows = slice(first, last + 1)
        steps.append((gyro[rows], accel[rows], spans))
    return steps
