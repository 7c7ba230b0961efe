"""Reader of a hand-moved inertial sensor with magnetometer, and of the cameras that tell its attitude and position.

Units (microtesla), the order of quaternions and the flags of lost rows end here. The sensor's axes are taken for right,
forward, up: the cameras' quaternion is the identity where they point east, north, up.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests
from torchfilt.io.inertial import check_finite, check_samples, refuse
from torchfilt.io.matlab import read_arrays
from torchfilt.spaces import UnitQuaternion

FILE = "21_undisturbed_fast_combined.mat"
_COLUMNS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4, "opt_pos": 3, "movement": 1, "sampling_rate": 1}
_TESLA_PER_MICROTESLA = 1e-6
# The field of the Earth is 22 to 67 microtesla strong.
_FIELD_TESLA = (15e-6, 100e-6)
_ROOM_M = 100.0
# Cameras and gyro agree within 0.12 rad/s in the median; a quaternion of another order is off by the rate itself.
_TURN_TOLERANCE_RAD_S = 0.5


class ImuMagLog(NamedTuple):
    """t rows at one rate, float64.

    times_s (t,), from zero; gyro_rad_s, accel_m_s2 (specific force), mag_t (tesla) (t, 3): sensor axes RFU.
    quaternion (t, 4): by the cameras, x y z w, sensor to east-north-up, NaN where they lost it. position_m (t, 3): by
    the cameras, ENU, NaN where lost; not always the same rows. Position and attitude belong to the end of the interval
    for which the sample of their row stands.
    movement (t,): True in rows to score; the sensor stands still before and behind them.
    """

    times_s: Tensor
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    mag_t: Tensor
    quaternion: Tensor
    position_m: Tensor
    movement: Tensor


def read_imu_mag_mocap(folder: str | Path, *, manifest: Mapping[str, str] | str | Path | None = None) -> ImuMagLog:
    """The trial in SI units, radians and tesla; quaternions x y z w, sensor (RFU) to ENU.

    Args:
        folder: holds `FILE`.
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.

    Raises:
        LogError: the file is damaged, foreign or implausible, or its digest differs from the manifest's. Rows are
            counted from 1, samples of the inertial sensor from 0.
        FileNotFoundError: the file is missing.
    """
    path = Path(folder) / FILE
    arrays = read_arrays(path, read_digests(manifest), tuple(_COLUMNS))
    name, rows = path.name, len(arrays["imu_gyr"])
    for key, columns in _COLUMNS.items():
        shape = (1 if key == "sampling_rate" else rows, columns)
        if arrays[key].shape != shape:
            raise LogError(f"{name}: {key} has shape {arrays[key].shape}, expected {shape}")
    rate_hz = float(arrays["sampling_rate"].item())
    if not 1.0 <= rate_hz <= 1e5:
        raise LogError(f"{name}: sampling_rate is {rate_hz} Hz; it must be from 1 to 100000")
    data = {key: torch.from_numpy(values) for key, values in arrays.items()}
    times = torch.arange(rows, dtype=torch.float64) / rate_hz
    check_samples(name, times, data["imu_gyr"], data["imu_acc"], torch.inf, "refuse")
    field = _field(name, data["imu_mag"])
    movement = data["movement"].squeeze(-1)
    refuse(name, (movement != 0) & (movement != 1), movement, "of movement; it must be 0 or 1")
    quaternion = _quaternion(name, data["opt_quat"])
    _check_turn(name, quaternion, data["imu_gyr"], 1 / rate_hz)
    position = data["opt_pos"]
    _check_lost(name, "opt_pos", position)
    refuse(name, (position.abs() > _ROOM_M).any(-1), position, f"of opt_pos, beyond {_ROOM_M} m; is it in mm?")
    return ImuMagLog(times, data["imu_gyr"], data["imu_acc"], field, quaternion, position, movement == 1)


def _field(name: str, microtesla: Tensor) -> Tensor:
    check_finite(name, "imu_mag", microtesla)
    field = microtesla * _TESLA_PER_MICROTESLA
    middle = field.norm(dim=-1).median().item()
    if not _FIELD_TESLA[0] < middle < _FIELD_TESLA[1]:
        raise LogError(
            f"{name}: the length of imu_mag is {middle / _TESLA_PER_MICROTESLA:.4g} in the median; "
            "no field of the Earth in microtesla"
        )
    return field


def _quaternion(name: str, w_first: Tensor) -> Tensor:
    """Order x y z w, after a check of the length."""
    _check_lost(name, "opt_quat", w_first)
    length = w_first.norm(dim=-1)
    refuse(name, (length - 1).abs() > 1e-6, length, "as the length of opt_quat; it must be 1")
    return w_first[:, [1, 2, 3, 0]]


def _check_lost(name: str, what: str, values: Tensor) -> None:
    """A row is there or lost as a whole."""
    lost = values.isnan()
    refuse(name, lost.any(-1) & ~lost.all(-1), values, f"of {what}; a row is lost as a whole or not at all")
    refuse(name, values.isinf().any(-1), values, f"of {what}; values must be finite, or NaN where lost")


def _check_turn(name: str, quaternion: Tensor, gyro: Tensor, step_s: float) -> None:
    """The cameras must see the sensor turn as its gyro says."""
    turn = UnitQuaternion("right").local(quaternion[:-1], quaternion[1:]) / step_s
    off = (turn - gyro[1:]).norm(dim=-1)
    off = off[off.isfinite()]
    if len(off) == 0:
        raise LogError(f"{name}: opt_quat has no two successive rows")
    if off.median().item() > _TURN_TOLERANCE_RAD_S:
        raise LogError(
            f"{name}: opt_quat turns otherwise than imu_gyr by {off.median().item():.3g} rad/s in the median, more "
            f"than {_TURN_TOLERANCE_RAD_S}; check units and the quaternion's order"
        )
