"""Sensors of indoor navigation: atmosphere and barometer, ultrasonic range, magnetometer, noise of inertial sensors.

Laws measure an inertial state: quaternion body (RFU) to a local frame with z up [0:4], velocity [4:7], position [7:10],
gyro bias [10:13], accelerometer bias [13:16], then what else is estimated. Which of these further numbers a law reads
is an argument, so that laws combine freely.
"""

from torchfilt.lazy import lazy_names

_HOMES = dict.fromkeys(["atmosphere", "barometer", "imu", "magnetometer", "ranges", "ultrasonic"], "")

__all__ = sorted(_HOMES)

__getattr__, __dir__ = lazy_names(__name__, _HOMES, globals())
