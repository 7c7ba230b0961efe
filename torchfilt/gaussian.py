"""The Gaussian as a light value: what laws return and what filters carry."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.linalg import apply_factor, log_abs_diagonal, triangularize, whiten
from torchfilt.spaces import EUCLIDEAN, Euclidean, Space

LOG_2PI = math.log(2 * math.pi)


class Gaussian(NamedTuple):
    """Normal law around ``mean`` on a space, held by a factor of its covariance.

    mean: (..., d). scale_tril: (e, e) shared by all rows, or (..., e, e) with one factor a row or size-1 dims;
    with ``is_diagonal`` it holds the standard deviations only, (..., e). Errors are tangent vectors:
    a draw is ``space.retract(mean, scale_tril @ noise)``. A zero standard deviation is allowed for sampling.
    """

    mean: Tensor
    scale_tril: Tensor
    space: Space = EUCLIDEAN
    is_diagonal: bool = False

    @property
    def tangent_size(self) -> int:
        """Numbers in an error vector, e."""
        return self.scale_tril.shape[-1]

    def factor(self) -> Tensor:
        """The factor as a matrix (..., e, e)."""
        return torch.diag_embed(self.scale_tril) if self.is_diagonal else self.scale_tril

    @property
    def covariance(self) -> Tensor:
        """Covariance of the error, (..., e, e), expanded over the leading dims of the mean."""
        factor = self.factor()
        product = factor @ factor.mT
        lead = torch.broadcast_shapes(self.mean.shape[:-1], product.shape[:-2])
        return product.expand(*lead, *product.shape[-2:])

    @property
    def variance(self) -> Tensor:
        """Diagonal of the covariance, (..., e)."""
        square = self.scale_tril.square()
        return square if self.is_diagonal else square.sum(-1)

    def sample(self, noise: Tensor) -> Tensor:
        """Draws made from standard normal ``noise`` (..., e); returns (..., d)."""
        mean, factor = self.mean, self.scale_tril
        flat = mean.dim() == 2 and factor.dim() == 2 and mean.shape == noise.shape and not self.is_diagonal
        if flat and isinstance(self.space, Euclidean):
            return torch.addmm(mean.mT, factor, noise.mT).mT  # one pass over the particles
        return self.space.retract(mean, apply_factor(factor, noise, diagonal=self.is_diagonal))

    def log_prob(self, x: Tensor, observed: Tensor | None = None) -> Tensor:
        """Log-density (per unit of tangent volume at the mean) of points x (..., d); returns (...).

        ``observed`` (..., e) marks the components of the error to keep; the others are integrated out exactly. A
        component marked as observed that is NaN in x gives NaN, as it does without ``observed``.
        """
        if observed is not None:
            return self._marginal_log_prob(x, observed)
        z = whiten(self.scale_tril, self.space.local(self.mean, x), diagonal=self.is_diagonal)
        log_volume = log_abs_diagonal(self.scale_tril, diagonal=self.is_diagonal)
        return torch.sub(-0.5 * LOG_2PI * self.tangent_size - log_volume, z.square().sum(-1), alpha=0.5)

    def _marginal_log_prob(self, x: Tensor, observed: Tensor) -> Tensor:
        present = observed.to(self.mean.dtype)
        filled = torch.where(torch.isnan(x), self.mean, x)  # NaN on the way would spoil the gradients
        residual = self.space.local(self.mean, filled).masked_fill(~self.space.observed(x), torch.nan)
        residual = torch.where(observed, residual, 0)
        if self.is_diagonal:
            factor = torch.where(observed, self.scale_tril, 1)
        else:
            factor = triangularize(mask_rows(self.scale_tril, observed))
        z = whiten(factor, residual, diagonal=self.is_diagonal)
        log_volume = log_abs_diagonal(factor, diagonal=self.is_diagonal)
        return -0.5 * z.square().sum(-1) - log_volume - 0.5 * LOG_2PI * present.sum(-1)

    def to_distribution(self) -> torch.distributions.Distribution:
        """The same law as a `torch.distributions.MultivariateNormal` (Euclidean space only).

        Raises:
            TypeError: the space is not Euclidean.
        """
        if type(self.space) is not type(EUCLIDEAN):
            raise TypeError(f"only a Euclidean Gaussian has a MultivariateNormal, this one lives on {self.space!r}")
        return torch.distributions.MultivariateNormal(self.mean, scale_tril=self.factor())


def mask_rows(columns: Tensor, observed: Tensor) -> Tensor:
    """Columns (..., e, k) with the rows not ``observed`` (..., e) replaced by independent unit noise: (..., e, k + e).

    A row of unit noise with a zero residual adds nothing to a likelihood or a gain, so the component is
    marginalised exactly whatever the correlations.
    """
    present = observed.to(columns.dtype).unsqueeze(-1)
    unit = torch.diag_embed(1 - present.squeeze(-1))
    return cat_columns(columns * present, unit)


def cat_columns(*blocks: Tensor) -> Tensor:
    """Blocks (..., e, k_i) side by side, leading dims broadcast; shared blocks stay shared."""
    lead = torch.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    return torch.cat([block.expand(*lead, *block.shape[-2:]) for block in blocks], -1)
