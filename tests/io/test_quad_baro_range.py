"""The flight of the multirotor: what its README promises, and refusal of every kind of damage."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfilt.io.files import LogError
from torchfilt.io.quad_baro_range import ARCHIVE, COLUMNS, read_quad_baro_range

FOLDER = Path(__file__).parents[2] / "data" / "quad_baro_range"
MANIFEST = FOLDER / "manifest.json"


def stored(name):
    with zipfile.ZipFile(FOLDER / ARCHIVE) as archive:
        return np.loadtxt(archive.read(name).decode().splitlines())


@pytest.fixture(scope="module")
def log():
    return read_quad_baro_range(FOLDER, manifest=MANIFEST)


# What the README says


def test_numbers_units_and_axes_are_those_of_the_tables(log):
    imu, mag, tune, flow, gps, att = (stored(name) for name in COLUMNS)
    assert [len(t) for t in (imu, mag, tune, flow, gps, att)] == [40520, 8115, 8117, 8051, 4235, 9700]
    # Forward, right, down to right, forward, up: a rotation, its determinant is 1.
    turn = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_array_equal(log.gyro_rad_s, imu[:, 2:5] @ turn.T)
    np.testing.assert_array_equal(log.accel_m_s2, imu[:, 5:8] @ turn.T)
    np.testing.assert_allclose(log.field_tesla, mag[:, 2:5] @ turn.T * 1e-7, rtol=1e-15)
    assert log.baro_height_m.tolist() == tune[:, 8].tolist()
    seen = flow[:, 3] > 0
    assert log.range_m[seen].tolist() == flow[seen, 3].tolist() and log.range_m[~seen].isnan().all()
    for time, table in (
        (log.imu_time_s, imu),
        (log.field_time_s, mag),
        (log.baro_time_s, tune),
        (log.range_time_s, flow),
        (log.fixes.time_s, gps),
        (log.onboard.time_s, att),
    ):
        np.testing.assert_allclose(time, table[:, 0] / 1e3, rtol=1e-15)
    fixes = log.fixes
    np.testing.assert_allclose(fixes.latitude_rad.rad2deg(), gps[:, 6], rtol=1e-14)
    np.testing.assert_allclose(fixes.longitude_rad.rad2deg(), gps[:, 7], rtol=1e-14)
    np.testing.assert_allclose(fixes.course_rad.rad2deg(), gps[:, 11], rtol=1e-14)
    assert fixes.height_m.tolist() == gps[:, 8].tolist() and fixes.speed_m_s.tolist() == gps[:, 10].tolist()
    assert fixes.velocity_up_m_s.tolist() == (-gps[:, 12]).tolist()
    for found, column in zip(log.onboard[1:], att[:, 2:5].T, strict=True):
        np.testing.assert_allclose(found.rad2deg(), column, rtol=1e-14, atol=1e-13)
    plain = [*log[:3], *log[4:10], *fixes, *log.onboard]
    assert {value.dtype for value in plain} == {torch.float64} and log.gaps.dtype == torch.int64


def test_times_and_gaps(log):
    assert (log.imu_time_s[0].item(), log.imu_time_s[-1].item()) == (0.0, 848.921)
    assert log.imu_time_s.diff().median().item() == pytest.approx(0.021)
    np.testing.assert_allclose(log.imu_time_s[log.gaps], [428.144, 429.193, 430.191], atol=1e-9)
    assert log.range_time_s.diff().median().item() == pytest.approx(0.105)


def test_gravity_field_and_heights(log):
    up = log.accel_m_s2.mean(0)
    assert up[2].item() == pytest.approx(9.70, abs=0.01) and up[:2].abs().max() < 0.5
    norm = log.field_tesla.norm(dim=-1)
    assert norm.mean().item() == pytest.approx(59.5e-6, abs=0.1e-6) and norm.std().item() < 1.5e-6
    heard = log.range_m[~log.range_m.isnan()]
    assert (heard.min().item(), heard.max().item()) == (0.13, 4.27)
    assert log.range_m.isnan().sum() == 2
    # The field of Melbourne points up (inclination -69 deg): upward part positive, and larger than the horizontal one.
    assert log.field_tesla[:, 2].mean() > 45e-6


def test_the_receivers_height_is_no_witness(log):
    """It follows the range finder in each minute to some cm, while the receiver's own upward velocity is biased."""
    time = log.fixes.time_s.numpy()
    seen = ~log.range_m.isnan().numpy()
    off = log.fixes.height_m.numpy() - np.interp(time, log.range_time_s.numpy()[seen], log.range_m.numpy()[seen])
    minutes = [off[(time >= k) & (time < k + 60)].mean() for k in range(40, 820, 60)]
    assert np.abs(minutes).max() < 0.06
    cruise = (time > 50) & (time < 430)
    assert log.fixes.velocity_up_m_s.numpy()[cruise].mean() * 380 > 100


