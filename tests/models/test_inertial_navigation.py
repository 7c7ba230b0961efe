"""Laws of the total navigation state: meaning, noise, first order, refusals, and a calibrated filter of both."""

import math

import numpy as np
import pymap3d
import pytest
import torch
from oracles import inertial_oracle as oracle
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import nn

import torchfilt as tf
from torchfilt import moments
from torchfilt.models import attitude
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.navigation import (
    NAVIGATION_SPACE,
    NavigationFixes,
    StrapdownTransition,
    navigation_state,
    state_navigation,
)
from torchfilt.models.inertial.strapdown import Navigation, increments, mechanize
from torchfilt.spaces import Angle, Euclidean, Product

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
ORIGIN = LocalMetres(math.radians(34.2), math.radians(108.9), 200.0)
WHITE = dict(angle_random_walk_rad_sqrt_s=2e-4, velocity_random_walk_m_s_sqrt_s=3e-3)
WALKS = dict(gyro_bias_walk_rad_s_sqrt_s=4e-6, accel_bias_walk_m_s2_sqrt_s=5e-5)
TIMES = dict(gyro_bias_time_s=30.0, accel_bias_time_s=7.0)
ARMS = dict(antenna_m=torch.tensor([0.5, -1.0, 1.2]).double(), axle_m=torch.tensor([0.1, -1.5, -0.3]).double())
ALL = dict(position_sd_m=2.0, velocity_sd_m_s=0.1, height_sd_m=3.0, heading_sd_rad=0.02, body_velocity_sd_m_s=0.05)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def states(*lead, seed=0):
    """Any attitude, 50 m/s, 5 km from the origin, biases of cheap sensors."""
    q = normal(*lead, 4, seed=seed)
    rest = normal(*lead, 12, seed=seed + 1)
    scale = torch.tensor([50.0] * 3 + [5e3, 5e3, 300.0] + [1e-3] * 3 + [1e-2] * 3, dtype=DOUBLE)
    return torch.cat([q / q.norm(dim=-1, keepdim=True), rest * scale], -1)


def controls(*lead, seed=5):
    """Turns of 0.1 rad, pushes of 0.2 s of gravity."""
    return normal(*lead, 6, seed=seed) * torch.tensor([0.1] * 3 + [2.0] * 3, dtype=DOUBLE)


# Motion ---------------------------------------------------------------------------------------------------------------


def test_state_and_navigation():
    x = states(4, 2)
    nav = state_navigation(x, ORIGIN)
    again = navigation_state(nav, ORIGIN, x[..., 10:13], x[..., 13:])
    torch.testing.assert_close(again, x, rtol=0, atol=1e-8)  # latitude rounds to 1e-9 m
    plain = navigation_state(nav, ORIGIN)
    assert not plain[..., 10:].any() and torch.equal(plain[..., :10], again[..., :10])
    one = Navigation(*(v[0, 0] for v in nav))
    assert navigation_state(one, ORIGIN, x[..., 10:13]).shape == (4, 2, 16)
    # North is the second of the metres: one of them is 1 / north_m rad of latitude.
    moved = state_navigation(x + torch.nn.functional.one_hot(torch.tensor(8), 16), ORIGIN)
    torch.testing.assert_close(
        (moved.latitude - nav.latitude) * ORIGIN.north_m, torch.ones(4, 2).double(), rtol=1e-8, atol=0
    )


@pytest.mark.parametrize("dt", [0.2, torch.tensor([[0.1], [0.2], [0.4]], dtype=DOUBLE)], ids=["number", "rows"])
def test_without_biases_it_is_the_mechanisation(dt):
    x, u = states(3), controls(3)
    x[:, 10:] = 0
    law = StrapdownTransition(ORIGIN, **WHITE)
    mean = law(x, u, dt).mean
    nav = mechanize(state_navigation(x, ORIGIN), u[:, :3], u[:, 3:], dt)
    torch.testing.assert_close(mean, navigation_state(nav, ORIGIN), rtol=0, atol=1e-8)
    assert law.space == NAVIGATION_SPACE == Product(tf.UnitQuaternion("left"), Euclidean(12))


