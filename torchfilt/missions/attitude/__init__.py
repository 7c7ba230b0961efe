"""Attitude filters on real logs."""

from torchfilt.missions.attitude.imu_mag import FILTERS, ImuMagSettings, run_imu_mag

__all__ = ["FILTERS", "ImuMagSettings", "run_imu_mag"]