# Damage

ROWS = 60


def rows_of(name):
    """The first 1.5 s or so: the tables of a small archive."""
    with zipfile.ZipFile(FOLDER / ARCHIVE) as archive:
        return archive.read(name).decode().splitlines()[: ROWS if name == "IMU.txt" else ROWS // 4]


SMALL = {name: rows_of(name) for name in COLUMNS}


def text_of(lines, end="\n"):
    return (end.join(lines) + end).encode()


def store(folder, end="\n", method=zipfile.ZIP_DEFLATED, extra=(), **changed):
    """A small archive, with other content for the members that are named; None leaves one out."""
    path = Path(folder) / ARCHIVE
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, lines in SMALL.items():
            content = changed.get(name.split(".")[0], lines)
            if content is not None:
                archive.writestr(name, content if isinstance(content, bytes) else text_of(content, end))
        for name, content in extra:
            archive.writestr(name, content)
    return path


def changed(name, row, column, value):
    lines = list(SMALL[name])
    fields = lines[row - 1].split()
    fields[column] = value
    lines[row - 1] = " ".join(fields)
    return {name.split(".")[0]: lines}


def test_small_archives_are_read_with_any_line_end_packed_or_not(tmp_path):
    small = read_quad_baro_range(store(tmp_path))
    assert small.imu_time_s.shape == (ROWS,) and small.range_m.shape == (ROWS // 4,)
    for end, method in (("\r\n", zipfile.ZIP_DEFLATED), ("\n", zipfile.ZIP_STORED)):
        extra = [("DIST.txt", "anything"), ("timing.txt", "")]
        again = read_quad_baro_range(str(store(tmp_path, end, method, extra)))
        assert torch.equal(again.gyro_rad_s, small.gyro_rad_s) and torch.equal(
            again.fixes.height_m, small.fixes.height_m
        )


def test_rows_of_the_attitude_that_are_written_twice_count_once(tmp_path):
    lines = [line for line in SMALL["ATT.txt"] for _ in range(2)]
    once = read_quad_baro_range(store(tmp_path)).onboard
    twice = read_quad_baro_range(store(tmp_path, ATT=lines)).onboard
    assert torch.equal(once.roll_rad, twice.roll_rad) and torch.equal(once.time_s, twice.time_s)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed("IMU.txt", 5, 2, "nan"), "IMU.txt: row 5: .*values must be finite"),
        (changed("GPS.txt", 5, 13, "1e999"), "GPS.txt: row 5: .*values must be finite"),
        (changed("NTUN.txt", 5, 8, "0.1x"), "NTUN.txt: row 5: could not convert"),
        (changed("MAG.txt", 5, 2, "1 2"), "MAG.txt: row 5: 9 columns, expected 8"),
        ({"FLOW": [line + " 1" for line in SMALL["FLOW.txt"]]}, "FLOW.txt: row 1: 9 columns, expected 8"),
        (changed("IMU.txt", 7, 0, "100"), "IMU.txt: times_s must increase, this one goes backward"),
        (changed("IMU.txt", 7, 0, SMALL["IMU.txt"][5].split()[0]), "IMU.txt: times_s must increase, this one is repea"),
        (changed("IMU.txt", 7, 3, "40"), "IMU.txt: angular rate must be at most 35 rad/s: sample 6"),
        (changed("IMU.txt", 7, 7, "-210"), "IMU.txt: specific force must be at most 200 m/s.2: sample 6"),
        (changed("NTUN.txt", 3, 0, "50"), "NTUN.txt: row 3: time goes from .* to 0.05 s; it must increase"),
        (changed("FLOW.txt", 3, 0, "22"), "FLOW.txt: row 3: time goes from 0.022 s to 0.022 s; it must increase"),
        (changed("MAG.txt", 9, 0, "50"), "MAG.txt: row 9: time goes"),
        (changed("GPS.txt", 2, 0, "8"), "GPS.txt: row 2: time goes"),
        (changed("ATT.txt", 4, 0, "1"), "ATT.txt: row 4: time goes"),
        (changed("NTUN.txt", 3, 8, "-501"), "NTUN.txt: row 3: got -501.0 m of height, more than 500"),
        (changed("FLOW.txt", 4, 3, "13"), "FLOW.txt: row 4: got 13.0 m of range, not from 0 to 10; which unit"),
        (changed("FLOW.txt", 4, 3, "-0.1"), "FLOW.txt: row 4: got -0.1 m of range"),
        (changed("GPS.txt", 4, 1, "2"), "GPS.txt: row 4: got 2.0 as status of the fix; it must be 3"),
        (changed("GPS.txt", 4, 6, "-91"), "GPS.txt: row 4: got -91.0 degrees of latitude"),
        (changed("GPS.txt", 4, 7, "1447"), "GPS.txt: row 4: got 1447.0 degrees of longitude"),
        ({"NTUN": SMALL["NTUN.txt"][:1]}, "NTUN.txt: 1 rows, at least 2"),
        ({"IMU": [*SMALL["IMU.txt"], "9000 9000 0 0 0 0 0 -9.8"]}, "MAG.txt: ends .* s before IMU.txt; one of them is"),
        (
            {"MAG": [*SMALL["MAG.txt"], "9000 9000 210 95 -517 0 0 0"]},
            "MAG.txt: ends .* s after IMU.txt; one of them is cut short",
        ),
        ({"IMU": [*SMALL["IMU.txt"][:5], "", *SMALL["IMU.txt"][5:]]}, "IMU.txt: row 6: 0 columns"),
        ({"IMU": b""}, "IMU.txt: row 1: no line end; the table is cut short"),
        ({"IMU": text_of(SMALL["IMU.txt"])[:-1]}, "IMU.txt: row 60: no line end; the table is cut short"),
        ({"IMU": b"\xff\xfe\n"}, "IMU.txt: not plain text at byte 0"),
        ({"IMU": None, "ATT": None}, f"{ARCHIVE}: no member IMU.txt, ATT.txt"),
    ],
)
def test_damage_is_named_by_table_row_and_rule(tmp_path, change, words):
    with pytest.raises(LogError, match=words):
        read_quad_baro_range(store(tmp_path, **change))


