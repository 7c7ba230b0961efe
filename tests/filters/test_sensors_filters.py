"""Every filter on several sensors: the numbers of one law that gives the whole measurement, gaps, streams by name."""

import copy

import numpy as np
import pytest
import torch
from oracles import kalman_oracle
from torch import nn

import torchfilt as tf
from torchfilt.kernels import Regularize
from torchfilt.moves import MetropolisHastings

DOUBLE = torch.float64
FIX, FIX_FACTOR = torch.eye(1, 4, dtype=DOUBLE), torch.tensor([[0.3]], dtype=DOUBLE)
NOISE = torch.tensor([[0.2, 0.0], [0.01, 0.03]], dtype=DOUBLE)


def polar(x):
    """Range and bearing of a beacon at (-3, 0) from a plane state (x, y and their rates)."""
    return torch.stack([torch.hypot(x[..., 0] + 3, x[..., 1]), torch.atan2(x[..., 1], x[..., 0] + 3)], -1)


def speeds(x):
    return x[..., 2:]


PARTS = {"camera": (2, polar), "fix": (1, lambda x: x[..., :1]), "doppler": (2, speeds)}
WIDTH = {"camera": NOISE, "fix": FIX_FACTOR, "doppler": 0.4 * torch.eye(2, dtype=DOUBLE)}
BEARING = tf.Product(tf.Euclidean(1), tf.Angle(1))


def sensors():
    return tf.Sensors(
        camera=tf.AdditiveGaussian(polar, space=BEARING, scale_tril=NOISE),
        fix=tf.LinearGaussian(FIX, scale_tril=FIX_FACTOR),
        doppler=tf.AdditiveGaussian(speeds, scale_tril=WIDTH["doppler"]),
    )


def whole():
    """One law with the same measurement, written by hand."""
    factor = torch.block_diag(*WIDTH.values())
    space = tf.Product(tf.Euclidean(1), tf.Angle(1), tf.Euclidean(3))
    return tf.AdditiveGaussian(
        lambda x: torch.cat([polar(x), x[..., :1], speeds(x)], -1), space=space, scale_tril=factor
    )


def linear_sensors():
    return tf.Sensors(
        fix=tf.LinearGaussian(FIX, scale_tril=FIX_FACTOR),
        doppler=tf.LinearGaussian(torch.eye(4, dtype=DOUBLE)[2:], scale_tril=WIDTH["doppler"]),
    )


def linear_whole():
    matrix = torch.eye(4, dtype=DOUBLE)[[0, 2, 3]]
    return tf.LinearGaussian(matrix, scale_tril=torch.block_diag(FIX_FACTOR, WIDTH["doppler"]))


MOTION = torch.eye(4, dtype=DOUBLE) + 0.1 * torch.diag(torch.ones(2, dtype=DOUBLE), 2)
DRIVE = torch.diag(torch.tensor([0.02, 0.02, 0.1, 0.1], dtype=DOUBLE))
PRIOR = tf.Gaussian(torch.tensor([0.0, 1, 0.5, -0.2], dtype=DOUBLE), torch.diag(torch.full((4,), 0.5, dtype=DOUBLE)))


def model(law):
    return tf.StateSpaceModel(PRIOR, tf.LinearGaussian(MOTION, scale_tril=DRIVE), law)


def measured(steps=8, rows=3, holes=True):
    """Simulated measurements (steps, rows, 5) at three rates, rows that miss different sensors."""
    generator = torch.Generator().manual_seed(3)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=DOUBLE)

    x, law, ys = PRIOR.sample(normal(rows, 4)), sensors(), []
    for _ in range(steps):
        x = x @ MOTION.mT + normal(rows, 4) @ DRIVE
        ys.append(law(x).sample(normal(rows, 5)))
    y = torch.stack(ys)
    if holes:
        y[1::2, :, :2] = torch.nan  # the camera is slow
        y[2::3, 0, 2] = torch.nan  # a fix is missing in one row, the doppler in another
        y[2::3, 1, 3:] = torch.nan
        y[5:6] = torch.nan  # silence
    return y


GAUSSIAN = {
    "extended": tf.ExtendedKalmanFilter,
    "iterated": lambda m: tf.ExtendedKalmanFilter(m, iterations=3),
    "unscented": tf.UnscentedKalmanFilter,
    "cubature": tf.CubatureKalmanFilter,
    "Gauss-Hermite": tf.GaussHermiteKalmanFilter,
}
PARTICLE = {
    "bootstrap": lambda m: tf.BootstrapFilter(m, 60),
    "auxiliary": lambda m: tf.AuxiliaryParticleFilter(m, 60),
    "regularized": lambda m: tf.RegularizedParticleFilter(m, 60),
    "resample-move": lambda m: tf.ResampleMoveParticleFilter(m, 60),
    "unscented particle": lambda m: tf.UnscentedParticleFilter(m, 30),
    "bank": lambda m: tf.LocallyLinearizedParticleFilter(m, 30),
    "Rao-Blackwellized": lambda m: tf.RaoBlackwellizedParticleFilter(m, 60, drawn=slice(0, 2)),
}
FILTERS = GAUSSIAN | PARTICLE


