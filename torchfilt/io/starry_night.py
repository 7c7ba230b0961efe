"""Reader of a hand-moved stereo camera with gyro over surveyed beacons, and of the motion capture that tells its pose.

Pixels become tangents, rotations become quaternions, absent sightings NaN; the axes stay the log's own: the vehicle's
and an inertial frame whose z axis points up.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests
from torchfilt.io.inertial import check_finite, check_times, refuse
from torchfilt.io.matlab import read_arrays
from torchfilt.models.attitude import from_matrix, rotate
from torchfilt.spaces import UnitQuaternion

FILE = "dataset3.mat"
BEACONS = 20
_NUMBERS = ("fu", "fv", "cu", "cv", "b")
_PER_ROW = ("theta_vk_i", "r_i_vk_i", "w_vk_vk_i", "v_vk_vk_i")
_NOT_SEEN = -1.0
_ROOM_M = 10.0
_MAX_TANGENT = 2.0
_MAX_RATE_RAD_S = 35.0
# Velocity and differenced position agree within 0.06 m/s in the median, rate and differenced attitude within 0.2 rad/s.
_SPEED_TOLERANCE_M_S, _TURN_TOLERANCE_RAD_S = 0.15, 0.5


class Camera(NamedTuple):
    """Where the left camera is: quaternion (4,) x y z w, camera (x right, y down, z ahead) to vehicle; position_m (3,)
    in vehicle axes; baseline_m, how far the right camera is along the camera's x axis.
    """

    quaternion: Tensor
    position_m: Tensor
    baseline_m: float


class StarryNight(NamedTuple):
    """t rows at uneven times, float64.

    times_s (t,); rate_rad_s, velocity_m_s (t, 3): measured, vehicle axes. beacons_m (20, 3): inertial.
    tangents (t, 20, 4): x/z and y/z of each beacon in the left camera, then in the right one; NaN where not seen.
    rate_variance (rad/s)^2, velocity_variance (m/s)^2 (3,), tangent_variance (4,): as the log states them.
    quaternion (t, 4): true, x y z w, vehicle to inertial; position_m (t, 3): true, of the vehicle, inertial.
    """

    times_s: Tensor
    rate_rad_s: Tensor
    velocity_m_s: Tensor
    beacons_m: Tensor
    tangents: Tensor
    rate_variance: Tensor
    velocity_variance: Tensor
    tangent_variance: Tensor
    camera: Camera
    quaternion: Tensor
    position_m: Tensor


def read_starry_night(folder: str | Path, *, manifest: Mapping[str, str] | str | Path | None = None) -> StarryNight:
    """The run in SI units, radians and tangents; quaternions x y z w.

    Args:
        folder: holds `FILE`.
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.

    Raises:
        LogError: the file is damaged, foreign or implausible, or its digest differs from the manifest's. Rows are
            counted from 1.
        FileNotFoundError: the file is missing.
    """
    path = Path(folder) / FILE
    data = _read_arrays(path, read_digests(manifest))
    name, times = path.name, data["t"][0]
    check_times(name, times)
    rotation, position, rate, velocity = (data[key].mT.contiguous() for key in _PER_ROW)
    for key, values in zip(_PER_ROW, (rotation, position, rate, velocity), strict=True):
        check_finite(name, key, values)
    fast = rate.norm(dim=-1) > _MAX_RATE_RAD_S
    refuse(name, fast, rate, f"rad/s of w_vk_vk_i, above {_MAX_RATE_RAD_S}; is it in degrees?")
    refuse(name, (position.abs() > _ROOM_M).any(-1), position, f"of r_i_vk_i, beyond {_ROOM_M} m; is it in mm?")
    quaternion = _quaternion(name, rotation)
    _check_motion(name, times, quaternion, position, rate, velocity)
    beacons = data["rho_i_pj_i"].mT.contiguous()
    check_finite(name, "rho_i_pj_i", beacons)
    tangents, tangent_variance = _tangents(name, data)
    return StarryNight(
        times,
        rate,
        velocity,
        beacons,
        tangents,
        _variance(name, data, "w_var"),
        _variance(name, data, "v_var"),
        tangent_variance,
        _camera(name, data),
        quaternion,
        position,
    )


def _read_arrays(path: Path, digests: Mapping[str, str] | None) -> dict[str, Tensor]:
    """All variables, of the shapes that they must have."""
    single = {"rho_i_pj_i": (3, BEACONS), "C_c_v": (3, 3), "rho_v_c_v": (3, 1)}
    single |= {"w_var": (3, 1), "v_var": (3, 1), "y_var": (4, 1)} | dict.fromkeys(_NUMBERS, (1, 1))
    arrays = read_arrays(path, digests, ("t", "y_k_j", *_PER_ROW, *single))
    rows = arrays["t"].shape[-1] if arrays["t"].ndim == 2 else 0
    shapes: dict[str, tuple[int, ...]] = {"t": (1, rows), "y_k_j": (4, rows, BEACONS)}
    shapes |= dict.fromkeys(_PER_ROW, (3, rows))
    for key, shape in (shapes | single).items():
        if arrays[key].shape != shape:
            raise LogError(f"{path.name}: {key} has shape {arrays[key].shape}, expected {shape}")
    return {key: torch.from_numpy(values) for key, values in arrays.items()}


def _quaternion(name: str, rotation: Tensor) -> Tensor:
    """Vehicle to inertial. The log's matrix of an axis and angle turns the other way: it is exp(-[theta])."""
    turn = rotation.norm(dim=-1)
    refuse(name, turn > torch.pi + 1e-9, turn, "rad in theta_vk_i, more than half a turn; is it in degrees?")
    identity = rotation.new_tensor([0.0, 0.0, 0.0, 1.0])
    return UnitQuaternion("right").retract(identity.expand(len(rotation), 4), rotation)


