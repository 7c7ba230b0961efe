"""What a particle filter does with measurements, particles and laws that give trouble."""

import numpy as np
import pytest
import torch
from oracles import grid_oracle
from particle_problem import PLANE, bias_score, gaussian, replicate, series, state_space, tensor

import torchfilt as tf
from torchfilt.resampling import ess_below, never, systematic
from torchfilt.spaces import Angle, UnitQuaternion

JOINT = dict(redraw="always", split=0.0, pooled=False, weights="joint")
FILTERS = {
    "bootstrap": lambda model: tf.BootstrapFilter(model, 200),
    "bootstrap-adaptive": lambda model: tf.BootstrapFilter(model, 200, ess_below(0.5)),
    "joint": lambda model: tf.UnscentedParticleFilter(model, 100, **JOINT),
    "bank": lambda model: tf.LocallyLinearizedParticleFilter(model, 100, redraw="resample"),
    "pooled": lambda model: tf.UnscentedParticleFilter(model, 100),
}


class Bounded(torch.nn.Module):
    """A measurement is within 1 of the first coordinate, or impossible."""

    def forward(self, x):
        return torch.distributions.Uniform(x[..., :1] - 1, x[..., :1] + 1, validate_args=False)


@pytest.mark.parametrize("resampler", [systematic, ess_below(0.5), never()], ids=lambda r: f"{r.threshold}")
def test_row_that_no_particle_explains_reports_and_recovers(resampler):
    """Row 0 sees something impossible at step 1: -inf and not ok there, its neighbour and its own future are sound."""
    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, linear.transition, Bounded())
    filter = tf.BootstrapFilter(model, 300, resampler)
    ys = tensor([[[0.1], [0.1]], [[1e6], [0.2]], [[0.0], [0.1]], [[0.3], [0.3]]])
    history = filter(ys, seed=1, throw=False)
    ok, log = history.diagnostics.ok, history.diagnostics.log_likelihood
    assert ok.tolist() == [[True, True], [False, True], [True, True], [True, True]]
    assert log[1, 0] == -np.inf and torch.isfinite(log[ok]).all()
    assert torch.isfinite(history.mean).all() and torch.isfinite(history.covariance).all()
    calm = filter(torch.where(ys > 1e5, 0.2, ys), seed=1)
    np.testing.assert_allclose(history.mean[:, 1], calm.mean[:, 1], rtol=0, atol=1e-12)
    with pytest.raises(tf.FilterError, match=r"step 1, rows \[\(0,\)\].*1000000.0"):
        filter(ys, seed=1)
    state = filter.init((2,), 1)
    state, _ = filter.step(state, ys[0])
    with pytest.raises(tf.FilterError, match=r"step 1, rows \[\(0,\)\]"):
        filter.step(state, ys[1])


@pytest.mark.parametrize("name", FILTERS)
def test_particles_that_a_law_cannot_move_lose_their_weight(name):
    """The motion is not a number right of 1.2: such particles get weight zero, their row goes on with the others.

    The exact answer is then that of the prior cut off at 1.2; here only soundness is asked, and a neighbour that never
    comes near keeps its numbers.
    """
    A = tensor(PLANE.A)

    def motion(x):
        return torch.where(x[..., :1] > 1.2, torch.nan, x @ A.mT)

    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, tf.AdditiveGaussian(motion, tensor(PLANE.Q)), linear.observation)
    filter = FILTERS[name](model)
    state = filter.init((2,), 3)
    far = state.belief.x - tensor([[[0.0, 0.0]], [[6.0, 0.0]]])
    state = state._replace(belief=state.belief._replace(x=far))
    y = tensor([[0.3], [-5.0]])
    after, info = filter.step(state, y)
    weights = after.belief.weights
    assert (weights[0] == 0).any() and (weights[1] > 0).all()
    assert info.ok.all() and torch.isfinite(info.log_likelihood).all()
    for _ in range(3):
        assert torch.isfinite(after.belief.x).all() and torch.isfinite(after.belief.covariance).all()
        np.testing.assert_allclose(after.belief.weights.sum(-1), 1, rtol=1e-12)
        after, info = filter.step(after, y)
        assert info.ok.all()


