"""Log-density of a marginal of a Gaussian in extended precision. numpy only."""

import numpy as np


def log_density(error, factor, keep):
    """Of the components ``keep`` of an error with covariance ``factor @ factor.T``; zero of none."""
    rows = np.asarray(factor, np.longdouble)[keep]
    rest = np.asarray(error, np.longdouble)[keep]
    covariance = rows @ rows.T
    value = np.longdouble(0)
    # One component after the other: its density given those before, which are then taken out (Schur complement).
    while len(rest):
        variance = covariance[0, 0]
        value -= (rest[0] ** 2 / variance + np.log(2 * np.longdouble(np.pi) * variance)) / 2
        gain = covariance[1:, 0] / variance
        rest = rest[1:] - gain * rest[0]
        covariance = covariance[1:, 1:] - np.outer(gain, covariance[0, 1:])
    return float(value)
