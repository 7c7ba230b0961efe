"""Reader of a multirotor's low flight: inertial sensors, barometer, range finder, magnetometer, satellite receiver.

The log is a zip of text tables; it is read in memory, nothing is unpacked to disk. Units (milliseconds, degrees,
milligauss) and axes (forward, right, down) end here.
"""

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests, read_stored
from torchfilt.io.inertial import check_samples, check_times, refuse
from torchfilt.io.tables import read_rows

ARCHIVE = "quad_baro_range.zip"
# Members that are read, with their columns; the first is the time in ms.
COLUMNS = {"IMU.txt": 8, "MAG.txt": 8, "NTUN.txt": 10, "FLOW.txt": 8, "GPS.txt": 14, "ATT.txt": 7}
# Members of the original archive that say nothing more: held copies of the range, constants.
_PASSED = ("DIST.txt", "timing.txt")
# The largest table of 849 s has 5.5 MB.
_MAX_MEMBER_BYTES = 16 * 2**20
_MAX_GAP_S = 0.06
_END_TOLERANCE_S = 1.5
_MILLIGAUSS_TESLA = 1e-7
# The sensor's own reach; its 0 means that it saw nothing.
_MAX_RANGE_M = 10.0
_MAX_HEIGHT_M = 500.0


class Fixes(NamedTuple):
    """Satellite receiver, g rows: time_s, latitude_rad, longitude_rad, speed_m_s, course_rad, velocity_up_m_s.

    height_m: what the log calls the receiver's height. It follows the range finder to some cm over the whole flight
    and lacks a receiver's wander, so it is the on-board filter's height: no independent witness.
    """

    time_s: Tensor
    latitude_rad: Tensor
    longitude_rad: Tensor
    speed_m_s: Tensor
    course_rad: Tensor
    velocity_up_m_s: Tensor
    height_m: Tensor


class Attitude(NamedTuple):
    """Another filter's answer, no truth: time_s, roll_rad (right side down), pitch_rad (nose up), heading_rad (a,)."""

    time_s: Tensor
    roll_rad: Tensor
    pitch_rad: Tensor
    heading_rad: Tensor


class QuadBaroRange(NamedTuple):
    """One flight, float64, each sensor at its own times of one clock, as received (for delays see the README).

    imu_time_s (t,), gyro_rad_s, accel_m_s2 (specific force) (t, 3), body right, forward, up. gaps (k,): rows after
    a gap, int64. baro_time_s, baro_height_m (b,): above the start, drifting. range_time_s, range_m (r,): along body
    axis down to the ground, one row a measurement, NaN where the sensor saw nothing. field_time_s (m,), field_tesla
    (m, 3): body right, forward, up. fixes, onboard: see there.
    """

    imu_time_s: Tensor
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    gaps: Tensor
    baro_time_s: Tensor
    baro_height_m: Tensor
    range_time_s: Tensor
    range_m: Tensor
    field_time_s: Tensor
    field_tesla: Tensor
    fixes: Fixes
    onboard: Attitude


def read_quad_baro_range(path: str | Path, *, manifest: Mapping[str, str] | str | Path | None = None) -> QuadBaroRange:
    """The flight in SI units, radians and body RFU.

    Args:
        path: the archive: the one of this repository or the original, or a folder that holds `ARCHIVE`.
        manifest: SHA-256 of the archive by name, or a JSON file that holds it.

    Returns:
        A `QuadBaroRange`, float64, of the times as received.

    Raises:
        LogError: the archive is damaged, has members that are foreign, double, encrypted or too large; a table is cut
            short or implausible; a digest differs from the manifest's. Rows are counted from 1, samples from 0.
        FileNotFoundError: no archive.
    """
    path = Path(path)
    if path.is_dir():
        path /= ARCHIVE
    imu, mag, tune, flow, gps, att = _tables(path, read_digests(manifest)).values()
    gyro, accel = _rfu(imu[:, 2:5]), _rfu(imu[:, 5:8])
    clock = imu[:, 0].contiguous()
    gaps = check_samples("IMU.txt", clock, gyro, accel, _MAX_GAP_S, "mark")
    for name, table in (("MAG.txt", mag), ("NTUN.txt", tune), ("FLOW.txt", flow), ("GPS.txt", gps)):
        check_times(name, table[:, 0])
        _check_ends(name, table[:, 0], clock)
    height, distance = tune[:, 8].contiguous(), flow[:, 3]
    refuse(
        "NTUN.txt", height.abs() > _MAX_HEIGHT_M, height, f"m of height, more than {_MAX_HEIGHT_M:g}; which unit is it?"
    )
    bad = (distance < 0) | (distance > _MAX_RANGE_M)
    refuse("FLOW.txt", bad, distance, f"m of range, not from 0 to {_MAX_RANGE_M:g}; which unit is it?")
    return QuadBaroRange(
        clock,
        gyro,
        accel,
        gaps,
        tune[:, 0].contiguous(),
        height,
        flow[:, 0].contiguous(),
        torch.where(distance > 0, distance, torch.nan),
        mag[:, 0].contiguous(),
        _rfu(mag[:, 2:5]) * _MILLIGAUSS_TESLA,
        _fixes(gps),
        _attitude(att, clock),
    )


