"""The SINS/SAR study on short flights: scenes, numbers, files, resuming, refusals."""

import json
import math

import numpy as np
import pytest
import torch
from scipy import stats

from torchfilt.missions.inertial import (
    FILTERS,
    SCENARIOS,
    InertialSettings,
    make_filter,
    make_scene,
    run_filter,
    run_inertial,
    summarize,
)
from torchfilt.missions.inertial.scene import DEFAULT, OUTLIER_FACTOR, OUTLIER_SHARE
from torchfilt.missions.inertial.study import GROUPS, different
from torchfilt.models.inertial.error_model import ERROR_SPACE
from torchfilt.models.inertial.imu import MEMS

SHORT = InertialSettings(runs=3, steps=20, particles=60, conditional_particles=20, window=3)
FALSE_ALARM = 1e-5


@pytest.fixture(scope="module")
def scene():
    return make_scene(SHORT)


def test_a_run_does_not_depend_on_its_neighbours(scene):
    """The run of seed 2 alone is row 2 of seeds 0 to 2."""
    alone = make_scene(InertialSettings(runs=1, steps=20, seed=2))
    for name in ("truth", "fixes", "controls"):
        assert torch.allclose(getattr(alone, name)[:, 0], getattr(scene, name)[:, 2], rtol=0, atol=1e-9), name


def test_fixes_scatter_as_their_law_says():
    """Whitened by the law at the truth: standard normal; outliers make the share of large ones that they should."""
    for scenario in ("sins-sar", "outliers"):
        settings = InertialSettings(scenario=scenario, runs=40, steps=50)
        scene = make_scene(settings)
        law = scene.model.conditional("observation", scene.truth, scene.controls)
        z = (law.space.local(law.mean, scene.fixes) / law.scale_tril).numpy()
        if scenario == "sins-sar":
            for component in z.reshape(-1, 4).T:
                assert stats.kstest(component, "norm").pvalue > FALSE_ALARM
        else:
            far = int(((z**2).sum(-1) > stats.chi2.ppf(0.9999, 4)).sum())
            chance = 1 - stats.chi2.cdf(stats.chi2.ppf(0.9999, 4) / OUTLIER_FACTOR**2, 4)
            share = OUTLIER_SHARE * chance + (1 - OUTLIER_SHARE) * 1e-4
            assert stats.binomtest(far, z.shape[0] * z.shape[1], share).pvalue > FALSE_ALARM


def test_start_errors_have_the_prior_they_are_said_to_have():
    """NEES of the first predicted error, 300 runs, mean within a 1e-5 band of chi-square with 15 degrees."""
    settings = InertialSettings(runs=300, steps=1)
    scene = make_scene(settings)
    tracker = make_filter("ckf", scene, settings)
    state = tracker.init((300,))
    ahead = tracker.predict(state.belief, scene.controls[0], 1.0)
    z = torch.linalg.solve_triangular(
        ahead.scale_tril.expand(300, 15, 15), ERROR_SPACE.local(ahead.mean, scene.truth[0]).unsqueeze(-1), upper=False
    )
    total = z.square().sum().item()
    assert FALSE_ALARM < stats.chi2.cdf(total, 15 * 300) < 1 - FALSE_ALARM


def test_unknown_heading_means_no_heading_fix():
    settings = InertialSettings(scenario="heading-unknown", runs=2, steps=3)
    scene = make_scene(settings)
    assert scene.fixes[..., 0].isnan().all() and scene.fixes[..., 1:].isfinite().all()
    assert settings.grade.gyro_bias_sd_rad_s == pytest.approx(math.radians(1) / 3600)
    assert InertialSettings(scenario="mems").grade is MEMS


