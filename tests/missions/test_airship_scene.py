"""Scenes of the airship study: a path that obeys the equations of motion, sensors that agree with it, settings."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from oracles import airship_oracle, landing_oracle
from scipy.spatial.transform import Rotation

from torchfilt.missions.airship import (
    ANCHORED,
    APPROACH,
    CRUISE,
    TRUTH_NAMES,
    AirshipSettings,
    make_scene,
    scene,
)
from torchfilt.models.airship import Airship, AirshipTransition
from torchfilt.models.inertial.imu import ImuGrade
from torchfilt.models.inertial.strapdown import join
from torchfilt.models.landing import LandingTransition

RUNS = 30
SETTINGS = AirshipSettings(runs=RUNS, seed=40, anchored_s=5.0, cruise_s=15.0, approach_s=15.0, clutter_m=0.0)
BRIEF = AirshipSettings(runs=8, seed=40, anchored_s=1.0, cruise_s=8.0, approach_s=3.0)
SILENT = ImuGrade(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def short():
    return make_scene(SETTINGS)


def share_is(found, expected, count):
    """Within five standard errors of a share: one false alarm in 1.7 million."""
    return abs(float(found) - expected) < 5 * math.sqrt(expected * (1 - expected) / count)


def variance_is(z, expected=1.0, correlated=1.0):
    """Within five standard errors of the variance of zero-mean normals; correlated: samples per independent one."""
    return abs(float(np.mean(np.square(z))) - expected) < 5 * expected * math.sqrt(2 * correlated / np.size(z))


def heard(values, every):
    """Rows in which a sensor of this period speaks; the others must be silent."""
    silent = np.arange(1, len(values) + 1) % every != 0
    assert np.isnan(values[silent]).all()
    return ~silent


# Flight ---------------------------------------------------------------------------------------------------------------


def test_shapes_and_phases(short):
    s = short
    assert s.dt == 0.05 and len(TRUTH_NAMES) == len(set(TRUTH_NAMES)) == 21 and s.settings is SETTINGS
    assert s.start.shape == (RUNS, 21) and s.truth.shape == (700, RUNS, 21) and s.ship.shape == (700, RUNS, 13)
    assert s.thrust.shape == s.air.shape == (700, RUNS, 3) and s.controls.shape == (700, RUNS, 6)
    shapes = {name: tuple(value.shape) for name, value in s.measurements.items()}
    sizes = {"barometer": 1, "ultrasonic": 1, "magnetometer": 3, "beacons": 4}
    assert shapes == {name: (700, RUNS, size) for name, size in sizes.items()}
    assert torch.equal(s.phase, torch.tensor([ANCHORED] * 100 + [CRUISE] * 300 + [APPROACH] * 300))
    np.testing.assert_allclose(s.time, 0.05 * np.arange(1, 701), rtol=1e-14)
    assert all(part.isfinite().all() for part in (s.start, s.truth, s.ship, s.thrust, s.air, s.controls))


@pytest.mark.slow
def test_whole_mission():
    """Still at the mast, about 1 m/s past all waypoints, clear of floor, walls and ceiling, down at the spot.

    What the scene's constants and the hull's size ask for; gusts of 0.05 m/s take nothing away from that.
    """
    s = make_scene(AirshipSettings(runs=RUNS, seed=7))
    place, speed = s.ship[..., 7:10], torch.linalg.vector_norm(s.ship[..., 4:7], dim=-1)
    moored = s.phase == ANCHORED
    away = torch.linalg.vector_norm(place[moored] - torch.tensor(scene.MAST_M), dim=-1)
    assert away.max() < 0.05 and 1e-5 < speed[moored].mean() < 0.02
    cruise = s.phase == CRUISE
    assert 0.8 < speed[cruise].mean() < 1.0 and speed.max() < 1.3
    for waypoint in scene.WAYPOINTS_M:
        off = torch.linalg.vector_norm(place[cruise][..., :2] - torch.tensor(waypoint[:2]), dim=-1)
        nearest = off.min(0)
        assert (nearest.values < scene._REACHED_M).all()
        height = place[cruise][nearest.indices, torch.arange(RUNS), 2]
        assert (height - waypoint[2]).abs().max() < 1.0
    hull = Airship()
    for axis, size in enumerate(scene.HALL_M):
        reach = hull.length_m / 2 if axis < 2 else max(hull.diameter_m / 2, -hull.gondola_height_m)
        assert place[..., axis].min() > reach and place[..., axis].max() < size - reach
    off = torch.linalg.vector_norm(place[-1, :, :2] - torch.tensor(scene.LANDING_M), dim=-1)
    assert off.max() < scene._ABOVE_M and (place[-1, :, 2] - scene.LANDED_HEIGHT_M).abs().max() < 0.2
    # It sinks near the spot, under the sonar's ranges.
    assert ((s.truth[..., 9] < 0.9).any(0)).all() and s.measurements["ultrasonic"][-20:].isfinite().any(0).all()


def test_mast_holds(short):
    moored = short.phase == ANCHORED
    place = short.ship[moored][..., 7:10] - torch.tensor(scene.MAST_M)
    assert place.abs().max() < 0.05 and place[-1].abs().max() > 1e-5
    turned = Rotation.from_quat(short.ship[moored][:, :, :4].reshape(-1, 4).numpy()).apply([0, 1, 0])
    assert turned[:, 0].min() > math.cos(math.radians(30)) and (short.thrust[moored] == 0).all()
    assert (short.thrust[~moored].abs() <= torch.tensor([0.4, 0.4, 0.25])).all()


def test_path_obeys_the_equations_of_motion(short):
    """The law under thrust and air gives the next state; so does the other integration, to what a step of RK4 makes."""
    s = short
    law = AirshipTransition()
    free = slice(100, None)
    u = torch.cat([s.thrust, s.air], -1)[free]
    before = s.ship[99:-1]
    torch.testing.assert_close(law(before, u, s.dt).mean, s.ship[free], rtol=0, atol=1e-13)
    ship = asdict(Airship())
    for k, run in ((110, 0), (250, 1), (450, 2), (690, 3)):
        end = airship_oracle.fly(
            ship, s.ship[k - 1, run].numpy(), s.dt, s.thrust[k, run].numpy(), s.air[k, run].numpy()
        )
        assert np.abs(airship_oracle.local(end, s.ship[k, run].numpy())).max() < 2e-6


def test_truth_is_that_of_the_gondola(short):
    x, at = short.ship.numpy(), short.truth.numpy()
    turn = Rotation.from_quat(x[..., :4].reshape(-1, 4))
    arm = [0, 0, Airship().gondola_height_m]
    assert np.array_equal(at[..., :4], x[..., :4])
    np.testing.assert_allclose(at[..., 7:10].reshape(-1, 3), x[..., 7:10].reshape(-1, 3) + turn.apply(arm), atol=1e-12)
    spin = turn.apply(np.cross(x[..., 10:].reshape(-1, 3), arm))
    np.testing.assert_allclose(at[..., 4:7].reshape(-1, 3), x[..., 4:7].reshape(-1, 3) + spin, atol=1e-12)
    # Central differences over two steps: a quarter of dt times the jumps of the acceleration with the thrust.
    speed = (at[2:, :, 7:10] - at[:-2, :, 7:10]) / 0.1
    assert np.abs(speed - at[1:-1, :, 4:7]).max() < 1e-2


def test_gusts():
    """Stationary Gauss-Markov: deviations, and correlation over the memory; the samples of a memory count as one."""
    settings = AirshipSettings(
        runs=400, gust_sd_m_s=0.2, gust_time_s=2.0, anchored_s=0.0, cruise_s=10.0, approach_s=0.0
    )
    air = scene._gusts(settings, list(range(400))).numpy()
    for axis, sd in ((0, 0.2), (1, 0.2), (2, 0.1)):
        assert variance_is(air[0, :, axis] / sd) and variance_is(air[-1, :, axis] / sd)
        assert variance_is(air[..., axis] / sd, correlated=40)
        product = air[:-40, :, axis] * air[40:, :, axis] / sd**2
        assert abs(product.mean() - math.exp(-1)) < 5 * math.sqrt(2 * 40 / product.size)


# Inertial sensors -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("biased", [False, True])
def test_increments_without_noise_give_the_truth(biased):
    """Attitude and velocity to rounding, or 2e-7 with biases: a turn of three deviations, 1e-3, squared by dv / 4.

    Position by dt^3 / 12 of the jerk a step: 0.05^3 / 12 of at most 2 m/s^3 where the thrust jumps.
    """
    grade = replace(SILENT, gyro_bias_sd_rad_s=math.radians(0.5), accel_bias_sd_m_s2=0.1) if biased else SILENT
    s = make_scene(replace(BRIEF, imu=grade, gyro_bias_walk_rad_s_sqrt_s=0.0))
    path = torch.cat([s.start.unsqueeze(0), s.truth])[..., :16]
    law = LandingTransition(1e-4, 1e-3)
    away = law.space.local(law(path[:-1], s.controls, s.dt).mean, path[1:])
    assert away[..., :6].abs().max() < (2e-7 if biased else 1e-13)
    assert away[..., 6:9].abs().max() < 0.05**3 / 12 * 2
    assert (away[..., 9:12] == 0).all() and (path[..., 10:13] != 0).all() == biased
    # The other way round, by an adaptive integration at the constant rate and force of the increments.
    x, u = path[150, 0].numpy(), s.controls[150, 0].numpy() / s.dt
    if not biased:
        end = landing_oracle.fly(x, lambda t: u[:3], lambda t: u[3:], s.dt)
        # The force is constant in turning axes there, in axes at the start here: half the turn of the step apart.
        assert np.abs(landing_oracle.local(end, path[151, 0].numpy())).max() < 1e-2


def test_position_error_is_of_third_order_a_step():
    """Increments joined in pairs make eight times the error of one step: on the free swing of a moored ship, smooth."""
    s = make_scene(
        replace(SETTINGS, runs=4, imu=SILENT, gust_sd_m_s=0.0, anchored_s=20.0, cruise_s=0.0, approach_s=0.0)
    )
    path = torch.cat([s.start.unsqueeze(0), s.truth])[..., :16]
    path[..., 10:] = 0
    law = LandingTransition(0.0, 0.0)
    one = law.space.local(law(path[:-1], s.controls, s.dt).mean, path[1:])[..., 6:9]
    pairs = s.controls.unflatten(0, (-1, 2)).movedim(1, -2)
    joined = torch.cat(join(pairs[..., :3], pairs[..., 3:]), -1)
    two = law.space.local(law(path[:-1:2], joined, 2 * s.dt).mean, path[2::2])[..., 6:9]
    # Moored, the pull of the mast jumps at every step: it is the jerk's mean over a step that counts.
    ratio = two.square().mean().sqrt() / one.square().mean().sqrt()
    assert 6 < ratio < 9.5, ratio


def test_noise_of_the_increments(short):
    """White, of the stated density; variances to five standard errors."""
    s = short
    path = torch.cat([s.start.unsqueeze(0), s.truth])[..., :16]
    law = LandingTransition(1e-4, 1e-3)
    away = law.space.local(law(path[:-1], s.controls, s.dt).mean, path[1:]).numpy()
    for part, density in ((slice(0, 3), math.radians(0.01)), (slice(3, 6), 0.002)):
        z = away[..., part] / (density * math.sqrt(0.05))
        assert variance_is(z) and abs(np.mean(z[1:] * z[:-1])) < 5 / math.sqrt(z.size)


def test_biases(short):
    """Start and walk of the stated sizes."""
    settings = replace(SETTINGS, runs=300, gyro_bias_walk_rad_s_sqrt_s=1e-3, accel_bias_walk_m_s2_sqrt_s=0.02)
    bias = scene._biases(settings, list(range(300))).numpy()
    for part, start, walk in ((slice(0, 3), math.radians(0.1), 1e-3), (slice(3, 6), 0.05, 0.02)):
        assert variance_is(bias[0, :, part] / start)
        assert variance_is(np.diff(bias[..., part], axis=0) / walk / math.sqrt(0.05))
    assert (np.diff(short.truth[..., 10:16].numpy(), axis=0) != 0).all()


# Other sensors --------------------------------------------------------------------------------------------------------


def test_barometer(short):
    s, y = short, short.measurements["barometer"].numpy()
    rows = heard(y, 2)
    height, lagged, offset = (s.truth[..., k].numpy() for k in (9, 16, 17))
    assert variance_is((y[rows, :, 0] - lagged[rows] - offset[rows]) / 0.15)
    assert variance_is(np.diff(offset, axis=0) / 0.05 / math.sqrt(0.05)) and variance_is(s.start[:, 17].numpy())
    # The lag: its integral equation by the trapezoidal rule, which is good to dt^2 / 12 of the slopes.
    gap = (height - lagged) / 0.5
    assert np.abs(np.cumsum((gap[1:] + gap[:-1]) * 0.025, 0) - (lagged[1:] - lagged[0])).max() < 1e-3
    assert np.abs(height - lagged).max() > 0.05 and torch.equal(s.start[:, 9], s.start[:, 16])


def test_ultrasonic(short):
    """Height of a tenth of a second before, within the cone, but for lost echoes; noise 1 cm and 0.5 %."""
    s, y = short, short.measurements["ultrasonic"].numpy()[..., 0]
    rows = heard(y, 2)
    path = torch.cat([s.start.unsqueeze(0), s.truth]).numpy()
    old = path[: len(y) - 1]  # end of step k - 2 for k from 1
    up = Rotation.from_quat(old[..., :4].reshape(-1, 4)).apply([0, 0, 1])[:, 2].reshape(old.shape[:2])
    assert np.arccos(up).max() < math.radians(15)
    reading, height = y[1:][rows[1:]], old[..., 9][rows[1:]]
    got = np.isfinite(reading)
    assert share_is(got.mean(), 0.95, got.size)
    assert variance_is(((reading - height) / (0.01 + 0.005 * height))[got])
    now = ((y[rows] - s.truth[..., 9].numpy()[rows]) / (0.01 + 0.005 * s.truth[..., 9].numpy()[rows]))[:-1]
    assert np.nanmean(now[50:] ** 2) > 1.02 * np.nanmean(((reading - height) / (0.01 + 0.005 * height))[50:] ** 2)


def test_tables_stand_between_sonar_and_floor(short):
    """Readings over a table are as much shorter; around mast and landing spot the floor is clear."""
    tall = make_scene(replace(SETTINGS, clutter_m=0.8))
    path = torch.cat([short.start.unsqueeze(0), short.truth]).numpy()[: len(short.truth) - 1]
    flat, low = (s.measurements["ultrasonic"].numpy()[1:, :, 0] for s in (short, tall))
    table = (np.floor(path[..., 7] / 4) + np.floor(path[..., 8] / 3)) % 2 == 0
    for spot in (scene.LANDING_M, scene.MAST_M[:2]):
        table &= np.hypot(path[..., 7] - spot[0], path[..., 8] - spot[1]) > 5
    both = np.isfinite(flat) & np.isfinite(low)
    assert (flat[both & ~table] == low[both & ~table]).all() and (both & table).sum() > 100
    # The noise is a share of the distance, so that it is less by up to 0.4 % of 0.8 m a deviation.
    np.testing.assert_allclose((flat - low)[both & table], 0.8, atol=0.005 * 0.8 * 6)


def test_late_sonar_is_silent_before_its_first_echo():
    settings = replace(
        SETTINGS, runs=2, anchored_s=1.0, cruise_s=0.0, approach_s=0.0, ultrasonic_hz=20, ultrasonic_dropout=0.0
    )
    for delay, first in ((0.0, 0), (0.05, 0), (0.1, 1), (0.5, 9)):
        y = make_scene(replace(settings, ultrasonic_delay_s=delay)).measurements["ultrasonic"]
        assert y[:first].isnan().all() and y[first:].isfinite().all()


@pytest.mark.parametrize("moment", [0.0, 300.0])
def test_magnetometer(moment):
    settings = replace(BRIEF, pillar_moment_a_m2=moment, magnetometer_hz=5, magnetometer_sd_ut=0.3, hard_iron_sd_ut=2.0)
    s = make_scene(settings)
    y = s.measurements["magnetometer"].numpy()
    rows = heard(y, 4)
    x = s.truth.numpy()[rows]
    down, east = math.radians(65), math.radians(3)
    earth = 48 * np.array([math.cos(down) * math.sin(east), math.cos(down) * math.cos(east), -math.sin(down)])
    ray = x[..., 7:10] - np.array(scene.PILLAR_M)
    length = np.linalg.norm(ray, axis=-1, keepdims=True)
    dipole = 1e-7 * (3 * ray * (ray[..., 2:] * moment) / length**5 - np.array([0, 0, moment]) / length**3) * 1e6
    field = (earth + dipole).reshape(-1, 3)
    seen = Rotation.from_quat(x[..., :4].reshape(-1, 4)).inv().apply(field).reshape(*x.shape[:2], 3)
    assert variance_is((y[rows] - seen - x[..., 18:21]) / 0.3)
    assert (x[0, :, 18:] == x[-1, :, 18:]).all() and 0.5 < x[0, :, 18:].std() < 4


def test_pillar_is_felt_nearby():
    near = torch.tensor([[21.5, 12.0, 2.0], [35.0, 5.0, 3.0], [20.0, 12.0, 2.0]], dtype=torch.float64)
    settings = AirshipSettings(pillar_moment_a_m2=300.0)
    change = scene.field_ut(settings, near) - scene.field_ut(AirshipSettings(), near)
    # Beside the dipole its field is opposite to it, 0.1 m / r^3; inside the steel it stays finite.
    np.testing.assert_allclose(change[0], [0, 0, -0.1 * 300 / 1.5**3], rtol=1e-12, atol=1e-12)
    assert change[1].norm() < 0.05 and change[2].isfinite().all()


def test_beacons(short):
    s, y = short, short.measurements["beacons"].numpy()
    rows = heard(y, 10)
    place = s.truth[..., 7:10].numpy()[rows]
    ranges = np.linalg.norm(place[..., None, :] - np.array(scene.BEACONS_M), axis=-1)
    got = np.isfinite(y[rows])
    assert share_is(got.mean(), 0.95, got.size) and variance_is(((y[rows] - ranges) / 0.03)[got])
    # Rank of the four directions: position is observable from one set of ranges, all over the hall.
    for point in ((2.0, 2.0, 1.0), (38.0, 18.0, 6.0), (20.0, 10.0, 0.7)):
        ray = np.array(scene.BEACONS_M) - point
        assert np.linalg.svd(ray / np.linalg.norm(ray, axis=1, keepdims=True))[1][-1] > 0.15


def test_only_beacons_see_a_shift_of_the_hall(short):
    """What the module says of observability: other readings are the same 3 m to the side."""
    truth = torch.cat([short.start.unsqueeze(0), short.truth])
    shifted = truth.clone()
    shifted[..., 7] += 3
    seeds = list(range(40, 40 + RUNS))
    here, there = (scene._measure(SETTINGS, seeds, x) for x in (truth, shifted))
    for name in here:
        same = torch.equal(here[name].nan_to_num(), there[name].nan_to_num())
        assert same == (name != "beacons")
        assert torch.equal(here[name].nan_to_num(), short.measurements[name].nan_to_num())


def test_dropouts_rates_and_noise_are_settings():
    settings = AirshipSettings(
        runs=6, anchored_s=2.0, cruise_s=6.0, approach_s=2.0, barometer_hz=20, barometer_sd_m=0.4, barometer_lag_s=0.2,
        barometer_offset_sd_m=0.0, barometer_walk_m_sqrt_s=0.0, ultrasonic_dropout=0.3, beacon_hz=20, beacon_sd_m=0.1,
        beacon_dropout=0.4,
    )  # fmt: skip
    s = make_scene(settings)
    y = {name: value.numpy() for name, value in s.measurements.items()}
    assert (s.truth[..., 17] == 0).all()
    assert variance_is((y["barometer"] - s.truth[..., 16:17].numpy()) / 0.4)
    assert share_is(np.isfinite(y["beacons"]).mean(), 0.6, y["beacons"].size)
    sonar = np.isfinite(y["ultrasonic"][heard(y["ultrasonic"], 2)])
    assert share_is(sonar.mean(), 0.7, sonar.size)
    ranges = np.linalg.norm(s.truth[..., None, 7:10].numpy() - np.array(scene.BEACONS_M), axis=-1)
    z = (y["beacons"] - ranges) / 0.1
    assert variance_is(z[np.isfinite(z)])


# Settings -------------------------------------------------------------------------------------------------------------


def test_runs_do_not_know_their_neighbours():
    """The third of four runs alone; rounding of other batch sizes grows by less than 1e-10 in this time."""
    settings = AirshipSettings(runs=4, seed=3, anchored_s=2.0, cruise_s=4.0, approach_s=2.0)
    many, alone = make_scene(settings), make_scene(replace(settings, runs=1, seed=5))
    torch.testing.assert_close(many.truth[:, 2:3], alone.truth, rtol=0, atol=1e-10)
    torch.testing.assert_close(many.controls[:, 2:3], alone.controls, rtol=0, atol=1e-10)
    for name, values in alone.measurements.items():
        torch.testing.assert_close(many.measurements[name][:, 2:3], values, rtol=0, atol=1e-9, equal_nan=True)
    again = make_scene(settings)
    assert torch.equal(many.truth, again.truth) and torch.equal(many.controls, again.controls)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"gust_sd_m_s": -0.1}, "gust_sd_m_s must be finite and not negative, got -0.1"),
        ({"cruise_s": math.nan}, "cruise_s must be finite and not negative, got nan"),
        ({"pillar_moment_a_m2": math.inf}, "pillar_moment_a_m2 must be finite, got inf"),
        ({"barometer_lag_s": 0.0}, "barometer_lag_s must be positive, got 0.0"),
        ({"beacon_dropout": 0.6}, "beacon_dropout must be from 0 to 0.5, got 0.6"),
        ({"ultrasonic_dropout": 0.7}, "ultrasonic_dropout must be from 0 to 0.5, got 0.7"),
        ({"beacon_hz": 3}, "beacon_hz must divide the filter's rate, 20, got 3"),
        ({"magnetometer_hz": 0}, "magnetometer_hz must divide the filter's rate, 20, got 0"),
        ({"ultrasonic_delay_s": 0.07}, r"ultrasonic_delay_s must be whole steps of 0\.05 s, got 0\.07"),
        ({"anchored_s": 0.0, "cruise_s": 0.0, "approach_s": 0.0}, "the durations must not all be zero"),
    ],
)
def test_settings_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        AirshipSettings(**change)


def test_settings_are_json():
    assert AirshipSettings(pillar_moment_a_m2=-200.0).steps == 4500
    plain = json.loads(json.dumps(AirshipSettings(runs=3).to_dict()))
    assert plain["runs"] == 3 and plain["imu"]["accel_bias_sd_m_s2"] == 0.05
    assert AirshipSettings(**{**plain, "imu": ImuGrade(**plain["imu"])}) == AirshipSettings(runs=3)
