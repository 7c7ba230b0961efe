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
from torchfilt.filters.mixture import GaussianSumFilter, InteractingMultipleModel
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
    "LocallyLinearizedParticleFilter",
    "ParticleFilter",
    "RaoBlackwellizedParticleFilter",
    "RegularizedParticleFilter",
    "ResampleMoveParticleFilter",
    "UnscentedKalmanFilter",
    "UnscentedParticleFilter",
]
