"""Training of Gaussian-process dynamics: Lightning modules, verified checkpoints, reports.

Names load Lightning and GPyTorch when first used.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "AtomicCheckpointIO": "checkpoint",
    "load_checkpoint": "checkpoint",
    "save_checkpoint": "checkpoint",
    "TransitionData": "data",
    "GPModule": "module",
    "TrainingReport": "train",
    "train_transition": "train",
    "OneStepError": "evaluate",
    "RunSettings": "settings",
    "UsageError": "settings",
    "load_transition": "run",
    "run_training": "run",
    "one_step_error": "evaluate",
    "roll_out": "evaluate",
    "roll_out_error": "evaluate",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