def test_biases_are_taken_out_of_compensated_increments():
    """Sensors with 0.15 deg/s and 0.01 g in turns of 20 deg/s: the rest is of third order in the length of the step."""
    time = 0.02 * torch.arange(200, dtype=DOUBLE).unsqueeze(-1)
    gyro = 0.3 * torch.sin(torch.tensor([1.1, 0.7, 0.9]) * time + torch.tensor([0.1, 1.0, 2.0])).double()
    accel = torch.tensor([0.5, 1.0, 9.8]) + torch.cos(torch.tensor([0.8, 1.3, 0.6]) * time).double()
    biases = torch.tensor([1e-3, -2e-3, 1.5e-3, 0.05, -0.08, 0.06], dtype=DOUBLE)
    law = StrapdownTransition(ORIGIN, **WHITE)

    def left(group):
        """Errors of attitude and velocity after a step; those of dv without the second order."""
        true = torch.cat(increments(gyro, accel, 0.02, group), -1)
        sensed = torch.cat(increments(gyro + biases[:3], accel + biases[3:], 0.02, group), -1)
        x = states(len(true))
        x[:, 10:] = 0
        expected = law(x, true, 0.02 * group).mean
        x[:, 10:] = biases
        away = NAVIGATION_SPACE.local(expected, law(x, sensed, 0.02 * group).mean).abs()
        plain = (sensed - biases * 0.02 * group - true).abs()
        return away[:, :3].max().item(), away[:, 3:6].max().item(), plain[:, 3:].max().item()

    short, long = left(2), left(10)
    assert long[0] < 1e-6 and long[1] < 3e-5
    for k in (0, 1):
        assert math.log(long[k] / short[k], 5) == pytest.approx(3, abs=0.1)
    assert short[2] > 50 * short[1]


def test_single_precision_flies_on():
    """Metres keep what latitudes in float32 (0.4 m) lose: centimetres after 48 s and 6 km in steps of 0.1 s."""
    time = 0.1 * np.arange(481)
    start = (ORIGIN.latitude_rad, ORIGIN.longitude_rad, ORIGIN.height_m)
    q, velocity = attitude.from_euler(*torch.tensor([0.4, 0.05, -0.1]).double()), np.array([10.0, 100.0, 1.0])
    turned, pushed, places, velocities, _ = oracle.flight(
        start,
        velocity,
        q.numpy(),
        lambda t: np.array([0.05, 0.0, 0.1]) * math.sin(0.3 * t),
        lambda t: np.array([0.05, 0.0, 0.1]) * (1 - math.cos(0.3 * t)) / 0.3,
        lambda t: np.array([1.0, 0.5, 0.2]),
        time,
    )
    raw = [torch.from_numpy(np.diff(v, axis=0) / 0.1) for v in (turned, pushed)]
    u = torch.cat(increments(*raw, 0.1, 2), -1)
    nav = Navigation(q, torch.from_numpy(velocity), *(torch.tensor(v, dtype=DOUBLE) for v in start))
    for dtype, metres, speed in ((DOUBLE, 0.02, 2e-4), (torch.float32, 0.1, 5e-3)):
        law = StrapdownTransition(ORIGIN, **WHITE).to(dtype)
        x = navigation_state(nav, ORIGIN).to(dtype)
        for push in u.to(dtype):
            x = law(x, push, 0.2).mean
        assert x.dtype == dtype
        end = ORIGIN.to_metres(*(torch.tensor(v) for v in places[-1]))
        assert (x[7:10] - end).abs().max() < metres
        assert np.abs(x[4:7].double().numpy() - velocities[-1]).max() < speed


# Noise ----------------------------------------------------------------------------------------------------------------


def test_noise_of_random_walks():
    law = StrapdownTransition(ORIGIN, **WHITE, **WALKS)
    result = law(states(2), controls(2), 0.25)
    assert result.is_diagonal and result.scale_tril.shape == (15,)
    expected = np.repeat([2e-4, 3e-3, 0.0, 4e-6, 5e-5], 3) * 0.5
    np.testing.assert_allclose(result.scale_tril, expected, rtol=4 * EPS)
    assert not law(states(2), controls(2), 0.0).scale_tril.any()
    rows = law(states(2), controls(2), torch.tensor([[0.25], [1.0]], dtype=DOUBLE)).scale_tril
    np.testing.assert_allclose(rows, np.stack([expected, 2 * expected]), rtol=4 * EPS)
    quiet = StrapdownTransition(ORIGIN, **WHITE)(states(2), controls(2), 1.0)
    assert not quiet.scale_tril[9:].any()