def _fixes(gps: Tensor) -> Fixes:
    time, latitude, longitude, height, speed, course, down = gps[:, [0, 6, 7, 8, 10, 11, 12]].mT.contiguous()
    refuse("GPS.txt", gps[:, 1] < 3, gps[:, 1], "as status of the fix; it must be 3")
    refuse("GPS.txt", latitude.abs() > 90, latitude, "degrees of latitude")
    refuse("GPS.txt", longitude.abs() > 180, longitude, "degrees of longitude")
    return Fixes(time, latitude.deg2rad(), longitude.deg2rad(), speed, course.deg2rad(), -down, height)


def _attitude(att: Tensor, clock: Tensor) -> Attitude:
    # Some rows are written twice.
    again = torch.cat([torch.zeros(1, dtype=torch.bool), att[1:, 0] == att[:-1, 0]])
    time, roll, pitch, heading = att[~again][:, [0, 2, 3, 4]].mT.contiguous()
    check_times("ATT.txt", time)
    _check_ends("ATT.txt", time, clock)
    return Attitude(time, roll.deg2rad(), pitch.deg2rad(), heading.deg2rad())


def _check_ends(name: str, time: Tensor, clock: Tensor) -> None:
    for end, word in ((0, "starts"), (-1, "ends")):
        off = (time[end] - clock[end]).item()
        if abs(off) > _END_TOLERANCE_S:
            side = "after" if off > 0 else "before"
            raise LogError(f"{name}: {word} {abs(off):.6g} s {side} IMU.txt; one of them is cut short")


def _rfu(frd: Tensor) -> Tensor:
    """Forward, right, down turned to right, forward, up."""
    return torch.stack([frd[:, 1], frd[:, 0], -frd[:, 2]], -1)


# Archive --------------------------------------------------------------------------------------------------------------


def _tables(path: Path, digests: Mapping[str, str] | None) -> dict[str, Tensor]:
    """Tables (rows, columns) by the order of `COLUMNS`, the time in seconds."""
    stored = read_stored(path, digests)
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            _check_members(path.name, archive.infolist())
            return {name: _table(name, _member(archive, name), count) for name, count in COLUMNS.items()}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, UnicodeDecodeError) as error:
        raise LogError(f"{path.name}: not a whole zip archive: {error}") from error


def _check_members(archive: str, members: list[zipfile.ZipInfo]) -> None:
    seen: set[str] = set()
    for member in members:
        name = member.filename
        if name not in COLUMNS and name not in _PASSED:
            raise LogError(f"{archive}: member {name[:80]!r} is foreign; expected {', '.join((*COLUMNS, *_PASSED))}")
        if name in seen:
            raise LogError(f"{archive}: member {name!r} is there twice")
        if member.flag_bits & 1:
            raise LogError(f"{archive}: member {name!r} is encrypted")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise LogError(f"{archive}: member {name!r} is packed by method {member.compress_type}, not by deflate")
        seen.add(name)
    absent = [name for name in COLUMNS if name not in seen]
    if absent:
        raise LogError(f"{archive}: no member {', '.join(absent)}")


def _member(archive: zipfile.ZipFile, name: str) -> str:
    # The size that a member states may be a lie: what is read is bounded by itself.
    with archive.open(name) as stream:
        text = stream.read(_MAX_MEMBER_BYTES + 1)
    if len(text) > _MAX_MEMBER_BYTES:
        raise LogError(f"{name}: more than the limit of {_MAX_MEMBER_BYTES} bytes when unpacked")
    try:
        return text.decode("ascii")
    except UnicodeDecodeError as error:
        raise LogError(f"{name}: not plain text at byte {error.start}") from error


def _table(name: str, text: str, columns: int) -> Tensor:
    if not text.endswith("\n"):
        raise LogError(f"{name}: row {text.count(chr(10)) + 1}: no line end; the table is cut short")
    lines = text.replace("\r\n", "\n").split("\n")[:-1]
    table = read_rows(name, lines, columns)
    return torch.cat([table[:, :1] / 1000, table[:, 1:]], -1)
