"""The same filters without the library: what torch can do by itself, and peers that leave the loop to the user."""

import math
from typing import Any

import numpy as np
import torch
from _problems import Linear, Turn, range_bearing, turn_law
from torch import Tensor


def tensors(problem: Linear, dtype: torch.dtype) -> dict[str, Tensor]:
    """The model's matrices, with the factors of Q, R and P0."""
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in problem._asdict().items()}
    given |= {f"root_{name}": torch.linalg.cholesky(given[name]) for name in ("Q", "R", "P0")}
    return {name: value.to(dtype) for name, value in given.items()}


def bare_particles(m: dict[str, Tensor], n: int, noise_dtype: torch.dtype, seed: int) -> tuple[float, Tensor]:
    """The fastest bootstrap filter that eager torch gives us: everything in place, components first (d, n).

    Ancestors by a histogram, one exp a step, R diagonal with equal entries. Returns log-likelihood and means (t, 6).
    """
    dtype, steps = m["ys"].dtype, len(m["ys"])
    d, sigma = 6, float(m["root_R"][0, 0])
    generator = torch.Generator().manual_seed(seed)
    x = m["root_P0"] @ torch.empty(d, n, dtype=noise_dtype).normal_(generator=generator).to(dtype)
    moved, noise = torch.empty_like(x), torch.empty(d, n, dtype=noise_dtype)
    cast = noise if noise_dtype == dtype else torch.empty_like(x)
    residual, weights = torch.empty(3, n, dtype=dtype), torch.empty(n, dtype=dtype)
    cumulative, ancestors = torch.empty(n, dtype=torch.float64), torch.empty(n, dtype=torch.int64)
    u = torch.empty((), dtype=torch.float64)
    means, terms = torch.empty(steps, d, dtype=dtype), torch.empty(steps, dtype=dtype)
    for k, y in enumerate(m["ys"]):
        if k > 0:
            torch.cumsum(weights, 0, out=cumulative)
            u.uniform_(generator=generator)
            cumulative.mul_(n / cumulative[-1]).sub_(u).ceil_()
            histogram = torch.bincount(cumulative[:-1].long(), minlength=n)
            torch.cumsum(histogram[:n], 0, out=ancestors)
            torch.index_select(x, 1, ancestors, out=moved)
            noise.normal_(generator=generator)
            if cast is not noise:
                cast.copy_(noise)
            torch.mm(m["F"], moved, out=x)
            x.addmm_(m["root_Q"], cast)
        torch.sub(x[:3], y.unsqueeze(1), out=residual)
        residual.square_()
        torch.sum(residual, 0, out=weights)
        weights.mul_(-0.5 / sigma**2)
        top = weights.max()
        weights.sub_(top).exp_()
        total = weights.sum()
        weights.div_(total)
        torch.mv(x, weights, out=means[k])
        torch.add(top, total.log_(), out=terms[k])
    constant = -1.5 * math.log(2 * math.pi) - 3 * math.log(sigma) - math.log(n)
    return float(terms.double().sum()) + steps * constant, means


def naive_particles(m: dict[str, Tensor], n: int, seed: int) -> tuple[float, Tensor]:
    """The bootstrap filter as one writes it first: particles as rows, search for ancestors, new tensors everywhere."""
    dtype = m["ys"].dtype
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 6, generator=generator, dtype=dtype) @ m["root_P0"].T
    weights = torch.full((n,), 1 / n, dtype=dtype)
    constant = -1.5 * math.log(2 * math.pi) - float(m["root_R"].diagonal().log().sum()) - math.log(n)
    means, log_likelihood = [], 0.0
    for k, y in enumerate(m["ys"]):
        if k > 0:
            positions = (torch.arange(n) + torch.rand(1, generator=generator, dtype=torch.float64)) / n
            cumulative = weights.double().cumsum(0)
            x = x[torch.searchsorted(cumulative, positions * cumulative[-1]).clamp(max=n - 1)]
            x = x @ m["F"].T + torch.randn(n, 6, generator=generator, dtype=dtype) @ m["root_Q"].T
        z = (y - x @ m["H"].T) / m["root_R"].diagonal()
        log_weights = -0.5 * (z**2).sum(1) + constant
        term = torch.logsumexp(log_weights, 0)
        weights = (log_weights - term).exp()
        log_likelihood += float(term)
        means.append((weights.unsqueeze(1) * x).sum(0))
    return log_likelihood, torch.stack(means)


