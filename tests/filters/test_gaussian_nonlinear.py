"""Nonlinear problems: Gauss-Newton by SciPy, filterpy's EKF and UKF, angles across the cut, attitude."""

import math
import warnings

import numpy as np
import pytest
import roma
import torch
from gaussian_problem import RULES, tensor
from scipy.optimize import least_squares

import torchfilt as tf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
    from filterpy.kalman import MerweScaledSigmaPoints
    from filterpy.kalman import UnscentedKalmanFilter as FilterpyUKF

POLAR = tf.Product(tf.Euclidean(1), tf.Angle())
R = np.diag([0.05, 0.02]) ** 2
MOTION = np.array([[1, 0, 0.5, 0], [0, 1, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]])
Q = 1e-3 * np.diag([0.1, 0.1, 1, 1])
M0, P0 = np.array([-4.0, 0.8, 0.1, -0.4]), np.diag([0.1, 0.1, 0.05, 0.05])


def polar(x):
    return torch.stack([torch.hypot(x[..., 0], x[..., 1]), torch.atan2(x[..., 1], x[..., 0])], -1)


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def range_bearing(turn=0.0, space=POLAR):
    """A target that crosses the negative axis, where the bearing jumps; ``turn`` rotates the sensor's zero."""

    def seen(x):
        found = polar(x)
        return torch.stack([found[..., 0], tf.spaces.wrap_angle(found[..., 1] - turn)], -1)

    return tf.StateSpaceModel(
        tf.Gaussian(tensor(M0), torch.linalg.cholesky(tensor(P0))),
        tf.AdditiveGaussian(lambda x: x @ tensor(MOTION).mT, tensor(Q)),
        tf.AdditiveGaussian(seen, tensor(R), space),
    )


def observations(steps=12, seed=0):
    """Range and bearing of a path that starts in the second quadrant and goes to the third."""
    rng = np.random.default_rng(seed)
    x = M0 + np.linalg.cholesky(P0) @ rng.standard_normal(4)
    ys = []
    for _ in range(steps):
        x = MOTION @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(4)
        ys.append([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])] + np.sqrt(np.diag(R)) * rng.standard_normal(2))
    ys = np.array(ys)
    ys[:, 1] = wrap(ys[:, 1])
    assert ys[:, 1].max() > 2.8
    assert ys[:, 1].min() < -2.8
    return ys


@pytest.mark.parametrize("rule", RULES)
def test_bearings_across_the_cut_equal_the_sensor_turned_by_half_a_turn(rule):
    """The same data with the sensor's zero turned by pi never come near the cut: same filter to rounding."""
    ys = observations()
    turned = ys.copy()
    turned[:, 1] = wrap(ys[:, 1] - np.pi)
    assert np.abs(turned[:, 1]).max() < 1.0
    across = tf.GaussianFilter(range_bearing(), RULES[rule], 2)(tensor(ys))
    away = tf.GaussianFilter(range_bearing(math.pi), RULES[rule], 2)(tensor(turned))
    plain = tf.GaussianFilter(range_bearing(math.pi, tf.Euclidean(2)), RULES[rule], 2)(tensor(turned))
    tolerance = 1e-10 if "negative" in rule else 1e-12
    for other in (away, plain):
        torch.testing.assert_close(across.mean, other.mean, rtol=0, atol=tolerance)
        torch.testing.assert_close(across.covariance, other.covariance, rtol=0, atol=tolerance)
        torch.testing.assert_close(across.log_likelihood, other.log_likelihood, rtol=0, atol=100 * tolerance)
        torch.testing.assert_close(across.diagnostics.innovation, other.diagnostics.innovation, rtol=0, atol=tolerance)


def test_an_angle_taken_as_a_number_would_fail():
    """The test above can fail: on a Euclidean space the same data throw the filter off."""
    ys = observations()
    wrapped = tf.ExtendedKalmanFilter(range_bearing())(tensor(ys)).log_likelihood
    plain = tf.ExtendedKalmanFilter(range_bearing(space=tf.Euclidean(2)))(tensor(ys)).log_likelihood
    assert plain < wrapped - 1000


