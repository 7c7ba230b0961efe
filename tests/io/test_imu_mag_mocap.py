"""The log of the hand-moved sensor: what its README promises, and refusal of every kind of damage."""

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat, savemat
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from torchfilt.io import files
from torchfilt.io.files import LogError
from torchfilt.io.imu_mag_mocap import FILE, read_imu_mag_mocap

FOLDER = Path(__file__).parents[2] / "data" / "imu_mag_mocap"
STORED = loadmat(FOLDER / FILE)
RATE_HZ = STORED["sampling_rate"].item()


@pytest.fixture(scope="module")
def log():
    return read_imu_mag_mocap(FOLDER, manifest=FOLDER / "manifest.json")


# What the README says


def test_sizes_units_and_order(log):
    rows = 53612
    assert log.times_s.shape == (rows,)
    assert log.gyro_rad_s.shape == log.accel_m_s2.shape == log.mag_t.shape == log.position_m.shape == (rows, 3)
    assert all(values.dtype == torch.float64 for values in log[:-1])
    np.testing.assert_allclose(log.times_s, np.arange(rows) / RATE_HZ, rtol=1e-15)
    k = 20000
    assert log.gyro_rad_s[k].tolist() == STORED["imu_gyr"][k].tolist()
    assert log.accel_m_s2[k].tolist() == STORED["imu_acc"][k].tolist()
    np.testing.assert_allclose(log.mag_t[k] * 1e6, STORED["imu_mag"][k], rtol=1e-14)
    assert log.quaternion[k].tolist() == STORED["opt_quat"][k, [1, 2, 3, 0]].tolist()
    assert log.position_m[k].tolist() == STORED["opt_pos"][k].tolist()


def test_movement_and_lost_rows(log):
    moving = log.movement.nonzero().squeeze(-1)
    assert log.movement.dtype == torch.bool and len(moving) == 33695
    assert log.times_s[moving[[0, -1]]].tolist() == pytest.approx([36.3, 154.3], abs=0.05)
    lost = log.quaternion.isnan().any(-1)
    assert lost.sum() == 2226 and (lost & log.movement).sum() == 207 and int((~lost).nonzero()[0]) == 1372
    lost_position = log.position_m.isnan().any(-1)
    assert lost_position.sum() == 219 and lost[lost_position].all()


def test_cameras_turn_as_the_gyro_says_and_lead_it(log):
    q = log.quaternion.numpy()[20000:40000]
    seen = ~np.isnan(q).any(1)
    pairs = seen[1:] & seen[:-1]
    turn = (Rotation.from_quat(q[:-1][pairs]).inv() * Rotation.from_quat(q[1:][pairs])).as_rotvec() * RATE_HZ
    gyro = log.gyro_rad_s.numpy()
    off = {}
    for lag in (0.0, 1.0, 1.5, 2.0, 3.0):
        rows = np.arange(20000, 39999)[pairs] + lag
        shifted = np.stack([np.interp(rows, np.arange(len(gyro)), axis) for axis in gyro.T], -1)
        off[lag] = np.median(np.linalg.norm(turn - shifted, axis=1))
    assert off[1.0] < 0.22 and off[1.5] < off[1.0] < off[0.0] and off[2.0] < off[3.0]


def test_gravity_field_and_acceleration_are_east_north_up(log):
    seen = ~log.quaternion.isnan().any(-1).numpy()
    world = Rotation.from_quat(log.quaternion.numpy()[seen])
    still = ~log.movement.numpy()[seen]
    force = world[still].apply(log.accel_m_s2.numpy()[seen][still]).mean(0)
    np.testing.assert_allclose(force, [0.02, -0.03, 9.82], atol=0.02)
    field = world.apply(log.mag_t.numpy()[seen]) * 1e6
    np.testing.assert_allclose(field.mean(0), [-1.0, 15.5, -41.4], atol=0.1)
    np.testing.assert_allclose(field.std(0), [2.3, 2.5, 1.3], atol=0.1)
    assert np.linalg.norm(field, axis=1).mean() == pytest.approx(44.3, abs=0.1)
    # A stretch in which the cameras lost nothing.
    part = slice(26000, 32000)
    assert seen[part].all() and not log.position_m[part].isnan().any()
    path = savgol_filter(log.position_m[part].numpy(), 31, 3, deriv=2, delta=1 / RATE_HZ, axis=0)
    inertial = Rotation.from_quat(log.quaternion.numpy()[part]).apply(log.accel_m_s2.numpy()[part])
    inertial = savgol_filter(inertial, 31, 2, axis=0)
    for axis in range(3):
        assert np.corrcoef(path[:, axis], inertial[:, axis])[0, 1] > 0.97


# Damage


PART = slice(20000, 20300)


