"""The true flight against the study's numbers, SciPy's integrators and Newton's law."""

import math
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
import torch
from oracles import inertial_oracle as oracle
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from torchfilt.models import attitude
from torchfilt.models.inertial.flight import FlightPlan, Segment, fly, reconnaissance

DOUBLE = torch.float64
PLAN = reconnaissance()
SECONDS = torch.arange(1001, dtype=DOUBLE)
FLIGHT = fly(PLAN, SECONDS)
NAVIGATION = FLIGHT.navigation
EARTH_RATE = 7.292115e-5

# Everything changes at once, from a climbing start: no term of the kinematics vanishes.
STEEP = FlightPlan(-0.7, 2.9, 500.0, 80.0, (Segment(8, 30, 0.4, -0.9), Segment(5, -20, -0.7, 1.2)), 0.2, 4.0)


def test_reconnaissance_meets_the_study():
    """The end is given to a tenth of a degree and to a metre."""
    lat, lon = (np.degrees(v.numpy()) for v in (NAVIGATION.latitude, NAVIGATION.longitude))
    np.testing.assert_allclose([lat[0], lon[0]], [34.2, 108.9], rtol=1e-15)
    np.testing.assert_allclose(NAVIGATION.velocity[0], [0.0, 100.0, 0.0], atol=1e-12)
    assert NAVIGATION.height[0] == 2000
    assert abs(lat[-1] - 34.8) < 0.005 and abs(lon[-1] - 110.6) < 0.005
    assert abs(NAVIGATION.height[-1] - 2748) < 0.5
    assert abs(NAVIGATION.height.max() - 5875) < 0.5
    assert NAVIGATION.velocity.norm(dim=-1).max() == pytest.approx(190, abs=1e-9)
    assert PLAN.duration_s == pytest.approx(1000, abs=1e-12)
    _, pitch, roll = attitude.to_euler(NAVIGATION.quaternion)
    assert roll.min() < -0.3 and roll.max() > 0.3, "it turns both ways"
    assert pitch.min() < -0.1 and pitch.max() > 0.13, "it climbs and descends"
    assert roll.abs().max() < 1.0 and FLIGHT.accel_m_s2.norm(dim=-1).max() < 20, "an aircraft can fly it"


def velocity(plan, t):
    """East, north, up from the plan's own words: the four-times-flat polynomial of each segment that has begun."""
    speed, climb, heading = plan.speed_m_s, plan.climb_rad, plan.heading_rad
    for part in plan.segments:
        s = min(max(t / part.duration_s, 0.0), 1.0)
        share = sum(math.comb(7, k) * s**k * (1 - s) ** (7 - k) for k in range(4, 8))
        speed += share * part.speed_change_m_s
        climb += share * part.climb_change_rad
        heading += share * part.heading_change_rad
        t -= part.duration_s
    level = speed * math.cos(climb)
    return np.array([level * math.sin(heading), level * math.cos(heading), speed * math.sin(climb)])


@pytest.mark.parametrize("plan", [PLAN, STEEP], ids=["reconnaissance", "steep"])
def test_position_equals_an_adaptive_integration(plan):
    """SciPy, anew for each segment, on another package's Earth; 1e-13 a step is 1e-6 m, 1e-5 m over the flight."""
    ends = np.cumsum([0.0, *(part.duration_s for part in plan.segments)])
    flight = fly(plan, torch.from_numpy(ends))

    def slope(t, y):
        v, lat = velocity(plan, t), math.degrees(y[0])
        north, across = pymap3d.rcurve.meridian(lat) + y[2], pymap3d.rcurve.transverse(lat) + y[2]
        return [v[1] / north, v[0] / (across * math.cos(y[0])), v[2]]

    path = [[plan.latitude_rad, plan.longitude_rad, plan.height_m]]
    for span in pairwise(ends):
        answer = solve_ivp(slope, span, path[-1], "DOP853", rtol=1e-13, atol=[1e-15, 1e-15, 1e-9], max_step=10.0)
        path.append(answer.y[:, -1])
    place, scale = torch.stack(flight.navigation[2:], -1).numpy(), np.array([6.4e6, 6.4e6, 1.0])
    np.testing.assert_allclose(place * scale, np.array(path) * scale, rtol=0, atol=1e-5)
    np.testing.assert_allclose(flight.navigation.velocity, [velocity(plan, t) for t in ends], atol=1e-11)