@pytest.mark.parametrize("name", FILTERS)
def test_nothing_measured_is_pure_prediction(name):
    """Against the exact prediction, 5 standard errors of the mean over particles; log-likelihood zero."""
    ys = torch.full((3, 1), torch.nan, dtype=torch.float64)
    history = FILTERS[name](state_space(PLANE))(ys, seed=4)
    exact = tf.KalmanFilter(state_space(PLANE))(ys)
    assert (history.diagnostics.log_likelihood.abs() < 1e-12).all() and history.diagnostics.ok.all()
    deviation = exact.covariance.diagonal(dim1=-2, dim2=-1).sqrt() / 100**0.5
    assert ((history.mean - exact.mean).abs() < 5 * deviation).all()


def test_joint_distribution_with_some_components_missing_is_refused():
    """A torch law joint over its components cannot be marginalised: the error says so."""

    class Joint(torch.nn.Module):
        def forward(self, x):
            return torch.distributions.Independent(torch.distributions.Laplace(x, 1.0, validate_args=False), 1)

    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, linear.transition, Joint())
    filter = tf.BootstrapFilter(model, 50)
    assert filter(tensor([[0.1, 0.2], [np.nan, np.nan]]), seed=1).diagnostics.log_likelihood[1] == 0
    with pytest.raises(ValueError, match="Independent is joint over its components"):
        filter(tensor([[0.1, np.nan]]), seed=1)


def test_a_multivariate_normal_loses_components_exactly():
    """Its margins are known: the same bits as with our own Gaussian."""

    class Joint(torch.nn.Module):
        def __init__(self, own):
            super().__init__()
            self.own = own

        def forward(self, x):
            factor = torch.tensor([[1.0, 0.0], [0.8, 0.3]], dtype=x.dtype)
            if self.own:
                return tf.Gaussian(x, factor)
            return torch.distributions.MultivariateNormal(x, scale_tril=factor, validate_args=False)

    linear = state_space(PLANE)
    models = [tf.StateSpaceModel(linear.initial, linear.transition, Joint(own)) for own in (True, False)]
    ys = tensor([[[0.1, 0.2], [0.3, np.nan]], [[np.nan, np.nan], [0.3, 0.2]]])
    one, two = (tf.BootstrapFilter(model, 50)(ys, seed=1).log_likelihood for model in models)
    torch.testing.assert_close(one, two, rtol=0, atol=1e-12)


class StudentSight(torch.nn.Module):
    """Independent heavy-tailed components: NaN ones drop out."""

    def forward(self, x):
        return torch.distributions.StudentT(3.0, x, 0.5)


GRID = np.linspace(-25, 25, 2001)


def student(after, location, scale, freedom):
    from scipy import stats

    return stats.t.logpdf((after - location) / scale, freedom) - np.log(scale)


def test_student_laws_everywhere_against_a_grid():
    """Initial, transition and observation all heavy-tailed, with an outlier; unbiased evidence (4.5 standard errors)
    and the last mean."""

    class Step(torch.nn.Module):
        def forward(self, x):
            return torch.distributions.StudentT(4.0, 0.9 * x, 0.4)

    initial = torch.distributions.StudentT(tensor([5.0]), tensor([0.5]), tensor([0.8]))
    model = tf.StateSpaceModel(initial, Step(), StudentSight())
    ys = np.array([0.4, 0.9, 9.0, 0.7])
    logs, means, variances = grid_oracle.grid_filter(
        GRID,
        lambda x: student(x, 0.5, 0.8, 5.0),
        lambda after, x: student(after, 0.9 * x, 0.4, 4.0),
        lambda y, x: student(y, x, 0.5, 3.0),
        ys,
    )
    history = tf.BootstrapFilter(model, 300)(replicate(tensor(ys[:, None]), 400), seed=5)
    score, mean, error = bias_score(history.log_likelihood, logs.sum())
    assert error < 0.02 and abs(score) < 4.5, (mean, error)
    found = history.mean[-1, :, 0]
    # Self-normalised weights bias a mean by order 1/n: allow one posterior deviation / 300.
    slack = variances[-1] ** 0.5 / 300
    assert abs(found.mean() - means[-1]) < 4.5 * found.std() / 400**0.5 + slack


