"""A weighted cloud of points, or of small Gaussians."""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.spaces import EUCLIDEAN, Space, centred, steady_sum, weighted_sum


class Centre(NamedTuple):
    """Mean (*batch, d) of the points x and their errors (*batch, n, e) from it, on a space, under these log-weights."""

    x: Tensor
    log_weights: Tensor
    space: Space
    mean: Tensor
    errors: Tensor


class PastStep(NamedTuple):
    """What a move of trajectories keeps of a step that its window reaches back over, in the order of the particles.

    origin (*batch, n, d) is the state the step set out from, noise (*batch, n, e) what it was drawn with, level
    (*batch, n) the log-density that it adds to the target. mean (*batch, 1, d) and factor (*batch, 1, e, e) fit the
    cloud that it predicted. None is what the target does not ask for. used (*batch, 1): rows that took the measurement
    in. y, u, dt and missing as in `torchfilt.types.StepInput`.
    """

    origin: Tensor
    noise: Tensor | None
    level: Tensor
    mean: Tensor | None
    factor: Tensor | None
    used: Tensor
    y: Tensor
    u: Tensor | None
    dt: Tensor | float | None
    missing: Literal["none", "shared", "rows"]


class Particles(NamedTuple):
    """Particles x (*batch, n, d) with normalised log-weights (*batch, n).

    scale_tril (*batch, n, e, e), or (*batch, 1, e, e) when all particles share it, makes each particle a Gaussian;
    None means points. ``held`` keeps (log_weights, weights) where the weights were already made, ``centre`` the mean;
    they count only for the very tensors they name, so replacing these is safe.
    ``past``: earlier steps, oldest first, that a move of trajectories goes back over.
    """

    x: Tensor
    log_weights: Tensor
    scale_tril: Tensor | None = None
    space: Space = EUCLIDEAN
    held: tuple[Tensor, Tensor] | None = None
    centre: Centre | None = None
    past: tuple[PastStep, ...] = ()

    @property
    def weights(self) -> Tensor:
        """Normalised weights (*batch, n)."""
        if self.held is not None and self.held[0] is self.log_weights:
            return self.held[1]
        return torch.softmax(self.log_weights, -1)

    @property
    def mean(self) -> Tensor:
        """Intrinsic weighted mean (*batch, d)."""
        known = self._known()
        return known.mean if known is not None else self.space.mean(self.x, self.weights)

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
        known, weights = self._known(), self.weights
        mean, errors = known[-2:] if known is not None else centred(self.space, self.x, weights)
        covariance = second_moment(errors, weights)
        if self.scale_tril is not None:
            covariance = covariance + self._local_covariance(errors, weights)
        return mean, covariance

    def with_centre(self) -> "Particles":
        """The same particles, which know their mean and errors: for who needs them more than once.

        Found component by component in memory, whatever the order of x, by which sums round.
        """
        if self._known() is not None:
            return self
        by_component = self.x.movedim(-1, 0).contiguous().movedim(0, -1)
        mean, errors = centred(self.space, by_component, self.weights)
        return self._replace(centre=Centre(self.x, self.log_weights, self.space, mean, errors))

    def _known(self) -> Centre | None:
        """What is kept of the mean, if it belongs to these very particles."""
        known = self.centre
        same = known is not None and known.x is self.x and known.log_weights is self.log_weights
        return known if same and known is not None and known.space is self.space else None

    def _local_covariance(self, errors: Tensor, weights: Tensor) -> Tensor:
        """Mean of the particles' own covariances, each seen from the mean of all."""
        assert self.scale_tril is not None
        factor = self.space.carry_back(errors, self.scale_tril)
        own = factor @ factor.mT
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
        # The lower triangle will do; room for a row's rest is made behind it.
        parts = [steady_sum(row * by_component[: k + 1], -1) for k, row in enumerate(weighted)]
        behind = (0, 0) * (weighted.dim() - 2)
        rows = torch.stack([torch.nn.functional.pad(part, (*behind, 0, len(parts) - len(part))) for part in parts])
    lower = rows.movedim((0, 1), (-2, -1)).tril()
    return lower + lower.tril(-1).mT


def uniform_log_weights(shape: torch.Size | tuple[int, ...], like: Tensor) -> Tensor:
    """Equal log-weights of ``shape`` (*batch, n)."""
    return torch.full(shape, -math.log(shape[-1]), dtype=like.dtype, device=like.device)


__all__ = ["Particles", "PastStep", "second_moment", "uniform_log_weights", "weighted_sum"]
