"""Scalar filtering by quadrature on a fixed grid: the answer for nonlinear models, without any sampling."""

import numpy as np


def normal_log_density(x, mean, variance):
    """Logarithm of N(x; mean, variance), broadcast."""
    return -0.5 * ((x - mean) ** 2 / variance + np.log(2 * np.pi * variance))


def grid_filter(points, initial, transition, observation, ys, predict_first=True):
    """Point-mass filter on equidistant points; the trapezoidal rule converges spectrally for smooth densities.

    Args:
        points: (g,) wide enough that the densities vanish at both ends.
        initial: log-density of the state before the first step, x (g,) -> (g,).
        transition: log-density of x_next (g, 1) given x (1, g) -> (g, g).
        observation: log-density of y given x (g,) -> (g,).
        ys: (t,).

    Returns:
        Log-likelihood of each step, filtered mean and variance, three arrays (t,).
    """
    width = points[1] - points[0]
    density = np.exp(initial(points))
    kernel = np.exp(transition(points[:, None], points[None, :]))
    logs, means, variances = [], [], []
    for k, y in enumerate(ys):
        if predict_first or k > 0:
            density = width * (kernel @ density)
        log = observation(y, points)
        top = log.max()
        density = density * np.exp(log - top)
        total = width * density.sum()
        density = density / total
        mean = width * (points * density).sum()
        logs.append(np.log(total) + top)
        means.append(mean)
        variances.append(width * ((points - mean) ** 2 * density).sum())
    return np.array(logs), np.array(means), np.array(variances)
