"""Reader of a sounding rocket's flight: inertial sensors and barometer, through ascent and a descent by parachute.

Units (degrees, degrees Celsius) and axes (the nose along the sensor's -y) end here.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests
from torchfilt.io.inertial import check_samples, check_times, refuse
from torchfilt.io.tables import Table, read_table

FILES = ("imu.csv.gz", "baro.csv.gz", "flightInfo.csv.gz")
_HEADERS = ("ts,id,Ax,Ay,Az,Gx,Gy,Gz", "ts,id,T,P", "ts,height,velocity,acceleration")
_LABELS = ("IMU0", "BARO0", None)
_KELVIN = 273.15
# Up to 30 km of height, and down to the Dead Sea.
_PRESSURE_PA = (1e3, 1.1e5)
# The files were written by one loop; the on-board filter's rows stand 5 ms beside the sensors'.
_END_TOLERANCE_S = 0.1
_MAX_GAP_S = 0.05


class Onboard(NamedTuple):
    """Another filter's answer, no truth, at times_s (r,): height_m above the start, velocity_m_s upward (r,)."""

    times_s: Tensor
    height_m: Tensor
    velocity_m_s: Tensor


class RocketDescent(NamedTuple):
    """t rows, float64, the clock at zero at lift-off.

    times_s (t,); gyro_rad_s, accel_m_s2 (specific force) (t, 3): body axes right, forward, up, the nose forward: on the
    launch rail the specific force is forward. pressure_pa, temperature_k (t,): the latter of the board, not of the air.
    """

    times_s: Tensor
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    pressure_pa: Tensor
    temperature_k: Tensor
    onboard: Onboard


def read_rocket_descent(folder: str | Path, *, manifest: Mapping[str, str] | str | Path | None = None) -> RocketDescent:
    """The flight in SI units, radians and body RFU.

    The files end without a line end, so that only a manifest finds a cut within the last row.

    Args:
        folder: holds the three `FILES`.
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.

    Raises:
        LogError: a file is damaged, cut short, foreign or implausible, or a digest differs from the manifest's. Rows
            are counted from 1 below the header, samples of the inertial sensor from 0.
        FileNotFoundError: a file is missing.
    """
    folder, digests = Path(folder), read_digests(manifest)
    imu, baro, onboard = (
        read_table(folder / name, header, digests, label=label, open_end=True)
        for name, header, label in zip(FILES, _HEADERS, _LABELS, strict=True)
    )
    accel, gyro = (_rfu(values) for values in imu.values.split(3, dim=-1))
    gyro = gyro.deg2rad()
    check_samples(imu.name, imu.time_s, gyro, accel, _MAX_GAP_S, "refuse")
    if not torch.equal(baro.time_s, imu.time_s):
        raise LogError(f"{baro.name}: times differ from those of {imu.name}")
    temperature, pressure = baro.values.unbind(-1)
    low, high = _PRESSURE_PA
    refuse(
        baro.name,
        (pressure < low) | (pressure > high),
        pressure,
        f"Pa of pressure, not from {low:g} to {high:g}; which unit is it?",
    )
    return RocketDescent(imu.time_s, gyro, accel, pressure, temperature + _KELVIN, _onboard(onboard, imu))


def _onboard(table: Table, imu: Table) -> Onboard:
    check_times(table.name, table.time_s)
    for end, word in ((0, "starts"), (-1, "ends")):
        off = (table.time_s[end] - imu.time_s[end]).item()
        if abs(off) > _END_TOLERANCE_S:
            raise LogError(
                f"{table.name}: {word} {abs(off):.6g} s {'after' if off > 0 else 'before'} {imu.name}; one of them is "
                "cut short"
            )
    return Onboard(table.time_s, table.values[:, 0].contiguous(), table.values[:, 1].contiguous())


def _rfu(sensor: Tensor) -> Tensor:
    """Turned by half a turn about z: the nose, along the sensor's -y, becomes forward."""
    return torch.stack([-sensor[:, 0], -sensor[:, 1], sensor[:, 2]], -1)
