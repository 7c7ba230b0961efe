"""Moment rules against numerical integration, and what each of them is exact for."""

import copy
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import integrate

import torchfilt as tf
from torchfilt.moments import cubature, gauss_hermite, predict, taylor, unscented, update

RULES = {
    "taylor": taylor(),
    "unscented": unscented(),
    "unscented-negative-centre": unscented(alpha=0.5, beta=2.0, kappa=0.0),
    "cubature": cubature(),
    "gauss-hermite": gauss_hermite(5),
}
QUADRATURES = {name: rule for name, rule in RULES.items() if name != "taylor"}


def tensor(value):
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


def belief(mean, covariance):
    return tf.Gaussian(tensor(mean), torch.linalg.cholesky(tensor(covariance)))


def integrate_1d(function, mean, deviation):
    """E f(x), x ~ N(mean, deviation^2), by adaptive quadrature to 1e-12."""

    def weighted(z):
        return function(mean + deviation * z) * math.exp(-z * z / 2) / math.sqrt(2 * math.pi)

    return integrate.quad(weighted, -12, 12, epsabs=1e-13, epsrel=1e-13, limit=400)[0]


def integrate_2d(function, mean, root):
    """E f(x) of a vector function, x ~ N(mean, root root^T): trapezium on a grid, converged beyond 1e-13."""
    z = np.linspace(-10, 10, 401)
    weights = np.exp(-(z**2) / 2) * (z[1] - z[0]) / math.sqrt(2 * math.pi)
    grid = np.stack(np.meshgrid(z, z, indexing="ij"), -1).reshape(-1, 2)
    return np.einsum("n,n...->...", np.outer(weights, weights).ravel(), function(mean + grid @ root.T))


# Exactness


def normal_moment(powers):
    """E of a monomial of independent standard normals."""
    odd = any(power % 2 for power in powers)
    return 0.0 if odd else float(math.prod(math.prod(range(1, power, 2)) for power in powers))


def rule_mean(rule, size, powers):
    law = tf.AdditiveGaussian(lambda x: (x ** torch.tensor(powers)).prod(-1, keepdim=True), tensor([[1.0]]))
    return rule.linearize(law, belief(np.zeros(size), np.eye(size)), None, None).mean.item()


def monomials(size, degree):
    return [p for p in np.ndindex(*[degree + 1] * size) if sum(p) == degree]


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("name", ["cubature", "unscented", "unscented-negative-centre"])
def test_third_degree_rules(name, size):
    """Every monomial up to degree 3 exactly; of degree 4 some are not."""
    for degree in range(4):
        for powers in monomials(size, degree):
            assert abs(rule_mean(RULES[name], size, powers) - normal_moment(powers)) < 1e-12, powers
    missed = [p for p in monomials(size, 4) if abs(rule_mean(RULES[name], size, p) - normal_moment(p)) > 1e-3]
    if not (name == "unscented" and size == 1):  # kappa = 2 is the three-point Gauss-Hermite rule in one dimension
        assert missed


@pytest.mark.parametrize("order", [2, 3, 4, 7, 12])
def test_gauss_hermite_is_exact_to_degree_2p_minus_1_in_each_axis(order):
    highest = 2 * order - 1
    for powers in [(k,) for k in range(highest + 1)] + [(highest - 1, highest - 1), (2, highest), (highest - 1, 0)]:
        exact = normal_moment(powers)
        # Weights come from eigenvectors, good to eps of the largest: far nodes raise that to the power.
        reach = gauss_hermite(order).build(1).nodes.max().item() ** sum(powers)
        assert abs(rule_mean(gauss_hermite(order), len(powers), powers) - exact) < 1e-14 * max(1, exact, reach)
    # The error of the first degree missed is the squared norm of the Hermite polynomial, order!.
    error = normal_moment((2 * order,)) - rule_mean(gauss_hermite(order), 1, (2 * order,))
    assert error == pytest.approx(math.factorial(order), rel=1e-9)


