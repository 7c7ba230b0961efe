"""The landing study: a multirotor, a pad with a beacon, and no other aid."""

from torchfilt.missions.landing.scene import SCENARIOS, LandingSettings, Scene, make_scene

__all__ = ["SCENARIOS", "LandingSettings", "Scene", "make_scene"]
