"""On linear-Gaussian models every Gaussian filter is the Kalman filter; oracles in covariance form."""

import itertools
import warnings

import numpy as np
import pytest
import torch
from gaussian_problem import RULES, model, problem, solve, tensor
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import kalman_oracle

import torchfilt as tf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from filterpy.kalman import KalmanFilter as FilterpyKalman
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter as StatsmodelsKalman


def run(p, rule, form="functions", iterations=1, dt=None):
    filter = tf.GaussianFilter(model(p, form), RULES[rule], iterations)
    return filter(tensor(p.ys), tensor(p.us), tensor(p.dts) if dt is None else dt)


def assert_equals_oracle(p, history, tolerance=1e-9):
    """Relative to the largest number of the series, which is what the rounding of a recursion scales with."""
    for row in range(p.ys.shape[1]):
        expected = solve(p, row)
        found = history.mean[:, row], history.covariance[:, row], history.diagnostics.log_likelihood[:, row]
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours.numpy(), theirs, rtol=0, atol=tolerance * max(1, np.abs(theirs).max()))


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("rule", RULES)
def test_plain_functions_equal_the_covariance_form(rule, iterations):
    """Controls, offsets, steps of different length; a third of the numbers missing, each row its own."""
    p = problem(1, hidden=0.33)
    assert np.isnan(p.ys).any(-1).any()
    assert_equals_oracle(p, run(p, rule, iterations=iterations))


@pytest.mark.parametrize("rule", RULES)
def test_linear_laws_equal_the_covariance_form(rule):
    p = problem(2, hidden=0.33)
    assert_equals_oracle(p, run(p, rule, "linear"))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31),
    d=st.integers(1, 4),
    m=st.integers(1, 4),
    radius=st.sampled_from([0.0, 0.5, 0.99, 1.0, 1.3]),
    hidden=st.sampled_from([0.0, 0.2, 0.7, 1.0]),
    rule=st.sampled_from(sorted(RULES)),
    form=st.sampled_from(["functions", "linear"]),
    iterations=st.integers(1, 3),
)
def test_random_models(seed, d, m, radius, hidden, rule, form, iterations):
    """Stable and unstable motions, more or fewer measurements than states, singular motion (radius 0)."""
    p = problem(seed, d, m, steps=8, rows=2, radius=radius, hidden=hidden)
    assert_equals_oracle(p, run(p, rule, form, iterations))


@pytest.mark.parametrize("rule", RULES)
def test_every_pattern_of_missing_components(rule):
    """Three components, all eight patterns, in an order that differs between the rows."""
    patterns = np.array(list(itertools.product([True, False], repeat=3)))
    p = problem(3, m=3, steps=len(patterns), rows=4)
    for row, shift in enumerate((0, 3, 5, 0)):
        p.ys[:, row][np.roll(patterns, shift, 0)] = np.nan
    assert_equals_oracle(p, run(p, rule))
    assert_equals_oracle(p, run(p, rule, "linear"))


@pytest.mark.parametrize("rule", RULES)
def test_a_prior_at_the_time_of_the_first_measurement(rule):
    p = problem(4, rows=1)
    motion = np.eye(3) + p.dts[:, None, None] * p.a
    push = p.us[:, 0] @ p.b.T + p.push
    expected = kalman_oracle.kalman(p.m0, p.p0, motion, p.q, p.h, p.r, p.ys[:, 0], push, p.offset, predict_first=False)
    filter = tf.GaussianFilter(model(p), RULES[rule])
    history = filter(tensor(p.ys), tensor(p.us), tensor(p.dts), predict_first=False)
    np.testing.assert_allclose(history.mean[:, 0].numpy(), expected.mean, rtol=0, atol=1e-11)
    np.testing.assert_allclose(history.covariance[:, 0].numpy(), expected.covariance, rtol=0, atol=1e-11)
    np.testing.assert_allclose(history.log_likelihood[0].item(), expected.log_likelihood.sum(), rtol=1e-12)


