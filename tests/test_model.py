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


def test_the_covariance_of_a_mixture_holds_what_its_means_share():
    """Law of total covariance, written out: components that are independent inside are not so across the mixture."""
    weights, means = np.array([0.2, 0.5, 0.3]), np.array([[0.0, 1.0], [2.0, 3.0], [-1.0, 0.5]])
    mean = weights @ means
    expected = COVARIANCE.numpy() + sum(w * np.outer(m - mean, m - mean) for w, m in zip(weights, means, strict=True))
    joint = td.MultivariateNormal(tensor(means), COVARIANCE)
    found = as_gaussian(td.MixtureSameFamily(td.Categorical(tensor(weights)), joint))
    torch.testing.assert_close(found.covariance, tensor(expected), rtol=0, atol=1e-15)
    torch.testing.assert_close(found.mean, tensor(mean), rtol=0, atol=1e-15)


def test_a_scalar_law_is_a_state_of_one_number():
    own = tf.Gaussian(tensor([0.5]), tensor([[2.0]]))
    walk = tf.LinearGaussian(EYE[:1, :1], 0.1 * EYE[:1, :1])
    y = tensor([[1.0], [0.5]])
    one, two = (tf.KalmanFilter(tf.StateSpaceModel(p, walk, walk))(y) for p in (own, td.Normal(own.mean[0], 2.0)))
    torch.testing.assert_close(one.log_likelihood, two.log_likelihood, rtol=0, atol=1e-15)


@pytest.mark.parametrize("particles", [3, 5])  # 3 particles and 3 rows: nothing may be paired by accident
def test_priors_of_each_row_reach_the_particles(particles):
    """Deviations of each row give the same draws as their factors; a torch law draws each row about its own mean."""
    deviations = tensor([[1.0, 2.0], [10.0, 20.0], [100.0, 200.0]])
    mean = torch.zeros(3, 2, dtype=torch.float64)
    priors = [
        tf.Gaussian(mean, deviations, is_diagonal=True),
        tf.Gaussian(mean, torch.diag_embed(deviations)),
        tf.Gaussian(mean[0], torch.diag_embed(deviations)),
    ]
    clouds = [
        tf.BootstrapFilter(tf.StateSpaceModel(prior, WALK, WALK), particles).init((3,)).belief for prior in priors
    ]
    assert clouds[0].x.shape == (3, particles, 2)
    for cloud in clouds[1:]:
        assert torch.equal(cloud.x, clouds[0].x)
    far = tensor([[0.0, 1e4], [2e4, 3e4], [4e4, 5e4]])
    for law in (td.MultivariateNormal(far, EYE), td.Normal(far, 1.0)):
        filter = tf.BootstrapFilter(tf.StateSpaceModel(law, WALK, WALK), particles)
        x = filter.init((3,)).belief.x
        assert ((x - far.unsqueeze(-2)).abs() < 7).all() and len(x.unique()) == x.numel()
        with pytest.raises(ValueError, match=r"the prior is for a batch of \(3,\), not \(4,\)"):
            filter.init((4,))
    with pytest.raises(ValueError, match=r"the prior is for a batch of \(3,\), not \(4,\)"):
        tf.KalmanFilter(tf.StateSpaceModel(priors[2], WALK, WALK)).init((4,))


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
    found = log_prob(td.MultivariateNormal(PRIOR.mean.expand(4, 2), COVARIANCE), y)
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-14)
    parts = td.MixtureSameFamily(td.Categorical(torch.ones(1)), td.MultivariateNormal(PRIOR.mean[None], COVARIANCE))
    with pytest.raises(ValueError, match="MixtureSameFamily is joint over its components"):
        log_prob(parts, y[:2])
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
    "scalar mean": ({"mean": PRIOR.mean[0]}, r"initial mean must be \(\*batch, d\) on Euclidean.*got \(\)"),
    "size on the space": ({"space": tf.UnitQuaternion()}, r"initial mean must be \(\*batch, 4\) on Unit.*got \(2,\)"),
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
    joint = {"pooled": False, "split": 0.0, "weights": "joint"}
    for build in (
        tf.ExtendedKalmanFilter,
        tf.UnscentedKalmanFilter,
        lambda model: tf.BootstrapFilter(model, 10),
        lambda model: tf.UnscentedParticleFilter(model, 10, **joint),
    ):
        filter = build(tf.StateSpaceModel(angle, law, law))
        with pytest.raises(ValueError, match=r"the transition law .* Euclidean.*Angle"):
            filter(tensor([[3.0]]))


