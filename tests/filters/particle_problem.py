"""Small problems with known answers, shared by the tests of the particle filters."""

import numpy as np
import torch
from oracles import particle_oracle
from oracles.particle_oracle import Linear

import torchfilt as tf
from torchfilt.resampling import ess_below, multinomial, never, residual, stratified, systematic

PLANE = Linear(
    A=np.array([[0.9, 0.3], [-0.2, 0.8]]),
    Q=np.array([[0.5, 0.1], [0.1, 0.4]]),
    H=np.array([[1.0, 0.5]]),
    R=np.array([[0.5]]),
    m0=np.array([0.3, -0.2]),
    P0=np.array([[1.0, 0.2], [0.2, 0.8]]),
)
POLICIES = {
    "never": never(),
    "always-systematic": systematic,
    "always-stratified": stratified,
    "always-multinomial": multinomial,
    "always-residual": residual,
    "adaptive-systematic": ess_below(0.7),
    "adaptive-stratified": ess_below(0.7, stratified),
    "adaptive-multinomial": ess_below(0.7, multinomial),
    "adaptive-residual": ess_below(0.7, residual),
}


def tensor(values, dtype=torch.float64):
    return torch.as_tensor(np.asarray(values, dtype=float)).to(dtype)


def gaussian(mean, covariance, space=tf.Euclidean()):  # noqa: B008 (a frozen value)
    return tf.Gaussian(mean, torch.linalg.cholesky(covariance), space)


def state_space(model, dtype=torch.float64):
    A, Q, H, R, m0, P0 = (tensor(part, dtype) for part in model)
    return tf.StateSpaceModel(gaussian(m0, P0), tf.LinearGaussian(A, Q), tf.LinearGaussian(H, R))


def series(steps, seed=0, model=PLANE):
    """One series (steps, m) with its exact answer."""
    _, ys = particle_oracle.simulate(model, steps, seed)
    return tensor(ys), particle_oracle.kalman(model, ys)


def replicate(ys, count):
    """The same series (t, m) in every row, (t, count, m): replicates differ by their random numbers only."""
    return ys.unsqueeze(1).expand(-1, count, -1)


def bias_score(log_likelihood, exact):
    """z-score of mean(exp(estimate - exact)) against one, with the mean and its standard error."""
    ratio = (log_likelihood.double() - exact).exp()
    error = (ratio.std() / len(ratio) ** 0.5).item()
    return (ratio.mean().item() - 1) / max(error, 1e-12), ratio.mean().item(), error
