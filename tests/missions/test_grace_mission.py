"""The GRACE task on its real log: data, learning, predictions, tracking; small sizes, the whole of it when slow."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchfilt.gaussian import Gaussian
from torchfilt.missions.grace.data import MU_M3_S2, build_data, nominal_law, residual
from torchfilt.missions.grace.learning import J2, POINT_MASS, POTENTIAL, learn_potential, nominal_dynamics
from torchfilt.missions.grace.prediction import gains, held_out_starts, predict_from, prediction_errors
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.grace.tracking import (
    Case,
    Tracked,
    bias_of_record,
    chi_square_band,
    make_filter,
    score,
    simulate_case,
    track,
)
from torchfilt.missions.stages import Stages

FOLDER = str(Path(__file__).parents[2] / "data" / "grace_2010")
SMALL = GraceSettings(
    folder=FOLDER, degree=20, tracking_hours=3, runs=3, particles=40, outage_starts_h=(1.8,), outage_minutes=40
)


@pytest.fixture(scope="module")
def data():
    return build_data(SMALL)


@pytest.fixture(scope="module")
def dynamics(data):
    return {**nominal_dynamics(data, SMALL), POTENTIAL: learn_potential(data, SMALL)}


# Data and learning ---------------------------------------------------------------------------------------------------


def test_data_are_the_pair_of_the_log(data):
    assert data.relative.shape == (8641, 6) and data.states.shape == (1441, 6) and data.controls.shape == (1440, 21)
    distance = torch.linalg.vector_norm(data.states[:, :3], dim=-1)
    assert distance.min() > 224.0e3 and distance.max() < 227.9e3
    assert (data.states[:, 1] > 0).all()  # B leads
    # The K-band file ends one epoch before the orbits.
    assert torch.isnan(data.range_m).sum() == 1 and torch.isnan(data.range_m[-1])
    assert (distance - data.range_m)[:-1].abs().max() < 0.1


def test_residual_of_the_nominal_laws(data):
    """Of a step of 60 s: J2 is 50 times better than a point mass, and leaves 2e-5 m/s^2."""
    sizes = {}
    for j2 in (False, True):
        missed = residual(data, nominal_law(0.0, j2=j2, step_s=60.0), 60.0)
        sizes[j2] = float(missed[:, 3:].square().sum(-1).mean().sqrt()) / 60
    assert 1.3e-3 < sizes[False] < 1.7e-3
    assert 2.0e-5 < sizes[True] < 3.0e-5


def test_nothing_after_the_training_hours_is_learned(data):
    """Whatever the deputy does later, the potential is the same to the bit; what it does before changes it."""
    small = GraceSettings(folder=FOLDER, degree=6, training_hours=3, tracking_hours=3, outage_starts_h=())
    limit = small.training_steps
    moved = data.states.clone()
    moved[limit + 1 :] += 1000.0
    later = data._replace(
        states=moved, relative=torch.cat([data.relative[: limit * 6 + 1], data.relative[limit * 6 + 1 :] + 1000.0])
    )
    learned, again = learn_potential(data, small), learn_potential(later, small)
    assert torch.equal(learned.controls, again.controls)
    for key in ("scale", "psd_m2_s3", "loss"):
        assert learned.training[key] == again.training[key]
    moved = data.states.clone()
    moved[limit // 2, 3] += 1e-3
    other = learn_potential(data._replace(states=moved), small)
    assert not torch.equal(learned.controls, other.controls)


def test_noise_of_the_nominal_laws_is_their_error(data):
    laws = nominal_dynamics(data, SMALL)
    missed = residual(data, nominal_law(0.0, j2=True, step_s=60.0), 60.0)[: SMALL.training_steps, 3:]
    assert laws[J2].training["psd_m2_s3"] == pytest.approx(float(missed.square().mean()) / 60)
    assert laws[POINT_MASS].training["psd_m2_s3"] > 1000 * laws[J2].training["psd_m2_s3"]


# Prediction ----------------------------------------------------------------------------------------------------------


def test_learned_potential_beats_its_nominal_on_held_out_hours(data, dynamics):
    """Degree 20 here; z says how honest the predicted deviation is."""
    entries, growth = prediction_errors(data, dynamics, SMALL)
    gain = gains(entries, J2, POTENTIAL)
    assert gain["one_step_velocity_m_s"] > 1.5 and gain["one_step_velocity_median_m_s"] > 2
    assert gain["median_15_min"] > 5 and gain["median_94_min"] > 5
    for group in ("position_m", "velocity_m_s"):
        assert 0.7 < entries[POTENTIAL]["one_step"][group]["z"] < 1.3
    # What two others got for the nominal laws with integrators of their own: 540 m and 5.6 km, 4 m and 36 m (other
    # starts).
    assert 400 < entries[POINT_MASS]["median_m"]["15_min"] < 700
    assert 2 < entries[J2]["median_m"]["15_min"] < 8
    assert 20 < entries[J2]["median_m"]["94_min"] < 110
    minutes, error = growth[POTENTIAL]
    assert minutes[0] == 1 and minutes[-1] == 94
    assert error[14] == pytest.approx(entries[POTENTIAL]["median_m"]["15_min"])
    json.dumps(entries)


def test_roll_outs_start_in_held_out_hours_and_equal_one_by_one(data, dynamics):
    starts = held_out_starts(SMALL, 1440, 94)
    assert starts[0] == 540 and starts[-1] <= 1440 - 94 and (starts.diff() == 10).all()
    own = dynamics[POTENTIAL]
    together = predict_from(own, data.states, starts[:3], 5, 60.0)
    for k in range(3):
        x = data.states[starts[k]]
        for step in range(5):
            x = own.law(x, own.controls[starts[k] + step], 60.0).mean
            torch.testing.assert_close(together[step, k], x, rtol=1e-12, atol=1e-8)


# Tracking ------------------------------------------------------------------------------------------------------------


def test_measurements_have_the_stated_noise(data):
    settings = GraceSettings(folder=FOLDER, tracking_hours=6, runs=8)
    case = simulate_case(data, settings, "radar")
    assert case.measurements.shape == (360, 8, 3) and case.prior.mean.shape == (8, 6)
    apart = case.measurements - case.observation.measure(case.truth).unsqueeze(1)
    count = 360 * 8
    # Standard deviations within four standard errors (false alarm 6e-5 each); the mean radius turns the first angle by
    # 4e-5 rad rms against 2.9e-4 rad of noise, 1 % of the deviation.
    for k, (sd, extra) in enumerate(((1.0, 0.0), (math.radians(0.05 / 3), 0.012), (math.radians(0.05 / 3), 0.0))):
        assert abs(float(apart[..., k].std()) / sd - 1) < 4 / (2 * count) ** 0.5 + extra
    error = (case.prior.mean - data.states[540]) / torch.tensor([100.0] * 3 + [0.1] * 3)
    assert abs(float(error.square().sum()) - 48) < 4 * 96**0.5
    assert torch.equal(simulate_case(data, settings, "radar").measurements, case.measurements)
    other = simulate_case(data, GraceSettings(folder=FOLDER, tracking_hours=6, runs=8, seed=1), "radar")
    assert not torch.equal(other.measurements, case.measurements)


def test_range_is_the_record_and_outages_are_empty(data):
    case = simulate_case(data, SMALL, "kband")
    assert case.measurements.shape == (180, 6, 3) and case.prior.mean.shape == (6, 7)
    plain, gaps = case.measurements[:, :3], case.measurements[:, 3:]
    assert torch.equal(plain[..., 0], data.range_m[541:721, None].expand(-1, 3))
    assert list(case.outages) == [range(108, 148)]
    silent = torch.isnan(gaps).all(-1).all(-1)
    assert silent.nonzero().flatten().tolist() == list(range(108, 148))
    assert torch.equal(gaps[~silent], plain[~silent])
    assert bias_of_record(data, SMALL) == pytest.approx(-0.012, abs=0.01)


def test_filters_with_learned_dynamics_track_better(data, dynamics):
    case = simulate_case(data, SMALL, "kband")
    scores = {name: score(track(name, case, dynamics, SMALL), case, SMALL) for name in ("nominal-ukf", "gp-ukf")}
    nominal, learned = scores["nominal-ukf"], scores["gp-ukf"]
    # In the orbital plane the range and the dynamics rule; across, angles of 65 m do, whatever the dynamics.
    assert learned["in_plane_rmse_m"] < nominal["in_plane_rmse_m"] / 2
    assert learned["outage_end"]["in_plane_rmse_m"] < nominal["outage_end"]["in_plane_rmse_m"] / 2
    assert learned["axes_rmse_m"]["along"] < 0.3
    assert learned["position_rmse_m"] < 15
    assert learned["log_likelihood"] > nominal["log_likelihood"] + 50
    assert 1 < learned["nees"] < 9
    assert learned["ms_per_step"] > 0 and learned["ess"] is None
    json.dumps(scores)


def test_particle_filter_is_the_gaussian_filter_here(data, dynamics):
    """The posterior is close to Gaussian: on the same measurements the particle filter gives the same answer within
    its own noise."""
    short = GraceSettings(folder=FOLDER, degree=20, tracking_hours=1, runs=3, particles=60, settle_minutes=20)
    case = simulate_case(data, short, "radar")
    upf, ukf = (track(name, case, dynamics, short) for name in ("mf-upf", "gp-ukf"))
    settled = slice(20, None)
    deviation = ukf.covariance[settled].diagonal(dim1=-2, dim2=-1).sqrt()
    apart = (upf.mean - ukf.mean)[settled] / deviation
    assert float(apart.square().mean().sqrt()) < 0.6
    assert upf.ess.shape == (60, 3) and 10 < upf.ess[settled].mean() < 60
    assert torch.equal(track("mf-upf", case, dynamics, short).mean, upf.mean)


def test_kept_results_are_found_again_by_the_same_settings_only(data, dynamics, tmp_path):
    short = replace(SMALL, tracking_hours=1, settle_minutes=20, outage_starts_h=())
    case, stages = simulate_case(data, short, "kband"), Stages(tmp_path)
    first = track("gp-ukf", case, dynamics, short, stages=stages)
    # Without dynamics nothing can be computed: this is read.
    again = track("gp-ukf", case, {}, short, stages=stages)
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
    assert (
        track("gp-ukf", case, {}, replace(short, particles=99, settle_minutes=30), stages=stages).cpu_s == first.cpu_s
    )
    changes = {"seed": 1, "runs": 4, "degree": 21, "bias_sd_m": 0.2, "range_sd_m": 0.02, "outage_starts_h": (0.1,)}
    for name, value in changes.items():
        with pytest.raises(KeyError):
            track("gp-ukf", case, {}, replace(short, **{name: value}), stages=stages)
    # A damaged file is told and replaced.
    told = []
    path = next(tmp_path.glob("gp-ukf-kband-*.npz"))
    path.write_bytes(path.read_bytes()[:-1])
    mended = track("gp-ukf", case, dynamics, short, stages=Stages(tmp_path, told.append))
    assert torch.equal(mended.mean, first.mean) and "truncated or altered" in told[0]


def test_learned_laws_are_kept(data, tmp_path):
    """The potential's controls and the phase GP come back to the bit; another degree is learned anew."""
    small = replace(SMALL, degree=6, training_hours=3)
    stages = Stages(tmp_path)
    first = learn_potential(data, small, stages)
    nothing = data._replace(relative=data.relative * torch.nan)
    again = learn_potential(nothing, small, stages)
    assert torch.equal(first.controls, again.controls) and first.training == again.training
    x, u = data.states[:3], first.controls[:3]
    assert torch.equal(first.law(x, u, 60.0).covariance, again.law(x, u, 60.0).covariance)
    assert not torch.equal(learn_potential(data, replace(small, degree=7), stages).controls, first.controls)


