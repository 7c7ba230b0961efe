"""Exact laws of the last states of a linear model by dense matrices in NumPy: no recursion, no library code."""

from typing import NamedTuple

import numpy as np


class Law(NamedTuple):
    """Posterior of (x_s, z_{s+1} ... z_k): mean (..., p) and covariance (p, p); states (L, d, p) take it to x_j."""

    mean: np.ndarray
    covariance: np.ndarray
    states: np.ndarray


def window(start, P, A, G, H, R, ys):
    """x_s ~ N(start, P), x_j = A x_{j-1} + G z_j with z_j standard normal, y_j = H x_j + N(0, R), j = s ... k.

    Args:
        start: (..., d), one prior mean for each trajectory or one for all.
        ys: (L, m); NaN components are left out.
    """
    d, r, length = len(A), G.shape[1], len(ys)
    size = d + (length - 1) * r
    states = np.zeros((length, d, size))
    states[0, :, :d] = np.eye(d)
    for j in range(1, length):
        states[j] = A @ states[j - 1]
        states[j, :, d + (j - 1) * r : d + j * r] = G
    prior = np.eye(size)
    prior[:d, :d] = P
    seen = ~np.isnan(ys.reshape(-1))
    look = np.concatenate([H @ part for part in states])[seen]
    error = np.kron(np.eye(length), R)[np.ix_(seen, seen)]
    mean = np.concatenate([start, np.zeros((*np.shape(start)[:-1], size - d))], -1)
    gain = np.linalg.solve(look @ prior @ look.T + error, look @ prior).T
    mean = mean + (ys.reshape(-1)[seen] - mean @ look.T) @ gain.T
    return Law(mean, prior - gain @ look @ prior, states)
