"""The airship study: a short mission whole, its numbers, what is kept, what is refused; targets over many runs."""

import json
import math

import numpy as np
import pytest
import run_airship
import torch
from scipy.stats import chi2

from torchfilt.missions.airship import figures, navigation, study
from torchfilt.missions.airship.scene import BEACONS_M, LANDED_HEIGHT_M, LANDING_M, AirshipSettings, make_scene
from torchfilt.models.airship import Airship

SHORT = AirshipSettings(runs=2, anchored_s=12.0, cruise_s=14.0, approach_s=6.0)
NAMES = ("indirect", "indirect-no-modes")


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("airship")
    said = []
    return folder, study.run_airship(SHORT, folder, NAMES, say=said.append), said


def test_a_short_mission(outcome):
    folder, summary, said = outcome
    entry = summary["filters"]["indirect"]
    assert entry["failed"] == 0 and entry["ms_per_step"] > 0
    # Errors are as large as claimed: a mean over time has no wider tail than one sample a run, 1e-6.
    assert entry["cruise"]["nees"] < chi2.isf(1e-6, 15 * SHORT.runs) / (15 * SHORT.runs)
    assert entry["switches"] == {
        "released from the mast, heading known to 5 deg": 2,
        "released from the mast before it was aligned": 0,
        "low over the landing spot": 0,
        "climbed away from the ground": 0,
        "height lost: no echo for too long": 0,
    }
    assert summary["filters"]["indirect-no-modes"]["switches"] == {}
    assert any("run 1,  12.05 s: alignment -> cruise" in line for line in said)
    # Three steps at each second one: that of the echo, and the two since.
    heard = (~torch.isnan(make_scene(SHORT).measurements["ultrasonic"])).any(1).sum().item()
    assert 0.8 * 3 * heard < entry["refiltered"] <= 3 * heard
    assert json.loads((folder / "metrics.json").read_text()) == json.loads(json.dumps(summary))
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert drawn == {"mission.png", "errors.png", "modes.png", "compare.png"}


@pytest.mark.parametrize(
    ("name", "shown"), [("indirect", ["alignment", "cruise"]), ("indirect-no-modes", ["without modes"])]
)
def test_the_path_is_drawn_with_and_without_modes(outcome, tmp_path, monkeypatch, name, shown):
    folder, _, _ = outcome
    stored = next((folder / "stages").glob(f"{name}-????????????.npz"))
    with np.load(stored) as file:
        result = dict(file)
    scene, seen = make_scene(SHORT), {}
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: seen.setdefault(path.name, figure))
    figures.airship_figures({name: result}, scene, tmp_path)
    above, side = seen["mission.png"].axes
    labels = [line.get_label() for line in above.lines]
    assert labels[: 1 + len(shown)] == ["truth", *shown] and len(side.lines) == 1 + len(shown)
    # Together the pieces are the estimate: truth less error.
    pieces = np.nansum([line.get_ydata() for line in side.lines[1:]], 0)
    np.testing.assert_allclose(pieces, scene.truth[:, 0, 9].numpy() - result["error"][:, 0, 8], rtol=1e-12)


def test_finished_stages_are_kept(outcome):
    folder, summary, _ = outcome
    said = []
    again = study.run_airship(SHORT, folder, NAMES, say=said.append, figures=False)
    assert sum("as before" in line for line in said) == 2
    assert again["filters"] == summary["filters"]


def made_up(scene):
    """Errors of one size in each group, which the filter claims rightly; the heading is away for 2 s."""
    steps, runs = scene.truth.shape[:2]
    error = np.zeros((steps, runs, 15))
    error[..., 0], error[..., 2] = math.radians(0.3), math.radians(2.0)
    error[..., 3], error[..., 6], error[..., 7], error[..., 8] = 0.1, 0.3, 0.4, 0.2
    error[:40, :, 2] = math.radians(6.0)
    error[-20:, :, 8] = 0.05
    switch = np.full((steps, runs), -1)
    switch[300, 0] = 1
    return {
        "error": error,
        "deviation": np.full((steps, runs, 15), math.radians(1.0)),
        "nees": np.full((steps, runs), 30.0),
        "switch": switch,
        "accepted": np.ones((steps, runs, 6), bool),
        "ok": np.ones((steps, runs), bool),
        "refiltered": np.array(7),
        "cpu_s": np.full(steps, 0.002),
    }


