"""Reader of a small fixed-wing aircraft's flight: inertial sensors, magnetometer, barometer and satellite receiver.

Units (degrees, gauss), axes (forward-right-down, north-east-down), the magnetometer's offsets, held fixes and the
on-board filter's biases end here.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests
from torchfilt.io.inertial import Gaps, GnssFixes, InertialLog, Reference, check_finite, check_fixes, check_samples
from torchfilt.io.matlab import read_structure

FILE = "thor_flight75_WaypointTracker_150squareWaypointNew_2012_10_10.mat"
# Airspeed above 12 m/s.
AIRBORNE_S = (211.7, 577.0)
# Before that the logger had not yet set the barometer's zero.
_BAROMETER_FROM_S = 4.03
_FIELDS = (
    *("time", "p", "q", "r", "p_bias", "q_bias", "r_bias", "ax", "ay", "az", "ax_bias", "ay_bias", "az_bias"),
    *("imuStatus", "hx", "hy", "hz", "h", "lat", "lon", "alt", "vn", "ve", "vd", "GPS_TOW", "satVisible"),
    *("navlat", "navlon", "navalt", "navvn", "navve", "navvd", "phi", "theta", "psi", "navValid"),
)
_TESLA_PER_GAUSS = 1e-4
# Offsets of the magnetometer, gauss, in body forward-right-down; its own y and z axes are turned.
_OFFSETS_GAUSS = (-0.41071, 0.18758, -0.37739)


def read_uav_thor(
    folder: str | Path,
    *,
    raw: bool = True,
    manifest: Mapping[str, str] | str | Path | None = None,
    max_gap_s: float = 0.05,
    gaps: Gaps = "refuse",
) -> InertialLog:
    """The flight in SI units, radians, body RFU and ENU.

    Samples before the inertial sensor reports are left out, and so are fixes without satellites in view. The
    reference is the on-board filter's answer, NaN where it calls itself invalid. Pressure height counts from the start
    point; it is NaN before its zero was set (4 s).

    Args:
        folder: holds `FILE`.
        raw: give the sensors' own output; False leaves the on-board filter's estimate of the biases taken out.
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.
        max_gap_s: longest step between inertial samples.
        gaps: "refuse" a longer step, or "mark" it in the log.

    Raises:
        LogError: the file is damaged, foreign or implausible, or a digest differs from the manifest's.
        FileNotFoundError: the file is missing.
    """
    path = Path(folder) / FILE
    data = _read_fields(path, read_digests(manifest))
    for name in _FIELDS:
        check_finite(path.name, name, data[name])

    def columns(*names: str) -> Tensor:
        return torch.stack([data[name] for name in names], -1)

    gyro, accel = columns("p", "q", "r"), columns("ax", "ay", "az")
    if raw:
        gyro = gyro + columns("p_bias", "q_bias", "r_bias")
        accel = accel + columns("ax_bias", "ay_bias", "az_bias")
    works = data["imuStatus"] > 0
    if not works.any():
        raise LogError(f"{path.name}: the inertial sensor never reports (imuStatus)")
    start = int(works.nonzero()[0])
    time, gyro, accel = data["time"][start:], _swapped(gyro)[start:], _swapped(accel)[start:]
    marked = check_samples(path.name, time, gyro, accel, max_gap_s, gaps)
    fixes = _fixes(path.name, data)
    x, y, z = _OFFSETS_GAUSS
    field = torch.stack([data["hx"] + x, y - data["hy"], z - data["hz"]], -1) * _TESLA_PER_GAUSS
    return InertialLog(
        time,
        gyro,
        accel,
        fixes,
        _reference(data),
        marked,
        pressure_height_m=torch.where(time < _BAROMETER_FROM_S, torch.nan, data["h"][start:]),
        magnetic_field_tesla=_swapped(field)[start:],
    )


def _fixes(name: str, data: Mapping[str, Tensor]) -> GnssFixes:
    """The fixes at which the receiver's own time changes."""
    new = torch.zeros(len(data["time"]), dtype=torch.bool)
    new[1:] = data["GPS_TOW"].diff() != 0
    new &= data["satVisible"] > 0
    if new.sum() < 2:
        raise LogError(f"{name}: {int(new.sum())} satellite fixes, at least 2 are needed")
    velocity = _swapped(torch.stack([data["vn"], data["ve"], data["vd"]], -1))
    latitude, longitude = data["lat"].deg2rad(), data["lon"].deg2rad()
    fixes = GnssFixes(*(values[new] for values in (data["time"], latitude, longitude, data["alt"], velocity)))
    check_fixes(name, fixes)
    return fixes


def _reference(data: Mapping[str, Tensor]) -> Reference:
    """The on-board solution: a row has seen the sensor's samples up to the row before, and has that row's time."""
    invalid = data["navValid"] != 0
    names = ("psi", "theta", "phi", "navlat", "navlon", "navalt", "navvn", "navve", "navvd")
    psi, pitch, roll, latitude, longitude, height, *ned = (
        torch.where(invalid, torch.nan, data[name])[1:] for name in names
    )
    heading = torch.remainder(psi + torch.pi, 2 * torch.pi) - torch.pi
    return Reference(
        data["time"][:-1], heading, pitch, roll, latitude, longitude, height, _swapped(torch.stack(ned, -1))
    )


def _swapped(vectors: Tensor) -> Tensor:
    """Forward-right-down to right-forward-up, north-east-down to east-north-up."""
    return torch.stack([vectors[:, 1], vectors[:, 0], -vectors[:, 2]], -1)


def _read_fields(path: Path, digests: Mapping[str, str] | None) -> dict[str, Tensor]:
    """The needed fields of `flight_data`, each (t,) float64."""
    record = read_structure(path, digests, "flight_data")
    absent = [name for name in _FIELDS if not hasattr(record, name)]
    if absent:
        raise LogError(f"{path.name}: flight_data has no field {', '.join(absent)}")
    fields = {name: torch.from_numpy(np.array(getattr(record, name), dtype=np.float64)) for name in _FIELDS}
    rows = fields["time"].shape
    for name, value in fields.items():
        if value.ndim != 1 or value.shape != rows:
            raise LogError(f"{path.name}: field {name} has shape {tuple(value.shape)}, time has {tuple(rows)}")
    return fields
