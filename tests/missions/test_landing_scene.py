"""Scenes of the landing study: flights that agree with their sensors, what the camera sees, noise, scenarios."""

import json
import math

import numpy as np
import pytest
import torch
from oracles import landing_oracle as oracle
from scipy import stats
from scipy.spatial.transform import Rotation

from torchfilt.missions.landing import SCENARIOS, LandingSettings, make_scene, scene
from torchfilt.models.inertial.imu import ImuGrade
from torchfilt.models.landing import ROTOR_IMU, Barometer, Beacon, HeadingGauge

FIELD = np.tan(np.radians([30, 17.5]))
RUNS = 40


@pytest.fixture(scope="module", params=SCENARIOS)
def case(request):
    settings = LandingSettings(request.param, runs=RUNS, seed=100)
    return settings, make_scene(settings)


@pytest.fixture(scope="module")
def nominal():
    return make_scene(LandingSettings(runs=RUNS, seed=100))


def share_is(found, expected, count):
    """Within five standard errors of a share: one false alarm in 1.7 million."""
    return abs(float(found) - expected) < 5 * math.sqrt(expected * (1 - expected) / count)


def angles(truth):
    """Tangents to the pad (t, R, 2) and distance, by SciPy."""
    x = truth.numpy()
    ray = (
        Rotation.from_quat(x[..., :4].reshape(-1, 4)).inv().apply(-x[..., 7:10].reshape(-1, 3)).reshape(*x.shape[:2], 3)
    )
    return ray[..., :2] / -ray[..., 2:], np.linalg.norm(ray, axis=-1), ray[..., 2] < 0


def true_view(truth):
    tangents, distance, below = angles(truth)
    return (np.abs(tangents) <= FIELD).all(-1) & (distance <= 15) & below


# Flight ---------------------------------------------------------------------------------------------------------------


def test_shapes_and_flights(case):
    settings, s = case
    size = 17 if settings.scenario == "pad-height" else 16
    columns = 2 if settings.scenario == "no-barometer" else 3
    assert s.truth.shape == (880, RUNS, size) and s.controls.shape == (880, RUNS, 6)
    assert s.measurements.shape == (880, RUNS, columns) and s.acquired.shape == (RUNS,) and s.dt == 0.025
    assert s.truth.isfinite().all() and s.controls.isfinite().all()
    # At least 12 s are left, the flight stays off the ground and ends near the pad, 1 to 2 m up and nearly at rest.
    assert (880 - s.acquired).min() * s.dt >= 12
    assert s.truth[..., 9].min() > 0.5 and s.truth[-1, :, 7:9].abs().max() < 0.2
    assert ((s.truth[-1, :, 9] > 1) & (s.truth[-1, :, 9] < 2)).all() and s.truth[-1, :, 4:7].abs().max() < 0.3


@pytest.mark.parametrize("scenario", ["nominal", "pad-height"])
@pytest.mark.parametrize("biased", [False, True])
def test_increments_without_noise_give_the_truth(scenario, biased, monkeypatch):
    """Rounding without biases; with them 1e-6 rms and 1e-5 at most, as the motion takes them out to second order."""
    gyro, accel = (ROTOR_IMU.gyro_bias_sd_rad_s, ROTOR_IMU.accel_bias_sd_m_s2) if biased else (0.0, 0.0)
    monkeypatch.setattr(scene, "ROTOR_IMU", ImuGrade(gyro, 0.0, accel, 0.0))
    s = make_scene(LandingSettings(scenario, runs=8))
    law = s.world_model.transition(s.truth[:-1], s.controls[1:], s.dt)
    pairs = zip(s.truth[1:].flatten(0, 1).numpy(), law.mean.flatten(0, 1).numpy(), strict=True)
    away = np.stack([oracle.local(x, y) for x, y in list(pairs)[::7]])
    assert np.abs(away).max() < (1e-5 if biased else 1e-12)
    assert np.sqrt(np.mean(away**2, 0)).max() < 1e-6
    assert (s.truth[0, :, 10:16] != 0).all() == biased and torch.equal(s.truth[0, :, 10:], s.truth[-1, :, 10:])