def test_numbers_of_made_up_errors():
    scene = make_scene(AirshipSettings(runs=2, anchored_s=12.0, cruise_s=6.0, approach_s=6.0))
    result = made_up(scene)
    result["accepted"][11, 0, 1] = result["accepted"][19, 1, 4] = False
    result["ok"][5, 1] = False
    found = study.summarize(result, scene, "indirect")
    for phase in study.PHASES:
        part = found[phase]
        assert part["heading_deg"] == pytest.approx(2.0) and part["tilt_deg"] == pytest.approx(0.3)
        assert part["velocity_m_s"] == pytest.approx(0.1) and part["horizontal_m"] == pytest.approx(0.5)
        assert part["nees"] == pytest.approx(2.0) and part["heading_z"] == pytest.approx(2.0)
    assert found["cruise"]["height_m"] == pytest.approx(0.2) and found["landing_height_m"] == pytest.approx(0.05)
    assert found["aligned_s"] == pytest.approx(2.0) and found["refiltered"] == 7 and found["failed"] == 1
    assert found["switches"]["released from the mast before it was aligned"] == 1
    # Of 480 steps in two runs each second one has a barometer, each tenth one beacons; the sonar comes late.
    assert found["refused"] == {"barometer": 1 / 480, "compass": 0, "magnetometer": 0, "beacons": 1 / 96}
    assert found["ms_per_step"] == pytest.approx(2.0)
    assert study.log_lines(result, scene, "indirect") == [
        "run 0,  15.05 s: alignment -> cruise: released from the mast before it was aligned"
    ]
    result["error"][:, 0, 2] = result["error"][:, 1, 2] = 1.0
    assert study.summarize(result, scene, "indirect")["aligned_s"] is None
    assert "aligned" in "\n".join(study.table({"filters": {"indirect": found}}))


def test_nees_of_a_belief_by_hand():
    scene = make_scene(AirshipSettings(runs=1, anchored_s=1.0, cruise_s=0.0, approach_s=0.0))
    belief = navigation.make_model(scene, navigation.VARIANTS["indirect"]).prior((1,))
    error, deviation, nees = study.compare(belief, scene.truth[0])
    covariance = (belief.factor() @ belief.factor().mT)[0, :15, :15].numpy()
    expected = error[0].numpy() @ np.linalg.solve(covariance, error[0].numpy())
    assert nees.item() == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(deviation[0], np.sqrt(np.diag(covariance)), rtol=1e-12)


def test_the_command_line_knows_what_the_study_knows():
    assert set(run_airship.FILTERS) == set(study.FILTERS) and run_airship.FILTERS[:6] == study.DEFAULT


def test_wrong_use_is_told(tmp_path, capsys):
    assert run_airship.main(["--runs", "0", "--out", str(tmp_path / "a")]) == 2
    assert "runs must be at least 1, got 0" in capsys.readouterr().err
    assert run_airship.main(["--filters", "kalman", "--out", str(tmp_path / "a")]) == 2
    assert "--filters takes" in capsys.readouterr().err
    assert run_airship.main(["--filters", "indirect,indirect", "--out", str(tmp_path / "a")]) == 2
    assert "--filters takes each name once; got indirect again" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"filters must be out of .* got kalman"):
        study.run_airship(SHORT, tmp_path, ("kalman",))


# Targets --------------------------------------------------------------------------------------------------------------


def unit_vectors(place):
    """From the beacons to places (..., 3): (..., b, 3), the derivative of the ranges."""
    ray = np.asarray(place)[..., None, :] - np.array(BEACONS_M)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def one_fix(place, settings):
    """Covariance (..., 3, 3) of a place from one set of ranges, by least squares."""
    ray = unit_vectors(place)
    return np.linalg.inv(ray.swapaxes(-1, -2) @ ray) * settings.beacon_sd_m**2


