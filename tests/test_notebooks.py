"""Notebooks and the README's examples run as they stand."""

import re
import runpy
from pathlib import Path

import pytest

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
