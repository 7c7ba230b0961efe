"""Two satellites in formation: radar, learned dynamics, and filters that are compared with the exact model's."""

from torchfilt.missions.formation.scene import (
    CASES,
    FILTERS,
    Scene,
    StudySettings,
    learned_law,
    make_filter,
    make_scene,
    scene_bound,
    train_gp,
)
from torchfilt.missions.formation.study import leakage, lost_runs, run_filter, run_formation, run_rmse, summarize, table

__all__ = [
    "CASES",
    "FILTERS",
    "Scene",
    "StudySettings",
    "leakage",
    "learned_law",
    "lost_runs",
    "make_filter",
    "make_scene",
    "run_filter",
    "run_formation",
    "run_rmse",
    "scene_bound",
    "summarize",
    "table",
    "train_gp",
]
