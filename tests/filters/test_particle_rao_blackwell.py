"""The Rao-Blackwellised particle filter: exact answers, an independent filter of the same noise, fewer particles."""

from collections import Counter

import numpy as np
import pytest
import torch
from oracles import grid_oracle, particle_oracle, rao_blackwell_oracle
from particle_problem import PLANE, POLICIES, bias_score, gaussian, replicate, series, state_space, tensor
from rao_blackwell_problem import MIXED, Motion, mixed_model, mixed_series, plain_model
from test_particle_gradients import EXACT, YS, against_score, gradients, torch_model
from torch.utils._python_dispatch import TorchDispatchMode

import torchfilt as tf
from torchfilt.moments import cubature, taylor, unscented
from torchfilt.resampling import ess_below, never, systematic
from torchfilt.spaces import Euclidean, Product, UnitQuaternion

# Each z-score is held to 4.5 standard errors: a false alarm in 150,000 tests.
Z = 4.5


class Matrices(TorchDispatchMode):
    """Counts the matrices that go through a QR."""

    def __init__(self):
        super().__init__()
        self.count = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if "linalg_qr" in str(function):
            self.count["qr"] += args[0].shape[:-2].numel()
        return function(*args, **(kwargs or {}))


# Linear models ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["never", "adaptive-systematic", "always-systematic", "adaptive-multinomial"])
@pytest.mark.parametrize("drawn", [(0,), (1,), slice(1, None)], ids=str)
def test_evidence_of_a_linear_model_is_unbiased(drawn, policy):
    ys, exact = series(4)
    filter = tf.RaoBlackwellizedParticleFilter(state_space(PLANE), 20, drawn=drawn, resampler=POLICIES[policy])
    history = filter(replicate(ys, 2000), seed=31, record="mean")
    score, mean, error = bias_score(history.log_likelihood, exact.log_likelihood.sum())
    assert filter.evidence == history.evidence == "unbiased"
    assert error < 0.01 and abs(score) < Z, (mean, error)


@pytest.mark.parametrize("drawn", [(0,), (1,)])
def test_moments_of_a_linear_model_approach_the_kalman_filters(drawn):
    """Means over 200 rows of 2000 particles: 4.5 standard errors and the bias of self-normalised weights, order 1/n."""
    ys, exact = series(4)
    filter = tf.RaoBlackwellizedParticleFilter(state_space(PLANE), 2000, drawn=drawn)
    history = filter(replicate(ys, 200), seed=32)
    for found, answer in ((history.mean, exact.mean), (history.covariance, exact.covariance)):
        error = found.std(1) / 200**0.5
        assert (error < 0.002).all()
        assert ((found.mean(1) - tensor(answer)).abs() < Z * error + 2 / 2000).all()


