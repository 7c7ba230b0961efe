"""Laws of continuous-time systems: against SciPy's ODE solver, closed forms and torchdiffeq."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import torchfilt as tf
from torchfilt.models.control import (
    ContinuousLinear,
    ContinuousTransition,
    integrate_noise,
    linear_model,
    noise_factor,
    ss,
)
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion
from torchfilt.testing import check_filter, check_law

DOUBLE = torch.float64
INTEGRATOR = torch.tensor([[0.0, 1.0], [0.0, 0.0]], dtype=DOUBLE)
DOWN = torch.tensor([[0.0], [1.0]], dtype=DOUBLE)
EPS = torch.finfo(DOUBLE).eps


def double(values):
    return torch.tensor(values, dtype=DOUBLE)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def oracle_noise(a, gqg, dt):
    """The covariance's own ODE, by Kronecker products: exact for linear systems, no torchfilt."""
    d = len(a)
    big = np.zeros((d * d + 1, d * d + 1))
    big[:-1, :-1] = dt * (np.kron(a, np.eye(d)) + np.kron(np.eye(d), a))
    big[:-1, -1] = gqg.reshape(-1)  # per unit of dt: expm's error is relative to its largest entry, one
    return dt * expm(big)[:-1, -1].reshape(d, d)


# Linear -------------------------------------------------------------------------------------------------------------


def test_the_notes_numbers():
    """Double integrator, dt = 0.5, white acceleration of density 0.04: the closed form to rounding."""
    law = ContinuousLinear(INTEGRATOR, double([[0.04]]), DOWN, b=DOWN)
    matrix, push, factor = law.matrices(0.5)
    torch.testing.assert_close(matrix, double([[1, 0.5], [0, 1]]), rtol=0, atol=4 * EPS)
    torch.testing.assert_close(push, double([[0.125], [0.5]]), rtol=4 * EPS, atol=0)
    torch.testing.assert_close(factor @ factor.mT, double([[0.04 / 24, 0.005], [0.005, 0.02]]), rtol=64 * EPS, atol=0)


@pytest.mark.parametrize("dt", [1e-6, 0.3, 2.0])
def test_any_linear_system_against_the_covariances_own_equation(dt):
    a, g, b = normal(4, 4, seed=1), normal(4, 2, seed=2), normal(4, 1, seed=3)
    q = double([[0.5, 0.1], [0.1, 0.2]])
    law = ContinuousLinear(a, q, g, b)
    matrix, push, factor = law.matrices(dt)
    expected = oracle_noise(a.numpy(), (g @ q @ g.mT).numpy(), dt)
    # exp(2 |A| dt) is the condition; 200 roundings of it.
    grown = 200 * EPS * math.exp(2 * float(torch.linalg.matrix_norm(a, 2)) * dt)
    np.testing.assert_allclose((factor @ factor.mT).numpy(), expected, rtol=0, atol=grown * np.abs(expected).max())
    np.testing.assert_allclose(matrix.numpy(), expm(a.numpy() * dt), rtol=0, atol=grown)
    whole = expm(np.block([[a.numpy(), b.numpy()], [np.zeros((1, 5))]]) * dt)
    np.testing.assert_allclose(push.numpy(), whole[:4, 4:], rtol=0, atol=grown * dt)


@pytest.mark.parametrize("rate", [1e-3, 1.0, 1000.0, 2000.0])
def test_stiff_systems_do_not_overflow(rate):
    """Ornstein-Uhlenbeck: variance q (1 - exp(-2 r dt)) / (2 r); the block exponential holds exp(+r dt) at 1000."""
    factor = noise_factor(double([[-rate]]), torch.ones(1, 1, dtype=DOUBLE), double(1.0))
    torch.testing.assert_close(factor.square(), double([[-math.expm1(-2 * rate) / (2 * rate)]]), rtol=1e-12, atol=0)


