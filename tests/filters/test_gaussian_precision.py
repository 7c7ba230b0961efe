"""Long runs and single precision: factors stay factors, numbers stay at the accuracy of their precision."""

import numpy as np
import pytest
import torch
from gaussian_problem import RULES, tensor
from oracles import kalman_oracle

import torchfilt as tf

STEP = 0.1
MOTION = np.array([[1, STEP, STEP**2 / 2], [0, 1, STEP], [0, 0, 1]])
INPUT = np.array([STEP**3 / 6, STEP**2 / 2, STEP])


def tracking(dtype, noise, jerk, form="linear"):
    """Position, velocity and acceleration; measured positions with standard deviation ``noise``, prior variances of 1.

    The process noise has rank one: a random jerk held over the step.
    """
    motion, h = tensor(MOTION, dtype), torch.eye(1, 3, dtype=dtype)
    r, q = torch.full((1, 1), noise, dtype=dtype), torch.zeros(3, 3, dtype=dtype)
    q[:, 0] = tensor(INPUT * jerk, dtype)
    prior = tf.Gaussian(torch.zeros(3, dtype=dtype), torch.eye(3, dtype=dtype))
    if form == "linear":
        return tf.StateSpaceModel(prior, tf.LinearGaussian(motion, scale_tril=q), tf.LinearGaussian(h, scale_tril=r))
    return tf.StateSpaceModel(
        prior,
        tf.AdditiveGaussian(lambda x: x @ motion.mT, scale_tril=q),
        tf.AdditiveGaussian(lambda x: x[..., :1], scale_tril=r),
    )


def positions(steps, noise, seed=0):
    """Measured positions (t, 1) of a path of size one."""
    t = STEP * np.arange(1, steps + 1)
    return (np.sin(0.3 * t) + noise * np.random.default_rng(seed).standard_normal(steps))[:, None]


def definite(factor):
    """Lowest eigenvalue of S S^T, formed in float64 and scaled to correlations, over all steps."""
    factor = factor.double()
    covariance = factor @ factor.mT
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    return torch.linalg.eigvalsh(covariance / (scale.unsqueeze(-1) * scale.unsqueeze(-2)))[..., 0].min()


def rounding_bounds(noise, jerk, node, eps):
    """Bounds of what rounding leaves in the steady filter: error of the mean (3,), error of the variances (3,); and the
    steady variances (3,) and innovation variance.

    One step makes fresh errors; the closed loop A = (I - K H) F carries them on, so they add up to sum |A^k| e for the
    mean and sum |A^k| E |A^k|^T for the covariance. Fresh: the mean and the data are rounded 4 times (product, sum,
    innovation, gain); a factor's row i by 16 eps of its size (a QR of 3 x 8 numbers), and where the law is seen through
    points x +- node S, by eps |x| / node more, because the points are rounded at the size of x.
    """
    q, h = jerk**2 * np.outer(INPUT, INPUT), np.eye(3)[0]
    p = np.eye(3)
    for _ in range(3000):
        before = MOTION @ p @ MOTION.T + q
        gain = before @ h / (before[0, 0] + noise**2)
        p = before - np.outer(gain, before[0])
    loop = (np.eye(3) - np.outer(gain, h)) @ MOTION
    assert np.abs(np.linalg.eigvals(loop)).max() < 0.97
    size = np.array([1.0, 0.3, 0.09])  # of the path and its derivatives
    fresh_mean = 4 * eps * (size + np.abs(gain))
    deviation = np.sqrt(np.diag(before))
    row = 16 * eps * deviation + (0 if node is None else 3 * eps * size / node)
    fresh = np.outer(row, deviation) + np.outer(deviation, row)
    mean, variance, power = np.zeros(3), np.zeros((3, 3)), np.eye(3)
    for _ in range(3000):
        mean += np.abs(power) @ fresh_mean
        variance += np.abs(power) @ fresh @ np.abs(power).T
        power = power @ loop
    return mean, np.diag(variance), np.diag(p), before[0, 0] + noise**2


NODES = {"taylor": None, "unscented": 3**0.5, "cubature": 3**0.5, "gauss-hermite": 3**0.5}


