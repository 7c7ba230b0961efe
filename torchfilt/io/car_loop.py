"""Reader of a car's drive round an urban loop: consumer inertial sensor, satellite receiver and its fused solution.

Units (degrees), axes (sensor forward-left-up, velocity and deviations north-east-down) and values that the receiver
writes before it knows (zero) end here.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests
from torchfilt.io.inertial import (
    Gaps,
    GnssFixes,
    InertialLog,
    Reference,
    check_fixes,
    check_samples,
    check_times,
)
from torchfilt.io.tables import Table, read_table

FILES = ("imu.csv.gz", "gnss.csv.gz", "reference_position.csv.gz", "reference_attitude.csv.gz")
# Until then the receiver's own solution has not settled.
SCORE_FROM_S = 60.0
_IMU = "t_s,gx_radps,gy_radps,gz_radps,ax_mps2,ay_mps2,az_mps2"
_GNSS = (
    "t_s,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,pos_std_n_m,pos_std_e_m,pos_std_d_m,"
    "vel_std_n_mps,vel_std_e_mps,vel_std_d_mps,heading_rad"
)
_POSITION = "t_s,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,heading_rad"
_ATTITUDE = "t_s,roll_deg,pitch_deg,yaw_deg"
# The four files were cut to one span; the slowest of them has a row each half second.
_END_TOLERANCE_S = 1.0


def read_car_loop(
    folder: str | Path,
    *,
    manifest: Mapping[str, str] | str | Path | None = None,
    max_gap_s: float = 0.05,
    gaps: Gaps = "refuse",
) -> InertialLog:
    """The drive in SI units, radians, body RFU and ENU.

    The sensor's axes are turned as if it were mounted squarely; it is so within a few degrees. The receiver's heading
    and the reference's attitude are NaN until the receiver writes them: heading and pitch from about 9 s, roll from
    about 40 s; score from `SCORE_FROM_S` on. Messages count rows from 1 below the header.

    Args:
        folder: holds the four `FILES`.
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.
        max_gap_s: longest step between inertial samples.
        gaps: "refuse" a longer step, or "mark" it in the log.

    Raises:
        LogError: a file is damaged, cut short, foreign or implausible, or a digest differs from the manifest's.
        FileNotFoundError: a file is missing.
    """
    folder, digests = Path(folder), read_digests(manifest)
    columns = (_IMU, _GNSS, _POSITION, _ATTITUDE)
    imu, gnss, position, attitude = (
        read_table(folder / name, header, digests) for name, header in zip(FILES, columns, strict=True)
    )
    gyro, accel = (_rfu(values) for values in imu.values.split(3, dim=-1))
    marked = check_samples(imu.name, imu.time_s, gyro, accel, max_gap_s, gaps)
    fixes = _fixes(gnss)
    reference = _reference(position, attitude)
    for table in (gnss, position):
        off = (table.time_s[-1] - imu.time_s[-1]).item()
        if abs(off) > _END_TOLERANCE_S:
            raise LogError(
                f"{table.name}: ends {abs(off):.6g} s {'after' if off > 0 else 'before'} {imu.name}; one of them is "
                "cut short"
            )
    return InertialLog(imu.time_s, gyro, accel, fixes, reference, marked)


def _fixes(table: Table) -> GnssFixes:
    latitude, longitude, height = _geodetic(table)
    position_sd, velocity_sd = (values[:, [1, 0, 2]] for values in table.values[:, 6:12].split(3, dim=-1))
    heading = _once_known(table.values[:, 12])
    fixes = GnssFixes(
        table.time_s, latitude, longitude, height, _enu(table.values[:, 3:6]), position_sd, velocity_sd, heading
    )
    check_fixes(table.name, fixes)
    return fixes


def _reference(position: Table, attitude: Table) -> Reference:
    for table in (position, attitude):
        check_times(table.name, table.time_s)
    if not torch.equal(position.time_s, attitude.time_s):
        raise LogError(f"{attitude.name}: times differ from those of {position.name}")
    latitude, longitude, height = _geodetic(position)
    velocity = _enu(position.values[:, 3:6])
    check_fixes(position.name, GnssFixes(position.time_s, latitude, longitude, height, velocity))
    roll, pitch, yaw = attitude.values.unbind(-1)
    # Yaw becomes known first; a pitch before that is of no use.
    yaw = _once_known(yaw)
    pitch = torch.where(yaw.isnan(), torch.nan, pitch)
    heading, pitch, roll = (_wrapped(value.deg2rad()) for value in (yaw, pitch, _once_known(roll)))
    return Reference(position.time_s, heading, pitch, roll, latitude, longitude, height, velocity)


def _geodetic(table: Table) -> tuple[Tensor, Tensor, Tensor]:
    return table.values[:, 0].deg2rad(), table.values[:, 1].deg2rad(), table.values[:, 2]


def _rfu(flu: Tensor) -> Tensor:
    """Forward, left, up to right, forward, up."""
    return torch.stack([-flu[:, 1], flu[:, 0], flu[:, 2]], -1)


def _enu(ned: Tensor) -> Tensor:
    return torch.stack([ned[:, 1], ned[:, 0], -ned[:, 2]], -1)


def _once_known(values: Tensor) -> Tensor:
    """NaN in place of the zeros that stand before the first other value."""
    known = (values != 0).cumsum(0) > 0
    return torch.where(known, values, torch.nan)


def _wrapped(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
