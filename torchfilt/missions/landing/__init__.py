"""The landing study: a multirotor, a pad with a beacon, and no other aid."""

from torchfilt.missions.landing.scene import SCENARIOS, LandingSettings, Scene, make_scene
from torchfilt.missions.landing.study import DEFAULT, FILTERS, make_filter, run_landing

__all__ = ["DEFAULT", "FILTERS", "SCENARIOS", "LandingSettings", "Scene", "make_filter", "make_scene", "run_landing"]
