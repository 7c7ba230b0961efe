"""Inertial navigation on WGS-84: the Earth, strapdown mechanisation, laws on total and error states, flight and IMU.

Axes are ENU (navigation) and right-forward-up (body); an attitude is a quaternion from body to ENU, see
`torchfilt.models.attitude`. Errors are computed minus true, the quaternion's on the left.
"""

from torchfilt.lazy import lazy_names

_HOMES = dict.fromkeys(["alignment", "earth", "error_model", "flight", "imu", "navigation", "strapdown"], "")

__all__ = sorted(_HOMES)

__getattr__, __dir__ = lazy_names(__name__, _HOMES, globals())