def check_single_precision(rule, steps, form):
    noise, jerk = 1e-4, 0.05
    ys = positions(steps, noise)
    exact = tf.KalmanFilter(tracking(torch.float64, noise, jerk))(tensor(ys))
    filter = tf.GaussianFilter(tracking(torch.float32, noise, jerk, form), RULES[rule])
    found = filter(tensor(ys, torch.float32), record="beliefs")
    factor = found.beliefs.scale_tril
    assert factor.dtype == found.mean.dtype == found.diagnostics.nis.dtype == torch.float32
    assert torch.isfinite(factor).all()
    assert definite(factor) > 0
    node = None if form == "linear" else NODES[rule]
    mean, variance, steady, innovation = rounding_bounds(noise, jerk, node, 2**-24)
    after = slice(300, None)  # the bounds are those of the steady filter
    np.testing.assert_array_less((found.mean.double() - exact.mean)[after].abs().amax(0).numpy(), mean)
    variances = [h.covariance.double().diagonal(dim1=-2, dim2=-1)[after] for h in (found, exact)]
    np.testing.assert_allclose(variances[1][-1].numpy(), steady, rtol=1e-6)
    np.testing.assert_array_less((variances[0] - variances[1]).abs().amax(0).numpy(), variance)
    # log N(z) changes by |z| dz + (1 + z^2) ds / 2; the errors below are the shares of a standard deviation.
    z = exact.diagnostics.nis.sqrt()[after]
    dz = (mean[0] + 3 * 2**-24) / innovation**0.5
    ds = 2 * variance[0] / innovation + 16 * 2**-24
    bound = (z * dz + (1 + z**2) * ds / 2 + 2**-22 * 10).sum().item()
    error = (found.diagnostics.log_likelihood.double() - exact.diagnostics.log_likelihood)[after].sum().item()
    assert abs(error) < bound


@pytest.mark.parametrize("rule", NODES)
def test_single_precision(rule):
    check_single_precision(rule, 600, "functions")


def test_single_precision_of_linear_laws():
    check_single_precision("taylor", 1000, "linear")


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "form"), [("taylor", "linear"), ("unscented", "functions")])
def test_single_precision_over_ten_thousand_steps(rule, form):
    check_single_precision(rule, 10_000, form)


@pytest.mark.parametrize("steps", [600, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_negative_centre_weight_in_single_precision_stays_definite(steps):
    """Small alpha (0.05) multiplies rounding by 1 / alpha^2 = 400: eps |x| 400 = 2.4e-5 is a quarter of the standard
    deviation of a position here. Nothing can be said of accuracy, but a factor is what comes out, or a status.
    """
    filter = tf.GaussianFilter(tracking(torch.float32, 1e-4, 0.05, "functions"), RULES["unscented-negative-centre"])
    found = filter(tensor(positions(steps, 1e-4), torch.float32), record="beliefs", throw=False)
    ok = found.diagnostics.ok
    factor = found.beliefs.scale_tril
    assert torch.equal(ok, torch.isfinite(factor).flatten(1).all(1))
    assert definite(factor[ok]) > 0


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "jerk"), [(1e-4, 0.05), (1e-8, 10.0), (1.0, 0.0)])
def test_twenty_thousand_steps_in_double_precision(noise, jerk):
    """Against the covariance form in extended precision; ordinary, nearly exact measurements, and no process noise."""
    steps = 20_000
    ys = positions(steps, noise) if jerk else np.random.default_rng(1).standard_normal((steps, 1))
    q, h = jerk**2 * np.outer(INPUT, INPUT), np.eye(3)[0]
    wide = kalman_oracle.kalman_scalar(np.zeros(3), np.eye(3), MOTION, q, h, noise**2, ys[:, 0])
    found = tf.KalmanFilter(tracking(torch.float64, noise, jerk))(tensor(ys), record="beliefs")
    assert torch.isfinite(found.beliefs.scale_tril).all()
    deviation = np.sqrt(np.diag(wide.covariance).astype(float))
    # No process noise: nothing is forgotten, one rounding a step adds up. Numbers of size one are rounded at eps.
    eps = 2**-53
    lost, placed = steps * eps, 8 * eps / deviation
    error = np.abs(found.mean[-1].numpy() - wide.mean.astype(float)) / deviation
    np.testing.assert_array_less(error, lost + placed)
    factor = found.final.belief.scale_tril.numpy() / deviation[:, None]
    correlation = (wide.covariance / np.outer(deviation, deviation)).astype(float)
    np.testing.assert_allclose(factor @ factor.T, correlation, rtol=0, atol=2 * lost)
    expected = float(wide.log_likelihood.sum())
    assert abs(found.log_likelihood.item() - expected) < lost * abs(expected) + placed[0] * steps**0.5
