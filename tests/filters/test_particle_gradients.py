"""Gradients of the evidence of particle filters against the exact score of a linear model.

The stop-gradient estimator makes grad exp(log Z) unbiased: its mean, weighted by Z / Z_exact, is the score itself,
whatever n. The gradient of log Z has a bias of order 1/n: minus half the derivative of the variance of log Z.
"""

import numpy as np
import pytest
import torch
from oracles import particle_oracle
from particle_problem import PLANE, replicate, tensor

import torchfilt as tf
from torchfilt.resampling import ess_below, multinomial, systematic

THETA = np.array([1.0, 1.0, 0.3, 1.0, 1.0])
YS = tensor(particle_oracle.simulate(PLANE, 4, 0)[1])
# Largest of five z-scores; a false alarm in 30,000 tests.
Z = 4.5


def build(theta):
    """Every matrix of the model depends on theta."""
    return PLANE._replace(
        A=PLANE.A * theta[0], Q=PLANE.Q * theta[1], m0=PLANE.m0 + theta[2], R=PLANE.R * theta[3], P0=PLANE.P0 * theta[4]
    )


def torch_model(theta):
    A, Q, H, R, m0, P0 = (tensor(part) for part in PLANE)
    return tf.StateSpaceModel(
        tf.Gaussian(m0 + theta[2], torch.linalg.cholesky(P0 * theta[4])),
        tf.LinearGaussian(A * theta[0], Q * theta[1]),
        tf.LinearGaussian(H, R * theta[3]),
    )


EXACT = particle_oracle.kalman(build(THETA), YS.numpy()).log_likelihood.sum()
SCORE = tensor(particle_oracle.score(build, THETA, YS.numpy()))
JOINT = dict(redraw="always", split=0.0, pooled=False, weights="joint")
FORMS = {
    "bootstrap": lambda model: tf.BootstrapFilter(model, 30),
    "bootstrap-adaptive": lambda model: tf.BootstrapFilter(model, 30, ess_below(0.7)),
    "bootstrap-multinomial": lambda model: tf.BootstrapFilter(model, 30, multinomial),
    "joint": lambda model: tf.UnscentedParticleFilter(model, 15, **JOINT, resampler=systematic),
    "bank-redrawn": lambda model: tf.LocallyLinearizedParticleFilter(model, 15, redraw="always", resampler=systematic),
    "bank-adaptive": lambda model: tf.LocallyLinearizedParticleFilter(model, 15, redraw="resample"),
}


class PathwiseOnly(tf.ParticleFilter):
    """The same filter without the score of the chosen ancestors."""

    def _resample(self, belief, preferred, uniforms):
        belief = belief._replace(log_weights=preferred.detach())
        return super()._resample(belief, belief.log_weights, uniforms)


def gradients(make, seed, batches=20, rows=100, pathwise=False):
    """Gradients (batches, 5) of Z / Z_exact and of log Z."""
    found = []
    for k in range(batches):
        theta = tensor(THETA).requires_grad_()
        filter = make(torch_model(theta))
        if pathwise:
            filter.__class__ = PathwiseOnly
        log = filter(replicate(YS, rows), seed=seed + k, record="mean").log_likelihood
        weight = (log - EXACT).exp().detach()
        (of_z,) = torch.autograd.grad((weight * log).mean(), theta, retain_graph=True)
        (of_log,) = torch.autograd.grad(log.mean(), theta)
        found.append(torch.stack([of_z, of_log]))
    return torch.stack(found).unbind(1)


def against_score(samples):
    error = samples.std(0) / len(samples) ** 0.5
    return (samples.mean(0) - SCORE) / error, error


def test_oracle_score_is_the_kalman_filters_own():
    theta = tensor(THETA).requires_grad_()
    log = tf.KalmanFilter(torch_model(theta))(YS).log_likelihood
    (gradient,) = torch.autograd.grad(log, theta)
    np.testing.assert_allclose(gradient, SCORE, rtol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_gradient_of_the_evidence_is_unbiased(form):
    of_z, _ = gradients(FORMS[form], 100)
    score, error = against_score(of_z)
    assert (error < 0.05 * SCORE.abs().max()).all(), error
    assert score.abs().max() < Z, score


@pytest.mark.parametrize("form", ["bootstrap", "bootstrap-adaptive", pytest.param("joint", marks=pytest.mark.slow)])
def test_pathwise_gradient_alone_would_be_biased(form):
    of_z, _ = gradients(FORMS[form], 100, batches=20 if "bootstrap" in form else 60, pathwise=True)
    score, _ = against_score(of_z)
    assert score.abs().max() > 6, score


def test_bias_of_the_log_evidences_gradient_falls_as_one_over_n():
    """Four times the particles, a quarter of the bias, within 4.5 standard errors; at n = 20 it is seen."""
    biases = {}
    for n in (20, 80):
        _, of_log = gradients(lambda model, n=n: tf.BootstrapFilter(model, n), 200, batches=30)
        biases[n] = of_log.mean(0) - SCORE, of_log.std(0) / 30**0.5
    worst = biases[20][0].abs().argmax()
    (coarse, coarse_error), (fine, fine_error) = ((part[worst] for part in biases[n]) for n in (20, 80))
    assert coarse.abs() > 4.5 * coarse_error
    assert (fine - coarse / 4).abs() < 4.5 * (fine_error**2 + coarse_error**2 / 16) ** 0.5


def test_gradients_reach_every_law_and_stay_finite():
    theta = tensor(THETA).requires_grad_()
    for make in FORMS.values():
        log = make(torch_model(theta))(YS, seed=1).log_likelihood
        (gradient,) = torch.autograd.grad(log, theta)
        assert torch.isfinite(gradient).all() and (gradient != 0).all()


def test_gradients_are_finite_beside_a_particle_without_weight():
    """A bounded law: most particles have no density at the measurement, their weights are exactly zero."""

    class Bounded(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.reach = torch.nn.Parameter(tensor([1.0]))

        def forward(self, x):
            return torch.distributions.Uniform(x[..., :1] - self.reach, x[..., :1] + self.reach, validate_args=False)

    model = torch_model(tensor(THETA))
    model = tf.StateSpaceModel(model.initial, model.transition, Bounded())
    for resampler in (systematic, ess_below(0.5)):
        history = tf.BootstrapFilter(model, 100, resampler)(YS, seed=2)
        assert (history.final.belief.weights == 0).any()
        (gradient,) = torch.autograd.grad(history.log_likelihood, model.observation.reach)
        assert torch.isfinite(gradient).all() and gradient < 0
