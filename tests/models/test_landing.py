"""Laws of the landing: motion, barometer, beacon, the symmetry about the vertical and the gauge that fixes it."""

import math

import numpy as np
import pytest
import torch
from oracles import landing_oracle as oracle
from scipy import stats
from torch import nn

import torchfilt as tf
from torchfilt.models import landing
from torchfilt.models.inertial.imu import ImuGrade
from torchfilt.models.inertial.strapdown import increments
from torchfilt.models.landing import (
    LANDING_SPACE,
    PAD_HEIGHT_SPACE,
    ROTOR_IMU,
    Barometer,
    Beacon,
    HeadingGauge,
    LandingStart,
    LandingTransition,
    landing_model,
    landing_prior,
)
from torchfilt.spaces import Euclidean, Product
from torchfilt.testing import check_law

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
WHITE = (3e-4, 1e-2)
WALKS = (*WHITE, 4e-6, 5e-5)
MOTION = LandingTransition(*WALKS)
LOST = LandingTransition(*WALKS, unknown_pad_height=True)
BEACON = Beacon(math.radians(0.4))
SIZES = pytest.mark.parametrize("size", [16, 17])


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def states(*lead, size=16, tilt=0.2, seed=0):
    """Any heading, tilts of 10 deg, 2 m/s, 5 m beside a point 8 m above the pad, biases of cheap sensors."""
    scale = [tilt, tilt, 2.0, *[2.0] * 3, 5.0, 5.0, 1.0, *[1e-2] * 3, *[0.1] * 3, 4.0][: size - 1]
    mean = torch.zeros(size, dtype=DOUBLE)
    mean[3], mean[9] = 1, 8.0
    space = PAD_HEIGHT_SPACE if size == 17 else LANDING_SPACE
    return space.retract(mean, normal(*lead, size - 1, seed=seed) * torch.tensor(scale, dtype=DOUBLE))


def controls(*lead, seed=5):
    """Turns of 0.1 rad, pushes of 0.2 s of gravity."""
    return normal(*lead, 6, seed=seed) * torch.tensor([0.1] * 3 + [2.0] * 3, dtype=DOUBLE)


def derivative(law, space, x, *arguments):
    """Derivative of a law's mean by forward-mode differentiation: (..., e_y, e)."""
    at = law(x, *arguments)
    lifted = [a.unsqueeze(-2) if isinstance(a, torch.Tensor) and a.dim() > 1 else a for a in arguments]

    def response(error):
        return at.space.local(at.mean.unsqueeze(-2), law(space.retract(x.unsqueeze(-2), error), *lifted).mean)

    size = x.shape[-1] - 1
    directions = torch.eye(size, dtype=x.dtype).expand(*x.shape[:-1], size, size).contiguous()
    return torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1].mT


# Motion ---------------------------------------------------------------------------------------------------------------

RATE = np.array([1.1, 0.7, 0.9])


def rate(t):
    return 0.5 * np.sin(RATE * t + np.array([0.1, 1.0, 2.0]))


def force(t):
    return np.array([0.5, -0.4, 9.8]) + np.cos(np.array([0.8, 1.3, 0.6]) * t)


