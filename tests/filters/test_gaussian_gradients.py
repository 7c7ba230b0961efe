"""Gradients of the log-likelihood: finite differences on every parameter, and the exact score on linear models."""

import warnings

import numpy as np
import pytest
import torch
from gaussian_problem import RULES, problem, tensor
from oracles import kalman_oracle

import torchfilt as tf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from statsmodels.tsa.statespace.structural import UnobservedComponents

D, M = 2, 2
NAMES = ("a", "push", "q_root", "h", "offset", "r_root", "m0", "p0_root")


def parameters(seed=0):
    """Matrices of a linear model; covariances by a root, so that they stay symmetric when an entry is moved."""
    p = problem(seed, d=D, m=M)
    root = np.linalg.cholesky
    return {
        "a": p.a + np.eye(D), "push": p.push, "q_root": root(p.q), "h": p.h,
        "offset": p.offset, "r_root": root(p.r), "m0": p.m0, "p0_root": root(p.p0),
    }  # fmt: skip


def hidden(pattern, rows=2):
    ys = problem(0, d=D, m=M, steps=5, rows=rows).ys
    if pattern == "shared":
        ys[1, :, 0] = ys[3] = np.nan
    if pattern == "rows":
        ys[1, 0, 0] = ys[2, 1] = ys[4, 1, 1] = np.nan
    return ys


def log_likelihood(rule, form, values, ys, iterations=1, bend=0.0, a_row=False):
    """Sum over the rows, as a function of the parameters in the order of NAMES; ``bend`` makes the laws nonlinear."""
    a, push, q_root, h, offset, r_root, m0, p0_root = values
    q, r = q_root @ q_root.mT, r_root @ r_root.mT
    prior = tf.Gaussian(m0, torch.linalg.cholesky(p0_root @ p0_root.mT))
    if form == "linear":
        laws = tf.LinearGaussian(a, q, push), tf.LinearGaussian(h, r, offset)
    else:
        laws = (
            tf.AdditiveGaussian(lambda x: x @ a.mT + push + bend * torch.sin(x), q),
            tf.AdditiveGaussian(lambda x: x @ h.mT + offset + bend * torch.cos(x), r),
        )
    filter = tf.GaussianFilter(tf.StateSpaceModel(prior, *laws), RULES[rule], iterations)
    state = filter.init((ys.shape[1],))
    if a_row:
        factor = state.belief.scale_tril.expand(ys.shape[1], -1, -1)
        state = state._replace(belief=state.belief._replace(scale_tril=factor))
    return filter(ys, state=state).log_likelihood.sum()


def oracle_score(ys):
    shapes = {name: value.shape for name, value in parameters().items()}

    def evidence(theta):
        value, place = {}, 0
        for name, shape in shapes.items():
            size = int(np.prod(shape))
            value[name], place = theta[place : place + size].reshape(shape), place + size
        p0, q, r = (value[name] @ value[name].T for name in ("p0_root", "q_root", "r_root"))
        runs = (
            kalman_oracle.kalman(
                value["m0"], p0, value["a"], q, value["h"], r, ys[:, row], value["push"], value["offset"]
            )
            for row in range(ys.shape[1])
        )
        return sum(run.log_likelihood.sum() for run in runs)

    return kalman_oracle.score(evidence, np.concatenate([value.ravel() for value in parameters().values()]))


CASES = [(rule, form) for rule in RULES for form in ("linear", "functions")]