def test_a_torch_transition_leaves_particles_on_their_space():
    """Across the cut of an angle the mean stays at the cut; taken for numbers it would lie on the other side."""
    angle = tf.Gaussian(tensor([3.1]), 0.3 * EYE[:1, :1], tf.Angle())
    sight = tf.AdditiveGaussian(lambda x: x, 0.05 * EYE[:1, :1], tf.Angle())
    model = tf.StateSpaceModel(angle, lambda x: td.Normal(x, 0.1, validate_args=False), sight)
    history = tf.BootstrapFilter(model, 200)(tensor([[3.12], [-3.12]]))
    assert history.space == tf.Angle()
    assert (tf.Angle().local(tensor([math.pi]), history.mean).abs() < 0.3).all()


@pytest.mark.parametrize("law", [lambda x: td.Normal(x, 1.0), lambda x: td.Normal(x[..., 0], 1.0)])
def test_measurements_of_another_size_than_a_torch_law_are_refused(law):
    """Three numbers would otherwise be compared with the only one, without a word."""
    x, y = torch.zeros(4, 2, 1, dtype=torch.float64), torch.zeros(4, 1, 3, dtype=torch.float64)
    for missing in ("none", "rows"):
        with pytest.raises(ValueError, match="the measurement has 3 numbers"):
            log_prob(law(x), y, missing)


def test_missing_components_of_a_law_without_a_mean_have_finite_gradients():
    scale = tensor(0.3).requires_grad_()
    value = log_prob(td.Cauchy(tensor([0.0, 1.0]), scale), tensor([0.5, math.nan]))
    (gradient,) = torch.autograd.grad(value, scale)
    (expected,) = torch.autograd.grad(td.Cauchy(0.0, scale).log_prob(tensor(0.5)), scale)
    torch.testing.assert_close(gradient, expected, rtol=1e-14, atol=0)


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


@pytest.mark.parametrize(
    ("prior", "transition", "observation", "error", "message"),
    [
        (3, (2, 2), (1, 2), ValueError, r"transition's matrix \(..., 2, 2\) does not fit a state of 3 numbers"),
        (2, (3, 2), (1, 2), ValueError, r"transition's matrix \(..., 3, 2\) does not fit a state of 2 numbers"),
        (2, (2, 2), (1, 3), ValueError, r"observation's matrix \(..., 1, 3\) does not fit a state of 2 numbers"),
    ],
)
def test_linear_laws_must_fit_the_prior(prior, transition, observation, error, message):
    def law(rows, columns):
        return tf.LinearGaussian(torch.ones(rows, columns, dtype=torch.float64), torch.eye(rows, dtype=torch.float64))

    initial = tf.Gaussian(torch.zeros(prior, dtype=torch.float64), torch.eye(prior, dtype=torch.float64))
    with pytest.raises(error, match=message):
        tf.StateSpaceModel(initial, law(*transition), law(*observation))


def test_precisions_of_prior_and_laws_must_agree():
    initial = tf.Gaussian(torch.zeros(2), torch.eye(2))
    law = tf.LinearGaussian(torch.eye(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"transition.s matrix is torch\.float64, the initial mean torch\.float32"):
        tf.StateSpaceModel(initial, law, law)
    with pytest.raises(TypeError, match=r"initial mean must be floating point, got torch\.int64"):
        tf.StateSpaceModel(tf.Gaussian(torch.zeros(2, dtype=torch.int64), torch.eye(2)), law, law)


def test_controls_that_no_law_takes_are_refused():
    one = torch.eye(1, dtype=torch.float64)
    law = tf.AdditiveGaussian(lambda x: x, one)
    model = tf.StateSpaceModel(tf.Gaussian(torch.zeros(1, dtype=torch.float64), one), lambda x: law(x), law)
    tracker = tf.UnscentedKalmanFilter(model)
    y = torch.zeros(3, 1, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"controls \(3, 1\) were given, but no law of the model has an argument u"):
        tracker(y, y)
    with pytest.raises(ValueError, match=r"u \(1,\) were given, but no law of the model has an argument u"):
        tracker.step(tracker.init(), y[0], y[0])
