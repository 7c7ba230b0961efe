"""Barometric altimeter: closed forms of the lag, SciPy's triangle hold, derivatives by autodiff, noise by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import cont2discrete
from torch import nn

import torchfilt as tf
from torchfilt.models.landing import PAD_HEIGHT_SPACE, LandingTransition
from torchfilt.models.sensors.barometer import BarometricAltimeter, WithAltimeter, first_order_lag, lag_weights
from torchfilt.spaces import Euclidean, Product, UnitQuaternion
from torchfilt.testing import check_law

DOUBLE = torch.float64
EPS = np.finfo(float).eps
TAU = 0.4


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def states(rows, size=18, seed=1):
    x = normal(rows, size, seed=seed)
    x[:, :4] = nn.functional.normalize(x[:, :4], dim=-1)
    x[:, 7:10] *= 20
    return x


def derivative(law, x, space, output=None):
    """By autodiff, row by row, in tangent coordinates of the state and of what comes out."""

    def error(row, v):
        mean = law(space.retract(row, v)).mean
        return mean if output is None else output.local(law(row).mean.detach(), mean)

    zero = torch.zeros(space.tangent_size, dtype=x.dtype)
    return torch.stack([torch.func.jacfwd(lambda v, row=row: error(row, v))(zero) for row in x])


# Lag ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [0.0, 1.7])
def test_step_and_ramp(speed):
    """h0 + v t - v T + (l0 - h0 + v T) exp(-t / T), exactly and for steps of any length."""
    steps = torch.tensor([0.01, 0.3, 0.0, 2.0, 0.05, 1e-9], dtype=DOUBLE)
    times = torch.cat([torch.zeros(1, dtype=DOUBLE), steps.cumsum(0)])
    height, start = 2.0 + speed * times, -1.0
    expected = height - speed * TAU + (start - 2.0 + speed * TAU) * torch.exp(-times / TAU)
    lagged = torch.tensor(start, dtype=DOUBLE)
    for k, dt in enumerate(steps):
        lagged = first_order_lag(lagged, height[k], height[k + 1], dt if k % 2 else dt.item(), TAU)
        np.testing.assert_allclose(lagged, expected[k + 1], rtol=0, atol=20 * EPS)


@pytest.mark.parametrize("dt", [1e-3, 0.1, 3.0])
def test_weights_against_scipy(dt):
    """Triangle hold of 1 / (T s + 1): its state is the lagged value less the share of the newest input."""
    plant = [np.array([[v]]) for v in (-1 / TAU, 1 / TAU, 1.0, 0.0)]
    a, b, c, d, _ = cont2discrete(plant, dt, "foh")
    weights = lag_weights(dt, TAU)
    np.testing.assert_allclose(weights.lagged, a[0, 0], rtol=1e-13)
    np.testing.assert_allclose(weights.after, d[0, 0], rtol=1e-10)
    np.testing.assert_allclose(weights.before, (c @ b - a @ d)[0, 0], rtol=1e-10)
    rows = lag_weights(torch.tensor([[dt], [0.0]], dtype=DOUBLE), TAU)
    np.testing.assert_allclose([part[0, 0] for part in rows], weights, rtol=1e-12)
    assert [part[1, 0].item() for part in rows] == [1, 0, 0] == list(lag_weights(0.0, TAU))


def test_acceleration_costs_what_is_stated():
    dt, fine, force = 0.5, 2000, 3.0
    times = torch.linspace(0, dt, fine + 1, dtype=DOUBLE)
    height, lagged = force * times**2 / 2, torch.zeros((), dtype=DOUBLE)
    for k in range(fine):
        lagged = first_order_lag(lagged, height[k], height[k + 1], dt / fine, TAU)
    coarse = first_order_lag(torch.zeros((), dtype=DOUBLE), height[0], height[-1], dt, TAU)
    bound = force * dt**2 / 8 * (1 - math.exp(-dt / TAU))
    assert 0.3 * bound < (coarse - lagged).item() < bound


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_lag_refuses(value):
    with pytest.raises(ValueError, match=f"time_constant_s must be positive and finite, got {value}"):
        lag_weights(0.1, value)


# Transition -----------------------------------------------------------------------------------------------------------

LANDING = LandingTransition(3e-4, 1e-2, 4e-6, 5e-5)
CONTROL = torch.tensor([0.01, -0.02, 0.03, 0.1, -0.1, 1.0], dtype=DOUBLE)
STEPS = torch.tensor([[0.1], [0.0], [1.5]], dtype=DOUBLE)


def fall():
    """Height and speed with noise on both, one correlated with the other."""
    covariance = torch.tensor([[0.04, 0.01], [0.01, 0.09]], dtype=DOUBLE)
    move = lambda x, u=None, dt=None: torch.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1]], -1)  # noqa: E731
    return tf.AdditiveGaussian(move, covariance, Euclidean(2)), covariance


def test_lagged_height_and_offset_follow():
    law = WithAltimeter(LANDING, TAU, 0.05)
    x = states(3)
    found = law(x, CONTROL, STEPS)
    inner = LANDING(x[:, :16], CONTROL, STEPS)
    np.testing.assert_allclose(found.mean[:, :16], inner.mean, rtol=0, atol=0)
    np.testing.assert_allclose(found.mean[:, 17], x[:, 17], rtol=0, atol=0)
    expected = first_order_lag(x[:, 16], x[:, 9], inner.mean[:, 9], STEPS[:, 0], TAU)
    np.testing.assert_allclose(found.mean[:, 16], expected, rtol=1e-14)
    assert found.is_diagonal and found.space == Product(UnitQuaternion("left"), Euclidean(14)) == law.space
    np.testing.assert_allclose(found.scale_tril[:, :15], inner.scale_tril, rtol=0, atol=0)
    np.testing.assert_allclose(found.scale_tril[:, 15:], torch.cat([0 * STEPS, 0.05 * STEPS.sqrt()], -1), rtol=1e-15)
    assert law.noise_in == [*LANDING.noise_in, 16]
    assert WithAltimeter(LANDING, TAU).noise_in == LANDING.noise_in
    alone = WithAltimeter(LANDING, offset_walk=0.05)
    assert alone.space == PAD_HEIGHT_SPACE and alone.noise_in == [*LANDING.noise_in, 15]
    np.testing.assert_allclose(alone(x[:, :17], CONTROL, STEPS).mean[:, 16], x[:, 16], rtol=0, atol=0)


@pytest.mark.parametrize("step", [0.3, STEPS])
@pytest.mark.parametrize(("lag", "walk"), [(TAU, 0.05), (TAU, None), (None, 0.05)])
def test_transition_obeys_the_rules(lag, walk, step):
    law = WithAltimeter(LANDING, lag, walk)
    x = states(3, size=law.space.size)
    check_law(law, x, CONTROL, step)
    _, slope = law.first_order(x, CONTROL, step)
    for k in range(3):
        dt = step if isinstance(step, float) else step[k]
        expected = derivative(lambda v, dt=dt: law(v, CONTROL, dt), x[k : k + 1], law.space, law.space)[0]
        # Those of the landing's own derivatives, second order in the turn.
        np.testing.assert_allclose(slope[k, 15:], expected[15:], atol=2e-3 * (1 + float(dt) ** 2))
        weights = lag_weights(float(dt), TAU)
        if lag:
            np.testing.assert_allclose(slope[k, 15, 8], weights.before + weights.after, atol=1e-12)
            np.testing.assert_allclose(slope[k, 15, 15], weights.lagged, atol=1e-12)


def test_noise_of_the_height_reaches_the_lag():
    """By hand: lagged = ... + (1 - w) height, so its covariance with the rest is (1 - w) times the height's."""
    inner, covariance = fall()
    law = WithAltimeter(inner, TAU, 0.2, height=0)
    for dt in (0.3, torch.tensor([[0.3], [0.3]], dtype=DOUBLE)):
        share = lag_weights(0.3, TAU).after
        expected = np.zeros((4, 4))
        expected[:2, :2] = covariance
        expected[2, :2] = expected[:2, 2] = share * covariance[0]
        expected[2, 2] = share**2 * covariance[0, 0]
        expected[3, 3] = 0.2**2 * 0.3
        np.testing.assert_allclose(law(normal(2, 4), None, dt).covariance, np.stack([expected] * 2), atol=1e-14)
    check_law(law, normal(4, 4), None, 0.3)
    assert not hasattr(law, "first_order") and not hasattr(law, "noise_in")
    drifting = WithAltimeter(inner, offset_walk=0.2, height=0)
    np.testing.assert_allclose(drifting(normal(2, 3), None, 0.3).covariance[0, 2], [0, 0, 0.012], atol=1e-15)


