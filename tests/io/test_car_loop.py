"""The log of the car: what its README promises, and refusal of every kind of damage."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchfilt.io.car_loop import FILES, SCORE_FROM_S, read_car_loop
from torchfilt.io.files import LogError

FOLDER = Path(__file__).parents[2] / "data" / "car_urban_loop"
IMU, GNSS, POSITION, ATTITUDE = FILES


@pytest.fixture(scope="module")
def log():
    return read_car_loop(FOLDER, manifest=FOLDER / "manifest.json")


# What the README says


def test_sizes_times_and_units(log):
    assert log.time_s.shape == (39703,)
    assert log.gyro_rad_s.shape == log.accel_m_s2.shape == (39703, 3)
    np.testing.assert_allclose(log.time_s.diff(), 0.0100507, atol=1e-7)
    assert len(log.gaps) == 0
    np.testing.assert_allclose(log.gnss.time_s.diff(), 0.5, atol=1e-12)
    assert log.gnss.latitude_rad[0].item() == np.deg2rad(43.482087199999995)
    assert log.gnss.longitude_rad[0].item() == np.deg2rad(-79.6906116)
    assert log.gnss.position_sd_m[0].tolist() == [0.971767924969743, 0.971767924969743, 1.631419044880867]
    # Row of 20 s: vn 2.913, ve 3.151, vd -0.06.
    assert log.gnss.velocity_m_s[40].tolist() == pytest.approx([3.151, 2.913, 0.06], rel=1e-12)
    assert log.pressure_height_m is None and log.magnetic_field_tesla is None
    tensors = [v for part in (log, log.gnss, log.reference) for v in part if isinstance(v, torch.Tensor)]
    assert {v.dtype for v in tensors} == {torch.float64, torch.int64}


def test_values_that_the_receiver_did_not_know_are_nan(log):
    reference = log.reference
    assert log.gnss.heading_rad.isnan().tolist() == [True] * 17 + [False] * 782
    for angle, start in ((reference.heading_rad, 8.756), (reference.pitch_rad, 8.756), (reference.roll_rad, 40.304)):
        assert torch.equal(angle.isnan(), reference.time_s < start - 1e-6)
        assert angle.nan_to_num().abs().max() <= np.pi
    assert SCORE_FROM_S > 40.304


def test_the_car_stands_level_at_first(log):
    still = log.time_s < 8
    force = log.accel_m_s2[still].mean(0)
    assert force[2].item() == pytest.approx(9.9, abs=0.05)
    assert force[:2].abs().max() < 0.5
    assert log.gyro_rad_s[still].mean(0).abs().max() < 0.01


def smooth_slope(time, values):
    return np.gradient(values, time)


def test_axes_and_signs_against_the_fused_reference(log):
    """Yaw about down is minus the rate about up; forward force is the change of speed. The README's correlations."""
    time, imu_time = log.reference.time_s.numpy(), log.time_s.numpy()
    late = time > 80
    heading_rate = smooth_slope(time[late], np.unwrap(log.reference.heading_rad.numpy()[late]))
    turn = -np.interp(time[late], imu_time, log.gyro_rad_s[:, 2].numpy())
    assert np.corrcoef(heading_rate, turn)[0, 1] == pytest.approx(0.9965, abs=5e-4)
    slope, offset = np.polyfit(turn, heading_rate, 1)
    assert (slope, offset) == (pytest.approx(1.016, abs=0.002), pytest.approx(0.005, abs=5e-4))
    fix = log.gnss.time_s.numpy()[1:-1]
    speed = log.gnss.velocity_m_s[:, :2].norm(dim=-1).numpy()
    change = (speed[2:] - speed[:-2]) / 1.0
    near = np.abs(imu_time - fix[:, None]) <= 0.25
    force = [np.mean(log.accel_m_s2[torch.from_numpy(window), 1].numpy()) for window in near]
    assert np.corrcoef(change, force)[0, 1] == pytest.approx(0.98, abs=0.005)


def test_lateral_force_is_speed_times_rate(log):
    """To the right is positive: a right turn (clockwise, negative rate about up) pushes to the right."""
    fix = log.gnss.time_s.numpy()
    late = fix > SCORE_FROM_S
    window = np.abs(log.time_s.numpy() - fix[late, None]) <= 0.25
    rate, force = (
        np.array([values[torch.from_numpy(w)].mean().item() for w in window])
        for values in (log.gyro_rad_s[:, 2], log.accel_m_s2[:, 0])
    )
    speed = log.gnss.velocity_m_s[:, :2].norm(dim=-1).numpy()[late]
    assert np.corrcoef(-rate * speed, force)[0, 1] > 0.97