def test_an_angle_as_the_state():
    """A heading that turns past pi equals its unwrapped twin modulo a turn."""
    rate, q, r = 0.4, 0.01, 0.02
    ys = 0.4 * np.arange(1, 30) + 0.05 * np.random.default_rng(0).standard_normal(29)

    def model(space):
        return tf.StateSpaceModel(
            tf.Gaussian(tensor([0.0]), tensor([[0.3]]), space),
            tf.AdditiveGaussian(lambda x: x + rate, tensor([[q]]), space),
            tf.AdditiveGaussian(lambda x: x, tensor([[r]]), space),
        )

    for rule in RULES.values():
        found = tf.GaussianFilter(model(tf.Angle()), rule)(tensor(wrap(ys))[:, None])
        plain = tf.GaussianFilter(model(tf.Euclidean(1)), rule)(tensor(ys)[:, None])
        assert found.mean.abs().max() <= math.pi + 1e-15
        assert plain.mean.max() > 3 * math.pi
        np.testing.assert_allclose(wrap(found.mean.numpy() - plain.mean.numpy()), 0, atol=1e-10)
        torch.testing.assert_close(found.covariance, plain.covariance, rtol=0, atol=1e-10)
        torch.testing.assert_close(found.log_likelihood, plain.log_likelihood, rtol=0, atol=1e-8)


# Gauss-Newton


@pytest.mark.parametrize("seed", range(4))
def test_iterated_extended_filter_is_the_map_of_gauss_newton(seed):
    """The mean minimises the posterior's sum of squares, its covariance is the inverse of J^T J there."""
    rng = np.random.default_rng(seed)
    mean, root = np.array([1.5, 0.5]), np.linalg.cholesky([[0.3, 0.1], [0.1, 0.4]])
    noise = np.array([0.05, 0.02])
    truth = mean + root @ rng.standard_normal(2)
    y = np.array([np.hypot(*truth), np.arctan2(truth[1], truth[0])]) + noise * rng.standard_normal(2)

    def residual(x):
        gap = y - np.array([np.hypot(*x), np.arctan2(x[1], x[0])])
        gap[1] = wrap(gap[1])
        return np.concatenate([gap / noise, np.linalg.solve(root, x - mean)])

    best = least_squares(residual, mean, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    law = tf.AdditiveGaussian(polar, scale_tril=torch.diag(tensor(noise)), space=POLAR)
    prior = tf.Gaussian(tensor(mean), tensor(root))
    found = tf.moments.update(law, prior, tensor(y), tf.moments.taylor(), "none", iterations=60).belief
    single = tf.moments.update(law, prior, tensor(y), tf.moments.taylor(), "none").belief
    # SciPy's own derivatives are finite differences: it stops at about sqrt(eps) of the residual's scale.
    np.testing.assert_allclose(found.mean.numpy(), best.x, rtol=0, atol=1e-7)
    assert np.abs(single.mean.numpy() - best.x).max() > 1e-4
    radius = np.hypot(*found.mean.numpy())
    a, b = found.mean.numpy()
    jacobian = np.array([[a / radius, b / radius], [-b / radius**2, a / radius**2]]) / noise[:, None]
    precision = jacobian.T @ jacobian + np.linalg.inv(root @ root.T)
    np.testing.assert_allclose(found.covariance.numpy() @ precision, np.eye(2), rtol=0, atol=1e-9)
    # Stationary: the gradient of the sum of squares vanishes at the filter's mean.
    full = np.concatenate([-jacobian, np.linalg.inv(root)])
    gradient = full.T @ residual(found.mean.numpy())
    np.testing.assert_allclose(gradient, 0, atol=1e-8)


# filterpy


def jacobian(x):
    radius = np.hypot(x[0], x[1])
    return np.array([[x[0] / radius, x[1] / radius, 0, 0], [-x[1] / radius**2, x[0] / radius**2, 0, 0]])


def seen(x):
    return np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])])


def gap(a, b):
    difference = a - b
    difference[1] = wrap(difference[1])
    return difference