def test_constants_follow():
    """The law without them, with numbers behind it that neither move nor are moved."""
    for lag, walk in ((TAU, 0.05), (None, 0.05), (TAU, None)):
        plain, law = (WithAltimeter(LANDING, lag, walk, constants=count) for count in (0, 3))
        x = states(3, law.space.size)
        own = plain.space.size
        (mean, slope), (expected, part) = ((a.first_order(b, CONTROL, 0.3)) for a, b in ((law, x), (plain, x[:, :own])))
        torch.testing.assert_close(mean.mean, torch.cat([expected.mean, x[:, own:]], -1), rtol=0, atol=0)
        torch.testing.assert_close(
            slope, torch.stack([torch.block_diag(row, torch.eye(3, dtype=DOUBLE)) for row in part])
        )
        wanted = nn.functional.pad(expected.covariance, (0, 3, 0, 3))
        torch.testing.assert_close(mean.covariance, wanted.expand_as(mean.covariance), rtol=0, atol=0)
        assert law.noise_in == plain.noise_in
        check_law(law, x, CONTROL, 0.3)


def test_walk_trains():
    walk = nn.Parameter(torch.tensor(0.05, dtype=DOUBLE))
    WithAltimeter(LANDING, None, walk)(states(1, 17), CONTROL, 4.0).scale_tril[..., -1].sum().backward()
    assert walk.grad.item() == 2


