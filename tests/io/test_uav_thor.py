"""The log of the aircraft: what its README promises, and refusal of every kind of damage."""

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
from scipy.spatial.transform import Rotation

from torchfilt.io import files, uav_thor
from torchfilt.io.files import LogError
from torchfilt.io.uav_thor import AIRBORNE_S, FILE, read_uav_thor

FOLDER = Path(__file__).parents[2] / "data" / "uav_thor75"
STORED = loadmat(FOLDER / FILE, struct_as_record=False, squeeze_me=True)["flight_data"]


@pytest.fixture(scope="module")
def log():
    return read_uav_thor(FOLDER, manifest=FOLDER / "manifest.json")


@pytest.fixture(scope="module")
def corrected():
    return read_uav_thor(FOLDER, raw=False)


def airborne(time_s):
    return (time_s > AIRBORNE_S[0]) & (time_s < AIRBORNE_S[1])


def turned(angle):
    """Degrees, between -180 and 180."""
    return np.rad2deg((angle + np.pi) % (2 * np.pi) - np.pi)


# What the README says


def test_sizes_times_and_units(log):
    assert log.time_s.shape == (34811,)  # without the first, before the sensor reports
    assert log.gyro_rad_s.shape == log.accel_m_s2.shape == log.magnetic_field_tesla.shape == (34811, 3)
    np.testing.assert_allclose(log.time_s.diff(), 0.02, atol=5e-5)
    assert len(log.gaps) == 0
    k = 15000
    row = {name: float(getattr(STORED, name)[k + 1]) for name in STORED._fieldnames[:60]}
    assert log.time_s[k].item() == row["time"]
    assert log.gyro_rad_s[k].tolist() == [
        row["q"] + row["q_bias"],
        row["p"] + row["p_bias"],
        -(row["r"] + row["r_bias"]),
    ]
    assert log.accel_m_s2[k].tolist() == [
        row["ay"] + row["ay_bias"],
        row["ax"] + row["ax_bias"],
        -(row["az"] + row["az_bias"]),
    ]
    field = [0.18758 - row["hy"], row["hx"] - 0.41071, row["hz"] + 0.37739]
    assert log.magnetic_field_tesla[k].tolist() == pytest.approx([1e-4 * value for value in field], rel=1e-12)
    assert log.pressure_height_m[k].item() == row["h"]
    # The on-board solution of this row belongs to the sample before.
    assert log.reference.time_s[k].item() == log.time_s[k - 1].item()
    assert log.reference.latitude_rad[k].item() == row["navlat"]
    assert log.reference.velocity_m_s[k].tolist() == [row["navve"], row["navvn"], -row["navvd"]]
    tensors = [v for part in (log, log.gnss, log.reference) for v in part if isinstance(v, torch.Tensor)]
    assert {v.dtype for v in tensors} == {torch.float64, torch.int64}


def test_held_fixes_are_gone(log):
    """One row a change of the receiver's time, but none without satellites."""
    changes = np.flatnonzero(np.diff(STORED.GPS_TOW)) + 1
    seen = changes[STORED.satVisible[changes] > 0]
    assert len(changes) == 674 and len(seen) == 673
    gnss = log.gnss
    assert gnss.time_s.tolist() == STORED.time[seen].tolist()
    assert gnss.latitude_rad.tolist() == np.deg2rad(STORED.lat[seen]).tolist()
    assert gnss.longitude_rad.tolist() == np.deg2rad(STORED.lon[seen]).tolist()
    assert gnss.height_m.tolist() == STORED.alt[seen].tolist()
    assert gnss.velocity_m_s.tolist() == np.stack([STORED.ve, STORED.vn, -STORED.vd], -1)[seen].tolist()
    step = gnss.time_s.diff()
    assert step.max() == pytest.approx(3.0, abs=0.01)  # the fix without satellites
    assert step[10:].sort().values[:-1].max() < 1.03


def test_what_is_not_known_is_nan(log):
    valid = log.reference.heading_rad.isfinite()
    time = log.reference.time_s
    assert torch.equal(valid, (time > 24.77) & ~((time > 222.73) & (time < 224.73)))
    for value in log.reference[1:]:
        assert torch.equal(value.isfinite().reshape(len(time), -1).all(-1), valid)
    assert log.reference.heading_rad.nan_to_num().abs().max() <= np.pi
    assert torch.equal(log.pressure_height_m.isnan(), log.time_s < 4.03)
    assert log.pressure_height_m[log.time_s < 20].nan_to_num().abs().max() < 10


