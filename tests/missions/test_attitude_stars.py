"""Pose of a camera over beacons: laws against SciPy and differences, the spread start, convergence, figures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from torchfilt.io.starry_night import Camera, read_starry_night
from torchfilt.missions.attitude.stars import (
    POSE_SPACE,
    PoseTransition,
    Sightings,
    StarsSettings,
    make_filter,
    read_part,
    run_stars,
    spread_start,
    summarize,
    table,
)
from torchfilt.testing import check_law

DATA = Path(__file__).parents[2] / "data" / "starry_night"
DOUBLE = torch.float64
SHORT = StarsSettings(str(DATA), starts=2, particles=50, stop_s=25.0)
SD = torch.tensor([0.01, 0.02], dtype=DOUBLE)
RATE_SD, VELOCITY_SD = (torch.tensor(v, dtype=DOUBLE) for v in ([0.1, 0.2, 0.4], [0.05, 0.04, 0.03]))


def normal(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def poses(count, seed=1):
    q = normal(count, 4, seed=seed)
    return torch.cat([q / q.norm(dim=-1, keepdim=True), normal(count, 3, seed=seed + 9)], -1)


def rotation(q):
    return Rotation.from_quat(q.numpy())


CAMERA = Camera(poses(1, seed=5)[0, :4], normal(3, seed=6, scale=0.1), 0.24)
BEACONS = normal(4, 3, seed=7, scale=2.0)
MOTION = PoseTransition(RATE_SD, VELOCITY_SD)
SIGHT = Sightings(BEACONS, CAMERA, SD)


@pytest.fixture(scope="module")
def log():
    return read_part(SHORT)


# Settings


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"starts": 0}, "starts must be positive and finite, got 0"),
        ({"motion_scale": -1.0}, "motion_scale must be positive and finite, got -1.0"),
        ({"sighting_scale": math.inf}, "sighting_scale must be positive and finite, got inf"),
        ({"member_sd_deg": math.nan}, "member_sd_deg must be positive and finite, got nan"),
        ({"member_sd_m": 0.0}, "member_sd_m must be positive and finite, got 0.0"),
        ({"room_high_m": (5.0, -1.0, 3.0)}, "room_low_m must be below room_high_m"),
        ({"room_low_m": (0.0, 0.0)}, r"room_high_m, three numbers each, got \(0.0, 0.0\)"),
        ({"room_low_m": (-math.inf, -1.0, 0.0)}, "room_low_m must be below room_high_m"),
        ({"start_s": 5.0, "stop_s": 5.0}, "start_s must be from 0 to below stop_s, got 5.0 and 5.0"),
        ({"start_s": -1.0}, "start_s must be from 0 to below stop_s"),
    ],
)
def test_settings_are_checked(change, rule):
    with pytest.raises(ValueError, match=rule):
        StarsSettings(**change)


def test_a_part_begins_with_a_sighting(log):
    whole = read_starry_night(DATA)
    stamp = whole.times_s - whole.times_s[0]
    empty = ~whole.tangents[..., 0].isfinite().any(-1)
    first = int((empty & (stamp > 5)).nonzero()[0])
    later = read_part(StarsSettings(str(DATA), start_s=stamp[first].item(), stop_s=30.0))
    assert later.times_s[0] > whole.times_s[first] and later.tangents[0, :, 0].isfinite().any()
    assert log.times_s[-1] <= whole.times_s[0] + 25.0 < whole.times_s[len(log.times_s)]
    narrow = StarsSettings(str(DATA), start_s=stamp[first].item(), stop_s=stamp[first].item() + 1e-3)
    with pytest.raises(ValueError, match="no beacon is seen from"):
        read_part(narrow)


def test_an_unknown_filter_is_refused(log, tmp_path):
    with pytest.raises(ValueError, match="filters must be out of mekf, ukf, llpf, got ekf"):
        make_filter("ekf", log, (0,), SHORT)
    with pytest.raises(ValueError, match="filters must be out of mekf, ukf, llpf, got none"):
        run_stars(SHORT, tmp_path, ())


# Laws


def test_laws_conform():
    check_law(MOTION, poses(5), normal(5, 6, seed=3), 0.3)
    check_law(MOTION, poses(5), normal(6, seed=3), normal(5, 1, seed=4).abs())
    check_law(SIGHT, poses(5))


def test_motion_is_that_of_a_turning_vehicle():
    """Against the integral of its differential equations, at uneven steps."""
    x, u = poses(3), normal(3, 6, seed=3)
    step = torch.tensor([[0.05], [0.7], [1.9]], dtype=DOUBLE)
    law = MOTION(x, u, step)
    for k in range(3):
        start, rate, velocity = rotation(x[k, :4]), u[k, :3].numpy(), u[k, 3:].numpy()

        def slope(t, _, start=start, rate=rate, velocity=velocity):
            return (start * Rotation.from_rotvec(rate * t)).apply(velocity)

        way = solve_ivp(slope, (0, step[k].item()), np.zeros(3), rtol=1e-12, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(law.mean[k, 4:], x[k, 4:].numpy() + way, atol=1e-10)
        after = start * Rotation.from_rotvec(rate * step[k].item())
        assert (rotation(law.mean[k, :4]).inv() * after).magnitude() < 1e-14
        # Errors in vehicle axes that last for the step.
        for part, sd in ((slice(0, 3), RATE_SD), (slice(3, 6), VELOCITY_SD)):
            axes = after.as_matrix() * (sd * step[k]).numpy()
            found = law.factor()[k, part, part]
            np.testing.assert_allclose(found @ found.mT, axes @ axes.T, atol=1e-14)
        assert not law.factor()[k, 3:, :3].any()


def numeric(function, x, space, size=1e-5):
    """Central differences of the error of function(x) by the error of x."""
    columns = []
    for e in torch.eye(6, dtype=DOUBLE) * size:
        ahead, behind = function(POSE_SPACE.retract(x, e.expand(len(x), 6))), function(POSE_SPACE.retract(x, -e))
        columns.append((space.local(behind, ahead) if space else ahead - behind) / (2 * size))
    return torch.stack(columns, -1)


def test_derivatives_are_those_of_the_means():
    """Differences err by their step squared, 1e-10, times third derivatives of up to 1e3 near the edge."""
    x, u = poses(40), normal(40, 6, seed=3)
    _, jacobian = MOTION.first_order(x, u, 0.3)
    torch.testing.assert_close(jacobian, numeric(lambda p: MOTION(p, u, 0.3).mean, x, POSE_SPACE), atol=1e-8, rtol=0)
    law, jacobian = SIGHT.first_order(x)
    torch.testing.assert_close(law.mean, SIGHT(x).mean, rtol=0, atol=0)
    expected = numeric(lambda p: SIGHT(p).mean, x, None)
    # Beacons inside and outside the edge are among them.
    length = law.mean.unflatten(-1, (4, 2)).norm(dim=-1)
    at_edge = (length - math.tan(math.radians(80))).abs() < 1e-9
    assert 20 < at_edge.sum() < 140
    torch.testing.assert_close(jacobian, expected, atol=1e-5, rtol=1e-5)


def test_sightings_are_the_logs(log):
    """Reprojection at truth has the deviations that the log states."""
    whole = read_starry_night(DATA)
    truth = torch.cat([whole.quaternion, whole.position_m], -1)
    law = Sightings(whole.beacons_m, whole.camera, whole.tangent_variance[:2].sqrt())(truth)
    off = (whole.tangents[..., :2] - law.mean.unflatten(-1, (20, 2)))[whole.tangents[..., 0].isfinite()]
    torch.testing.assert_close(off.std(0), whole.tangent_variance[:2].sqrt(), rtol=1e-3, atol=0)
    assert law.factor()[0, 0] == whole.tangent_variance[0].sqrt() and law.is_diagonal


def test_behind_the_camera_tangents_are_finite_and_continuous():
    beacon = torch.tensor([[0.0, 0.0, 2.0]], dtype=DOUBLE)
    straight = Camera(torch.tensor([0.0, 0, 0, 1], dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE), 0.24)
    law = Sightings(beacon, straight, SD, edge_rad=math.radians(60))
    angle = torch.tensor([0.0, 0.5, 59.999, 60.001, 90, 135, 179.9, 180], dtype=DOUBLE).deg2rad()
    turned = torch.stack([angle * 0, (angle / 2).sin(), angle * 0, (angle / 2).cos()], -1)
    x = torch.cat([turned, torch.zeros(8, 3, dtype=DOUBLE)], -1)
    mean, (_, jacobian) = law(x).mean, law.first_order(x)
    assert jacobian.isfinite().all()
    limit = math.tan(math.radians(60))
    expected = -torch.tensor([0.0, math.tan(math.radians(0.5)), *[limit] * 5, 0.0], dtype=DOUBLE)
    # 0.001 deg off the edge is 7e-5 there; half a turn is rounding of a sine.
    torch.testing.assert_close(mean[:-1, 0], expected[:-1], atol=1e-4, rtol=0)
    at = law(torch.cat([turned[:1], beacon], -1))
    assert at.mean.isfinite().all() and law.first_order(torch.cat([turned[:1], beacon], -1))[1].isfinite().all()


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: PoseTransition(RATE_SD[:2], VELOCITY_SD), r"rate_sd_rad_s must be \(3,\) positive finite numbers"),
        (lambda: PoseTransition(RATE_SD, -VELOCITY_SD), r"velocity_sd_m_s must be \(3,\) positive finite numbers"),
        (lambda: MOTION(poses(2)[:, :6], normal(6), 0.1), r"the state must be \(..., 7\), got \(2, 6\)"),
        (lambda: MOTION(poses(2), None, 0.1), r"rate and velocity as a control u \(..., 6\), got none"),
        (lambda: MOTION(poses(2), normal(3), 0.1), r"control u \(..., 6\), got shape \(3,\)"),
        (lambda: MOTION(poses(2), normal(6)), "needs the time step dt"),
        (lambda: Sightings(BEACONS[0], CAMERA, SD), r"beacons_m must be \(n, 3\) with n >= 1, got \(3,\)"),
        (lambda: Sightings(BEACONS[:0], CAMERA, SD), r"beacons_m must be \(n, 3\) with n >= 1, got \(0, 3\)"),
        (lambda: Sightings(BEACONS * math.nan, CAMERA, SD), "beacons_m must be finite"),
        (lambda: Sightings(BEACONS, CAMERA, SD * 0), r"sd must be \(2,\) positive finite numbers, got \[0.0, 0.0\]"),
        (lambda: Sightings(BEACONS, CAMERA, SD, edge_rad=2.0), r"edge_rad must be in \(0, pi/2\), got 2.0"),
        (lambda: SIGHT(poses(2)[:, :6]), r"the state must be \(..., 7\), got \(2, 6\)"),
    ],
)
def test_laws_name_what_is_wrong(call, rule):
    with pytest.raises(ValueError, match=rule):
        call()


# Start and study


def test_the_spread_start_agrees_with_the_first_sighting_and_leaves_the_rest_open(log):
    settings = StarsSettings(str(DATA), starts=2, particles=4000, member_sd_deg=20.0, member_sd_m=0.3)
    bank = spread_start(log, settings)
    beacon = int(log.tangents[0, :, 0].isfinite().nonzero()[0])
    seen = Sightings(log.beacons_m[[beacon]], log.camera, SD)(bank.x).mean
    torch.testing.assert_close(seen, log.tangents[0, beacon, :2].expand(2, 4000, 2), atol=1e-12, rtol=0)
    own = [math.radians(20.0)] * 3 + [0.3] * 3
    torch.testing.assert_close(bank.scale_tril[1, 7], torch.diag(torch.tensor(own, dtype=DOUBLE)))
    # Camera uniform in the room: means and deviations within 5 standard errors, one false alarm in 10^5.
    world = rotation(bank.x[..., :4].flatten(0, 1))
    camera = bank.x[..., 4:].flatten(0, 1).numpy() + world.apply(log.camera.position_m.numpy())
    low, high = np.array(settings.room_low_m), np.array(settings.room_high_m)
    assert ((camera > low) & (camera < high)).all()
    width = (high - low) / math.sqrt(12)
    assert (np.abs(camera.mean(0) - (low + high) / 2) < 5 * width / math.sqrt(8000)).all()
    # Uniform about the line of sight: the mean of any axis across it vanishes against that line.
    line = log.beacons_m[beacon].numpy() - camera
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    side = world.apply([0.3, -0.8, 0.5])
    across = side - (side * line).sum(1, keepdims=True) * line
    first = np.cross(line, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.arctan2((across * np.cross(line, first)).sum(1), (across * first).sum(1))
    for k in (1, 2):
        assert abs(np.exp(1j * k * angle).mean()) < 5 / math.sqrt(8000)


def test_columns_of_nan_say_what_leaving_beacons_out_says(log):
    k = int((log.tangents[..., 0].isfinite().sum(-1) >= 6).nonzero()[0])
    seen = log.tangents[k, :, 0].isfinite().nonzero()[:, 0].tolist()
    assert 6 <= len(seen) < 20
    truth = torch.cat([log.quaternion[k], log.position_m[k]])
    found = []
    for beacons in (seen, range(20)):
        tracker = make_filter("mekf", log, beacons, SHORT)
        state = tracker.init((2,))
        state = state._replace(belief=state.belief._replace(mean=truth.expand(2, 7), scale_tril=torch.eye(6).double()))
        y = log.tangents[k, list(beacons), :2].flatten().expand(2, -1)
        control = torch.cat([log.rate_rad_s[k], log.velocity_m_s[k]])
        found.append(tracker.step(state, y, control, 0.1)[0].belief)
    torch.testing.assert_close(found[0].mean, found[1].mean, atol=1e-9, rtol=0)
    torch.testing.assert_close(found[0].covariance, found[1].covariance, atol=1e-12, rtol=1e-7)


def test_the_bank_settles_from_any_pose_and_a_second_run_reads_its_stages(tmp_path):
    lines = []
    summary = run_stars(SHORT, tmp_path, ("llpf", "ukf"), say=lines.append)
    bank = summary["filters"]["llpf"]
    assert bank["converged"] == 1 and max(bank["converged_s"]) < 16 and bank["nis"] is None
    assert bank["position_m"]["rms"] < 0.06 and bank["attitude_deg"]["rms"] < 2.5
    assert json.loads((tmp_path / "metrics.json").read_text())["filters"] == summary["filters"]
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names >= {"path.png", "errors.png", "bands_llpf.png", "bands_ukf.png"}
    again = run_stars(SHORT, tmp_path, ("llpf",), say=lines.append, figures=False, progress=True)
    assert again["filters"]["llpf"] == bank and "llpf: as before" in lines
    assert sum(line.startswith("llpf") for line in lines) == 4


def test_settings_reach_the_filter(log):
    """Wider motion and sightings make wider claims; linearising once, or from another seed, is something else."""
    k = int((log.tangents[..., 0].isfinite().sum(-1) >= 6).nonzero()[0])
    seen = log.tangents[k, :, 0].isfinite().nonzero()[:, 0].tolist()
    y = log.tangents[k, seen, :2].flatten().expand(2, -1)
    control = torch.cat([log.rate_rad_s[k], log.velocity_m_s[k]])
    near = POSE_SPACE.retract(torch.cat([log.quaternion[k], log.position_m[k]]), normal(2, 6, seed=8, scale=0.2))
    beliefs, ahead = {}, {}
    for name, change in {
        "same": {},
        "sighting": {"sighting_scale": 3.0},
        "motion": {"motion_scale": 3.0},
        "once": {"iterations": 1},
    }.items():
        tracker = make_filter("mekf", log, seen, StarsSettings(str(DATA), **({"starts": 2} | change)))
        state = tracker.init((2,))
        state = state._replace(belief=state.belief._replace(mean=near, scale_tril=0.3 * torch.eye(6).double()))
        beliefs[name] = tracker.step(state, y, control, 0.3)[0].belief
        ahead[name] = tracker.predict(state.belief, control, 0.3).covariance
    claims = {name: belief.covariance.diagonal(dim1=-2, dim2=-1) for name, belief in beliefs.items()}
    assert (claims["sighting"] > 2 * claims["same"]).all()
    more = (ahead["motion"] - ahead["same"]).diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3)).sum(-1)
    noise = torch.stack([log.rate_variance.sum(), log.velocity_variance.sum()])
    torch.testing.assert_close(more, (8 * 0.3**2 * noise).expand(2, 2))
    assert (beliefs["once"].mean - beliefs["same"].mean).abs().max() > 1e-3
    priors = [make_filter("ukf", log, (0,), StarsSettings(str(DATA), seed=seed)).init((8,)).belief for seed in (0, 1)]
    assert (priors[0].mean[:, :4] - priors[1].mean[:, :4]).abs().max() > 0.1
    # The room's middle, and the deviation of a uniform law on it.
    room = StarsSettings(str(DATA), room_low_m=(1.0, 0.0, 0.0), room_high_m=(3.0, 4.0, 6.0))
    prior = make_filter("ukf", log, (0,), room).init((8,)).belief
    torch.testing.assert_close(prior.mean[:, 4:], prior.mean.new_tensor([2.0, 2.0, 3.0]).expand(8, 3))
    width = prior.covariance.diagonal(dim1=-2, dim2=-1).sqrt()[..., 3:] * math.sqrt(12)
    torch.testing.assert_close(width.expand(8, 3), prior.mean.new_tensor([2.0, 4.0, 6.0]).expand(8, 3))
    assert make_filter("llpf", log, (0,), SHORT).particles == SHORT.particles
    other = spread_start(log, StarsSettings(str(DATA), starts=2, particles=50, seed=1)).x
    assert (spread_start(log, SHORT).x - other).abs().max() > 0.1


def made(error_m, error_deg, nis=math.nan):
    """Result of 41 steps of a second and two starts, from their errors."""
    shape = (41, 2)
    return {
        "time_s": np.arange(41.0),
        "error_m": np.broadcast_to(error_m, shape),
        "error_deg": np.broadcast_to(error_deg, shape),
        "nees": np.full(shape, 2.0),
        "nis": np.full(shape, nis),
        "cpu_s": np.array(1.5),
    }


def test_convergence_holds_for_ten_seconds_and_what_comes_later_counts():
    error = np.full((41, 2), 0.1)
    error[:5], error[12, 0], error[30, 0] = 1.0, 0.5, 2.0
    error[12::10, 1] = 0.31  # never ten seconds below
    found = summarize(made(error, 4.0, 0.5))
    assert found["converged_s"] == [13.0, None] and found["converged"] == 0.5
    scored = np.where(np.arange(13, 41) == 30, 2.0, 0.1)
    assert found["position_m"]["rms"] == pytest.approx(np.sqrt((scored**2).mean()))
    assert found["position_m"]["median"] == pytest.approx(0.1)
    assert found["attitude_deg"] == {"median": 4.0, "rms": 4.0}
    assert (found["nees"], found["nis"], found["cpu_s"]) == (2.0, 0.5, 1.5)
    assert summarize(made(0.1, 4.0))["nis"] is None
    turned = summarize(made(0.1, 11.0))
    assert turned["converged"] == 0 and turned["position_m"] is None
    assert (
        "never" not in "".join(table({"filters": {"mekf": turned}})) and "0.00" in table({"filters": {"a": turned}})[1]
    )


@pytest.mark.slow
def test_the_bank_follows_the_whole_log(tmp_path):
    """All starts converge; the figures of docs/attitude_stars.md, a tenth above."""
    settings = StarsSettings(str(DATA), starts=2, particles=100)
    found = run_stars(settings, tmp_path, ("llpf",), say=lambda line: None, figures=False)["filters"]["llpf"]
    assert found["converged"] == 1 and max(found["converged_s"]) < 16
    assert found["position_m"]["median"] < 0.028 and found["position_m"]["rms"] < 0.056
    assert found["attitude_deg"]["median"] < 2.0 and found["attitude_deg"]["rms"] < 4.2
