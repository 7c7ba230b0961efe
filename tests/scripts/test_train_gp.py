"""The command line of GP training: help, exit codes, signals, kills."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "train_gp.py"
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("train_gp", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Arguments of a short training on a small log."""
    path = tmp_path_factory.mktemp("logs") / "log.npz"
    generator = np.random.default_rng(0)
    x, u = generator.standard_normal((60, 2)), generator.uniform(0, 6.3, (60, 1))
    turned = np.stack([-x[:, 1], x[:, 0]], 1) * (1 + 0.5 * np.cos(u))
    np.savez(path, x=x, u=u, x_next=x + 0.1 * turned + 1e-4 * generator.standard_normal((60, 2)), dt=1.0)
    return ["--source", str(path), "--phase-column", "0", "--figures", "false"]


def command(*arguments, **options):
    line = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, env=ENVIRONMENT, timeout=120, **options)


def test_every_setting_has_an_option(script):
    from dataclasses import fields

    from torchfilt.learning.run import RunSettings

    options = script.parse([])
    names = {field.name for field in fields(RunSettings)}
    assert set(options) == names | {"quiet", "debug", "threads"}
    defaults = RunSettings()
    assert all(options[name] == getattr(defaults, name) for name in names)


def test_examples_of_the_help_parse(script):
    lines = [line.split()[1:] for line in script.EXAMPLES.splitlines() if line.startswith("    train_gp.py")]
    assert len(lines) >= 7
    for arguments in lines:
        if "--config" not in arguments:
            script.parse(arguments)