def test_raw_is_logged_plus_bias(log, corrected):
    bias = np.stack([STORED.q_bias, STORED.p_bias, -STORED.r_bias], -1)[1:]
    np.testing.assert_allclose(log.gyro_rad_s - corrected.gyro_rad_s, bias, atol=1e-15)
    bias = np.stack([STORED.ay_bias, STORED.ax_bias, -STORED.az_bias], -1)[1:]
    np.testing.assert_allclose(log.accel_m_s2 - corrected.accel_m_s2, bias, atol=1e-14)
    assert bias[:, 1].max() == pytest.approx(0.3883, abs=1e-4)


def free_inertial_errors(log, gyro, accel, seconds=10):
    """Horizontal errors (m) after windows that start each 5 s at the on-board state: an integration of its own."""
    time, reference = log.time_s.numpy(), log.reference
    first = np.searchsorted(time, np.arange(AIRBORNE_S[0], AIRBORNE_S[1] - seconds, 5.0))
    steps = 50 * seconds
    at = lambda values: values.numpy()[1:]  # noqa: E731 - the first sample has no inertial data
    known = np.isfinite(at(reference.heading_rad))
    first = first[[known[k : k + steps + 1].all() for k in first]]
    angles = np.stack([-at(reference.heading_rad), at(reference.pitch_rad), at(reference.roll_rad)], -1)[first]
    attitude = Rotation.from_euler("ZXY", angles)
    velocity = at(reference.velocity_m_s)[first]
    moved = np.zeros_like(velocity)
    for k in range(1, steps + 1):
        turn = Rotation.from_rotvec(gyro[first + k] * 0.02)
        force = (attitude * Rotation.from_rotvec(gyro[first + k] * 0.01)).apply(accel[first + k])
        attitude = attitude * turn
        before = velocity
        velocity = velocity + (force - [0, 0, 9.806]) * 0.02
        moved += (velocity + before) * 0.01
    last = first + steps
    latitude, longitude = at(reference.latitude_rad), at(reference.longitude_rad)
    north = (latitude[last] - latitude[first]) * 6.370e6  # meridian radius at 45 deg, within 3e-4
    east = (longitude[last] - longitude[first]) * 6.389e6 * np.cos(latitude[first])
    return np.hypot(moved[:, 0] - east, moved[:, 1] - north)


def test_reference_has_the_time_of_the_last_sample_it_saw(corrected):
    """From one time to the next its velocity changes by the sample that ends there, and by no other."""
    log, reference = corrected, corrected.reference
    known = torch.arange(13000, 20000)
    angles = torch.stack([-reference.heading_rad, reference.pitch_rad, reference.roll_rad], -1)[known + 1]
    velocity = reference.velocity_m_s
    assert torch.equal(reference.time_s[known + 1], log.time_s[known])
    change = ((velocity[known + 2] - velocity[known + 1]) / 0.02).numpy()

    def misfit(shift):
        force = Rotation.from_euler("ZXY", angles).apply(log.accel_m_s2[known + shift])
        return np.median(np.abs(change - force)[:, :2])

    assert misfit(1) < 2e-5
    assert misfit(0) > 0.05 and misfit(2) > 0.05


def test_axes_signs_and_biases_hold_for_free_inertial_flight(log, corrected):
    """The README's medians, 6 m and 53 m, which depend on the choice of windows by a fifth."""
    gyro, accel = corrected.gyro_rad_s.numpy(), corrected.accel_m_s2.numpy()
    errors = free_inertial_errors(corrected, gyro, accel)
    assert len(errors) > 60
    assert np.median(errors) == pytest.approx(6, rel=0.2)
    twice = [2 * a - b.numpy() for a, b in ((gyro, log.gyro_rad_s), (accel, log.accel_m_s2))]
    assert np.median(free_inertial_errors(corrected, *twice)) == pytest.approx(53, rel=0.2)
    # Each axis matters: with one turned round the errors are at least twice as large.
    for axis in range(3):
        sign = np.ones(3)
        sign[axis] = -1
        assert np.median(free_inertial_errors(corrected, gyro * sign, accel)) > 60
        assert np.median(free_inertial_errors(corrected, gyro, accel * sign)) > 2 * np.median(errors)


