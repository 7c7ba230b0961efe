"""Mechanisation against closed forms, geodesics of geographiclib and Newton's law in inertial axes."""

import math

import numpy as np
import pytest
import torch
from geographiclib.geodesic import Geodesic
from oracles import inertial_oracle as oracle
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.optimize import curve_fit
from scipy.spatial.transform import Rotation

from torchfilt.models import attitude
from torchfilt.models.inertial import earth, strapdown
from torchfilt.models.inertial.strapdown import Navigation, compensate, increments, join, mechanize, navigate

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps


def tensor(*values):
    return torch.tensor(values, dtype=DOUBLE)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def level(heading_rad=0.0):
    return attitude.from_euler(*tensor(heading_rad, 0.0, 0.0))


# Samples --------------------------------------------------------------------------------------------------------------

# D_ij of the samples i < j, by hand for two and from the literature for three and four (Jiang and Lin 1992, Ignagni).
WEIGHTS = {
    1: {},
    2: {(0, 1): 2 / 3},
    3: {(0, 1): 57 / 80, (1, 2): 57 / 80, (0, 2): 33 / 80},
    4: {
        (0, 1): 736 / 945,
        (0, 2): 334 / 945,
        (0, 3): 526 / 945,
        (1, 2): 218 / 315,
        (1, 3): 334 / 945,
        (2, 3): 736 / 945,
    },
}


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_constant_rate_and_force_are_exact(samples):
    """Up to 1.5 rad in one group: the mean of the rotations in between."""
    turn, push = tensor(0.9, -1.0, 0.7), tensor(0.3, 0.2, -1.0)
    dtheta, dv = compensate(*(v.expand(samples, 3) / samples for v in (turn, push)))
    torch.testing.assert_close(dtheta, turn, rtol=0, atol=4 * EPS)
    exact, _ = quad_vec(lambda s: Rotation.from_rotvec(s * turn.numpy()).apply(push.numpy()), 0, 1, epsabs=1e-14)
    np.testing.assert_allclose(dv, exact, rtol=0, atol=16 * EPS)


def coning(samples, step_rad, angle=0.02, rounds=40):
    """Drift about z in rad after many groups of a cone of half-angle ``angle``; and what second order theory says."""
    t = step_rad * np.arange(samples * rounds + 1)
    # Integrals of the body rate (-sin a sin t, sin a cos t, cos a - 1) for one radian of the cone a second.
    integral = np.stack([math.sin(angle) * np.cos(t), math.sin(angle) * np.sin(t), (math.cos(angle) - 1) * t], -1)
    samples_rad = torch.from_numpy(np.diff(integral, axis=0)).unflatten(0, (rounds, samples))
    dtheta, _ = compensate(samples_rad, torch.zeros_like(samples_rad))
    half = math.sin(angle / 2)
    truth = np.stack([half * np.cos(t), half * np.sin(t), 0 * t, math.cos(angle / 2) + 0 * t], -1)
    total = Rotation.from_quat(truth[0])
    for turn in dtheta:
        total = total * Rotation.from_rotvec(turn)
    drift = (total * Rotation.from_quat(truth[-1]).inv()).as_rotvec()[2]
    found = sum(
        4 * math.sin(step_rad / 2) ** 2 * d * math.sin((j - i) * step_rad) for (i, j), d in WEIGHTS[samples].items()
    )
    needed = (samples * step_rad - math.sin(samples * step_rad)) / 2
    return drift, rounds * math.sin(angle) ** 2 * (found - needed)


@pytest.mark.parametrize("step_rad", [0.1, 0.5])
@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_coning_drifts_as_theory_says(samples, step_rad):
    """The remainder of the second order; the fourth in the cone's angle adds its square, 4e-4, of the coning itself."""
    drift, expected = coning(samples, step_rad)
    whole = 40 * math.sin(0.02) ** 2 * (samples * step_rad) ** 3 / 12
    assert abs(drift - expected) < 4e-4 * whole + 1e-15
    if samples == 1:
        assert abs(drift) > 0.9 * whole  # one sample alone shows no coning


