"""Kernel smoothing of a cloud: after resampling, copies are drawn from a continuous density instead."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchfilt.linalg import steady_triangularize
from torchfilt.particles import Particles
from torchfilt.resampling import gather_particles
from torchfilt.spaces import weighted_sum

Shape = Literal["gaussian", "epanechnikov"]

# The first e coordinates of a point that is uniform on the sphere in e + 4 dimensions follow Epanechnikov's kernel.
_EXTRA = 4


def optimal_bandwidth(size: int, particles: int, shape: Shape = "gaussian", multimodal: bool = False) -> float:
    """Bandwidth h of least mean integrated squared error for a Gaussian cloud: the kernel has h^2 times its covariance.

    Args:
        size: dimensions of an error vector, e.
        particles: n.
        shape: of the kernel. A unit Epanechnikov kernel is scaled to unit covariance here, as the Gaussian one is.
        multimodal: half of it, for clouds in several pieces, whose overall covariance is far above that of a piece.

    Raises:
        ValueError: size below 1, particles below 2.

    Source: Silverman, Density Estimation (1986), section 4.3; Musso, Oudjane, Le Gland, Improving regularised particle
        filters (2001), equations 12.2.7 and 12.2.8.
    """
    if size < 1 or particles < 2:
        raise ValueError(f"size must be at least 1 and particles at least 2, got {size} and {particles}")
    if shape == "gaussian":
        constant, deviation = 4 / (size + 2), 1.0
    else:
        log_ball = 0.5 * size * math.log(math.pi) - math.lgamma(0.5 * size + 1)
        log_constant = math.log(8 * (size + 4)) + size * math.log(2 * math.sqrt(math.pi)) - log_ball
        constant, deviation = math.exp(log_constant), (size + _EXTRA) ** -0.5
    return (0.5 if multimodal else 1.0) * deviation * (constant / particles) ** (1 / (size + 4))


@dataclass(frozen=True)
class Regularize:
    """Draw resampled particles anew from a kernel around each, with the covariance of the whole cloud.

    With ``keep_moments`` particles are first shrunk towards the mean by sqrt(1 - h^2), and the result is matched to the
    mean and covariance the weighted cloud had before resampling: neither the kernel nor the resampling's own noise
    widens it. Without, the plain kernel adds h^2 times the covariance at every resampling, which in many dimensions,
    where the optimal h is not small, makes a filter diverge.

    Kernel steps go through the space's `retract`. Rows whose cloud has lost a dimension are shrunk, not matched.

    Args:
        shape: "gaussian" or "epanechnikov".
        bandwidth: h; None for the optimum of `optimal_bandwidth`.
        multimodal: half the optimal bandwidth.
        keep_moments: see above.

    Raises:
        ValueError: unknown shape, bandwidth not positive or, with ``keep_moments``, not below 1.

    Sources: Musso, Oudjane, Le Gland, Improving regularised particle filters (2001); Liu and West, Combined parameter
        and state estimation in simulation-based filtering (2001), for the shrinkage.
    """

    shape: Shape = "gaussian"
    bandwidth: float | None = None
    multimodal: bool = False
    keep_moments: bool = True

    def __post_init__(self) -> None:
        if self.shape not in ("gaussian", "epanechnikov"):
            raise ValueError(f"shape must be 'gaussian' or 'epanechnikov', got {self.shape!r}")
        if self.bandwidth is not None and not 0 < self.bandwidth < (1 if self.keep_moments else math.inf):
            rule = "in (0, 1), as the cloud is shrunk by sqrt(1 - h^2)" if self.keep_moments else "positive and finite"
            raise ValueError(f"bandwidth must be {rule}, got {self.bandwidth}")

    def normals(self, size: int) -> int:
        """How many standard normals a particle of ``size`` error dimensions needs."""
        return size + _EXTRA if self.shape == "epanechnikov" else size

    def __call__(
        self,
        cloud: Particles,
        resampled: Particles,
        noise: Tensor,
        chosen: Tensor | None = None,
        ancestors: Tensor | None = None,
    ) -> Particles:
        """Smooth.

        Args:
            cloud: weighted, before resampling.
            resampled: x (*batch, n, d).
            noise: standard normals (*batch, n, k) with k of `normals`.
            chosen: (*batch), rows that were resampled; None for all.
            ancestors: (*batch, n), of the resampled particles where known: their errors need not be found again.
        """
        space, cloud = cloud.space, cloud.with_centre()
        assert cloud.centre is not None
        mean = cloud.centre.mean.unsqueeze(-2)
        whole = _factor(cloud.centre.errors, cloud.weights)
        size = whole.shape[-1]
        h = self.bandwidth or optimal_bandwidth(size, resampled.x.shape[-2], self.shape, self.multimodal)
        step = ((h * whole) @ self._unit(noise, size).mT).mT
        if self.keep_moments:
            known = cloud.centre.errors
            apart = space.local(mean, resampled.x) if ancestors is None else gather_particles(known, ancestors)
            drawn = torch.add(step, apart, alpha=(1 - h**2) ** 0.5)
            x = space.retract(mean, _match(drawn, resampled.weights, whole))
        else:
            x = space.retract(resampled.x, step)
        if chosen is not None:
            x = torch.where(chosen.unsqueeze(-1).unsqueeze(-1), x, resampled.x)
        return resampled._replace(x=x)

    def _unit(self, noise: Tensor, size: int) -> Tensor:
        """Draws (..., e) of the kernel with unit covariance."""
        if self.shape == "gaussian":
            return noise
        length = noise.square().sum(-1, keepdim=True).sqrt()
        return noise[..., :size] * ((size + _EXTRA) ** 0.5 / length)


def _factor(apart: Tensor, weights: Tensor) -> Tensor:
    """Factor (*batch, e, e) of the weighted second moment of errors (*batch, n, e)."""
    return steady_triangularize((apart * weights.sqrt().unsqueeze(-1)).mT)


def _match(errors: Tensor, weights: Tensor, whole: Tensor) -> Tensor:
    """Errors with weighted mean zero and the covariance that ``whole`` is a factor of."""
    errors = errors - weighted_sum(errors, weights).unsqueeze(-2)
    found = _factor(errors, weights)
    # In units of the cloud's own deviations: a dimension without spread can't be matched.
    scale = whole.square().sum(-1).sqrt()
    lost = (found.diagonal(dim1=-2, dim2=-1) <= 1e3 * torch.finfo(found.dtype).eps * scale).any(-1)[..., None, None]
    identity = torch.eye(found.shape[-1], dtype=found.dtype, device=found.device)
    turn = torch.linalg.solve_triangular(torch.where(lost, identity, found), whole, upper=False, left=False)
    return (torch.where(lost, identity, turn) @ errors.mT).mT


def check_kernel(kernel: object) -> None:
    """Raise a TypeError unless this is a `Regularize` or None."""
    if kernel is not None and not isinstance(kernel, Regularize):
        raise TypeError(f"kernel must be a Regularize or None, got {kernel!r}")