def test_transition_refuses():
    with pytest.raises(ValueError, match="give time_constant_s=, offset_walk= or both"):
        WithAltimeter(LANDING)
    with pytest.raises(ValueError, match="time_constant_s must be positive and finite, got 0"):
        WithAltimeter(LANDING, 0.0)
    with pytest.raises(ValueError, match="constants must not be negative, got -1"):
        WithAltimeter(LANDING, TAU, constants=-1)
    for walk in (-1.0, math.nan, torch.ones(2)):
        with pytest.raises(ValueError, match="offset_walk must be one finite number >= 0"):
            WithAltimeter(LANDING, TAU, walk)
    for height in (0, 16):
        with pytest.raises(ValueError, match=rf"height must be an index in 1..15 of the state, got {height}"):
            WithAltimeter(LANDING, TAU, height=height)
    with pytest.raises(ValueError, match="law must state a space of known size, Linear has None"):
        WithAltimeter(nn.Linear(2, 2), TAU)
    law = WithAltimeter(LANDING, TAU)
    with pytest.raises(ValueError, match=r"the state must be \(..., 17\), got \(2, 16\)"):
        law(states(2, 16), CONTROL, 0.1)
    with pytest.raises(ValueError, match="needs the time step dt"):
        law(states(2, 17), CONTROL)


# Measurement ----------------------------------------------------------------------------------------------------------

SPACE = Product(UnitQuaternion("left"), Euclidean(14))
LAWS = {
    "pressure": dict(sd_pa=3.0, reference_pressure_pa=95_000.0),
    "pressure, lag and offset": dict(sd_pa=3.0, lagged=16, offset=17),
    "height": dict(sd_m=0.2),
    "height, another index, offset": dict(sd_m=0.2, height=8, offset=16),
    "height, lag": dict(sd_m=0.2, lagged=17),
}


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_and_rules(name):
    law, x = BarometricAltimeter(**LAWS[name]), states(5)
    check_law(law, x)
    _, slope = law.first_order(x)
    np.testing.assert_allclose(slope, derivative(law, x, SPACE), rtol=1e-10, atol=1e-12)
    batch = law.first_order(x.reshape(5, 1, 18))[1]
    assert batch.shape == (5, 1, 1, 17)


def test_what_is_shown():
    x = states(4)
    ambiance = pytest.importorskip("ambiance")
    # Pressure as far above the height at which the other program has the reference pressure.
    base = ambiance.Atmosphere.from_pressure(95_000.0).H[0]
    above = ambiance.CONST.r * (base + x[:, 9].numpy()) / (ambiance.CONST.r - base - x[:, 9].numpy())
    found = BarometricAltimeter(sd_pa=3.0, reference_pressure_pa=95_000.0)(x)
    # Gas constants differ by 7e-7 and layers' base pressures in the last of six printed digits.
    np.testing.assert_allclose(found.mean[:, 0], ambiance.Atmosphere(above).pressure, rtol=1e-5)
    assert found.scale_tril.tolist() == [3.0] and found.is_diagonal
    at_origin = torch.cat([x[:, :9], 0 * x[:, 9:]], -1)
    np.testing.assert_allclose(
        BarometricAltimeter(sd_pa=3.0, reference_pressure_pa=95_000.0)(at_origin).mean, 95_000, rtol=1e-13
    )
    both = BarometricAltimeter(sd_pa=3.0, lagged=16, offset=17)(x).mean
    lagged = BarometricAltimeter(sd_pa=3.0, height=16)(x).mean
    np.testing.assert_allclose(both, lagged + x[:, 17:], rtol=1e-15)
    shown = BarometricAltimeter(sd_m=0.2, lagged=16, offset=17, reference_pressure_pa=90e3)(x)
    np.testing.assert_allclose(shown.mean[:, 0], x[:, 16] + x[:, 17], rtol=1e-15)


