"""Where pairs come from: the simulator's tests are new to the training, files are whole or refused."""

import os
import pickle
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from learning_problem import pairs, write_log

from torchfilt.learning.settings import RunSettings, UsageError
from torchfilt.learning.sources import MOVED_M, Pairs, read_pairs, simulated, split_file
from torchfilt.models.relative_motion import FormationSettings


def test_simulated_tests_are_new_to_the_training():
    data = simulated(RunSettings(source="arcs", samples=20, dt=10.0, seed=4))
    formation = FormationSettings()
    assert data.training.x.shape == (20, 6) and data.training.u.shape == (20, 21)
    assert data.training.group.tolist() == [i // 2 for i in range(20)]
    for first, second in zip(data.training.x[:-1:2], data.training.x[1::2], strict=True):
        assert torch.equal(second, data.training.x_next[(data.training.x == first).all(-1)][0])
    seen = {tuple(row) for row in data.training.x.tolist()}
    for name, part in data.tests.items():
        assert len(part.x) == 200, name
        assert not seen & {tuple(row) for row in part.x.tolist()}
    assert not torch.equal(data.tests["held_out"].x, data.tests["next_revolution"].x)
    # A closed ellipse moved by 20 m on each axis stays so far from the nominal one; the chief's orbit is the same.
    nominal, moved = (data.tracks[name].states for name in ("nominal_start", "moved_start"))
    torch.testing.assert_close((moved - nominal)[0, :3], torch.full((3,), MOVED_M).double(), rtol=1e-9, atol=0)
    distance = torch.linalg.vector_norm((moved - nominal)[:, :3], dim=-1)
    assert distance.min() > 15 and distance.max() < 80
    assert torch.equal(data.tracks["nominal_start"].controls, data.tracks["moved_start"].controls)
    assert len(nominal) == int(formation.period_s // 10) + 1
    again = simulated(RunSettings(source="arcs", samples=20, dt=10.0, seed=5))
    assert not torch.equal(again.training.x, data.training.x)
    assert not torch.equal(again.tests["held_out"].x, data.tests["held_out"].x)


def test_simulator_refusals_name_the_options():
    with pytest.raises(UsageError, match=r"--source cloud --samples 5 --dt 1e\+06: span_s must be longer"):
        simulated(RunSettings(samples=5, dt=1e6))


def test_reads_what_was_written(tmp_path):
    path = tmp_path / "log.npz"
    group = np.arange(60) // 20
    write_log(path, group=group)
    got, dt, unused = read_pairs(path)
    for part, expected in zip(got[:3], pairs(), strict=True):
        assert torch.equal(part, expected)
    assert dt == 1.0 and unused == ["time"] and got.group.tolist() == group.tolist()
    x, _, x_next = pairs()
    compressed = tmp_path / "big-endian.npz"
    np.savez_compressed(compressed, x=x.numpy().astype(">f4"), x_next=x_next.numpy().astype(">f4"))
    got, dt, unused = read_pairs(compressed)
    assert got.x.dtype == torch.float64 and torch.equal(got.x, x.float().double())
    assert got.u is None and dt is None and unused == []


BAD = np.zeros((60, 2))
BAD[7, 1] = np.nan


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"x": None}, "array 'x' is missing; the file holds"),
        ({"x_next": None}, "array 'x_next' is missing"),
        ({"x": np.zeros((59, 2))}, r"must be \(S, d\) alike.*\(59, 2\) and \(60, 2\)"),
        ({"x": np.zeros(60)}, r"x must have 2 axes, got shape \(60,\)"),
        ({"x": np.zeros((60, 2), int)}, "x must be float32 or float64, got int64"),
        ({"x": np.zeros((60, 2), np.float16)}, "x must be float32 or float64, got float16"),
        ({"x": np.zeros((60, 2), complex)}, "got complex128"),
        ({"x": np.zeros((60, 2), np.float32)}, "one precision, got float32 and float64"),
        ({"x": BAD}, r"x must be finite, nan at \(7, 1\) is not"),
        ({"x_next": BAD + np.inf}, r"x_next must be finite, inf at \(0, 0\)"),
        ({"x": np.zeros((1, 2)), "x_next": np.zeros((1, 2))}, "S >= 2"),
        ({"u": np.zeros((59, 1))}, r"u must be \(S, k\) with S = 60 rows, got \(59, 1\)"),
        ({"u": np.zeros((60, 0))}, r"got \(60, 0\)"),
        ({"dt": np.zeros(2)}, r"dt must have 0 axes"),
        ({"dt": -1.0}, "dt must be positive, got -1"),
        ({"dt": np.nan}, "dt must be finite"),
        ({"group": np.zeros(60)}, r"group must be \(60,\) integers, got \(60,\) of float64"),
        ({"x": np.array([["a"] * 2] * 60)}, "x must be float32 or float64, got <U1"),
    ],
)
def test_bad_arrays_are_named(tmp_path, arrays, message):
    path = tmp_path / "bad.npz"
    write_log(path, **arrays)
    with pytest.raises(ValueError, match=message) as caught:
        read_pairs(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


class Canary:
    """Unpickling writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.system, (f"touch {self.path}",))


def test_nothing_is_unpickled(tmp_path):
    canary = tmp_path / "ran"
    objects = np.empty((60, 2), dtype=object)
    objects[:] = Canary(canary)
    for name, save in (
        ("objects.npz", lambda p: write_log(p, x=objects)),
        ("raw.npz", lambda p: p.write_bytes(pickle.dumps(Canary(canary)))),
        ("member.npz", lambda p: zipfile.ZipFile(p, "w").writestr("x.npy", pickle.dumps(Canary(canary)))),
    ):
        save(tmp_path / name)
        with pytest.raises(ValueError, match=rf"{name}: "):
            read_pairs(tmp_path / name)
    assert not canary.exists()


def test_files_that_are_no_archive(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.npz: no such file"):
        read_pairs(tmp_path / "absent.npz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_pairs(tmp_path)
    np.save(tmp_path / "a.npy", np.zeros((5, 2)))
    for name, content in (("empty", b""), ("text", b"x,y\n1,2\n"), ("npy", (tmp_path / "a.npy").read_bytes())):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match="not an NPZ archive, or a truncated one"):
            read_pairs(tmp_path / name)
    write_log(tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    for share in (0.1, 0.5, 0.99):
        (tmp_path / "cut.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"cut\.npz: cannot be read \(not an NPZ archive, or a truncated one\)"):
            read_pairs(tmp_path / "cut.npz")
    # A header that claims a petabyte.
    header = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little")
    header += b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 12), }".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("x.npy", header + b"\0" * 64)
        archive.writestr("x_next.npy", header + b"\0" * 64)
    with pytest.raises(ValueError, match=r"huge\.npz: cannot be read"):
        read_pairs(tmp_path / "huge.npz")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_changed_byte_is_refused_or_harmless(tmp_path, data):
    path = tmp_path / "log.npz"
    if not path.exists():
        write_log(path, count=4)
    original = path.read_bytes()
    at, flip = data.draw(st.integers(0, len(original) - 1)), data.draw(st.integers(1, 255))
    changed = tmp_path / "changed.npz"
    changed.write_bytes(original[:at] + bytes([original[at] ^ flip]) + original[at + 1 :])
    expected = read_pairs(path)[0]
    try:
        got = read_pairs(changed)[0]
    except ValueError as error:
        assert str(error).startswith(f"{changed}: ") and "\n" not in str(error)
        return
    # A zip archive has bytes that nothing depends on (times, attributes), and a changed name drops an optional array.
    assert torch.equal(got.x, expected.x) and torch.equal(got.x_next, expected.x_next)
    assert got.u is None or torch.equal(got.u, expected.u)


def test_split_keeps_the_last_rows():
    x, u, x_next = pairs(50)
    whole = Pairs(x, u, x_next, torch.arange(50))
    base = RunSettings(source="log.npz")
    data = split_file(base, whole, None)
    assert torch.equal(data.training.x, x[:40]) and torch.equal(data.tests["held_out"].x_next, x_next[40:])
    assert data.training.group.tolist() == list(range(40)) and data.tracks == {}
    some = split_file(RunSettings(source="log.npz", samples=15, seed=2), whole, None).training
    assert len(some.x) == 15 and some.group.tolist() == sorted(set(some.group.tolist())) and max(some.group) < 40
    assert torch.equal(some.x, x[some.group])
    other = split_file(RunSettings(source="log.npz", held_out=0.0, test="b"), whole, whole.rows(slice(0, 5)))
    assert len(other.training.x) == 50 and set(other.tests) == {"test_file"}
    with pytest.raises(UsageError, match=r"--samples 41: log\.npz has 40 rows"):
        split_file(RunSettings(source="log.npz", samples=41), whole, None)
    with pytest.raises(UsageError, match=r"--held-out 0\.99 leaves 0 of 50 rows"):
        split_file(RunSettings(source="log.npz", held_out=0.99), whole, None)
    with pytest.raises(UsageError, match=r"--held-out 0\.001 leaves 50 of 50"):
        split_file(RunSettings(source="log.npz", held_out=0.001), whole, None)
