"""The flight of the rocket: what its README promises, and refusal of every kind of damage."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfilt.io.files import LogError
from torchfilt.io.rocket_descent import FILES, read_rocket_descent

FOLDER = Path(__file__).parents[2] / "data" / "rocket_descent"
IMU, BARO, ONBOARD = FILES


def stored(name, columns):
    with gzip.open(FOLDER / name, "rt") as stream:
        return np.loadtxt(stream, delimiter=",", skiprows=1, usecols=columns)


@pytest.fixture(scope="module")
def log():
    return read_rocket_descent(FOLDER, manifest=FOLDER / "manifest.json")


# What the README says


def test_numbers_units_and_axes_are_those_of_the_files(log):
    imu, baro, onboard = stored(IMU, (0, 2, 3, 4, 5, 6, 7)), stored(BARO, (0, 2, 3)), stored(ONBOARD, range(3))
    assert len(imu) == len(baro) == 24564 and len(onboard) == 24563
    assert log.times_s.tolist() == imu[:, 0].tolist()
    # The sensor's axes are right = -x, forward = -y, up = z; a half turn has determinant 1.
    turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_array_equal(log.accel_m_s2, imu[:, 1:4] @ turn)
    np.testing.assert_allclose(log.gyro_rad_s, np.deg2rad(imu[:, 4:] @ turn), rtol=1e-15)
    assert log.pressure_pa.tolist() == baro[:, 2].tolist()
    np.testing.assert_allclose(log.temperature_k, baro[:, 1] + 273.15, rtol=1e-15)
    for found, expected in zip(log.onboard, onboard.T, strict=True):
        assert found.tolist() == expected.tolist()
    assert {value.dtype for value in (*log[:-1], *log.onboard)} == {torch.float64}


def test_times(log):
    assert (log.times_s[0].item(), log.times_s[-1].item()) == (-0.756, 244.874)
    np.testing.assert_allclose(log.times_s.diff(), 0.01, atol=1e-9)
    np.testing.assert_allclose(log.onboard.times_s - log.times_s[:-1], 0.005, atol=1e-9)


def test_the_nose_is_forward_on_the_rail_and_in_the_boost(log):
    """The first row is at rest; then the rail shakes by some m/s^2, about the same mean."""
    np.testing.assert_allclose(log.accel_m_s2[0], [-0.8, 9.9, -0.7], atol=0.05)
    still = log.accel_m_s2[log.times_s < -0.2]
    right, forward, up = still.mean(0).tolist()
    # 3 standard errors of the mean of a shaking of 2.7 m/s^2, for each axis: 0.8 % false alarms in all.
    assert abs(forward - 9.8) < 1.1 and max(abs(right), abs(up)) < 1.1
    boost = (log.times_s > 0.5) & (log.times_s < 2)
    right, forward, up = log.accel_m_s2[boost].mean(0).tolist()
    assert forward == pytest.approx(65, abs=2) and max(abs(right), abs(up)) < 2


def test_heights_and_forces_of_the_descent(log):
    time, pressure = log.times_s.numpy(), log.pressure_pa.numpy()
    height = 44330 * (1 - (pressure / pressure[time < 0].mean()) ** 0.190295)
    assert height.max() == pytest.approx(5252, abs=1) and time[height.argmax()] == pytest.approx(33.9, abs=0.05)
    assert log.onboard.height_m.max().item() == pytest.approx(5230, abs=1)
    late = (time > 60) & (time < 240)
    assert np.polyfit(time[late], height[late], 1)[0] == pytest.approx(-25, abs=0.5)
    rough = height - np.convolve(height, np.ones(101) / 101, "same")
    assert rough[late].std() == pytest.approx(2.2, abs=0.05)
    force = log.accel_m_s2.norm(dim=-1).numpy()[late]
    assert (force.mean(), force.std()) == (pytest.approx(11.1, abs=0.05), pytest.approx(1.6, abs=0.05))
    # Off during the ascent: the on-board filter does not follow it.
    other = np.interp(time, log.onboard.times_s, log.onboard.height_m)
    assert (height - other)[np.abs(time - 12) < 0.1].mean() > 50
    assert np.abs(np.median((height - other)[late])) < 10


def test_the_gyro_is_in_radians_a_second(log):
    fastest = log.gyro_rad_s.abs().max().item()
    assert fastest == pytest.approx(30.7, abs=0.05) == np.deg2rad(1757)
    late = (log.times_s > 60) & (log.times_s < 240)
    spin = log.gyro_rad_s[late, 1].rad2deg()
    assert spin.min() < -400 and spin.max() > 400


# Damage

COUNT = 120


def rows_of(name, count):
    return gzip.decompress((FOLDER / name).read_bytes()).decode().splitlines()[: count + 1]


SMALL = {name: rows_of(name, COUNT) for name in FILES}


def store(folder, end="", line_end="\n", **changed):
    """The three small files, as a rule without an end of the last line, with other lines for those named."""
    for name, lines in SMALL.items():
        lines = changed.get(name.split(".")[0], lines)
        (Path(folder) / name).write_bytes(gzip.compress((line_end.join(lines) + end).encode()))
    return folder


def changed(name, row, column, value):
    lines = list(SMALL[name])
    fields = lines[row].split(",")
    fields[column] = value
    lines[row] = ",".join(fields)
    return {name.split(".")[0]: lines}


def lines_of(name, *parts):
    return {name.split(".")[0]: [line for part in parts for line in SMALL[name][part]]}


def test_the_small_files_are_read_with_any_line_end(tmp_path):
    small = read_rocket_descent(store(tmp_path))
    assert small.times_s.shape == small.pressure_pa.shape == (COUNT,)
    for end, line_end in (("\n", "\n"), ("\r\n", "\r\n"), ("", "\r\n")):
        again = read_rocket_descent(str(store(tmp_path, end, line_end)))
        assert torch.equal(again.gyro_rad_s, small.gyro_rad_s)
        assert torch.equal(again.onboard.velocity_m_s, small.onboard.velocity_m_s)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(IMU, 5, 2, "nan"), "imu.csv.gz: row 5: .*values must be finite"),
        (changed(BARO, 5, 3, "inf"), "baro.csv.gz: row 5: .*values must be finite"),
        (changed(ONBOARD, 5, 1, "1e999"), "flightInfo.csv.gz: row 5: .*values must be finite"),
        (changed(IMU, 5, 2, "0.1x"), "imu.csv.gz: row 5: could not convert"),
        (changed(IMU, 5, 7, ""), "imu.csv.gz: row 5: could not convert"),
        (changed(IMU, 5, 2, "0.1,0.2"), "imu.csv.gz: row 5: 8 columns, expected 7"),
        (changed(IMU, 5, 1, "IMU1"), "imu.csv.gz: row 5: second column is 'IMU1', expected 'IMU0'"),
        (changed(BARO, 7, 1, ""), "baro.csv.gz: row 7: second column is '', expected 'BARO0'"),
        (changed(IMU, 0, 2, "ax"), "imu.csv.gz: header is 'ts,id,ax.*without the columns Ax; expected 'ts,id,Ax"),
        (changed(BARO, 0, 3, "P,more"), "baro.csv.gz: header .* with columns in another order or beside them"),
        (changed(IMU, 7, 0, "0.2"), "imu.csv.gz: times_s must increase, this one goes backward: sample 7"),
        (changed(IMU, 7, 5, "2100"), "imu.csv.gz: angular rate must be at most 35 rad/s: sample 6"),
        (changed(IMU, 7, 2, "210"), "imu.csv.gz: specific force must be at most 200 m/s.2: sample 6"),
        (changed(BARO, 3, 0, "-0.7365"), "baro.csv.gz: times differ from those of imu.csv.gz"),
        (changed(BARO, 3, 3, "996.1"), "baro.csv.gz: row 3: .* Pa of pressure, not from 1000 to 110000; which unit"),
        (changed(BARO, 3, 3, "120000"), "baro.csv.gz: row 3: .* Pa of pressure"),
        (changed(ONBOARD, 3, 0, "-0.741"), r"flightInfo.csv.gz: row 3: time goes from -0.741 s to -0.741 s"),
        (lines_of(IMU, slice(0, 5), slice(12, COUNT + 1)), "imu.csv.gz: .* no gap above 0.05 s: sample 4"),
        (lines_of(IMU, slice(0, 5), slice(4, None)), "imu.csv.gz: times_s must increase, this one is repeated: sample"),
        (lines_of(IMU, slice(0, 1)), "imu.csv.gz: no rows"),
        (lines_of(IMU, slice(0, 100)), "baro.csv.gz: times differ from those of imu.csv.gz"),
        (lines_of(BARO, slice(0, 100)), "baro.csv.gz: times differ from those of imu.csv.gz"),
        (
            lines_of(ONBOARD, slice(0, 100)),
            "flightInfo.csv.gz: ends 0.205 s before imu.csv.gz; one of them is cut short",
        ),
        (
            lines_of(ONBOARD, slice(0, 1), slice(20, None)),
            "flightInfo.csv.gz: starts 0.195 s after imu.csv.gz; one of them is cut short",
        ),
        ({"imu": [*SMALL[IMU][:5], "", *SMALL[IMU][5:]]}, "imu.csv.gz: row 5: "),
    ],
)
def test_damage_is_named_by_file_row_and_rule(tmp_path, change, words):
    with pytest.raises(LogError, match=words):
        read_rocket_descent(store(tmp_path, **change))


def test_files_are_whole_or_refused(tmp_path):
    store(tmp_path)
    whole = (tmp_path / IMU).read_bytes()
    for damaged in (whole[:-20], b"plain,text\n", b"", gzip.compress(b"\xff\xfe\n"), gzip.compress(b"")):
        (tmp_path / IMU).write_bytes(damaged)
        with pytest.raises(LogError, match=f"{IMU}: "):
            read_rocket_descent(tmp_path)
    (tmp_path / IMU).unlink()
    with pytest.raises(FileNotFoundError):
        read_rocket_descent(tmp_path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads((FOLDER / "manifest.json").read_text())
    assert read_rocket_descent(FOLDER, manifest=digests).times_s.shape == (24564,)
    with pytest.raises(LogError, match=r"baro.csv.gz: SHA-256 is .* the manifest says 00"):
        read_rocket_descent(FOLDER, manifest={**digests, BARO: "00"})
    with pytest.raises(LogError, match=r"imu.csv.gz: SHA-256 is .* the manifest says"):
        read_rocket_descent(store(tmp_path), manifest=digests)


@given(st.sampled_from(FILES), st.integers(0, 10**6))
def test_a_cut_text_is_refused_by_the_manifest_and_never_read_past_its_rows(tmp_path_factory, name, cut):
    """Without a manifest a cut within the last row may pass, as the reader says; rows are never invented."""
    folder = store(tmp_path_factory.mktemp("cut"))
    text = "\n".join(SMALL[name])
    piece = text[: cut % len(text)]
    (folder / name).write_bytes(gzip.compress(piece.encode()))
    try:
        small = read_rocket_descent(folder)
    except LogError:
        pass
    else:
        # A shorter file beside the two others passes only where it is the on-board one, by its tolerance.
        rows = piece.count("\n") + (not piece.endswith("\n")) - 1
        assert rows == COUNT or (name == ONBOARD and rows > COUNT - 12)
        assert len(small.onboard.times_s) == (rows if name == ONBOARD else COUNT)
    with pytest.raises(LogError, match="SHA-256"):
        read_rocket_descent(folder, manifest=json.loads((FOLDER / "manifest.json").read_text()))


@given(st.sampled_from(FILES), st.integers(0, 10**6), st.sampled_from(["nan", "", "-inf", "1e999", "x"]))
def test_bad_fields_are_refused(tmp_path_factory, name, place, value):
    columns = len(SMALL[name][0].split(","))
    row, column = 1 + place % COUNT, place // COUNT % columns
    with pytest.raises(LogError, match=rf"{name}: row {row}: "):
        read_rocket_descent(store(tmp_path_factory.mktemp("bad"), **changed(name, row, column, value)))
