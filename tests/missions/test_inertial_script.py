"""scripts/run_inertial.py as its user meets it: exit codes, messages, going on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "run_inertial.py"
SMALL = ["--runs", "2", "--steps", "4", "--particles", "20", "--conditional-particles", "5", "--window", "2"]


def run(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=240, check=False)
    return done.returncode, done.stdout, done.stderr


def test_it_runs_refuses_to_overwrite_and_goes_on(tmp_path):
    chosen = [*SMALL, "--filters", "es-kf,rpf", "--figures", "false", "--out", tmp_path]
    code, out, err = run(*chosen)
    assert code == 0 and err == "" and "without fixes the system is off by" in out
    first = json.loads((tmp_path / "metrics.json").read_text())
    assert list(first["filters"]) == ["es-kf", "rpf"] and first["settings"]["steps"] == 4
    code, out, err = run(*SMALL, "--out", tmp_path)
    assert code == 2 and "is not empty: --resume goes on with it, --force overwrites it" in err and out == ""
    code, out, err = run(*chosen, "--resume")
    assert code == 0 and out.count("as before") == 2
    assert json.loads((tmp_path / "metrics.json").read_text()) == first
    code, out, err = run(*chosen, "--force", "--quiet", "--threads", "1", "--scenario", "outliers")
    assert code == 0 and out == "" and json.loads((tmp_path / "metrics.json").read_text())["scenario"] == "outliers"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--filters", "ekf"], "--filters takes es-kf,"),
        (["--steps", "1001"], "steps must be from 1 to 1000"),
        (["--scenario", "sea"], "invalid choice"),
        (["--scenario", "car", "--filters", "rpf"], "--filters takes es-kf,es-kf-constraint,ckf-constraint; got rpf"),
        (["--scenario", "uav", "--steps", "50"], "--steps belongs to a simulated flight, the scenario uav is a log"),
        (["--data", "data/car_urban_loop"], "--data belongs to a log, the scenario sins-sar is simulated"),
    ],
)
def test_wrong_use_is_code_2_in_one_line(tmp_path, arguments, message):
    code, out, err = run(*arguments, "--out", tmp_path / "run")
    assert code == 2 and message in err and "Traceback" not in err and out == ""
    assert not (tmp_path / "run").exists()


def test_the_script_and_the_library_know_the_same_names():
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        import run_inertial as script
    finally:
        sys.path.pop(0)
    from torchfilt.missions.inertial import FILTERS, LOGS, SCENARIOS
    from torchfilt.missions.inertial.log_scene import VARIANTS

    assert script.FILTERS == FILTERS and (*SCENARIOS, *LOGS) == script.SCENARIOS
    assert {log: tuple(variants) for log, variants in VARIANTS.items()} == script.VARIANTS