def test_sensor_noise_turns_into_the_diagonal():
    """White noise of the increments, pushed through the mean: the same in all axes, up to the turn over half a step."""
    law = StrapdownTransition(ORIGIN, **WHITE)
    x, dt = states(), 0.01
    u = 0.05 * controls()
    result = law(x, u, dt)
    jacobian = torch.func.jacfwd(lambda v: NAVIGATION_SPACE.local(result.mean, law(x, v, dt).mean))(u)
    deviation = torch.tensor([2e-4] * 3 + [3e-3] * 3, dtype=DOUBLE) * math.sqrt(dt)
    columns = jacobian * deviation
    covariance = columns @ columns.mT
    expected = result.covariance
    size = expected.diagonal()[:6].sqrt()
    # Velocity gets noise of the attitude by half of its own increment: 0.1 m/s of turn noise beside that of the push.
    correlation = (covariance - expected)[:6, :6] / (size.unsqueeze(-1) * size)
    assert correlation[:3, :3].abs().max() < 1e-4 and correlation[3:, 3:].abs().max() < 1e-2
    # The position's own noise, which the law leaves out, is half a step's worth of the velocity's.
    assert covariance.diagonal()[6:9].sqrt().max() < 0.51 * dt * float(size[3])


@pytest.mark.parametrize("dt", [0.01, 2.0, 200.0])
def test_gauss_markov_biases(dt):
    """Decay and variance of a first-order process by the matrix exponential of Van Loan."""
    law = StrapdownTransition(ORIGIN, **WHITE, **WALKS, **TIMES)
    x = states(2)
    result = law(x, controls(2), dt)
    for place, walk, time in ((slice(10, 13), 4e-6, 30.0), (slice(13, 16), 5e-5, 7.0)):
        # Scaled by the density: [[1 / T, 1], [0, -1 / T]].
        block = expm(np.array([[1 / time, 1.0], [0.0, -1 / time]]) * min(dt, 20.0))
        spread = block[1, 1] * block[0, 1] if dt < 20 else time / 2 * -math.expm1(-2 * dt / time)
        np.testing.assert_allclose(result.mean[:, place], x[:, place] * math.exp(-dt / time), rtol=8 * EPS)
        found = result.scale_tril[place.start - 1 : place.stop - 1]
        np.testing.assert_allclose(found, walk * math.sqrt(spread), rtol=1e-12)
    settled = law(x, controls(2), 1e4).scale_tril
    np.testing.assert_allclose(settled[9:], np.repeat([4e-6 * math.sqrt(15), 5e-5 * math.sqrt(3.5)], 3), rtol=4 * EPS)
    rows = law(x, controls(2), torch.tensor([[dt], [1.0]], dtype=DOUBLE))
    torch.testing.assert_close(rows.scale_tril[0], result.scale_tril, rtol=8 * EPS, atol=0)
    torch.testing.assert_close(rows.mean[0], result.mean[0], rtol=8 * EPS, atol=1e-12)


def test_one_bias_decays_and_the_other_walks():
    x, u = states(2), controls(2)
    law = StrapdownTransition(ORIGIN, **WHITE, **WALKS, accel_bias_time_s=7.0)
    result, (_, jacobian) = law(x, u, 0.5), law.first_order(x, u, 0.5)
    assert torch.equal(result.mean[:, 10:13], x[:, 10:13])
    torch.testing.assert_close(result.mean[:, 13:], x[:, 13:] * math.exp(-0.5 / 7))
    assert result.scale_tril[9] == pytest.approx(4e-6 * math.sqrt(0.5), rel=4 * EPS)
    assert torch.equal(jacobian[:, 9:12, 9:12], torch.eye(3, dtype=DOUBLE).expand(2, 3, 3))
    assert jacobian[0, 12, 12] == pytest.approx(math.exp(-0.5 / 7), rel=4 * EPS)