def test_noise_of_the_increments(nominal):
    """White, of the stated density, position's share half a step of velocity's; variances to five standard errors."""
    s = nominal
    law = s.world_model.conditional("transition", s.truth[:-1], s.controls[1:], s.dt)
    away = law.space.local(law.mean, s.truth[1:])
    for part, density in ((slice(0, 3), math.radians(0.02)), (slice(3, 6), 0.010)):
        z = away[..., part] / (density * math.sqrt(0.025))
        assert abs(float(z.square().mean()) - 1) < 5 * math.sqrt(2 / z.numel())
        assert abs(float((z[1:] * z[:-1]).mean())) < 5 / math.sqrt(z.numel())
    assert (away[..., 6:9] - away[..., 3:6] * 0.0125).abs().max() < 1e-6


def test_thrust_is_along_body_z(nominal):
    """Acceleration plus weight, by differences of the velocity over two steps, against the third body axis."""
    x = nominal.truth.numpy()
    force = (x[2:, :, 4:7] - x[:-2, :, 4:7]) / 0.05 - oracle.GRAVITY
    force /= np.linalg.norm(force, axis=-1, keepdims=True)
    axis = Rotation.from_quat(x[1:-1, :, :4].reshape(-1, 4)).apply([0, 0, 1]).reshape(force.shape)
    assert np.linalg.norm(force - axis, axis=-1).max() < 5e-3


@pytest.mark.parametrize(("scenario", "speed", "tilt"), [("nominal", 2.0, 3.0), ("wide-start", 4.0, 10.0)])
def test_start_is_drawn_from_the_prior(scenario, speed, tilt):
    """Draws that can't reach the pad are left out; what has no part in that has the prior's law: p above 1e-4."""
    settings = LandingSettings(scenario, runs=400)
    start = scene._draw_start(settings, list(range(400)))
    assert torch.linalg.vector_norm(start.position[:, :2], dim=-1).max() <= 35
    assert start.position[:, 2].min() >= 5 and start.position[:, 2].max() <= 20
    assert stats.kstest(start.yaw.numpy(), stats.uniform(-math.pi, 2 * math.pi).cdf).pvalue > 1e-4
    assert stats.kstest(start.velocity[:, :2].flatten().numpy() / speed, "norm").pvalue > 1e-4
    lean = np.arctan(np.linalg.norm(start.acceleration.numpy(), axis=-1) / 9.80665)
    assert stats.kstest(lean / np.radians(tilt), stats.rayleigh.cdf).pvalue > 1e-4
    assert not start.acceleration[:, 2].abs().max() > 1e-12
    for part, sd in ((slice(0, 3), math.radians(0.05)), (slice(3, 6), 0.03)):
        assert stats.kstest(start.rest[:, part].flatten().numpy() / sd, "norm").pvalue > 1e-4


# Sensors --------------------------------------------------------------------------------------------------------------


def test_field_of_view_dropout_and_outliers(nominal):
    s = nominal
    seen = s.measurements[..., 1].isfinite().numpy()
    view = true_view(s.truth)
    assert not (seen & ~view).any() and 0.3 < view.mean() < 0.95
    assert share_is(seen[view].mean(), 0.9, view.sum())
    sight = s.measurements[..., 1:].numpy()
    assert np.array_equal(np.isnan(sight[..., 0]), np.isnan(sight[..., 1]))
    z = (sight - angles(s.truth)[0])[seen] / math.radians(0.4)
    far = np.abs(z).max(-1) > 6
    # Of the outliers those within 6 deviations of the truth pass for sights: at most this share of the picture.
    mistaken = (12 * math.radians(0.4)) ** 2 / (4 * FIELD.prod())
    assert 0.02 * (1 - mistaken) - 5 * math.sqrt(0.02 / len(far)) < far.mean() < 0.02 + 5 * math.sqrt(0.02 / len(far))
    assert (np.abs(sight[seen][far]) <= FIELD).all()
    for axis in range(2):
        anywhere = sight[seen][far][:, axis] / FIELD[axis]
        assert abs(np.mean(anywhere**2) - 1 / 3) < 5 * math.sqrt(4 / 45 / far.sum()) + mistaken
    # Cheap bound on what the outliers in disguise add to the variance: 36 times their share.
    assert abs(np.mean(z[~far] ** 2) - 1) < 5 * math.sqrt(1 / (~far).sum()) + 36 * 0.02 * mistaken


def test_dropout_and_outlier_share_are_settings():
    s = make_scene(LandingSettings(runs=5, dropout=0.0, outlier_share=0.0, duration_s=12.0))
    assert len(s.truth) == 480
    seen = s.measurements[..., 1].isfinite().numpy()
    assert np.array_equal(seen, true_view(s.truth)) and np.array_equal(s.acquired, seen.argmax(0))
    z = (s.measurements[..., 1:].numpy() - angles(s.truth)[0])[seen] / math.radians(0.4)
    assert np.abs(z).max() < 6  # false alarm 2e-9 each


