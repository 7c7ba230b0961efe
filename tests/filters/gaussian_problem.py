"""Random linear-Gaussian problems: the same numbers for the oracle, for linear laws and for plain functions."""

from typing import NamedTuple

import numpy as np
import torch
from oracles import kalman_oracle

import torchfilt as tf
from torchfilt.moments import cubature, gauss_hermite, taylor, unscented

RULES = {
    "taylor": taylor(),
    "unscented": unscented(),
    "unscented-negative-centre": unscented(alpha=0.05, beta=2.0, kappa=0.0),
    "cubature": cubature(),
    "gauss-hermite": gauss_hermite(3),
}


class Problem(NamedTuple):
    """x' = (I + dt a) x + b u + push + N(0, q); y = h x + offset + N(0, r); data for t steps and a batch of rows."""

    a: np.ndarray
    b: np.ndarray
    push: np.ndarray
    q: np.ndarray
    h: np.ndarray
    offset: np.ndarray
    r: np.ndarray
    m0: np.ndarray
    p0: np.ndarray
    ys: np.ndarray  # (t, rows, m)
    us: np.ndarray  # (t, rows, k)
    dts: np.ndarray  # (t,)


def covariance(rng: np.random.Generator, size: int, scale: float = 1.0) -> np.ndarray:
    """Well conditioned: eigenvalues in [0.2, 2] times scale."""
    basis = np.linalg.qr(rng.standard_normal((size, size)))[0]
    matrix = basis * (scale * rng.uniform(0.2, 2.0, size)) @ basis.T
    return (matrix + matrix.T) / 2


def problem(
    seed: int,
    d: int = 3,
    m: int = 2,
    k: int = 1,
    steps: int = 12,
    rows: int = 3,
    radius: float = 0.9,
    hidden: float = 0,
) -> Problem:
    """``radius``: spectral radius of the motion over dt = 1; ``hidden``: share of measured numbers that are missing."""
    rng = np.random.default_rng(seed)
    motion = rng.standard_normal((d, d))
    motion *= radius / np.abs(np.linalg.eigvals(motion)).max()
    ys = rng.standard_normal((steps, rows, m)) * 2
    ys[rng.uniform(size=ys.shape) < hidden] = np.nan
    return Problem(
        motion - np.eye(d),
        rng.standard_normal((d, k)),
        rng.standard_normal(d),
        covariance(rng, d, 0.3),
        rng.standard_normal((m, d)),
        rng.standard_normal(m),
        covariance(rng, m, 0.5),
        rng.standard_normal(d),
        covariance(rng, d),
        ys,
        rng.standard_normal((steps, rows, k)),
        rng.uniform(0.2, 1.0, steps),
    )


def solve(p: Problem, row: int) -> kalman_oracle.Filtered:
    """The oracle's answer for one row."""
    motion = np.eye(len(p.m0)) + p.dts[:, None, None] * p.a
    push = p.us[:, row] @ p.b.T + p.push
    return kalman_oracle.kalman(p.m0, p.p0, motion, p.q, p.h, p.r, p.ys[:, row], push, p.offset)


def tensor(value, dtype=torch.float64) -> torch.Tensor:
    return torch.as_tensor(np.asarray(value), dtype=dtype)


class Drift(torch.nn.Module):
    """The motion of a `Problem` as a linear law whose matrix depends on dt."""

    def __init__(self, p: Problem, dtype=torch.float64) -> None:
        super().__init__()
        for name in ("a", "b", "push"):
            self.register_buffer(name, tensor(getattr(p, name), dtype))
        self.register_buffer("scale_tril", torch.linalg.cholesky(tensor(p.q, dtype)))

    def linear_form(self, u=None, dt=None):
        eye = torch.eye(len(self.a), dtype=self.a.dtype)
        step = dt.unsqueeze(-1) if isinstance(dt, torch.Tensor) else dt
        return eye + step * self.a, self.push if u is None else u @ self.b.mT + self.push, self.scale_tril

    def forward(self, x, u=None, dt=None):
        moved = x + dt * (x @ self.a.mT) + self.push
        return tf.Gaussian(moved if u is None else moved + u @ self.b.mT, self.scale_tril)


def model(p: Problem, form: str = "functions", dtype=torch.float64) -> tf.StateSpaceModel:
    """The problem's laws as plain functions or with their linear form."""
    a, b, push, h, offset = (tensor(value, dtype) for value in (p.a, p.b, p.push, p.h, p.offset))
    prior = tf.Gaussian(tensor(p.m0, dtype), torch.linalg.cholesky(tensor(p.p0, dtype)))
    if form == "linear":
        return tf.StateSpaceModel(prior, Drift(p, dtype), tf.LinearGaussian(h, tensor(p.r, dtype), offset))

    def transition(x, u, dt):
        return x + dt * (x @ a.mT) + u @ b.mT + push

    return tf.StateSpaceModel(
        prior,
        tf.AdditiveGaussian(transition, tensor(p.q, dtype)),
        tf.AdditiveGaussian(lambda x: x @ h.mT + offset, tensor(p.r, dtype)),
    )