# First order ----------------------------------------------------------------------------------------------------------

CAR = NavigationFixes(**ALL, **ARMS)
LAWS = {
    "transition": StrapdownTransition(ORIGIN, **WHITE, **WALKS),
    "transition, biases decay": StrapdownTransition(ORIGIN, **WHITE, **WALKS, **TIMES),
    "all fixes with arms": CAR,
    "all fixes": NavigationFixes(**ALL),
    "position with an arm": NavigationFixes(position_sd_m=1.0, antenna_m=ARMS["antenna_m"]),
    "velocity with an arm": NavigationFixes(velocity_sd_m_s=1.0, antenna_m=ARMS["antenna_m"]),
    "heading": NavigationFixes(heading_sd_rad=1.0),
    "body velocity": NavigationFixes(body_velocity_sd_m_s=1.0, axle_m=ARMS["axle_m"]),
}
STEPS = {"number": 0.2, "rows": torch.tensor([[0.2], [0.1], [0.3], [0.0], [1.0]], dtype=DOUBLE)}


class Plain(nn.Module):
    """A law without its short cut."""

    def __init__(self, law):
        super().__init__()
        self.law = law

    def forward(self, x, u=None, dt=None):
        return self.law(x, u, dt)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("name", LAWS)
def test_first_order_is_the_derivative_on_the_space(name, step):
    """Each entry to 1e-9 of itself, or of the rounding of its row."""
    law, x, u, dt = LAWS[name], states(5), controls(5), STEPS[step]
    at, jacobian = law.first_order(x, u, dt)
    plain = law(x, u, dt)
    torch.testing.assert_close(at.mean, plain.mean, rtol=0, atol=0)
    torch.testing.assert_close(at.scale_tril, plain.scale_tril, rtol=0, atol=0)
    lifted = (u.unsqueeze(-2), dt.unsqueeze(-2) if isinstance(dt, torch.Tensor) else dt)

    def response(error):
        points = NAVIGATION_SPACE.retract(x.unsqueeze(-2), error)
        return at.space.local(at.mean.unsqueeze(-2), law(points, *lifted).mean)

    directions = torch.eye(15, dtype=DOUBLE).expand(5, 15, 15).contiguous()
    expected = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1].mT
    assert jacobian.shape == expected.shape
    slack = 1e-9 * expected.abs() + 4 * EPS * expected.abs().amax(-1, keepdim=True)
    assert ((jacobian - expected).abs() <= slack).all()