def test_score_of_known_errors():
    settings = GraceSettings(folder=FOLDER, tracking_hours=1, settle_minutes=10, outage_starts_h=(), runs=2)
    steps, truth = 60, torch.zeros(60, 6, dtype=torch.float64)
    mean = torch.zeros(steps, 2, 6, dtype=torch.float64)
    mean[10:, 0] = torch.tensor([3.0, 0.0, 4.0, 0.3, 0.0, 0.4])
    mean[10:, 1] = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.1, 0.0])
    mean[:10] = 1e6  # not settled
    covariance = torch.diag(torch.tensor([4.0] * 3 + [0.04] * 3, dtype=torch.float64)).expand(steps, 2, 6, 6)
    tracked = Tracked(mean, covariance, torch.ones(steps, 2, dtype=torch.float64), None, 1.2)
    case = Case("radar", torch.nn.Identity(), truth, Gaussian(truth[0], torch.eye(6)), truth, 2, [])
    found = score(tracked, case, settings)
    assert found["position_rmse_m"] == pytest.approx(13**0.5)
    assert found["velocity_rmse_m_s"] == pytest.approx(0.13**0.5)
    assert found["position_rmse_sd_m"] == pytest.approx((5 - 1) / 2**0.5)
    assert found["axes_rmse_m"] == pytest.approx({"radial": 4.5**0.5, "along": 0.5**0.5, "across": 8**0.5})
    assert found["in_plane_rmse_m"] == pytest.approx(5**0.5)
    assert found["nees"] == pytest.approx((25 / 4 + 25 / 4 + 1 / 4 + 1 / 4) / 2)
    assert found["nees_inside_band"] == 1.0
    alone = tracked._replace(mean=mean[:, :1], covariance=covariance[:, :1])
    assert score(alone, case._replace(runs=1), settings)["position_rmse_sd_m"] is None
    assert found["ms_per_step"] == pytest.approx(10.0)
    assert found["log_likelihood"] == 60 and found["ess"] is None and "bias" not in found