@pytest.mark.parametrize(("samples", "order"), [(1, 2), (2, 4), (3, 4), (4, 6)])
def test_coning_order(samples, order):
    """Drift a second, by the length of a sample; a small cone, so that only the second order is left."""
    errors = [coning(samples, step, angle=1e-4)[0] / (samples * step) for step in (0.4, 0.2)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_sculling_rectifies(samples):
    """A swing about x in phase with a shake along y pushes along z at half the product of their amplitudes."""
    step, rounds, swing, shake = 0.25, 64, 1e-3, 2.0
    t = step * np.arange(samples * rounds + 1)
    turn = np.stack([swing * np.sin(t), 0 * t, 0 * t], -1)
    push = np.stack([0 * t, -shake * np.cos(t), 0 * t], -1)
    raw = [torch.from_numpy(np.diff(v, axis=0)).unflatten(0, (rounds, samples)) for v in (turn, push)]
    dtheta, dv = compensate(*raw)
    torch.testing.assert_close(dtheta, raw[0].sum(1), rtol=0, atol=1e-18)
    # In the axes at the start of each group, to second order: integral of (A(t) - A(0)) f.
    a, b = (samples * step * np.arange(rounds) + shift for shift in (0, samples * step))
    exact = swing * shake * ((b - a) / 2 - (np.sin(2 * b) - np.sin(2 * a)) / 4 - np.sin(a) * (np.cos(a) - np.cos(b)))
    error = dv[:, 2].numpy() - exact
    # What the fit leaves out is of the order of its next power of the samples' phase
    # and the third order of the swing is 1e-6.
    limit = {1: 2e-3, 2: 3e-4, 3: 2e-5, 4: 5e-6}[samples] * samples
    assert np.abs(error).max() < limit * swing * shake
    if samples > 1:
        plain = raw[0].sum(1)[:, 0] * raw[1].sum(1)[:, 1] / 2  # rotation alone
        assert np.abs(error).max() < 0.2 * np.abs(plain.numpy() - exact).max()
        # In the reference's own axes the push adds up: 1/2 swing shake a second.
        total = (dv[:, 2].numpy() + swing * np.sin(a) * dv[:, 1].numpy()).sum()
        assert total / (swing * shake * t[-1]) == pytest.approx(0.5, abs=0.01)


def test_joined_increments_are_products_of_rotations():
    dtheta, dv = 0.4 * normal(5, 7, 3), normal(5, 7, 3, seed=1)
    found, push = join(dtheta, dv)
    for k in range(5):
        total, sum_ = Rotation.identity(), np.zeros(3)
        for turn, step in zip(dtheta[k], dv[k], strict=True):
            sum_ = sum_ + total.apply(step)
            total = total * Rotation.from_rotvec(turn)
        np.testing.assert_allclose(found[k], total.as_rotvec(), rtol=0, atol=64 * EPS)
        np.testing.assert_allclose(push[k], sum_, rtol=0, atol=64 * EPS)
    rest = torch.zeros(5, 2, 3, dtype=DOUBLE)
    again = join(torch.cat([dtheta, rest], 1), torch.cat([dv, rest], 1))
    torch.testing.assert_close(again, (found, push), rtol=0, atol=4 * EPS)
    one = join(dtheta[:, :1], dv[:, :1])
    assert torch.equal(one[0], dtheta[:, 0]) and torch.equal(one[1], dv[:, 0])


@pytest.mark.parametrize(("group", "size"), [(1, 1), (2, 2), (4, 4), (5, 1), (6, 3), (8, 4)])
def test_groups_of_rates(group, size):
    """Blocks of samples, a batch in the middle, a rest that is left out."""
    gyro, accel = normal(4 * group + (group > 1), 2, 3), normal(4 * group + (group > 1), 2, 3, seed=1)
    dtheta, dv = increments(gyro, accel, 0.02, group)
    assert dtheta.shape == dv.shape == (4, 2, 3)
    for k in range(4):
        for run in range(2):
            own = slice(k * group, (k + 1) * group)
            parts = [0.02 * v[own, run].unflatten(0, (group // size, size)) for v in (gyro, accel)]
            expected = join(*compensate(*parts))
            torch.testing.assert_close((dtheta[k, run], dv[k, run]), expected, rtol=0, atol=4 * EPS)
    unequal = torch.full((len(gyro), 1, 1), 0.02, dtype=DOUBLE)
    torch.testing.assert_close(increments(gyro, accel, unequal, group), (dtheta, dv), rtol=0, atol=0)


def test_two_samples_make_a_group_by_default():
    gyro, accel = normal(8, 3), normal(8, 3, seed=1)
    torch.testing.assert_close(increments(gyro, accel, 0.1), increments(gyro, accel, 0.1, 2), rtol=0, atol=0)


def test_refusals():
    good = normal(6, 3)
    with pytest.raises(ValueError, match="group must be at least 1 sample, got 0"):
        increments(good, good, 0.1, 0)
    with pytest.raises(ValueError, match=r"\(t, \*batch, 3\), got \(6, 3\) and \(5, 3\)"):
        increments(good, good[:5], 0.1)
    with pytest.raises(ValueError, match=r"\(t, \*batch, 3\), got \(6, 2\) and \(6, 2\)"):
        increments(good[:, :2], good[:, :2], 0.1)
    with pytest.raises(ValueError, match="a group of 7 samples needs at least as many, got 6"):
        increments(good, good, 0.1, 7)
    with pytest.raises(ValueError, match="at most 4 samples make a block, got 6; join several blocks"):
        compensate(good, good)


# Closed forms ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("latitude", [-1.2, 0.0, 0.7])
def test_at_rest_on_the_turning_earth(latitude):
    """Gyros feel the Earth turn, accelerometers gravity; nothing moves: ten minutes in steps of 1 s, any attitude."""
    q = attitude.from_euler(*tensor(0.7, 0.3, -1.0))
    lat, height = tensor(latitude).squeeze(), tensor(120.0).squeeze()
    back = attitude.inverse(q)
    dtheta = attitude.rotate(back, earth.earth_rate_enu(lat))
    # The body turns with the Earth: the increment in axes at the start is a little to the side of gravity.
    up = torch.nn.functional.pad(earth.gravity(lat, height).reshape(1), (2, 0))
    _, dv = compensate(dtheta.unsqueeze(0), attitude.rotate(back, up).unsqueeze(0))
    nav = Navigation(q, torch.zeros(3, dtype=DOUBLE), lat, tensor(0.3).squeeze(), height)
    for _ in range(600):
        nav = mechanize(nav, dtheta, dv, 1.0)
    # Second order in a step: (turn)^2 / 12 of the force, 4e-9 m/s^2.
    assert nav.velocity.abs().max() < 4e-6
    away = [(nav.latitude - lat) * 6.4e6, (nav.longitude - 0.3) * 6.4e6, nav.height - height]
    assert max(abs(float(v)) for v in away) < 1.2e-3
    turn = attitude.to_rotation_vector(attitude.multiply(nav.quaternion, back))
    assert turn.abs().max() < 1e-10


@pytest.mark.parametrize("speed", [250.0, -250.0])
def test_flight_along_the_equator(speed):
    """All is constant: longitude grows by v / (a + h) a second, the force is gravity less what curves the path."""
    height, dt, steps = 5000.0, 1.0, 1000
    a = earth.WGS84.semi_major_m + height
    rate = earth.WGS84.rate_rad_s + speed / a  # of the body against inertial space, about north
    down = float(earth.gravity(tensor(0.0), tensor(height))) + earth.WGS84.rate_rad_s**2 * a
    start = Navigation(level(math.pi / 2), tensor(speed, 0, 0), *(tensor(v).squeeze() for v in (0.0, -3.0, height)))
    dtheta = attitude.rotate(attitude.inverse(start.quaternion), tensor(0, rate * dt, 0))
    dv = attitude.rotate(attitude.inverse(start.quaternion), tensor(0, 0, (down - rate**2 * a) * dt))
    _, dv = compensate(dtheta.unsqueeze(0), dv.unsqueeze(0))
    path = navigate(start, dtheta.expand(steps, 3), dv.expand(steps, 3), dt)
    time = dt * torch.arange(1, steps + 1, dtype=DOUBLE)
    east = (path.longitude + 3.0 - speed / a * time) * a
    # Second order: (turn of a step)^2 / 12 of the force, 1e-8 m/s^2, along up, where errors grow as cosh(t / 570 s).
    assert east.abs().max() < 0.002 and (path.height - height).abs().max() < 0.01
    assert (path.latitude * a).abs().max() < 1e-6
    turned = attitude.to_rotation_vector(attitude.multiply(path.quaternion, attitude.inverse(start.quaternion)))
    assert turned.abs().max() < 1e-9


def geodesic_flight(azimuth_deg, speed, dt, steps):
    """Raw samples of level flight along a geodesic of the ellipsoid, height zero, by geographiclib.

    The nose follows the track. A geodesic does not turn about the vertical, so the body's rate about up is the Earth's.
    """
    line = Geodesic.WGS84.DirectLine(34.2, 108.9, azimuth_deg, 1e6)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    gyro, accel = [], []
    omega = earth.WGS84.rate_rad_s
    for k in range(steps):
        turn, push = np.zeros(3), np.zeros(3)
        for node, weight in zip(nodes, weights, strict=True):
            place = line.Position(speed * dt * (k + (node + 1) / 2))
            lat, azimuth = math.radians(place["lat2"]), math.radians(place["azi2"])
            s, c, sa, ca = math.sin(lat), math.cos(lat), math.sin(azimuth), math.cos(azimuth)
            meridian, transverse = oracle.radii(lat)
            transport = np.array([-speed * ca / meridian, speed * sa / transverse, speed * sa * s / c / transverse])
            axis = omega * np.array([0, c, s])
            velocity = speed * np.array([sa, ca, 0])
            # The azimuth of a geodesic changes by sin(azimuth) tan(latitude) / N a metre (Clairaut).
            swing = speed * sa * s / c / transverse
            rate = axis + transport - [0, 0, swing]
            force = speed * swing * np.array([ca, -sa, 0]) + np.cross(2 * axis + transport, velocity)
            force[2] += oracle.plain_gravity(lat, 0.0)
            body = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]])
            turn, push = turn + weight * dt / 2 * (body @ rate), push + weight * dt / 2 * (body @ force)
        gyro.append(turn)
        accel.append(push)
    return torch.tensor(np.array(gyro)), torch.tensor(np.array(accel))


def test_great_circles():
    """Ten minutes at 200 m/s in three directions, in steps of 4 s: position to a part in 1e7 of the 120 km."""
    azimuths, speed, dt, steps = (10.0, 70.0, -135.0), 200.0, 2.0, 300
    flown = [geodesic_flight(azimuth, speed, dt, steps) for azimuth in azimuths]
    dtheta, dv = increments(*(torch.stack(v, 1) / dt for v in zip(*flown, strict=True)), dt, 2)
    heading = torch.tensor([math.radians(azimuth) for azimuth in azimuths], dtype=DOUBLE)
    zero = torch.zeros_like(heading)
    start = Navigation(
        attitude.from_euler(heading, zero, zero),
        speed * torch.stack([heading.sin(), heading.cos(), zero], -1),
        zero + math.radians(34.2),
        zero + math.radians(108.9),
        zero,
    )
    path = navigate(start, dtheta, dv, 2 * dt)
    for k, azimuth in enumerate(azimuths):
        place = math.degrees(path.latitude[-1, k]), math.degrees(path.longitude[-1, k])
        end = Geodesic.WGS84.Direct(34.2, 108.9, azimuth, speed * dt * steps)
        gap = Geodesic.WGS84.Inverse(*place, end["lat2"], end["lon2"])["s12"]
        assert gap < 0.012
        found, pitch, roll = (float(v[-1, k]) for v in attitude.to_euler(path.quaternion))
        assert abs(found - math.radians(end["azi2"])) < 1e-8 and abs(pitch) < 1e-8 and abs(roll) < 1e-8
    assert path.height.abs().max() < 0.03  # (turn of a step)^2 / 12 of the force


def test_an_initial_tilt_swings_with_schulers_period():
    """On the equator, against the matrix exponential of the linear error equations; then the 84.4 minutes themselves.

    The Earth's rate exchanges tilt about east and heading, which adds 0.5 (rate of the Earth / Schuler's)^2, 0.2 %.
    """
    tilt, dt, steps = 1e-5, 4.0, 1400
    q = attitude.multiply(attitude.from_rotation_vector(tensor(tilt, 0, 0)), level())
    zero = torch.zeros((), dtype=DOUBLE)
    g, omega = float(earth.gravity(zero, zero)), earth.WGS84.rate_rad_s
    radius = float(earth.radii(zero)[0])
    dtheta = tensor(0, omega * dt, 0)
    _, dv = compensate(dtheta.unsqueeze(0), tensor(0, 0, g * dt).unsqueeze(0))
    start = Navigation(q, torch.zeros(3, dtype=DOUBLE), zero, zero, zero)
    path = navigate(start, dtheta.expand(steps, 3), dv.expand(steps, 3), dt)
    # Computed minus true: tilt about east, turn about up, north velocity, latitude. On the left, the tilt turns the
    # force; velocity turns ENU; a turn against ENU rotates with the Earth's rate, whose direction depends on latitude.
    system = np.array([[0, -omega, 1 / radius, 0], [omega, 0, 0, -omega], [-g, 0, 0, 0], [0, 0, 1 / radius, 0]])
    swing = expm(system * dt)
    state, expected = np.array([tilt, 0, 0, 0]), []
    for _ in range(steps):
        state = swing @ state
        expected.append(state[2])
    speed = path.velocity[:, 1].numpy()
    assert np.abs(speed).max() == pytest.approx(tilt * math.sqrt(g * radius), rel=0.03)  # 0.08 m/s
    assert np.abs(speed - expected).max() < 2e-4 * np.abs(speed).max()
    time = dt * np.arange(1, steps + 1) / 60

    def model(t, period, sine, cosine, offset, trend):
        return sine * np.sin(2 * np.pi * t / period) + cosine * np.cos(2 * np.pi * t / period) + offset + trend * t

    (period, *_), _ = curve_fit(model, time, speed, (80.0, 0.1, 0.0, 0.0, 0.0))
    assert period == pytest.approx(84.4, rel=0.005)


# Newton's law in inertial axes ----------------------------------------------------------------------------------------

PLACE = (math.radians(34.2), math.radians(108.9), 2000.0)
TURNS = np.array([[0.12, 17.0, 0.3], [0.10, 23.0, 1.0], [0.15, 41.0, 2.0]])  # rad/s, period in s, phase
PUSHES = np.array([[3.0, 60.0], [2.5, 45.0], [1.5, 80.0]])  # m/s^2, period in s


def flown(seconds, sample_s):
    """Raw samples (t, 3) and the end of a flight with turns of 9 deg/s and pushes of 0.3 g."""
    size, frequency, phase = TURNS[:, 0], 2 * math.pi / TURNS[:, 1], TURNS[:, 2]
    times = sample_s * np.arange(round(seconds / sample_s) + 1)
    q = attitude.from_euler(*tensor(0.4, 0.05, -0.1))
    velocity = np.array([10.0, 100.0, 1.0])
    turned, pushed, places, velocities, rotations = oracle.flight(
        PLACE,
        velocity,
        q.numpy(),
        lambda t: size * np.sin(frequency * t + phase),
        lambda t: size / frequency * (np.cos(phase) - np.cos(frequency * t + phase)),
        lambda t: PUSHES[:, 0] * np.sin(2 * math.pi * t / PUSHES[:, 1]),
        times,
    )
    start = Navigation(q, torch.from_numpy(velocity), *(tensor(v).squeeze() for v in PLACE))
    raw = [torch.from_numpy(np.diff(v, axis=0)) for v in (turned, pushed)]
    return start, raw, (places[-1], velocities[-1], rotations[-1])


def errors(nav, end):
    """Position in m, velocity in m/s, attitude in rad: the largest components."""
    place, velocity, rotation = end
    metres = np.array([6.4e6, 6.4e6 * math.cos(place[0]), 1.0])
    found = np.array([float(v) for v in (nav.latitude, nav.longitude, nav.height)])
    turn = attitude.to_matrix(nav.quaternion).numpy() @ rotation.T
    return (
        np.abs((found - place) * metres).max(),
        np.abs(nav.velocity.numpy() - velocity).max(),
        np.abs(Rotation.from_matrix(turn).as_rotvec()).max(),
    )


def steered(start, raw, sample_s, group):
    dtheta, dv = increments(raw[0] / sample_s, raw[1] / sample_s, sample_s, group)
    nav = start
    for turn, push in zip(dtheta, dv, strict=True):
        nav = mechanize(nav, turn, push, group * sample_s)
    return nav


def test_second_order_against_newtons_law():
    start, raw, end = flown(48.0, 0.02)

    def after(thinned, group):
        sample = [v.unflatten(0, (-1, thinned)).sum(1) for v in raw]
        return errors(steered(start, sample, 0.02 * thinned, group), end)

    fine, middle, coarse = after(2, 2), after(4, 2), after(8, 2)
    assert fine[0] < 0.01 and fine[1] < 2e-5 and fine[2] < 5e-9
    for one, two in ((coarse, middle), (middle, fine)):
        assert math.log2(one[0] / two[0]) > 1.9  # position
        assert math.log2(one[1] / two[1]) > 2.5  # velocity: sculling of third order beside smaller terms of second
    assert math.log2(coarse[2] / middle[2]) > 3.5  # attitude: coning of fourth order
    # Longer groups of the same samples cost little; single samples, which show no coning, cost a lot.
    assert after(1, 10)[2] < 1e-8
    assert after(4, 1)[2] > 100 * middle[2]


@pytest.mark.slow
def test_drift_in_1000_seconds_at_100_hz():
    """0.1 m is asked for, 0.1 mm is found, in 50,000 steps."""
    start, raw, end = flown(1000.0, 0.01)
    position, velocity, turn = errors(steered(start, raw, 0.01, 2), end)
    assert position < 1e-3 and velocity < 2e-6 and turn < 1e-9


# What a tensor function owes ------------------------------------------------------------------------------------------


def somewhere(*lead, seed=0):
    """Navigation states, increments of 0.2 s."""
    q = normal(*lead, 4, seed=seed)
    nav = Navigation(
        q / q.norm(dim=-1, keepdim=True),
        100 * normal(*lead, 3, seed=seed + 1),
        0.5 + 0.2 * normal(*lead, seed=seed + 2),
        normal(*lead, seed=seed + 3),
        1000 * normal(*lead, seed=seed + 4),
    )
    return nav, 0.1 * normal(*lead, 3, seed=seed + 5), 2 * normal(*lead, 3, seed=seed + 6)


def test_slopes_are_the_derivatives_of_a_step():
    """All of the 72 numbers, each to rounding of its own size, against forward-mode differentiation."""
    nav, dtheta, dv = somewhere(6)
    found, slopes = strapdown.advance_slopes(nav.quaternion, nav.velocity, nav.latitude, nav.height, dtheta, dv, 0.2)
    torch.testing.assert_close(
        found,
        strapdown.advance(nav.quaternion, nav.velocity, nav.latitude, nav.height, dtheta, dv, 0.2),
        rtol=0,
        atol=0,
    )
    torch.testing.assert_close(slopes.force, attitude.rotate(nav.quaternion, dv))
    identity = tensor(0, 0, 0, 1.0)

    def step(force, velocity, latitude, height):
        """With level axes and a body that does not turn, the quaternion at the end is the turn of ENU, backwards."""
        end = strapdown.advance(identity, velocity, latitude, height, torch.zeros_like(force), force, 0.2)
        turn = -attitude.to_rotation_vector(end.quaternion)
        return turn, end.velocity, torch.stack([end.longitude_rad, end.latitude_rad, end.height_m], -1)

    for k in range(6):
        at = (slopes.force[k], nav.velocity[k], nav.latitude[k], nav.height[k])
        torch.testing.assert_close(step(*at)[0], slopes.enu_turn[k], rtol=1e-10, atol=0)
        jacobians = torch.func.jacfwd(step, (0, 1, 2, 3))(*at)
        for name, (force, velocity, latitude, height) in zip(("turn", "velocity", "position"), jacobians, strict=True):
            expected = torch.cat([force, velocity, latitude.unsqueeze(-1), height.unsqueeze(-1)], -1)
            mine = getattr(slopes, name)[k]
            assert (mine - expected).abs().max() < 1e-10 * expected.abs().max()
            # Each entry beside its own row and column: small couplings are right too.
            assert (
                (mine - expected).abs() <= 1e-9 * expected.abs() + 1e-16 * expected.abs().amax(-1, keepdim=True)
            ).all()


def test_rows_and_leading_dims():
    nav, dtheta, dv = somewhere(2, 3)
    dt = torch.tensor([[[0.1], [0.2], [0.4]]], dtype=DOUBLE)
    whole = mechanize(nav, dtheta, dv, dt)
    for i in range(2):
        for j in range(3):
            row = mechanize(Navigation(*(v[i, j] for v in nav)), dtheta[i, j], dv[i, j], float(dt[0, j]))
            for one, other in zip(row, whole, strict=True):
                torch.testing.assert_close(one, other[i, j], rtol=4 * EPS, atol=0)
    mapped = torch.vmap(torch.vmap(lambda n, a, b: mechanize(n, a, b, 0.2)))(nav, dtheta, dv)
    torch.testing.assert_close(mapped, mechanize(nav, dtheta, dv, 0.2), rtol=4 * EPS, atol=1e-15)
    # One increment for all, several for one.
    assert mechanize(nav, dtheta[0, 0], dv[0, 0], 0.2).quaternion.shape == (2, 3, 4)
    one = Navigation(*(v[0, 0] for v in nav))
    assert mechanize(one, dtheta, dv, 0.2).velocity.shape == (2, 3, 3)


def test_a_path_is_its_steps():
    nav, _, _ = somewhere(2)
    dtheta, dv = 0.1 * normal(5, 2, 3), normal(5, 2, 3, seed=1)
    lengths = torch.tensor([0.1, 0.2, 0.0, 0.3, 0.1], dtype=DOUBLE)
    path = navigate(nav, dtheta, dv, lengths)
    assert path.quaternion.shape == (5, 2, 4) and path.height.shape == (5, 2)
    for k in range(5):
        nav = mechanize(nav, dtheta[k], dv[k], float(lengths[k]))
        torch.testing.assert_close(Navigation(*(v[k] for v in path)), nav, rtol=4 * EPS, atol=0)


def test_derivatives_and_one_graph():
    nav, dtheta, dv = somewhere(2)
    inputs = [v.clone().requires_grad_() for v in (*nav, dtheta, dv)]

    def step(q, velocity, latitude, longitude, height, dtheta, dv):
        """In units that make the derivatives of size one."""
        nav = Navigation(q, velocity, latitude, longitude, 1e3 * height)
        end = mechanize(nav, dtheta, dv, 0.2)
        return end.quaternion, end.velocity, end.latitude, end.longitude, 1e-3 * end.height

    inputs[4] = (nav.height / 1e3).requires_grad_()
    assert torch.autograd.gradcheck(step, inputs, check_forward_ad=True, fast_mode=True)
    samples = [normal(2, 3, 3, seed=k).requires_grad_() for k in (7, 8)]
    assert torch.autograd.gradcheck(compensate, samples, check_forward_ad=True)
    assert torch.autograd.gradcheck(lambda a, b: join(0.3 * a, b), samples, check_forward_ad=True)
    compiled = torch.compile(mechanize, fullgraph=True, backend="eager", dynamic=False)
    torch.testing.assert_close(compiled(nav, dtheta, dv, 0.2), mechanize(nav, dtheta, dv, 0.2), rtol=0, atol=0)
    mapped = torch.vmap(compensate)(*samples)
    torch.testing.assert_close(mapped, compensate(*samples), rtol=0, atol=4 * EPS)


def test_single_precision():
    """Attitude, velocity and height keep the digits of float32; latitude and longitude resolve 0.4 m."""
    nav, dtheta, dv = somewhere(20)
    low = [v.float() for v in (*nav, dtheta, dv)]
    found = mechanize(Navigation(*low[:5]), *low[5:], 0.2)
    exact = mechanize(Navigation(*(v.double() for v in low[:5])), *(v.double() for v in low[5:]), 0.2)
    assert all(v.dtype == torch.float32 for v in found)
    for name, limit in (("quaternion", 5e-7), ("velocity", 1e-4), ("latitude", 1.2e-7), ("longitude", 4e-7)):
        assert (getattr(found, name) - getattr(exact, name)).abs().max() < limit
    assert (found.height - exact.height).abs().max() < 1e-3
    assert all(v.dtype == torch.float32 for v in compensate(*(normal(2, 3).float() for _ in range(2))))
