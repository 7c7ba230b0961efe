"""Gaussian-process dynamics: learned by GPyTorch, frozen into plain torch, used as a law like any other.

`FrozenGP` and `GPTransition` need torch only; `GPRegression`, `SparseGPRegression` and the kernel load GPyTorch when
first named.
"""

from torchfilt.lazy import lazy_names

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES, globals())
