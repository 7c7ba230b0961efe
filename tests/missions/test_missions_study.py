"""The loop that the studies share, on made-up filters: what is kept, told, written and refused."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from torchfilt.missions.stages import check_names
from torchfilt.missions.study import digest, run_study


@dataclass(frozen=True)
class Settings:
    scale: float = 2.0


def run(folder, names, **options):
    """Two filters: one tells the CPU time of each step, the other of all; returns summary, lines, who was run."""
    said, followed = [], []

    def follow(name):
        followed.append(name)
        seconds = np.array([0.5, 0.75]) if name == "slow" else np.array(0.25)
        return {"error": np.full(3, len(name) * 2.0), "cpu_s": seconds}

    options = {
        "recipe": lambda name: {"scale": 2.0},
        "table": lambda summary: [f"{name} {row['worst']}" for name, row in summary["filters"].items()],
        "draw": None,
        **options,
    }
    summary = run_study(
        names,
        Settings(),
        folder,
        follow=follow,
        summarize=lambda name, result: {"worst": float(result["error"].max()), "letters": len(name)},
        say=said.append,
        **options,
    )
    return summary, said, followed


def test_a_run_is_told_and_written(tmp_path):
    summary, said, _ = run(tmp_path, ("slow", "ukf"))
    assert said == ["slow: 1.2 s of CPU", "ukf: 0.2 s of CPU", "slow 8.0", "ukf 6.0"]
    assert list(summary) == ["filters", "settings", "versions"] and summary["settings"] == {"scale": 2.0}
    assert summary["filters"]["ukf"] == {"worst": 6.0, "letters": 3}
    assert json.loads((tmp_path / "metrics.json").read_text()) == summary
    assert (tmp_path / "table.txt").read_text() == "slow 8.0\nukf 6.0\n"
    assert not (tmp_path / "figures").exists()


def test_what_a_study_adds_of_its_own(tmp_path):
    def draw(results, folder):
        return [folder / f"{name}-{len(result['error'])}.png" for name, result in results.items()]

    summary, said, _ = run(
        tmp_path,
        ("ukf",),
        what="variants",
        more={"scenario": "calm"},
        table=lambda summary: [summary["scenario"], *summary["variants"]],
        notes=lambda results: ["", f"{len(results)} log"],
        draw=draw,
    )
    assert list(summary) == ["scenario", "variants", "settings", "versions"]
    assert (tmp_path / "table.txt").read_text() == "calm\nukf\n\n1 log\n"
    assert said[1:] == ["calm", "ukf", "", "1 log", f"wrote {tmp_path / 'figures' / 'ukf-3.png'}"]


def test_only_a_filter_whose_recipe_changed_is_run_again(tmp_path):
    first, _, followed = run(tmp_path, ("slow", "ukf"))
    assert followed == ["slow", "ukf"]
    again, said, followed = run(
        tmp_path, ("slow", "ukf"), recipe=lambda name: {"scale": 2.0} | ({"window": 3} if name == "ukf" else {})
    )
    assert followed == ["ukf"] and said[:2] == ["slow: as before", "ukf: 0.2 s of CPU"]
    assert again["filters"] == first["filters"]


def test_logs_that_differ_have_different_digests():
    def log(last=3.0, name="a", rate=50):
        return torch.tensor([1.0, last]), (torch.tensor([last]), None), name, rate

    found = {digest(log(**change)) for change in ({}, {"last": 4.0}, {"name": "b"}, {"rate": 51})}
    assert len(found) == 4 and digest(log()) in found
    # Tensors too long for their text to show every number are told apart, in parts too.
    long = torch.zeros(5000)
    changed = long.clone()
    changed[2500] = 1.0
    assert digest([(long,)]) != digest([(changed,)]) and digest([long]) != digest([changed])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "filters must be out of ukf, ekf, got none"),
        (("ukf", "pf", "kf"), "filters must be out of ukf, ekf, got pf, kf"),
        (("ukf", "ekf", "ukf", "ukf"), "filters must be given once each, got ukf again"),
    ],
)
def test_names_that_are_missing_unknown_or_given_twice_are_refused(names, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        check_names(names, ("ukf", "ekf"), "filters")
    check_names(("ekf", "ukf"), ("ukf", "ekf"), "filters")