def test_chi_square_band_holds_95_percent():
    low, high = chi_square_band(6, 10)
    draws = torch.randn(20000, 10, 6, generator=torch.Generator().manual_seed(0)).square().sum(-1).mean(-1)
    inside = float(((draws > low) & (draws < high)).double().mean())
    assert abs(inside - 0.95) < 4 * (0.95 * 0.05 / 20000) ** 0.5


# Settings ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step_s": 30.0}, "step_s must be a multiple of 20 s"),
        ({"training_hours": 2.0}, "training_hours must be whole steps, at least 3 h, got 2"),
        ({"training_hours": 21.0}, "training_hours must leave 4 h"),
        ({"training_hours": 12.0, "tracking_hours": 13.0}, "room for tracking_hours, got 12.0 and 13.0"),
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"degree": 1}, "degree must be at least 2"),
        ({"range_sd_m": 0.0}, "range_sd_m must be positive, got 0"),
        ({"prior_sd_m": math.nan}, "prior_sd_m must be positive, got nan"),
        ({"settle_minutes": 360.0}, "settle_minutes must end before"),
        ({"outage_starts_h": (5.5,)}, r"outage_starts_h must leave room for 45\.0 min within 6\.0 h, got 5\.5"),
    ],
)
def test_settings_name_the_rule(change, message):
    with pytest.raises(ValueError, match=message):
        GraceSettings(**change)


def test_other_steps_and_unknown_filter(data, dynamics):
    settings = GraceSettings(folder=FOLDER, step_s=20.0)
    assert settings.stride == 2 and settings.training_steps == 1620 and settings.tracking_steps == 1080
    assert settings.outage_rows == [range(360, 495), range(810, 945)]
    assert GraceSettings(tracking_hours=2).outage_rows == [range(40, 85)]
    assert build_data(settings).states.shape == (4321, 6)
    with pytest.raises(ValueError, match="filter must be one of nominal-ukf, gp-ukf, mf-upf, got 'ekf'"):
        make_filter("ekf", simulate_case(data, SMALL, "kband"), dynamics, SMALL)
    with pytest.raises(FileNotFoundError):
        build_data(GraceSettings(folder="nowhere"))
    assert MU_M3_S2 == 3.986004415e14
