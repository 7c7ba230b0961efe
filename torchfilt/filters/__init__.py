"""Filters: thin modules over the atoms, and the names of the literature as short constructors."""

from torchfilt.filters.gaussian import (
    CubatureKalmanFilter,
    ExtendedKalmanFilter,
    GaussHermiteKalmanFilter,
    GaussianFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
)
from torchfilt.filters.particle import (
    BootstrapFilter,
    LocallyLinearizedParticleFilter,
    ParticleFilter,
    UnscentedParticleFilter,
)

__all__ = [
    "BootstrapFilter",
    "CubatureKalmanFilter",
    "ExtendedKalmanFilter",
    "GaussHermiteKalmanFilter",
    "GaussianFilter",
    "KalmanFilter",
    "LocallyLinearizedParticleFilter",
    "ParticleFilter",
    "UnscentedKalmanFilter",
    "UnscentedParticleFilter",
]
