"""Observers with a constant gain: the notes' numbers, SciPy, the recursive filter, filterpy, statsmodels."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are

import torchfilt as tf
from torchfilt.filters.observer import LuenbergerObserver, SteadyStateKalmanFilter
from torchfilt.models.control import c2d, place, ss
from torchfilt.models.control.continuous import linear_model
from torchfilt.models.relative_motion import ClohessyWiltshire
from torchfilt.testing import check_filter

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps


def double(values):
    return torch.tensor(values, dtype=DOUBLE)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


A, B, C = double([[0, 1], [0, 0]]), double([[0], [1]]), double([[1, 0]])
PLANT = ss(A, B, C)
PERIOD = 0.5
SAMPLED = c2d(PLANT, PERIOD, double([[0.04]]), B)
PRIOR = tf.Gaussian(double([1.0, -0.5]), torch.eye(2, dtype=DOUBLE))
R = double([[0.5]])
MODEL = linear_model(SAMPLED.system, SAMPLED.noise_covariance, R, PRIOR)
TWO = ss(double([[0.9, 0.2], [-0.1, 0.8]]), B, torch.eye(2, dtype=DOUBLE), double([[0.1], [0.0]]), PERIOD)
TWO_NOISE = 0.1 * torch.eye(2, dtype=DOUBLE), double([[0.3, 0.1], [0.1, 0.2]])


def two_model():
    return linear_model(TWO, *TWO_NOISE, PRIOR)


# Luenberger ---------------------------------------------------------------------------------------------------------


def test_the_notes_gains():
    """Double integrator, poles -2 and -3: L = (5, 6); with a bias that enters with a minus sign (4.5, 6.5, -3)."""
    observer = LuenbergerObserver(PLANT, double([[5.0], [6.0]]))
    assert sorted(observer.poles().real.tolist()) == pytest.approx([-3, -2], abs=1e-12)
    chain = ss(double([[0, 1, 0], [0, 0, -1], [0, 0, 0]]), double([[0], [1], [0]]), double([[1, 0, 0]]))
    gain = place(chain.a.mT, chain.c.mT, [-1, -1.5, -2]).mT
    torch.testing.assert_close(gain, double([[4.5], [6.5], [-3]]), rtol=1e-10, atol=0)
    poles = LuenbergerObserver(chain, gain).poles().real
    # Three poles half a unit apart: the condition of each is about a hundred.
    torch.testing.assert_close(poles.sort().values, double([-2, -1.5, -1]), rtol=1e-10, atol=0)


def test_a_continuous_observer_solves_its_own_equation():
    """x' = A x + B u + L (y - C x - D u) with u and y held: DOP853 on steps of many lengths."""
    a, b, c, d = normal(3, 3), normal(3, 2, seed=1), normal(2, 3, seed=2), normal(2, 2, seed=3)
    gain, start = normal(3, 2, seed=4), normal(3, seed=5)
    ys, us, steps = normal(4, 2, seed=6), normal(4, 2, seed=7), double([0.1, 0.7, 0.0, 0.3])
    history = LuenbergerObserver(ss(a, b, c, d), gain, start)(ys, us, steps)
    x = start.numpy()
    for k in range(4):
        y, u = ys[k].numpy(), us[k].numpy()

        def rate(t, x, y=y, u=u):
            return a.numpy() @ x + b.numpy() @ u + gain.numpy() @ (y - c.numpy() @ x - d.numpy() @ u)

        if steps[k] > 0:
            x = solve_ivp(rate, (0, float(steps[k])), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(history.mean[k].numpy(), x, rtol=0, atol=1e-10)
    assert torch.isnan(history.covariance).all() and torch.isnan(history.log_likelihood)
    assert history.diagnostics.ok.all() and torch.equal(history.mean[2], history.mean[1])


def test_a_discrete_observer_by_hand():
    gain = normal(2, 2, seed=1)
    ys, us = normal(5, 2, seed=2), normal(5, 1, seed=3)
    observer = LuenbergerObserver(TWO, gain, double([1.0, 2.0]))
    history = observer(ys, us, PERIOD)
    x = np.array([1.0, 2.0])
    for k in range(5):
        u = us[k].numpy()
        x = TWO.a.numpy() @ x + TWO.b.numpy() @ u
        x = x + gain.numpy() @ (ys[k].numpy() - TWO.c.numpy() @ x - TWO.d.numpy() @ u)
        np.testing.assert_allclose(history.mean[k].numpy(), x, rtol=1e-13, atol=1e-14)
    assert torch.equal(observer(ys, us).mean, history.mean)
    still = observer.step(observer.init(), ys[0], us[0], 0.0)[0].belief.mean
    torch.testing.assert_close(still, observer.step(observer.init(), ys[0], us[0], predict_first=False)[0].belief.mean)
    assert not torch.allclose(still, history.mean[0])


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_error_dies_out_as_the_poles_say(kind):
    """Without noise, from a wrong start at rest: every error is the matrix power of the first."""
    poles = [0.5, 0.4] if kind == "discrete" else [-2.0, -3.0]
    sampled = SAMPLED.system
    if kind == "discrete":  # the error moves by (I - K C) A: the dual of placing (A, C A)
        system, gain = sampled, place(sampled.a.mT, (sampled.c @ sampled.a).mT, double(poles)).mT
        matrix = (np.eye(2) - gain.numpy() @ sampled.c.numpy()) @ sampled.a.numpy()
    else:
        system, gain = PLANT, place(A.mT, C.mT, poles).mT
        matrix = expm(PERIOD * (A - gain @ C).numpy())
    observer = LuenbergerObserver(system, gain)
    torch.testing.assert_close(observer.poles().real.sort().values, double(poles).sort().values, rtol=1e-9, atol=0)
    x, state, errors = double([3.0, 0.0]), observer.init(), []
    for _ in range(16):  # at rest, so that a held measurement is no approximation
        state, _ = observer.step(state, C @ x, torch.zeros(1, dtype=DOUBLE), PERIOD)
        errors.append((state.belief.mean - x).numpy())
    first = (observer.init().belief.mean - x).numpy()
    for k, error in enumerate(errors):
        np.testing.assert_allclose(error, np.linalg.matrix_power(matrix, k + 1) @ first, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_claimed_covariance_is_that_of_the_error(kind):
    """20,000 runs of a gain that is far from the best; the covariance within five standard errors (1e-5 for all)."""
    runs, steps = 20_000, 12
    torch_noise = torch.Generator().manual_seed(5)

    def draw(*shape):
        return torch.randn(shape, generator=torch_noise, dtype=DOUBLE)

    if kind == "discrete":
        observer = LuenbergerObserver(SAMPLED.system, double([[0.8], [0.1]]), PRIOR, SAMPLED.noise_covariance, R)
        root = torch.linalg.cholesky(SAMPLED.noise_covariance)
        x = PRIOR.sample(draw(runs, 2))
        state = observer.init((runs,))
        for _ in range(steps):
            x = x @ SAMPLED.system.a.mT + draw(runs, 2) @ root.mT
            state, info = observer.step(state, x @ C.mT + draw(runs, 1) * R.sqrt())
        error = x - state.belief.mean
        # In truth the innovation is a sum of the errors: NIS has mean 1, standard error (2 / runs) ** 0.5.
        assert abs(info.nis.mean().item() - 1) < 5 * (2 / runs) ** 0.5
        assert state.belief.scale_tril.dim() == 2
    else:  # e' = (A - L C) e + F w - L v by small steps of Euler's rule, 1 / 2000 s: bias 5e-4 at most
        observer = LuenbergerObserver(PLANT, double([[2.0], [1.0]]), PRIOR, double([[0.04]]), double([[0.25]]), B)
        h, error = 1 / 500, draw(runs, 2)
        loop, push = A - observer.gain @ C, torch.cat([0.2 * B, -0.5 * observer.gain], -1)
        for _ in range(500):
            error = error + h * (error @ loop.mT) + h**0.5 * draw(runs, 2) @ push.mT
        state, _ = observer.step(observer.init(), double([0.3]), dt=1.0)
    found, claimed = error.mT @ error / runs, state.belief.covariance
    claimed = claimed[0] if claimed.dim() == 3 else claimed
    deviation = ((claimed.diagonal()[:, None] * claimed.diagonal() + claimed**2) / runs).sqrt()
    slack = 0 if kind == "discrete" else 2e-3 * claimed.abs().max()  # Euler's rule: |A - L C|^2 h
    assert bool(((found - claimed).abs() < 5 * deviation + slack).all()), (found, claimed)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_recursion_settles_at_lyapunovs_answer(kind):
    if kind == "discrete":
        observer = LuenbergerObserver(SAMPLED.system, double([[0.8], [0.2]]), PRIOR, SAMPLED.noise_covariance, R)
    else:
        observer = LuenbergerObserver(PLANT, double([[2.0], [1.0]]), PRIOR, double([[0.04]]), double([[0.25]]), B)
    history = observer(torch.zeros(120, 1, dtype=DOUBLE), dt=PERIOD)
    expected = observer.stationary_covariance()
    torch.testing.assert_close(history.covariance[-1], expected, rtol=1e-10, atol=1e-13)
    assert not torch.allclose(history.covariance[3], expected, rtol=1e-3)


def test_the_best_gain_is_the_stationary_filters_own():
    """Continuous: L = P C^T / R gives back the notes' P; discrete: K gives back P+."""
    best = LuenbergerObserver(
        PLANT, double([[0.894427191], [0.4]]), PRIOR, double([[0.04]]), double([[0.25]]), B
    ).stationary_covariance()
    torch.testing.assert_close(best, double([[0.223606797750, 0.1], [0.1, 0.0894427191]]), rtol=1e-9, atol=0)
    gain = double([[0.36059166453], [0.15992602483]])
    found = LuenbergerObserver(SAMPLED.system, gain, PRIOR, SAMPLED.noise_covariance, R).stationary_covariance()
    torch.testing.assert_close(
        found, double([[0.18029583226, 0.07996301242], [0.07996301242, 0.08018961483]]), rtol=1e-9, atol=0
    )


def test_a_missing_component_corrects_nothing():
    """Its column of the gain is as good as zero, in both kinds of time, row by row."""
    continuous = ss(A, B, torch.eye(2, dtype=DOUBLE))
    for system, noise in ((TWO, TWO_NOISE), (continuous, TWO_NOISE)):
        gain = 0.5 * torch.eye(2, dtype=DOUBLE) + 0.1
        whole = LuenbergerObserver(system, gain, PRIOR, *noise)
        first = LuenbergerObserver(system, gain * double([1.0, 0.0]), PRIOR, *noise)
        ys, u = normal(3, 2, seed=1), normal(1, seed=2)
        holes = ys.clone()
        holes[0, 1] = holes[2] = torch.nan
        state, info = whole.step(whole.init((3,)), holes, u, PERIOD)
        alone = first.step(first.init(), ys[0], u, PERIOD)[0].belief
        full = whole.step(whole.init(), ys[1], u, PERIOD)[0].belief
        none = LuenbergerObserver(system, 0 * gain, PRIOR, *noise)
        open_loop = none.step(none.init(), ys[2], u, PERIOD)[0].belief
        for row, expected in enumerate((alone, full, open_loop)):
            torch.testing.assert_close(state.belief.mean[row], expected.mean, rtol=1e-12, atol=1e-13)
            torch.testing.assert_close(state.belief.covariance[row], expected.covariance, rtol=1e-12, atol=1e-13)
        assert (info.innovation[2] == 0).all() and info.innovation[0, 1] == 0
        shared = whole.step(whole.init(), holes[0], u, PERIOD)[0].belief
        torch.testing.assert_close(shared.covariance, alone.covariance, rtol=1e-12, atol=1e-13)


def test_a_continuous_observer_of_a_ramp_lags_by_half_a_step():
    """What is stated: a y that changes over dt is taken for its value at the end, half a step early, to first order.

    The next order is a pole, 3 / s at most, times dt.
    """
    lags = []
    for dt in (0.1, 0.05):
        observer = LuenbergerObserver(PLANT, double([[5.0], [6.0]]), double([0.0, 1.0]))
        count = round(20 / dt)
        times = dt * torch.arange(1, count + 1, dtype=DOUBLE)
        final = observer(times.unsqueeze(-1), dt=dt).mean[-1]
        lags.append(float(final[0] - times[-1]))
        assert lags[-1] == pytest.approx(dt / 2, rel=3 * dt)
    assert lags[0] / lags[1] == pytest.approx(2, rel=3 * 0.05)


# Stationary Kalman filter -------------------------------------------------------------------------------------------


def test_the_notes_stationary_filter():
    filter = SteadyStateKalmanFilter(MODEL, PERIOD)
    torch.testing.assert_close(filter.gain, double([[0.36059166453], [0.15992602483]]), rtol=1e-10, atol=0)
    predicted = filter.predicted @ filter.predicted.mT
    expected = double([[0.28197291505, 0.12505781983], [0.12505781983, 0.10018961483]])
    torch.testing.assert_close(predicted, expected, rtol=1e-10, atol=0)
    after = filter.posterior @ filter.posterior.mT
    expected = double([[0.18029583226, 0.07996301242], [0.07996301242, 0.08018961483]])
    torch.testing.assert_close(after, expected, rtol=1e-10, atol=0)
    continuous = SteadyStateKalmanFilter(linear_model(PLANT, double([[0.04]]), R, PRIOR, B), PERIOD)
    torch.testing.assert_close(continuous.gain, filter.gain, rtol=1e-11, atol=0)


def test_it_is_where_the_recursive_filter_settles():
    """Mean, covariance, innovation, likelihood: after 200 steps equal to rounding, before not."""
    ys, us = normal(300, 4, 1, seed=1), normal(300, 4, 1, seed=2)
    constant, recursive = SteadyStateKalmanFilter(MODEL, PERIOD)(ys, us), tf.KalmanFilter(MODEL)(ys, us)
    close = dict(rtol=1e-10, atol=1e-11)
    torch.testing.assert_close(constant.mean[200:], recursive.mean[200:], **close)
    torch.testing.assert_close(constant.covariance[200:], recursive.covariance[200:], **close)
    for name in ("log_likelihood", "nis", "innovation"):
        found, expected = (getattr(history.diagnostics, name)[200:] for history in (constant, recursive))
        torch.testing.assert_close(found, expected, **close)
    assert not torch.allclose(constant.mean[0], recursive.mean[0])
    factors = constant.diagnostics.innovation_scale_tril
    assert factors.shape == (300, 1, 1) and bool((factors == factors[0]).all())
    assert constant.beliefs.scale_tril.shape == (300, 1, 2, 2), "one factor for all rows"


def test_nile():
    """Local level: from the 60th year on the answers of filterpy and statsmodels; filterpy's own steady-state step."""
    flow = np.loadtxt(Path(__file__).parents[2] / "data/classic/nile.csv", delimiter=",", skiprows=1)[:, 1]
    one = torch.ones(1, 1, dtype=DOUBLE)
    prior = tf.Gaussian(double([flow[0]]), double([[4032.0**0.5]]))
    model = tf.StateSpaceModel(prior, tf.LinearGaussian(one, 1469.1 * one), tf.LinearGaussian(one, 15099.0 * one))
    filter = SteadyStateKalmanFilter(model)
    history = filter(torch.as_tensor(flow)[:, None])
    P = solve_discrete_are(np.eye(1), np.eye(1), [[1469.1]], [[15099.0]])
    assert filter.gain.item() == pytest.approx(P.item() / (P.item() + 15099.0), rel=1e-13)
    assert history.mean[-1].item() == pytest.approx(798.3703, abs=5e-5)
    assert history.covariance[-1].item() == pytest.approx(4032.158, abs=5e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from filterpy.kalman import KalmanFilter
        from statsmodels.tsa.statespace.structural import UnobservedComponents
    witness = UnobservedComponents(flow, "llevel")
    witness.ssm.initialize_approximate_diffuse(1e6)
    expected = witness.filter([15099.0, 1469.1])
    # The start is forgotten by 0.7325 a year: 0.7325 ** 59 * 400 is below 1e-5 of a thousand.
    np.testing.assert_allclose(history.mean[59:, 0].numpy(), expected.filtered_state[0, 59:], rtol=1e-8)
    np.testing.assert_allclose(history.diagnostics.log_likelihood[59:].numpy(), expected.llf_obs[59:], atol=1e-7)
    rival = KalmanFilter(1, 1)
    rival.x, rival.F, rival.H = np.array([[flow[0]]]), np.eye(1), np.eye(1)
    rival.K = filter.gain.numpy()
    rival.inv = np.linalg.inv  # what filterpy calls by default
    for k, value in enumerate(flow):
        rival.predict_steadystate()
        rival.update_steadystate(np.array([[value]]))
        assert rival.x.item() == pytest.approx(history.mean[k].item(), rel=1e-13)


def test_unsettled_it_carries_the_true_covariance():
    """From the prior on: Joseph's recursion of the constant gain, by hand."""
    filter = SteadyStateKalmanFilter(MODEL, PERIOD, settled=False)
    history = filter(normal(4, 1), normal(4, 1, seed=1))
    P, K, a, c = np.eye(2), filter.gain.numpy(), SAMPLED.system.a.numpy(), C.numpy()
    left = np.eye(2) - K @ c
    for k in range(4):
        P = a @ P @ a.T + SAMPLED.noise_covariance.numpy()
        S = (c @ P @ c.T + R.numpy()).item()
        P = left @ P @ left.T + K @ R.numpy() @ K.T
        np.testing.assert_allclose(history.covariance[k].numpy(), P, rtol=1e-12)
        innovation = history.diagnostics.innovation[k].item()
        assert history.diagnostics.nis[k].item() == pytest.approx(innovation**2 / S, rel=1e-12)
        likelihood = -0.5 * (innovation**2 / S + np.log(2 * np.pi * S))
        assert history.diagnostics.log_likelihood[k].item() == pytest.approx(likelihood, rel=1e-12)


def gaps(model, ys, us=None):
    return SteadyStateKalmanFilter(model, PERIOD)(ys, us), tf.KalmanFilter(model)(ys, us)


@pytest.mark.parametrize("pattern", ["component", "all"])
@pytest.mark.parametrize("rows", ["shared", "one row"])
def test_a_gap_is_taken_in_exactly_and_not_forgotten(pattern, rows):
    """At the gap all numbers are the recursive filter's; after it the covariance is the truth of a constant gain."""
    ys, us = normal(80, 2, 2, seed=3), normal(80, 1, seed=4)
    hole = ys[60] if rows == "shared" else ys[60, :1]
    hole[..., slice(None) if pattern == "all" else 1] = torch.nan
    constant, recursive = gaps(two_model(), ys, us)
    close = dict(rtol=1e-9, atol=1e-11)
    for k in (59, 60):
        torch.testing.assert_close(constant.mean[k], recursive.mean[k], **close)
        torch.testing.assert_close(constant.covariance[k], recursive.covariance[k], **close)
        for name in ("log_likelihood", "nis"):
            found, expected = (getattr(h.diagnostics, name)[k] for h in (constant, recursive))
            torch.testing.assert_close(found, expected, **close)
    filter = SteadyStateKalmanFilter(two_model(), PERIOD)
    P = recursive.covariance[60].numpy()
    left = np.eye(2) - filter.gain.numpy() @ TWO.c.numpy()
    for k in range(61, 64):
        P = TWO.a.numpy() @ P @ TWO.a.numpy().T + TWO_NOISE[0].numpy()
        P = left @ P @ left.T + filter.gain.numpy() @ TWO_NOISE[1].numpy() @ filter.gain.numpy().T
        np.testing.assert_allclose(constant.covariance[k].numpy(), P, rtol=1e-9)
    assert constant.covariance[61, 0, 0, 0] > 1.001 * constant.covariance[59, 0, 0, 0]
    torch.testing.assert_close(constant.covariance[-1], constant.covariance[59], rtol=1e-3, atol=0)


def test_dt_zero_and_predict_first_mean_no_motion():
    filter = SteadyStateKalmanFilter(MODEL, PERIOD)
    u, y = normal(1), normal(1, seed=1)
    still, info = filter.step(filter.init(), y, u, 0.0)
    torch.testing.assert_close(still.belief.mean, PRIOR.mean + filter.gain[:, 0] * (y - PRIOR.mean[0]))
    other, _ = filter.step(filter.init(), y, u, predict_first=False)
    assert torch.equal(other.belief.mean, still.belief.mean)
    # The claimed prior is the stationary posterior: its innovation is what its factor says, not that of a prediction.
    expected = (0.18029583226 + 0.5) ** 0.5
    assert info.innovation_scale_tril.item() == pytest.approx(expected, rel=1e-9)


def test_laws_of_the_library_with_controls_of_their_own():
    """Clohessy-Wiltshire motion takes a thrust; a step without measurement is the recursive filter's mean."""
    law = ClohessyWiltshire(1.1e-3, 1e-4, 10.0)
    sight = tf.LinearGaussian(torch.eye(3, 6, dtype=DOUBLE), torch.eye(3, dtype=DOUBLE))
    prior = tf.Gaussian(100 * normal(6), torch.eye(6, dtype=DOUBLE))
    model = tf.StateSpaceModel(prior, law, sight)
    filter, thrust = SteadyStateKalmanFilter(model, 10.0), normal(3, seed=1)
    nothing = torch.full((3,), torch.nan, dtype=DOUBLE)
    found = filter.step(filter.init(), nothing, thrust)[0].belief.mean
    recursive = tf.KalmanFilter(model)
    expected = recursive.step(recursive.init(), nothing, thrust, 10.0)[0].belief.mean
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
    assert not torch.allclose(found, filter.step(filter.init(), nothing)[0].belief.mean)


def test_offsets_and_controls_of_both_laws():
    """Constant offsets and inputs to motion and measurement, against the recursive filter."""
    offset = double([0.3, -0.2])
    motion = tf.LinearGaussian(TWO.a, TWO_NOISE[0], offset, control_matrix=TWO.b)
    sight = tf.LinearGaussian(TWO.c, TWO_NOISE[1], 2 * offset, control_matrix=TWO.d)
    model = tf.StateSpaceModel(PRIOR, motion, sight)
    ys, us = normal(100, 3, 2), normal(100, 3, 1, seed=1)
    constant, recursive = SteadyStateKalmanFilter(model)(ys, us), tf.KalmanFilter(model)(ys, us)
    torch.testing.assert_close(constant.mean[60:], recursive.mean[60:], rtol=1e-10, atol=1e-11)
    assert constant.evidence == "approximate" and recursive.evidence == "exact"
    with pytest.raises(ValueError, match="the transition has an input matrix but no control u"):
        SteadyStateKalmanFilter(model)(ys)


def test_laws_on_a_space():
    """An angle as a measurement: innovations are wrapped."""
    space = tf.Angle(1)

    class Compass(tf.LinearGaussian):
        pass

    compass = Compass(C, R)
    compass.space = space
    model = tf.StateSpaceModel(PRIOR, MODEL.transition, compass)
    filter = SteadyStateKalmanFilter(model, PERIOD)
    u = torch.zeros(1, dtype=DOUBLE)
    one, _ = filter.step(filter.init(), double([3.0]), u)
    other, _ = filter.step(filter.init(), double([3.0 - 2 * np.pi]), u)
    torch.testing.assert_close(one.belief.mean, other.belief.mean, rtol=1e-12, atol=1e-12)


# For all ------------------------------------------------------------------------------------------------------------


def every():
    continuous = ss(A, B, torch.eye(2, dtype=DOUBLE))
    gain = 0.5 * torch.eye(2, dtype=DOUBLE)
    return {
        "Luenberger discrete": LuenbergerObserver(TWO, gain, PRIOR, *TWO_NOISE),
        "stationary": SteadyStateKalmanFilter(two_model(), PERIOD),
        "stationary unsettled": SteadyStateKalmanFilter(two_model(), PERIOD, settled=False),
        "stationary continuous": SteadyStateKalmanFilter(linear_model(continuous, *TWO_NOISE, PRIOR), PERIOD),
    }


@pytest.mark.parametrize("name", every())
def test_they_conform(name):
    check_filter(every()[name], normal(6, 3, 2, seed=8), normal(6, 1, seed=9), PERIOD)
    check_filter(every()[name], normal(6, 3, 2, seed=8), normal(6, 3, 1, seed=9), PERIOD)


def test_a_continuous_observer_streams_and_keeps_its_rows_apart():
    observer = LuenbergerObserver(PLANT, double([[5.0], [6.0]]), PRIOR, double([[0.04]]), double([[0.25]]), B)
    ys, us = normal(5, 3, 1), normal(5, 3, 1, seed=1)
    dt = double([0.1, 0.2, 0.1, 0.0, 0.3])
    history = observer(ys, us, dt, record="beliefs")
    state = observer.init((3,))
    for k in range(5):
        state, _ = observer.step(state, ys[k], us[k], float(dt[k]))
        assert torch.equal(state.belief.mean, history.mean[k])
    each = observer(ys, us, dt[:, None] * double([1.0, 0.5, 2.0]))
    for row, factor in enumerate((1.0, 0.5, 2.0)):
        alone = observer(ys[:, row], us[:, row], dt * factor)
        torch.testing.assert_close(each.mean[:, row], alone.mean, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(each.covariance[:, row], alone.covariance, rtol=1e-11, atol=1e-13)
    small = observer.float()
    assert small(ys.float(), us.float(), dt.float()).mean.dtype == torch.float32


@pytest.mark.parametrize("missing", ["none", "rows"])
@pytest.mark.parametrize("name", ["stationary", "Luenberger discrete", "Luenberger continuous"])
def test_steps_compile_whole_and_map(name, missing):
    both = ss(A, B, torch.eye(2, dtype=DOUBLE))
    continuous = LuenbergerObserver(both, 0.5 * torch.eye(2, dtype=DOUBLE), PRIOR, *TWO_NOISE)
    filter = {**every(), "Luenberger continuous": continuous}[name]
    ys, us = normal(3, 2, seed=1), normal(3, 1, seed=2)
    if missing == "rows":
        ys[0, 0] = torch.nan
    belief = filter.init((3,)).belief

    def step(mean, y, u):
        after, info = filter.advance(belief._replace(mean=mean), y, u, PERIOD, missing=missing)
        return after.mean, after.covariance, info.log_likelihood

    expected = step(belief.mean, ys, us)
    found = torch.compile(step, fullgraph=True, backend="aot_eager")(belief.mean, ys, us)
    mapped = torch.func.vmap(step)(belief.mean, ys, us)
    for part, other, right in zip(found, mapped, expected, strict=True):
        torch.testing.assert_close(part, right, rtol=1e-10, atol=1e-12, equal_nan=True)
        torch.testing.assert_close(other, right, rtol=1e-10, atol=1e-12, equal_nan=True)


def test_single_precision_from_the_start():
    """Designed in float64 whatever the system: the gain is the other's, rounded."""
    small = linear_model(
        ss(*(part.float() for part in (SAMPLED.system.a, SAMPLED.system.b, C)), dt=PERIOD),
        SAMPLED.noise_covariance.float(),
        R.float(),
        tf.Gaussian(PRIOR.mean.float(), PRIOR.scale_tril.float()),
    )
    filter = SteadyStateKalmanFilter(small, PERIOD)
    torch.testing.assert_close(filter.gain.double(), SteadyStateKalmanFilter(MODEL, PERIOD).gain, rtol=1e-5, atol=0)
    assert filter(normal(4, 1).float(), normal(4, 1).float()).mean.dtype == torch.float32
    period = torch.tensor(PERIOD, dtype=DOUBLE)
    observer = LuenbergerObserver(ss(TWO.a, TWO.b, TWO.c, TWO.d, period), 0.5 * torch.eye(2, dtype=DOUBLE))
    ys, us = normal(3, 2), normal(3, 1)
    assert torch.equal(observer(ys, us).mean, observer(ys, us, PERIOD).mean)


def test_a_history_survives_a_file(tmp_path):
    filter = SteadyStateKalmanFilter(MODEL, PERIOD)
    ys, us = normal(6, 1), normal(6, 1, seed=1)
    whole, first = filter(ys, us, record="beliefs"), filter(ys[:3], us[:3], record="beliefs")
    first.save(tmp_path / "run.npz")
    loaded = tf.History.load(tmp_path / "run.npz")
    rest = filter(ys[3:], us[3:], state=loaded.final)
    torch.testing.assert_close(rest.mean, whole.mean[3:], rtol=0, atol=0)
    torch.testing.assert_close(rest.covariance, whole.covariance[3:], rtol=1e-12, atol=0)


ONE = torch.eye(2, dtype=DOUBLE)
GAIN = double([[5.0], [6.0]])
STATIC = ss(0.5 * ONE, B, C, dt=0.5)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: LuenbergerObserver(3, GAIN), TypeError, "StateSpace"),
        (lambda: LuenbergerObserver(PLANT, GAIN.mT), ValueError, r"gain must be \(2, 1\)"),
        (lambda: LuenbergerObserver(PLANT, GAIN / 0), ValueError, "gain must be finite"),
        (lambda: LuenbergerObserver(PLANT, GAIN.tolist()), TypeError, r"gain must be a tensor \(d, m\), got list"),
        (lambda: LuenbergerObserver(PLANT, GAIN, normal(3)), ValueError, r"initial must be .* got shape \(3,\)"),
        (lambda: LuenbergerObserver(PLANT, GAIN.float()), TypeError, "gain must have the system's dtype"),
        (lambda: LuenbergerObserver(ss(A.expand(3, 2, 2), B, C), GAIN), ValueError, "one system for all rows"),
        (lambda: LuenbergerObserver(PLANT, GAIN, PRIOR, ONE), ValueError, "given together"),
        (lambda: LuenbergerObserver(PLANT, GAIN, None, ONE, R), ValueError, "initial must be a Gaussian"),
        (lambda: LuenbergerObserver(PLANT, GAIN, noise_input=B), ValueError, "noise_input needs process_noise"),
        (lambda: LuenbergerObserver(PLANT, GAIN, PRIOR, -ONE, R), ValueError, "process_noise must be positive"),
        (lambda: LuenbergerObserver(PLANT, GAIN).stationary_covariance(), ValueError, "no covariance"),
        (
            lambda: LuenbergerObserver(PLANT, -GAIN, PRIOR, ONE, R).stationary_covariance(),
            ValueError,
            "the error does not die out: pole",
        ),
        (lambda: LuenbergerObserver(PLANT, GAIN)(normal(3, 1)), ValueError, "no time step"),
        (lambda: LuenbergerObserver(PLANT, GAIN)(normal(3, 2), dt=0.1), ValueError, "the measurement has 2 numbers"),
        (lambda: LuenbergerObserver(STATIC, GAIN)(normal(3, 1), dt=0.1), ValueError, "the gain belongs to the time"),
        (
            lambda: LuenbergerObserver(STATIC, GAIN)(normal(3, 2, 1), dt=0.5 * torch.ones(3, 2).double()),
            ValueError,
            "the gain belongs to one time step",
        ),
        (lambda: SteadyStateKalmanFilter(3), TypeError, "model must be a StateSpaceModel"),
        (
            lambda: SteadyStateKalmanFilter(
                tf.StateSpaceModel(PRIOR, tf.AdditiveGaussian(lambda x: x, ONE), MODEL.observation)
            ),
            TypeError,
            "needs linear laws; transition is a AdditiveGaussian",
        ),
        (lambda: SteadyStateKalmanFilter(MODEL, -1.0), ValueError, "dt must be positive"),
        (lambda: SteadyStateKalmanFilter(MODEL, PERIOD)(normal(3, 1), dt=0.1), ValueError, "the time step 0.5"),
        (
            lambda: SteadyStateKalmanFilter(
                tf.StateSpaceModel(PRIOR, tf.LinearGaussian(ONE.expand(3, 2, 2), ONE), MODEL.observation)
            ),
            ValueError,
            "one system for all rows",
        ),
        (
            lambda: SteadyStateKalmanFilter(
                tf.StateSpaceModel(PRIOR, tf.LinearGaussian(2 * ONE, ONE), tf.LinearGaussian(C, R))
            ),
            ValueError,
            "do not see the mode 2, which does not decay",
        ),
        (lambda: linear_model(PLANT, ONE, -R, PRIOR), ValueError, "positive semidefinite"),
    ],
)
def test_errors(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("plant", [PLANT, ss(0.5 * ONE, B, C, dt=PERIOD)])
@pytest.mark.parametrize("kind", ["Luenberger", "stationary", "recursive"])
def test_controls_of_another_size_are_refused(plant, kind):
    model = linear_model(plant, ONE, R, PRIOR)
    filters = {
        "Luenberger": lambda: LuenbergerObserver(plant, GAIN),
        "stationary": lambda: SteadyStateKalmanFilter(model, PERIOD),
        "recursive": lambda: tf.KalmanFilter(model),
    }
    with pytest.raises(ValueError, match=r"the control must be \(\*batch, 1\), got shape \(2,\)"):
        filters[kind]()(normal(3, 1), normal(3, 2), PERIOD)


def test_controls_that_no_law_looks_at_are_refused():
    free = ss(A, 0 * B, C)
    with pytest.raises(ValueError, match="no law of the model has an argument u"):
        LuenbergerObserver(free, GAIN)(normal(3, 1), normal(3, 1), 0.1)
    assert LuenbergerObserver(free, GAIN)(normal(3, 1), dt=0.1).mean.shape == (3, 2)
