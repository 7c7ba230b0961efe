"""Attitude filters on the motion-capture trial: references, groups, errors, convergence, targets and a witness."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfilt.io.imu_mag_mocap import read_imu_mag_mocap
from torchfilt.missions.attitude.imu_mag import (
    ImuMagSettings,
    attitude_errors,
    field_delay,
    initial_errors,
    make_filter,
    make_motion,
    run_imu_mag,
    summarize,
)

DATA = Path(__file__).parents[2] / "data" / "imu_mag_mocap"
SHORT = ImuMagSettings(str(DATA), angles_deg=(0.0, 180.0), stop_s=8.0, particles=12)


@pytest.fixture(scope="module")
def log():
    return read_imu_mag_mocap(DATA)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"accel_sd_m_s2": 0.0}, "accel_sd_m_s2 must be positive and finite, got 0.0"),
        ({"group": 0}, "group must be positive and finite, got 0"),
        ({"stop_s": math.nan}, "stop_s must be positive and finite, got nan"),
        ({"angles_deg": ()}, "angles_deg must be from 0 to 180"),
        ({"angles_deg": (190.0,)}, "angles_deg must be from 0 to 180"),
    ],
)
def test_settings_are_checked(change, rule):
    with pytest.raises(ValueError, match=rule):
        ImuMagSettings(**change)


def test_a_stop_before_the_first_step_is_refused(log):
    with pytest.raises(ValueError, match=r"a step of 10 rows from 4\.80 s, when .* to 4\.00 s"):
        make_motion(log, ImuMagSettings(stop_s=4.0))


def test_an_unknown_filter_is_refused(log, tmp_path):
    with pytest.raises(ValueError, match="filters must be out of mekf, ukf, llpf, got ekf"):
        make_filter("ekf", make_motion(log, SHORT), SHORT)
    with pytest.raises(ValueError, match="filters must be out of mekf, ukf, llpf, got none"):
        run_imu_mag(SHORT, tmp_path, ())


def test_errors_are_the_parts_of_a_turn_about_the_vertical_and_a_tilt():
    tilt = Rotation.from_rotvec([0.3, -0.4, 0.0])
    turn = Rotation.from_rotvec([0.0, 0.0, -0.7])
    truth = Rotation.random(5, random_state=3)
    estimate = turn * tilt * truth
    errors, signed = attitude_errors(torch.from_numpy(estimate.as_quat()), torch.from_numpy(-truth.as_quat()))
    total = (estimate * truth.inv()).magnitude()
    # Square roots of sums of rounded squares: some units in the last place, in degrees.
    expected = np.rad2deg(np.stack([total, np.full(5, 0.7), np.full(5, 0.5)], -1))
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    np.testing.assert_allclose(signed, -0.7, atol=1e-14)


def test_steps_carry_the_samples_turns_and_block_means(log):
    settings = ImuMagSettings(group=4, block=3)
    motion = make_motion(log, settings)
    first = int(torch.isfinite(log.quaternion[:, 0]).nonzero()[0])
    row_s = log.times_s[1].item()
    k = 3 * 800 + 2  # the last step of a block, in movement
    begin = first + 1 + 4 * (k - 2)
    turns = [Rotation.from_rotvec(g * row_s) for g in log.gyro_rad_s[begin : begin + 12].numpy()]
    step = turns[8] * turns[9] * turns[10] * turns[11]
    np.testing.assert_allclose(motion.rate_rad_s[k] * motion.step_s, step.as_rotvec(), atol=1e-13)
    ahead, forces = Rotation.identity(), []
    for i in reversed(range(12)):
        forces.append(ahead.inv().apply(log.accel_m_s2[begin + i].numpy()))
        ahead = turns[i] * ahead
    np.testing.assert_allclose(motion.measurements[k, :3], np.mean(forces, 0), atol=1e-11)
    assert motion.measurements[k - 2 : k, :6].isnan().all()
    torch.testing.assert_close(motion.truth[k], log.quaternion[begin + 11], equal_nan=True)


def test_references_and_rest_are_those_of_the_standstill(log):
    motion = make_motion(log, ImuMagSettings())
    resting = motion.measurements[:, 6].isfinite()
    assert resting[: int(25 / motion.step_s)].float().mean() > 0.9
    assert not resting[motion.scored].float().mean() > 0.01
    rest = motion.measurements[resting, 6:].mean(0)
    # What the data's description says of the gyro's offset.
    torch.testing.assert_close(rest, rest.new_tensor([0.0032, 0.0021, -0.0039]), atol=2e-4, rtol=0)
    assert motion.gravity[2].item() == pytest.approx(9.822, abs=2e-3)
    assert motion.field.norm().item() == pytest.approx(44.3, abs=1.5)


def test_initial_errors_stand_in_the_prior(log):
    settings = ImuMagSettings(angles_deg=(0.0, 30.0, 180.0))
    names, errors = initial_errors(settings)
    assert names == ["0", "30 up", "30 east", "30 oblique", "180 up", "180 east", "180 oblique"]
    motion = make_motion(log, settings)
    state = make_filter("ukf", motion, settings).init((7,))
    found, _ = attitude_errors(state.belief.mean[:, :4], motion.start.expand(7, 4))
    np.testing.assert_allclose(found[:, 0], errors.norm(dim=-1).rad2deg(), atol=1e-5)


def test_the_magnetometer_lags_and_a_longer_lag_is_found_as_such(log):
    """Four rows, 14 ms, is what the cameras say too: their attitude fits the field best 4 to 5 rows on."""
    assert field_delay(log) == 4
    late = log._replace(mag_t=torch.cat([log.mag_t[:1].expand(3, 3), log.mag_t[:-3]]))
    assert field_delay(late) == 7
    assert field_delay(log._replace(movement=torch.zeros_like(log.movement))) == 0


def test_a_bank_settles_from_half_a_turn_and_a_second_run_reads_its_stages(tmp_path):
    lines = []
    summary = run_imu_mag(SHORT, tmp_path, ("mekf", "llpf"), say=lines.append)
    found = {name: summary["filters"][name]["rows"] for name in ("mekf", "llpf")}
    assert found["mekf"]["0"]["converged_s"] == 0
    # One point of expansion half a turn off is a saddle, and its claim shrinks all the same: it takes minutes.
    assert found["mekf"]["180 up"]["converged_s"] is None
    for row in found["llpf"].values():
        assert row["converged_s"] < 2
        assert row["rms_deg"] is None
    assert json.loads((tmp_path / "metrics.json").read_text())["filters"] == summary["filters"]
    assert {path.name for path in (tmp_path / "figures").iterdir()} >= {"errors.png", "bias.png"}
    again = run_imu_mag(SHORT, tmp_path, ("mekf",), say=lines.append, figures=False, progress=True)
    assert again["filters"]["mekf"] == summary["filters"]["mekf"] and "mekf: as before" in lines


@pytest.mark.slow
def test_the_bank_reaches_the_target_from_every_start(tmp_path):
    """Total error below 3 deg over the movement. Inclination stays at 1.9 deg, 1.6 with the cameras a row later."""
    settings = ImuMagSettings(str(DATA), angles_deg=(90.0, 180.0))
    summary = run_imu_mag(settings, tmp_path, ("llpf",), say=lambda line: None, figures=False)
    for row in summary["filters"]["llpf"]["rows"].values():
        assert row["converged_s"] < 2
        assert row["rms_deg"]["total"] < 3
        assert row["rms_deg"]["inclination"] < 2.1


def test_a_row_that_never_settles_says_so(log):
    motion = make_motion(log, SHORT)
    count = len(motion.time_s)
    result = {
        "time_s": motion.time_s.numpy(),
        "scored": np.zeros(count, bool),
        "error_deg": np.full((count, 4, 3), 20.0),
        "cpu_s": np.array(1.0),
    }
    assert summarize(result, motion, SHORT)["rows"]["180 east"]["converged_s"] is None
