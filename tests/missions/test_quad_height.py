"""Height on the multirotor's log: the law, the upright force, the withheld range finder, and the numbers reported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import run_height as run_height_script
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from scipy.stats import f as fisher

from torchfilt.io.quad_baro_range import Attitude, Fixes, QuadBaroRange, read_quad_baro_range
from torchfilt.missions.quad_height import (
    FILTERS,
    HeightSettings,
    VerticalMotion,
    follow,
    make_filter,
    make_flight,
    run_height,
    summarize,
    upright,
)

ROOT = Path(__file__).parents[2]
DATA = ROOT / "data" / "quad_baro_range"
# A piece of the log: 25 s with gaps of 2 and 4 s.
SHORT = HeightSettings(str(DATA), stop_s=25.0, settle_s=8.0, split_s=15.0, gaps_s=(2.0, 4.0), phases=2)


@pytest.fixture(scope="module")
def log():
    return read_quad_baro_range(DATA)


@pytest.fixture(scope="module")
def short(log):
    return make_flight(log, SHORT)


# Law


@pytest.mark.parametrize("dt", [0.05, 0.8])
def test_the_law_is_the_exact_step_of_its_differential_equation(dt):
    """Van Loan's integral of the continuous system, with the noise of the force as a density."""
    bias_walk, offset_walk, wander_sd, wander_time, density = 0.02, 0.3, 0.7, 1.5, 0.2
    drift = np.zeros((5, 5))
    drift[0, 1], drift[1, 2], drift[4, 4] = 1, -1, -1 / wander_time
    power = np.diag([0, density**2, bias_walk**2, offset_walk**2, 2 * wander_sd**2 / wander_time])
    # Without the bias's own noise in velocity and height, which the law leaves to the next step: see below.
    power[2, 2] = 0
    whole = expm(np.block([[-drift, power], [np.zeros((5, 5)), drift.T]]) * dt)
    matrix = whole[5:, 5:].T
    noise = matrix @ whole[:5, 5:]
    noise[2, 2] = bias_walk**2 * dt
    law = VerticalMotion(bias_walk, offset_walk, wander_sd, wander_time)
    control = torch.tensor([0.3, density * dt**0.5], dtype=torch.float64)
    found = law.linear_form(control, dt)
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-14)
    np.testing.assert_allclose(found.scale_tril @ found.scale_tril.mT, noise, rtol=1e-12, atol=1e-15)
    # A constant force moves height by half of what it adds to velocity, times dt.
    np.testing.assert_allclose(found.offset, [0.3 * dt / 2, 0.3, 0, 0, 0], rtol=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_law_in_batches_equals_single_steps(dtype):
    torch.manual_seed(0)
    law = VerticalMotion(0.02, 0.3, 0.7, 1.5)
    x, u, dt = (torch.rand(*shape, dtype=dtype) for shape in ((4, 3, 5), (4, 3, 2), (4, 3, 1)))
    many = law(x, u, dt)
    assert many.mean.dtype == many.scale_tril.dtype == dtype
    for i in range(4):
        for j in range(3):
            one = law(x[i, j], u[i, j], dt[i, j].item())
            torch.testing.assert_close(many.mean[i, j], one.mean)
            torch.testing.assert_close(many.scale_tril[i, j], one.scale_tril)


def test_the_law_refuses_what_it_cannot_use():
    for scales in ((-1.0, 0.1, 0.1, 1.0), (0.1, 0.1, float("nan"), 1.0), (0.1, 0.1, 0.1, 0.0)):
        with pytest.raises(ValueError, match="walks and deviations must be zero or more and the time positive"):
            VerticalMotion(*scales)
    law, x = VerticalMotion(0.1, 0.1, 0.1, 1.0), torch.zeros(5)
    with pytest.raises(ValueError, match=r"needs a control u \(\.\.\., 2\), got none"):
        law(x, None, 0.1)
    with pytest.raises(ValueError, match=r"needs a control u \(\.\.\., 2\), got \(3,\)"):
        law(x, torch.zeros(3), 0.1)
    with pytest.raises(ValueError, match="needs the time step dt"):
        law(x, torch.zeros(2))


# Flight


def lean_at(time, most_rad):
    """Level for 2 s, so that the filter's start is right, then to and fro."""
    return most_rad * np.sin(0.4 * np.clip(time - 2, 0, None))


def made_log(seconds=40.0, lean_rad=0.15):
    """A body that leans, turns about the vertical and goes up and down: known attitude, force and height."""
    rate_hz, turn_rad_s, swing = 50.0, 0.6, 2 * np.pi / 7
    time = np.arange(0, seconds, 1 / rate_hz)

    def attitude(at):
        leaning = lean_at(at, lean_rad)
        return Rotation.from_euler("z", turn_rad_s * at[:, None]) * Rotation.from_euler("x", leaning[:, None])

    turned = attitude(time)
    step = (turned[:-1].inv() * turned[1:]).as_rotvec() * rate_hz
    middle = (time[1:] + time[:-1]) / 2
    up = 9.80665 + 0.8 * swing**2 * np.cos(swing * middle)
    force = attitude(middle).inv().apply(np.stack([0 * up, 0 * up, up], -1))
    stamp = torch.from_numpy(time)
    gyro, accel = (torch.from_numpy(np.concatenate([v[:1], v])) for v in (step, force))
    slow = torch.arange(0.0, seconds - 0.5, 0.1, dtype=torch.float64)
    height = 2 - 0.8 * torch.cos(swing * slow)
    tilt = torch.from_numpy(np.cos(lean_at(slow.numpy(), lean_rad)))
    nothing = torch.zeros_like(slow)
    return QuadBaroRange(
        stamp,
        gyro,
        accel,
        torch.zeros(0, dtype=torch.int64),
        slow + 0.35,
        height + 1.5,
        slow + 0.24,
        height / tilt,
        slow,
        torch.zeros(len(slow), 3, dtype=torch.float64),
        Fixes(slow, nothing, nothing, nothing, nothing, nothing, height),
        Attitude(slow, nothing, nothing, nothing),
    )


# Errors of the sampling at 50 Hz: a lean of 0.06 rad/s is held for half a sample; heights up to 2.8 m are seen along
# it; a jerk of 0.8 m (2 pi / 7 s)^3 is held over the halves of a sample at both ends of a step.
LEAN_ERROR_RAD = 0.15 * 0.4 * 0.01
RANGE_ERROR_M = 2.8 * np.tan(0.15) * LEAN_ERROR_RAD
PUSH_ERROR_M_S = 0.8 * (2 * np.pi / 7) ** 3 * 0.02**2 / 4 + 9.81 * 0.25 * LEAN_ERROR_RAD**2
MADE = HeightSettings(stop_s=38.0, settle_s=5.0, gaps_s=(4.0,), up_sd_m_s2=30.0)


def test_forces_are_turned_upright():
    log = made_log()
    edges = torch.arange(0.0, 38.0, 0.25, dtype=torch.float64)
    quaternion, push = upright(log, edges, MADE)
    at = edges[1:].numpy()
    lean = lean_at(at, 0.15)
    seen = Rotation.from_quat(quaternion.numpy()).apply([0.0, 0, 1], inverse=True)
    # Specific force leans with nothing here, so that tilt has no other error.
    np.testing.assert_allclose(seen, np.stack([0 * lean, np.sin(lean), np.cos(lean)], -1), atol=LEAN_ERROR_RAD)
    swing = 2 * np.pi / 7
    expected = np.diff(0.8 * swing * np.sin(swing * edges.numpy()))
    np.testing.assert_allclose(push, expected, atol=PUSH_ERROR_M_S)


def test_delays_are_taken_back_and_range_is_seen_from_the_tilt():
    flight = make_flight(made_log(), MADE)
    heard = flight.range_height_m.isfinite()
    true = 2 - 0.8 * torch.cos(2 * torch.pi / 7 * flight.time_s)
    torch.testing.assert_close(flight.range_height_m[heard], true[heard], atol=RANGE_ERROR_M, rtol=0)
    torch.testing.assert_close(
        flight.baro_m[flight.baro_m.isfinite()], true[flight.baro_m.isfinite()] + 1.5, atol=1e-6, rtol=0
    )
    late = make_flight(made_log(), replace(MADE, range_delay_s=0.0, baro_delay_s=0.0))
    heard = late.range_height_m.isfinite()
    true = 2 - 0.8 * torch.cos(2 * torch.pi / 7 * late.time_s)
    # The chord of 0.24 s; the lean that it is seen along is late as well, by 0.06 rad/s.
    chord, lean = 1.6 * np.sin(2 * np.pi / 7 * 0.12), 2.8 * np.tan(0.15) * 0.06 * 0.24
    assert (late.range_height_m - true)[heard].abs().max().item() == pytest.approx(chord, abs=lean)


@pytest.mark.parametrize("name", FILTERS)
def test_a_made_flight_is_followed_through_gaps(name):
    """No noise at all: what is left is the sampling of force and tilt at 50 Hz.

    In a gap of 4 s the errors of 16 pushes add up, of which each acts for half of it in the mean; the speed at its
    start is wrong by how fast the lean's error comes and goes, 0.4 / s, the height by the range's.
    """
    flight = make_flight(made_log(), MADE)
    summary = summarize(follow(name, flight, MADE), flight, MADE)
    most = 4 * 16 * PUSH_ERROR_M_S / 2 + 4 * 0.4 * RANGE_ERROR_M + RANGE_ERROR_M
    assert summary["gaps"]["4"]["rms_m"] < most
    assert summary["used"]["to_onboard"]["rms_m"] < RANGE_ERROR_M
    if name != "inertial":
        assert summary["withheld"]["rms_m"] < most  # the barometer keeps it so for the rest
        assert summary["drift_m"] == pytest.approx([1.5, 1.5], abs=RANGE_ERROR_M)


def test_gaps_of_the_range_finder_and_of_the_inertial_sensors(log, short):
    stamp = short.time_s
    assert short.withheld.shape[1] == 2 + 2 * 2 and not short.withheld[:, 0].any()
    assert torch.equal(short.withheld[:, 1], stamp > SHORT.settle_s)
    seen = set()
    for row, first, last, gap_s in short.ends:
        assert short.withheld[first : last + 1, row].all() and not short.withheld[first - 1, row]
        assert last + 1 == len(stamp) or not short.withheld[last + 1, row]
        # Steps are no longer than 0.11 s.
        assert stamp[last] - stamp[first] == pytest.approx(gap_s, abs=0.15)
        seen.add((row, gap_s))
    assert seen == {(2, 2.0), (3, 2.0), (4, 4.0), (5, 4.0)}
    noise = short.control[:, 1] / short.dt_s.sqrt()
    torch.testing.assert_close(noise, torch.full_like(noise, SHORT.force_noise_m_s2_sqrt_hz))
    # A force that was held for 0.5 s is known the less well.
    marked = log._replace(gaps=torch.tensor([200]))
    held = make_flight(marked, SHORT)
    more = (held.control[:, 1].square() - short.control[:, 1].square()).clamp(min=0).sqrt()
    gap_s = (log.imu_time_s[200] - log.imu_time_s[199]).item()
    assert more.sum().item() == pytest.approx(SHORT.hold_sd_m_s2 * gap_s, rel=1e-6)


def test_tilt_is_near_that_of_another_filter(log, short):
    """Nearer to it than gravity's direction by the force of the moment, which each push leans, and than no tilt."""
    roll, pitch = (
        np.interp(short.time_s, log.onboard.time_s, values) for values in (log.onboard.roll_rad, log.onboard.pitch_rad)
    )
    theirs = np.stack([-np.sin(roll) * np.cos(pitch), np.sin(pitch), np.cos(roll) * np.cos(pitch)], -1)
    ours = Rotation.from_quat(short.quaternion.numpy()).apply([0.0, 0, 1], inverse=True)
    force = np.stack([np.interp(short.time_s, log.imu_time_s, axis) for axis in log.accel_m_s2.T], -1)
    force /= np.linalg.norm(force, axis=-1, keepdims=True)
    off, *others = (np.arccos(np.clip((up * theirs).sum(-1), -1, 1)) for up in (ours, force, np.array([[0.0, 0, 1]])))
    for other in others:
        assert np.median(off) < np.median(other) and off.max() < other.max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range_sd_m": 0.0}, "range_sd_m must be positive and finite, got 0.0"),
        ({"phases": 0}, "phases must be positive and finite, got 0"),
        ({"baro_delay_s": -0.1}, "baro_delay_s must be zero or more and finite, got -0.1"),
        ({"range_delay_s": float("inf")}, "range_delay_s must be zero or more and finite, got inf"),
        ({"gaps_s": ()}, r"gaps_s must be at least 1.0 s and finite, got \(\)"),
        ({"gaps_s": (0.5,)}, r"gaps_s must be at least 1.0 s and finite, got \(0.5,\)"),
        ({"stop_s": 70.0}, r"a gap of 60.0 s has no room in 50 s, settle_s taken off"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        HeightSettings(**change)


def test_a_part_outside_the_log_and_unknown_filters_are_refused(log, short, tmp_path):
    with pytest.raises(ValueError, match=r"stop_s must be within the log, 848.921 s, got 900"):
        make_flight(log, HeightSettings(stop_s=900.0))
    with pytest.raises(ValueError, match="filters"):
        make_filter("ekf", short, SHORT)
    with pytest.raises(ValueError, match="filters"):
        run_height(SHORT, tmp_path, ("ekf",))


# Filters and study


@pytest.mark.parametrize("name", ["fixed", "wander"])
def test_the_filter_equals_a_plain_one(short, name):
    """The textbook recursion in NumPy, both for the row with the range finder and for one with gaps."""
    found = follow(name, short, SHORT)
    walk, wander_sd, baro_sd = {
        "fixed": (0.0, 0.0, SHORT.fixed_baro_sd_m),
        "wander": (SHORT.slow_walk_m_sqrt_s, SHORT.wander_sd_m, SHORT.baro_sd_m),
    }[name]
    for row in (0, 4):
        height = np.where(short.withheld[:, row], np.nan, short.range_height_m)
        first = short.range_height_m[short.range_height_m.isfinite()][0].item()
        offset = short.baro_m[short.baro_m.isfinite()][0].item() - first
        mean = np.array([first, 0, 0, offset, 0])
        covariance = np.diag(np.square([0.02, 0.3, 0.3, 0.3, wander_sd]))
        for k, (dt, (push, noise)) in enumerate(zip(short.dt_s.tolist(), short.control.tolist(), strict=True)):
            kept = np.exp(-dt / SHORT.wander_time_s)
            matrix = np.diag([1, 1, 1, 1, kept])
            matrix[0, 1], matrix[0, 2], matrix[1, 2] = dt, -(dt**2) / 2, -dt
            mean = matrix @ mean + [push * dt / 2, push, 0, 0, 0]
            covariance = matrix @ covariance @ matrix.T
            covariance[:2, :2] += noise**2 * np.array([[dt**2 / 3, dt / 2], [dt / 2, 1]])
            bias = SHORT.force_bias_walk_m_s3_sqrt_hz**2 * dt
            covariance[2:, 2:] += np.diag([bias, walk**2 * dt, wander_sd**2 * (1 - kept**2)])
            for value, design, sd in (
                (height[k], np.array([1.0, 0, 0, 0, 0]), SHORT.range_sd_m),
                (short.baro_m[k].item(), np.array([1.0, 0, 0, 1, 1]), baro_sd),
            ):
                if np.isfinite(value):
                    gain = covariance @ design / (design @ covariance @ design + sd**2)
                    mean = mean + gain * (value - design @ mean)
                    covariance = covariance - np.outer(gain, design @ covariance)
            # Subtracted covariances lose digits by (0.4 m / 1 cm)^2; some hundred steps.
            np.testing.assert_allclose(found["mean"][k, row], mean, atol=1e-9)
            claimed = np.sqrt(np.diag(covariance).clip(0))
            np.testing.assert_allclose(found["deviation"][k, row], claimed, rtol=1e-6, atol=1e-9)


def test_numbers_are_those_of_the_definition(short):
    """Estimates that are off by a known amount, and a claim of half of it."""
    steps, rows = short.withheld.shape
    height = np.interp(
        short.time_s, *(v[short.range_height_m.isfinite()] for v in (short.time_s, short.range_height_m))
    )
    mean = np.zeros((steps, rows, 5))
    mean[..., 0] = height[:, None]
    mean[:, 1, 0] -= 2.0
    mean[:, 2:4, 0] += 3.0
    mean[:, 4:, 0] -= 4.0
    mean[:, 0, 1] = short.witness[:, 1].numpy() + np.where(short.time_s.numpy() > SHORT.split_s, 0.25, -0.5)
    mean[:, 0, 3], mean[:, 0, 4] = np.linspace(0, 1, steps), 0.5
    settled = short.time_s.numpy() > SHORT.settle_s
    deviation = np.full((steps, rows, 5), (1.5**2 - SHORT.range_sd_m**2) ** 0.5)
    result = {
        "mean": mean,
        "deviation": deviation,
        "range_nis": np.where(settled, 1.25, 9.0),
        "baro_nis": np.full(steps, np.nan),
        "log_likelihood": np.array(-7.0),
        "cpu_s": np.array(0.5),
    }
    found = summarize(result, short, SHORT)
    assert found["used"]["range_nis"] == 1.25 and found["used"]["baro_nis"] is None
    assert found["used"]["velocity_bias_m_s"] == pytest.approx([-0.5, 0.25])
    assert found["used"]["velocity_sd_m_s"] == pytest.approx([0, 0], abs=1e-9)
    assert found["drift_m"] == pytest.approx([0.5 + np.linspace(0, 1, steps)[settled][0], 1.5])
    off = (height - short.witness[:, 0].numpy())[settled]
    assert found["used"]["to_onboard"]["rms_m"] == pytest.approx(np.sqrt((off**2).mean()))
    assert found["used"]["to_onboard"]["p90_m"] == pytest.approx(np.quantile(np.abs(off), 0.9))
    assert "nees" not in found["used"]["to_onboard"]
    assert found["withheld"]["median_m"] == pytest.approx(2) and found["withheld"]["nees"] == pytest.approx(
        (2 / 1.5) ** 2
    )
    for gap, size in (("2", 3.0), ("4", 4.0)):
        part = found["gaps"][gap]
        assert part["count"] == sum(end[3] == float(gap) for end in short.ends)
        assert [part[key] for key in ("median_m", "p90_m", "rms_m")] == pytest.approx([size] * 3, rel=1e-9)
        assert part["nees"] == pytest.approx((size / 1.5) ** 2, rel=1e-9)
        late = sum(end[3] == float(gap) and short.time_s[end[1]] > SHORT.split_s for end in short.ends)
        assert found["late_gaps"][gap]["count"] == late < part["count"]
    assert (found["log_likelihood"], found["cpu_s"]) == (-7.0, 0.5)


def test_the_study_on_a_piece_and_again_from_its_stages(short, tmp_path):
    lines = []
    summary = run_height(SHORT, tmp_path, say=lines.append)
    assert list(summary["filters"]) == list(FILTERS)
    for row in summary["filters"].values():
        # The range finder is followed to its noise, so that the on-board filter is as far away as from the range.
        heard = short.range_height_m.isfinite() & (short.time_s > SHORT.settle_s)
        apart = (short.range_height_m - short.witness[:, 0])[heard].square().mean().sqrt().item()
        assert row["used"]["to_onboard"]["rms_m"] == pytest.approx(apart, abs=3 * SHORT.range_sd_m)
        assert row["used"]["range_nis"] > 0
        assert set(row["gaps"]) == {"2", "4"}
    assert summary["filters"]["inertial"]["used"]["baro_nis"] is None
    assert json.loads((tmp_path / "metrics.json").read_text())["filters"] == summary["filters"]
    assert {path.name for path in (tmp_path / "figures").iterdir()} >= {"height.png", "gaps.png"}
    again = run_height(SHORT, tmp_path, ("walk",), say=lines.append, figures=False, progress=True)
    assert again["filters"]["walk"] == summary["filters"]["walk"] and "walk: as before" in lines


@pytest.mark.slow
def test_the_drift_in_the_state_carries_the_height_through_gaps(tmp_path):
    """Gaps on the whole flight: rms smaller, claims honest with a drift in the state, neither with a fixed offset.

    Gaps of one length overlap, so that half of their number counts as independent. 99.9 % of the ratio of two mean
    squares, of a mean NEES; the fixed offset is refuted to 1e-6. Measured rms after 60 s: 26 m without barometer, 1.1 m
    with a fixed offset, 0.6 m with a drifting one.
    """
    settings = HeightSettings(str(DATA))
    found = run_height(settings, tmp_path, say=lambda line: None, figures=False)["filters"]
    for gap in ("10", "30", "60"):
        fixed = found["fixed"]["gaps"][gap]
        count = fixed["count"] // 2
        assert fixed["nees"] > chi2.isf(1e-6, count) / count
        for name in ("walk", "wander"):
            part = found[name]["gaps"][gap]
            # Of the longer gaps there are too few for a bound of their own.
            surely = fisher.isf(1e-3, count, count) ** -0.5 if gap == "10" else 1.0
            assert part["rms_m"] < surely * fixed["rms_m"] and part["nees"] < chi2.isf(1e-3, count) / count
    # Forces integrated twice for a minute.
    last = {name: found[name]["gaps"]["60"]["rms_m"] for name in ("inertial", "fixed")}
    assert last["inertial"] > fisher.isf(1e-3, count, count) ** 0.5 * last["fixed"]
    # Withheld for good, nothing knows the drift: it is in the claim of `wander`, one error alike for long.
    assert found["wander"]["withheld"]["nees"] < chi2.isf(1e-3, 1)
    # The receiver's velocity is no witness in the circles: what the range finder rose by says so without a filter.
    flight = make_flight(read_quad_baro_range(DATA), settings)
    part = (flight.time_s > settings.settle_s) & (flight.time_s <= settings.split_s)
    seen = torch.nonzero(part & flight.range_height_m.isfinite())[[0, -1], 0]
    rise = (flight.range_height_m[seen].diff() / flight.time_s[seen].diff()).item()
    receiver, dt = flight.witness[part, 1], flight.dt_s[part]
    # Means over steps that are not alike: four standard errors of a speed weighted by unrelated lengths.
    spread = 4 * (receiver.std() * dt.std() / dt.mean()).item() / len(dt) ** 0.5
    bias = found["wander"]["used"]["velocity_bias_m_s"][0]
    assert bias == pytest.approx(rise - receiver.mean().item(), abs=spread) and bias < -5 * spread


# Command line


def test_the_command_runs_and_goes_on(tmp_path, capsys):
    chosen = [
        "--data",
        str(DATA),
        "--stop-s",
        "81",
        "--filters",
        "wander",
        "--figures",
        "false",
        "--out",
        str(tmp_path),
    ]
    chosen += ["--range-delay-s", "0.2", "--baro-delay-s", "0.3"]
    assert run_height_script.main(chosen) == 0 and "range withheld" in capsys.readouterr().out
    settings = json.loads((tmp_path / "metrics.json").read_text())["settings"]
    assert (settings["stop_s"], settings["range_delay_s"], settings["baro_delay_s"]) == (81, 0.2, 0.3)
    assert run_height_script.main([*chosen, "--resume"]) == 0 and "wander: as before" in capsys.readouterr().out
    assert run_height_script.main([*chosen, "--force", "--quiet"]) == 0 and capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--filters", "ekf"], 2, "--filters takes inertial,fixed,walk,wander; got ekf"),
        (["--range-delay-s", "-1"], 2, "range_delay_s must be zero or more and finite, got -1"),
        (["--data", "/nowhere.zip"], 1, "nowhere"),
    ],
)
def test_wrong_use_is_told_in_one_line(tmp_path, capsys, arguments, code, message):
    assert run_height_script.main([*arguments, "--out", str(tmp_path / "run")]) == code
    out, err = capsys.readouterr()
    assert message in err and len(err.splitlines()) == 1 and out == ""


def test_the_script_and_the_library_know_the_same_names():
    assert run_height_script.FILTERS == FILTERS