def test_missing_components_of_a_student_law():
    """Rows with a component missing equal the smaller law."""
    linear = state_space(PLANE)
    both = tf.StateSpaceModel(linear.initial, linear.transition, StudentSight())

    class First(torch.nn.Module):
        def forward(self, x):
            return torch.distributions.StudentT(3.0, x[..., :1], 0.5)

    first = tf.StateSpaceModel(linear.initial, linear.transition, First())
    ys = tensor([[0.3, np.nan], [1.0, np.nan]])
    one = tf.BootstrapFilter(both, 100)(ys, seed=6)
    other = tf.BootstrapFilter(first, 100)(ys[:, :1], seed=6)
    np.testing.assert_allclose(one.log_likelihood, other.log_likelihood, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.mean, other.mean, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
def test_angles_wrap_in_likelihoods(name):
    """A heading near pi, measured a turn away or from the other side: the same numbers to rounding."""
    model = tf.StateSpaceModel(
        gaussian(tensor([3.1]), tensor([[0.04]]), Angle(1)),
        tf.AdditiveGaussian(lambda x: x + 0.02, tensor([[0.001]]), Angle(1)),
        tf.AdditiveGaussian(lambda x: x, tensor([[0.01]]), Angle(1)),
    )
    ys = tensor([[3.13], [-3.12], [-3.10], [-3.08]])
    history = FILTERS[name](model)(ys, seed=7)
    turned = FILTERS[name](model)(ys + 2 * np.pi * tensor([[1], [-1], [2], [0]]), seed=7)
    np.testing.assert_allclose(turned.log_likelihood, history.log_likelihood, rtol=0, atol=1e-9)
    away = Angle(1).local(history.mean, turned.mean).abs().max()
    assert away < 1e-9
    # Unwrapped, the problem is linear: the exact filter on the line is the answer.
    line = tf.StateSpaceModel(
        gaussian(tensor([3.1]), tensor([[0.04]])),
        tf.LinearGaussian(tensor([[1.0]]), tensor([[0.001]]), tensor([0.02])),
        tf.LinearGaussian(tensor([[1.0]]), tensor([[0.01]])),
    )
    exact = tf.KalmanFilter(line)(torch.where(ys < 0, ys + 2 * np.pi, ys))
    off = Angle(1).local(exact.mean, history.mean).abs()
    assert (off < 5 * exact.covariance.squeeze(-1).sqrt() / 100**0.5).all()
    assert (history.mean.abs() <= np.pi + 1e-12).all()


@pytest.mark.parametrize("name", FILTERS)
def test_quaternions_stay_unit_and_turn_right(name):
    """A slow turn seen through its rotation vector; every particle stays on the sphere to rounding."""
    space = UnitQuaternion()
    rate = tensor([0.0, 0.0, 0.1])

    def turn(x):
        return space.retract(x, rate.expand(*x.shape[:-1], 3))

    model = tf.StateSpaceModel(
        gaussian(tensor([0.0, 0.0, 0.0, 1.0]), 0.2 * torch.eye(3).double(), space),
        tf.AdditiveGaussian(turn, 1e-3 * torch.eye(3).double(), space),
        tf.AdditiveGaussian(lambda x: x, 1e-2 * torch.eye(3).double(), space),
    )
    truth, ys = tensor([0.1, -0.2, 0.0, 1.0]), []
    truth = space.project(truth)
    for _ in range(8):
        truth = turn(truth)
        ys.append(truth * (-1) ** len(ys))  # q and -q are the same attitude
    history = FILTERS[name](model)(torch.stack(ys), seed=8, record="beliefs")
    norms = torch.linalg.vector_norm(history.beliefs.x, dim=-1)
    assert (norms - 1).abs().max() < 1e-14
    assert (torch.linalg.vector_norm(history.mean, dim=-1) - 1).abs().max() < 1e-14
    error = space.local(truth, history.mean[-1])
    # Posterior deviation of an axis is about 0.05 rad, its Monte Carlo error with 100 particles of some ESS far less.
    assert error.abs().max() < 0.1
    assert history.covariance.shape == (8, 3, 3)


def test_global_generator_is_put_back_by_laws_that_draw_themselves():
    linear = state_space(PLANE)

    class Step(torch.nn.Module):
        def forward(self, x):
            return torch.distributions.Laplace(0.9 * x, 0.4)

    filter = tf.BootstrapFilter(tf.StateSpaceModel(linear.initial, Step(), linear.observation), 50)
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one = filter(series(3)[0], seed=2)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(99)
    other = filter(series(3)[0], seed=2)
    assert torch.equal(one.mean, other.mean)
    assert not torch.equal(one.mean, filter(series(3)[0], seed=3).mean)