def assert_equal_histories(found, expected, tolerance=1e-9):
    """To rounding: blocks are added in another order, and the update solves with factors of condition below 100."""
    np.testing.assert_allclose(found.mean.detach(), expected.mean.detach(), rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(found.covariance.detach(), expected.covariance.detach(), rtol=0, atol=tolerance)
    np.testing.assert_allclose(found.log_likelihood.detach(), expected.log_likelihood.detach(), rtol=tolerance)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("name", FILTERS)
def test_sensors_are_the_law_written_by_hand(name, holes):
    ys = measured(holes=holes)
    found = FILTERS[name](model(sensors()))(ys, seed=4)
    assert_equal_histories(found, FILTERS[name](model(whole()))(ys, seed=4))
    assert found.diagnostics.ok.all()


@pytest.mark.parametrize("name", ["Kalman", *FILTERS])
def test_linear_sensors_are_the_kalman_filter_of_the_whole(name):
    """Gaussian filters against NumPy's; particles against the law written by hand."""
    ys = measured()[..., 2:]
    make = tf.KalmanFilter if name == "Kalman" else FILTERS[name]
    found = make(model(linear_sensors()))(ys, seed=1)
    if name in PARTICLE:
        assert_equal_histories(found, make(model(linear_whole()))(ys, seed=1))
        assert found.evidence == make(model(linear_whole())).evidence
        return
    h, factor = np.eye(4)[[0, 2, 3]], linear_whole().noise().numpy()
    drive = (DRIVE @ DRIVE).numpy()
    for row in range(3):
        expected = kalman_oracle.kalman(
            PRIOR.mean.numpy(),
            PRIOR.covariance.numpy(),
            MOTION.numpy(),
            drive,
            h,
            factor @ factor.T,
            ys[:, row].numpy(),
        )
        np.testing.assert_allclose(found.mean[:, row], expected.mean, atol=1e-10)
        np.testing.assert_allclose(found.covariance[:, row], expected.covariance, atol=1e-10)
        np.testing.assert_allclose(found.log_likelihood[row], expected.log_likelihood.sum(), rtol=1e-10)
    assert found.evidence == "exact"


@pytest.mark.parametrize("name", FILTERS)
def test_a_stream_at_three_rates_by_name_is_the_series(name):
    """To the bit: only who speaks is named, NaN hides single rows."""
    filter = FILTERS[name](model(sensors()))
    ys = measured()
    history = filter(ys, seed=9)
    by_name = filter({key: value for key, value in sensors().unpack(ys).items()}, seed=9)
    assert torch.equal(by_name.mean, history.mean)
    state = filter.init((3,), 9)
    for k, y in enumerate(ys):
        said = {key: value for key, value in sensors().unpack(y).items() if not value.isnan().all()}
        assert len(said) == [3, 2, 3, 2, 3, 0, 3, 2][k]
        state, info = filter.step(state, said)
        assert torch.equal(state.belief.mean, history.mean[k])
        assert torch.equal(info.log_likelihood, history.diagnostics.log_likelihood[k])


@pytest.mark.parametrize("name", FILTERS)
def test_silence_is_a_prediction(name):
    """All sensors silent: what a measurement that never was leaves, with log-likelihood zero."""
    filter = FILTERS[name](model(sensors()))
    state = filter.init((3,), 2)
    state, _ = filter.step(state, measured()[0])
    silent, info = filter.step(state, {})
    assert (info.log_likelihood.abs() < 1e-12).all() and info.ok.all()
    # The mean of the motion's own: exact for Gaussians, 5 standard errors of the particles (one false alarm in 10^6).
    expected = state.belief.mean @ MOTION.mT
    limit = 1e-12
    if name in PARTICLE:
        limit = 5 * (silent.belief.covariance.diagonal(dim1=-2, dim2=-1) / info.ess.min()).sqrt()
    assert ((silent.belief.mean - expected).abs() <= limit).all()


@pytest.mark.parametrize("name", FILTERS)
def test_rows_that_miss_different_sensors_are_each_on_their_own(name):
    """A row of the batch is the row alone: with its own share of the same random numbers."""
    filter = FILTERS[name](model(sensors()))
    ys = measured()
    state = filter.init((3,), 5)
    noise = filter.draw(state.belief, 0, 5)
    for y in (ys[2], ys[1], ys[5]):
        together, _ = filter.advance(state.belief, y, noise=noise)
        for row in range(3):
            alone = y.clone()
            others = [k for k in range(3) if k != row]
            alone[others] = torch.nan
            single, _ = filter.advance(state.belief, alone, noise=noise)
            np.testing.assert_allclose(single.mean[row], together.mean[row], rtol=1e-12, atol=1e-13)


def test_one_that_moves_trajectories_and_one_with_a_kernel_see_the_same_sensors():
    """Parts that look at the measurement law themselves."""
    ys = measured()
    for parts in (
        {"move": MetropolisHastings(2, 0.3, target="predictive")},
        {"kernel": Regularize(keep_moments=False), "move": MetropolisHastings(1, 0.5, target="transition")},
    ):
        both = [tf.ParticleFilter(model(law()), 60, tf.proposals.Prior(), **parts)(ys) for law in (sensors, whole)]
        assert_equal_histories(*both)


# Transformations ----------------------------------------------------------------------------------------------------


class Trained(nn.Module):
    """A camera whose noise and place train."""

    size, space = 2, BEARING

    def __init__(self):
        super().__init__()
        self.sd = nn.Parameter(torch.tensor([0.2, 0.03], dtype=DOUBLE))
        self.east = nn.Parameter(torch.tensor(0.1, dtype=DOUBLE))

    def forward(self, x):
        return tf.Gaussian(polar(x + self.east * torch.eye(4, dtype=x.dtype)[0]), self.sd, BEARING, is_diagonal=True)


@pytest.mark.parametrize("name", ["extended", "unscented", "bootstrap", "bank"])
def test_parameters_of_a_part_train_through_the_filter(name):
    """Gradients through gaps, against central differences of the same function of the same random numbers.

    Differences of step 1e-5: their error is 1e-10 times third derivatives, and 1e-16 / 1e-5 of the value. Resampling
    is never done, so that the evidence is smooth.
    """
    law = tf.Sensors(camera=Trained(), fix=tf.LinearGaussian(FIX, scale_tril=FIX_FACTOR))
    make = FILTERS[name]
    if name == "bootstrap":
        make = lambda m: tf.BootstrapFilter(m, 60, tf.resampling.never())  # noqa: E731
    filter = make(model(law))
    if name == "bank":
        filter = tf.LocallyLinearizedParticleFilter(model(law), 30, resampler=tf.resampling.never())
    ys = measured(4)[..., :3]
    camera = law.law("camera")
    total = filter(ys, seed=3).log_likelihood.sum()
    total.backward()
    for parameter in (camera.sd, camera.east):
        flat, slope = parameter.data.view(-1), parameter.grad.view(-1)
        for k in range(len(flat)):
            values = []
            for away in (1e-5, -1e-5):
                flat[k] += away
                with torch.no_grad():
                    values.append(filter(ys, seed=3).log_likelihood.sum().item())
                flat[k] -= away
            np.testing.assert_allclose(slope[k], (values[0] - values[1]) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", GAUSSIAN)
def test_vmap_over_rows(name):
    """`torch.func.vmap` of one step over means and measurements with gaps is the batch."""
    filter = GAUSSIAN[name](model(sensors()))
    y, belief = measured()[2], filter.init((3,)).belief
    expected, _ = filter.advance(belief, y)
    found = torch.func.vmap(lambda mean, y: filter.advance(belief._replace(mean=mean), y)[0].mean)(belief.mean, y)
    np.testing.assert_allclose(found, expected.mean, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
def test_single_precision(name):
    """dtype kept; Gaussian filters near the double ones: 8 steps of 1e-7 times condition 1e2."""
    filter = copy.deepcopy(FILTERS[name](model(sensors()))).float()
    ys = measured()
    found = filter(ys.float(), seed=4)
    assert found.mean.dtype == found.covariance.dtype == torch.float32 and found.diagnostics.ok.all()
    if name in GAUSSIAN:
        expected = FILTERS[name](model(sensors()))(ys)
        np.testing.assert_allclose(found.mean, expected.mean, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["extended", "bootstrap", "bank"])
def test_compiled_step_equals_eager(name):
    """One graph, with rows that miss different sensors; tolerance as in the other tests of compiled steps."""
    torch._dynamo.reset()
    filter = FILTERS[name](model(sensors()))
    compiled = torch.compile(filter.advance, fullgraph=True)
    eager = fast = filter.init((3,), 1).belief
    for k, y in enumerate(measured(4)):
        noise = filter.draw(eager, k, 1)
        eager, info = filter.advance(eager, y, None, None, noise, "rows")
        fast, fast_info = compiled(fast, y, None, None, noise, "rows")
        np.testing.assert_allclose(fast.mean, eager.mean, rtol=0, atol=1e-10)
        np.testing.assert_allclose(fast_info.log_likelihood, info.log_likelihood, rtol=0, atol=1e-10)


def test_names_need_sensors():
    filter = tf.ExtendedKalmanFilter(model(whole()))
    with pytest.raises(TypeError, match="measurements by name need Sensors"):
        filter.step(filter.init((3,)), {"camera": measured()[0, :, :2]})
    with pytest.raises(ValueError, match="no sensor 'kamera'"):
        tf.ExtendedKalmanFilter(model(sensors()))({"kamera": measured()[..., :2]})
