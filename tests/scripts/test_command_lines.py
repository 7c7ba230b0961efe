"""What all command lines promise: a help that loads nothing heavy, and their exit codes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
NAMES = sorted(path.stem for path in SCRIPTS.glob("*.py") if not path.stem.startswith("_"))


def test_there_is_a_script_for_each_part() -> None:
    assert NAMES == [
        "demo",
        "run_airship",
        "run_attitude",
        "run_formation",
        "run_grace",
        "run_height",
        "run_inertial",
        "run_landing",
        "train_gp",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_help_is_complete_and_loads_nothing_heavy(name: str) -> None:
    code = (
        "import runpy, sys\n"
        f"sys.path.insert(0, {str(SCRIPTS)!r})\n"
        f"sys.argv = ['{name}.py', '--help']\n"
        "try:\n"
        f"    runpy.run_path({str(SCRIPTS / name)!r} + '.py', run_name='__main__')\n"
        "except SystemExit as stop:\n"
        "    assert stop.code == 0\n"
        "heavy = {'torch', 'gpytorch', 'pytorch_lightning', 'numpy', 'scipy', 'matplotlib', 'torchfilt'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    for word in ("examples:", "exit codes:", "Output:", "--out DIR", "--config FILE"):
        assert word in result.stdout
    assert "null" not in result.stdout and "type:" not in result.stdout
    assert max(len(line) for line in result.stdout.splitlines()) <= 80


def demo(*arguments: str | Path) -> "subprocess.Popen[str]":
    command = [sys.executable, str(SCRIPTS / "demo.py"), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ})


def finish(process: "subprocess.Popen[str]") -> tuple[int, str, str]:
    out, err = process.communicate(timeout=280)
    return process.returncode, out, err


def test_wrong_use_of_the_demo_is_code_2_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for arguments, message in (
        (["--runs", "0"], "--runs must be at least 1, got 0"),
        (["--out", tmp_path / "file"], "is not a folder"),
    ):
        code, out, err = finish(demo(*arguments))
        assert code == 2 and message in err and len(err.splitlines()) == 1 and out == ""


@pytest.mark.slow
def test_the_demo_interrupted_goes_on_and_ends_with_all_numbers(tmp_path: Path) -> None:
    arguments = ["--runs", "2", "--grace-runs", "2", "--quiet", "--out", tmp_path]
    process = demo(*arguments)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("paper/stages/cw-ukf*.npz")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130 and "the same command goes on from here" in err
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/stages/*.npz")}
    assert kept
    code, out, err = finish(demo(*arguments))
    assert code == 0, err
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    names = {"cw-pf", "cw-pf-paper-noise", "cw-ukf", "gp-ukf", "mf-upf", "mf-upf-literal", "exact-ukf"}
    assert names <= metrics["paper"].keys()
    for entry in metrics["paper"].values():
        for revolution in ("orbit1", "orbit2"):
            assert {"position_rmse_m", "velocity_rmse_m_s", "nees", "ess", "ms_per_step"} <= entry[revolution].keys()
    assert {"nominal-ukf", "gp-ukf", "mf-upf", "prediction"} <= metrics["grace"].keys()
    assert metrics["versions"]["torch"] and metrics["seeds"]
    assert "mf-upf" in out and str(tmp_path / "metrics.json") in out
    assert list(tmp_path.glob("*/figures/*.png"))
