"""Gaussian-process dynamics: learned by GPyTorch, frozen into plain torch, used as a law like any other.

`FrozenGP` and `GPTransition` need torch only; `GPRegression`, `SparseGPRegression` and the kernel load GPyTorch when
first named.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Collapsed": "frozen",
    "FrozenGP": "frozen",
    "IntegrityError": "frozen",
    "GPTransition": "transition",
    "Novelty": "transition",
    "one_step_targets": "transition",
    "GPRegression": "regression",
    "StructuredKernel": "regression",
    "SparseGPRegression": "sparse",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
