"""The landing study: a short run whole, its numbers, what is kept, what is refused; targets over 50 runs."""

import json
import math

import numpy as np
import pytest
import run_landing
import torch

import torchfilt as tf
from torchfilt.missions.landing import figures, study
from torchfilt.missions.landing.scene import SCENARIOS, LandingSettings, make_scene
from torchfilt.models.attitude import multiply

SHORT = LandingSettings(runs=2, duration_s=18.0)


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("landing")
    said = []
    summary = study.run_landing(SHORT, folder, ("ukf-restart", "mekf-no-gauge"), say=said.append)
    return folder, summary, said


def test_a_short_run_lands(outcome):
    folder, summary, said = outcome
    entry = summary["filters"]["ukf-restart"]
    assert entry["converged"] == 1.0 and entry["failed"] == 0 and entry["ms_one_vehicle"] > 0
    assert json.loads((folder / "metrics.json").read_text()) == summary
    assert any("mekf-no-gauge" in line for line in said)
    assert {path.name for path in (folder / "figures").iterdir()} == {"errors.png", "particles.png", "paths.png"}


def test_finished_stages_are_kept(outcome):
    folder, summary, _ = outcome
    said = []
    again = study.run_landing(SHORT, folder, ("ukf-restart", "mekf-no-gauge"), say=said.append, figures=False)
    assert sum("as before" in line for line in said) == 2
    for name, entry in again["filters"].items():
        del entry["ms_one_vehicle"]
        assert entry.items() <= summary["filters"][name].items()


def test_numbers_of_made_up_errors():
    """Ten steps of 1 s: one run comes near at step 4 and stays, one never does; the beacon is seen at step 2."""
    error = np.zeros((20, 2, 15))
    error[:4, 0, 6], error[:, 1, 6], error[:, :, 8], error[:, :, 0] = 30.0, 40.0, 0.5, math.radians(3)
    result = {
        "error": error,
        "nees": np.full((20, 2), 28.0),
        "ok": np.ones((20, 2), bool),
        "restarts": np.array([0.0, 2.0]),
        "cpu_s": np.full(20, 0.25),
    }
    found = study.summarize(result, torch.tensor([2, 2]), 1.0)
    assert found["converged"] == 0.5 and found["seconds_to_converge"] == 2.0
    assert found["horizontal_m"] == [0.0, 40.0] and found["vertical_m"] == [0.5, 0.5]
    np.testing.assert_allclose(found["attitude_deg"], [3.0, 3.0])
    assert found["nees"] == 2.0 and found["restarts"] == 1 and found["failed"] == 0 and found["ms_per_step"] == 250.0


def test_a_turned_belief_is_as_consistent():
    """Mean and covariance turned about the vertical together: the same error and the same NEES, of one row by hand."""
    scene = make_scene(LandingSettings(runs=1, duration_s=11.0))
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(15, 15, generator=generator, dtype=torch.float64).tril() * 0.1
    prior = scene.model.prior()
    mean = scene.model.representative(scene.truth[100])
    truth = scene.model.representative(prior.space.retract(mean, 0.05 * torch.ones(1, 15, dtype=torch.float64)))
    angle = 1.1
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    blocks = torch.block_diag(turn, turn, turn, torch.eye(6, dtype=torch.float64))
    about_z = torch.tensor([0, 0, math.sin(angle / 2), math.cos(angle / 2)], dtype=torch.float64)
    parts = [multiply(about_z, mean[:, :4]), mean[:, 4:7] @ turn.mT, mean[:, 7:10] @ turn.mT, mean[:, 10:]]
    beliefs = (
        tf.Gaussian(mean, factor, prior.space),
        tf.Gaussian(torch.cat(parts, -1), blocks @ factor, prior.space),
    )
    (at, error, nees), (as_at, as_error, as_nees) = (study.compare(scene, belief, truth) for belief in beliefs)
    torch.testing.assert_close(as_at, at, rtol=0, atol=1e-12)
    torch.testing.assert_close(as_error, error, rtol=0, atol=1e-12)
    # Conditioned like a random triangular factor of 15 numbers.
    torch.testing.assert_close(as_nees, nees, rtol=1e-8, atol=0)
    # A level belief without a turn of its own loses the heading and keeps the rest.
    level = scene.model.prior().mean.unsqueeze(0)
    near = prior.space.retract(level, 0.05 * (torch.arange(15) != 2).to(level).unsqueeze(0))
    spread = torch.linspace(0.1, 1.5, 15, dtype=torch.float64)
    error, nees = study.compare(scene, tf.Gaussian(level, spread, prior.space, True), near)[1:]
    expected = sum(float(e / d) ** 2 for k, (e, d) in enumerate(zip(error[0], spread, strict=True)) if k != 2)
    assert nees.item() == pytest.approx(expected, rel=1e-12)