def test_the_factor_belongs_to_the_covariance():
    """A batch whose rows are doubled differently often, one noise for all and one a row."""
    a, dt = normal(5, 3, 3, seed=1), double([0.01, 3.0, 0.0, 0.5, 40.0])
    a[4] -= 5 * torch.eye(3, dtype=DOUBLE)
    for columns in (double([[0.0], [0.0], [1.0]]), normal(5, 3, 4, seed=2)):
        factor, expected = noise_factor(a, columns, dt), integrate_noise(a, columns @ columns.mT, dt)
        scale = expected.abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)
        torch.testing.assert_close(factor @ factor.mT / scale, expected / scale, rtol=0, atol=1e-12)
        alone = torch.stack([noise_factor(a[k], columns.expand(5, 3, -1)[k], float(dt[k])) for k in range(5)])
        torch.testing.assert_close(factor @ factor.mT / scale, alone @ alone.mT / scale, rtol=0, atol=1e-12)


def test_beyond_the_reach_is_nan_not_wrong():
    """2^64 in plain calls, 2^20 in a traced one; a row beyond it, or without a number for dt, spoils no other."""
    one = torch.ones(1, 1, dtype=DOUBLE)
    a = double([[[-1e20]], [[-1e19]], [[-1.0]], [[-1.0]]])
    dt = double([1.0, 1.0, torch.nan, torch.inf])
    for noise in (noise_factor(a, one, dt).square(), integrate_noise(a, one, dt)):
        assert torch.isnan(noise[[0, 2, 3]]).all()
        torch.testing.assert_close(noise[1], double([[0.5e-19]]), rtol=1e-12, atol=0)
    rates = double([[[-1.1e6]], [[-1e6]]])
    for integral in (noise_factor, integrate_noise):
        traced = torch.func.vmap(lambda a, integral=integral: integral(a, one, 1.0))(rates)
        assert torch.isnan(traced[0]).all()
        torch.testing.assert_close(traced[1].square() if integral is noise_factor else traced[1], 0.5 / -rates[1])


