"""Ranging between two satellites far apart: a range with a constant bias, and two angles."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearForm, hold
from torchfilt.models.relative_motion.radar import RADAR_SPACE, RendezvousRadar
from torchfilt.models.relative_motion.transforms import block_diagonal

Step = Tensor | float | None


class WithConstant(nn.Module):
    """A transition law with ``size`` constants appended to its state: sensor biases, to be estimated.

    Args:
        law: transition law of the first d numbers, errors on Euclidean axes; its ``linear_form`` and ``pooled``, where
            it has them, are offered too.
        size: number of constants.
        drift_psd: white rate of change on each constant, units^2 / s; zero keeps them constant. Particle filters need
            some, or every constant dies out but a few.

    Raises:
        ValueError: size below 1, negative drift.
    """

    drift_psd: Tensor

    def __init__(
        self, law: nn.Module | Callable[..., Gaussian], size: int = 1, drift_psd: Tensor | float = 0.0
    ) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"size must be at least 1, got {size}")
        drift = drift_psd if isinstance(drift_psd, Tensor) else torch.tensor(drift_psd, dtype=torch.float64)
        if not bool((drift.detach() >= 0).all()):
            raise ValueError(f"drift_psd must be >= 0, got {drift_psd}")
        self.law: Any = law
        self.size = size
        hold(self, "drift_psd", drift)
        # Filters ask with hasattr which short cuts a law has, so they exist only where the inner law has them.
        if hasattr(law, "linear_form"):
            self.linear_form = self._linear_form
        if hasattr(law, "pooled"):
            self.pooled = self._pooled

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the longer state (..., d + size)."""
        inner: Gaussian = self.law(x[..., : -self.size], u, dt)
        return self._extend(inner, x[..., -self.size :], dt)

    def _pooled(self, x: Tensor, weights: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        inner: Gaussian = self.law.pooled(x[..., : -self.size], weights, u, dt)
        return self._extend(inner, x[..., -self.size :], dt)

    def _linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        matrix, offset, scale_tril = self.law.linear_form(u, dt)
        one = torch.eye(self.size, dtype=matrix.dtype, device=matrix.device)
        if offset is not None:
            offset = torch.nn.functional.pad(offset, (0, self.size))
        return LinearForm(block_diagonal(matrix, one), offset, block_diagonal(scale_tril, self._drift(scale_tril, dt)))

    def _extend(self, inner: Gaussian, constants: Tensor, dt: Step) -> Gaussian:
        mean = torch.cat([inner.mean, constants.expand(*inner.mean.shape[:-1], self.size)], -1)
        drift = self._drift(inner.scale_tril, dt)
        if inner.is_diagonal:
            own = drift.diagonal(dim1=-2, dim2=-1)
            lead = torch.broadcast_shapes(inner.scale_tril.shape[:-1], own.shape[:-1])
            parts = [part.expand(*lead, part.shape[-1]) for part in (inner.scale_tril, own)]
            return Gaussian(mean, torch.cat(parts, -1), inner.space, True)
        return Gaussian(mean, block_diagonal(inner.scale_tril, drift), inner.space)

    def _drift(self, like: Tensor, dt: Step) -> Tensor:
        """Factor (..., size, size) of what the constants gain in a step."""
        psd = self.drift_psd.to(like.dtype)
        if dt is None:
            if bool(self.drift_psd.detach().any()):
                raise ValueError("a drifting constant needs the time step dt")
            dt = 0.0
        variance: Tensor = psd * dt
        lead = dt.shape[:-1] if isinstance(dt, Tensor) else ()
        return torch.diag_embed(variance.sqrt().expand(*lead, self.size).to(like.dtype))


class BiasedRanging(nn.Module):
    """Range with an unknown constant bias, and two angles, of states [x y z vx vy vz bias].

    measurement = (range + bias, alpha, beta) with the geometry of `RendezvousRadar`; a part that a sensor does not give
    is NaN.

    Args:
        chief_radius_m: distance of the chief from the Earth's centre, number or (...). It only turns the axes in which
            the angles are given: 7 km of it turn them by 4e-5 rad at 225 km.
        range_sd_m: of the ranging, without its bias.
        azimuth_sd_rad, elevation_sd_rad: of the angles.
    """

    def __init__(
        self,
        chief_radius_m: Tensor | float,
        range_sd_m: Tensor | float,
        azimuth_sd_rad: Tensor | float,
        elevation_sd_rad: Tensor | float,
    ) -> None:
        super().__init__()
        self.radar = RendezvousRadar(chief_radius_m, range_sd_m, azimuth_sd_rad, elevation_sd_rad)
        self.space = RADAR_SPACE

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the measurement given states (..., 7)."""
        law = self.radar(x[..., :6])
        return law._replace(mean=law.mean + torch.nn.functional.pad(x[..., 6:7], (0, 2)))