def test_deviation_trains_and_law_compiles():
    deviation = nn.Parameter(torch.tensor(0.2, dtype=DOUBLE))
    BarometricAltimeter(sd_m=deviation)(states(1)).scale_tril.sum().backward()
    assert deviation.grad.item() == 1
    law, x = BarometricAltimeter(sd_pa=3.0, lagged=16, offset=17), states(3)
    compiled = torch.compile(law.first_order, fullgraph=True, backend="eager")(x)
    torch.testing.assert_close(compiled[1], law.first_order(x)[1])
    torch.testing.assert_close(torch.func.vmap(lambda row: law(row).mean)(x), law(x).mean)


def test_measurement_refuses():
    for options in ({}, dict(sd_pa=1.0, sd_m=1.0)):
        with pytest.raises(ValueError, match="give exactly one of sd_pa= and sd_m="):
            BarometricAltimeter(**options)
    with pytest.raises(ValueError, match="sd_pa must be one positive finite number, got 0"):
        BarometricAltimeter(sd_pa=0.0)
    with pytest.raises(ValueError, match="sd_m must be one positive finite number"):
        BarometricAltimeter(sd_m=torch.ones(2))
    for name in ("height", "lagged", "offset"):
        with pytest.raises(ValueError, match=f"{name} must be an index behind the quaternion, 4 or more, got 3"):
            BarometricAltimeter(sd_m=1.0, **{name: 3})
    with pytest.raises(ValueError, match="pressure_pa must be between"):
        BarometricAltimeter(sd_pa=1.0, reference_pressure_pa=1013.25e3)
    with pytest.raises(ValueError, match=r"the state must have more than 17 numbers, got \(2, 17\)"):
        BarometricAltimeter(sd_m=1.0, offset=17)(states(2, 17))


# Together -------------------------------------------------------------------------------------------------------------


def test_a_filter_sees_through_the_lag():
    """Constant climb at 1 m/s, exact readings: without the lag the height is v T too low, with it right.

    The straight line through 20 s weighs its start by -2 / 20 s at its end: of the missing lag of the first moments, an
    area of v T^2, so much is left. With the lag the prior's speed of zero is left, 20 s of it: 1 / 2^2 of information
    against 400 / 12 (20 / 0.05)^2.
    """
    dt, count = 0.05, 400
    climb = torch.arange(1, count + 1, dtype=DOUBLE) * dt
    reading = (climb - TAU * (1 - torch.exp(-climb / TAU))).reshape(-1, 1, 1)
    control = torch.tensor([0, 0, 0, 0, 0, 9.80665 * dt], dtype=DOUBLE).expand(count, 1, 6)
    ends = []
    for lag in (None, TAU):
        inner = LandingTransition(1e-5, 1e-3)
        transition = inner if lag is None else WithAltimeter(inner, lag)
        size = transition.space.size
        mean = torch.zeros(size, dtype=DOUBLE)
        mean[3] = 1
        deviation = torch.full((size - 1,), 1e-6, dtype=DOUBLE)
        deviation[5] = deviation[8] = 2.0
        start = tf.Gaussian(mean, deviation, transition.space, is_diagonal=True)
        sensor = BarometricAltimeter(sd_m=0.05, lagged=None if lag is None else 16)
        run = tf.ExtendedKalmanFilter(tf.StateSpaceModel(start, transition, sensor))
        ends.append(run(reading, control, dt=dt).mean[-1, 0, 9].item() - climb[-1].item())
    assert ends[0] == pytest.approx(-TAU, abs=2 * TAU**2 / 20)
    assert abs(ends[1]) < 20 * 12 / 4 / (400 * (20 / 0.05) ** 2)


def test_transition_compiles():
    law, x = WithAltimeter(LANDING, TAU, 0.05), states(3)
    found, slope = torch.compile(law.first_order, fullgraph=True, backend="eager")(x, CONTROL, STEPS)
    expected = law.first_order(x, CONTROL, STEPS)
    torch.testing.assert_close(found.mean, expected[0].mean)
    torch.testing.assert_close(slope, expected[1])
    rows = torch.func.vmap(lambda row: law(row, CONTROL, 0.3).mean)(x)
    torch.testing.assert_close(rows, law(x, CONTROL, 0.3).mean)
    single = law.first_order(x.float(), CONTROL.float(), STEPS.float())
    assert single[0].mean.dtype == single[0].scale_tril.dtype == single[1].dtype == torch.float32
