"""A weighted cloud of points, or of small Gaussians."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.spaces import EUCLIDEAN, Space, steady_sum, weighted_sum


class Particles(NamedTuple):
    """Particles x (*batch, n, d) with normalised log-weights (*batch, n).

    scale_tril (*batch, n, e, e), or (*batch, 1, e, e) when all particles share it, makes each particle a Gaussian;
    None means points. ``held`` keeps (log_weights, weights) where the weights were already made; it counts only for the
    very log_weights it names, so replacing these is safe.
    """

    x: Tensor
    log_weights: Tensor
    scale_tril: Tensor | None = None
    space: Space = EUCLIDEAN
    held: tuple[Tensor, Tensor] | None = None

    @property
    def weights(self) -> Tensor:
        """Normalised weights (*batch, n)."""
        if self.held is not None and self.held[0] is self.log_weights:
            return self.held[1]
        return torch.softmax(self.log_weights, -1)

    @property
    def mean(self) -> Tensor:
        """Intrinsic weighted mean (*batch, d)."""
        return self.space.mean(self.x, self.weights)

    @property
    def covariance(self) -> Tensor:
        """Spread of the particles plus the mean of their own covariances (*batch, e, e)."""
        return self.moments()[1]

    @property
    def ess(self) -> Tensor:
        """Effective sample size, 1 / sum of squared weights, (*batch)."""
        return steady_sum(self.weights.square(), -1).reciprocal()

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean (*batch, d) and covariance (*batch, e, e) of the mixture."""
        weights = self.weights
        mean = self.space.mean(self.x, weights)
        covariance = second_moment(self.space.local(mean.unsqueeze(-2), self.x), weights)
        if self.scale_tril is not None:
            covariance = covariance + self._local_covariance(weights)
        return mean, covariance

    def _local_covariance(self, weights: Tensor) -> Tensor:
        assert self.scale_tril is not None
        own = self.scale_tril @ self.scale_tril.mT
        if own.shape[-3] == 1:
            return own.squeeze(-3)
        return (own * weights[..., None, None]).sum(-3)


# Numbers that the outer products of all particles may fill at once; above, one row of the matrix at a time.
_BLOCK = 1 << 20


def second_moment(deviation: Tensor, weights: Tensor) -> Tensor:
    """Weighted sum (*batch, e, e) of outer products of errors (*batch, n, e): the same bits for any thread count."""
    by_component = deviation.movedim(-1, 0).contiguous()
    weighted = by_component * weights
    if by_component.numel() * len(by_component) <= _BLOCK:
        rows = steady_sum(weighted.unsqueeze(1) * by_component, -1)
    else:
        rows = torch.stack([steady_sum(row * by_component, -1) for row in weighted])
    lower = rows.movedim((0, 1), (-2, -1)).tril()
    return lower + lower.tril(-1).mT


def uniform_log_weights(shape: torch.Size | tuple[int, ...], like: Tensor) -> Tensor:
    """Equal log-weights of ``shape`` (*batch, n)."""
    return torch.full(shape, -math.log(shape[-1]), dtype=like.dtype, device=like.device)


__all__ = ["Particles", "second_moment", "uniform_log_weights", "weighted_sum"]
