"""The SINS/SAR study on the 16-state error model, and inertial navigation on real logs."""

from torchfilt.missions.inertial.log_scene import LOGS, LogSettings
from torchfilt.missions.inertial.logs import run_log
from torchfilt.missions.inertial.scene import FILTERS, SCENARIOS, InertialSettings, Scene, make_filter, make_scene
from torchfilt.missions.inertial.study import run_filter, run_inertial, summarize, table

__all__ = [
    "FILTERS",
    "LOGS",
    "SCENARIOS",
    "InertialSettings",
    "LogSettings",
    "Scene",
    "make_filter",
    "make_scene",
    "run_filter",
    "run_inertial",
    "run_log",
    "summarize",
    "table",
]
