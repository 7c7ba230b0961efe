"""Filters: thin modules over the atoms, and the names of the literature as short constructors."""

from torchfilt.filters.gaussian import (
    CubatureKalmanFilter,
    ErrorStateKalmanFilter,
    ExtendedKalmanFilter,
    GaussHermiteKalmanFilter,
    GaussianFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
)
from torchfilt.filters.lqg import LQGController
from torchfilt.filters.mixture import GaussianSumFilter, InteractingMultipleModel
from torchfilt.filters.observer import LuenbergerObserver, SteadyStateKalmanFilter
from torchfilt.filters.particle import ParticleFilter
from torchfilt.filters.particle_methods import (
    AuxiliaryParticleFilter,
    BootstrapFilter,
    LocallyLinearizedParticleFilter,
    RaoBlackwellizedParticleFilter,
    RegularizedParticleFilter,
    ResampleMoveParticleFilter,
    UnscentedParticleFilter,
)

__all__ = [
    "AuxiliaryParticleFilter",
    "BootstrapFilter",
    "CubatureKalmanFilter",
    "ErrorStateKalmanFilter",
    "ExtendedKalmanFilter",
    "GaussHermiteKalmanFilter",
    "GaussianFilter",
    "GaussianSumFilter",
    "InteractingMultipleModel",
    "KalmanFilter",
    "LQGController",
    "LocallyLinearizedParticleFilter",
    "LuenbergerObserver",
    "ParticleFilter",
    "RaoBlackwellizedParticleFilter",
    "RegularizedParticleFilter",
    "ResampleMoveParticleFilter",
    "SteadyStateKalmanFilter",
    "UnscentedKalmanFilter",
    "UnscentedParticleFilter",
]