def test_filterpy_agrees():
    p = problem(5, rows=1)
    history = run(p, "unscented")
    witness = FilterpyKalman(dim_x=3, dim_z=2, dim_u=1)
    witness.x, witness.P, witness.Q, witness.R, witness.H = p.m0.copy(), p.p0.copy(), p.q, p.r, p.h
    for k in range(len(p.ys)):
        witness.predict(u=p.us[k, 0], B=p.b, F=np.eye(3) + p.dts[k] * p.a)
        witness.x = witness.x + p.push
        witness.update(p.ys[k, 0] - p.offset)
        np.testing.assert_allclose(history.mean[k, 0].numpy(), witness.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(history.covariance[k, 0].numpy(), witness.P, rtol=0, atol=1e-9)
        found = history.diagnostics.log_likelihood[k, 0].item()
        np.testing.assert_allclose(found, witness.log_likelihood, rtol=0, atol=1e-9)


@pytest.mark.parametrize("rule", RULES)
def test_statsmodels_agrees(rule):
    """Its initial state is the one at the first measurement; missing components are dropped by its own code."""
    p = problem(6, rows=1, hidden=0.3)
    p = p._replace(dts=np.ones(len(p.ys)), us=np.zeros_like(p.us))
    motion = np.eye(3) + p.a
    witness = StatsmodelsKalman(k_endog=2, k_states=3)
    witness.bind(p.ys[:, 0].copy())
    witness["design"], witness["obs_intercept"], witness["obs_cov"] = p.h, p.offset, p.r
    witness["transition"], witness["state_intercept"] = motion, p.push
    witness["selection"], witness["state_cov"] = np.eye(3), p.q
    witness.initialize_known(motion @ p.m0 + p.push, motion @ p.p0 @ motion.T + p.q)
    expected = witness.filter()
    history = run(p, rule)
    np.testing.assert_allclose(history.mean[:, 0].numpy(), expected.filtered_state.T, rtol=0, atol=1e-9)
    covariance = np.moveaxis(expected.filtered_state_cov, -1, 0)
    np.testing.assert_allclose(history.covariance[:, 0].numpy(), covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(history.log_likelihood[0].item(), expected.llf, rtol=0, atol=1e-9)


def test_small_alpha_costs_digits_as_its_weights_grow():
    """Weights of the mean reach 1 / alpha^2; each step rounds the mean by that many ulps, and no more."""
    p = problem(7)
    for alpha in (1e-1, 1e-2, 1e-3):
        filter = tf.UnscentedKalmanFilter(model(p), alpha=alpha, beta=2.0, kappa=0.0)
        history = filter(tensor(p.ys), tensor(p.us), tensor(p.dts))
        assert_equals_oracle(p, history, max(1e-13, 100 * 2.2e-16 / alpha**2))


def variants(p, pattern):
    """Measurements and time steps of a pattern; rows of the problem stay the same series."""
    ys, dts = p.ys.copy(), p.dts
    if pattern == "shared":
        ys[3, :, 0] = ys[5] = np.nan
    if pattern == "rows":
        ys[3, 0, 0] = ys[4, 1] = ys[5, 2, 1] = np.nan
    if pattern == "mixed":
        ys[2, :, 1] = ys[4, 0, 0] = np.nan
    if pattern == "dt-rows":
        dts = dts[:, None] * np.linspace(0.5, 1, ys.shape[1])
    return ys, dts


@pytest.mark.parametrize("pattern", ["complete", "shared", "rows", "mixed", "dt-rows"])
@pytest.mark.parametrize("batch", [(4,), (2, 2)])
def test_shared_covariance_gives_the_numbers_of_a_covariance_a_row(pattern, batch):
    """One factor for the batch; one a row; a loop over rows. Rounding of 12 steps, condition below 100: 1e-12."""
    p = problem(8, rows=4)
    ys, dts = variants(p, pattern)
    filter = tf.KalmanFilter(model(p, "linear"))
    shape = (len(ys), *batch)
    y, u = tensor(ys).reshape(*shape, -1), tensor(p.us).reshape(*shape, -1)
    dt = tensor(dts) if dts.ndim == 1 else tensor(dts).reshape(shape)
    shared = filter(y, u, dt, record="beliefs")
    start = filter.init(batch)
    belief = start.belief._replace(scale_tril=start.belief.scale_tril.expand(*batch, -1, -1).contiguous())
    a_row = filter(y, u, dt, state=start._replace(belief=belief))
    assert (shared.final.belief.scale_tril.dim() == 2) == (pattern in ("complete", "shared"))
    assert a_row.final.belief.scale_tril.shape == (*batch, 3, 3)
    loop = [
        filter(tensor(ys[:, row]), tensor(p.us[:, row]), tensor(dts if dts.ndim == 1 else dts[:, row]))
        for row in range(4)
    ]
    for name in ("mean", "covariance"):
        found = getattr(shared, name)
        assert found.shape[:-1] == (*shape, 3)[: found.dim() - 1]
        torch.testing.assert_close(found, getattr(a_row, name), rtol=0, atol=1e-12)
        rows = torch.stack([getattr(one, name) for one in loop], 1).reshape(found.shape)
        torch.testing.assert_close(found, rows, rtol=0, atol=1e-12)
    for name in ("log_likelihood", "nis", "innovation"):
        found = getattr(shared.diagnostics, name)
        torch.testing.assert_close(found, getattr(a_row.diagnostics, name), rtol=0, atol=1e-11)
        rows = torch.stack([getattr(one.diagnostics, name) for one in loop], 1).reshape(found.shape)
        torch.testing.assert_close(found, rows, rtol=0, atol=1e-11)


def test_a_prior_for_each_row():
    """Means and factors of the prior may differ by row."""
    p = problem(9, rows=3)
    laws = model(p, "linear")
    means = tensor(np.stack([p.m0, p.m0 + 1, p.m0 - 2]))
    factors = torch.linalg.cholesky(tensor(p.p0)) * tensor([1.0, 0.5, 2.0])[:, None, None]
    many = tf.KalmanFilter(tf.StateSpaceModel(tf.Gaussian(means, factors), laws.transition, laws.observation))
    history = many(tensor(p.ys), tensor(p.us), tensor(p.dts))
    for row in range(3):
        scale = (1.0, 0.5, 2.0)[row]
        expected = solve(p._replace(m0=means[row].numpy(), p0=p.p0 * scale**2), row)
        np.testing.assert_allclose(history.mean[:, row].numpy(), expected.mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(history.covariance[:, row].numpy(), expected.covariance, rtol=0, atol=1e-11)


@pytest.mark.parametrize("rule", RULES)
def test_a_step_without_any_measurement_is_the_prediction_bit_for_bit(rule):
    p = problem(10, rows=2)
    for form in ("functions", "linear"):
        filter = tf.GaussianFilter(model(p, form), RULES[rule])
        u, y = tensor(p.us[0]), torch.full((2, 2), torch.nan, dtype=torch.float64)
        state = filter(tensor(p.ys), tensor(p.us), tensor(p.dts)).final
        predicted = filter.predict(state.belief, u, 0.3)
        after, info = filter.step(state, y, u, 0.3)
        assert torch.equal(after.belief.mean, predicted.mean)
        assert torch.equal(after.belief.scale_tril, predicted.scale_tril)
        assert torch.equal(info.log_likelihood, torch.zeros(2, dtype=torch.float64))
        # In a batch where another row is measured the silent row is the same prediction.
        mixed = y.clone()
        mixed[1] = 1.0
        half, info = filter.step(state, mixed, u, 0.3)
        expected = predicted.scale_tril if predicted.scale_tril.dim() == 2 else predicted.scale_tril[0]
        assert torch.equal(half.belief.mean[0], predicted.mean[0])
        assert torch.equal(half.belief.scale_tril[0], expected)
        assert info.log_likelihood[0] == 0
        assert info.log_likelihood[1] != 0


@pytest.mark.parametrize("rule", RULES)
def test_neighbours_in_a_batch_change_nothing(rule):
    """Another row gets wild numbers, on the path without and on the path with missing components."""
    p = problem(11, rows=3)
    filter = tf.GaussianFilter(model(p), RULES[rule])
    for hidden in (False, True):
        ys = p.ys.copy()
        if hidden:
            ys[2, 2, 0] = np.nan
        before = filter(tensor(ys), tensor(p.us), tensor(p.dts))
        ys[:, 1] = 1e6
        after = filter(tensor(ys), tensor(p.us), tensor(p.dts))
        for row in (0, 2):
            assert torch.equal(before.mean[:, row], after.mean[:, row])
            assert torch.equal(before.covariance[:, row], after.covariance[:, row])
            found = (history.diagnostics.log_likelihood[:, row] for history in (before, after))
            assert torch.equal(*found)
        assert not torch.equal(before.mean[:, 1], after.mean[:, 1])