@pytest.mark.parametrize("name", QUADRATURES)
def test_weights_and_nodes_are_standard(name):
    """Weights of the mean sum to one, nodes have mean zero and unit covariance under both sets of weights."""
    for size in (1, 2, 4):
        rule = QUADRATURES[name].build(size)
        torch.testing.assert_close(rule.mean_weights.sum(), tensor(1.0), rtol=0, atol=1e-13)
        eye = torch.eye(size, dtype=torch.float64)
        for weights in (rule.mean_weights, rule.covariance_weights):
            torch.testing.assert_close(weights @ rule.nodes, 0 * eye[0], rtol=0, atol=1e-13)
            torch.testing.assert_close(rule.nodes.mT @ (weights.unsqueeze(-1) * rule.nodes), eye, rtol=0, atol=1e-13)


# Nonlinear laws against integration


def smooth(x, library):
    return library.sin(x) + 0.3 * x**2


def covariance_of(line):
    spread = line.spread()
    whole = line.slope @ line.slope.mT + spread @ spread.mT
    return whole if line.negative is None else whole - line.negative.unsqueeze(-1) * line.negative.unsqueeze(-2)


def test_gauss_hermite_converges_to_the_integral():
    """Mean, covariance and cross-covariance in one dimension: each two orders gain digits, order 14 has 1e-9."""
    mean, deviation, noise = 0.4, 0.8, 0.1
    m = integrate_1d(lambda x: smooth(x, np), mean, deviation)
    v = integrate_1d(lambda x: (smooth(x, np) - m) ** 2, mean, deviation) + noise
    c = integrate_1d(lambda x: (x - mean) * smooth(x, np), mean, deviation)
    law = tf.AdditiveGaussian(lambda x: smooth(x, torch), tensor([[noise]]))
    errors = []
    for order in (2, 4, 6, 8, 14):
        line = gauss_hermite(order).linearize(law, belief([mean], [[deviation**2]]), None, None)
        found = line.mean.item(), covariance_of(line).item(), line.slope.item() * deviation
        errors.append(max(abs(a - b) for a, b in zip(found, (m, v, c), strict=True)))
    assert all(after < before / 3 for before, after in pairwise(errors)), errors
    assert errors[-1] < 1e-9


def test_gauss_hermite_in_two_dimensions():
    """Range and bearing of an uncertain position, as a vector law with correlated errors."""
    mean, covariance = np.array([2.0, 1.0]), np.array([[0.04, 0.02], [0.02, 0.06]])
    root = np.linalg.cholesky(covariance)

    def polar(x):
        return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1)

    m = integrate_2d(polar, mean, root)
    v = integrate_2d(lambda x: (polar(x) - m)[..., :, None] * (polar(x) - m)[..., None, :], mean, root)
    c = integrate_2d(lambda x: (x - mean)[..., :, None] * (polar(x) - m)[..., None, :], mean, root)

    def measured(x):
        return torch.stack([torch.hypot(*x.unbind(-1)), torch.atan2(x[..., 1], x[..., 0])], -1)

    law = tf.AdditiveGaussian(measured, 1e-3 * torch.eye(2, dtype=torch.float64))
    line = gauss_hermite(16).linearize(law, belief(mean, covariance), None, None)
    np.testing.assert_allclose(line.mean.numpy(), m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(covariance_of(line).numpy(), v + 1e-3 * np.eye(2), rtol=0, atol=1e-9)
    np.testing.assert_allclose(root @ line.slope.numpy().T, c, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["unscented", "unscented-negative-centre", "cubature"])
def test_third_degree_rules_err_by_the_fourth_order_of_the_spread(name):
    """Halving the deviation divides the error of the mean by 16."""
    errors = []
    for deviation in (0.4, 0.2, 0.1):
        exact = integrate_1d(lambda x: math.exp(x), 0.3, deviation)
        law = tf.AdditiveGaussian(torch.exp, tensor([[0.1]]))
        errors.append(abs(RULES[name].linearize(law, belief([0.3], [[deviation**2]]), None, None).mean.item() - exact))
    if name == "unscented":  # three-point Gauss-Hermite in one dimension: order six
        assert errors[0] / errors[1] == pytest.approx(64, rel=0.1)
        return
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.1)


