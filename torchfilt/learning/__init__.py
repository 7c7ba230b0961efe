"""Training of Gaussian-process dynamics: Lightning modules, verified checkpoints, reports.

Names load Lightning and GPyTorch when first used.
"""

from torchfilt.lazy import lazy_names

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES, globals())