def test_course_heading_and_reference_agree(log):
    fix, reference = log.gnss.time_s.numpy(), log.reference
    east, north, _ = log.gnss.velocity_m_s.numpy().T
    fast = (np.hypot(east, north) > 5) & (fix > SCORE_FROM_S)
    late = reference.time_s.numpy() > SCORE_FROM_S - 1
    heading = np.interp(fix, reference.time_s.numpy()[late], np.unwrap(reference.heading_rad.numpy()[late]))

    def difference(angle):
        return np.rad2deg((angle - heading + np.pi) % (2 * np.pi) - np.pi)[fast]

    course = difference(np.arctan2(east, north))
    assert course.mean() == pytest.approx(-0.2, abs=0.1)
    assert 2.0 < course.std() < 2.4
    assert np.abs(np.median(difference(log.gnss.heading_rad.numpy()))) < 1.0


def test_reference_position_is_near_the_fixes(log):
    at = log.gnss.time_s.numpy()
    latitude, longitude = (
        np.interp(at, log.reference.time_s, angle)
        for angle in (log.reference.latitude_rad, log.reference.longitude_rad)
    )
    north = (log.gnss.latitude_rad.numpy() - latitude) * 6.36e6
    east = (log.gnss.longitude_rad.numpy() - longitude) * 6.39e6 * np.cos(latitude)
    assert np.sqrt(np.mean(north**2 + east**2)) == pytest.approx(0.94, abs=0.02)


def test_reference_attitude_has_the_signs_of_this_project(log):
    """Gravity as the sensor sees it: nose up moves the force forward, right side down moves it to the left.

    The sensor is mounted 2.5 deg rolled, so roll is compared by its change between slopes."""
    speed = np.interp(log.reference.time_s, log.gnss.time_s, log.gnss.velocity_m_s.norm(dim=-1))
    pitch, roll = log.reference.pitch_rad.numpy(), log.reference.roll_rad.numpy()
    late = log.reference.time_s.numpy() > SCORE_FROM_S
    attitude = Rotation.from_euler("ZXY", np.stack([0 * pitch, pitch, roll], -1)[late])
    vertical = attitude.inv().apply([0, 0, 9.80])
    force = np.stack([np.interp(log.reference.time_s, log.time_s, f) for f in log.accel_m_s2.T.numpy()], -1)[late]
    rate = np.interp(log.reference.time_s, log.time_s, log.gyro_rad_s[:, 2])[late]
    change = np.gradient(speed, log.reference.time_s.numpy())[late]
    force = force - np.stack([-speed[late] * rate, change, 0 * rate], -1)
    kernel = np.ones(30) / 30
    for axis in (0, 1):
        pair = [np.convolve(values[:, axis], kernel, "valid") for values in (vertical, force)]
        assert np.corrcoef(*pair)[0, 1] > 0.5  # a wrong sign of the angle changes the sign of this


# Damage


def rows_of(name, count):
    return gzip.decompress((FOLDER / name).read_bytes()).decode().splitlines()[: count + 1]


# Some seconds of each file, cut to one span.
SMALL = {
    IMU: rows_of(IMU, 400),
    GNSS: rows_of(GNSS, 9),
    POSITION: rows_of(POSITION, 121),
    ATTITUDE: rows_of(ATTITUDE, 121),
}


def store(folder, end="\n", **changed):
    """The four small files, with other lines for those named by their first word."""
    for name, lines in SMALL.items():
        lines = changed.get(name.split(".")[0], lines)
        (Path(folder) / name).write_bytes(gzip.compress((end.join(lines) + end).encode()))
    return folder


def changed(name, row, column, value):
    lines = list(SMALL[name])
    fields = lines[row].split(",")
    fields[column] = value
    lines[row] = ",".join(fields)
    return {name.split(".")[0]: lines}


def lines_of(name, *parts):
    return {name.split(".")[0]: [line for part in parts for line in SMALL[name][part]]}


def test_the_small_files_are_read(tmp_path):
    small = read_car_loop(store(tmp_path))
    assert small.time_s.shape == (400,)
    assert small.reference.heading_rad.isnan().all()
    assert torch.equal(read_car_loop(store(tmp_path, "\r\n")).gyro_rad_s, small.gyro_rad_s)


