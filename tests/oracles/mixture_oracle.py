"""Mixtures of Kalman filters in plain numpy, covariance form; imports nothing of the library.

A component is (weight, mean (d,), covariance (d, d)); a mixture is a list of them.
"""

import numpy as np
from oracles.kalman_oracle import predict, update
from scipy.spatial.transform import Rotation

Array = np.ndarray
Mixture = list[tuple[float, Array, Array]]


def moments(mixture: Mixture) -> tuple[Array, Array]:
    """Mean and covariance; weights need not sum to one."""
    total = sum(w for w, _, _ in mixture)
    mean = sum(w * m for w, m, _ in mixture) / total
    spread = sum(w * (p + np.outer(m - mean, m - mean)) for w, m, p in mixture) / total
    return mean, spread


def normalised(mixture: Mixture) -> tuple[Mixture, float]:
    total = sum(w for w, _, _ in mixture)
    return [(w / total, m, p) for w, m, p in mixture], float(np.log(total))


def gaussian_sum(
    mixture: Mixture,
    f: Array,
    h: Array,
    motions: list[tuple[float, Array, Array]],
    sensors: list[tuple[float, Array, Array]],
    ys: Array,
) -> tuple[list[Mixture], Array]:
    """Every history of motions and sensors, nothing merged; each of them is (chance, offset, covariance).

    Returns the mixtures after each of the ys (t, m) and the log-likelihood (t).
    """
    series, evidence = [], []
    for y in ys:
        after: Mixture = []
        for w, m, p in mixture:
            for chance, push, q in motions:
                ahead = predict(m, p, f, q, push)
                for share, offset, r in sensors:
                    mean, covariance, logged = update(*ahead, y, h, r, offset)
                    after.append((w * chance * share * float(np.exp(logged)), mean, covariance))
        mixture, total = normalised(after)
        series.append(mixture)
        evidence.append(total)
    return series, np.array(evidence)


def interacting(
    modes: list[tuple[Array, Array, Array, Array]], jumps: list[Array], mixture: Mixture, ys: Array
) -> tuple[Array, Array, Array, Array]:
    """Interacting multiple models, each (f, q, h, r); jumps: one (m, m) a step.

    Returns modes' probabilities (t, m), mean (t, d), covariance (t, d, d) and log-likelihood (t).
    """
    found = []
    for y, jump in zip(ys, jumps, strict=True):
        after: Mixture = []
        for j, (f, q, h, r) in enumerate(modes):
            reach = [w * jump[i, j] for i, (w, _, _) in enumerate(mixture)]
            if sum(reach) == 0:
                mixed = mixture[j][1:]
            else:
                mixed = moments([(a, m, p) for a, (_, m, p) in zip(reach, mixture, strict=True)])
            mean, covariance, logged = update(*predict(*mixed, f, q), y, h, r)
            after.append((sum(reach) * float(np.exp(logged)), mean, covariance))
        mixture, total = normalised(after)
        found.append((np.array([w for w, _, _ in mixture]), *moments(mixture), total))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def reduced(mixture: Mixture, count: int) -> Mixture:
    """Pairs merged one after the other, the cheapest by Runnalls' bound first."""
    mixture = list(mixture)
    while len(mixture) > count:
        best = None
        for i in range(len(mixture)):
            for j in range(i + 1, len(mixture)):
                pair = [mixture[i], mixture[j]]
                w = pair[0][0] + pair[1][0]
                mean, covariance = moments(pair)
                logs = [a * np.linalg.slogdet(p)[1] for a, _, p in [(w, mean, covariance), *pair]]
                cost = (logs[0] - logs[1] - logs[2]) / 2
                if best is None or cost < best[0]:
                    best = cost, i, j, (w, mean, covariance)
        _, i, j, one = best
        mixture[i] = one
        del mixture[j]
    return mixture


def grid_filter(x: Array, prior: Array, step: Array, likelihoods: Array) -> tuple[Array, Array, Array]:
    """One dimension: densities on a uniform grid x (n,), prior (n,), transition densities step (n, n) to row from
    column, likelihoods (t, n). Returns mean, variance and log-likelihood, (t) each."""
    width, density, found = x[1] - x[0], prior, []
    for likelihood in likelihoods:
        density = step @ density * width * likelihood
        total = density.sum() * width
        density = density / total
        mean = (x * density).sum() * width
        found.append((mean, ((x - mean) ** 2 * density).sum() * width, np.log(total)))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def right_jacobian(v: Array) -> Array:
    """exp(v + d) = exp(v) exp(J d) for small d, by the series sum of (-[v])^k / (k + 1)!."""
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    total, term = np.zeros((3, 3)), np.eye(3)
    for k in range(40):
        total = total + term
        term = term @ -cross / (k + 2)
    return total


def rotation_mean(quaternions: Array, weights: Array) -> Rotation:
    """Intrinsic mean of quaternions (n, 4), order x y z w, by fixed-point iteration."""
    points = Rotation.from_quat(quaternions)
    mean = points[int(np.argmax(weights))]
    for _ in range(200):
        mean = mean * Rotation.from_rotvec(weights @ (mean.inv() * points).as_rotvec())
    return mean