def filterpy_particles(problem: Linear, n: int, seed: int) -> tuple[float, np.ndarray]:
    """filterpy's resampler in a NumPy loop: filterpy gives the resampler only."""
    from filterpy.monte_carlo import systematic_resample

    rng = np.random.default_rng(seed)
    np.random.seed(seed)
    root_q, sigma = np.linalg.cholesky(problem.Q), math.sqrt(problem.R[0, 0])
    x = rng.standard_normal((n, 6)) @ np.sqrt(problem.P0)
    weights = np.full(n, 1 / n)
    constant = -1.5 * math.log(2 * math.pi) - 3 * math.log(sigma) - math.log(n)
    means, log_likelihood = [], 0.0
    for k, y in enumerate(problem.ys):
        if k > 0:
            # Rounding can leave the last cumulative weight below the last position, which ends filterpy's search.
            weights[-1] += max(0.0, 1 - np.cumsum(weights)[-1])
            x = x[systematic_resample(weights)] @ problem.F.T + rng.standard_normal((n, 6)) @ root_q.T
        log_weights = -0.5 * (((x[:, :3] - y) / sigma) ** 2).sum(1) + constant
        top = log_weights.max()
        weights = np.exp(log_weights - top)
        total = weights.sum()
        weights /= total
        log_likelihood += top + math.log(total)
        means.append(weights @ x)
    return log_likelihood, np.stack(means)


def torch_kf_series(m: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """torch-kf over (t, series, 3), one covariance a row as its interface has it; it gives no log-likelihood."""
    from torch_kf import GaussianState, KalmanFilter

    dtype, series = m["ys"].dtype, m["ys"].shape[1]
    filter_ = KalmanFilter(m["F"], m["H"], m["Q"], m["R"])
    state = GaussianState(torch.zeros(series, 6, 1, dtype=dtype), m["P0"].expand(series, 6, 6).clone())
    means = []
    for k, y in enumerate(m["ys"].unsqueeze(-1)):
        if k > 0:
            state = filter_.predict(state)
        state = filter_.update(state, y)
        means.append(state.mean.squeeze(-1))
    return torch.full((series,), math.nan), torch.stack(means)


def obvious_kalman(m: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """The batched covariance-form filter as one writes it first, one covariance a row."""
    dtype, series = m["ys"].dtype, m["ys"].shape[1]
    mean, P = torch.zeros(series, 6, 1, dtype=dtype), m["P0"].expand(series, 6, 6).clone()
    F, H, eye = m["F"], m["H"], torch.eye(6, dtype=dtype)
    total, means = torch.zeros(series, dtype=dtype), []
    for k, y in enumerate(m["ys"].unsqueeze(-1)):
        if k > 0:
            mean, P = F @ mean, F @ P @ F.mT + m["Q"]
        S = H @ P @ H.mT + m["R"]
        factor = torch.linalg.cholesky(S)
        gain = torch.cholesky_solve(H @ P, factor).mT
        innovation = y - H @ mean
        z = torch.linalg.solve_triangular(factor, innovation, upper=False)
        volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        total = total - 0.5 * z.square().sum((-2, -1)) - volume - 1.5 * math.log(2 * math.pi)
        mean = mean + gain @ innovation
        P = (eye - gain @ H) @ P
        means.append(mean.squeeze(-1))
    return total, torch.stack(means)


def filterpy_kalman(problem: Linear, series: int) -> tuple[np.ndarray, np.ndarray]:
    """filterpy over the first ``series`` series, one after the other."""
    from filterpy.kalman import KalmanFilter

    totals, means = np.zeros(series), np.empty((len(problem.ys), series, 6))
    for row in range(series):
        filter_ = KalmanFilter(dim_x=6, dim_z=3)
        filter_.F, filter_.Q, filter_.H, filter_.R = problem.F, problem.Q, problem.H, problem.R
        filter_.P, filter_.x = problem.P0.copy(), np.zeros(6)
        for k, y in enumerate(problem.ys[:, row]):
            if k > 0:
                filter_.predict()
            filter_.update(y)
            totals[row] += filter_.log_likelihood
            means[k, row] = filter_.x
    return totals, means


def filterpy_unscented(problem: Turn, series: int) -> tuple[np.ndarray, np.ndarray]:
    """filterpy's unscented filter over the first ``series`` series; sigma points as in torchfilt's default."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    steps = len(problem.ys)
    totals, means = np.zeros(series), np.empty((steps, series, 5))
    for row in range(series):
        points: Any = MerweScaledSigmaPoints(5, alpha=1.0, beta=0.0, kappa=1.0)
        filter_: Any = UnscentedKalmanFilter(5, 2, 1.0, hx=range_bearing, fx=turn_law, points=points)
        filter_.x, filter_.P = problem.mean0.copy(), problem.root0 @ problem.root0.T
        filter_.Q, filter_.R = problem.root_q @ problem.root_q.T, problem.root_r @ problem.root_r.T
        for k, y in enumerate(problem.ys[:, row]):
            if k > 0:
                filter_.predict()
            # filterpy keeps the sigma points of the motion; torchfilt draws them anew from the predicted belief.
            filter_.sigmas_f = points.sigma_points(filter_.x, filter_.P)
            filter_.update(y)
            totals[row] += filter_.log_likelihood
            means[k, row] = filter_.x
    return totals, means
