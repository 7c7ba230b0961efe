"""The GRACE run as a whole and its command line."""

import importlib.util
import json
import subprocess
import sys
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


def test_help_loads_nothing_heavy():
    code = (
        "import runpy, sys\n"
        "sys.argv = ['run_grace.py', '--help']\n"
        "try:\n"
        f"    runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\n"
        "except SystemExit as stop:\n"
        "    assert stop.code == 0\n"
        "heavy = {'torch', 'gpytorch', 'pytorch_lightning', 'numpy', 'scipy', 'matplotlib', 'torchfilt'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    for word in ("examples:", "exit codes:", "Data:", "Model:", "Measurements:", "Output:"):
        assert word in result.stdout
    assert "null" not in result.stdout and "type:" not in result.stdout
    assert max(len(line) for line in result.stdout.splitlines()) <= 80


def test_every_setting_has_an_option_with_its_default(script):
    options = script.build_parser().parse_args([]).as_dict()
    defaults = GraceSettings()
    for field in fields(GraceSettings):
        assert options[field.name] == getattr(defaults, field.name), field.name
    own = {"config", "out", "force", "figures", "threads", "quiet", "debug"}
    assert set(options) - own == {field.name for field in fields(GraceSettings)}


def test_wrong_use_and_failures_have_their_exit_codes(script, tmp_path, capsys):
    assert script.main(["--runs", "1", "--out", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err == "run_grace.py: runs must be at least 2, got 1\n"
    (tmp_path / "metrics.json").write_text("{}")
    assert script.main(["--out", str(tmp_path)]) == 2
    assert "give --force or another --out" in capsys.readouterr().err
    assert (tmp_path / "metrics.json").read_text() == "{}"
    assert script.main(["--out", str(tmp_path / "metrics.json")]) == 2
    assert "not a folder" in capsys.readouterr().err
    assert script.main(["--folder", str(tmp_path), "--out", str(tmp_path / "b")]) == 1
    assert "grca_truth.csv.gz" in capsys.readouterr().err
    with pytest.raises(ValueError, match="runs must be at least 2"):
        script.main(["--runs", "1", "--out", str(tmp_path / "a"), "--debug"])


@pytest.mark.slow
def test_small_run_repeats_itself_and_fills_its_folder(script, tmp_path, capsys):
    arguments = ["--folder", FOLDER, "--degree", "8", "--training-hours", "3", "--tracking-hours", "3", "--runs", "2"]
    arguments += ["--particles", "12"]
    assert script.main([*arguments, "--out", str(tmp_path / "first"), "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert {path.stem for path in (tmp_path / "first" / "figures").glob("*.png")} == FIGURES
    assert (tmp_path / "first" / "two-body-phase-gp" / "gp.npz").is_file()
    # A run's settings make the same run.
    config = str(tmp_path / "first" / "settings.json")
    assert script.main(["--config", config, "--out", str(tmp_path / "second"), "--quiet", "--figures", "false"]) == 0
    assert not (tmp_path / "second" / "figures").exists()
    results = [json.loads((tmp_path / name / "metrics.json").read_text())["grace"] for name in ("first", "second")]
    first, second = (without_times(result) for result in results)
    assert first == second and first["settings"]["degree"] == 8


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
