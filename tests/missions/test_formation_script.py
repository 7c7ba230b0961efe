"""scripts/run_formation.py as its user meets it: exit codes, messages, interruption and going on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "run_formation.py"
SMALL = ["--runs", "2", "--steps", "130", "--particles", "20", "--samples", "100", "--bootstrap-particles", "200"]


def start(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def run(*arguments):
    process = start(*arguments)
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def test_it_runs_refuses_to_overwrite_and_goes_on(tmp_path):
    code, out, err = run(*SMALL, "--filters", "cw-ukf,gp-ukf", "--figures", "false", "--out", tmp_path)
    assert code == 0 and err == "" and "gp-ukf" in out and "Cramér-Rao bound" in out
    first = json.loads((tmp_path / "metrics.json").read_text())
    code, out, err = run(*SMALL, "--out", tmp_path)
    assert code == 2 and "is not empty: --resume goes on with it, --force overwrites it" in err and out == ""
    code, out, err = run(*SMALL, "--filters", "cw-ukf,gp-ukf", "--figures", "false", "--out", tmp_path, "--resume")
    assert code == 0 and out.count("as before") == 3
    assert json.loads((tmp_path / "metrics.json").read_text()) == first


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--filters", "ekf"], "--filters takes cw-pf,"),
        (["--runs", "0"], "runs must be at least 1, got 0"),
        (["--resume", "--force"], "give one of them"),
        (["--case", "other"], "invalid choice"),
    ],
)
def test_wrong_use_is_code_2_in_one_line(tmp_path, arguments, message):
    code, out, err = run(*arguments, "--out", tmp_path / "run")
    assert code == 2 and message in err and "Traceback" not in err and out == ""
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done(tmp_path):
    arguments = [
        "--runs",
        "10",
        "--filters",
        "cw-ukf,mf-upf",
        "--samples",
        "100",
        "--figures",
        "false",
        "--out",
        tmp_path,
    ]
    process = start(*arguments)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("stages/cw-ukf-*.npz")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "go on with --resume" in err and "Traceback" not in err
    assert not (tmp_path / "metrics.json").exists()
    code, out, _ = run(*arguments, "--resume")
    assert code == 0 and out.count("as before") >= 2
