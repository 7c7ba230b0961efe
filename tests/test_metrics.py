"""Metrics against SciPy and hand-made cases."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from particle_problem import PLANE, state_space, tensor
from scipy import stats
from scipy.spatial.distance import mahalanobis

import torchfilt as tf
from torchfilt import metrics
from torchfilt.spaces import Angle, Euclidean, Product


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_rmse_by_groups():
    error = normal(50, 4, 6)
    found = metrics.rmse(error, {"position_m": [0, 1, 2], "velocity_m_s": slice(3, None), "last": [-1]})
    e = error.numpy()
    np.testing.assert_allclose(found["position_m"], np.sqrt((e[..., :3] ** 2).sum(-1).mean(0)), rtol=1e-14)
    np.testing.assert_allclose(found["velocity_m_s"], np.sqrt((e[..., 3:] ** 2).sum(-1).mean(0)), rtol=1e-14)
    np.testing.assert_allclose(found["last"], np.sqrt((e[..., 5] ** 2).mean(0)), rtol=1e-14)
    whole = metrics.rmse(error, dim=(0, 1))["error"]
    np.testing.assert_allclose(whole, np.sqrt((e**2).sum(-1).mean()), rtol=1e-14)
    with pytest.raises(ValueError, match=r"group 'far' .* error of 6, got \[7\]"):
        metrics.rmse(error, {"far": [7]})
    with pytest.raises(ValueError, match=r"group 'none' .* got \[\]"):
        metrics.rmse(error, {"none": []})
    with pytest.raises(ValueError, match=r"dim must leave out the coordinates.* got -1"):
        metrics.rmse(error, dim=-1)


def test_nees_is_the_squared_mahalanobis_distance():
    a = normal(7, 3, 3, seed=1)
    covariance = a @ a.mT + 0.1 * torch.eye(3)
    estimate, truth = normal(7, 3, seed=2), normal(7, 3, seed=3)
    found = metrics.nees(estimate, truth, covariance)
    for k in range(7):
        expected = mahalanobis(estimate[k], truth[k], np.linalg.inv(covariance[k].numpy())) ** 2
        assert found[k].item() == pytest.approx(expected, rel=1e-11)
    shared = metrics.nees(estimate, truth, covariance[0])
    assert shared.shape == (7,) and shared[0].item() == pytest.approx(found[0].item(), rel=1e-12)
    assert metrics.nees(estimate[0], truth[0], covariance[0]).shape == ()
    assert metrics.nees(estimate, truth, -covariance).isnan().all()


def test_nees_lives_on_the_space():
    """Angles 0.02 apart across the seam are 0.02 apart."""
    space = Product(Angle(1), Euclidean(1))
    found = metrics.nees(tensor([np.pi - 0.01, 1.0]), tensor([-np.pi + 0.01, 3.0]), tensor([[1e-4, 0], [0, 4]]), space)
    assert found.item() == pytest.approx(0.02**2 / 1e-4 + 4 / 4, rel=1e-9)


def test_nis_is_what_the_filters_report():
    """A 2-component sensor with gaps."""
    model = state_space(PLANE._replace(H=np.array([[1.0, 0.5], [0.0, 1.0]]), R=np.diag([0.5, 0.4])))
    ys = normal(20, 3, 2, seed=4)
    ys[3, 1, 0] = ys[4] = torch.nan
    history = tf.UnscentedKalmanFilter(model)(ys)
    info = history.diagnostics
    found = metrics.nis(info.innovation, info.innovation_scale_tril, ~torch.isnan(ys))
    np.testing.assert_allclose(found, info.nis, rtol=1e-12, atol=1e-14)
    linear = tf.KalmanFilter(model)(normal(3, 3, 2, seed=4)).diagnostics
    assert linear.innovation_scale_tril.shape == (3, 2, 2)  # one factor a step for all rows
    np.testing.assert_allclose(metrics.nis(linear.innovation, linear.innovation_scale_tril), linear.nis, rtol=1e-12)
    with pytest.raises(ValueError, match="zero where nothing was measured"):
        metrics.nis(info.innovation + 1, info.innovation_scale_tril, ~torch.isnan(ys))


@pytest.mark.parametrize(("freedom", "count", "confidence"), [(6, 10, 0.95), (3, 1, 0.99), (2, 1000, 0.9)])
def test_band_is_scipys(freedom, count, confidence):
    band = metrics.chi_square_band(freedom, count, confidence)
    low, high = stats.chi2.interval(confidence, freedom * count)
    assert (band.low, band.high) == (pytest.approx(low / count), pytest.approx(high / count))
    assert band.low < band.expected == freedom < band.high


def test_band_holds_its_confidence():
    """2000 means of 5 chi-square values with 4 degrees of freedom: coverage within 4.5 standard errors of 90 %."""
    draws = np.random.default_rng(0).chisquare(4, (2000, 5)).mean(1)
    band = metrics.chi_square_band(4, 5, 0.9)
    share = ((draws > band.low) & (draws < band.high)).mean()
    assert abs(share - 0.9) < 4.5 * (0.9 * 0.1 / 2000) ** 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1), "must be positive, got 0 and 1"),
        ((1, -1), "must be positive, got 1 and -1"),
        ((1, 1, 1.0), r"confidence must be in \(0, 1\), got 1.0"),
    ],
)
def test_bad_bands(arguments, message):
    with pytest.raises(ValueError, match=message):
        metrics.chi_square_band(*arguments)


@pytest.mark.parametrize(("claimed", "verdict"), [(0.5, "overconfident"), (1.0, "consistent"), (2.0, "underconfident")])
def test_consistency_in_words(claimed, verdict):
    """Errors of unit variance, 6 of them, claimed to be half as large, as they are, twice as large."""
    error = normal(100, 50, 6, seed=5)
    values = metrics.nees(torch.zeros_like(error), error, claimed**2 * torch.eye(6, dtype=torch.float64))
    found = metrics.consistency(values, 6, confidence=0.999)
    assert found.verdict == verdict and str(found).startswith(f"{verdict}: the errors are")
    assert found.mean == pytest.approx(6 / claimed**2, rel=0.03)
    assert found.runs == 50 and found.mean_in_time.shape == (100,)
    assert (found.inside > 0.95) == (verdict == "consistent")
    low, high = stats.chi2.interval(0.999, 6 * 50)
    assert (found.band.low, found.band.high) == (pytest.approx(low / 50), pytest.approx(high / 50))
    if verdict == "overconfident":
        assert "2.00 times" in str(found) or "1.99 times" in str(found) or "2.01 times" in str(found)


def test_consistency_counts_what_is_independent():
    values = torch.full((40, 5), 3.3, dtype=torch.float64)
    assert metrics.consistency(values, 3).verdict == "consistent"
    white = metrics.consistency(values, 3, effective_steps=40, name="NIS")
    low, high = stats.chi2.interval(0.95, 3 * 200)
    assert (white.band.low, white.band.high) == (pytest.approx(low / 200), pytest.approx(high / 200))
    assert "mean NIS" in str(white)
    holes = values.clone()
    holes[::2] = torch.nan
    half = metrics.consistency(holes, 3, effective_steps=40)
    low, high = stats.chi2.interval(0.95, 3 * 100)
    assert (half.band.low, half.band.high) == (pytest.approx(low / 100), pytest.approx(high / 100))
    assert half.mean == pytest.approx(3.3) and half.mean_in_time[::2].isnan().all() and half.inside == 1
    with pytest.raises(ValueError, match=r"effective_steps must be in \(0, 40\], got 41"):
        metrics.consistency(values, 3, effective_steps=41)
    with pytest.raises(ValueError, match="finite"):
        metrics.consistency(values * torch.nan, 3)
    with pytest.raises(ValueError, match=r"got \(0,\)"):
        metrics.consistency(torch.zeros(0), 3)


def test_a_kalman_filter_on_its_own_model_is_consistent():
    """300 simulated runs; NEES with 99.9 % bands, NIS white in time. A wrong process noise is caught, both ways."""
    rows, steps = 300, 30
    A, Q, H, R, m0, P0 = (tensor(part) for part in PLANE)
    x = m0 + normal(rows, 2, seed=6) @ torch.linalg.cholesky(P0).mT
    states, ys = [], []
    for k in range(steps):
        x = x @ A.mT + normal(rows, 2, seed=100 + k) @ torch.linalg.cholesky(Q).mT
        states.append(x)
        ys.append(x @ H.mT + normal(rows, 1, seed=200 + k) * R.sqrt())
    truth, ys = torch.stack(states), torch.stack(ys)
    verdicts = {}
    for factor in (0.3, 1.0, 3.0):
        history = tf.KalmanFilter(state_space(PLANE._replace(Q=factor * PLANE.Q)))(ys)
        values = metrics.nees(history.mean, truth, history.covariance)
        verdicts[factor] = metrics.consistency(values, 2, confidence=0.999).verdict
        white = metrics.consistency(history.diagnostics.nis, 1, confidence=0.999, effective_steps=steps, name="NIS")
        assert white.verdict == verdicts[factor]
    assert verdicts == {0.3: "overconfident", 1.0: "consistent", 3.0: "underconfident"}


def test_scipy_is_loaded_on_use_only():
    code = "import sys, torchfilt; torchfilt.metrics; print('scipy.stats' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
