"""Notebooks and the examples of the README and of orientations run as they stand."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
import torch

import torchfilt as tf
from torchfilt.testing import check_symmetry

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_runs(path: Path) -> None:
    runpy.run_path(str(path))


def test_the_readmes_example_runs_and_prints_what_the_readme_says(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert blocks, "the README has a Python example"
    assert len(blocks[0].strip().splitlines()) <= 32
    exec(compile(blocks[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out
    errors = dict(re.findall(r"^(\w+): error ([\d.]+) rad", printed, flags=re.MULTILINE))
    claimed = dict(re.findall(r"^(\w+): error ([\d.]+) rad", text, flags=re.MULTILINE))
    assert errors.keys() == claimed.keys() == {"known", "learned"}
    for name, value in claimed.items():
        # Two digits: the last bits of the training may differ between machines, the claim may not.
        assert float(errors[name]) == pytest.approx(float(value), rel=0.05)


def test_the_example_on_modes_prints_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    section = (ROOT / "docs" / "filters.md").read_text().split("\n## Modes\n")[1].split("\n## ")[0]
    example, printed = re.findall(r"```(?:python)?\n(.*?)```", section, flags=re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(example, "docs/filters.md", "exec"), names)
    assert capsys.readouterr().out == printed
    history, truth = names["history"], names["truth"]
    # The sonar's 2 cm count at the end of the first row only; what the barometer alone knows is within 1 m.
    assert abs(float(history.mean[-1, 0, 0] - truth[-1, 0])) < 0.06
    assert abs(float(history.mean[-1, 1, 0] - truth[-1, 1])) < 1.0


def test_the_examples_on_sensors_print_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "sensors.md").read_text()
    blocks = re.findall(r"```(?:python)?\n(.*?)```", text, flags=re.DOTALL)
    for example, printed in zip(blocks[::2], blocks[1::2], strict=True):
        names: dict[str, Any] = {}
        exec(compile(example, "docs/sensors.md", "exec"), names)
        assert capsys.readouterr().out == printed
        if "found" in names and "truth" in names:  # a descent
            off = (names["found"] - names["truth"])[[9, 17]].abs()
            assert (off < 4 * names["sd"][[8, 16]]).all() and off[0] < 0.05


def test_the_examples_on_orientations_run_and_agree() -> None:
    """One block after the other; every filter that they make goes on with the measurements of the first."""
    text = (ROOT / "docs" / "attitude_filters.md").read_text()
    names = {"tf": tf, "torch": torch}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(compile(block, "docs/attitude_filters.md", "exec"), names)
    rolling = tf.UnscentedKalmanFilter(
        tf.StateSpaceModel(names["prior"], names["model"].transition, names["rolling"]), iterations=5
    )
    found = {}
    for name, tracker in {key: names[key] for key in ("mekf", "bank", "imm", "gated", "safe")}.items():
        state, info = tracker.step(tracker.init(), names["z"], names["rate"], 0.02)
        assert info.ok, name
        found[name] = state.belief.mean
    state, _ = rolling.step(rolling.init(), {"accelerometer": names["up"]}, names["rate"], 0.02)
    # The body is level with its nose north, and filters start there: they stay. Pieces of the bank start far off.
    found["rolling"] = state.belief.mean
    del found["bank"]
    for name, mean in found.items():
        torch.testing.assert_close(mean, names["mean"], rtol=0, atol=1e-3, msg=name)
    tilt = tf.UnscentedKalmanFilter(names["tilt"])
    assert tilt.step(tilt.init(), names["up"], names["rate"], 0.02)[1].ok
    points = names["prior"].space.retract(names["mean"], 0.3 + 0.3 * torch.eye(6, dtype=torch.float64))
    check_symmetry(names["tilt"], points, names["rate"], 0.02)