def test_exit_codes(script, tmp_path, log, capsys):
    assert script.main([*log, "--out", str(tmp_path / "a"), "--epochs", "2", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert script.main([*log, "--out", str(tmp_path / "a"), "--epochs", "2"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and told.startswith("train_gp.py: ") and "--force" in told
    with pytest.raises(SystemExit) as stopped:
        script.main(["--nominal", "newton"])
    assert stopped.value.code == 2
    assert "'two-body', 'ltv', 'cw', 'none'" in capsys.readouterr().err
    assert script.main(["--source", str(tmp_path / "absent.npz"), "--out", str(tmp_path / "b")]) == 2
    assert "neither 'cloud', 'arcs', 'trajectory' nor a file" in capsys.readouterr().err
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04")
    assert script.main(["--source", str(tmp_path / "broken.npz"), "--out", str(tmp_path / "b")]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "broken.npz: cannot be read" in told
    assert not (tmp_path / "b").exists()  # nothing is left of a run that never began
    with pytest.raises(ValueError, match="cannot be read"):
        script.main(["--source", str(tmp_path / "broken.npz"), "--out", str(tmp_path / "b"), "--debug"])


def test_report_and_quiet(script, tmp_path, log, capsys):
    assert script.main([*log, "--out", str(tmp_path / "a"), "--epochs", "3"]) == 0
    out = capsys.readouterr().out
    assert "48 pairs from" in out and "held_out" in out and "z is error" in out
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert format(metrics["one_step"]["held_out"]["state"]["rms"], ".2e") in out


def test_settings_file_repeats_a_run(script, tmp_path, log):
    assert script.main([*log, "--out", str(tmp_path / "a"), "--noise-floor", "1e-3", "--quiet"]) == 0
    config = str(tmp_path / "a" / "settings.json")
    assert script.main(["--config", config, "--out", str(tmp_path / "b"), "--quiet"]) == 0
    assert (tmp_path / "a" / "gp.npz").read_bytes() == (tmp_path / "b" / "gp.npz").read_bytes()


def test_resume_needs_no_other_option(script, tmp_path, log):
    folder = str(tmp_path / "a")
    options = ["--noise-floor", "1e-3", "--optimizer", "adam"]
    assert script.main([*log, *options, "--out", folder, "--epochs", "3", "--quiet"]) == 0
    assert script.main(["--resume", "--out", folder, "--epochs", "5", "--quiet"]) == 0
    assert json.loads((tmp_path / "a" / "metrics.json").read_text())["training"]["epochs"] == 5
    (tmp_path / "a").rename(tmp_path / "moved")
    assert script.main(["--resume", "--out", str(tmp_path / "moved"), "--quiet"]) == 0
    assert script.main(["--resume", "--out", folder, "--quiet"]) == 2  # nothing there any more


def test_sparse_gp_with_adam_minibatches_and_tensorboard(script, tmp_path, log):
    sparse = ["--inducing", "10", "--batch-size", "16", "--noise-floor", "1e-2", "--epochs", "5", "--tensorboard"]
    assert script.main([*log, *sparse, "--out", str(tmp_path), "--quiet"]) == 0
    events = list((tmp_path / "tensorboard-1").glob("events*"))
    assert len(events) == 1 and b"loss" in events[0].read_bytes()
    rows = (tmp_path / "log-1" / "metrics.csv").read_text().splitlines()
    assert len(rows) == 6
    assert json.loads((tmp_path / "settings.json").read_text())["optimizer"] == "adam"


def test_flipped_byte_in_the_checkpoint_is_refused(script, tmp_path, log, capsys):
    assert script.main([*log, "--out", str(tmp_path), "--epochs", "2", "--quiet"]) == 0
    path = tmp_path / "last.ckpt"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    assert script.main(["--resume", "--out", str(tmp_path), "--quiet"]) == 1
    assert "truncated or altered" in capsys.readouterr().err


def test_stop_remembers_one_signal_and_ends_at_the_second(script, capsys):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with script.AfterEpoch() as stop:
        assert not stop()
        signal.raise_signal(signal.SIGTERM)
        assert stop() and stop.received == signal.SIGTERM
        with pytest.raises(SystemExit) as ended:
            signal.raise_signal(signal.SIGINT)
        assert ended.value.code == 130
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert "stopping after this epoch" in capsys.readouterr().err


# Many short epochs, each with its checkpoint: long enough to be hit in the middle, on any machine.
LONG = ["--optimizer", "adam", "--epochs", "80", "--learning-rate", "0.01"]
LONG_SPARSE = [*LONG, "--inducing", "10", "--batch-size", "12", "--noise-floor", "1e-2"]


def start(folder, *arguments):
    line = [sys.executable, str(SCRIPT), "--out", str(folder), *arguments]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)


def wait_for_change(path, process, seconds=60.0):
    """Until the file appears or is replaced; False where the process ended before."""
    before = path.stat().st_mtime_ns if path.exists() else None
    limit = time.monotonic() + seconds
    while time.monotonic() < limit:
        if path.exists() and path.stat().st_mtime_ns != before:
            return True
        if process.poll() is not None:
            return False
        time.sleep(0.002)
    raise AssertionError(f"no checkpoint within {seconds} s")


def same_run(a, b):
    """The same frozen GP, bit for bit, and the same metrics but for the time they took."""
    assert (a / "gp.npz").read_bytes() == (b / "gp.npz").read_bytes()
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (a, b)]
    for one in metrics:
        one["training"].pop("seconds")
        one.pop("versions")  # they tell whether the source was edited since its last commit
    assert metrics[0] == metrics[1]


@pytest.fixture(scope="module")
def whole(script, tmp_path_factory, log):
    """Folder of an uninterrupted run with given options, made once."""
    made = {}

    def get(*options):
        if options not in made:
            made[options] = tmp_path_factory.mktemp("whole") / "run"
            assert script.main([*log, *options, "--out", str(made[options]), "--quiet"]) == 0
        return made[options]

    return get


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "options"),
    [(signal.SIGINT, 130, LONG), (signal.SIGTERM, 143, LONG), (signal.SIGTERM, 143, LONG_SPARSE)],
    ids=["SIGINT", "SIGTERM", "SIGTERM-minibatches"],
)
def test_signals_save_and_the_run_goes_on(tmp_path, log, whole, number, code, options):
    process = start(tmp_path / "cut", *log, *options)
    assert wait_for_change(tmp_path / "cut" / "last.ckpt", process)
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == code, told
    assert "stopping after this epoch" in told and "--resume --out" in told and "Traceback" not in told
    assert not (tmp_path / "cut" / "gp.npz").exists()
    assert command("--resume", "--out", tmp_path / "cut").returncode == 0
    same_run(whole(*options), tmp_path / "cut")


@pytest.mark.slow
@pytest.mark.parametrize("options", [LONG, LONG_SPARSE], ids=["exact", "minibatches"])
def test_killed_again_and_again_a_run_ends_in_the_same_bits(tmp_path, log, whole, options):
    folder, kills = tmp_path / "killed", 0
    for delay in (0.0, 0.03, 0.11):
        process = start(folder, *log, *options) if not folder.exists() else start(folder, "--resume")
        if wait_for_change(folder / "last.ckpt", process):
            time.sleep(delay)
            process.kill()
        process.communicate(timeout=60)
        kills += process.returncode == -signal.SIGKILL
    assert kills >= 2
    assert not (folder / "metrics.json").exists()
    result = command("--resume", "--out", folder)
    assert result.returncode == 0, result.stderr
    same_run(whole(*options), folder)


@pytest.mark.slow
def test_killed_at_the_start_a_run_begins_anew(tmp_path, log, whole):
    process = start(tmp_path / "cut", *log)
    assert wait_for_change(tmp_path / "cut" / "settings.json", process)
    process.kill()
    process.communicate(timeout=60)
    assert command("--resume", "--out", tmp_path / "cut").returncode == 0
    same_run(whole(), tmp_path / "cut")