@pytest.mark.parametrize("pattern", ["complete", "shared", "rows"])
@pytest.mark.parametrize(("rule", "form"), CASES)
def test_gradient_is_the_exact_score_of_a_linear_model(rule, form, pattern):
    """Every entry of every matrix of the three laws; the score by complex steps through the oracle."""
    ys = hidden(pattern)
    values = [tensor(parameters()[name]).requires_grad_() for name in NAMES]
    found = torch.autograd.grad(log_likelihood(rule, form, values, tensor(ys)), values)
    expected = oracle_score(ys)
    flat = np.concatenate([g.numpy().ravel() for g in found])
    # Points of the negative-centre rule carry weights of 1 / alpha^2 = 400.
    np.testing.assert_allclose(flat, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("pattern", ["complete", "shared", "rows"])
def test_shared_and_separate_covariances_have_the_same_gradient(pattern):
    values = [tensor(parameters()[name]).requires_grad_() for name in NAMES]
    ys = tensor(hidden(pattern, rows=3))
    one, two = (
        torch.autograd.grad(log_likelihood("taylor", "linear", values, ys, a_row=a_row), values)
        for a_row in (False, True)
    )
    for g, h in zip(one, two, strict=True):
        torch.testing.assert_close(g, h, rtol=0, atol=1e-11 * max(1, h.abs().max().item()))


@pytest.mark.parametrize("iterations", [1, 2])
@pytest.mark.parametrize("rule", RULES)
def test_gradcheck_of_nonlinear_laws(rule, iterations):
    """Finite differences over all parameters of the three laws, rows with different missing components."""
    ys = tensor(hidden("rows"))[:3]
    values = tuple(tensor(parameters()[name]).requires_grad_() for name in NAMES)
    assert torch.autograd.gradcheck(
        lambda *v: log_likelihood(rule, "functions", v, ys, iterations, bend=0.3), values, atol=1e-6, rtol=1e-5
    )


def test_gradient_reaches_measurements_and_controls():
    p = problem(3, rows=1, steps=4)
    filter = tf.ExtendedKalmanFilter(
        tf.StateSpaceModel(
            tf.Gaussian(tensor(p.m0), torch.linalg.cholesky(tensor(p.p0))),
            tf.AdditiveGaussian(lambda x, u, dt: torch.sin(x) * dt + u, tensor(p.q)),
            tf.AdditiveGaussian(lambda x: x[..., :2] ** 2, tensor(p.r)),
        )
    )
    inputs = (tensor(p.ys), tensor(p.us), tensor(p.dts))
    inputs = tuple(value.requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(lambda y, u, dt: filter(y, u, dt).log_likelihood.sum(), inputs)


def test_parameters_of_modules_receive_the_gradient():
    """trainable=True, an nn.Module as the function, an nn.Parameter as covariance and as prior mean."""
    generator = torch.Generator().manual_seed(0)
    net = torch.nn.Linear(D, D, dtype=torch.float64)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    eye = torch.eye(D, dtype=torch.float64)
    covariance, mean = torch.nn.Parameter(0.3 * eye), torch.nn.Parameter(torch.zeros(D, dtype=torch.float64))
    model = tf.StateSpaceModel(
        tf.Gaussian(mean, eye),
        tf.AdditiveGaussian(net, covariance),
        tf.LinearGaussian(eye, 0.1 * eye, torch.zeros(D, dtype=torch.float64), trainable=True),
    )
    filter = tf.UnscentedKalmanFilter(model)
    names = {name for name, _ in filter.named_parameters()}
    assert len(names) == 7, names
    (-filter(tensor(hidden("rows"))).log_likelihood.mean()).backward()
    for name, parameter in filter.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_statsmodels_score_of_a_local_level():
    """Its own complex-step score of the variances; known start, first value counted."""
    ys = np.cumsum(np.random.default_rng(0).standard_normal(60))[:, None]
    ys[10:15] = np.nan
    witness = UnobservedComponents(ys[:, 0], "llevel")
    witness.ssm.initialize_known(np.zeros(1), np.eye(1) * 10)
    witness.ssm.loglikelihood_burn = 0
    witness.ssm.tolerance = 0  # never takes its gain as converged
    variances = np.array([0.7, 1.3])  # irregular, level
    expected = witness.score(variances, transformed=True)
    value = tensor(variances).requires_grad_()
    one = torch.eye(1, dtype=torch.float64)
    # Its prior is the state at the first measurement.
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(1, dtype=torch.float64), 10**0.5 * one),
        tf.LinearGaussian(one, value[1] * one),
        tf.LinearGaussian(one, value[0] * one),
    )
    evidence = tf.KalmanFilter(model)(tensor(ys), predict_first=False).log_likelihood
    np.testing.assert_allclose(evidence.item(), witness.loglike(variances, transformed=True), rtol=1e-12)
    (found,) = torch.autograd.grad(evidence, value)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)
