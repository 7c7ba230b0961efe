"""Probabilistic filtering in PyTorch: one state-space model, any filter, gradients through everything."""

from torchfilt import delays, kernels, mixture, moments, moves, proposals, rao_blackwell, resampling, spaces
from torchfilt.delays import DelayedMeasurements
from torchfilt.filters import (
    AuxiliaryParticleFilter,
    BootstrapFilter,
    CubatureKalmanFilter,
    ErrorStateKalmanFilter,
    ExtendedKalmanFilter,
    GaussHermiteKalmanFilter,
    GaussianFilter,
    GaussianSumFilter,
    InteractingMultipleModel,
    KalmanFilter,
    LocallyLinearizedParticleFilter,
    LQGController,
    LuenbergerObserver,
    ParticleFilter,
    RaoBlackwellizedParticleFilter,
    RegularizedParticleFilter,
    ResampleMoveParticleFilter,
    SteadyStateKalmanFilter,
    UnscentedKalmanFilter,
    UnscentedParticleFilter,
)
from torchfilt.gates import Gate
from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.laws import AdditiveGaussian, LinearGaussian
from torchfilt.lazy import lazy_names
from torchfilt.mixture import InitialMixture, MixtureLaw, split_gaussian
from torchfilt.model import StateSpaceModel
from torchfilt.modes import Mode, NavigationModes, Switch
from torchfilt.noise import NoiseSource
from torchfilt.particles import Particles
from torchfilt.robust import Reacquire
from torchfilt.sensors import PseudoMeasurement, Sensors
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion
from torchfilt.types import FilterError, FilterState, StepInfo, StepNoise

__version__ = "0.1.0"

# Loaded when first named: they bring GPyTorch, Lightning, SciPy or a plotting library.
_LATER = {"GPTransition": "gp"} | dict.fromkeys(
    ("gp", "io", "learning", "metrics", "missions", "models", "testing"), ""
)

__all__ = [
    "AdditiveGaussian",
    "Angle",
    "AuxiliaryParticleFilter",
    "BootstrapFilter",
    "CubatureKalmanFilter",
    "DelayedMeasurements",
    "ErrorStateKalmanFilter",
    "Euclidean",
    "ExtendedKalmanFilter",
    "FilterError",
    "FilterState",
    "GPTransition",
    "Gate",
    "GaussHermiteKalmanFilter",
    "Gaussian",
    "GaussianFilter",
    "GaussianSumFilter",
    "History",
    "InitialMixture",
    "InteractingMultipleModel",
    "KalmanFilter",
    "LQGController",
    "LinearGaussian",
    "LocallyLinearizedParticleFilter",
    "LuenbergerObserver",
    "MixtureLaw",
    "Mode",
    "NavigationModes",
    "NoiseSource",
    "ParticleFilter",
    "Particles",
    "Product",
    "PseudoMeasurement",
    "RaoBlackwellizedParticleFilter",
    "Reacquire",
    "RegularizedParticleFilter",
    "ResampleMoveParticleFilter",
    "Sensors",
    "StateSpaceModel",
    "SteadyStateKalmanFilter",
    "StepInfo",
    "StepNoise",
    "Switch",
    "UnitQuaternion",
    "UnscentedKalmanFilter",
    "UnscentedParticleFilter",
    "delays",
    "gp",
    "io",
    "kernels",
    "learning",
    "metrics",
    "missions",
    "models",
    "mixture",
    "moments",
    "moves",
    "proposals",
    "rao_blackwell",
    "resampling",
    "spaces",
    "split_gaussian",
    "testing",
]

__getattr__, __dir__ = lazy_names(__name__, _LATER, globals())
