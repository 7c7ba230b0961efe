"""Filters on real logs: attitude against cameras, a pose from sightings of beacons, a descent by parachute."""

from torchfilt.missions.attitude.descent import DescentSettings, run_descent
from torchfilt.missions.attitude.imu_mag import ImuMagSettings, run_imu_mag
from torchfilt.missions.attitude.stars import StarsSettings, run_stars

__all__ = ["DescentSettings", "ImuMagSettings", "StarsSettings", "run_descent", "run_imu_mag", "run_stars"]