def test_short_steps_of_a_long_chain_keep_all_digits():
    """Three integrators at dt = 1e-4: variances span 16 decades, the closed form holds in every entry."""
    a, dt = torch.diag(torch.ones(2, dtype=DOUBLE), 1), 1e-4
    factor = noise_factor(a, double([[0.0], [0.0], [1.0]]), double(dt))
    expected = double(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    torch.testing.assert_close(factor @ factor.mT, expected, rtol=200 * EPS, atol=0)


def test_a_step_is_two_half_steps():
    law = ContinuousLinear(normal(3, 3, seed=4), torch.eye(3, dtype=DOUBLE))
    whole, _, root = law.matrices(0.8)
    half, _, short = law.matrices(0.4)
    torch.testing.assert_close(whole, half @ half, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(root @ root.mT, half @ short @ short.mT @ half.mT + short @ short.mT, rtol=1e-12, atol=0)


def test_time_steps_a_row_and_batched_systems():
    a = normal(3, 2, 2, seed=5)
    dt = double([[0.1], [0.0], [0.7]])
    law = ContinuousLinear(a, torch.eye(2, dtype=DOUBLE), b=normal(3, 2, 1, seed=6))
    x, u = normal(3, 2, seed=7), normal(3, 1, seed=8)
    whole = law(x, u, dt)
    for k in range(3):
        alone = ContinuousLinear(a[k], torch.eye(2, dtype=DOUBLE), b=law.b[k])(x[k], u[k], float(dt[k]))
        torch.testing.assert_close(whole.mean[k], alone.mean, rtol=1e-13, atol=1e-14)
        torch.testing.assert_close(whole.scale_tril[k], alone.scale_tril, rtol=1e-12, atol=1e-14)
    points = law(x.unsqueeze(1).expand(3, 5, 2), u.unsqueeze(1), dt.unsqueeze(1))
    torch.testing.assert_close(points.mean[:, 3], whole.mean, rtol=1e-13, atol=1e-14)
    assert torch.equal(whole.mean[1], x[1]) and not whole.scale_tril[1].any()


@pytest.mark.parametrize("shared", [False, True], ids=["control a row", "one control"])
def test_a_batch_of_discrete_systems_is_each_alone(shared):
    """Matrices of all kinds with a row each, in a Gaussian filter and in a bank of particles."""
    a, b, c, d = (normal(3, *shape, seed=k) for k, shape in enumerate([(2, 2), (2, 1), (1, 2), (1, 1)]))
    noise, own = 0.1 * torch.eye(2, dtype=DOUBLE), torch.eye(1, dtype=DOUBLE)
    prior = tf.Gaussian(normal(2, seed=9), torch.eye(2, dtype=DOUBLE))
    ys, us = normal(4, 3, 1, seed=10), normal(4, 1 if shared else 3, 1, seed=11)
    us = us[:, 0] if shared else us
    whole = linear_model(ss(0.5 * a, b, c, d, dt=1.0), noise, own, prior)
    makers = (
        tf.KalmanFilter,
        tf.UnscentedKalmanFilter,
        lambda model: tf.LocallyLinearizedParticleFilter(model, 4, split=1.0),
    )
    histories = [make(whole)(ys, us) for make in makers]
    for k in range(3):
        one = linear_model(ss(0.5 * a[k], b[k], c[k], d[k], dt=1.0), noise, own, prior)
        alone = tf.KalmanFilter(one)(ys[:, k], us if shared else us[:, k])
        for history in histories:
            torch.testing.assert_close(history.mean[:, k], alone.mean, rtol=1e-11, atol=1e-12)
            torch.testing.assert_close(history.log_likelihood[k], alone.log_likelihood, rtol=1e-11, atol=1e-12)


def test_matrices_of_a_repeated_step_are_held_until_they_would_be_stale():
    law = ContinuousLinear(INTEGRATOR, double([[0.04]]), DOWN)
    first = law.matrices(0.5)
    assert law.matrices(0.5)[0] is first[0] and law.matrices(0.25)[0] is not first[0]
    assert law.matrices(0.5)[0] is first[0]
    for k in range(8):
        law.matrices(1.0 + k)
    assert law.matrices(0.5)[0] is not first[0], "only the last steps are held"
    law.a.copy_(2 * INTEGRATOR)
    assert law.matrices(0.5)[0][0, 1] == 1.0
    swapped = torch.func.functional_call(law, {"a": 3 * INTEGRATOR}, (torch.ones(2, dtype=DOUBLE), None, 0.5))
    assert swapped.mean[0] == 2.5 and law.matrices(0.5)[0][0, 1] == 1.0
    law.to(torch.float32)
    assert law.matrices(0.5)[2].dtype == torch.float32


def test_matrices_made_in_inference_mode_are_not_held():
    law = ContinuousLinear(INTEGRATOR, double([[0.04]]), DOWN)
    with torch.inference_mode():
        law.matrices(0.5)
    x = torch.ones(2, dtype=DOUBLE, requires_grad=True)
    law(x, None, 0.5).mean.sum().backward()
    assert x.grad.tolist() == [1.0, 1.5]


def test_gradients_reach_the_density_and_the_dynamics():
    a, q = (0.3 * normal(2, 2, seed=9)).requires_grad_(), double([[0.5, 0.1], [0.1, 0.3]]).requires_grad_()
    g = normal(2, 2, seed=10).requires_grad_()

    def spread(a, q, g, dt):
        law = ContinuousLinear(a, (q + q.mT) / 2, g)
        factor = law.linear_form(None, dt).scale_tril
        return factor @ factor.mT

    torch.autograd.gradcheck(spread, (a, q, g, double(0.4).requires_grad_()))


def test_linear_laws_conform():
    law = ContinuousLinear(normal(3, 3, seed=1), 0.3 * torch.eye(2, dtype=DOUBLE), normal(3, 2), normal(3, 1))
    check_law(law, normal(4, 3), normal(4, 1, seed=2), 0.3)
    check_law(law, normal(4, 3), normal(1), double([[0.1], [0.0], [0.5], [1.0]]))
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(3, dtype=DOUBLE), torch.eye(3, dtype=DOUBLE)),
        law,
        tf.LinearGaussian(normal(2, 3, seed=3), 0.3 * torch.eye(2, dtype=DOUBLE)),
    )
    check_filter(tf.KalmanFilter(model), normal(6, 3, 2, seed=4), normal(6, 1), 0.2)


