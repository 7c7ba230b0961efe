"""scripts/run_attitude.py as its user meets it: exit codes, messages, going on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "run_attitude.py"
SMALL = ["--scenario", "descent", "--data", ROOT / "data" / "rocket_descent", "--stop-s", "95"]


def run(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=240, check=False)
    return done.returncode, done.stdout, done.stderr


def test_it_runs_refuses_to_overwrite_and_goes_on(tmp_path):
    chosen = [*SMALL, "--filters", "baro-ukf,baro-ekf", "--figures", "false", "--out", tmp_path]
    code, out, err = run(*chosen)
    assert code == 0 and err == "" and "without barometer for" in out
    first = json.loads((tmp_path / "metrics.json").read_text())
    assert list(first["filters"]) == ["baro-ukf", "baro-ekf"] and first["settings"]["stop_s"] == 95
    code, out, err = run(*chosen)
    assert code == 2 and "is not empty: --resume goes on with it, --force overwrites it" in err and out == ""
    code, out, err = run(*chosen, "--resume")
    assert code == 0 and out.count("as before") == 2
    assert json.loads((tmp_path / "metrics.json").read_text()) == first
    code, out, err = run(*chosen, "--force", "--quiet", "--threads", "1", "--seed", "3", "--particles", "7")
    assert code == 0 and out == "" and not list(tmp_path.glob("figures/*"))
    settings = json.loads((tmp_path / "metrics.json").read_text())["settings"]
    assert (settings["seed"], settings["particles"]) == (3, 7)


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "folder"), [("imu-mag", "imu_mag_mocap"), ("stars", "starry_night")])
def test_each_scenario_has_its_study(tmp_path, scenario, folder):
    data = ROOT / "data" / folder
    options = ["--scenario", scenario, "--data", data, "--stop-s", "6", "--filters", "mekf", "--figures", "false"]
    code, out, err = run(*options, "--out", tmp_path)
    assert code == 0 and "mekf: " in out, err
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert list(found["filters"]) == ["mekf"] and found["settings"]["data"] == str(data)
    code, out, err = run(*options, "--out", tmp_path, "--resume")
    assert code == 0 and "mekf: as before" in out, err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--filters", "ekf"], "--filters takes mekf,ukf,llpf; got ekf"),
        (["--scenario", "descent", "--filters", "mekf"], "--filters takes baro-ekf,baro-ukf,imu-mekf,"),
        (["--scenario", "sea"], "invalid choice"),
        (["--particles", "0"], "particles must be positive and finite, got 0"),
        (["--scenario", "stars", "--stop-s", "0"], "stop_s"),
        (["--scenario", "descent", "--stop-s", "50"], "a gap of 30.0 s has no room in -10 s"),
        (["--resume", "--force"], "give one of them"),
    ],
)
def test_wrong_use_is_code_2_in_one_line(tmp_path, arguments, message):
    code, out, err = run(*arguments, "--out", tmp_path / "run")
    assert code == 2 and message in err and "Traceback" not in err and out == ""
    assert not (tmp_path / "run").exists()


def test_a_missing_log_is_code_1(tmp_path):
    code, _, err = run("--scenario", "descent", "--data", tmp_path / "none", "--out", tmp_path / "run")
    assert code == 1 and "none" in err and len(err.splitlines()) == 1


def test_the_script_and_the_library_know_the_same_names():
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        import run_attitude as script
    finally:
        sys.path.pop(0)
    from torchfilt.missions.attitude import descent, imu_mag, stars

    libraries = {"imu-mag": imu_mag, "stars": stars, "descent": descent}
    assert {name: module.FILTERS for name, module in libraries.items()} == script.FILTERS