def test_barometer(case):
    settings, s = case
    if settings.scenario == "no-barometer":
        assert s.model.observation.names == ("beacon",)
        return
    assert s.model.observation.names == ("barometer", "beacon")
    height = s.truth[..., 9] + (s.truth[..., 16] if settings.scenario == "pad-height" else 0)
    z = (s.measurements[..., 0] - height) / 0.4
    assert (
        abs(float(z.square().mean()) - 1) < 5 * math.sqrt(2 / z.numel()) and abs(float(z.mean())) < 5 / z.numel() ** 0.5
    )
    if settings.scenario == "pad-height":
        offset = s.truth[0, :, 16] / 5
        assert abs(float(offset.square().mean()) - 1) < 5 * math.sqrt(2 / RUNS)


def test_acquired_is_the_first_true_sight(case):
    settings, s = case
    first = settings.scenario == "false-source"
    z = (s.measurements[..., -2:].numpy() - angles(s.truth)[0]) / math.radians(0.4)
    true = np.isfinite(z[..., 0]) & (np.abs(np.nan_to_num(z, nan=99)).max(-1) < 6)
    assert np.array_equal(true.argmax(0), s.acquired.numpy())
    assert not first or s.acquired.min() >= 80


def test_false_source():
    """One second, some metres off, the same place all along, before the beacon is seen; nothing in between."""
    s = make_scene(LandingSettings("false-source", runs=RUNS, outlier_share=0.0))
    x, sight = s.truth.numpy(), s.measurements[..., 1:].numpy()
    for k, acquired in enumerate(s.acquired.tolist()):
        steps = np.flatnonzero(np.isfinite(sight[:acquired, k, 0]))
        assert acquired - 60 <= steps.min() and steps.max() < acquired - 20 and 5 < len(steps) <= 40
        # Where each picture puts the source on the ground, given the true state.
        ray = Rotation.from_quat(x[steps, k, :4]).apply(np.append(sight[steps, k], -np.ones((len(steps), 1)), 1))
        ground = x[steps, k, 7:10] - ray * (x[steps, k, 9:10] / ray[:, 2:])
        middle = np.median(ground, 0)
        assert np.hypot(*middle[:2]) > 3.5
        assert np.median(np.abs(ground - middle)) < 0.02 * x[steps[0], k, 9]


def test_models(case):
    settings, s = case
    assert isinstance(s.model.gauge, HeadingGauge) and s.world_model.gauge is None
    assert s.model.prior().mean.shape == s.truth.shape[2:]
    prior, degree = s.world_model.prior(), math.radians(1)
    wide = settings.scenario == "wide-start"
    tilt, speed = (10 * degree, 4.0) if wide else (3 * degree, 2.0)
    np.testing.assert_allclose(prior.scale_tril[[0, 3, 6, 8]], [tilt, speed, 15, 5])
    assert prior.mean[9] == 12
    laws = s.model.observation
    assert isinstance(laws.law("beacon"), Beacon)
    assert settings.scenario == "no-barometer" or isinstance(laws.law("barometer"), Barometer)


# Seeds and refusals ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_each_run_depends_on_its_own_seed_alone(scenario):
    many = make_scene(LandingSettings(scenario, runs=3, seed=7))
    one = make_scene(LandingSettings(scenario, runs=1, seed=8))
    for part in ("truth", "measurements", "controls"):
        torch.testing.assert_close(
            getattr(many, part)[:, 1:2], getattr(one, part), rtol=1e-12, atol=1e-12, equal_nan=True
        )
        assert not torch.equal(getattr(many, part)[:, 0], getattr(many, part)[:, 1])
    assert many.acquired[1] == one.acquired[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "night"}, "scenario must be one of nominal, false-source, .* got 'night'"),
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"duration_s": 10.0}, "duration_s must be from 11, .* to 60, got 10.0"),
        ({"duration_s": math.nan}, "duration_s must be from 11"),
        ({"dropout": -0.1}, "dropout must be from 0 to 0.5, got -0.1"),
        ({"outlier_share": 0.6}, "outlier_share must be from 0 to 0.5, got 0.6"),
    ],
)
def test_bad_settings_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        LandingSettings(**arguments)


def test_settings_are_ready_for_json():
    settings = LandingSettings("pad-height", runs=3)
    assert LandingSettings(**json.loads(json.dumps(settings.to_dict()))) == settings