def test_a_late_start_of_a_table_is_refused(tmp_path):
    later = [" ".join([str(float(line.split()[0]) + 1600), *line.split()[1:]]) for line in SMALL["MAG.txt"]]
    with pytest.raises(LogError, match=r"MAG.txt: starts 1\.6.* s after IMU.txt"):
        read_quad_baro_range(store(tmp_path, MAG=later))


# Hostile archives


@pytest.mark.parametrize("name", ["../IMU.txt", "/etc/passwd", "IMU.txt/", "imu.txt", "a/IMU.txt", "IMU.txt\x7f"])
def test_foreign_members_are_refused_and_nothing_is_written(tmp_path, name):
    path = store(tmp_path, extra=[(name, "1 2 3\n")])
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(LogError, match=f"{ARCHIVE}: member .* is foreign; expected IMU.txt, MAG.txt"):
        read_quad_baro_range(path)
    assert sorted(tmp_path.rglob("*")) == before


def test_members_that_are_there_twice_encrypted_or_packed_otherwise(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = store(tmp_path, extra=[("IMU.txt", "1 2 3\n")])
    with pytest.raises(LogError, match=f"{ARCHIVE}: member 'IMU.txt' is there twice"):
        read_quad_baro_range(path)
    with pytest.raises(LogError, match=f"{ARCHIVE}: member 'IMU.txt' is packed by method 14, not by deflate"):
        read_quad_baro_range(store(tmp_path, method=zipfile.ZIP_LZMA))
    whole = bytearray(store(tmp_path).read_bytes())
    directory = whole.index(b"PK\x01\x02")
    whole[directory + 8] |= 1
    path.write_bytes(whole)
    with pytest.raises(LogError, match=f"{ARCHIVE}: member 'IMU.txt' is encrypted"):
        read_quad_baro_range(path)


def test_a_bomb_is_stopped_at_the_limit_whatever_size_it_states(tmp_path):
    path = store(tmp_path, IMU=bytes(17 * 2**20))
    assert path.stat().st_size < 2**16
    with pytest.raises(LogError, match=r"IMU.txt: more than the limit of 16777216 bytes when unpacked"):
        read_quad_baro_range(path)
    # A directory that says 100 bytes: the archive breaks its own word and is refused all the same.
    whole = bytearray(path.read_bytes())
    directory = whole.index(b"PK\x01\x02")
    whole[directory + 24 : directory + 28] = (100).to_bytes(4, "little")
    path.write_bytes(whole)
    with pytest.raises(LogError):
        read_quad_baro_range(path)


def test_large_absent_and_foreign_files(tmp_path):
    path = tmp_path / ARCHIVE
    with pytest.raises(FileNotFoundError):
        read_quad_baro_range(tmp_path)
    for content in (b"", b"plain text\n", b"PK\x03\x04", (FOLDER / ARCHIVE).read_bytes()[:-30]):
        path.write_bytes(content)
        with pytest.raises(LogError, match=f"{ARCHIVE}: not a whole zip archive"):
            read_quad_baro_range(path)
    with path.open("wb") as stream:
        stream.truncate(17 * 2**20)
    with pytest.raises(LogError, match="17825792 bytes, more than the limit"):
        read_quad_baro_range(path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads(MANIFEST.read_text())
    assert set(digests) == {"LICENSE.upstream", ARCHIVE}
    with pytest.raises(LogError, match=r"SHA-256 is .* the manifest says 00"):
        read_quad_baro_range(FOLDER, manifest={ARCHIVE: "00"})
    with pytest.raises(LogError, match=r"SHA-256 is .* the manifest says"):
        read_quad_baro_range(store(tmp_path), manifest=digests)


def packed():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, lines in SMALL.items():
            archive.writestr(name, text_of(lines))
    return buffer.getvalue()


PACKED = packed()


@given(st.integers(0, len(PACKED) - 1))
def test_a_cut_archive_is_refused(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("cut") / ARCHIVE
    path.write_bytes(PACKED[:cut])
    with pytest.raises(LogError):
        read_quad_baro_range(path)


@given(st.integers(0, len(PACKED) - 1), st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path_factory, place, bit):
    """Bits of dates and the like may flip unseen; numbers are guarded by the archive's own check sums."""
    folder = tmp_path_factory.mktemp("flip")
    path = folder / ARCHIVE
    path.write_bytes(PACKED)
    whole = read_quad_baro_range(path)
    flipped = bytearray(PACKED)
    flipped[place] ^= 1 << bit
    path.write_bytes(flipped)
    try:
        again = read_quad_baro_range(path)
    except LogError:
        return
    for before, after in zip(
        [*whole[:10], *whole.fixes, *whole.onboard], [*again[:10], *again.fixes, *again.onboard], strict=True
    ):
        assert torch.equal(before.nan_to_num(-1), after.nan_to_num(-1))


@given(st.sampled_from(list(COLUMNS)), st.integers(0, 10**6), st.sampled_from(["nan", "-inf", "1e999", "x", "0x1"]))
def test_bad_fields_are_refused(tmp_path_factory, name, place, value):
    row, column = 1 + place % len(SMALL[name]), place // len(SMALL[name]) % COLUMNS[name]
    with pytest.raises(LogError, match=rf"{name}: row {row}: "):
        read_quad_baro_range(store(tmp_path_factory.mktemp("bad"), **changed(name, row, column, value)))
