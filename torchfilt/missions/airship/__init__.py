"""The airship study: an indoor mission from the mast to the landing spot."""

from torchfilt.missions.airship.scene import ANCHORED, APPROACH, CRUISE, TRUTH_NAMES, AirshipSettings, Scene, make_scene

__all__ = ["ANCHORED", "APPROACH", "CRUISE", "TRUTH_NAMES", "AirshipSettings", "Scene", "make_scene"]
