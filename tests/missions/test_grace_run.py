"""The GRACE run as a whole and its command line."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest

from torchfilt.missions.grace.settings import GraceSettings

REPOSITORY = Path(__file__).parents[2]
SCRIPT = REPOSITORY / "scripts" / "run_grace.py"
FOLDER = str(REPOSITORY / "data" / "grace_2010")
FIGURES = {"prediction", "bias", "outages"} | {f"{q}_{c}" for q in ("position", "velocity") for c in ("kband", "radar")}


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("run_grace", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_setting_has_an_option_with_its_default(script):
    options = script.build_parser().parse_args([]).as_dict()
    defaults = GraceSettings()
    for field in fields(GraceSettings):
        assert options[field.name] == getattr(defaults, field.name), field.name
    own = {"config", "out", "force", "resume", "figures", "threads", "quiet", "debug"}
    assert set(options) - own == {field.name for field in fields(GraceSettings)}


def test_wrong_use_and_failures_have_their_exit_codes(script, tmp_path, capsys):
    assert script.main(["--runs", "0", "--out", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err == "run_grace.py: runs must be at least 1, got 0\n"
    (tmp_path / "settings.json").write_text("{}")
    assert script.main(["--out", str(tmp_path)]) == 2
    assert "--resume goes on with it, --force overwrites it" in capsys.readouterr().err
    assert script.main(["--out", str(tmp_path), "--resume", "--force"]) == 2
    assert "give one of them" in capsys.readouterr().err
    assert (tmp_path / "settings.json").read_text() == "{}"
    assert script.main(["--out", str(tmp_path / "settings.json")]) == 2
    assert "not a folder" in capsys.readouterr().err
    assert script.main(["--folder", str(tmp_path), "--out", str(tmp_path / "b")]) == 1
    assert "grca_truth.csv.gz" in capsys.readouterr().err
    with pytest.raises(script.UsageError, match="runs must be at least 1"):
        script.main(["--runs", "0", "--out", str(tmp_path / "a"), "--debug"])


SMALL = ["--folder", FOLDER, "--degree", "8", "--training-hours", "3", "--tracking-hours", "3", "--runs", "2"]
SMALL += ["--particles", "12"]


@pytest.mark.slow
def test_small_run_fills_its_folder_and_repeats_itself(script, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    assert script.main([*SMALL, "--out", str(first), "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert {path.stem for path in (first / "figures").glob("*.png")} == FIGURES
    assert "gp-ukf" in (first / "table.txt").read_text()
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics["seeds"] == [0] and metrics["versions"]["torch"]
    assert metrics["grace"]["settings"]["degree"] == 8
    # A run's settings make the same run.
    config = str(first / "settings.json")
    assert script.main(["--config", config, "--out", str(second), "--quiet", "--figures", "false"]) == 0
    assert not (second / "figures").exists()
    again = json.loads((second / "metrics.json").read_text())
    assert without_times(again) == without_times(metrics)
    # Resumed, all parts are found: even their times are the same.
    assert script.main([*SMALL, "--out", str(second), "--resume", "--figures", "false"]) == 0
    resumed = json.loads((second / "metrics.json").read_text())["grace"]
    assert resumed.pop("seconds") < again["grace"].pop("seconds")
    assert resumed == again["grace"]
    assert "held-out hours" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_goes_on(tmp_path, number):
    line = [sys.executable, str(SCRIPT), *SMALL, "--out", str(tmp_path), "--quiet", "--figures", "false"]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    begin = time.monotonic()
    while not list((tmp_path / "stages").glob("*phase-gp*.npz")) and time.monotonic() - begin < 120:
        time.sleep(0.02)
    process.send_signal(number)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "go on with --resume" in message
    assert not (tmp_path / "metrics.json").exists()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "stages").glob("*.npz")}
    done = subprocess.run([*line, "--resume"], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "metrics.json").is_file()
    assert kept and all(path.stat().st_mtime_ns == when for path, when in kept.items())


def without_times(value):
    if isinstance(value, dict):
        return {key: without_times(v) for key, v in value.items() if key not in ("seconds", "ms_per_step")}
    return value


@pytest.mark.slow
def test_val_learned_dynamics_on_the_real_log():
    """The claims of docs/grace.md, with room for other processors' rounding and for the machine's noise of a run."""
    from torchfilt.missions.grace.campaign import run

    lines = []
    result = run(GraceSettings(folder=FOLDER), say=lines.append)
    json.dumps(result, allow_nan=False)
    gains, prediction = result["prediction"]["gains"], result["prediction"]
    potential = gains["j2-potential-gp"]
    assert potential["median_15_min"] > 12 and potential["median_94_min"] > 8
    assert potential["one_step_velocity_m_s"] > 2.5 and potential["one_step_velocity_median_m_s"] > 5
    phase = gains["two-body-phase-gp"]
    assert phase["one_step_velocity_m_s"] > 30 and phase["median_15_min"] > 30 and phase["median_94_min"] > 80
    # The phase alone cannot see where the Earth stands under the orbit.
    assert 0.9 < gains["j2-phase-gp"]["median_15_min"] < 1.1
    for group in ("position_m", "velocity_m_s"):
        assert 0.7 < prediction["j2-potential-gp"]["one_step"][group]["z"] < 1.3
    nominal, learned, particles = (result[name] for name in ("nominal-ukf", "gp-ukf", "mf-upf"))
    assert nominal["in_plane_rmse_m"] > 4 * learned["in_plane_rmse_m"]
    assert nominal["outage_end"]["in_plane_rmse_m"] > 6 * learned["outage_end"]["in_plane_rmse_m"]
    assert nominal["radar"]["in_plane_rmse_m"] > 2.5 * learned["radar"]["in_plane_rmse_m"]
    assert learned["position_rmse_m"] < nominal["position_rmse_m"]
    for own in (nominal, learned, particles):
        for part in (own, own["radar"]):
            assert 1.5 < part["nees"] < 9
            assert set(part) >= {"position_rmse_m", "velocity_rmse_m_s", "nees", "ess", "ms_per_step"}
        assert abs(own["bias"]["estimate_m"] - result["recorded_bias_m"]) < 3 * own["bias"]["sd_m"]
    assert particles["in_plane_rmse_m"] < 1.2 * learned["in_plane_rmse_m"]
    assert 0.5 * 100 < particles["ess"] < 100
    assert any("95 % band" in line for line in lines)
