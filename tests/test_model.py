"""The three laws together: laws of torch, their moments and densities, what is refused."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import distributions as td

import torchfilt as tf
from torchfilt.model import as_gaussian, log_prob, sample


def tensor(value):
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


EYE = torch.eye(2, dtype=torch.float64)
COVARIANCE = tensor([[0.5, 0.2], [0.2, 0.4]])
PRIOR = tf.Gaussian(tensor([1.0, -1.0]), torch.linalg.cholesky(COVARIANCE))
WALK = tf.LinearGaussian(EYE, 0.1 * EYE)


def test_moments_of_torch_laws():
    """Mean and covariance of each family as torch states them."""
    normal = td.Normal(tensor([1.0, 2.0]), tensor([0.5, 0.2]))
    joint = td.MultivariateNormal(tensor([1.0, 2.0]), COVARIANCE)
    low = td.LowRankMultivariateNormal(tensor([1.0, 2.0]), tensor([[0.3], [0.4]]), tensor([0.1, 0.2]))
    for law, covariance in (
        (normal, torch.diag(normal.variance)),
        (td.Independent(normal, 1), torch.diag(normal.variance)),
        (joint, COVARIANCE),
        (low, low.covariance_matrix),
        (td.Poisson(tensor([3.0, 4.0])), torch.diag(tensor([3.0, 4.0]))),
        (td.StudentT(tensor(5.0), tensor([1.0, 2.0]), tensor([1.0, 1.0])), 5 / 3 * EYE),
    ):
        found = as_gaussian(law)
        torch.testing.assert_close(found.mean, law.mean)
        torch.testing.assert_close(found.covariance, covariance)
    assert as_gaussian(PRIOR) is PRIOR
    with pytest.raises(TypeError, match="must return a Gaussian or a torch Distribution, got Tensor"):
        as_gaussian(tensor([1.0]))


PRIORS = {
    "MultivariateNormal": td.MultivariateNormal(PRIOR.mean, COVARIANCE),
    "module": None,
    "Gaussian": PRIOR,
}


@pytest.mark.parametrize("name", PRIORS)
def test_priors(name):
    class Own(torch.nn.Module):
        def forward(self):
            return td.MultivariateNormal(PRIOR.mean, COVARIANCE)

    initial = PRIORS[name] if PRIORS[name] is not None else Own()
    model = tf.StateSpaceModel(initial, WALK, WALK)
    torch.testing.assert_close(model.prior().mean, PRIOR.mean, rtol=0, atol=0)
    torch.testing.assert_close(model.prior().covariance, COVARIANCE, rtol=0, atol=1e-15)
    history = tf.KalmanFilter(model)(tensor([[1.0, 0.0], [0.5, math.nan]]))
    expected = tf.KalmanFilter(tf.StateSpaceModel(PRIOR, WALK, WALK))(tensor([[1.0, 0.0], [0.5, math.nan]]))
    torch.testing.assert_close(history.mean, expected.mean, rtol=0, atol=1e-15)


def test_a_diagonal_prior():
    diagonal = tf.Gaussian(tensor([1.0, 2.0]), tensor([0.5, 0.2]), is_diagonal=True)
    full = tf.Gaussian(tensor([1.0, 2.0]), torch.diag(tensor([0.5, 0.2])))
    y = tensor([[1.0, 0.0]])
    one, two = (tf.KalmanFilter(tf.StateSpaceModel(prior, WALK, WALK))(y) for prior in (diagonal, full))
    assert torch.equal(one.mean, two.mean)
    assert torch.equal(one.covariance, two.covariance)


def test_gaussian_filters_take_torch_laws_by_their_moments():
    """A law that returns a MultivariateNormal is the same filter; a Student law is the Gaussian of its variance."""

    def torch_law(x):
        return td.MultivariateNormal(torch.sin(x), 0.2 * EYE)

    def student(x):
        return td.StudentT(tensor(6.0), torch.sin(x), tensor(0.5).sqrt())

    plain = tf.AdditiveGaussian(torch.sin, 0.2 * EYE)
    scaled = tf.AdditiveGaussian(torch.sin, 0.5 * 1.5 * EYE)
    ys = tensor([[0.5, 0.2], [math.nan, 0.4], [0.1, -0.5]])
    for build in (
        tf.ExtendedKalmanFilter,
        tf.UnscentedKalmanFilter,
        tf.CubatureKalmanFilter,
        tf.GaussHermiteKalmanFilter,
    ):
        for law, twin in ((torch_law, plain), (student, scaled)):
            one, two = (build(tf.StateSpaceModel(PRIOR, WALK, own))(ys) for own in (law, twin))
            torch.testing.assert_close(one.mean, two.mean, rtol=0, atol=1e-14)
            torch.testing.assert_close(one.covariance, two.covariance, rtol=0, atol=1e-14)
            torch.testing.assert_close(one.log_likelihood, two.log_likelihood, rtol=0, atol=1e-13)


class SeesOnly(torch.nn.Module):
    """A measurement law with its own linear form, called as law(x) only."""

    def linear_form(self, u=None, dt=None):
        return EYE[:1], None, 0.3 * EYE[:1, :1]

    def forward(self, x):
        return tf.Gaussian(x[..., :1], 0.3 * EYE[:1, :1])


class PoolsItself(torch.nn.Module):
    """The same with `pooled`."""

    def pooled(self, points, weights, u=None, dt=None):
        return tf.Gaussian(points[..., :1], 0.3 * EYE[:1, :1])

    def forward(self, x):
        return tf.Gaussian(x[..., :1], 0.3 * EYE[:1, :1])


@pytest.mark.parametrize("law", [SeesOnly(), PoolsItself()])
def test_laws_with_short_cuts_need_not_take_what_they_do_not_use(law):
    ys = tensor([[0.5], [0.2]])
    plain = tf.AdditiveGaussian(lambda x: x[..., :1], scale_tril=0.3 * EYE[:1, :1])
    for rule in (tf.moments.taylor(), tf.moments.unscented(), tf.moments.gauss_hermite(3)):
        one, two = (tf.GaussianFilter(tf.StateSpaceModel(PRIOR, WALK, own), rule)(ys) for own in (law, plain))
        torch.testing.assert_close(one.mean, two.mean, rtol=0, atol=1e-14)
        torch.testing.assert_close(one.covariance, two.covariance, rtol=0, atol=1e-14)


def test_is_linear_and_the_evidence_it_promises():
    bent = tf.AdditiveGaussian(torch.sin, EYE)
    assert tf.StateSpaceModel(PRIOR, WALK, WALK).is_linear()
    for laws in ((bent, WALK), (WALK, bent)):
        model = tf.StateSpaceModel(PRIOR, *laws)
        assert not model.is_linear()
        assert tf.UnscentedKalmanFilter(model).evidence == "linearized"
        with pytest.raises(
            TypeError, match=r"KalmanFilter needs linear laws; .* is a AdditiveGaussian without linear_form"
        ):
            tf.KalmanFilter(model)
    assert tf.KalmanFilter(tf.StateSpaceModel(PRIOR, WALK, WALK)).evidence == "exact"


# Densities


def test_densities_with_missing_components():
    """Against SciPy's marginals: our Gaussian, an independent torch law, a joint one."""
    y = tensor([[0.5, 0.2], [math.nan, 0.2], [0.5, math.nan], [math.nan, math.nan]])
    ours = log_prob(tf.Gaussian(PRIOR.mean, PRIOR.scale_tril), y)
    mean, deviation = PRIOR.mean.numpy(), np.sqrt(np.diag(COVARIANCE))
    expected = [
        stats.multivariate_normal(mean, COVARIANCE.numpy()).logpdf(y[0].numpy()),
        stats.norm(mean[1], deviation[1]).logpdf(0.2),
        stats.norm(mean[0], deviation[0]).logpdf(0.5),
        0.0,
    ]
    np.testing.assert_allclose(ours.numpy(), expected, rtol=0, atol=1e-14)
    laplace = td.Laplace(PRIOR.mean.expand(4, 2), tensor([0.5, 2.0]))
    parts = stats.laplace(mean, [0.5, 2.0]).logpdf(y.numpy())
    np.testing.assert_allclose(log_prob(laplace, y).numpy(), np.nansum(parts, -1), rtol=0, atol=1e-14)
    joint = td.MultivariateNormal(PRIOR.mean.expand(2, 2), COVARIANCE)
    np.testing.assert_allclose(log_prob(joint, y[[0, 3]]).numpy(), [expected[0], 0.0], rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="MultivariateNormal is joint over its components"):
        log_prob(joint, y[:2])
    with pytest.raises(ValueError, match="measurement has 1 numbers, the observation law 2"):
        log_prob(PRIOR, y[:, :1])


