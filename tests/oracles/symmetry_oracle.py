"""A vehicle near a landmark, in the vehicle's own axes: the state that is left when the compass is taken away.

b is where the vehicle is, seen along and across its nose; imports nothing of the library.
"""

import numpy as np
from oracles import kalman_oracle

Array = np.ndarray


def rotation(angle: Array | float) -> Array:
    """Matrices (..., 2, 2) that turn vectors counter-clockwise."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)


def simulate(
    rng, rows: int, us: Array, dt: float, prior_sd: float, heading_sd: float, walk: float, wobble: float
) -> tuple[Array, Array]:
    """World states (steps, rows, 3) and b (steps, rows, 2) under controls us (steps, 2): speed and turn rate."""
    p, heading = prior_sd * rng.standard_normal((rows, 2)), heading_sd * rng.standard_normal(rows)
    states, own = [], []
    for speed, rate in us:
        nose = np.stack([np.cos(heading), np.sin(heading)], -1)
        p = p + dt * speed * nose + walk * rng.standard_normal((rows, 2))
        heading = heading + dt * rate + wobble * rng.standard_normal(rows)
        states.append(np.concatenate([p, heading[:, None]], -1))
        own.append(np.einsum("rij,ri->rj", rotation(heading), p))
    return np.array(states), np.array(own)


def kalman(us: Array, dt: float, prior_sd: float, walk: float, h: Array, r: Array, ys: Array) -> kalman_oracle.Filtered:
    """Exact filter of b from ys (steps, m) = h b + noise, for turns without noise: b' = R(-turn) (b + step + noise)."""
    back = rotation(-dt * us[:, 1])
    push = np.einsum("tij,tj->ti", back, np.stack([dt * us[:, 0], 0 * us[:, 0]], -1))
    q = np.broadcast_to(walk**2 * np.eye(2), back.shape)
    return kalman_oracle.kalman(np.zeros(2), prior_sd**2 * np.eye(2), back, q, h, r, ys, push)


def bootstrap(rng, count: int, us: Array, dt: float, prior_sd: float, walk: float, wobble: float, log_density, ys):
    """Many particles of b; log_density(y, b) -> (count,). Log-likelihood of the series, last mean and covariance."""
    b, total = prior_sd * rng.standard_normal((count, 2)), 0.0
    for (speed, rate), y in zip(us, ys, strict=True):
        b = b + np.array([dt * speed, 0.0]) + walk * rng.standard_normal((count, 2))
        turn = dt * rate + wobble * rng.standard_normal(count)
        b = np.einsum("rij,rj->ri", rotation(-turn), b)
        log = log_density(y, b)
        top = log.max()
        weights = np.exp(log - top)
        total += np.log(weights.mean()) + top
        weights /= weights.sum()
        mean = weights @ b
        covariance = (b - mean).T @ ((b - mean) * weights[:, None])
        b = b[np.searchsorted(weights.cumsum(), (rng.uniform() + np.arange(count)) / count).clip(max=count - 1)]
    return total, mean, covariance
