"""The covariance-form Kalman filter in plain numpy; imports nothing of the library.

Missing components are left out by deleting rows. All formulas are analytic, so complex numbers may go in: the imaginary
part of the log-likelihood over a step of 1e-30 is the exact score.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Filtered(NamedTuple):
    """mean (t, d), covariance (t, d, d), log_likelihood (t)."""

    mean: Array
    covariance: Array
    log_likelihood: Array


def predict(mean: Array, covariance: Array, f: Array, q: Array, push: Array | float = 0.0) -> tuple[Array, Array]:
    return f @ mean + push, f @ covariance @ f.T + q


def update(
    mean: Array, covariance: Array, y: Array, h: Array, r: Array, offset: Array | float = 0.0
) -> tuple[Array, Array, complex]:
    """Posterior mean and covariance (Joseph's form) and the log-density of the components that are not NaN."""
    seen = ~np.isnan(y.real)
    if not seen.any():
        return mean, covariance, 0.0
    shift = np.broadcast_to(np.asarray(offset), y.shape)
    h, r, y, shift = h[seen], r[np.ix_(seen, seen)], y[seen], shift[seen]
    innovation = y - h @ mean - shift
    s = h @ covariance @ h.T + r
    gain = np.linalg.solve(s, h @ covariance).T
    keep = np.eye(len(mean)) - gain @ h
    after = keep @ covariance @ keep.T + gain @ r @ gain.T
    quadratic = innovation @ np.linalg.solve(s, innovation)
    log_likelihood = -0.5 * (quadratic + np.log(np.linalg.det(s)) + len(y) * np.log(2 * np.pi))
    return mean + gain @ innovation, (after + after.T) / 2, log_likelihood


def kalman(
    m0: Array,
    p0: Array,
    f: Array,
    q: Array,
    h: Array,
    r: Array,
    ys: Array,
    push: Array | float = 0.0,
    offset: Array | float = 0.0,
    predict_first: bool = True,
) -> Filtered:
    """Filter one series ys (t, m).

    f (d, d) or (t, d, d), q likewise, push (d,), (t, d) or a number: what the motion adds; offset (m,) or a number.
    The prior is the state before the first measurement.
    """
    count = len(ys)
    fs, qs = (np.broadcast_to(value, (count, len(m0), len(m0))) for value in (f, q))
    pushes = np.broadcast_to(push, (count, len(m0)))
    mean, covariance = m0, p0
    means, covariances, likelihoods = [], [], []
    for k in range(count):
        if predict_first or k:
            mean, covariance = predict(mean, covariance, fs[k], qs[k], pushes[k])
        mean, covariance, value = update(mean, covariance, ys[k], h, r, offset)
        means.append(mean)
        covariances.append(covariance)
        likelihoods.append(value)
    return Filtered(np.array(means), np.array(covariances), np.array(likelihoods))


def score(log_likelihood: Callable[[Array], complex], theta: Array) -> Array:
    """Gradient of an analytic function of theta (p,) by complex steps: exact to rounding."""
    step = 1e-30
    return np.array([log_likelihood(theta + 1j * step * unit).imag / step for unit in np.eye(len(theta))])


def kalman_scalar(
    m0: Array, p0: Array, f: Array, q: Array, h: Array, r: float, ys: Array, dtype: type = np.longdouble
) -> Filtered:
    """The same for scalar measurements ys (t) in extended precision: h (d,), r a variance.

    Returns the last mean (d,) and covariance (d, d), and log_likelihood (t).
    """
    mean, p, f, q, h = (np.asarray(value, dtype) for value in (m0, p0, f, q, h))
    r, two_pi = dtype(r), 2 * np.arccos(dtype(-1))
    likelihoods = []
    eye = np.eye(len(mean), dtype=dtype)
    for y in ys.astype(dtype):
        mean, p = f @ mean, f @ p @ f.T + q
        s = h @ p @ h + r
        gain = p @ h / s
        innovation = y - h @ mean
        keep = eye - np.outer(gain, h)
        mean, p = mean + gain * innovation, keep @ p @ keep.T + r * np.outer(gain, gain)
        likelihoods.append(-0.5 * (innovation**2 / s + np.log(two_pi * s)))
    return Filtered(mean, p, np.array(likelihoods))