def inertial(plan, times):
    """Positions (t, 3) and attitudes in axes that don't turn."""
    flight = fly(plan, times)
    places, turns = [], []
    for k, t in enumerate(times.tolist()):
        lat, lon, h = (float(part[k]) for part in flight.navigation[2:])
        spin = Rotation.from_euler("z", EARTH_RATE * t)
        places.append(spin.apply(oracle.ecef(lat, lon, h)))
        axes = np.array(
            [
                [-math.sin(lon), math.cos(lon), 0],
                [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)],
                [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)],
            ]
        )
        turns.append(spin * Rotation.from_matrix(axes.T) * Rotation.from_quat(flight.navigation.quaternion[k].numpy()))
    return np.array(places), turns, flight


@pytest.mark.parametrize(
    ("plan", "time"), [(PLAN, 61.3), (PLAN, 138.7), (PLAN, 371.0), (PLAN, 640.2), (STEEP, 3.1), (STEEP, 9.9)]
)
def test_rate_and_force_obey_newton(plan, time):
    """Sensors at one time against differences of attitude and position in inertial axes.

    Sixth-order differences with steps of 0.04 s: rounding of the position is 1e-9 m, hence 5e-6 m/s^2; truncation at
    segments of 5 s and more is below. Gravity is that of the potential, 5e-5 m/s^2 across the normal at 6 km.
    """
    step = 0.04
    times = time + step * torch.arange(-3, 4, dtype=DOUBLE)
    places, turns, flight = inertial(plan, times)
    second = np.array([2, -27, 270, -490, 270, -27, 2]) / 180 / step**2
    acceleration = second @ places
    lat, lon, h = (float(part[3]) for part in flight.navigation[2:])
    down, south = oracle.gravity(lat, h)
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    spin = Rotation.from_euler("z", EARTH_RATE * time)
    omega = np.array([0, 0, EARTH_RATE])
    gravitation = spin.apply(-down * up - south * north) + np.cross(omega, np.cross(omega, places[3]))
    force = turns[3].inv().apply(acceleration - gravitation)
    np.testing.assert_allclose(flight.accel_m_s2[3], force, rtol=0, atol=6e-5)

    # Rotation vectors from the middle attitude: their derivative there is the body rate.
    vectors = np.array([(turns[3].inv() * q).as_rotvec() for q in turns])
    rate = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60 / step @ vectors
    np.testing.assert_allclose(flight.gyro_rad_s[3], rate, rtol=0, atol=1e-7)


@pytest.mark.parametrize("plan", [PLAN, STEEP], ids=["reconnaissance", "steep"])
def test_increments_are_integrals(plan):
    """Simpson's rule on a grid ten times finer: fourth order, off by h^4 / 180 of the fourth derivative, 1e-8 here."""
    fine = torch.linspace(0, min(plan.duration_s, 150.0), 3001 if plan is STEEP else 30001, dtype=DOUBLE)
    samples, coarse = fly(plan, fine), fly(plan, fine[::10])
    weights = torch.tensor([1, 4, 2, 4, 2, 4, 2, 4, 2, 4, 1], dtype=DOUBLE) / 3 * (fine[1] - fine[0])
    for values, found in ((samples.gyro_rad_s, coarse.dtheta_rad), (samples.accel_m_s2, coarse.dvelocity_m_s)):
        expected = (values.unfold(0, 11, 10) * weights).sum(-1)
        torch.testing.assert_close(found, expected, rtol=0, atol=3e-8)
        joined = (found.sum(0), fly(plan, fine[[0, -1]]))
        whole = joined[1].dtheta_rad if values is samples.gyro_rad_s else joined[1].dvelocity_m_s
        torch.testing.assert_close(joined[0], whole[0], rtol=0, atol=1e-9)


def test_turns_are_coordinated():
    """Nothing to the side but the Earth's rotation and curvature: 2 Omega v + v^2 tan(lat) / R, at most 0.04 m/s^2."""
    sideways = FLIGHT.accel_m_s2[:, 0]
    assert sideways.abs().max() < 0.05
    heading, _, roll = attitude.to_euler(NAVIGATION.quaternion)
    turning = heading[2:] - heading[:-2]
    right, left = turning > 0.01, turning < -0.01
    assert right.sum() > 30 and left.sum() > 30
    assert bool((roll[1:-1][right] > 0).all()) and bool((roll[1:-1][left] < 0).all())