def test_gaps_are_marked_on_request(tmp_path):
    store(tmp_path, **lines_of(IMU, slice(0, 5), slice(12, 401)))
    assert read_car_loop(tmp_path, gaps="mark").gaps.tolist() == [4]
    assert read_car_loop(tmp_path, max_gap_s=0.1).gaps.tolist() == []
    with pytest.raises(LogError, match=r"imu.csv.gz: .* no gap above 0.01 s: sample 1"):
        read_car_loop(tmp_path, max_gap_s=0.01)


def in_units_of(name, columns, factor):
    """The same file with other units in some columns."""
    head, *lines = rows_of(name, 799 if name == GNSS else 400)
    rows = [line.split(",") for line in lines]
    for row in rows:
        row[columns] = [repr(float(field) * factor) for field in row[columns]]
    return {name.split(".")[0]: [head, *(",".join(row) for row in rows)]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(IMU, 5, 2, "nan"), "imu.csv.gz: row 5: .*values must be finite"),
        (changed(IMU, 5, 2, "1e999"), "imu.csv.gz: row 5: .*values must be finite"),
        (changed(IMU, 5, 2, "0.1x"), "imu.csv.gz: row 5: could not convert"),
        (changed(IMU, 5, 2, ""), "imu.csv.gz: row 5: could not convert"),
        (changed(IMU, 5, 2, "0.1,0.2"), "imu.csv.gz: row 5: 8 columns, expected 7"),
        (changed(IMU, 400, 6, "0.1,0.2"), "imu.csv.gz: row 400: 8 columns, expected 7"),
        (changed(IMU, 0, 2, "gx_dps"), "imu.csv.gz: header is 't_s,gx_radps,gx_dps.*without the columns gy_radps"),
        (changed(GNSS, 0, 5, "vn_mps"), "gnss.csv.gz: header .* without the columns ve_mps"),
        (changed(GNSS, 0, 13, "heading_rad,more"), "gnss.csv.gz: header .* with columns in another order or beside"),
        (changed(IMU, 7, 0, "0.2"), "imu.csv.gz: times_s must increase, this one goes backward: sample 6"),
        (changed(IMU, 7, 1, "40"), "imu.csv.gz: angular rate must be at most 35 rad/s: sample 6"),
        (changed(GNSS, 3, 1, "4348.2"), "gnss.csv.gz: row 3: .* rad of latitude"),
        (changed(GNSS, 3, 7, "0"), "gnss.csv.gz: row 3: got 0.0 of position_sd_m; it must be positive"),
        (changed(GNSS, 3, 0, "1.5"), "gnss.csv.gz: row 4: time goes from 1.5 s to 1.5 s"),
        (changed(ATTITUDE, 3, 0, "0.342"), "reference_attitude.csv.gz: times differ from those of reference_position"),
        (changed(ATTITUDE, 3, 0, "0.1"), "reference_attitude.csv.gz: row 3: time goes from"),
        (changed(POSITION, 3, 1, "inf"), "reference_position.csv.gz: row 3: .*values must be finite"),
        (
            lines_of(IMU, slice(0, 5), slice(12, 401)),
            "imu.csv.gz: .* no gap above 0.05 s: sample 4",
        ),
        (lines_of(IMU, slice(0, 1)), "imu.csv.gz: no rows"),
        (lines_of(IMU, slice(0, 2)), "gnss.csv.gz: ends .* s after imu.csv.gz"),
        (
            lines_of(IMU, slice(0, 5), slice(4, 401)),
            "imu.csv.gz: times_s must increase, this one is repeated: sample 4",
        ),
        (lines_of(IMU, slice(0, 200)), "gnss.csv.gz: ends .* s after imu.csv.gz; one of them is cut short"),
        (lines_of(GNSS, slice(0, 4)), "gnss.csv.gz: ends .* s before imu.csv.gz; one of them is cut short"),
        ({"imu": [*SMALL[IMU][:5], "", *SMALL[IMU][5:]]}, "imu.csv.gz: row 5: 1 columns, expected 7"),
        (changed(IMU, 9, 6, "210"), "imu.csv.gz: specific force must be at most 200 m/s.2: sample 8"),
        (in_units_of(IMU, slice(4, 7), 1 / 9.80665), "imu.csv.gz: specific force must be in m/s.2: .* as if in g"),
        (in_units_of(GNSS, slice(1, 3), np.pi / 180), "gnss.csv.gz: velocity differs from the differenced position"),
    ],
)
def test_damage_is_named_by_file_row_and_rule(tmp_path, change, words):
    with pytest.raises(LogError, match=words):
        read_car_loop(store(tmp_path, **change))


