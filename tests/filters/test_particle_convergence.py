"""Filtering moments approach the exact ones as 1/sqrt(n): the order is measured, not one number."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, replicate, series, state_space

import torchfilt as tf
from torchfilt.resampling import ess_below, systematic

COUNTS = (50, 200, 800, 3200)
FORMS = {
    "bootstrap": lambda model, n: tf.BootstrapFilter(model, n, ess_below(0.5)),
    "bootstrap-always": lambda model, n: tf.BootstrapFilter(model, n, systematic),
    "joint-points": lambda model, n: tf.UnscentedParticleFilter(
        model, n, redraw="always", split=0.0, pooled=False, weights="joint"
    ),
    "bank": lambda model, n: tf.LocallyLinearizedParticleFilter(model, n),
    "bank-redrawn": lambda model, n: tf.LocallyLinearizedParticleFilter(model, n, redraw="resample"),
    "pooled": lambda model, n: tf.UnscentedParticleFilter(model, n),
}


def rms_errors(make, n, runs, seed):
    """Root mean square over replicates of the last filtered mean's and covariance's error."""
    ys, exact = series(5)
    history = make(state_space(PLANE), n)(replicate(ys, runs), seed=seed)
    mean = history.mean[-1].numpy() - exact.mean[-1]
    covariance = history.covariance[-1].numpy() - exact.covariance[-1]
    return np.sqrt((mean**2).mean()), np.sqrt((covariance**2).mean())


SLOW = ("bank", "bank-redrawn")


@pytest.mark.parametrize("form", [pytest.param(f, marks=pytest.mark.slow if f in SLOW else ()) for f in FORMS])
def test_order_of_convergence_is_one_half(form):
    """Slope of log error over log n within 0.1 of -1/2.

    One error has a relative standard error of 1/sqrt(2 * 64 runs * 2 components) = 6 %, the slope over four counts that
    span a factor of 64 one of 0.02; systematic resampling makes errors fall slightly faster than 1/2 at small n.
    """
    errors = np.array([rms_errors(FORMS[form], n, 64, 31) for n in COUNTS])
    slopes = np.polyfit(np.log(COUNTS), np.log(errors), 1)[0]
    assert np.all(np.abs(slopes + 0.5) < 0.1), (slopes, errors)


def test_each_particle_of_a_local_filter_is_worth_more_than_a_bootstrap_particle():
    """Same n, same data: the better proposal has the smaller error, and the redrawn bank the smallest."""
    errors = {form: rms_errors(FORMS[form], 200, 200, 32)[0] for form in ("bootstrap", "joint-points", "bank")}
    assert errors["bank"] < 0.8 * errors["joint-points"] < 0.8 * 0.9 * errors["bootstrap"], errors


def test_rows_choose_for_themselves_when_to_resample():
    """A row with a surprising measurement resamples, its quiet neighbour keeps every particle and its weights."""
    filter = tf.BootstrapFilter(state_space(PLANE), 100, ess_below(0.5))
    state = filter.init((2,), seed=1)
    y = torch.tensor([[0.2], [6.0]]).double()
    state, info = filter.step(state, y)
    assert info.ess[0] > 50 > info.ess[1]
    noise = filter.draw(state.belief, state.step, state.seed)
    belief, ancestors, chosen = filter._resample(state.belief, state.belief.log_weights, noise.resampling)
    assert chosen.tolist() == [False, True]
    assert torch.equal(ancestors[0], torch.arange(100)) and len(ancestors[1].unique()) < 60
    assert torch.equal(belief.x[0], state.belief.x[0]) and torch.equal(
        belief.log_weights[0], state.belief.log_weights[0]
    )
    np.testing.assert_allclose(belief.weights[1], 0.01, rtol=1e-14)
    _, info = filter.step(state, y)
    assert torch.equal(info.ancestors, ancestors)


def test_ess_is_what_the_weights_say():
    filter = tf.BootstrapFilter(state_space(PLANE), 100)
    state, info = filter.step(filter.init((3,)), torch.tensor([[0.0], [2.0], [-3.0]]).double())
    np.testing.assert_allclose(info.ess, 1 / state.belief.weights.square().sum(-1), rtol=1e-12)