def test_the_bank_covers_the_circle():
    """36 Gaussians 10 deg apart, each six wide; the mixture's heading has the prior's mean and spread."""
    settings = InertialSettings(scenario="heading-unknown", runs=1, steps=2)
    scene = make_scene(settings)
    tracker = make_filter("bank-36", scene, settings)
    belief, prior = tracker.init((1,)).belief, scene.model.prior()
    heading = ERROR_SPACE.local(prior.mean, belief.x[0])[:, 2]
    assert torch.allclose(heading.diff(), torch.full((35,), math.radians(10), dtype=torch.float64), atol=1e-12)
    own = belief.scale_tril[0].square().sum(-1)[:, 2]
    assert torch.allclose(own.sqrt().rad2deg(), torch.full((36,), 6.0, dtype=torch.float64), atol=1e-9)
    weights = belief.weights[0]
    assert abs((weights * heading).sum()) < 1e-12
    assert (weights * (own + heading.square())).sum().sqrt().rad2deg().item() == pytest.approx(60, abs=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_runs_on_its_scenario(name, scene):
    scenario = next(key for key in SCENARIOS if name in DEFAULT[key])
    settings = InertialSettings(**(SHORT.to_dict() | {"scenario": scenario, "steps": 6}))
    result = run_filter(name, make_scene(settings), settings)
    assert result["error"].shape == (6, 3, 15) and result["ok"].all()
    assert np.isfinite(result["error"]).all() and (result["deviation"] >= 0).all()
    particles = not name.startswith(("es-kf", "ckf"))
    assert np.isfinite(result["ess"]).all() == particles and np.isfinite(result["nis"]).all() != particles
    if particles and name != "bank-36":
        assert (result["unique"] >= result["roots"]).all() and (result["roots"] >= 1).all()
    assert np.isfinite(result["acceptance"]).any() == name.startswith("mpf")
    entry = summarize(result, 4)
    assert entry["failed"] == 0 and entry["position_m"] > 0 and json.dumps(entry, allow_nan=False)


def test_different_counts_each_row_alone():
    assert different(torch.tensor([[1, 1, 4, 2], [3, 3, 3, 3]])).tolist() == [3.0, 1.0]


def test_summary_is_the_root_mean_square_it_says():
    """Errors of known size: tilt is an angle about one axis, position the length of a vector; worst is one run's."""
    error = np.zeros((10, 2, 15))
    error[..., 0] = error[..., 1] = 3 * math.radians(1 / 60)
    error[:, 1, 6:9] = 2.0
    result = {
        "error": error,
        "deviation": np.ones_like(error),
        "ok": np.ones((10, 2), bool),
        "cpu_s": np.full(10, 0.002),
        **{name: np.full((10, 2), 30.0) for name in ("nees", "nis", "ess", "unique", "acceptance", "roots")},
    }
    entry = summarize(result, 3)
    assert entry["tilt_arcmin"] == pytest.approx(3)
    assert entry["position_m"] == pytest.approx((12 / 2) ** 0.5) and entry["worst_position_m"] == pytest.approx(12**0.5)
    assert entry["nees"] == 2 and entry["nis"] == 10 and entry["ms_per_step"] == pytest.approx(2)
    assert set(GROUPS) < set(entry) and entry["heading_arcmin"] == 0
    result["error"][3, 0, 6] = np.nan
    broken = summarize(result, 3)
    assert broken["failed"] == 1 and broken["position_m"] is None


def test_a_run_is_kept_and_resumed(tmp_path):
    said: list[str] = []
    settings = InertialSettings(runs=2, steps=5, particles=40)
    first = run_inertial(settings, tmp_path, ("es-kf", "rpf"), say=said.append)
    assert (tmp_path / "figures" / "errors.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "metrics.json").read_text()) == first
    assert "es-kf" in (tmp_path / "table.txt").read_text() and not any("as before" in line for line in said)
    said.clear()
    again = run_inertial(settings, tmp_path, ("es-kf", "rpf", "sir"), say=said.append, figures=False)
    assert sum("as before" in line for line in said) == 2
    assert again["filters"]["rpf"] == first["filters"]["rpf"] and "sir" in again["filters"]
    other = InertialSettings(runs=2, steps=5, particles=50)
    run_inertial(other, tmp_path, ("es-kf", "rpf"), say=said.append, figures=False)
    assert sum("as before" in line for line in said) == 3  # the Kalman filter has no particles


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(scenario="sea"), "scenario must be one of sins-sar, mems, heading-unknown, outliers, got 'sea'"),
        (dict(steps=1001), "steps must be from 1 to 1000, the length of the flight in s, got 1001"),
        (dict(runs=0), "runs must be at least 1, got 0"),
        (dict(particles=16), "particles must be at least 17, got 16"),
    ],
)
def test_settings_name_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        InertialSettings(**change)


def test_unknown_filters_are_refused(tmp_path, scene):
    with pytest.raises(ValueError, match=r"filters must be out of es-kf.* got ukf"):
        run_inertial(SHORT, tmp_path, ("es-kf", "ukf"))
    with pytest.raises(ValueError, match=r"filter must be one of es-kf.* got 'ukf'"):
        make_filter("ukf", scene, SHORT)
