"""Probabilistic filtering in PyTorch: one state-space model, any filter, gradients through everything."""

from importlib import import_module
from typing import Any

from torchfilt import moments, moves, proposals, resampling, spaces
from torchfilt.filters import (
    BootstrapFilter,
    CubatureKalmanFilter,
    ExtendedKalmanFilter,
    GaussHermiteKalmanFilter,
    GaussianFilter,
    KalmanFilter,
    LocallyLinearizedParticleFilter,
    ParticleFilter,
    UnscentedKalmanFilter,
    UnscentedParticleFilter,
)
from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.laws import AdditiveGaussian, LinearGaussian
from torchfilt.model import StateSpaceModel
from torchfilt.noise import NoiseSource
from torchfilt.particles import Particles
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion
from torchfilt.types import FilterError, FilterState, StepInfo, StepNoise

__version__ = "0.1.0"

# Loaded when first named: they bring GPyTorch, Lightning, SciPy or a plotting library.
_LATER = {"GPTransition": "gp"}
_MODULES = ("gp", "io", "learning", "metrics", "models", "testing")

__all__ = [
    "AdditiveGaussian",
    "Angle",
    "BootstrapFilter",
    "CubatureKalmanFilter",
    "Euclidean",
    "ExtendedKalmanFilter",
    "FilterError",
    "FilterState",
    "GPTransition",
    "GaussHermiteKalmanFilter",
    "Gaussian",
    "GaussianFilter",
    "History",
    "KalmanFilter",
    "LinearGaussian",
    "LocallyLinearizedParticleFilter",
    "NoiseSource",
    "ParticleFilter",
    "Particles",
    "Product",
    "StateSpaceModel",
    "StepInfo",
    "StepNoise",
    "UnitQuaternion",
    "UnscentedKalmanFilter",
    "UnscentedParticleFilter",
    "gp",
    "io",
    "learning",
    "metrics",
    "models",
    "moments",
    "moves",
    "proposals",
    "resampling",
    "spaces",
    "testing",
]


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER, *_MODULES})
