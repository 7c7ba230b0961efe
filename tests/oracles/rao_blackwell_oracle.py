"""Rao-Blackwellised particle filter in plain NumPy, one particle after the other, covariance form.

Time update by the draw as a second measurement, as in Schon, Gustafsson, Nordlund (2005), equations 17 to 23.
"""

from typing import NamedTuple

import numpy as np


class Mixed(NamedTuple):
    """n+ = fn(n) + An(n) l + wn; l+ = fl(n) + Al(n) l + wl; y = h(n) + C(n) l + e; w = (wn, wl) ~ N(0, Q), e ~ N(0, R).

    Functions of the drawn part n (k,); l (r,) is the linear part.
    """

    fn: object
    An: object
    fl: object
    Al: object
    Q: np.ndarray
    h: object
    C: object
    R: np.ndarray


def move(model, n, m, P, z):
    """Drawn part, mean and covariance of the linear part after the motion; z (k,) standard normals."""
    An, Al, k = model.An(n), model.Al(n), len(n)
    Qn, Ql, Qln = model.Q[:k, :k], model.Q[k:, k:], model.Q[k:, :k]
    S = An @ P @ An.T + Qn
    ahead = model.fn(n) + An @ m
    drawn = ahead + np.linalg.cholesky(S) @ z
    L = (Al @ P @ An.T + Qln) @ np.linalg.inv(S)
    return drawn, model.fl(n) + Al @ m + L @ (drawn - ahead), Al @ P @ Al.T + Ql - L @ S @ L.T


def measure(model, n, m, P, y):
    """Mean, covariance and log-likelihood after the measurement; NaN components are dropped."""
    seen = ~np.isnan(y)
    if not seen.any():
        return m, P, 0.0
    C, R = model.C(n)[seen], model.R[np.ix_(seen, seen)]
    S = C @ P @ C.T + R
    residual = y[seen] - (model.h(n)[seen] + C @ m)
    K = P @ C.T @ np.linalg.inv(S)
    log = -0.5 * (residual @ np.linalg.solve(S, residual) + np.log(np.linalg.det(2 * np.pi * S)))
    return m + K @ residual, P - K @ S @ K.T, log


def systematic(weights, uniform):
    """Ancestors at the positions (i + u) / n, by search."""
    n = len(weights)
    ends = np.cumsum(weights)
    return np.searchsorted(ends / ends[-1], (np.arange(n) + uniform) / n, side="right")


def run(model, particles, normals, uniforms, ys, threshold):
    """Filter.

    Args:
        model: `Mixed`.
        particles: list of (n, m, P), the start.
        normals: (t, N, k); uniforms: (t,) of the systematic resampling; ys: (t, q).
        threshold: resample where the effective sample size is below this share of N.

    Returns:
        Log-likelihoods (t,), means (t, k + r), covariances (t, k + r, k + r).
    """
    N = len(particles)
    weights = np.full(N, 1 / N)
    logs, means, covariances = [], [], []
    for y, z, u in zip(ys, normals, uniforms, strict=True):
        if 1 / (weights**2).sum() < threshold * N:
            particles = [particles[i] for i in systematic(weights, u)]
            weights = np.full(N, 1 / N)
        particles = [move(model, *particle, z[i]) for i, particle in enumerate(particles)]
        measured = [measure(model, *particle, y) for particle in particles]
        likelihood = weights * np.exp([log for _, _, log in measured])
        logs.append(np.log(likelihood.sum()))
        weights = likelihood / likelihood.sum()
        particles = [(n, m, P) for (n, _, _), (m, P, _) in zip(particles, measured, strict=True)]
        points = np.array([np.concatenate([n, m]) for n, m, _ in particles])
        mean = weights @ points
        covariance = np.einsum("i,ij,ik->jk", weights, points - mean, points - mean)
        k = len(particles[0][0])
        covariance[k:, k:] += np.einsum("i,ijk->jk", weights, np.array([P for _, _, P in particles]))
        means.append(mean)
        covariances.append(covariance)
    return np.array(logs), np.array(means), np.array(covariances)


def plane_grid(axes, initial, transition, observation, ys):
    """Log-likelihoods (t,) and means (t, 2) of a point-mass filter on a plane; arguments as in `grid_oracle`.

    Args:
        axes: two arrays of equidistant numbers.
        initial: log-density of points (g, 2); transition: of points (g, 1, 2) given (1, g, 2); observation: of y given
            points (g, 2).
        ys: (t,).
    """
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    area = np.prod([axis[1] - axis[0] for axis in axes])
    density = np.exp(initial(points))
    kernel = area * np.exp(transition(points[:, None], points[None]))
    logs, means = [], []
    for y in ys:
        density = (kernel @ density) * np.exp(observation(y, points))
        total = area * density.sum()
        density = density / total
        logs.append(np.log(total))
        means.append(area * density @ points)
    return np.array(logs), np.array(means)