def test_the_kalman_filter_is_the_continuous_discrete_one():
    """Irregular steps; between them SciPy solves dP/dt = A P + P A^T + G Q G^T."""
    a, g, q = 0.5 * normal(2, 2, seed=1), normal(2, 1, seed=2), 0.3
    c, r = double([[1.0, 0.5]]), double([[0.2]])
    steps, ys = double([0.3, 0.05, 1.1, 0.4]), normal(4, 1, seed=3)
    prior = tf.Gaussian(double([1.0, -1.0]), torch.eye(2, dtype=DOUBLE))
    model = tf.StateSpaceModel(prior, ContinuousLinear(a, double([[q]]), g), tf.LinearGaussian(c, r))
    history = tf.KalmanFilter(model)(ys, dt=steps)
    m, P = prior.mean.numpy(), np.eye(2)
    for k in range(4):
        m, P = moments_by_scipy(lambda x: a.numpy() @ x, lambda x: a.numpy(), q * (g @ g.mT).numpy(), m, P, steps[k])
        S = c.numpy() @ P @ c.numpy().T + r.numpy()
        K = P @ c.numpy().T / S
        m, P = m + K @ (ys[k].numpy() - c.numpy() @ m), P - K @ c.numpy() @ P
        # DOP853 at rtol 1e-12 is good to a few 1e-11 over these steps.
        np.testing.assert_allclose(history.mean[k].numpy(), m, rtol=0, atol=1e-10)
        np.testing.assert_allclose(history.covariance[k].numpy(), P, rtol=0, atol=1e-10)


# Nonlinear ----------------------------------------------------------------------------------------------------------


def moments_by_scipy(f, jacobian, gqg, mean, covariance, dt):
    """Mean and covariance ODE of the continuous-discrete extended filter."""
    d = len(mean)

    def rate(t, z):
        x, P = z[:d], z[d:].reshape(d, d)
        F = jacobian(x)
        return np.concatenate([f(x), (F @ P + P @ F.T + gqg).reshape(-1)])

    start = np.concatenate([mean, covariance.reshape(-1)])
    end = solve_ivp(rate, (0, float(dt)), start, "DOP853", rtol=1e-12, atol=1e-14 * np.abs(start).max()).y[:, -1]
    return end[:d], end[d:].reshape(d, d)


def van_der_pol(x, u=None):
    push = 0.0 if u is None else u[..., 0]
    return torch.stack([x[..., 1], 1.5 * (1 - x[..., 0] ** 2) * x[..., 1] - x[..., 0] + push], -1)


def pendulum(x):
    return torch.stack([x[..., 1], -4.0 * x[..., 0].sin() - 0.3 * x[..., 1]], -1)


GAMMA = 5e-5  # 1/ft: Athans, Wishner, Bertolini (1968); state altitude (ft), speed downward (ft/s), ballistic (1/ft)


def falling_body(x):
    drag = (-GAMMA * x[..., 0]).exp() * x[..., 1] ** 2 * x[..., 2]
    return torch.stack([-x[..., 1], -drag, torch.zeros_like(drag)], -1)