@pytest.mark.parametrize("name", LAWS)
def test_taylor_takes_the_short_cut(name):
    law, x, u = LAWS[name], states(3), controls(3)
    factor = (normal(15, 15, seed=3).tril() * 0.1 + torch.eye(15, dtype=DOUBLE)) * 1e-2
    belief = tf.Gaussian(x, factor, NAVIGATION_SPACE)
    short, long = (moments.taylor().linearize(each, belief, u, 0.2) for each in (law, Plain(law)))
    torch.testing.assert_close(short.slope, long.slope, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(short.mean, long.mean, rtol=0, atol=0)
    torch.testing.assert_close(short.noise, long.noise, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["transition, biases decay", "all fixes with arms"])
def test_gradients_vmap_and_one_graph(name):
    law, x, u = LAWS[name], states(2), controls(2)
    scale = torch.tensor([1.0] * 4 + [50.0] * 3 + [5e3, 5e3, 300.0] + [1e-2] * 6, dtype=DOUBLE)
    inputs = (
        (x / scale).requires_grad_(),
        u.clone().requires_grad_(),
        torch.tensor([[0.2]], dtype=DOUBLE).requires_grad_(),
    )

    def scaled(x, u, dt):
        mean = law(x * scale, u, dt).mean
        return mean / scale if mean.shape[-1] == 16 else mean / 50

    assert torch.autograd.gradcheck(scaled, inputs, check_forward_ad=True, fast_mode=True)
    for function in (lambda x, u: law(x, u, 0.2).mean, lambda x, u: law.first_order(x, u, 0.2)[1]):
        whole = function(x, u)
        torch.testing.assert_close(torch.vmap(function)(x, u), whole, rtol=1e-12, atol=1e-13)
        compiled = torch.compile(function, fullgraph=True, backend="eager", dynamic=False)
        torch.testing.assert_close(compiled(x, u), whole, rtol=0, atol=0)


def test_densities_and_deviations_train():
    walk = nn.Parameter(torch.tensor(2e-4, dtype=DOUBLE))
    law = StrapdownTransition(ORIGIN, **(WHITE | dict(angle_random_walk_rad_sqrt_s=walk)))
    law(states(2), controls(2), 0.25).scale_tril.sum().backward()
    assert walk.grad.item() == pytest.approx(3 * 0.5, rel=4 * EPS)
    deviation = nn.Parameter(torch.tensor([1.0, 2.0, 3.0], dtype=DOUBLE))
    fixes = NavigationFixes(position_sd_m=deviation, heading_sd_rad=0.1)
    fixes(states(2)).scale_tril.sum().backward()
    assert deviation.grad.tolist() == [1.0, 1.0, 1.0]


# Fixes ----------------------------------------------------------------------------------------------------------------


def test_every_part_means_what_it_says():
    """Against SciPy's rotations: parts in their order, arms, angular rate without the bias."""
    x, u, dt = states(6), controls(6), 0.2
    found = CAR.measure(x, u, dt)
    turn = Rotation.from_quat(x[:, :4])
    rate = (u[:, :3] / dt - x[:, 10:13]).numpy()
    antenna, axle = ARMS["antenna_m"].numpy(), ARMS["axle_m"].numpy()
    ahead = turn.apply([0.0, 1.0, 0.0])
    expected = {
        "position": x[:, 7:10].numpy() + turn.apply(antenna),
        "velocity": x[:, 4:7].numpy() + turn.apply(np.cross(rate, antenna)),
        "height": x[:, 9:10].numpy(),
        "heading": np.arctan2(ahead[:, :1], ahead[:, 1:2]),
        "body_velocity": turn.inv().apply(x[:, 4:7]) + np.cross(rate, axle),
    }
    assert list(CAR.parts) == list(expected)
    for part, value in expected.items():
        np.testing.assert_allclose(found[:, CAR.parts[part]], value, rtol=0, atol=1e-11)
    assert CAR.space == Product(Euclidean(7), Angle(1), Euclidean(3))
    law = CAR(x, u, dt)
    assert torch.equal(law.mean, found) and law.is_diagonal
    assert law.scale_tril.tolist() == [2.0] * 3 + [0.1] * 3 + [3.0, 0.02] + [0.05] * 3
    heading = attitude.to_euler(x[:, :4])[0]
    np.testing.assert_allclose(found[:, 7], heading, rtol=0, atol=1e-13)


def test_the_antenna_is_where_geodesy_puts_it():
    """pymap3d carries the arm from the sensors to the antenna; near the origin metres are metres."""
    x = states(6)
    x[:, 7:10] *= 1e-2
    arm = ARMS["antenna_m"]
    nav = state_navigation(x, ORIGIN)
    offset = attitude.rotate(x[:, :4], arm.expand(6, 3)).numpy().T
    place = [v.numpy() for v in nav[2:]]
    there = pymap3d.enu2geodetic(*offset, *place, deg=False)
    metres = ORIGIN.to_metres(*(torch.from_numpy(np.asarray(v)) for v in there))
    found = NavigationFixes(position_sd_m=1.0, antenna_m=arm).measure(x)
    # Radii change by 2e-5 of a metre over 100 m; the arm is 1.6 m long.
    np.testing.assert_allclose(found, metres, rtol=0, atol=1e-4)


def test_parts_of_their_own():
    """Any choice of parts, its space, deviations for each axis; u is not needed without arms of velocities."""
    x = states(3)
    sd = torch.tensor([1.0, 2.0, 3.0], dtype=DOUBLE)
    law = NavigationFixes(velocity_sd_m_s=sd, body_velocity_sd_m_s=2 * sd)
    assert law(x).scale_tril.tolist() == [1, 2, 3, 2, 4, 6] and law.space == Euclidean(6)
    assert NavigationFixes(position_sd_m=sd, heading_sd_rad=0.1).space == Product(Euclidean(3), Angle(1))
    assert NavigationFixes(heading_sd_rad=0.1, body_velocity_sd_m_s=1.0).space == Product(Angle(1), Euclidean(3))
    assert NavigationFixes(heading_sd_rad=0.1).space == Product(Angle(1))
    height = NavigationFixes(height_sd_m=1.0)
    assert torch.equal(height(x).mean, x[:, 9:10]) and height.parts == {"height": slice(0, 1)}
    antenna = NavigationFixes(position_sd_m=1.0, antenna_m=ARMS["antenna_m"])
    assert not antenna.takes_controls and not law.takes_controls and CAR.takes_controls
    assert antenna(x).mean.shape == (3, 3)
    motion = StrapdownTransition(ORIGIN, **WHITE)
    prior = tf.Gaussian(x[0], torch.ones(15, dtype=DOUBLE), NAVIGATION_SPACE, is_diagonal=True)
    assert tf.StateSpaceModel(prior, motion, CAR).takes_controls()


def test_a_step_of_no_length_has_no_rate():
    x, still = states(2), torch.zeros(2, 6, dtype=DOUBLE)
    expected = CAR.measure(x, still, 0.5)
    for dt in (0.0, torch.zeros(2, 1, dtype=DOUBLE)):
        torch.testing.assert_close(CAR.measure(x, still, dt), expected, rtol=0, atol=0)


def test_measurements_are_assembled_with_gaps():
    y = CAR.assemble(heading=torch.ones(4, 1, dtype=DOUBLE), position=torch.zeros(3, dtype=DOUBLE))
    assert y.shape == (4, 11)
    seen = [0, 1, 2, 7]
    assert y[:, seen].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 4
    assert y[:, [k for k in range(11) if k not in seen]].isnan().all()
    with pytest.raises(
        ValueError, match="this law measures position, velocity, height, heading, body_velocity, not speed"
    ):
        CAR.assemble(speed=torch.ones(1))
    with pytest.raises(ValueError, match=r"heading must be \(\.\.\., 1\), got \(4, 2\)"):
        CAR.assemble(heading=torch.ones(4, 2))
    with pytest.raises(ValueError, match=r"height must be \(\.\.\., 1\), got \(\)"):
        CAR.assemble(height=torch.tensor(1.0))
    with pytest.raises(ValueError, match="give at least one of position, velocity"):
        CAR.assemble()


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("origin", "arguments", "message"),
    [
        (ORIGIN._replace(latitude_rad=math.pi / 2), {}, r"latitude inside \+-pi/2 rad, got \(1.57"),
        (ORIGIN._replace(height_m=math.nan), {}, "origin must be a finite place"),
        (
            ORIGIN,
            dict(angle_random_walk_rad_sqrt_s=-1.0),
            "angle_random_walk_rad_sqrt_s must be one finite number >= 0, got -1",
        ),
        (ORIGIN, dict(velocity_random_walk_m_s_sqrt_s=math.nan), "velocity_random_walk_m_s_sqrt_s must be one finite"),
        (ORIGIN, dict(gyro_bias_walk_rad_s_sqrt_s=math.inf), "gyro_bias_walk_rad_s_sqrt_s must be one finite number"),
        (ORIGIN, dict(accel_bias_walk_m_s2_sqrt_s=torch.ones(3)), "accel_bias_walk_m_s2_sqrt_s must be one finite"),
        (ORIGIN, dict(gyro_bias_time_s=0.0), "gyro_bias_time_s must be positive and finite, got 0"),
        (ORIGIN, dict(accel_bias_time_s=math.inf), "accel_bias_time_s must be positive and finite, got inf"),
    ],
)
def test_transitions_that_are_refused(origin, arguments, message):
    with pytest.raises(ValueError, match=message):
        StrapdownTransition(origin, **(WHITE | arguments))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ((states(2), None, 0.1), r"increments \(dtheta, dv\) as a control u \(\.\.\., 6\), got none"),
        ((states(2), controls(2)[:, :3], 0.1), r"control u \(\.\.\., 6\), got shape \(2, 3\)"),
        ((states(2), controls(2), None), "this law needs the time step dt"),
        ((states(2), controls(2), -0.1), "dt must be >= 0, got -0.1"),
        ((states(2)[:, :15], controls(2), 0.1), r"the state must be \(\.\.\., 16\), got \(2, 15\)"),
    ],
)
def test_calls_that_are_refused(call, message):
    for law in (LAWS["transition"], CAR):
        for way in (law, law.first_order):
            with pytest.raises(ValueError, match=message):
                way(*call)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give the standard deviation of at least one of position, velocity, height, heading, body_velocity"),
        (dict(position_sd_m=0.0), r"the deviation of position must be positive and finite, got 0"),
        (
            dict(velocity_sd_m_s=torch.tensor([1.0, math.nan, 1.0])),
            "the deviation of velocity must be positive and finite",
        ),
        (dict(height_sd_m=torch.ones(2)), r"the deviation of height must be one number or \(1,\), got \(2,\)"),
        (dict(heading_sd_rad=math.inf), "the deviation of heading must be positive and finite"),
        (dict(body_velocity_sd_m_s=torch.ones(1, 3)), r"one number or \(3,\), got \(1, 3\)"),
        (dict(height_sd_m=1.0, antenna_m=torch.ones(3)), "antenna_m was given, but nothing that is measured there"),
        (dict(position_sd_m=1.0, axle_m=torch.ones(3)), "axle_m was given, but nothing that is measured there"),
        (
            dict(position_sd_m=1.0, antenna_m=torch.ones(2)),
            r"antenna_m must be three finite numbers \(3,\), got \[1.0, 1.0\]",
        ),
        (dict(body_velocity_sd_m_s=1.0, axle_m=torch.tensor([1, math.nan, 1])), "axle_m must be three finite numbers"),
    ],
)
def test_fixes_that_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        NavigationFixes(**arguments)


