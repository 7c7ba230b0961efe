"""Checkpoints: whole or refused, and never code."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchfilt.learning.checkpoint import FILE_KIND, AtomicCheckpointIO, load_checkpoint, save_checkpoint
from torchfilt.storage import IntegrityError, manifest_path, write_verified


def test_round_trip_of_plain_values(tmp_path):
    path = tmp_path / "a.ckpt"
    content = {
        "w": torch.arange(3.0),
        "where": Path("x/y"),
        "number": np.float64(2.5),
        "array": np.arange(4),
        "nested": [{"a": (1, None)}, {2}],
        "dtype": torch.float64,
    }
    save_checkpoint(content, path)
    loaded = load_checkpoint(path)
    assert torch.equal(loaded["w"], content["w"]) and loaded["where"] == "x/y" and loaded["number"] == 2.5
    assert torch.equal(loaded["array"], torch.arange(4)) and loaded["nested"] == [{"a": (1, None)}, {2}]
    assert loaded["dtype"] is torch.float64
    with pytest.raises(TypeError, match=r"checkpoint\['f'\].*function"):
        save_checkpoint({"f": pairs_of}, path)
    assert torch.equal(load_checkpoint(path)["w"], content["w"])  # a failed save leaves the old file


def pairs_of():
    """Something that is not data."""


class Canary:
    """Unpickling writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.system, (f"touch {self.path}",))


@pytest.mark.parametrize("override", [None, "1"])
@pytest.mark.parametrize("disguise", ["raw", "with manifest", "torch"])
def test_hostile_pickle_is_refused_before_it_runs(tmp_path, monkeypatch, override, disguise):
    if override:
        monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", override)
    path, canary = tmp_path / "evil.ckpt", tmp_path / "ran"
    if disguise == "torch":
        torch.save({"state_dict": Canary(canary)}, path)
        data = path.read_bytes()
    else:
        data = pickle.dumps({"state_dict": Canary(canary)})
    path.write_bytes(data)
    if disguise != "raw":  # an attacker can compute a digest too; the loader itself must refuse
        write_verified(path, data, FILE_KIND)
    for load in (load_checkpoint, AtomicCheckpointIO().load_checkpoint):
        with pytest.raises(IntegrityError, match=r"evil\.ckpt"):
            load(path)
    assert not canary.exists()


@pytest.mark.parametrize("path", ["https://example.org/a.ckpt", "s3://bucket/a.ckpt", "file:///tmp/a.ckpt"])
def test_urls_are_refused(path):
    for call in (load_checkpoint, AtomicCheckpointIO().remove_checkpoint, lambda p: save_checkpoint({}, p)):
        with pytest.raises(ValueError, match="not URLs"):
            call(path)


def test_unrestricted_loading_is_refused(tmp_path):
    save_checkpoint({"a": 1}, tmp_path / "a.ckpt")
    with pytest.raises(ValueError, match="weights_only=False"):
        AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt", weights_only=False)
    with pytest.raises(TypeError, match="storage_options"):
        AtomicCheckpointIO().save_checkpoint({}, tmp_path / "a.ckpt", storage_options={})


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_mutation_loads(tmp_path, data):
    path = tmp_path / "a.ckpt"
    if not path.exists():
        save_checkpoint({"w": torch.arange(100.0)}, path)
    victim = data.draw(st.sampled_from([path, manifest_path(path)]))
    original = victim.read_bytes()
    at = data.draw(st.integers(0, len(original) - 1))
    changed = bytearray(original)
    changed[at] ^= data.draw(st.integers(1, 255))
    victim.write_bytes(bytes(changed) if data.draw(st.booleans()) else original[:at])
    try:
        with pytest.raises(IntegrityError, match=r"a\.ckpt"):
            load_checkpoint(path)
    finally:
        victim.write_bytes(original)


def test_missing_file_and_removal(tmp_path):
    path = tmp_path / "a.ckpt"
    with pytest.raises(FileNotFoundError, match=r"a\.ckpt"):
        load_checkpoint(path)
    save_checkpoint({"a": 1}, path)
    AtomicCheckpointIO().remove_checkpoint(path)
    assert list(tmp_path.iterdir()) == []


SAVER = """
import sys, torch
from torchfilt.learning.checkpoint import save_checkpoint
print("ready", flush=True)
for i in range(10**6):
    save_checkpoint({"step": i, "w": torch.full((200_000,), float(i))}, sys.argv[1])
    print(i, flush=True)
"""


@pytest.mark.slow
def test_killed_while_saving_leaves_a_whole_checkpoint(tmp_path):
    path = tmp_path / "a.ckpt"
    for attempt in range(4):
        process = subprocess.Popen([sys.executable, "-c", SAVER, str(path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.readline()
        time.sleep(0.05 + 0.037 * attempt)
        process.send_signal(signal.SIGKILL)
        process.wait()
        last = [int(line) for line in process.stdout.read().split()]
        process.stdout.close()
        loaded = load_checkpoint(path)
        assert (loaded["w"] == loaded["step"]).all()
        if last:
            assert loaded["step"] >= last[-1]


@pytest.mark.parametrize("crash_at", ["before data", "before manifest"])
def test_crash_between_the_two_files(tmp_path, monkeypatch, crash_at):
    path = tmp_path / "a.ckpt"
    save_checkpoint({"step": 1}, path)
    real, calls = os.replace, []

    def fails(source, target):
        calls.append(target)
        if len(calls) == (2 if crash_at == "before data" else 1):
            raise OSError("no space left on device")
        real(source, target)

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(OSError, match="no space"):
        save_checkpoint({"step": 2}, path)
    monkeypatch.undo()
    assert load_checkpoint(path)["step"] == 1
    assert not list(tmp_path.glob(".*"))