def test_a_vehicle_that_sees_the_beacon_at_once_is_timed_from_its_start(monkeypatch):
    """The clock begins ten steps before the first sight; where there are none, not at the other end of the flight."""
    heard = []

    class Listener:
        def init(self, batch_shape, seed):
            return "prior"

        def step(self, state, y, *_, **__):
            heard.append(y)
            return state, None

    monkeypatch.setattr(study, "make_filter", lambda name, scene: Listener())
    seeds = make_scene(LandingSettings(runs=200, duration_s=11.0)).acquired
    settings = LandingSettings(runs=1, seed=int(seeds.argmin()))
    scene = make_scene(settings)
    assert scene.acquired.item() < 10
    study.time_one_vehicle("ukf", settings, steps=30)
    torch.testing.assert_close(torch.stack(heard), scene.measurements[:30], rtol=0, atol=0, equal_nan=True)


def test_figures_know_when_runs_end():
    """Flights of 11 s: the clock since the first sight stops with the last run, and who is gone is not away."""
    scene = make_scene(LandingSettings(runs=3, duration_s=11.0))
    values = torch.arange(440.0, dtype=torch.float64)[:, None].expand(440, 3).numpy()
    seconds, shifted = figures._since_sight(values, scene)
    early, late = int(scene.acquired.min()), int(scene.acquired.max())
    assert seconds[-1] == pytest.approx((439 - early) * scene.dt)
    assert seconds[0] == pytest.approx(-min(2.0, late * scene.dt))
    assert np.isfinite(shifted).any(1).all() and np.isnan(shifted[-1]).sum() == (scene.acquired > early).sum()
    assert np.nanmax(np.abs(shifted - (seconds[:, None] / scene.dt + scene.acquired.numpy()))) < 1e-9


def test_every_filter_can_be_made():
    scene = make_scene(LandingSettings(runs=1, duration_s=11.0))
    for name in study.FILTERS:
        assert study.make_filter(name, scene).model is (scene.world_model if "no-gauge" in name else scene.model)
    with pytest.raises(ValueError, match=r"filters must be out of .* got kalman"):
        study.make_filter("kalman", scene)


def test_the_command_line_knows_what_the_study_knows():
    assert set(run_landing.FILTERS) == set(study.FILTERS)
    assert set(run_landing.SCENARIOS) == set(SCENARIOS)


def test_wrong_use_is_told(tmp_path, capsys):
    assert run_landing.main(["--runs", "0", "--out", str(tmp_path / "a")]) == 2
    assert "runs must be at least 1, got 0" in capsys.readouterr().err
    assert run_landing.main(["--filters", "kalman", "--out", str(tmp_path / "a")]) == 2
    assert "--filters takes" in capsys.readouterr().err


# Targets --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ukf-restart", "llpf-50"])
def test_the_nominal_landing(name):
    """At least 0.99 converged, at most 0.07 m in the median, consistent."""
    settings = LandingSettings()
    scene = make_scene(settings)
    found = study.summarize(study.run_filter(name, scene, 0), scene.acquired, scene.dt)
    assert found["converged"] >= 0.99 and found["horizontal_m"][0] <= 0.07
    assert 0.8 <= found["nees"] <= 1.5


@pytest.mark.slow
def test_a_false_source_is_left_again():
    scene = make_scene(LandingSettings("false-source"))
    stuck, again = (
        study.summarize(study.run_filter(name, scene, 0), scene.acquired, scene.dt) for name in ("ukf", "ukf-restart")
    )
    assert again["converged"] >= 0.95 > stuck["converged"]
