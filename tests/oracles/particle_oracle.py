"""Exact answers for linear-Gaussian models in plain NumPy, covariance form: no square roots, no library code."""

from typing import NamedTuple

import numpy as np


class Linear(NamedTuple):
    """x_0 ~ N(m0, P0); x_t = A x_{t-1} + N(0, Q); y_t = H x_t + N(0, R). Entries may be complex (see `score`)."""

    A: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    m0: np.ndarray
    P0: np.ndarray


class Filtered(NamedTuple):
    """Per step: log p(y_t | y_{1..t-1}) (t,), mean (t, d), covariance (t, d, d)."""

    log_likelihood: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def kalman(model, ys, predict_first=True):
    """Textbook Kalman filter; NaN components of a measurement are dropped."""
    m, P = model.m0, model.P0
    logs, means, covariances = [], [], []
    for k, y in enumerate(ys):
        if predict_first or k > 0:
            m, P = model.A @ m, model.A @ P @ model.A.T + model.Q
        seen = ~np.isnan(y)
        H, R = model.H[seen], model.R[np.ix_(seen, seen)]
        log = 0.0
        if seen.any():
            S = H @ P @ H.T + R
            residual = y[seen] - H @ m
            gain = np.linalg.solve(S, H @ P).T
            log = -0.5 * (residual @ np.linalg.solve(S, residual) + np.log(np.linalg.det(2 * np.pi * S)))
            m, P = m + gain @ residual, P - gain @ S @ gain.T
        logs.append(log)
        means.append(m)
        covariances.append(P)
    return Filtered(np.array(logs), np.array(means), np.array(covariances))


def score(build, theta, ys):
    """Derivative of the log-likelihood by theta through a complex step: exact to rounding.

    build: maps theta (k,) to a `Linear`.
    """
    gradient = []
    for k in range(len(theta)):
        moved = np.array(theta, dtype=complex)
        moved[k] += 1e-30j
        gradient.append(kalman(build(moved), ys).log_likelihood.sum().imag / 1e-30)
    return np.array(gradient)


def simulate(model, steps, seed):
    """States and measurements (steps, d), (steps, m)."""
    generator = np.random.default_rng(seed)
    x = generator.multivariate_normal(model.m0, model.P0)
    states, ys = [], []
    for _ in range(steps):
        x = model.A @ x + generator.multivariate_normal(np.zeros(len(x)), model.Q)
        states.append(x)
        ys.append(model.H @ x + generator.multivariate_normal(np.zeros(len(model.R)), model.R))
    return np.array(states), np.array(ys)


def literal_bank(model, ys):
    """Log-likelihood and last covariance that the literal local form approaches with infinitely many particles.

    Each particle is drawn from its whole posterior N(m_i, P_i) and keeps P_i: on a linear model the cloud is then
    Gaussian with the spread V of the centres and, on top, the local P: its covariance V + P counts the draws twice.
    """
    m, P, V = model.m0, model.P0, model.P0  # the start is drawn from the prior and keeps it as well
    total = 0.0
    for y in ys:
        V = V + P  # redrawn before every step, the first one too
        P = model.A @ P @ model.A.T + model.Q
        m, V = model.A @ m, model.A @ V @ model.A.T
        # Each centre is updated with its own gain and weighted by its own innovation likelihood N(y; H m_i, S).
        S = model.H @ P @ model.H.T + model.R
        whole = S + model.H @ V @ model.H.T
        residual = y - model.H @ m
        total += -0.5 * (residual @ np.linalg.solve(whole, residual) + np.log(np.linalg.det(2 * np.pi * whole)))
        # Weighting turns the spread of the predicted centres into its posterior; the update then contracts it.
        pull = np.linalg.solve(whole, model.H @ V).T
        m, V = m + pull @ residual, V - pull @ whole @ pull.T
        gain = np.linalg.solve(S, model.H @ P).T
        keep = np.eye(len(m)) - gain @ model.H
        m, V, P = m + gain @ (y - model.H @ m), keep @ V @ keep.T, keep @ P
    return total, V + P