@pytest.mark.parametrize("rule", [taylor(), cubature(), unscented()], ids=["taylor", "cubature", "unscented"])
def test_nothing_drawn_is_the_kalman_filter(rule):
    ys, exact = series(6)
    history = tf.RaoBlackwellizedParticleFilter(state_space(PLANE), 5, drawn=(), rule=rule)(ys, seed=3)
    np.testing.assert_allclose(history.diagnostics.log_likelihood, exact.log_likelihood, rtol=0, atol=1e-12)
    np.testing.assert_allclose(history.mean, exact.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(history.covariance, exact.covariance, rtol=0, atol=1e-12)


def test_nothing_drawn_is_the_extended_filter_on_a_curved_model():
    model, ys = plain_model(), mixed_series(8)
    history = tf.RaoBlackwellizedParticleFilter(model, 3, drawn=())(ys)
    extended = tf.ExtendedKalmanFilter(model)(ys)
    assert history.evidence == "linearized"
    np.testing.assert_allclose(history.log_likelihood, extended.log_likelihood, rtol=0, atol=1e-9)
    np.testing.assert_allclose(history.mean, extended.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(history.covariance, extended.covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("resampler", [systematic, ess_below(0.5), never()], ids=lambda r: f"{r.threshold}")
def test_everything_drawn_is_the_bootstrap_filter(resampler):
    """Bit for bit, on a curved model too."""
    model, ys = plain_model(), mixed_series(6)
    whole = tf.RaoBlackwellizedParticleFilter(model, 50, drawn=slice(None), resampler=resampler)
    one, other = whole(ys, seed=4), tf.BootstrapFilter(model, 50, resampler)(ys, seed=4)
    assert whole.evidence == "unbiased"
    assert torch.equal(one.log_likelihood, other.log_likelihood) and torch.equal(one.mean, other.mean)


# A mixed model ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [0, 2])
@pytest.mark.parametrize("model", [mixed_model, plain_model])
def test_each_particle_is_that_of_an_independent_filter(model, place):
    """The same normals and uniforms, 25 steps with resampling; measurements have gaps.

    Tolerance: rounding of the covariance form, which a single other ancestor would exceed by far.
    """
    filter = tf.RaoBlackwellizedParticleFilter(model(place), 40, drawn=[place])
    ys = mixed_series(25)
    ys[3, 0] = ys[7, 1] = ys[11] = torch.nan
    state = filter.init((), 6)
    order = [place, *(k for k in range(4) if k != place)]
    x, factor = state.belief.x[:, order].numpy(), state.belief.scale_tril[0].numpy()[np.ix_(order, order)]
    assert not factor[0].any()
    start = [(point[:1], point[1:], factor[1:, 1:] @ factor[1:, 1:].T) for point in x]
    noise = [filter.draw(state.belief, k, 6) for k in range(25)]
    normals = np.stack([part.proposal[:, :1].numpy() for part in noise])
    uniforms = [part.resampling.item() for part in noise]
    logs, means, covariances = rao_blackwell_oracle.run(MIXED, start, normals, uniforms, ys.numpy(), 0.5)
    history = filter(ys, seed=6)
    assert (history.diagnostics.ess < 20).any()
    np.testing.assert_allclose(history.diagnostics.log_likelihood, logs, rtol=0, atol=1e-10)
    np.testing.assert_allclose(history.mean[:, order], means, rtol=0, atol=1e-10)
    np.testing.assert_allclose(history.covariance[:, order][:, :, order], covariances, rtol=0, atol=1e-10)


def test_evidence_varies_less_than_that_of_points():
    """300 rows of 100 particles, deviation of the log-evidence 0.29 against 1.8: asked is a fourth. Means likewise.

    Against 1500 points: one evidence, within 4.5 standard errors of the two together.
    """
    ys, model = replicate(mixed_series(6), 300), mixed_model()
    marginal = tf.RaoBlackwellizedParticleFilter(model, 100, drawn=[0])(ys, seed=7, record="mean")
    few, many = (tf.BootstrapFilter(model, n, ess_below(0.5))(ys, seed=7, record="mean") for n in (100, 1500))
    assert marginal.log_likelihood.std() < few.log_likelihood.std() / 4
    assert (marginal.mean[-1].std(0) < few.mean[-1].std(0) / 2).all()
    _, mean, error = bias_score(marginal.log_likelihood, -7.4)
    _, other, other_error = bias_score(many.log_likelihood, -7.4)
    assert error < 0.02 and other_error < 0.02
    assert abs(mean - other) < Z * (error**2 + other_error**2) ** 0.5, (mean, other)


@pytest.mark.parametrize("place", [0, 2])
def test_a_shared_covariance_is_carried_once_a_row(place):
    """Counted: two QRs a row and step against two a particle. The numbers are the same, to the order of sums."""
    ys = replicate(mixed_series(6), 3).clone()
    ys[1, 0, 0] = ys[2, 1] = torch.nan
    histories, counts = [], []
    for model in (mixed_model(place), mixed_model(place, wide=True), plain_model(place)):
        filter = tf.RaoBlackwellizedParticleFilter(model, 50, drawn=[place])
        with Matrices() as matrices:
            histories.append(filter(ys, seed=8, record="beliefs"))
        counts.append(matrices.count["qr"])
    shared, wide, plain = histories
    assert counts[0] == 1 + 6 * 3 * 2 and counts[1] == counts[2] == 1 + 6 * 3 * 50 * 2
    assert shared.beliefs.scale_tril.shape == (6, 3, 1, 4, 4)
    assert wide.beliefs.scale_tril.shape == plain.beliefs.scale_tril.shape == (6, 3, 50, 4, 4)
    assert mixed_model().transition.linear_in and (shared.evidence, plain.evidence) == ("unbiased", "linearized")
    for other in (wide, plain):
        for name in ("mean", "covariance", "log_likelihood"):
            np.testing.assert_allclose(getattr(other, name), getattr(shared, name), rtol=0, atol=1e-11)


def test_derivatives_at_the_rows_mean_are_shared_by_all_its_particles():
    """Laws as plain functions: the same numbers where the matrices are the same everywhere, with two QRs a row."""
    ys = replicate(mixed_series(6), 3).clone()
    ys[1, 0, 0] = ys[2, 1] = torch.nan
    model = plain_model()
    each = tf.RaoBlackwellizedParticleFilter(model, 50, drawn=[0])(ys, seed=8)
    filter = tf.RaoBlackwellizedParticleFilter(model, 50, drawn=[0], shared=True)
    with Matrices() as matrices:
        one = filter(ys, seed=8, record="beliefs")
    assert matrices.count["qr"] == 1 + 6 * 3 * 2 and one.beliefs.scale_tril.shape == (6, 3, 1, 4, 4)
    for name in ("mean", "covariance", "log_likelihood"):
        np.testing.assert_allclose(getattr(one, name), getattr(each, name), rtol=0, atol=1e-11)
    first = filter(ys, seed=8, predict_first=False)
    assert first.final.belief.scale_tril.shape == (3, 1, 4, 4) and first.diagnostics.ok.all()
    linear = tf.RaoBlackwellizedParticleFilter(state_space(PLANE), 30, drawn=[0], shared=True)
    assert linear.evidence == "unbiased" and filter.evidence == "linearized"
    declared = tf.RaoBlackwellizedParticleFilter(mixed_model(), 30, drawn=[0], shared=True)
    assert declared.evidence == "linearized"


def test_shared_derivatives_are_those_at_the_mean():
    """A slope that depends on the drawn component: means of each particle, one gain, by hand."""
    model = tf.StateSpaceModel(
        gaussian(tensor([0.0, 1.0]), tensor([[0.5, 0.0], [0.0, 2.0]])),
        tf.AdditiveGaussian(lambda x: torch.stack([x[..., 0], x[..., 0].sin() * x[..., 1]], -1), 0.1 * torch.eye(2)
                            .double()),
        tf.AdditiveGaussian(lambda x: x[..., :1].cos() * x[..., 1:], tensor([[0.3]])),
    )  # fmt: skip
    filter = tf.RaoBlackwellizedParticleFilter(model, 40, drawn=[0], shared=True)
    state = filter.init((), 3)
    x, noise = state.belief.x, filter.draw(state.belief, 0, 3)
    after, info = filter.advance(state.belief, tensor([0.7]), None, None, noise, "none")
    centre = x.mean(0)
    drawn = x[:, 0] + 0.1**0.5 * noise.proposal[:, 0]
    m, P = x[:, 0].sin() * x[:, 1], centre[0].sin() ** 2 * 2.0 + 0.1
    H = centre[0].cos()
    S = H**2 * P + 0.3
    residual = 0.7 - drawn.cos() * m
    np.testing.assert_allclose(after.x[:, 0], drawn, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.x[:, 1], m + P * H / S * residual, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.scale_tril[0, 1, 1] ** 2, P - (P * H) ** 2 / S, rtol=1e-12)
    log = -0.5 * residual**2 / S - 0.5 * (2 * np.pi * S).log()
    np.testing.assert_allclose(info.log_likelihood, log.exp().mean().log(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("shared", [False, True])
def test_a_particle_that_cannot_move_loses_its_weight_and_not_the_sharing(shared):
    class Bounded(Motion):
        def forward(self, x):
            law = super().forward(x)
            return law._replace(mean=torch.where(x[..., :1] > 0.8, torch.nan, law.mean))

    model = mixed_model()
    model = tf.StateSpaceModel(model.initial, Bounded(), model.observation)
    filter = tf.RaoBlackwellizedParticleFilter(model, 30, drawn=[0], shared=shared)
    state = filter.init((2,), 1)
    for y in mixed_series(3):
        state, info = filter.step(state, y.expand(2, 2))
        assert info.ok.all() and torch.isfinite(state.belief.x).all()
        assert state.belief.scale_tril.shape == (2, 1, 4, 4) and torch.isfinite(state.belief.covariance).all()
    assert (state.belief.weights == 0).any()


def test_terrain_against_a_grid():
    """Position over a periodic ground, drawn; velocity linear. Evidence and mean against a point-mass filter."""
    H = np.array([[1.0, 0.5], [0.0, 0.9]])
    Q, R = np.diag([0.06, 0.05]), 0.05
    ys = np.array([0.9, -0.2, 0.7, 0.1])

    def ground(p):
        return p.sin() if isinstance(p, torch.Tensor) else np.sin(p)

    motion = tf.LinearGaussian(tensor(H), tensor(Q))
    sensor = tf.AdditiveGaussian(lambda x: ground(x[..., :1]), tensor([[R]]))
    sensor.linear_in = (1,)
    model = tf.StateSpaceModel(gaussian(tensor([0.5, 0.3]), tensor(np.diag([1.5, 0.3]))), motion, sensor)
    normal = grid_oracle.normal_log_density
    axes = np.linspace(-7, 8, 76), np.linspace(-2.4, 2.6, 30)

    def initial(x):
        return normal(x[:, 0], 0.5, 1.5) + normal(x[:, 1], 0.3, 0.3)

    def transition(after, x):
        mean = x @ H.T
        return normal(after[..., 0], mean[..., 0], Q[0, 0]) + normal(after[..., 1], mean[..., 1], Q[1, 1])

    def observation(y, x):
        return normal(y, ground(x[:, 0]), R)

    logs, means = rao_blackwell_oracle.plane_grid(axes, initial, transition, observation, ys)
    filter = tf.RaoBlackwellizedParticleFilter(model, 300, drawn=[0])
    history = filter(replicate(tensor(ys[:, None]), 1000), seed=9)
    score, mean, error = bias_score(history.log_likelihood, logs.sum())
    assert filter.evidence == "unbiased" and error < 0.01 and abs(score) < Z, (mean, error)
    found = history.mean[-1]
    assert ((found.mean(0) - tensor(means[-1])).abs() < Z * found.std(0) / 1000**0.5 + 3 / 300).all()


# Spaces, gaps, failures ----------------------------------------------------------------------------------------------


INERTIAL = Product(UnitQuaternion("left"), Euclidean(12))


class ErrorMotion(torch.nn.Module):
    """Attitude error turned by the drift, velocity error pushed by the tilt, position, drift, bias: 15 components."""

    def __init__(self, dt=0.5):
        super().__init__()
        self.dt = dt
        F = torch.zeros(15, 15, dtype=torch.float64)
        F[0:3, 9:12] = F[3:6, 12:15] = F[6:9, 3:6] = torch.eye(3, dtype=torch.float64)
        F[3, 1], F[4, 0] = -9.8, 9.8
        F[9:12, 9:12] = F[12:15, 12:15] = -0.01 * torch.eye(3, dtype=torch.float64)
        self.register_buffer("matrix", torch.eye(15, dtype=torch.float64) + dt * F)
        deviation = torch.tensor([3e-3] * 3 + [1e-2] * 3 + [0.0] * 3 + [1e-5] * 3 + [1e-3] * 3, dtype=torch.float64)
        self.register_buffer("scale", deviation.diag())

    def forward(self, x, u=None, dt=None):
        tilt = UnitQuaternion("left").local(x.new_tensor([0.0, 0, 0, 1]).expand_as(x[..., :4]), x[..., :4])
        fall = torch.stack([-tilt[..., 1], tilt[..., 0], torch.zeros_like(tilt[..., 0])], -1) * 9.8
        step = x[..., 4:] @ self.matrix[3:, 3:].mT
        step = step + torch.nn.functional.pad(self.dt * fall, (0, 9))
        q = UnitQuaternion("left").retract(x[..., :4], x[..., 10:13] @ self.matrix[:3, 9:12].mT)
        return tf.Gaussian(torch.cat([q, step], -1), self.scale, INERTIAL)

    def first_order(self, x, u=None, dt=None):
        return self(x, u, dt), self.matrix


class ErrorFixes(torch.nn.Module):
    """Heading and position, as errors."""

    def __init__(self):
        super().__init__()
        self.register_buffer("matrix", torch.eye(15, dtype=torch.float64)[[2, 6, 7, 8]])
        self.register_buffer("scale", torch.tensor([0.01, 1, 1, 1], dtype=torch.float64).diag())

    def forward(self, x, u=None, dt=None):
        tilt = UnitQuaternion("left").local(x.new_tensor([0.0, 0, 0, 1]).expand_as(x[..., :4]), x[..., :4])
        return tf.Gaussian(torch.cat([tilt[..., 2:], x[..., 7:10]], -1), self.scale)

    def first_order(self, x, u=None, dt=None):
        return self(x, u, dt), self.matrix


def inertial_model():
    deviation = torch.tensor([0.01] * 3 + [0.1] * 3 + [1.0] * 3 + [1e-4] * 3 + [1e-2] * 3, dtype=torch.float64)
    mean = torch.zeros(16, dtype=torch.float64)
    mean[3] = 1
    return tf.StateSpaceModel(tf.Gaussian(mean, deviation, INERTIAL, True), ErrorMotion(), ErrorFixes())


def test_inertial_error_state_with_attitude_drawn():
    """Sixteen numbers, three drawn; position has no noise of its own. One covariance a row.

    At such small tilts the extended filter is as good as exact: the mean over 20 rows of 2000 particles within 4.5
    standard errors and 3 % of a deviation, deviations within 5 %.
    """
    model = inertial_model()
    generator = torch.Generator().manual_seed(0)
    ys = 0.5 * torch.randn(12, 4, generator=generator, dtype=torch.float64) * tensor([0.01, 1, 1, 1])
    filter = tf.RaoBlackwellizedParticleFilter(model, 2000, drawn=slice(0, 3))
    history = filter(replicate(ys, 20), seed=10)
    extended = tf.ExtendedKalmanFilter(model)(ys)
    assert filter.evidence == "linearized" and history.final.belief.scale_tril.shape == (20, 1, 15, 15)
    error = INERTIAL.local(extended.mean.unsqueeze(1), history.mean)
    deviation = extended.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    away = (error.mean(1) / deviation).abs()
    assert (away < Z * (error.std(1) / deviation) / 20**0.5 + 0.03).all(), away.max()
    found = history.covariance.mean(1).diagonal(dim1=-2, dim2=-1).sqrt()
    np.testing.assert_allclose(found / deviation, 1, rtol=0, atol=0.05)


def test_rows_with_gaps_have_the_evidence_of_what_they_saw():
    """Each row misses other components; rows keep one factor each, and the exact evidence (z-scores as above)."""
    two = PLANE._replace(H=np.array([[1.0, 0.5], [0.0, 1.0]]), R=np.array([[0.5, 0.2], [0.2, 0.4]]))
    ys = particle_oracle.simulate(two, 3, 6)[1]
    patterns = np.tile(ys, (3, 1, 1))
    patterns[0, 1, 0], patterns[1, 1, 1], patterns[2, 1] = np.nan, np.nan, np.nan
    exact = [particle_oracle.kalman(two, row).log_likelihood.sum() for row in patterns]
    data = tensor(patterns).movedim(0, 1).repeat_interleave(1000, 1)
    history = tf.RaoBlackwellizedParticleFilter(state_space(two), 40, drawn=[0])(data, seed=11, record="mean")
    assert history.final.belief.scale_tril.shape == (3000, 1, 2, 2)
    for row, answer in zip(history.log_likelihood.split(1000), exact, strict=True):
        score, mean, error = bias_score(row, answer)
        assert error < 0.02 and abs(score) < Z, (mean, error)


def test_a_measurement_at_the_priors_own_time():
    ys, _ = series(3)
    exact = particle_oracle.kalman(PLANE, ys.numpy(), predict_first=False).log_likelihood.sum()
    filter = tf.RaoBlackwellizedParticleFilter(state_space(PLANE), 30, drawn=[1])
    history = filter(replicate(ys, 3000), predict_first=False, seed=12)
    score, mean, error = bias_score(history.log_likelihood, exact)
    assert error < 0.01 and abs(score) < Z, (mean, error)


def test_failed_rows_say_so_and_keep_the_sharing():
    """Row 0 is too far from anything in double precision."""
    filter = tf.RaoBlackwellizedParticleFilter(mixed_model(), 30, drawn=[0])
    ys = replicate(mixed_series(4), 2).clone()
    calm = filter(ys, seed=13)
    ys[1, 0] = 1e200
    history = filter(ys, seed=13, throw=False)
    assert history.diagnostics.ok[:2].tolist() == [[True, True], [False, True]] and history.diagnostics.ok[:, 1].all()
    assert history.diagnostics.log_likelihood[1, 0] == -np.inf
    assert history.final.belief.scale_tril.shape == (2, 1, 4, 4)
    np.testing.assert_allclose(history.mean[:, 1], calm.mean[:, 1], rtol=0, atol=1e-12)
    with pytest.raises(tf.FilterError, match=r"step 1, rows \[\(0,\)\]"):
        filter(ys, seed=13)


# Gradients and graphs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawn", [(0,), (1,)])
def test_gradient_of_the_evidence_is_unbiased(drawn):
    of_z, _ = gradients(lambda model: tf.RaoBlackwellizedParticleFilter(model, 15, drawn=drawn), 300)
    score, error = against_score(of_z)
    assert (error < 0.2).all() and score.abs().max() < Z, (score, error)


def test_gradient_with_nothing_drawn_is_the_score():
    theta = tensor([1.0, 1, 0.3, 1, 1]).requires_grad_()
    log = tf.RaoBlackwellizedParticleFilter(torch_model(theta), 3, drawn=())(YS).log_likelihood
    assert abs(log.item() - EXACT) < 1e-12
    (gradient,) = torch.autograd.grad(log, theta)
    (expected,) = torch.autograd.grad(tf.KalmanFilter(torch_model(theta))(YS).log_likelihood, theta)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9)


def test_gradients_are_finite_where_a_drawn_component_does_not_move():
    """A constant, drawn once from its prior: no noise of its own, so its row of the factor is zero."""
    rate = tensor(0.8).requires_grad_()

    def motion(x):
        return torch.cat([x[..., :1], rate * x[..., 1:] + x[..., :1]], -1)

    model = tf.StateSpaceModel(
        gaussian(tensor([0.2, 0.0]), tensor([[0.5, 0.1], [0.1, 1.0]])),
        tf.AdditiveGaussian(motion, scale_tril=tensor([[0.0, 0.0], [0.0, 0.3]])),
        tf.LinearGaussian(tensor([[0.0, 1.0]]), tensor([[0.2]])),
    )
    log = tf.RaoBlackwellizedParticleFilter(model, 200, drawn=[0])(YS, seed=1).log_likelihood
    (gradient,) = torch.autograd.grad(log, rate)
    exact = tf.ExtendedKalmanFilter(model)(YS).log_likelihood
    (score,) = torch.autograd.grad(exact, rate)
    # One series, 200 particles: of the right size.
    assert torch.isfinite(gradient) and abs(gradient - score) < 0.5 * score.abs() + 0.2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_streams_have_the_bits_of_the_series(dtype):
    model = inertial_model().to(dtype)
    filter = tf.RaoBlackwellizedParticleFilter(model, 40, drawn=slice(0, 3))
    generator = torch.Generator().manual_seed(0)
    ys = (0.5 * torch.randn(6, 2, 4, generator=generator, dtype=torch.float64)).to(dtype) * 0.1
    whole = filter(ys, seed=2, record="beliefs")
    assert whole.beliefs.x.dtype == whole.beliefs.scale_tril.dtype == dtype
    state = filter.init((2,), 2)
    for k, y in enumerate(ys):
        state, _ = filter.step(state, y)
        assert torch.equal(state.belief.x, whole.beliefs.x[k])
        assert torch.equal(state.belief.scale_tril, whole.beliefs.scale_tril[k])


# The compiler itself uses a name that its own package deprecates.
@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
def test_compiled_step_equals_eager(shared):
    """Tolerance: the compiler may add in another order, 4 steps of rounding; ancestors would show any larger error."""
    torch._dynamo.reset()
    filter = tf.RaoBlackwellizedParticleFilter(mixed_model() if shared else plain_model(), 32, drawn=[0])
    compiled = torch.compile(filter.advance, fullgraph=True)
    eager = fast = filter.init((2,), 1).belief
    for k, y in enumerate(replicate(mixed_series(4), 2)):
        noise = filter.draw(eager, k, 1)
        eager, info = filter.advance(eager, y, None, None, noise, "none")
        fast, fast_info = compiled(fast, y, None, None, noise, "none")
        assert eager.scale_tril.shape == fast.scale_tril.shape == (2, 1 if shared else 32, 4, 4)
        np.testing.assert_allclose(fast.x, eager.x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(fast.log_weights, eager.log_weights, rtol=0, atol=1e-10)
        assert torch.equal(fast_info.ancestors, info.ancestors) and fast_info.ok.all()