def test_magnetometer_sees_the_field_of_the_place(log):
    """0.57 G inclined by 72 deg, the horizontal part to the north."""
    fly = airborne(log.time_s)
    field = log.magnetic_field_tesla[fly].numpy()
    norm = np.linalg.norm(field, axis=-1)
    assert norm.mean() == pytest.approx(0.572e-4, abs=1e-6)
    assert norm.std() == pytest.approx(0.0185e-4, abs=1e-7)
    pitch, roll, heading = (
        angle[1:][fly[:-1]].numpy()
        for angle in (log.reference.pitch_rad, log.reference.roll_rad, log.reference.heading_rad)
    )
    known = np.isfinite(pitch)
    level = Rotation.from_euler("XY", np.stack([pitch, roll], -1)[known]).apply(field[known])
    inclination = np.rad2deg(np.arctan2(-level[:, 2], np.hypot(level[:, 0], level[:, 1])))
    assert inclination.mean() == pytest.approx(72.1, abs=0.2)
    difference = turned(np.arctan2(-level[:, 0], level[:, 1]) - heading[known])
    assert difference.mean() == pytest.approx(-3.7, abs=0.3)
    assert difference.std() == pytest.approx(7.8, abs=0.3)


def test_magnetometer_is_right_on_the_ground_and_the_reference_is_not(log):
    """Taxiing at 2.5 to 3 m/s, 190 s: the course is the heading."""
    fix = (log.gnss.time_s > 189.5) & (log.gnss.time_s < 191)
    at = torch.searchsorted(log.time_s, log.gnss.time_s[fix])
    east, north, _ = log.gnss.velocity_m_s[fix].numpy().T
    assert len(at) == 2 and np.hypot(east, north).min() > 2.4
    course = np.arctan2(east, north)
    pitch, roll = log.reference.pitch_rad[at + 1], log.reference.roll_rad[at + 1]
    level = Rotation.from_euler("XY", torch.stack([pitch, roll], -1)).apply(log.magnetic_field_tesla[at])
    assert np.abs(turned(np.arctan2(-level[:, 0], level[:, 1]) - course)).max() < 15
    assert np.abs(turned(log.reference.heading_rad[at + 1].numpy() - course)).min() > 30


def test_fixes_reference_and_barometer_agree(log):
    """On-board minus GPS height and barometer minus GPS height at the fixes' times."""
    fix = log.gnss
    k = torch.searchsorted(log.time_s, fix.time_s)
    fly = airborne(fix.time_s)
    height = (log.reference.height_m[k + 1] - fix.height_m)[fly]
    height = height[height.isfinite()]
    assert height.mean() == pytest.approx(-0.9, abs=0.2)
    assert height.std() == pytest.approx(1.5, abs=0.2)
    difference = (log.pressure_height_m[k] - fix.height_m)[fly]
    assert difference.std() == pytest.approx(5.4, abs=0.3)
    assert difference.mean() == pytest.approx(-240.9, abs=1)
    velocity = (log.reference.velocity_m_s[k + 1] - fix.velocity_m_s)[fly]
    assert velocity[velocity.isfinite().all(-1)].square().mean(0).sqrt().max() < 0.4


# Damage


def flight(**changes):
    """Ten seconds of the flight's fields, with changes; None leaves a field out."""
    fields = {name: getattr(STORED, name)[15000:15500] for name in uav_thor._FIELDS} | changes
    return {name: value for name, value in fields.items() if value is not None}


def save(folder, content, compress=True):
    stream = io.BytesIO()
    savemat(stream, content, do_compression=compress)
    (Path(folder) / FILE).write_bytes(stream.getvalue())
    return folder


@pytest.mark.parametrize("compress", [True, False])
def test_ten_seconds_are_read(tmp_path, log, compress):
    content = {"other": np.zeros(3), "flight_data": flight(), "more": "text"}
    small = read_uav_thor(save(tmp_path, content, compress))
    assert torch.equal(small.gyro_rad_s, log.gyro_rad_s[14999:15499])
    assert len(small.gnss.time_s) == 10


def edited(values, row, value):
    values = np.array(values, dtype=float)
    values[row] = value
    return values


