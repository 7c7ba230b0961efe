"""Where navigation starts: tilt from gravity, gyro bias from rest, heading from the course.

Axes are those of `torchfilt.models.attitude`: ENU and body right-forward-up, heading clockwise from north.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.models.attitude import from_euler, inverse, rotate
from torchfilt.models.inertial.earth import earth_rate_enu


class Alignment(NamedTuple):
    """Attitude (..., 4) from body to ENU, and gyro bias (..., 3) in rad/s."""

    quaternion: Tensor
    gyro_bias: Tensor


def level(force: Tensor) -> tuple[Tensor, Tensor]:
    """Pitch and roll (...) in rad of a body at rest, from its specific force (..., 3), which points up.

    An accelerometer bias of b tilts by b / g; a force of zero gives zeros.

    Source: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), section 5.6.
    """
    right, forward, up = force.unbind(-1)
    return torch.atan2(forward, torch.hypot(right, up)), torch.atan2(-right, up)


def course(velocity: Tensor) -> Tensor:
    """Direction of motion (...) in rad, clockwise from north, of ENU velocities (..., 3); zero for one that is zero."""
    east, north, _ = velocity.unbind(-1)
    return torch.atan2(east, north)


def align_at_rest(
    gyro_rad_s: Tensor, accel_m_s2: Tensor, heading_rad: Tensor, latitude_rad: Tensor | float
) -> Alignment:
    """Attitude and gyro bias of a body that stood still on the Earth.

    Args:
        gyro_rad_s, accel_m_s2: samples (t, ..., 3), body axes; their means count.
        heading_rad: (...), from elsewhere: sensors of this kind do not feel the Earth turn.
        latitude_rad: of the place, for the Earth's rate, which is no bias; number or (...).

    Raises:
        ValueError: no samples, or shapes that differ.
    """
    if gyro_rad_s.shape != accel_m_s2.shape or gyro_rad_s.dim() < 2 or len(gyro_rad_s) == 0:
        shapes = f"{tuple(gyro_rad_s.shape)} and {tuple(accel_m_s2.shape)}"
        raise ValueError(f"gyro_rad_s and accel_m_s2 must both be (t, ..., 3) with t >= 1, got {shapes}")
    pitch, roll = level(accel_m_s2.mean(0))
    quaternion = from_euler(heading_rad, pitch, roll)
    latitude = torch.as_tensor(latitude_rad, dtype=quaternion.dtype, device=quaternion.device)
    turning = rotate(inverse(quaternion), earth_rate_enu(latitude))
    return Alignment(quaternion, gyro_rad_s.mean(0) - turning)