def test_taylor_is_the_derivative():
    law = tf.AdditiveGaussian(lambda x: torch.stack([x[..., 0] * x[..., 1], torch.sin(x[..., 0])], -1),
                              torch.eye(2, dtype=torch.float64))  # fmt: skip
    prior = belief([0.3, -2.0], [[0.5, 0.2], [0.2, 0.4]])
    line = taylor().linearize(law, prior, None, None)
    jacobian = tensor([[-2.0, 0.3], [math.cos(0.3), 0.0]])
    torch.testing.assert_close(line.mean, tensor([-0.6, math.sin(0.3)]), rtol=0, atol=1e-15)
    torch.testing.assert_close(line.slope, jacobian @ prior.factor(), rtol=0, atol=1e-15)
    assert line.residual is None


# Noise that depends on the state


class Heteroscedastic(torch.nn.Module):
    """y ~ N(x, R(x)) with a factor that depends on the state, full or diagonal."""

    def __init__(self, form):
        super().__init__()
        self.form = form

    def root(self, x):
        a, b = x.unbind(-1)
        zero = torch.zeros_like(a)
        lower = torch.stack([1 + a**2, zero, a * b * (self.form == "full"), 0.5 + b**2], -1)
        return lower.unflatten(-1, (2, 2))

    def forward(self, x, u=None, dt=None):
        if self.form == "diagonal":
            return tf.Gaussian(x, self.root(x).diagonal(dim1=-2, dim2=-1), is_diagonal=True)
        return tf.Gaussian(x, self.root(x))


class Pooled(Heteroscedastic):
    """Averages its own noise over the points, as a Gaussian process does."""

    def pooled(self, points, weights, u=None, dt=None):
        root = self.root(points)
        mean = (root @ root.mT * weights[:, None, None]).sum(-3, keepdim=True)
        return tf.Gaussian(points, torch.linalg.cholesky(mean))


def mean_noise(form, mean, root):
    def covariance(x):
        a, b = x[..., 0], x[..., 1]
        lower = np.zeros((*a.shape, 2, 2))
        lower[..., 0, 0], lower[..., 1, 1] = 1 + a**2, 0.5 + b**2
        if form == "full":
            lower[..., 1, 0] = a * b
        return lower @ np.swapaxes(lower, -1, -2)

    return integrate_2d(covariance, mean, root)