def _check_motion(
    name: str, times: Tensor, quaternion: Tensor, position: Tensor, rate: Tensor, velocity: Tensor
) -> None:
    """Position and attitude must change as the measured velocity and rate say; tells wrong units and axes."""
    step = times.diff().unsqueeze(-1)
    space = UnitQuaternion("right")
    turn = space.local(quaternion[:-1], quaternion[1:]) / step
    moved = position.diff(dim=0) / step
    for what, off, tolerance, unit in (
        ("v_vk_vk_i", rotate(quaternion[1:], velocity[1:]) - moved, _SPEED_TOLERANCE_M_S, "m/s"),
        ("w_vk_vk_i", rate[1:] - turn, _TURN_TOLERANCE_RAD_S, "rad/s"),
    ):
        middle = off.norm(dim=-1).median().item()
        if middle > tolerance:
            raise LogError(
                f"{name}: {what} differs from the motion of the truth by {middle:.3g} {unit} in the median, more than "
                f"{tolerance} {unit}; check units and axes"
            )


def _tangents(name: str, data: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Of all beacons (t, 20, 4), and their variances (4,)."""
    pixels = data["y_k_j"].permute(1, 2, 0)
    for key in _NUMBERS:
        if not torch.isfinite(data[key]).all() or (key in ("fu", "fv", "b") and data[key].item() <= 0):
            raise LogError(f"{name}: {key} is {data[key].item()}; it must be finite, lengths positive")
    check_finite(name, "y_k_j", pixels)
    absent = pixels == _NOT_SEEN
    part = (absent.any(-1) & ~absent.all(-1)).any(-1)
    refuse(name, part, pixels.flatten(1), "of y_k_j; a beacon is seen by both cameras or by none")
    focus = torch.cat([data["fu"], data["fv"]], -1).squeeze(0).repeat(2)
    centre = torch.cat([data["cu"], data["cv"]], -1).squeeze(0).repeat(2)
    tangents = torch.where(absent, torch.nan, (pixels - centre) / focus)
    wide = (tangents.abs() > _MAX_TANGENT).flatten(1).any(-1)
    refuse(name, wide, pixels.flatten(1), f"of y_k_j, beyond a tangent of {_MAX_TANGENT}; is it in pixels?")
    return tangents.contiguous(), _variance(name, data, "y_var") / focus.square()


def _variance(name: str, data: Mapping[str, Tensor], key: str) -> Tensor:
    values = data[key].squeeze(-1)
    refuse(name, ~(values.isfinite() & (values > 0)), values, f"of {key}; a variance must be positive and finite")
    return values


def _camera(name: str, data: Mapping[str, Tensor]) -> Camera:
    turn, position = data["C_c_v"], data["rho_v_c_v"].squeeze(-1)
    check_finite(name, "rho_v_c_v", position)
    identity = torch.eye(3, dtype=torch.float64)
    if not (turn @ turn.mT - identity).abs().max() < 1e-3 or torch.linalg.det(turn) < 0:
        raise LogError(f"{name}: C_c_v is {turn.tolist()}; it must be a rotation")
    return Camera(from_matrix(turn.mT), position, data["b"].item())