def samples(count, interval, biases):
    """Means over the intervals of what sensors with biases show, by Gauss and Legendre's rule of five nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    times = interval * (np.arange(count)[:, None] + (nodes + 1) / 2)
    mean = [
        np.stack([sum(w * f(t) for w, t in zip(weights, row, strict=True)) / 2 for row in times]) for f in (rate, force)
    ]
    return torch.from_numpy(mean[0] + biases[:3]), torch.from_numpy(mean[1] + biases[3:])


@SIZES
def test_motion_against_the_integrated_equations(size):
    """Two seconds in steps of 25 ms, five samples each: 1e-5 rad, 1e-4 m/s, 1e-3 m; biases of 0.6 deg/s, 0.1 m/s^2."""
    x = states(size=size)
    raw = samples(400, 0.005, x[10:16].numpy())
    u = torch.cat(increments(*raw, 0.005, 5), -1)
    law, found = LandingTransition(*WHITE, unknown_pad_height=size == 17), x
    for push in u:
        found = law(found, push, 0.025).mean
    away = oracle.local(oracle.fly(x.numpy(), rate, force, 2.0), found.numpy())
    assert np.abs(away[:3]).max() < 1e-5 and np.abs(away[3:6]).max() < 1e-4 and np.abs(away[6:9]).max() < 1e-3
    assert not away[9:].any()


def test_second_order_in_the_length_of_the_step():
    """Halving the step quarters the error of the position; smallest and largest of the ratio over components."""
    x = states()
    x[10:] = 0
    truth = oracle.fly(x.numpy(), rate, force, 1.6)
    away = []
    for group in (40, 20, 10):
        found = x
        for push in torch.cat(increments(*samples(320, 0.005, np.zeros(6)), 0.005, group), -1):
            found = MOTION(found, push, 0.005 * group).mean
        away.append(np.linalg.norm(oracle.local(truth, found.numpy())[6:9]))
    orders = np.log2(np.array(away[:-1]) / away[1:])
    assert orders == pytest.approx(2.0, abs=0.1)


def test_at_rest_nothing_moves_and_free_fall_is_a_parabola():
    x = states(3)
    x[:, 10:] = 0
    x[:, :3], x[:, 3], x[:, 4:7] = 0, 1, 0
    still = MOTION(x, torch.tensor([0, 0, 0, 0, 0, 9.80665 * 0.5], dtype=DOUBLE), 0.5).mean
    torch.testing.assert_close(still, x, rtol=0, atol=8 * EPS)
    fallen = MOTION(x, torch.zeros(6, dtype=DOUBLE), 0.5).mean
    torch.testing.assert_close(fallen[:, 6], torch.full((3,), -9.80665 * 0.5, dtype=DOUBLE), rtol=4 * EPS, atol=0)
    torch.testing.assert_close(
        fallen[:, 9] - x[:, 9], torch.full((3,), -9.80665 / 8, dtype=DOUBLE), rtol=64 * EPS, atol=0
    )


def test_noise():
    result = LOST(states(2, size=17), controls(2), 0.25)
    expected = np.append(np.repeat([3e-4, 1e-2, 0.0, 4e-6, 5e-5], 3) * 0.5, 0.0)
    assert result.is_diagonal and result.space == PAD_HEIGHT_SPACE
    np.testing.assert_allclose(result.scale_tril, expected, rtol=4 * EPS)
    rows = MOTION(states(2), controls(2), torch.tensor([[0.25], [1.0]], dtype=DOUBLE)).scale_tril
    np.testing.assert_allclose(rows, np.stack([expected[:15], 2 * expected[:15]]), rtol=4 * EPS)
    assert MOTION.noise_in == [0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14]
    assert LandingTransition(*WHITE).noise_in == list(range(6))
    assert LandingTransition(*WHITE, 0.0, 1e-5).noise_in == [*range(6), 12, 13, 14]
    walk = nn.Parameter(torch.tensor(0.0, dtype=DOUBLE))
    trained = LandingTransition(*WHITE, walk)
    assert trained.noise_in == [*range(6), 9, 10, 11]
    trained(states(2), controls(2), 0.25).scale_tril.sum().backward()
    assert walk.grad.item() == pytest.approx(1.5)


def test_sensor_noise_turns_into_the_diagonal():
    """White noise of the increments, pushed through the mean: the same in all axes, up to the turn over half a step."""
    x, dt = states(), 0.025
    u = 0.2 * controls()
    result = LandingTransition(*WHITE)(x, u, dt)
    jacobian = torch.func.jacfwd(lambda v: LANDING_SPACE.local(result.mean, MOTION(x, v, dt).mean))(u)
    columns = jacobian * torch.tensor([3e-4] * 3 + [1e-2] * 3, dtype=DOUBLE) * math.sqrt(dt)
    covariance = columns @ columns.mT
    size = result.covariance.diagonal()[:6].sqrt()
    correlation = (covariance - result.covariance)[:6, :6] / (size.unsqueeze(-1) * size)
    assert correlation.abs().max() < 0.02
    # What the law leaves out of the position's own noise: half a step's worth of the velocity's.
    assert covariance.diagonal()[6:9].sqrt().max() < 0.51 * dt * float(size[3])


# Barometer and beacon -------------------------------------------------------------------------------------------------


def test_barometer():
    law = Barometer(0.4)
    assert law.size == 1
    plain, lost = states(3), states(3, size=17)
    torch.testing.assert_close(law(plain).mean, plain[:, 9:10], rtol=0, atol=0)
    torch.testing.assert_close(law(lost).mean[:, 0], lost[:, 9] + lost[:, 16], rtol=0, atol=0)
    assert law(plain).scale_tril.tolist() == [0.4]
    deviation = nn.Parameter(torch.tensor(0.4, dtype=DOUBLE))
    Barometer(deviation)(plain).scale_tril.sum().backward()
    assert deviation.grad.item() == 1


@SIZES
def test_beacon_shows_the_angles_to_the_pad(size):
    x = states(50, size=size, seed=3)
    law = Beacon(0.01)
    found, expected = law(x), [oracle.angles_to_pad(row) for row in x.numpy()]
    assert law.size == 2 and found.scale_tril.tolist() == [0.01, 0.01]
    inside = np.array(
        [np.hypot(*np.tan(a)) < math.tan(math.radians(80)) and np.abs(a).max() < 1.5 for a, _ in expected]
    )
    tangents = np.array([np.tan(angles) for angles, _ in expected])
    assert inside.sum() > 40
    np.testing.assert_allclose(found.mean[inside], tangents[inside], rtol=1e-12, atol=1e-13)
    visible = np.array([np.all(np.abs(a) <= np.radians([30, 17.5])) and distance <= 15 for a, distance in expected])
    assert np.array_equal(law.in_view(x).numpy(), visible) and 0 < visible.sum() < 50


def test_field_of_view_range_and_outliers():
    x = torch.zeros(4, 16, dtype=DOUBLE)
    x[:, 3] = 1
    x[:, 7:10] = torch.tensor([[-1.0, 0, 10], [0, -1.0, 10], [0, 0, 10], [0, 0, -10]])
    assert BEACON.in_view(x).tolist() == [True, True, True, False]
    narrow = Beacon(0.01, field_of_view_rad=(math.radians(5), math.radians(10)), range_m=10.01)
    assert narrow.in_view(x).tolist() == [False, False, True, False]  # sideways; farther than 10 m along
    wide = Beacon(0.01, field_of_view_rad=(math.radians(10), math.radians(5)), range_m=11.0)
    assert wide.in_view(x).tolist() == [True, False, True, False]
    area = 4 * math.tan(math.radians(10)) * math.tan(math.radians(5))
    assert wide.outlier_log_density == pytest.approx(-math.log(area))


def test_beyond_the_edge_the_beacon_is_finite_and_continuous():
    """Pad beside, above and at the camera: on the edge, straight towards the axis, and no jump on the way."""
    law = Beacon(0.01, edge_rad=math.radians(60))
    edge = math.tan(math.radians(60))
    places = torch.tensor([[-3.0, -4, 0], [-3, -4, -2], [0, 0, -1], [0, 0, 0], [-6e8, 0, 1]], dtype=DOUBLE)
    x = torch.zeros(5, 16, dtype=DOUBLE)
    x[:, 3], x[:, 7:10] = 1, places
    expected = torch.tensor([[0.6, 0.8], [0.6, 0.8], [0, 0], [0, 0], [1, 0]], dtype=DOUBLE) * edge
    torch.testing.assert_close(law(x).mean, expected, rtol=1e-12, atol=1e-12)
    assert law.first_order(x)[1].isfinite().all()
    assert (torch.func.jvp(lambda v: law(v).mean, (x,), (torch.ones_like(x),))[1]).isfinite().all()
    height = torch.linspace(4, -4, 4001, dtype=DOUBLE)
    path = x[:1].repeat(4001, 1)
    path[:, 7:10] = torch.stack([torch.full_like(height, -3), 0 * height, height], -1)
    tangents = law(path).mean
    assert tangents.diff(dim=0).abs().max() < 0.003  # 2 mm times the slope at the edge, edge^2 / 3 m, and some
    assert (tangents.diff(dim=0)[:, 0] >= -1e-15).all() and tangents[-1, 0] == pytest.approx(edge)
    single = law.to(torch.float32)(x.float())
    assert single.mean.isfinite().all() and single.mean.dtype == torch.float32


# First order ----------------------------------------------------------------------------------------------------------

STEPS = {"number": 0.2, "rows": torch.tensor([[0.2], [0.1], [0.3], [0.0], [1.0]], dtype=DOUBLE)}


@SIZES
@pytest.mark.parametrize("step", STEPS)
def test_first_order_of_the_motion(size, step):
    law, space = (LOST, PAD_HEIGHT_SPACE) if size == 17 else (MOTION, LANDING_SPACE)
    x, u, dt = states(5, size=size), controls(5), STEPS[step]
    at, jacobian = law.first_order(x, u, dt)
    torch.testing.assert_close(at.mean, law(x, u, dt).mean, rtol=0, atol=0)
    torch.testing.assert_close(at.scale_tril, law(x, u, dt).scale_tril, rtol=0, atol=0)
    torch.testing.assert_close(jacobian, derivative(law, space, x, u, dt), rtol=1e-11, atol=1e-13)


@SIZES
@pytest.mark.parametrize("name", ["barometer", "beacon", "beacon, edge"])
def test_first_order_of_the_measurements(size, name):
    law = {"barometer": Barometer(0.4), "beacon": BEACON, "beacon, edge": Beacon(0.01, edge_rad=0.6)}[name]
    x = states(40, size=size, seed=3)
    at, jacobian = law.first_order(x)
    space = PAD_HEIGHT_SPACE if size == 17 else LANDING_SPACE
    torch.testing.assert_close(at.mean, law(x).mean, rtol=0, atol=0)
    torch.testing.assert_close(jacobian, derivative(law, space, x), rtol=1e-11, atol=1e-12)
    if name == "beacon, edge":
        outside = torch.linalg.vector_norm(at.mean, dim=-1) > math.tan(0.6) * (1 - 1e-9)
        assert 0 < outside.sum() < 40


@pytest.mark.parametrize("law", [MOTION, BEACON, Barometer(0.4)], ids=["motion", "beacon", "barometer"])
def test_laws_conform(law):
    x, u = states(5), controls(5)
    check_law(law, x, *((u, 0.1) if law is MOTION else (None, None)), tolerance=1e-10)


def test_gradients_vmap_and_one_graph():
    x, u = states(2), controls(2)
    functions = {
        "motion": lambda x: MOTION(x, u[0], 0.2).mean,
        "slopes": lambda x: MOTION.first_order(x, u[0], 0.2)[1],
        "beacon": lambda x: BEACON(x).mean,
        "beacon slopes": lambda x: BEACON.first_order(x)[1],
        "gauge": HeadingGauge(),
        "gauge slopes": lambda x: HeadingGauge().first_order(x)[1],
    }
    for name, function in functions.items():
        whole = function(x)
        torch.testing.assert_close(torch.vmap(function)(x), whole, rtol=1e-12, atol=1e-13)
        compiled = torch.compile(function, fullgraph=True, backend="eager", dynamic=False)
        torch.testing.assert_close(compiled(x), whole, rtol=0, atol=0)
        if "slopes" not in name:
            inputs = (x.clone().requires_grad_(),)
            assert torch.autograd.gradcheck(function, inputs, check_forward_ad=True, fast_mode=True), name


# Symmetry -------------------------------------------------------------------------------------------------------------


@SIZES
def test_the_model_does_not_know_where_the_axes_point(size):
    """Turned about the vertical: the same measurements, and the motion of the turned is the turned motion."""
    x, u = states(6, size=size), controls(6)
    law = LOST if size == 17 else MOTION
    for angle in (0.3, -2.0, math.pi):
        other = torch.from_numpy(np.stack([oracle.turned(row, angle) for row in x.numpy()]))
        for sensor in (BEACON, Barometer(0.4)):
            torch.testing.assert_close(sensor(other).mean, sensor(x).mean, rtol=1e-12, atol=1e-12)
        assert torch.equal(BEACON.in_view(other), BEACON.in_view(x))
        moved = torch.from_numpy(np.stack([oracle.turned(row, angle) for row in law(x, u, 0.2).mean.numpy()]))
        away = law.space.local(moved, law(other, u, 0.2).mean)
        assert away.abs().max() < 1e-13


@SIZES
def test_gauge_picks_one_state_of_each_orbit(size):
    gauge, x = HeadingGauge(), states(20, size=size, tilt=0.6)
    found = gauge(x)
    space = PAD_HEIGHT_SPACE if size == 17 else LANDING_SPACE
    for row, after in zip(x.numpy(), found.numpy(), strict=True):
        heading = oracle.heading(row)
        assert oracle.heading(after) == pytest.approx(0, abs=1e-14)
        assert np.abs(oracle.local(oracle.turned(row, heading), after)).max() < 1e-13
        other = torch.from_numpy(oracle.turned(row, 2.5))
        assert space.local(torch.from_numpy(after), gauge(other)).abs().max() < 1e-13
    torch.testing.assert_close(gauge(found), found, rtol=0, atol=1e-13)
    torch.testing.assert_close(found[:, 10:], x[:, 10:], rtol=0, atol=0)
    # The nose backwards, exactly, and both signs of the quaternion.
    back = torch.zeros(1, size, dtype=DOUBLE)
    back[:, 2], back[:, 7] = 1, 3.0
    assert gauge(back)[0, 7] == -3 and gauge(-back)[0, 3].abs() == 1


@SIZES
def test_first_order_of_the_gauge(size):
    """Against differences of the oracle's turn and forward-mode derivatives; the orbit's direction is lost."""
    gauge, x = HeadingGauge(), states(8, size=size, tilt=0.6)
    space = PAD_HEIGHT_SPACE if size == 17 else LANDING_SPACE
    found, jacobian = gauge.first_order(x)
    torch.testing.assert_close(found, gauge(x), rtol=0, atol=0)
    for row, slope in zip(x.numpy(), jacobian.numpy(), strict=True):
        at = oracle.turned(row, oracle.heading(row))
        expected = oracle.differences(
            lambda y, at=at: oracle.local(at, oracle.turned(y, oracle.heading(y))), row, np.full(size - 1, 1e-6)
        )
        np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-7)
    for at in (x, found):  # in the gauge the turn is zero

        def response(error, at=at):
            return space.local(gauge(at).unsqueeze(-2), gauge(space.retract(at.unsqueeze(-2), error)))

        directions = torch.eye(size - 1, dtype=DOUBLE).expand(8, -1, -1).contiguous()
        exact = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1].mT
        torch.testing.assert_close(gauge.first_order(at)[1], exact, rtol=1e-11, atol=1e-12)
    v, p = x[:, 4:7], x[:, 7:10]
    up, zero = torch.tensor([0.0, 0, 1]).double().expand(8, 3), torch.zeros(8, size - 10, dtype=DOUBLE)
    orbit = torch.cat([up, torch.linalg.cross(up, v), torch.linalg.cross(up, p), zero], -1)
    assert (jacobian @ orbit.unsqueeze(-1)).abs().max() < 1e-13
    assert (torch.linalg.matrix_rank(jacobian) == size - 2).all()


def test_gauge_above_the_pad_and_with_the_nose_up():
    """Regular where a bearing is not; finite even where the heading has no meaning."""
    x = states(4)
    x[:, 7:9] = 0
    assert HeadingGauge().first_order(x)[1].abs().max() < 10
    x[:, :3], x[:, 3] = torch.tensor([1.0, 0, 0]), 1
    x[:, :4] /= 2**0.5
    found, jacobian = HeadingGauge().first_order(x)
    assert found.isfinite().all() and jacobian.isfinite().all()


# Start and model ------------------------------------------------------------------------------------------------------


def test_prior():
    prior = landing_prior()
    assert prior.space == LANDING_SPACE == Product(tf.UnitQuaternion("left"), Euclidean(12))
    assert prior.mean.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0, 15, 0, 0, 0, 0, 0, 0]
    degree = math.radians(1)
    expected = [3 * degree] * 2 + [math.pi / 3**0.5] + [2.0] * 3 + [15, 15, 5] + [0.05 * degree] * 3 + [0.03] * 3
    np.testing.assert_allclose(prior.scale_tril, expected, rtol=4 * EPS)
    # As wide as a heading that may be anywhere.
    assert prior.scale_tril[2] == pytest.approx(stats.uniform(-math.pi, 2 * math.pi).std())
    start = LandingStart(20.0, 1.0, 2.0, 3.0, 0.1, pad_height_sd_m=4.0)
    other = landing_prior(start, ImuGrade(0.5, 1.0, 0.6, 1.0))
    assert other.space == PAD_HEIGHT_SPACE and other.mean[9] == 20 and other.mean.shape == (17,)
    np.testing.assert_allclose(
        other.scale_tril[[0, 1, 3, 4, 5, 6, 7, 8, 9, 12, 15]], [0.1, 0.1, 3, 3, 3, 1, 1, 2, 0.5, 0.6, 4.0]
    )


def test_model():
    model = landing_model()
    prior = model.prior()
    gauge = HeadingGauge()
    assert torch.equal(model.representative(states(3)), gauge(states(3)))
    # Whatever the heading is, the prior in the gauge does not ask: its spread about the vertical is gone.
    assert prior.covariance[2, 2] < 1e-12 and prior.covariance[6, 6] == pytest.approx(225)
    free = landing_model(gauge=False)
    assert torch.equal(free.representative(states(3)), states(3)) and free.prior().covariance[2, 2] > 3
    x = states(3)
    law = model.conditional("observation", x)
    torch.testing.assert_close(law.mean, torch.cat([Barometer(0.4)(x).mean, BEACON(x).mean], -1), rtol=0, atol=0)
    assert law.variance.sqrt()[..., :1] == pytest.approx(0.4)
    bare = landing_model(barometer_sd_m=None, beacon_sd_rad=0.02)
    sight = bare.conditional("observation", x)
    assert sight.mean.shape == (3, 2) and sight.variance.sqrt().flatten()[-1] == pytest.approx(0.02)
    lost = landing_model(LandingStart(pad_height_sd_m=5.0), ImuGrade(0.1, 0.2, 0.3, 0.4), barometer_sd_m=1.0)
    assert lost.prior().mean.shape == (17,)
    noise = lost.conditional("transition", states(2, size=17), controls(2), 1.0).scale_tril
    assert noise.tolist() == pytest.approx([0.2] * 3 + [0.4] * 3 + [0.0] * 10)
    imu = landing_model().conditional("transition", x, controls(3), 1.0).scale_tril
    assert imu[0] == ROTOR_IMU.angle_random_walk_rad_sqrt_s and imu[3] == ROTOR_IMU.velocity_random_walk_m_s_sqrt_s


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LandingTransition(-1.0, 0.1), "angle_random_walk_rad_sqrt_s must be one finite number >= 0, got -1.0"),
        (lambda: LandingTransition(0.1, math.inf), "velocity_random_walk_m_s_sqrt_s must be one finite number"),
        (lambda: LandingTransition(0.1, 0.1, math.nan), "gyro_bias_walk_rad_s_sqrt_s must be one finite number"),
        (lambda: LandingTransition(0.1, 0.1, 0.1, torch.ones(3)), "accel_bias_walk_m_s2_sqrt_s must be one finite"),
        (lambda: MOTION(states(2, size=17), controls(2), 0.1), r"the state must be \(..., 16\), got \(2, 17\)"),
        (lambda: LOST(states(2), controls(2), 0.1), r"the state must be \(..., 17\), got \(2, 16\)"),
        (lambda: MOTION(states(2), None, 0.1), r"needs increments \(dtheta, dv\) as a control .* got none"),
        (lambda: MOTION(states(2), torch.zeros(2, 5), 0.1), r"got shape \(2, 5\)"),
        (lambda: MOTION(states(2), controls(2)), "needs the time step dt"),
        (lambda: MOTION(states(2), controls(2), -0.1), "dt must be >= 0, got -0.1"),
        (lambda: Barometer(0.0), "sd_m must be one positive finite number, got 0.0"),
        (lambda: Beacon(math.nan), "sd_rad must be one positive finite number, got nan"),
        (lambda: Beacon(torch.ones(2)), "sd_rad must be one positive finite number"),
        (lambda: Beacon(0.1, field_of_view_rad=(0.5,)), r"field_of_view_rad must be two angles .* got \(0.5,\)"),
        (lambda: Beacon(0.1, field_of_view_rad=(0.5, 1.6)), "field_of_view_rad must be two angles"),
        (
            lambda: Beacon(0.1, edge_rad=0.5),
            "edge_rad must lie between the picture's corner, 0.5819, and pi/2, got 0.5",
        ),
        (lambda: Beacon(0.1, edge_rad=1.6), "edge_rad must lie between"),
        (lambda: Beacon(0.1, range_m=0.0), "range_m must be positive, got 0.0"),
        (lambda: LandingStart(tilt_sd_rad=-0.1), "tilt_sd_rad must be finite and not negative, got -0.1"),
        (lambda: LandingStart(pad_height_sd_m=math.inf), "pad_height_sd_m must be finite and not negative, got inf"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_module_says_what_it_is():
    assert landing.CONTROL_SIZE == 6 and landing.GRAVITY_M_S2 == 9.80665
    assert ROTOR_IMU.gyro_bias_sd_rad_s == pytest.approx(math.radians(0.05)) and ROTOR_IMU.accel_bias_sd_m_s2 == 0.03