CHANGES = [
    (lambda s: {"p": None}, "flight_data has no field p"),
    (lambda s: {"p": s.p[:499]}, r"field p has shape \(499,\), time has \(500,\)"),
    (lambda s: {"p": s.p[:500].reshape(2, 250)}, r"field p has shape \(2, 250\)"),
    (lambda s: {"ax": 3.0}, r"field ax has shape \(\), time has \(500,\)"),
    (lambda s: {"time": 3.0}, r"field time has shape \(\)"),
    (lambda s: {"q": edited(s.q[:500], 6, np.nan)}, "row 7: got nan of q; values must be finite"),
    (lambda s: {"navlat": edited(s.q[:500], 6, np.inf)}, "row 7: got inf of navlat; values must be finite"),
    (lambda s: {"time": edited(s.time[:500], 6, s.time[5])}, "times_s must increase, this one is repeated: sample 6"),
    (lambda s: {"time": edited(s.time[:500], 6, s.time[4])}, "times_s must increase, this one goes backward: sample 6"),
    (lambda s: {"time": s.time[:500] + (np.arange(500) > 9)}, "no gap above 0.05 s: sample 10"),
    (lambda s: {"r": np.rad2deg(edited(s.r[:500], 8, 1.0))}, "angular rate must be at most 35 rad/s: sample 8"),
    (
        lambda s: {n: getattr(s, n)[15000:15500] / 9.8 for n in ("ax", "ay", "az")},
        "specific force must be in m/s.2: .* as if in g",
    ),
    (lambda s: {"lat": np.deg2rad(s.lat[15000:15500])}, "velocity differs from the differenced position"),
    (lambda s: {"vn": s.ve[15000:15500], "ve": s.vn[15000:15500]}, "velocity differs from the differenced position"),
    (lambda s: {"lon": s.lon[15000:15500] * 3}, "row 1: got -4.88.* rad of longitude"),
    (lambda s: {"GPS_TOW": np.ones(500)}, "0 satellite fixes, at least 2 are needed"),
    (lambda s: {"satVisible": np.zeros(500)}, "0 satellite fixes, at least 2"),
    (lambda s: {"imuStatus": np.zeros(500)}, "never reports"),
    (lambda s: {"p": np.array([1.0, "x"], dtype=object)}, "not a whole MATLAB 5 file.*a field that is no plain array"),
    (lambda s: {"p": "text"}, "a field of class 4, expected real numbers"),
    (lambda s: {"p": {"q": 1.0}}, "a field that is no plain array"),
    (lambda s: {"p": s.p[:500] + 1j}, "a field that is no plain array"),
]


@pytest.mark.parametrize(("change", "words"), CHANGES)
def test_damage_is_named(tmp_path, change, words):
    save(tmp_path, {"flight_data": flight(**change(STORED))})
    with pytest.raises(LogError, match=words) as caught:
        read_uav_thor(tmp_path)
    assert FILE in str(caught.value)


def test_gaps_are_marked_on_request(tmp_path):
    late = np.arange(500) > 9
    save(tmp_path, {"flight_data": flight(time=STORED.time[15000:15500] + late)})
    assert read_uav_thor(tmp_path, gaps="mark").gaps.tolist() == [10]
    assert read_uav_thor(tmp_path, max_gap_s=1.1).gaps.tolist() == []


def test_file_rules(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError):
        read_uav_thor(tmp_path)
    whole = (FOLDER / FILE).read_bytes()
    for damaged in (whole[:-20], whole[:200], whole[:100], b"", b"MATLAB 7.3 MAT-file".ljust(4096), b"\x80\x04N." * 99):
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
            read_uav_thor(tmp_path)
    save(tmp_path, {"flight": flight()})
    with pytest.raises(LogError, match="0 variables flight_data"):
        read_uav_thor(tmp_path)
    save(tmp_path, {"flight_data": np.zeros(3)})
    with pytest.raises(LogError, match="class 6 with 3 entries, expected one structure"):
        read_uav_thor(tmp_path)
    save(tmp_path, {"flight_data": flight()})
    monkeypatch.setattr(files, "MAX_BYTES", 10_000)
    with pytest.raises(LogError, match="more than the limit of 10000 bytes when unpacked"):
        read_uav_thor(tmp_path)
    monkeypatch.setattr(files, "MAX_PACKED_BYTES", 1000)
    with pytest.raises(LogError, match="bytes, more than the limit of 1000"):
        read_uav_thor(tmp_path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads((FOLDER / "manifest.json").read_text())
    with pytest.raises(LogError, match=r"SHA-256 is .* the manifest says 00"):
        read_uav_thor(FOLDER, manifest={**digests, FILE: "00"})
    with pytest.raises(LogError, match="the manifest says nothing"):
        read_uav_thor(FOLDER, manifest={})
    content = bytearray((FOLDER / FILE).read_bytes())
    content[2_000_000] ^= 1
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(LogError, match="SHA-256 is"):
        read_uav_thor(tmp_path, manifest=digests)


# Files that were made to do harm. SciPy alone follows the first until the stack ends, and fills 8 GB for the second.


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def matrix(kind, sizes, name, *content):
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(sizes)}i", *sizes))
    return element(14, head + element(1, name) + b"".join(content))