CASES = {
    "van der Pol": (
        van_der_pol,
        lambda x: np.array([x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]]),
        lambda x: np.array([[0, 1], [-3 * x[0] * x[1] - 1, 1.5 * (1 - x[0] ** 2)]]),
        double([1.0, 0.8]),
        double([[0.3, 0.05], [0.05, 0.2]]),
        0.5,
    ),
    "pendulum": (
        pendulum,
        lambda x: np.array([x[1], -4 * math.sin(x[0]) - 0.3 * x[1]]),
        lambda x: np.array([[0, 1], [-4 * math.cos(x[0]), -0.3]]),
        double([2.0, -0.5]),
        double([[0.0, 0.0], [0.0, 0.2]]),
        0.5,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_mean_and_covariance_are_of_fourth_order(name):
    f, plain, jacobian, x, q, dt = CASES[name]
    P = double([[0.5, 0.1], [0.1, 0.4]])
    mean, covariance = moments_by_scipy(plain, jacobian, q.numpy(), x.numpy(), P.numpy(), dt)
    errors = []
    for steps in (2, 4, 8, 16):
        law, phi = ContinuousTransition(f, q, steps=steps).first_order(x, None, dt)
        moved = phi @ P @ phi.mT + law.covariance
        errors.append([np.abs(law.mean.numpy() - mean).max(), np.abs(moved.numpy() - covariance).max()])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert ((orders > 3.6) & (orders < 4.5)).all(), (errors, orders)
    assert np.max(errors[-1]) < 1e-6


@pytest.mark.parametrize("name", CASES)
def test_the_noise_alone_is_of_fourth_order(name):
    f, plain, jacobian, x, q, dt = CASES[name]
    _, expected = moments_by_scipy(plain, jacobian, q.numpy(), x.numpy(), np.zeros((2, 2)), dt)
    errors = [
        np.abs(ContinuousTransition(f, q, steps=steps)(x, None, dt).covariance.numpy() - expected).max()
        for steps in (2, 4, 8, 16)
    ]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert ((orders > 3.6) & (orders < 4.5)).all(), (errors, orders)


def test_linear_drift_is_the_linear_law():
    a, b, g, q = normal(3, 3, seed=1), normal(3, 1, seed=2), normal(3, 2, seed=3), double([[0.5, 0.2], [0.2, 0.3]])
    x, u = normal(4, 3, seed=4), normal(4, 1, seed=5)
    exact = ContinuousLinear(a, q, g, b)
    law = ContinuousTransition(lambda x, u: x @ a.mT + u @ b.mT, q, g, steps=40)
    at, phi = law.first_order(x, u, 0.5)
    expected = exact(x, u, 0.5)
    # (|A| h)^5 / 5! a half step with |A| h below 0.02, eighty times: below 3e-9.
    torch.testing.assert_close(at.mean, expected.mean, rtol=0, atol=3e-9)
    torch.testing.assert_close(at.covariance, expected.covariance.expand(4, 3, 3), rtol=0, atol=3e-9)
    torch.testing.assert_close(phi, exact.matrices(0.5)[0].expand(4, 3, 3), rtol=0, atol=3e-9)


def test_the_double_integrator_is_exact_in_one_step():
    """Simpson's rule is exact for the squares of a straight line, Runge-Kutta for a parabola."""
    at = ContinuousTransition(lambda x, u: x @ INTEGRATOR.mT + u @ DOWN.mT, double([[0.04]]), DOWN)(
        double([1.0, 2.0]), double([0.3]), 0.5
    )
    torch.testing.assert_close(at.mean, double([1 + 1 + 0.125 * 0.3, 2.15]), rtol=4 * EPS, atol=0)
    torch.testing.assert_close(at.covariance, double([[0.04 / 24, 0.005], [0.005, 0.02]]), rtol=32 * EPS, atol=0)


def test_a_jacobian_of_ones_own_gives_the_same():
    def jacobian(x, u):
        row = torch.stack([-3 * x[..., 0] * x[..., 1] - 1, 1.5 * (1 - x[..., 0] ** 2)], -1)
        return torch.stack([torch.tensor([0.0, 1.0], dtype=x.dtype).expand_as(row), row], -2)

    x, u, q = normal(4, 2), normal(4, 1, seed=1), 0.2 * torch.eye(2, dtype=DOUBLE)
    given = ContinuousTransition(van_der_pol, q, steps=2, jacobian=jacobian).first_order(x, u, 0.3)
    own = ContinuousTransition(van_der_pol, q, steps=2).first_order(x, u, 0.3)
    torch.testing.assert_close(given[0].mean, own[0].mean, rtol=1e-14, atol=1e-15)
    torch.testing.assert_close(given[0].scale_tril, own[0].scale_tril, rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(given[1], own[1], rtol=1e-13, atol=1e-14)


def test_the_transition_matrix_is_the_derivative_of_the_mean():
    x = double([1.0, 0.8])
    law = ContinuousTransition(van_der_pol, torch.eye(2, dtype=DOUBLE), steps=3)
    phi = law.first_order(x, None, 0.5)[1]
    expected = torch.autograd.functional.jacobian(lambda x: law(x, None, 0.5).mean, x)
    torch.testing.assert_close(phi, expected, rtol=1e-13, atol=1e-14)


def test_an_integrator_of_ones_own():
    """torchdiffeq's dopri5, time scaled so that dt may be a tensor."""
    odeint = pytest.importorskip("torchdiffeq").odeint
    calls = []

    def dopri5(f, z, dt):
        calls.append(dt)
        return odeint(lambda t, z: dt * f(z), z, torch.tensor([0.0, 1.0], dtype=z.dtype), rtol=1e-10, atol=1e-12)[-1]

    f, plain, jacobian, x, q, dt = CASES["van der Pol"]
    _, spread = moments_by_scipy(plain, jacobian, q.numpy(), x.numpy(), np.zeros((2, 2)), dt)
    mean, phi_phi = moments_by_scipy(plain, jacobian, 0 * q.numpy(), x.numpy(), np.eye(2), dt)
    at, phi = ContinuousTransition(f, q, integrator=dopri5).first_order(x, None, dt)
    assert calls == [0.25, 0.25]
    np.testing.assert_allclose(at.mean.numpy(), mean, rtol=0, atol=1e-8)
    np.testing.assert_allclose((phi @ phi.mT).numpy(), phi_phi, rtol=0, atol=1e-8)
    # The noise is Simpson's, whoever integrates: 1 / 16 at twice the steps.
    near = ContinuousTransition(f, q, steps=2, integrator=dopri5)(x, None, dt)
    far, close = (np.abs(law.covariance.numpy() - spread).max() for law in (at, near))
    assert 12 < far / close < 22
    rows = ContinuousTransition(f, q, integrator=dopri5)(torch.stack([x, -x]), None, double([[dt], [0.1]]))
    np.testing.assert_allclose(rows.mean[0].numpy(), mean, rtol=0, atol=1e-8)


SWING = Product(Angle(1), Euclidean(1))


def models():
    x0 = tf.Gaussian(double([0.5, 0.0]), 0.3 * torch.eye(2, dtype=DOUBLE), SWING)
    law = ContinuousTransition(pendulum, double([[0.1]]), DOWN, steps=2, space=SWING)
    return tf.StateSpaceModel(x0, law, tf.AdditiveGaussian(lambda x: x[..., :1].sin(), double([[0.05]])))


def test_nonlinear_laws_conform():
    q = 0.2 * torch.eye(2, dtype=DOUBLE)
    check_law(ContinuousTransition(van_der_pol, q, steps=2), normal(4, 2), normal(4, 1), 0.3)
    rows = double([[0.1], [0.0], [0.5], [0.2]])
    check_law(ContinuousTransition(van_der_pol, q), normal(4, 2), normal(1), rows)
    check_law(ContinuousTransition(pendulum, double([[0.1]]), DOWN, space=SWING), 3 * normal(4, 2), None, rows)


@pytest.mark.parametrize(
    "make",
    [
        tf.ExtendedKalmanFilter,
        tf.UnscentedKalmanFilter,
        lambda model: tf.BootstrapFilter(model, 30),
        lambda model: tf.UnscentedParticleFilter(model, 10),
    ],
)
def test_every_kind_of_filter_works_with_it(make):
    check_filter(make(models()), normal(5, 2, 1, seed=3), None, double([0.1, 0.0, 0.3, 0.1, 0.2]))


def test_the_extended_filter_is_the_continuous_discrete_one():
    """The vertically falling body: one radar pass, against SciPy's moments between the measurements."""
    start, spread = np.array([3e5, 2e4, 1e-3]), np.diag([1e6, 4e6, 1e-4])
    model = tf.StateSpaceModel(
        tf.Gaussian(double(start), double(spread).sqrt()),
        ContinuousTransition(falling_body, torch.zeros(3, 3, dtype=DOUBLE), steps=64),
        tf.AdditiveGaussian(lambda x: (1e10 + (x[..., :1] - 1e5) ** 2).sqrt(), double([[1e4]])),
    )
    ys = double([[2.07e5], [1.9e5], [1.72e5], [1.56e5]])
    history = tf.ExtendedKalmanFilter(model)(ys, dt=1.0)

    def rate(x):
        return np.array([-x[1], -math.exp(-GAMMA * x[0]) * x[1] ** 2 * x[2], 0.0])

    def jacobian(x):
        e = math.exp(-GAMMA * x[0])
        return np.array([[0, -1, 0], [GAMMA * e * x[1] ** 2 * x[2], -2 * e * x[1] * x[2], -e * x[1] ** 2], [0, 0, 0]])

    m, P = start, spread
    for k in range(4):
        m, P = moments_by_scipy(rate, jacobian, np.zeros((3, 3)), m, P, 1.0)
        slant = math.sqrt(1e10 + (m[0] - 1e5) ** 2)
        H = np.array([[(m[0] - 1e5) / slant, 0, 0]])
        K = P @ H.T / (H @ P @ H.T + 1e4)
        m, P = m + K[:, 0] * (ys[k].item() - slant), (np.eye(3) - K @ H) @ P
        # Runge-Kutta at 1/128 s leaves 1e-9 of these numbers, SciPy's solver less.
        np.testing.assert_allclose(history.mean[k].numpy() / m, 1.0, rtol=0, atol=1e-8)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(history.covariance[k].numpy() / scale, P / scale, rtol=0, atol=1e-7)


def test_the_law_compiles_whole_and_maps():
    for law, u in (
        (ContinuousTransition(van_der_pol, double([[0.1]]), DOWN, steps=2), normal(3, 1)),
        (ContinuousLinear(INTEGRATOR, double([[0.1]]), DOWN, DOWN), normal(3, 1)),
    ):
        x = normal(3, 2, seed=1)
        expected = law(x, u, 0.2)
        compiled = torch.compile(lambda x, u, law=law: law(x, u, 0.2)[:2], fullgraph=True, backend="aot_eager")
        mapped = torch.func.vmap(lambda x, u, law=law: law(x, u, 0.2)[:2])
        for found in (compiled(x, u), mapped(x, u)):
            torch.testing.assert_close(found[0], expected.mean, rtol=1e-12, atol=1e-13)
            torch.testing.assert_close(
                found[1].expand(3, 2, 2), expected.scale_tril.expand(3, 2, 2), rtol=1e-12, atol=1e-13
            )


def test_gradients_flow_through_a_trained_drift():
    net = torch.nn.Linear(2, 2, dtype=DOUBLE)
    psd = (0.1 * torch.eye(2, dtype=DOUBLE)).requires_grad_()
    law = ContinuousTransition(net, psd, steps=2)
    at, phi = law.first_order(normal(3, 2), None, 0.3)
    (at.mean.sum() + at.scale_tril.sum() + phi.sum()).backward()
    assert net.weight.grad.abs().sum() > 0 and psd.grad.abs().sum() > 0 and len(list(law.parameters())) == 2


def test_noise_that_reaches_too_few_states_in_one_step_is_singular_not_wrong():
    """Four integrators, one noise: Simpson's three columns hold rank three, two steps more."""
    chain = torch.diag(torch.ones(3, dtype=DOUBLE), 1)
    last = double([[0.0], [0], [0], [1]])
    one, two = (ContinuousTransition(lambda x: x @ chain.mT, double([[1.0]]), last, steps=s) for s in (1, 2))
    x = normal(4)
    assert torch.linalg.matrix_rank(one(x, None, 1.0).scale_tril) == 3
    assert torch.linalg.matrix_rank(two(x, None, 1.0).scale_tril) == 4


# Errors -------------------------------------------------------------------------------------------------------------

ONE = torch.eye(2, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: ContinuousLinear(normal(2, 3), ONE), ValueError, "a must be a square matrix"),
        (lambda: ContinuousLinear([[1.0]], ONE), TypeError, "a must be a floating-point tensor, got list"),
        (lambda: ContinuousLinear(ONE, [[1.0]]), TypeError, "noise_psd must be a floating-point tensor, got list"),
        (
            lambda: ContinuousTransition(pendulum, [[1.0]]),
            TypeError,
            "noise_psd must be a floating-point tensor, got l",
        ),
        (lambda: ContinuousLinear(ONE * torch.nan, ONE), ValueError, "a must be finite"),
        (lambda: ContinuousLinear(ONE, -ONE), ValueError, "noise_psd must be positive semidefinite"),
        (lambda: ContinuousLinear(ONE, double([[1.0]])), ValueError, "noise_psd must be 2 x 2"),
        (lambda: ContinuousLinear(ONE, ONE, normal(3, 2)), ValueError, "noise_input must be"),
        (lambda: ContinuousLinear(ONE, ONE, DOWN), ValueError, "noise_input must be"),
        (lambda: ContinuousLinear(ONE, ONE, ONE / 0), ValueError, "noise_input must be finite"),
        (lambda: ContinuousLinear(ONE, ONE, ONE.float()), TypeError, "noise_input must have noise_psd's dtype"),
        (lambda: ContinuousLinear(ONE, ONE.float()), TypeError, "noise_psd must have the dtype"),
        (lambda: ContinuousLinear(ONE, ONE, None, ONE.float()), TypeError, "b must have the dtype"),
        (lambda: ContinuousLinear(ONE, ONE, None, normal(3, 1)), ValueError, "b must be"),
        (lambda: ContinuousLinear(ONE, ONE, None, ONE / 0), ValueError, "b must be finite"),
        (lambda: ContinuousLinear(ONE, ONE)(ONE), ValueError, "no time step"),
        (lambda: ContinuousLinear(ONE, ONE)(ONE, ONE, 0.1), ValueError, "this law has no b"),
        (lambda: ContinuousLinear(ONE, ONE, None, ONE)(ONE, None, 0.1), ValueError, "no control u"),
        (lambda: ContinuousTransition(3, ONE), TypeError, "drift must be a function"),
        (lambda: ContinuousTransition(pendulum, ONE, jacobian=3), TypeError, "jacobian must be a function"),
        (lambda: ContinuousTransition(pendulum, ONE, integrator=3), TypeError, "integrator must be a function"),
        (lambda: ContinuousTransition(pendulum, ONE, steps=0), ValueError, "steps must be"),
        (lambda: ContinuousTransition(pendulum, ONE, steps=1.5), ValueError, "steps must be"),
        (lambda: ContinuousTransition(pendulum, ONE, space=UnitQuaternion()), ValueError, "space must be made of"),
        (lambda: ContinuousTransition(pendulum, ONE, space=Angle(3)), ValueError, "noise_psd must be 3 x 3"),
        (lambda: ContinuousTransition(pendulum, ONE, normal(2, 1)), ValueError, "noise_input must be"),
        (lambda: ContinuousTransition(pendulum, ONE)(ONE), ValueError, "no time step"),
        (lambda: ContinuousTransition(pendulum, ONE)(normal(3), None, 0.1), ValueError, "the noise reaches 2 numbers"),
        (lambda: ContinuousTransition(lambda x: x[..., :1], ONE)(ONE, None, 0.1), ValueError, "drift must turn"),
        (
            lambda: ContinuousTransition(pendulum, ONE, jacobian=lambda x: x)(normal(3, 2), None, 0.1),
            ValueError,
            "jacobian must give",
        ),
    ],
)
def test_errors(make, error, message):
    with pytest.raises(error, match=message):
        make()