# Both laws in a filter ------------------------------------------------------------------------------------------------


def test_an_extended_filter_of_both_laws_is_calibrated():
    """100 cars drawn from the model itself; NEES of 15 and NIS of 11 degrees of freedom.

    Means over 100 runs: 15 +- 0.55 and, with 40 steps, 11 +- 0.075; five standard deviations miss once in 2 million.
    """
    runs, steps, dt = 100, 40, 0.1
    motion = StrapdownTransition(ORIGIN, **WHITE, **WALKS)
    law = NavigationFixes(**(ALL | dict(position_sd_m=0.5)), **ARMS)
    deviation = torch.tensor([5e-3] * 3 + [0.2] * 3 + [1.0] * 3 + [1e-3] * 3 + [0.02] * 3, dtype=DOUBLE)
    start = torch.zeros(16, dtype=DOUBLE)
    start[:4] = attitude.from_euler(*torch.tensor([0.7, 0.02, -0.01]).double())
    start[4:7] = 15 * torch.tensor([math.sin(0.7), math.cos(0.7), 0.0])
    prior = tf.Gaussian(start, deviation, NAVIGATION_SPACE, is_diagonal=True)
    x = prior._replace(mean=start.expand(runs, 16)).sample(normal(runs, 15, seed=11))
    # A bend to the left with the force that holds the car in it.
    u = torch.tensor([0.0, 0.0, 0.3 * dt, -4.5 * dt, 0.1 * dt, 9.8 * dt], dtype=DOUBLE).expand(steps, 6)
    noise, error = normal(steps, runs, 15, seed=12), normal(steps, runs, 11, seed=13)
    ys = []
    for k in range(steps):
        x = motion(x, u[k], dt).sample(noise[k])
        ys.append(law(x, u[k], dt).sample(error[k]))
    history = tf.ExtendedKalmanFilter(tf.StateSpaceModel(prior, motion, law))(torch.stack(ys), u, dt)
    belief = history.final.belief
    away = NAVIGATION_SPACE.local(belief.mean, x)
    nees = torch.linalg.solve_triangular(belief.factor(), away.unsqueeze(-1), upper=False).square().sum((-2, -1))
    assert abs(nees.mean() - 15) < 5 * math.sqrt(2 * 15 / runs)
    nis = history.diagnostics.nis
    assert abs(nis.mean() - 11) < 5 * math.sqrt(2 * 11 / (runs * steps))
