"""Gaussian-process formulas in plain numpy, in extended precision; imports nothing of the library."""

import numpy as np

Array = np.ndarray
WIDE = np.longdouble


def structured_kernel(a: Array, b: Array, deviation: Array, lengthscale: float) -> Array:
    """(s0^2 + sum s_j^2 x_j x'_j) exp(-|f - f'|^2 / 2 l^2); the last two columns are the phase features."""
    a, b = a.astype(WIDE), b.astype(WIDE)
    affine = WIDE(deviation[0]) ** 2 + (a[:, None, :-2] * b[None, :, :-2] * np.asarray(deviation[1:], WIDE) ** 2).sum(
        -1
    )
    chord = ((a[:, None, -2:] - b[None, :, -2:]) ** 2).sum(-1)
    return affine * np.exp(-chord / (2 * WIDE(lengthscale) ** 2))


def se_kernel(a: Array, b: Array, amplitude: float, lengthscale: Array) -> Array:
    """Squared exponential with one length-scale an input."""
    a, b = a.astype(WIDE), b.astype(WIDE)
    scaled = (a[:, None, :] - b[None, :, :]) / np.asarray(lengthscale, WIDE)
    return WIDE(amplitude) * np.exp(-0.5 * (scaled**2).sum(-1))


def cholesky(matrix: Array) -> Array:
    """Lower factor by the textbook loop, in the precision of the input."""
    size = len(matrix)
    factor = np.zeros_like(matrix)
    for j in range(size):
        factor[j, j] = np.sqrt(matrix[j, j] - (factor[j, :j] ** 2).sum())
        factor[j + 1 :, j] = (matrix[j + 1 :, j] - factor[j + 1 :, :j] @ factor[j, :j]) / factor[j, j]
    return factor


def forward_solve(factor: Array, right: Array) -> Array:
    """factor^-1 right."""
    result = np.array(right, dtype=factor.dtype)
    for i in range(len(factor)):
        result[i] = (result[i] - factor[i, :i] @ result[:i]) / factor[i, i]
    return result


def posterior(prior: Array, cross: Array, own: Array, y: Array, noise: float) -> tuple[Array, Array]:
    """Mean and latent variance: prior (S, S), cross (S, M), own (M,), y (S,)."""
    factor = cholesky(prior + WIDE(noise) * np.eye(len(y), dtype=WIDE))
    white = forward_solve(factor, cross)
    mean = white.T @ forward_solve(factor, y.astype(WIDE))
    return mean.astype(float), (own - (white**2).sum(0)).astype(float)


def log_marginal_likelihood(prior: Array, y: Array, noise: float) -> float:
    """log N(y; 0, prior + noise I)."""
    factor = cholesky(prior + WIDE(noise) * np.eye(len(y), dtype=WIDE))
    white = forward_solve(factor, y.astype(WIDE))
    return float(-0.5 * white @ white - np.log(np.diag(factor)).sum() - 0.5 * len(y) * np.log(2 * np.pi))


def leave_one_out(prior: Array, y: Array, noise: float) -> tuple[Array, Array]:
    """Errors and predictive variances by leaving each sample out in turn."""
    errors, variances = [], []
    for i in range(len(y)):
        keep = np.arange(len(y)) != i
        mean, variance = posterior(prior[np.ix_(keep, keep)], prior[keep][:, [i]], prior[[i], [i]], y[keep], noise)
        errors.append(y[i] - mean[0])
        variances.append(variance[0] + noise)
    return np.array(errors), np.array(variances)
