"""Gates: sensor by sensor, in single Gaussians and in banks; what they refuse and how often."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

import torchfilt as tf
from torchfilt.moments import taylor
from torchfilt.resampling import never
from torchfilt.robust import decisions

F64 = torch.float64
EYE = torch.eye(2, dtype=F64)
FIRST, SECOND = (torch.eye(2, dtype=F64)[k : k + 1] for k in range(2))


def walk(gauge=None):
    """Two numbers that walk; sensor a sees the first, sensor b both."""
    b = tf.LinearGaussian(EYE, torch.tensor([[0.5, 0.3], [0.3, 0.5]], dtype=F64))
    sensors = tf.Sensors(a=tf.LinearGaussian(FIRST, 0.4 * EYE[:1, :1]), b=b)
    return tf.StateSpaceModel(tf.Gaussian(torch.zeros(2, dtype=F64), EYE), tf.LinearGaussian(EYE, 0.2 * EYE), sensors)


def reference(ys, level, density):
    """NumPy: each sensor tested by its own chi-square, what passes taken in together."""
    m, P = np.zeros(2), np.eye(2)
    H = np.array([[1.0, 0], [1, 0], [0, 1]])
    R = np.zeros((3, 3))
    R[0, 0], R[1:, 1:] = 0.4, [[0.5, 0.3], [0.3, 0.5]]
    out, total = [], 0.0
    for y in ys:
        P = P + 0.2 * np.eye(2)
        kept, verdict = [], []
        for part in ([0], [1, 2]):
            S = H[part] @ P @ H[part].T + R[np.ix_(part, part)]
            e = y[part] - H[part] @ m
            there = ~np.isnan(e)
            nis = e[there] @ np.linalg.solve(S[np.ix_(there, there)], e[there]) if there.any() else 0.0
            good = not there.any() or nis <= stats.chi2.ppf(level, there.sum())
            verdict.append(good)
            total += 0.0 if good else density
            kept += [k for k, t in zip(part, there, strict=True) if t and good]
        if kept:
            S = H[kept] @ P @ H[kept].T + R[np.ix_(kept, kept)]
            e = y[kept] - H[kept] @ m
            K = P @ H[kept].T @ np.linalg.inv(S)
            m, P = m + K @ e, P - K @ S @ K.T
            total += stats.multivariate_normal(np.zeros(len(kept)), S).logpdf(e)
        out.append((m, P, verdict))
    return out, total


def data():
    rng = np.random.default_rng(5)
    x = np.cumsum(0.4 * rng.normal(size=(60, 2)), 0)
    ys = x[:, [0, 0, 1]] + 0.6 * rng.normal(size=(60, 3))
    ys[10, 0], ys[20, 2], ys[30] = 9.0, -8.0, 7.0
    ys[40], ys[45, 1], ys[50, 0] = np.nan, np.nan, np.nan
    return ys


@pytest.mark.parametrize(
    "make",
    [
        tf.KalmanFilter,
        tf.ExtendedKalmanFilter,
        tf.ErrorStateKalmanFilter,
        tf.UnscentedKalmanFilter,
        tf.CubatureKalmanFilter,
        tf.GaussHermiteKalmanFilter,
    ],
)
def test_every_gaussian_filter_takes_a_gate(make):
    ys = torch.from_numpy(data())
    history = make(walk(), gate=tf.Gate(0.99, -3.0))(ys)
    plain = tf.GaussianFilter(walk(), taylor(), gate=tf.Gate(0.99, -3.0))(ys)
    assert torch.equal(history.diagnostics.accepted, plain.diagnostics.accepted) and history.evidence == "approximate"
    torch.testing.assert_close(history.mean, plain.mean, rtol=0, atol=1e-12)


def test_each_sensor_is_tested_on_its_own():
    ys = data()
    tracker = tf.GaussianFilter(walk(), taylor(), gate=tf.Gate(0.99, -3.0))
    history = tracker(torch.tensor(ys).unsqueeze(1))
    expected, total = reference(ys, 0.99, -3.0)
    report = history.diagnostics
    assert report.accepted.shape == report.gate_nis.shape == (60, 1, 2)
    assert report.accepted[:, 0].tolist() == [verdict for *_, verdict in expected]
    assert report.accepted[10, 0].tolist() == [False, True] and report.accepted[20, 0].tolist() == [True, False]
    # Sixty steps of a stable recursion.
    np.testing.assert_allclose(history.mean[:, 0], [m for m, *_ in expected], rtol=0, atol=1e-12)
    np.testing.assert_allclose(history.covariance[-1, 0], expected[-1][1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(history.log_likelihood[0], total, rtol=1e-12)
    assert history.evidence == "approximate"


def test_only_the_sensors_that_are_named_are_tested():
    ys = torch.tensor(data()).unsqueeze(1)
    report = tf.GaussianFilter(walk(), taylor(), gate=tf.Gate(0.99, sensors=("b",)))(ys).diagnostics
    assert bool(report.accepted[..., 0].all()) and not bool(report.accepted[20, 0, 1])


def test_a_bank_decides_member_by_member():
    """Weights against the densities of two members, of which the far one refuses."""
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(1, dtype=F64), EYE[:1, :1]),
        tf.LinearGaussian(EYE[:1, :1], 0.01 * EYE[:1, :1]),
        tf.Sensors(a=tf.LinearGaussian(EYE[:1, :1], 0.01 * EYE[:1, :1])),
    )
    tracker = tf.LocallyLinearizedParticleFilter(
        model, 2, taylor(), resampler=never(), gate=tf.Gate(0.999, {"a": -4.0})
    )
    x = torch.tensor([[0.0], [5.0]], dtype=F64)
    bank = tf.Particles(x, torch.full((2,), math.log(0.5), dtype=F64), 0.1 * torch.ones(2, 1, 1, dtype=F64))
    state = tracker.init()._replace(belief=bank)
    state, info = tracker.step(state, {"a": torch.tensor([0.1], dtype=F64)})
    S = 0.01 + 0.01 + 0.01
    near = stats.norm(0, math.sqrt(S)).logpdf(0.1)
    weights = np.exp([near, -4.0])
    np.testing.assert_allclose(state.belief.weights, weights / weights.sum(), rtol=1e-12)
    np.testing.assert_allclose(info.log_likelihood, math.log(weights.sum() / 2), rtol=1e-12)
    np.testing.assert_allclose(state.belief.x[:, 0], [0.1 * 0.02 / S, 5.0], rtol=0, atol=1e-14)
    assert info.accepted.tolist() == [True]
    state, info = tracker.step(state, {"a": torch.tensor([-30.0], dtype=F64)})
    assert info.accepted.tolist() == [False] and info.gate_nis.item() > 1000


def test_the_log_of_decisions():
    ys = torch.tensor(data()).unsqueeze(1)
    history = tf.GaussianFilter(walk(), taylor(), gate=0.99)(ys)
    found = list(decisions(history, ("a", "b")))
    assert len(found) == int((~history.diagnostics.accepted).sum())
    assert (10, (0,), "a") in [(d.step, d.row, d.sensor) for d in found]
    assert all(d.gate_nis > stats.chi2.ppf(0.99, 1) and not d.restarted for d in found)
    with pytest.raises(ValueError, match="names must be 2, one a sensor"):
        list(decisions(history))
    with pytest.raises(ValueError, match="ran without a gate"):
        list(decisions(tf.GaussianFilter(walk(), taylor())(ys)))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: tf.Gate(1.0), ValueError, r"gate must be a probability in \(0, 1\) or None, got 1.0"),
        (lambda: tf.Gate(0.9, math.inf), ValueError, "outlier_log_density must be finite, got inf"),
        (lambda: tf.Gate(0.9, {"a": math.nan}), ValueError, "outlier_log_density must be finite, got nan"),
        (lambda: tf.Gate(sensors="beacon"), TypeError, r"sensors must be names, such as \('beacon',\)"),
        (lambda: tf.GaussianFilter(walk(), taylor(), gate="a"), TypeError, "gate must be a Gate, .* got str"),
        (lambda: tf.GaussianFilter(walk(), taylor(), gate=True), TypeError, "gate must be a Gate, .* got bool"),
        (lambda: tf.LocallyLinearizedParticleFilter(walk(), gate=tf.Gate()), ValueError, "needs outlier_log_density"),
        (
            lambda: tf.LocallyLinearizedParticleFilter(
                walk(), gate=tf.Gate(0.9, 0.0), redraw="always", split=None, weights="joint"
            ),
            ValueError,
            "a gate goes with marginal weights",
        ),
        (
            lambda: tf.GaussianFilter(walk(), taylor(), gate=tf.Gate(sensors=("c",)))(torch.zeros(1, 3, dtype=F64)),
            ValueError,
            "the gate names a sensor 'c', the measurement law has a, b",
        ),
    ],
)
def test_gates_that_make_no_sense(make, error, message):
    with pytest.raises(error, match=message):
        make()
