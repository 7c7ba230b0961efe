"""The problems that all rows of the filter benchmarks solve, and their exact answers by plain NumPy."""

from typing import NamedTuple

import numpy as np


class Linear(NamedTuple):
    """Linear-Gaussian model with its data: x' = F x + N(0, Q), y = H x + N(0, R); the prior is at the first y."""

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    P0: np.ndarray
    ys: np.ndarray


def constant_velocity(steps: int, series: int | None = None, seed: int = 1) -> Linear:
    """Three axes, position measured: F (6, 6), ys (t, 3) or (t, series, 3)."""
    dt, q, r = 1.0, 0.1, 2.0
    axes = np.eye(3)
    F = np.kron(np.array([[1, dt], [0, 1]]), axes)
    Q = q * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), axes)
    H = np.hstack([axes, np.zeros((3, 3))])
    P0 = np.diag([25.0] * 3 + [1.0] * 3)
    rng = np.random.default_rng(seed)
    count = 1 if series is None else series
    root = np.linalg.cholesky(Q)
    x = rng.standard_normal((count, 6)) @ np.sqrt(P0)
    ys = np.empty((steps, count, 3))
    for k in range(steps):
        if k > 0:
            x = x @ F.T + rng.standard_normal((count, 6)) @ root.T
        ys[k] = x[:, :3] + r * rng.standard_normal((count, 3))
    return Linear(F, Q, H, r**2 * axes, P0, ys[:, 0] if series is None else ys)


def kalman(problem: Linear) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance-form Kalman filter of all series at once.

    Returns:
        Log-likelihoods (series,), means (t, series, 6), variances (t, 6).
    """
    F, Q, H, R, P, ys = problem
    ys = ys if ys.ndim == 3 else ys[:, None]
    mean, total = np.zeros((ys.shape[1], len(F))), np.zeros(ys.shape[1])
    means, variances = [], []
    for k, y in enumerate(ys):
        if k > 0:
            mean, P = mean @ F.T, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        gain = np.linalg.solve(S, H @ P).T
        innovation = y - mean @ H.T
        nis = np.einsum("bi,bi->b", innovation, np.linalg.solve(S, innovation.T).T)
        total += -0.5 * (nis + np.linalg.slogdet(2 * np.pi * S)[1])
        mean = mean + innovation @ gain.T
        P = P - gain @ S @ gain.T
        means.append(mean)
        variances.append(np.diag(P))
    return total, np.stack(means), np.stack(variances)


def turn_law(x: np.ndarray, dt: float) -> np.ndarray:
    """Coordinated turn of (..., 5): position, velocity, turn rate."""
    px, py, vx, vy, w = np.moveaxis(x, -1, 0)
    angle = w * dt
    small = np.abs(w) < 1e-9
    safe = np.where(small, 1.0, w)
    s = np.where(small, dt, np.sin(angle) / safe)
    c = np.where(small, 0.0, (1 - np.cos(angle)) / safe)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([px + s * vx - c * vy, py + c * vx + s * vy, cos * vx - sin * vy, sin * vx + cos * vy, w], -1)


def range_bearing(x: np.ndarray) -> np.ndarray:
    """(..., 2)."""
    return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1)


class Turn(NamedTuple):
    """Coordinated turn seen by range and bearing; factors of the noises, ys (t, series, 2)."""

    mean0: np.ndarray
    root0: np.ndarray
    root_q: np.ndarray
    root_r: np.ndarray
    ys: np.ndarray


def coordinated_turn(steps: int, series: int, seed: int = 2) -> Turn:
    """Far from the origin and from the cut of the bearing, so that no row needs to wrap an angle."""
    mean0 = np.array([1000.0, 500.0, 5.0, 10.0, 0.02])
    root0 = np.diag([10.0, 10.0, 1.0, 1.0, 0.005])
    root_q, root_r = np.diag([0.5, 0.5, 0.2, 0.2, 0.001]), np.diag([5.0, 0.005])
    rng = np.random.default_rng(seed)
    x = mean0 + rng.standard_normal((series, 5)) @ root0
    ys = np.empty((steps, series, 2))
    for k in range(steps):
        if k > 0:
            x = turn_law(x, 1.0) + rng.standard_normal((series, 5)) @ root_q
        ys[k] = range_bearing(x) + rng.standard_normal((series, 2)) @ root_r
    return Turn(mean0, root0, root_q, root_r, ys)
