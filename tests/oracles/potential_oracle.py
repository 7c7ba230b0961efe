"""Gravity of spherical harmonics straight from Legendre functions, and Gaussian regression in function space."""

import math

import numpy as np
from scipy.special import lpmv
from scipy.stats import multivariate_normal


def potential(position, l, m, sine, mu, radius):
    """Potential of one unit coefficient, normalised to 4 pi, at a point (3,)."""
    x, y, z = position
    r = math.sqrt(x * x + y * y + z * z)
    longitude = m * math.atan2(y, x)
    # lpmv has the sign (-1)^m, geodesy has not.
    legendre = (-1) ** m * lpmv(m, l, z / r)
    scale = math.sqrt((2 if m else 1) * (2 * l + 1) * math.factorial(l - m) / math.factorial(l + m))
    return mu / r * (radius / r) ** l * scale * legendre * (math.sin(longitude) if sine else math.cos(longitude))


def gradient(position, l, m, sine, mu, radius, step=2e3):
    """Acceleration (3,): central differences of sixth order."""
    result = np.empty(3)
    for axis in range(3):
        shift = np.zeros(3)
        total = 0.0
        for k, weight in ((1, 45), (2, -9), (3, 1)):
            shift[axis] = k * step
            ahead = potential(position + shift, l, m, sine, mu, radius)
            behind = potential(position - shift, l, m, sine, mu, radius)
            total += weight * (ahead - behind)
        result[axis] = total / (60 * step)
    return result


def posterior(design, prior_deviation, noise, y):
    """Mean and covariance of weights w in y = design w + noise e, by the (n, n) covariance of the data.

    Also the log-density of y.
    """
    prior = np.diag(prior_deviation**2)
    cross = prior @ design.T
    covariance = design @ cross + noise**2 * np.eye(len(y))
    gain = np.linalg.solve(covariance, cross.T).T
    evidence = multivariate_normal(np.zeros(len(y)), covariance).logpdf(y)
    return gain @ y, prior - gain @ cross.T, evidence
