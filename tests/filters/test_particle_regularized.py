"""Regularised and auxiliary particle filters as whole filters, against the exact answer."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, bias_score, replicate, series, state_space, tensor

import torchfilt as tf
from torchfilt.kernels import Regularize
from torchfilt.moments import unscented
from torchfilt.proposals import Local, LookAhead, Prior
from torchfilt.resampling import ess_below

STILL = PLANE._replace(A=np.array([[1.0, 0.5], [0.0, 1.0]]), Q=1e-8 * PLANE.Q, H=np.array([[1.0, 0.0]]))


def deviation(history, exact):
    """Root mean square of (mean - exact mean) in exact standard deviations, over the last half of the steps."""
    apart = (history.mean - tensor(exact.mean).unsqueeze(1))[len(exact.mean) // 2 :]
    factor = torch.linalg.cholesky(tensor(exact.covariance))[len(exact.mean) // 2 :].unsqueeze(1)
    whitened = torch.linalg.solve_triangular(factor.expand(*apart.shape, 2), apart.unsqueeze(-1), upper=False)
    return whitened.square().mean().sqrt().item()


def test_moments_kept_saves_what_resampling_alone_loses():
    """Next to no process noise: copies of copies without the kernel, a widening cloud with the plain one."""
    ys, exact = series(60, model=STILL)
    ys, model = replicate(ys, 30), state_space(STILL)
    found = {
        name: deviation(filter(ys, seed=2), exact)
        for name, filter in {
            "bootstrap": tf.BootstrapFilter(model, 400),
            "plain": tf.RegularizedParticleFilter(model, 400, Regularize(keep_moments=False)),
            "kept": tf.RegularizedParticleFilter(model, 400),
            "epanechnikov": tf.RegularizedParticleFilter(model, 400, Regularize("epanechnikov")),
        }.items()
    }
    # A cloud of 400 independent draws is off by 1 / sqrt(400) = 0.05 deviations a component and step; it remembers.
    assert found["kept"] < 0.3 and found["epanechnikov"] < 0.3, found
    assert found["bootstrap"] > 4 * found["kept"] and found["plain"] > 1.3 * found["kept"], found


def test_regularised_covariance_is_the_exact_one_in_the_limit():
    """Mean over 60 rows of 2000 particles against the Riccati recursion: a few per mille."""
    ys, exact = series(30)
    history = tf.RegularizedParticleFilter(state_space(PLANE), 2000)(replicate(ys, 60), seed=3)
    ratio = history.covariance.mean(1) / tensor(exact.covariance)
    assert ((ratio - 1).abs() < 0.02).all()
    assert history.evidence == "approximate"


def test_rows_that_are_not_resampled_are_not_smoothed():
    """A high effective sample size leaves everything as the bootstrap filter has it, to the bit."""
    ys, _ = series(1)
    model = state_space(PLANE)
    smooth = tf.RegularizedParticleFilter(model, 100, resampler=ess_below(0.01))(ys, seed=4)
    plain = tf.BootstrapFilter(model, 100, ess_below(0.01))(ys, seed=4)
    assert torch.equal(smooth.final.belief.x, plain.final.belief.x)


@pytest.mark.parametrize("power", [1.0, 0.5])
@pytest.mark.parametrize("policy", ["always", "adaptive"])
def test_auxiliary_evidence_is_unbiased(power, policy):
    """z-score below 4.5 (1 in 150,000) with a standard error of at most 2 %."""
    ys, exact = series(4)
    resampler = ess_below(0.7) if policy == "adaptive" else tf.resampling.systematic
    filter = tf.AuxiliaryParticleFilter(state_space(PLANE), 40, power, resampler)
    assert filter.evidence == "unbiased"
    score, mean, error = bias_score(filter(replicate(ys, 8000), seed=5).log_likelihood, exact.log_likelihood.sum())
    assert error < 0.02 and abs(score) < 4.5, (score, mean, error)


def test_forgetting_the_first_stage_would_be_seen():
    """The same filter that keeps equal weights after the look ahead is biased by far."""

    class Forgetful(tf.ParticleFilter):
        def _resample(self, belief, preferred, uniforms):
            return super()._resample(belief._replace(log_weights=preferred), preferred, uniforms)

    ys, exact = series(4)
    filter = tf.AuxiliaryParticleFilter(state_space(PLANE), 40)
    filter.__class__ = Forgetful
    belief = filter(replicate(ys, 2000), seed=5)
    assert abs(bias_score(belief.log_likelihood, exact.log_likelihood.sum())[0]) > 10


def test_looking_ahead_pays_where_the_measurement_says_much():
    """Little process noise and a sharp sensor that surprises: the log-evidence varies less than the bootstrap's."""
    model = PLANE._replace(Q=0.02 * PLANE.Q, R=0.1 * PLANE.R)
    ys, _ = series(1, model=model)
    ys = torch.stack([ys[0], ys[0] + 1.5, ys[0] + 2.0])
    laws = state_space(model)
    spread = {
        name: filter(replicate(ys, 300), seed=6).log_likelihood.var().item()
        for name, filter in {
            "bootstrap": tf.BootstrapFilter(laws, 300),
            "auxiliary": tf.AuxiliaryParticleFilter(laws, 300),
        }.items()
    }
    assert spread["auxiliary"] < 0.7 * spread["bootstrap"], spread


def test_no_look_ahead_is_the_bootstrap_filter():
    ys, _ = series(10)
    model = state_space(PLANE)
    one = tf.AuxiliaryParticleFilter(model, 200, power=0.0)(ys, seed=7)
    other = tf.BootstrapFilter(model, 200)(ys, seed=7)
    assert torch.allclose(one.mean, other.mean, rtol=1e-12, atol=1e-12)


def test_auxiliary_gradient_is_that_of_the_evidence():
    """Mean of the gradient of Z / Z_exact over rows against the exact score, 4.5 standard errors (1 in 150,000)."""
    ys, _ = series(3)
    shift = torch.zeros(1, dtype=torch.float64, requires_grad=True)

    def log_evidence(make, rows):
        laws = state_space(PLANE)
        offset = torch.cat([shift, torch.zeros(1, dtype=torch.float64)])
        law = tf.LinearGaussian(tensor(PLANE.A), tensor(PLANE.Q), offset)
        model = tf.StateSpaceModel(laws.initial, law, laws.observation)
        return make(model)(replicate(ys, rows), seed=8).log_likelihood

    exact = log_evidence(tf.KalmanFilter, 1)
    (score,) = torch.autograd.grad(exact.sum(), shift)
    found = []
    for k in range(25):
        log = log_evidence(lambda m: tf.AuxiliaryParticleFilter(m, 60, power=0.7), 200 + k)
        weight = (log - exact.detach()).exp().detach()
        (gradient,) = torch.autograd.grad((weight * log).mean(), shift)
        found.append(gradient)
    found = torch.stack(found)
    error = found.std(0) / len(found) ** 0.5
    assert (error < 0.2 * score.abs()).all()
    assert ((found.mean(0) - score).abs() < 4.5 * error).all()


def test_parts_that_do_not_fit_are_refused():
    model = state_space(PLANE)
    with pytest.raises(ValueError, match="a move or a kernel walks on points"):
        tf.ParticleFilter(model, 50, Local(unscented()), kernel=Regularize())
    with pytest.raises(TypeError, match="kernel must be a Regularize or None, got 'gaussian'"):
        tf.ParticleFilter(model, 50, Prior(), kernel="gaussian")
    with pytest.raises(ValueError, match=r"power must be in \[0, 1\], got 1.5"):
        LookAhead(1.5)