def test_filterpy_extended_kalman_filter():
    """Range and bearing across the cut, 12 steps: means, covariances, likelihood to 1e-9."""
    ys = observations()
    history = tf.ExtendedKalmanFilter(range_bearing())(tensor(ys))
    witness = FilterpyEKF(4, 2)
    witness.x, witness.P, witness.Q, witness.R, witness.F = M0.copy(), P0.copy(), Q, R, MOTION
    for k, y in enumerate(ys):
        witness.predict()
        witness.update(y, jacobian, seen, residual=gap)
        np.testing.assert_allclose(history.mean[k].numpy(), witness.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(history.covariance[k].numpy(), witness.P, rtol=0, atol=1e-9)
        found = history.diagnostics.log_likelihood[k].item()
        assert found == pytest.approx(witness.log_likelihood, abs=1e-9)


@pytest.mark.parametrize("alpha", [1.0, 0.1])
def test_filterpy_unscented_kalman_filter(alpha):
    """The same with its own sigma points; it reuses predicted points only if asked, so it draws them anew here.

    A wrapped mean of bearings by sine and cosine differs from the intrinsic one by the cube of the spread, so the
    bearings' mean is the one around the centre point.
    """
    ys = observations()
    history = tf.UnscentedKalmanFilter(range_bearing(), alpha, 2.0, 0.0)(tensor(ys))

    def centred_mean(points, weights):
        offset = np.array([gap(point, points[0]) for point in points])
        mean = points[0] + weights @ offset
        mean[1] = wrap(mean[1])
        return mean

    points = MerweScaledSigmaPoints(4, alpha, 2.0, 0.0)
    witness = FilterpyUKF(
        4, 2, 1.0, hx=seen, fx=lambda x, dt: MOTION @ x, points=points, z_mean_fn=centred_mean, residual_z=gap
    )
    witness.x, witness.P, witness.Q, witness.R = M0.copy(), P0.copy(), Q, R
    for k, y in enumerate(ys):
        witness.predict()
        witness.sigmas_f = points.sigma_points(witness.x, witness.P)
        witness.update(y)
        np.testing.assert_allclose(history.mean[k].numpy(), witness.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(history.covariance[k].numpy(), witness.P, rtol=0, atol=1e-9)


# Attitude


def attitude_model(side="right"):
    """Attitude and a constant gyro bias, turned by a known rate; two known directions are seen in body axes."""
    space = tf.Product(tf.UnitQuaternion(side), tf.Euclidean(3))
    north, down = tensor([1.0, 0.0, 0.3]), tensor([0.0, 0.0, 1.0])

    def motion(x, u, dt):
        q, bias = x[..., :4], x[..., 4:]
        turn = roma.rotvec_to_unitquat((u - bias) * dt)
        q, turn = torch.broadcast_tensors(q, turn)
        return torch.cat([roma.quat_product(q, turn), bias], -1)

    def sees(x):
        inverse = roma.quat_conjugation(x[..., :4])
        return torch.cat([roma.quat_action(inverse, v.expand_as(x[..., :3])) for v in (north, down)], -1)

    prior = tf.Gaussian(tensor([0.0, 0, 0, 1, 0, 0, 0]), torch.diag(tensor([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])), space)
    noise = torch.diag(tensor([0.005] * 3 + [1e-4] * 3))
    return tf.StateSpaceModel(
        prior,
        tf.AdditiveGaussian(motion, scale_tril=noise, space=space),
        tf.AdditiveGaussian(sees, scale_tril=0.02 * torch.eye(6, dtype=torch.float64)),
    )


def attitude_runs(runs=60, steps=60, dt=0.2):
    model = attitude_model()
    generator = torch.Generator().manual_seed(5)

    def normal(size):
        return torch.randn(runs, size, generator=generator, dtype=torch.float64)

    prior = model.prior()
    x = tf.Gaussian(prior.mean.expand(runs, 7), prior.scale_tril, prior.space).sample(normal(6))
    t = dt * torch.arange(steps, dtype=torch.float64)
    rates = torch.stack([torch.sin(t), 0.5 * torch.cos(0.7 * t), 0.8 * torch.ones_like(t)], -1)
    truth, ys = [], []
    for k in range(steps):
        x = model.transition(x, rates[k], dt).sample(normal(6))
        truth.append(x)
        ys.append(model.observation(x).sample(normal(6)))
    return model, torch.stack(truth), torch.stack(ys), rates, dt


@pytest.fixture(scope="module")
def attitude():
    return attitude_runs()


@pytest.mark.parametrize("rule", ["taylor", "unscented", "unscented-negative-centre", "cubature"])
def test_attitude_filter_is_consistent_and_keeps_unit_norm(rule, attitude):
    """60 runs whose truth is drawn from the model, with two full turns and more.

    The mean over runs of e^T P^-1 e at the last step is a chi-squared of 360 degrees of freedom divided by 60: 5
    deviations are allowed, 6 +- 5 sqrt(12 / 60) = 6 +- 2.2, with false alarms below 1e-6; likewise the innovations,
    where linearisation adds up to 0.1.
    """
    model, truth, ys, rates, dt = attitude
    history = tf.GaussianFilter(model, RULES[rule])(ys, rates, dt)
    norm = torch.linalg.vector_norm(history.mean[..., :4], dim=-1)
    torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=4e-15)
    error = history.space.local(history.mean[-1], truth[-1])
    nees = (error * torch.linalg.solve(history.covariance[-1], error.unsqueeze(-1)).squeeze(-1)).sum(-1)
    assert abs(nees.mean() - 6) < 5 * (12 / 60) ** 0.5
    nis = history.diagnostics.nis[20:].mean()
    assert abs(nis - 6) < 5 * (12 / (40 * 60)) ** 0.5 + 0.1
    # It learns: attitude to a fraction of the first error, bias below its prior.
    first = history.space.local(model.prior().mean, truth[0])
    assert error[:, :3].square().mean() < 0.01 * first[:, :3].square().mean()
    deviation = history.covariance[-1].diagonal(dim1=-2, dim2=-1).sqrt()
    assert (deviation[:, 3:] < 0.02).all()


def test_signs_of_a_quaternion_do_not_matter(attitude):
    """A prior mean q or -q: the same rotations, the same likelihood."""
    model, _, ys, rates, dt = attitude
    filter = tf.UnscentedKalmanFilter(model)
    state = filter.init((5,))
    flipped = state._replace(belief=state.belief._replace(mean=state.belief.mean * tensor([-1.0] * 4 + [1.0] * 3)))
    one, two = (filter(ys[:20, :5], rates[:20], dt, state=s) for s in (state, flipped))
    torch.testing.assert_close(one.mean[..., :4].abs(), two.mean[..., :4].abs(), rtol=0, atol=1e-12)
    torch.testing.assert_close(one.log_likelihood, two.log_likelihood, rtol=0, atol=1e-9)


def test_a_star_tracker_measures_a_quaternion():
    """A measurement that lives on the sphere: half of its numbers missing means all of it missing."""
    space = tf.UnitQuaternion()
    eye = torch.eye(3, dtype=torch.float64)
    model = tf.StateSpaceModel(
        tf.Gaussian(tensor([0.0, 0, 0, 1]), 0.5 * eye, space),
        tf.AdditiveGaussian(lambda x: x, scale_tril=0.01 * eye, space=space),
        tf.AdditiveGaussian(lambda x: x, scale_tril=0.1 * eye, space=space),
    )
    y = roma.rotvec_to_unitquat(tensor([0.3, -0.2, 0.1]))
    series = torch.stack([y, -y, torch.cat([y[:2], tensor([torch.nan] * 2)]), y])
    for rule in ("taylor", "unscented", "cubature"):
        history = tf.GaussianFilter(model, RULES[rule])(series)
        assert history.diagnostics.log_likelihood[2] == 0
        assert history.covariance.shape == (4, 3, 3)
        assert history.diagnostics.innovation.shape == (4, 3)
        # Isotropic about the identity: the gain of the first step is that of a scalar filter along the axis.
        gain = (0.25 + 1e-4) / (0.25 + 1e-4 + 0.01)
        turned = roma.unitquat_to_rotvec(history.mean[0])
        torch.testing.assert_close(turned, gain * tensor([0.3, -0.2, 0.1]), rtol=0, atol=1e-9)