def test_the_body_looks_along_its_path():
    ahead = attitude.rotate(NAVIGATION.quaternion, torch.tensor([0.0, 1.0, 0.0], dtype=DOUBLE))
    speed = NAVIGATION.velocity.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(ahead, NAVIGATION.velocity / speed, rtol=0, atol=1e-14)


def test_segments_join_smoothly():
    """Velocity has three continuous derivatives, so specific force and rate have one at least: slopes from both sides
    agree to the step times the second derivative's jump, 1e-3 times 0.2."""
    step = 1e-3
    for joint in (34.0, 84.0, 124.0, 144.0, 270.52, 620.52, 740.52):
        around = fly(PLAN, joint + step * torch.arange(-2, 3, dtype=DOUBLE))
        for values in (around.gyro_rad_s, around.accel_m_s2):
            slopes = values.diff(dim=0) / step
            assert (slopes[2] - slopes[1]).abs().max() < 2e-3, joint


def test_any_grid_gives_the_same_flight():
    """Times between, uneven ones, and a part of the flight: to the rounding of positions and of running sums."""
    uneven = torch.tensor([0.0, 0.004, 33.3, 34.0, 90.123, 500.0, 999.99, 1000.0], dtype=DOUBLE)
    alone = fly(PLAN, uneven[4:7])
    whole = fly(PLAN, uneven)
    for one, other in zip(alone.navigation, whole.navigation, strict=True):
        torch.testing.assert_close(one, other[4:7], rtol=1e-14, atol=1e-9)
    torch.testing.assert_close(alone.dtheta_rad, whole.dtheta_rad[4:6], rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(alone.dvelocity_m_s, whole.dvelocity_m_s[4:6], rtol=1e-11, atol=1e-9)
    for k in (0, 3, 5, 7):
        one = fly(PLAN, uneven[k : k + 1])
        torch.testing.assert_close(one.navigation.latitude[0], whole.navigation.latitude[k], rtol=1e-14, atol=0)
        assert one.dtheta_rad.shape == (0, 3)
    second = int(uneven[5])
    for one, other in zip(whole.navigation, NAVIGATION, strict=True):
        torch.testing.assert_close(one[5], other[second], rtol=1e-14, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"segments": ()}, "at least one segment"),
        ({"segments": (Segment(5), Segment(0.0))}, "duration_s of segment 1 must be positive, got 0.0"),
        ({"speed_m_s": 0.0}, "the speed must stay positive, it is 0.0 m/s at the start"),
        ({"segments": (Segment(5, -60),)}, "the speed must stay positive, it is -10.0 m/s at the end of segment 0"),
        ({"climb_rad": 1.6}, "below a right angle, it is 1.6 rad at the start"),
        ({"segments": (Segment(5), Segment(5, 0, -2.0))}, "it is -2.0 rad at the end of segment 1"),
    ],
)
def test_bad_plans_are_named(arguments, words):
    plan = {"latitude_rad": 0.5, "longitude_rad": 0.0, "height_m": 0.0, "speed_m_s": 50.0, "segments": (Segment(9),)}
    with pytest.raises(ValueError, match=words):
        FlightPlan(**(plan | arguments))


@pytest.mark.parametrize(
    ("times", "error", "words"),
    [
        (torch.zeros(3), TypeError, "float64, got torch.float32"),
        (torch.zeros(2, 2).double(), ValueError, r"one row of times \(t,\), got shape \(2, 2\)"),
        (torch.zeros(0).double(), ValueError, "one row"),
        (torch.tensor([0.0, 2, 1]).double(), ValueError, "entries 1 and 2 are 2.0 and 1.0"),
        (torch.tensor([0.0, math.nan]).double(), ValueError, "entries 0 and 1"),
        (torch.tensor([-1.0, 2]).double(), ValueError, "inside the flight, 0 to 13"),
        (torch.tensor([1.0, 20]).double(), ValueError, "got 1.0 to 20.0 s"),
    ],
)
def test_bad_times_are_named(times, error, words):
    with pytest.raises(error, match=words):
        fly(STEEP, times)