def nest(depth):
    """Cells in cells."""
    head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<2i", 1, 1)) + element(1, b"")
    parts, length = [matrix(6, (1, 1), b"", element(9, bytes(8)))], 56
    for _ in range(depth):
        length += len(head)
        parts.append(struct.pack("<II", 14, length) + head)
        length += 8
    return b"".join(reversed(parts))


def structure(*fields):
    return matrix(2, (1, 1), b"flight_data", element(5, struct.pack("<i", 8)), element(1, bytes(8)), *fields)


HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
VAST = (2**15, 2**15)
HOSTILE = {
    "nested": (structure(nest(100_000)), "a field that is no plain array|a field of class 1"),
    "vast cell": (matrix(1, VAST, b"flight_data"), "class 1 with 1073741824 entries"),
    "vast field": (structure(matrix(6, VAST, b"", element(9, bytes(8)))), "larger than its values"),
    "vast structure": (matrix(2, VAST, b"flight_data"), "class 2 with 1073741824 entries"),
    "negative": (structure(matrix(6, (-1, 5), b"", element(9, bytes(8)))), r"sizes \(-1, 5\)"),
    "object": (structure(matrix(3, (1, 1), b"", element(9, bytes(8)))), "a field of class 3"),
    "function": (structure(matrix(16, (1, 1), b"", element(9, bytes(8)))), "a field of class 16"),
    "no matrix": (element(9, bytes(8)), "an element of type 9, expected a matrix"),
    "packed bomb": (element(15, zlib.compress(bytes(2**27))), "more than the limit"),
    "packed in packed": (element(15, zlib.compress(element(15, zlib.compress(bytes(99))))), "type 15"),
    "behind the end": (struct.pack("<II", 14, 2**31), "an element ends behind the file"),
    "short": (element(14, b""), "not a whole"),
    "twice": (2 * structure(), "2 variables flight_data"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_before_scipy_sees_it(tmp_path, monkeypatch, name):
    content, words = HOSTILE[name]
    monkeypatch.setattr("scipy.io.loadmat", lambda *_, **__: pytest.fail("SciPy was asked"))
    (tmp_path / FILE).write_bytes(HEAD + content)
    with pytest.raises(LogError, match=words):
        read_uav_thor(tmp_path)


@given(st.integers(0, 10**9), st.integers(1, 255), st.booleans())
def test_a_flipped_byte_is_refused_or_changes_a_value_only(tmp_path_factory, place, flip, compress):
    """Without a manifest: no other error, and a packed file is protected by its own checksum."""
    folder = save(tmp_path_factory.mktemp("flip"), {"flight_data": flight()}, compress)
    content = bytearray((folder / FILE).read_bytes())
    place %= len(content)
    content[place] ^= flip
    (folder / FILE).write_bytes(content)
    try:
        found = read_uav_thor(folder)
    except LogError:
        return
    if compress:
        assert place < 124  # the title
    assert found.gyro_rad_s.shape[1] == 3


@given(st.integers(0, 10**9), st.booleans())
def test_a_cut_file_is_refused(tmp_path_factory, cut, compress):
    folder = save(tmp_path_factory.mktemp("cut"), {"flight_data": flight()}, compress)
    content = (folder / FILE).read_bytes()
    (folder / FILE).write_bytes(content[: cut % len(content)])
    with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
        read_uav_thor(folder)


@given(st.binary(max_size=400))
def test_noise_is_refused(tmp_path_factory, noise):
    folder = tmp_path_factory.mktemp("noise")
    for content in (noise, HEAD + noise, HEAD + element(14, noise), HEAD + element(15, zlib.compress(noise))):
        (folder / FILE).write_bytes(content)
        with pytest.raises(LogError):
            read_uav_thor(folder)
