"""Attitude: rotations and laws, the one place of the models that knows a quaternion's order (x y z w, Hamilton)."""

from torchfilt.models.attitude.kinematics import ATTITUDE_SPACE, GyroTransition, VectorMeasurement, plausible
from torchfilt.models.attitude.rotations import (
    from_euler,
    from_matrix,
    from_rotation_vector,
    inverse,
    mean_rotation,
    multiply,
    ned_frd_to_enu_rfu,
    rotate,
    skew,
    swap_enu_ned,
    swap_rfu_frd,
    to_euler,
    to_matrix,
    to_rotation_vector,
)

__all__ = [
    "ATTITUDE_SPACE",
    "GyroTransition",
    "VectorMeasurement",
    "from_euler",
    "from_matrix",
    "from_rotation_vector",
    "inverse",
    "mean_rotation",
    "multiply",
    "ned_frd_to_enu_rfu",
    "plausible",
    "rotate",
    "skew",
    "swap_enu_ned",
    "swap_rfu_frd",
    "to_euler",
    "to_matrix",
    "to_rotation_vector",
]