def test_draws_leave_the_global_generator_alone():
    law = td.Gamma(tensor([2.0, 3.0]), tensor([1.0, 1.0]))
    before = torch.random.get_rng_state()
    one, two, other = sample(law, tensor([0.0]), 1), sample(law, tensor([0.0]), 1), sample(law, tensor([0.0]), 2)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


# Refusals and state


LAWS = {
    "prior": ((tensor([1.0]), WALK, WALK), "initial must be a Gaussian.*got Tensor"),
    "transition": ((PRIOR, EYE, WALK), "transition must be a law.*got Tensor"),
    "observation": ((PRIOR, WALK, 3), "observation must be a law.*got int"),
}
NAME = "initial scale_tril must"
PRIOR_PARTS = {
    "NaN mean": ({"mean": PRIOR.mean * math.nan}, r"initial mean must be finite, entry \(0,\)"),
    "infinite factor": ({"scale_tril": EYE * math.inf}, f"{NAME} be finite"),
    "size of the factor": ({"scale_tril": EYE[:1, :1]}, rf"{NAME} end in 2, got \(1, 1\)"),
    "factor not square": ({"scale_tril": EYE[:1]}, rf"{NAME} be a square matrix .*\(1, 2\)"),
    "factor not lower": ({"scale_tril": COVARIANCE}, rf"{NAME} be lower triangular, entry \(0, 1\) is 0\.2"),
    "quaternion": ({"mean": tensor([0.0, 0, 0, 1]), "space": tf.UnitQuaternion()}, rf"{NAME} end in 3, got \(2, 2\)"),
}