@pytest.mark.parametrize("form", ["full", "diagonal"])
@pytest.mark.parametrize("kind", [Heteroscedastic, Pooled])
def test_state_dependent_noise_enters_as_its_mean(kind, form):
    """R is of degree 4 in each axis: Gauss-Hermite of order 3 has its mean exactly."""
    mean, covariance = np.array([0.5, -0.3]), np.array([[0.3, 0.1], [0.1, 0.2]])
    root = np.linalg.cholesky(covariance)
    expected = mean_noise(form, mean, root)
    line = gauss_hermite(3).linearize(kind(form), belief(mean, covariance), None, None)
    np.testing.assert_allclose((line.noise @ line.noise.mT).numpy(), expected, rtol=0, atol=1e-12)
    # Alone among the rules, Taylor takes the noise at the mean.
    at_mean = mean_noise(form, mean, 0 * root)
    line = taylor().linearize(Heteroscedastic(form), belief(mean, covariance), None, None)
    np.testing.assert_allclose((line.noise @ line.noise.mT).numpy(), at_mean, rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", ["full", "diagonal"])
@pytest.mark.parametrize("name", QUADRATURES)
def test_state_dependent_noise_is_the_weighted_sum_for_every_rule(name, form):
    """By its definition, point by point; rows of a batch one by one; prediction and update use it."""
    rule, law = QUADRATURES[name], Heteroscedastic(form)
    means = tensor([[0.5, -0.3], [0.1, 0.2], [-1.0, 0.4]])
    factors = torch.linalg.cholesky(tensor([[0.3, 0.1], [0.1, 0.2]])) * tensor([1.0, 0.3, 0.6])[:, None, None]
    line = rule.linearize(law, tf.Gaussian(means, factors), None, None)
    data = rule.build(2)
    for row in range(3):
        points = means[row] + data.nodes @ factors[row].mT
        own = law.root(points)
        expected = (own @ own.mT * data.mean_weights[:, None, None]).sum(0)
        found = line.noise[row] @ line.noise[row].mT
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
        predicted = predict(law, tf.Gaussian(means[row], factors[row]), rule, None, None)
        torch.testing.assert_close(predicted.covariance, factors[row] @ factors[row].mT + expected, rtol=0, atol=1e-12)
        result = update(law, tf.Gaussian(means[row], factors[row]), means[row] + 1, rule)
        s = factors[row] @ factors[row].mT + expected
        likelihood = torch.distributions.MultivariateNormal(means[row], s).log_prob(means[row] + 1)
        torch.testing.assert_close(result.log_likelihood, likelihood, rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", ["full", "diagonal"])
def test_a_mean_noise_that_is_not_positive_is_a_failure_not_a_number(form):
    """alpha = 0.5 in four states: centre weight -3; noise that is large at the centre alone averages below zero."""

    class Peak(torch.nn.Module):
        def forward(self, x, u=None, dt=None):
            size = torch.exp(-20 * x.square().sum(-1, keepdim=True)) + 1e-3
            if form == "diagonal":
                return tf.Gaussian(x, size.expand_as(x), is_diagonal=True)
            return tf.Gaussian(x, size.unsqueeze(-1) * torch.eye(4, dtype=torch.float64))

    rule = unscented(alpha=0.5, kappa=0.0)
    line = rule.linearize(Peak(), belief(np.zeros(4), np.eye(4)), None, None)
    assert torch.isnan(line.noise).any()


# Update


def test_the_update_is_statistical_linear_regression():
    """Gain = cross-covariance / innovation covariance, all three by integration."""
    mean, deviation, noise, y = 0.4, 0.8, 0.1, 1.3
    m = integrate_1d(lambda x: smooth(x, np), mean, deviation)
    s = integrate_1d(lambda x: (smooth(x, np) - m) ** 2, mean, deviation) + noise
    c = integrate_1d(lambda x: (x - mean) * smooth(x, np), mean, deviation)
    law = tf.AdditiveGaussian(lambda x: smooth(x, torch), tensor([[noise]]))
    result = update(law, belief([mean], [[deviation**2]]), tensor([y]), gauss_hermite(14))
    assert result.belief.mean.item() == pytest.approx(mean + c / s * (y - m), abs=1e-9)
    assert result.belief.covariance.item() == pytest.approx(deviation**2 - c**2 / s, abs=1e-9)
    assert result.nis.item() == pytest.approx((y - m) ** 2 / s, abs=1e-9)
    assert result.innovation.item() == pytest.approx(y - m, abs=1e-9)
    assert result.innovation_scale_tril.item() ** 2 == pytest.approx(s, abs=1e-9)
    expected = -0.5 * ((y - m) ** 2 / s + math.log(2 * math.pi * s))
    assert result.log_likelihood.item() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", RULES)
def test_missing_components_are_marginalised(name):
    """A law of two components with one missing equals the law of the other alone, correlated noise and all."""
    noise = tensor([[0.4, 0.3], [0.3, 0.5]])
    prior = belief([0.5, -0.3], [[0.3, 0.1], [0.1, 0.2]])

    def both(x):
        return torch.stack([x[..., 0] * x[..., 1], torch.exp(x[..., 0])], -1)

    for iterations in (1, 3):
        for seen in (0, 1):
            y = tensor([0.7, 1.9])
            y[1 - seen] = torch.nan
            found = update(tf.AdditiveGaussian(both, noise), prior, y, RULES[name], iterations=iterations)
            alone = tf.AdditiveGaussian(lambda x, k=seen: both(x)[..., k : k + 1], noise[seen, seen].reshape(1, 1))
            expected = update(alone, prior, y[seen : seen + 1], RULES[name], "none", iterations)
            torch.testing.assert_close(found.belief.mean, expected.belief.mean, rtol=0, atol=1e-13)
            torch.testing.assert_close(found.belief.covariance, expected.belief.covariance, rtol=0, atol=1e-13)
            torch.testing.assert_close(found.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-12)
            torch.testing.assert_close(found.nis, expected.nis, rtol=0, atol=1e-12)
            assert found.innovation[1 - seen] == 0


def test_iterated_posterior_linearisation_settles():
    """A fixed point of its own equation: linear regression about the posterior gives that posterior back."""
    law = tf.AdditiveGaussian(lambda x: smooth(x, torch), tensor([[0.05]]))
    prior, rule = belief([0.4], [[0.64]]), gauss_hermite(9)
    one, many, more = (update(law, prior, tensor([1.3]), rule, iterations=k).belief for k in (1, 40, 41))
    torch.testing.assert_close(many.mean, more.mean, rtol=0, atol=1e-12)
    assert (one.mean - many.mean).abs() > 1e-3
    m, deviation = many.mean.item(), many.scale_tril.item()
    slope = integrate_1d(lambda x: (x - m) * smooth(x, np), m, deviation) / deviation**2
    centre = integrate_1d(lambda x: smooth(x, np), m, deviation)
    rest = integrate_1d(lambda x: (smooth(x, np) - centre - slope * (x - m)) ** 2, m, deviation) + 0.05
    variance = 1 / (1 / 0.64 + slope**2 / rest)
    mean = 0.4 + variance * slope / rest * (1.3 - centre - slope * (0.4 - m))
    assert deviation**2 == pytest.approx(variance, abs=1e-9)
    assert m == pytest.approx(mean, abs=1e-9)


# Refusals


def test_refusals():
    with pytest.raises(ValueError, match="alpha must be positive, got 0"):
        unscented(alpha=0.0)
    with pytest.raises(ValueError, match=r"size \+ kappa must be positive, got 2 \+ -2"):
        unscented(kappa=-2.0).build(2)
    with pytest.raises(ValueError, match="order must be at least 2, got 1"):
        gauss_hermite(1)
    with pytest.raises(ValueError, match=r"10 \*\* 6 points are too many"):
        gauss_hermite(10).build(6)
    law = tf.AdditiveGaussian(lambda x: x[..., :1], tensor([[1.0]]))
    with pytest.raises(ValueError, match="turns 2 state numbers into 1"):
        predict(law, belief([0.0, 0.0], np.eye(2)), taylor(), None, None)
    with pytest.raises(ValueError, match="measurement has 2 numbers, the observation law gives 1"):
        update(law, belief([0.0, 0.0], np.eye(2)), tensor([0.0, 1.0]), taylor())


@pytest.mark.parametrize("name", RULES)
def test_rules_reach_another_process(name):
    """Pickled and copied they are the same rule; so are filters that hold them."""
    rule = RULES[name]
    eye = torch.eye(2, dtype=torch.float64)
    law = tf.AdditiveGaussian(torch.sin, eye)
    model = tf.StateSpaceModel(tf.Gaussian(eye[0], eye), law, law)
    y = tensor([[0.3, 0.1], [0.2, 0.5]])
    for filter in (tf.GaussianFilter(model, rule), tf.LocallyLinearizedParticleFilter(model, 5, rule)):
        expected = filter(y)
        for twin in (pickle.loads(pickle.dumps(filter)), copy.deepcopy(filter)):
            assert torch.equal(twin(y).mean, expected.mean)


def test_rules_are_held_once_and_do_not_leak_precision():
    assert unscented() is unscented()
    law = tf.AdditiveGaussian(torch.sin, torch.eye(2))
    single = tf.Gaussian(torch.zeros(2), torch.eye(2))
    for rule in RULES.values():
        line = rule.linearize(law, single, None, None)
        for part in (line.mean, line.slope, line.residual, line.noise, line.negative):
            assert part is None or part.dtype == torch.float32