def test_files_are_whole_or_refused(tmp_path):
    store(tmp_path)
    whole = (tmp_path / IMU).read_bytes()
    for damaged in (whole[:-20], b"plain,text\n", b""):
        (tmp_path / IMU).write_bytes(damaged)
        with pytest.raises(LogError, match=f"{IMU}: "):
            read_car_loop(tmp_path)
    for text, words in ((b"\xff\xfe\n", "not plain text"), (b"a,b\n1,2", "row 1: no line end; the file is cut short")):
        (tmp_path / IMU).write_bytes(gzip.compress(text))
        with pytest.raises(LogError, match=words):
            read_car_loop(tmp_path)
    (tmp_path / IMU).unlink()
    with pytest.raises(FileNotFoundError):
        read_car_loop(tmp_path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads((FOLDER / "manifest.json").read_text())
    assert read_car_loop(FOLDER, manifest=digests).time_s.shape == (39703,)
    with pytest.raises(LogError, match=r"gnss.csv.gz: SHA-256 is .* the manifest says 00"):
        read_car_loop(FOLDER, manifest={**digests, GNSS: "00"})
    with pytest.raises(LogError, match=r"imu.csv.gz: SHA-256 is .* the manifest says"):
        read_car_loop(store(tmp_path), manifest=digests)


@given(st.sampled_from(FILES), st.integers(0, 10**6))
def test_a_cut_text_is_refused_or_whole_rows(tmp_path_factory, name, cut):
    """A prefix that ends inside a row is refused; one that ends at a row is read as these rows or found too short."""
    folder = store(tmp_path_factory.mktemp("cut"))
    text = "\n".join(SMALL[name]) + "\n"
    piece = text[: cut % len(text)]
    (folder / name).write_bytes(gzip.compress(piece.encode()))
    rows = piece.count("\n") - 1
    if name == IMU and piece.endswith("\n") and rows > 300:
        assert len(read_car_loop(folder).time_s) == rows
    elif name == GNSS and piece.endswith("\n") and rows >= 7:
        assert len(read_car_loop(folder).gnss.time_s) == rows
    else:
        # A shorter second file may be named as the one that differs.
        with pytest.raises(LogError, match=r"\.csv\.gz: "):
            read_car_loop(folder)


@given(
    st.sampled_from(FILES),
    st.integers(0, 10**6),
    st.integers(0, 10**6),
    st.sampled_from(["nan", "", "-inf", "1e999", "x"]),
)
def test_bad_fields_and_swapped_rows_are_refused(tmp_path_factory, name, row, column, value):
    rows = len(SMALL[name]) - 1
    row, column = 1 + row % rows, column % len(SMALL[name][0].split(","))
    folder = tmp_path_factory.mktemp("bad")
    with pytest.raises(LogError, match=rf"{name}: row {row}: "):
        read_car_loop(store(folder, **changed(name, row, column, value)))
    lines = list(SMALL[name])
    other = 1 + (row + column) % rows
    if other != row:
        lines[row], lines[other] = lines[other], lines[row]
        with pytest.raises(LogError, match=rf"{name}: (row \d+: time goes|times_s must increase)"):
            read_car_loop(store(folder, **{name.split(".")[0]: lines}))


@given(st.sampled_from(FILES), st.binary(max_size=400))
def test_noise_is_refused(tmp_path_factory, name, noise):
    folder = store(tmp_path_factory.mktemp("noise"))
    head = SMALL[name][0].encode() + b"\n"
    for content in (noise, gzip.compress(noise), gzip.compress(head + noise)):
        (folder / name).write_bytes(content)
        with pytest.raises(LogError):
            read_car_loop(folder)


@given(st.sampled_from(FILES), st.integers(0, 10**9), st.integers(1, 255))
def test_a_flipped_byte_of_the_log_is_found_by_the_manifest(tmp_path_factory, name, place, flip):
    folder = tmp_path_factory.mktemp("flip")
    digests = json.loads((FOLDER / "manifest.json").read_text())
    for other in FILES:
        content = bytearray((FOLDER / other).read_bytes())
        if other == name:
            content[place % len(content)] ^= flip
            (folder / other).write_bytes(content)
        else:
            (folder / other).symlink_to(FOLDER / other)
    with pytest.raises(LogError, match=f"{name}: SHA-256"):
        read_car_loop(folder, manifest=digests)