@pytest.mark.parametrize("name", LAWS)
def test_what_is_not_a_law_is_refused(name):
    laws, message = LAWS[name]
    with pytest.raises(TypeError, match=message):
        tf.StateSpaceModel(*laws)


@pytest.mark.parametrize("name", PRIOR_PARTS)
def test_priors_that_are_refused(name):
    changes, message = PRIOR_PARTS[name]
    with pytest.raises(ValueError, match=message):
        tf.StateSpaceModel(PRIOR._replace(**changes), WALK, WALK)


def test_a_transition_onto_another_space_is_refused():
    """A heading with a plain transition law would silently become a number."""
    angle = tf.Gaussian(tensor([3.0]), EYE[:1, :1], tf.Angle())
    law = tf.AdditiveGaussian(lambda x: x, EYE[:1, :1])
    for build in (tf.ExtendedKalmanFilter, tf.UnscentedKalmanFilter):
        filter = build(tf.StateSpaceModel(angle, law, law))
        with pytest.raises(ValueError, match=r"the transition law .* Euclidean.*Angle"):
            filter(tensor([[3.0]]))


def test_copies_precision_and_state():
    model = tf.StateSpaceModel(PRIOR, WALK, tf.AdditiveGaussian(torch.sin, 0.2 * EYE))
    filter = tf.UnscentedKalmanFilter(model)
    y = tensor([[0.5, 0.2], [math.nan, 0.4]])
    expected = filter(y)
    twin = copy.deepcopy(filter)
    assert torch.equal(twin(y).mean, expected.mean)
    twin.model.transition.matrix += 1.0
    assert torch.equal(filter(y).mean, expected.mean)
    assert not torch.equal(twin(y).mean, expected.mean)
    twin.load_state_dict(filter.state_dict())
    assert torch.equal(twin(y).mean, expected.mean)
    assert set(filter.state_dict()) == {
        "model.initial.mean", "model.initial.scale_tril", "model.transition.matrix",
        "model.transition.noise.scale_tril", "model.observation.noise.scale_tril",
    }  # fmt: skip
    single = copy.deepcopy(filter).to(torch.float32)
    history = single(y.float())
    assert {history.mean.dtype, history.covariance.dtype, history.log_likelihood.dtype} == {torch.float32}
    torch.testing.assert_close(history.mean.double(), expected.mean, rtol=0, atol=1e-6)
    with pytest.raises(TypeError, match=r"dtype torch\.float32, got torch\.float64"):
        single(y)


def test_the_caller_may_change_his_tensors():
    mean = PRIOR.mean.clone()
    model = tf.StateSpaceModel(PRIOR._replace(mean=mean), WALK, WALK)
    mean += 1
    assert torch.equal(model.prior().mean, PRIOR.mean)