def most(sd, samples):
    """What the root of a mean square of so many normal numbers stays below, but for one time in a thousand."""
    return sd * math.sqrt(chi2.isf(1e-3, samples) / samples)


@pytest.mark.slow
def test_a_whole_mission():
    """All runs pass through all modes for the stated reasons, land within centimetres and claim what they are worth.

    Errors of a run are alike for a long time: bands are those of one independent sample a run and phase, 99.9 %. How
    small errors are follows from the sensors: who has all readings knows no less than who has the last one alone.
    """
    settings = AirshipSettings(runs=10)
    scene = make_scene(settings)
    found = study.summarize(study.run_filter("indirect", scene), scene, "indirect")
    assert found["failed"] == 0
    assert found["switches"]["released from the mast, heading known to 5 deg"] == 10
    assert found["switches"]["low over the landing spot"] == 10
    low, high = chi2.ppf([0.0005, 0.9995], 15 * settings.runs) / (15 * settings.runs)
    for phase in ("cruise", "approach"):
        assert low < found[phase]["nees"] < high
    # The heading is one number, alike for a whole phase: 99.9 % of its mean square over ten runs.
    low, high = (math.sqrt(chi2.ppf(p, settings.runs) / settings.runs) for p in (0.0005, 0.9995))
    assert low < found["cruise"]["heading_z"] < high and low < found["approach"]["heading_z"] < high
    # Place: one set of ranges over the spot. Height: one echo, 1 cm and 0.5 % of the distance.
    gondola_m = LANDED_HEIGHT_M + Airship().gondola_height_m
    fix = one_fix([*LANDING_M, gondola_m], settings)
    assert found["approach"]["horizontal_m"] < most(math.sqrt(fix[0, 0] + fix[1, 1]), 2 * settings.runs)
    assert found["landing_height_m"] < most(0.01 + 0.005 * gondola_m, settings.runs)
    # Heading: a compass alone is off by what the hard iron turns the level field, and that by luck seldom so little.
    compass = math.degrees(settings.hard_iron_sd_ut / np.hypot(*navigation.earth_field_ut()[:2].tolist()))
    assert found["approach"]["heading_deg"] < compass * math.sqrt(chi2.ppf(1e-3, settings.runs) / settings.runs)


@pytest.mark.slow
def test_late_readings_taken_for_new_leave_a_bias():
    """A reading that is 0.3 s old is too high by what the ship has sunk since, and the height by the sonar's share.

    In a steady state innovations of sensors that show the same height cancel, each weighted by its information: the
    offset of one is passed on by its share in the sum, here 0.98 beside the beacons; the barometer's own offset is
    unknown, it has none. Mean errors to four standard errors of the claimed deviation, one sample a run: 6e-5 each.
    """
    settings = AirshipSettings(runs=6, anchored_s=15.0, cruise_s=20.0, approach_s=60.0, ultrasonic_delay_s=0.3)
    scene = make_scene(settings)
    truth, steps = scene.truth.numpy(), round(0.3 / scene.dt)
    sinking = ((scene.phase == 2) & (scene.truth[..., 6].mean(1) < -0.12)).numpy()
    assert sinking.sum() > 40
    place, echoes = truth[sinking][..., 7:10], scene.measurements["ultrasonic"][sinking].isfinite().double().mean()
    ranges = scene.measurements["beacons"][sinking].isfinite().double().mean()
    sonar = (echoes / (0.01 + 0.005 * place[..., 2].mean()) ** 2).item()
    beacons = (ranges / one_fix(place, settings)[..., 2, 2].mean()).item()
    sunk = np.mean(truth[np.flatnonzero(sinking) - steps, :, 9] - place[..., 2])
    for name, bias in (("indirect", 0.0), ("indirect-late-as-new", -sunk * sonar / (sonar + beacons))):
        result = study.run_filter(name, scene)
        error, claimed = (result[part][sinking][..., 8].mean() for part in ("error", "deviation"))
        spread = 4 * claimed / math.sqrt(settings.runs)
        assert abs(error - bias) < spread, (name, error, bias)
    assert -bias > 2 * spread