def trial(**changes):
    """A second of the trial, with changes; None leaves a variable out."""
    names = ("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "opt_pos", "movement")
    arrays = {name: STORED[name][PART] for name in names} | {"sampling_rate": STORED["sampling_rate"]} | changes
    return {name: value for name, value in arrays.items() if value is not None}


def save(folder, content, compress=True):
    stream = io.BytesIO()
    savemat(stream, content, do_compression=compress)
    (Path(folder) / FILE).write_bytes(stream.getvalue())
    return folder


@pytest.mark.parametrize("compress", [True, False])
def test_a_second_is_read(tmp_path, log, compress):
    small = read_imu_mag_mocap(save(tmp_path, trial(info="text", other=np.zeros(3)), compress))
    assert torch.equal(small.gyro_rad_s, log.gyro_rad_s[PART])
    assert torch.equal(small.quaternion, log.quaternion[PART])


def edited(name, row, value, column=...):
    values = np.array(STORED[name][PART], dtype=float)
    values[row, column] = value
    return {name: values}


CHANGES = [
    ({"imu_gyr": None}, "0 variables imu_gyr"),
    ({"movement": None}, "0 variables movement"),
    ({"imu_acc": STORED["imu_acc"][:299]}, r"imu_acc has shape \(299, 3\), expected \(300, 3\)"),
    ({"opt_quat": STORED["opt_pos"][PART]}, r"opt_quat has shape \(300, 3\), expected \(300, 4\)"),
    ({"imu_mag": STORED["imu_mag"][PART].T}, r"imu_mag has shape \(3, 300\)"),
    ({"sampling_rate": np.ones((2, 1))}, r"sampling_rate has shape \(2, 1\), expected \(1, 1\)"),
    ({"sampling_rate": np.array([[np.nan]])}, "sampling_rate is nan Hz; it must be from 1 to 100000"),
    ({"sampling_rate": np.array([[-5.0]])}, "sampling_rate is -5.0 Hz"),
    ({"sampling_rate": np.array([[3.0]])}, "opt_quat turns otherwise than imu_gyr"),
    (edited("imu_gyr", 6, np.nan, 1), "gyro_rad_s must be finite: sample 6"),
    (edited("imu_acc", 6, np.inf, 1), "accel_m_s2 must be finite: sample 6"),
    (edited("imu_mag", 6, np.nan, 1), r"row 7: got .* of imu_mag; values must be finite"),
    ({"imu_gyr": np.rad2deg(STORED["imu_gyr"][PART])}, "angular rate must be at most 35 rad/s"),
    ({"imu_acc": STORED["imu_acc"][:300] / 9.8}, "specific force must be in m/s.2: .* as if in g"),
    ({"imu_mag": STORED["imu_mag"][PART] / 100}, "length of imu_mag is 0.4.* in the median; no field of the Earth"),
    ({"imu_mag": STORED["imu_mag"][PART] * 1e3}, "no field of the Earth in microtesla"),
    (edited("opt_quat", 6, np.nan, 1), "row 7: got .* of opt_quat; a row is lost as a whole or not at all"),
    (edited("opt_quat", 6, np.inf), "row 7: got .* of opt_quat; values must be finite, or NaN where lost"),
    (edited("opt_quat", 6, 0.0), "row 7: got 0.0 as the length of opt_quat; it must be 1"),
    ({"opt_quat": np.full((300, 4), np.nan)}, "opt_quat has no two successive rows"),
    ({"opt_quat": STORED["opt_quat"][PART][:, [3, 0, 1, 2]]}, "opt_quat turns otherwise than imu_gyr by"),
    ({"opt_quat": STORED["opt_quat"][PART] * [1, -1, -1, -1]}, "opt_quat turns otherwise than imu_gyr by"),
    (edited("opt_pos", 6, np.nan, 1), "row 7: got .* of opt_pos; a row is lost as a whole"),
    ({"opt_pos": STORED["opt_pos"][PART] * 1e3}, "row 1: got .* of opt_pos, beyond 100.0 m; is it in mm"),
    (edited("movement", 6, 2), "row 7: got 2.0 of movement; it must be 0 or 1"),
    ({"imu_gyr": "text"}, "variable imu_gyr of class 4, expected real numbers"),
    ({"imu_gyr": {"a": 1.0}}, "variable imu_gyr that is no plain array"),
    ({"imu_gyr": STORED["imu_gyr"][PART] + 1j}, "variable imu_gyr that is no plain array"),
]


@pytest.mark.parametrize(("change", "words"), CHANGES)
def test_damage_is_named(tmp_path, change, words):
    save(tmp_path, trial(**change))
    with pytest.raises(LogError, match=words) as caught:
        read_imu_mag_mocap(tmp_path)
    assert FILE in str(caught.value)


def test_file_rules(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError):
        read_imu_mag_mocap(tmp_path)
    whole = (FOLDER / FILE).read_bytes()
    for damaged in (whole[:-20], whole[:200], whole[:100], b"", b"MATLAB 7.3 MAT-file".ljust(4096), b"\x80\x04N." * 99):
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
            read_imu_mag_mocap(tmp_path)
    save(tmp_path, trial())
    monkeypatch.setattr(files, "MAX_BYTES", 10_000)
    with pytest.raises(LogError, match="more than the limit of 10000 bytes when unpacked"):
        read_imu_mag_mocap(tmp_path)
    monkeypatch.setattr(files, "MAX_PACKED_BYTES", 1000)
    with pytest.raises(LogError, match="bytes, more than the limit of 1000"):
        read_imu_mag_mocap(tmp_path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads((FOLDER / "manifest.json").read_text())
    with pytest.raises(LogError, match=r"SHA-256 is .* the manifest says 00"):
        read_imu_mag_mocap(FOLDER, manifest={**digests, FILE: "00"})
    content = bytearray((FOLDER / FILE).read_bytes())
    content[2_000_000] ^= 1
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(LogError, match="SHA-256 is"):
        read_imu_mag_mocap(tmp_path, manifest=digests)


# Files that were made to do harm: arrays where SciPy alone would run out of memory or stack.


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def matrix(kind, sizes, *content):
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(sizes)}i", *sizes))
    return element(14, head + element(1, b"imu_gyr") + b"".join(content))


HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
VAST = (2**15, 2**15)
HOSTILE = {
    "vast": (matrix(6, VAST, element(9, bytes(8))), "variable imu_gyr that is larger than its values"),
    "vast cell": (matrix(1, VAST), "that is no plain array"),
    "cell": (matrix(1, (1, 1), matrix(6, (1, 1), element(9, bytes(8)))), "of class 1, expected real numbers"),
    "negative": (matrix(6, (-1, 5), element(9, bytes(8))), r"sizes \(-1, 5\)"),
    "function": (matrix(16, (1, 1), element(9, bytes(8))), "of class 16, expected real numbers"),
    "no matrix": (element(9, bytes(8)), "an element of type 9, expected a matrix"),
    "empty matrix": (element(14, b""), "a matrix of 0 parts"),
    "no flags": (element(14, element(6, b"") + element(5, b"") + element(1, b"imu_gyr") + element(9, b"")), "not a"),
    "packed bomb": (element(15, zlib.compress(bytes(2**27))), "more than the limit"),
    "behind the end": (struct.pack("<II", 14, 2**31), "an element ends behind the file"),
    "twice": (2 * matrix(6, (1, 1), element(9, bytes(8))), "2 variables imu_gyr"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_before_scipy_sees_it(tmp_path, monkeypatch, name):
    content, words = HOSTILE[name]
    monkeypatch.setattr("scipy.io.loadmat", lambda *_, **__: pytest.fail("SciPy was asked"))
    (tmp_path / FILE).write_bytes(HEAD + content)
    with pytest.raises(LogError, match=words):
        read_imu_mag_mocap(tmp_path)


@given(st.integers(0, 10**9), st.integers(1, 255), st.booleans())
def test_a_flipped_byte_is_refused_or_changes_a_value_only(tmp_path_factory, place, flip, compress):
    """Without a manifest: no other error, and a packed file is protected by its own checksum."""
    folder = save(tmp_path_factory.mktemp("flip"), trial(), compress)
    content = bytearray((folder / FILE).read_bytes())
    place %= len(content)
    content[place] ^= flip
    (folder / FILE).write_bytes(content)
    try:
        found = read_imu_mag_mocap(folder)
    except LogError:
        return
    if compress:
        assert place < 124  # the title
    assert found.gyro_rad_s.shape[1] == 3 and not found.mag_t.isnan().any()


@given(st.integers(0, 10**9), st.booleans())
def test_a_cut_file_is_refused(tmp_path_factory, cut, compress):
    folder = save(tmp_path_factory.mktemp("cut"), trial(), compress)
    content = (folder / FILE).read_bytes()
    (folder / FILE).write_bytes(content[: cut % len(content)])
    with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
        read_imu_mag_mocap(folder)


@given(st.binary(max_size=400))
def test_noise_is_refused(tmp_path_factory, noise):
    folder = tmp_path_factory.mktemp("noise")
    for content in (noise, HEAD + noise, HEAD + element(14, noise), HEAD + element(15, zlib.compress(noise))):
        (folder / FILE).write_bytes(content)
        with pytest.raises(LogError):
            read_imu_mag_mocap(folder)
