"""Gaussian-process dynamics as a transition law."""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.gp.frozen import FrozenGP
from torchfilt.spaces import EUCLIDEAN, Space, weighted_sum

Target = Literal["residual", "identity", "next_state"]
Step = Tensor | float | None


class Freezable(Protocol):
    """A regression that gives its frozen posterior."""

    def freeze(self) -> FrozenGP:
        """The posterior as plain tensors."""
        ...


class Novelty(NamedTuple):
    """How far a query is from what was learned.

    variance_ratio (...): largest latent variance over prior variance among the outputs, 0 (known) to 1 (unknown).
    distance (...): largest standardised distance of a state coordinate from the training mean, 1 to 2 inside the data.
    """

    variance_ratio: Tensor
    distance: Tensor


def one_step_targets(
    x: Tensor, u: Tensor | None, x_next: Tensor, dt: Step, *, target: Target, nominal: Callable[..., Gaussian] | None
) -> Tensor:
    """What the GP learns from pairs (x, x_next), both (S, d); returns (S, d).

    target: "residual" x_next - nominal mean; "identity" x_next - x; "next_state" x_next itself ("model-free").

    Raises:
        ValueError: a residual without a nominal law, or another target with one.
    """
    check_target(target, nominal)
    return x_next - _base(x, u, dt, target, nominal)


def check_target(target: Target, nominal: object | None) -> None:
    """Raise a ValueError unless target and nominal law fit each other."""
    if target not in ("residual", "identity", "next_state"):
        raise ValueError(f"target must be 'residual', 'identity' or 'next_state', got {target!r}")
    if (target == "residual") != (nominal is not None):
        raise ValueError(f"target {target!r} {'needs' if nominal is None else 'does not take'} a nominal law")


def _base(x: Tensor, u: Tensor | None, dt: Step, target: Target, nominal: Callable[..., Gaussian] | None) -> Tensor:
    """What the GP's output is added to."""
    if nominal is not None:
        return nominal(x, u, dt).mean
    return x if target == "identity" else torch.zeros_like(x)


class GPTransition(nn.Module):
    """``x_next ~ N(base + GP mean, diag(GP variance) + nominal covariance)``, base by the target the GP learned.

    Args:
        gp: frozen posterior, or a regression to freeze.
        nominal: law(x, u, dt) -> Gaussian on Euclidean axes whose residual was learned, or None.
        context: function of the control u giving the GP's inputs beyond the state (..., c), such as the phase; or None.
        target: as in `one_step_targets`; default what the file says, else "residual" with a nominal law, "identity"
            without.
        process_noise_scale_tril: (d, d) factor that replaces the nominal law's own noise (the floor), or None.
        noise: "predictive" adds the learned noise variance (what the kernel cannot explain is an error of the next
            step too); "latent" leaves it out.
        pooling: how `pooled` forms the one variance of a sigma-point set: the weighted "average" over the points, or
            the variance at their "centre", which saves a dense GP most of its work and differs by its curvature.
        dt: time step of the training pairs, s; default what the file says. A step of another length is refused
            (a float: ValueError; a tensor: NaN rows), zero means no motion.
        space: Euclidean.

    Raises:
        ValueError: target, nominal law, context and GP do not fit.
    """

    def __init__(
        self,
        gp: FrozenGP | Freezable,
        nominal: nn.Module | Callable[..., Gaussian] | None = None,
        *,
        context: Callable[[Tensor], Tensor] | None = None,
        target: Target | None = None,
        process_noise_scale_tril: Tensor | None = None,
        noise: Literal["predictive", "latent"] = "predictive",
        pooling: Literal["average", "centre"] = "average",
        dt: float | None = None,
        space: Space = EUCLIDEAN,
    ) -> None:
        super().__init__()
        frozen = gp if isinstance(gp, FrozenGP) else gp.freeze()
        self.target: Target = target or frozen.settings.get("target") or ("identity" if nominal is None else "residual")
        check_target(self.target, nominal)
        if noise not in ("predictive", "latent"):
            raise ValueError(f"noise must be 'predictive' or 'latent', got {noise!r}")
        if pooling not in ("average", "centre"):
            raise ValueError(f"pooling must be 'average' or 'centre', got {pooling!r}")
        if (context is None) != (frozen.context_size == 0):
            need = "needs" if context is None else "does not take"
            raise ValueError(f"this GP {need} a context ({frozen.context_size} inputs beyond the state)")
        if frozen.output_size != frozen.state_size:
            raise ValueError(
                f"the GP maps {frozen.state_size} state numbers to {frozen.output_size} outputs, not the same"
            )
        if type(space) is not type(EUCLIDEAN):
            raise ValueError(f"a GP transition lives on Euclidean axes, got {space!r}")
        self.gp, self.nominal, self.context, self.noise, self.space = frozen, nominal, context, noise, space
        self.pooling = pooling
        self.dt = frozen.settings.get("dt") if dt is None else dt
        self.process_noise_scale_tril: Tensor | None
        self.register_buffer("process_noise_scale_tril", process_noise_scale_tril)

    def _context(self, u: Tensor | None) -> Tensor | None:
        if self.context is None:
            return None
        if u is None:
            raise ValueError("this transition reads its GP context (the phase) from the control u, and no u was given")
        # Controls may stay in double precision where the state is in single.
        return self.context(u).to(self.gp.noise.dtype)

    def _parts(self, x: Tensor, u: Tensor | None, dt: Step, correction: Tensor) -> tuple[Tensor, Tensor | None, bool]:
        """Mean (..., d), floor factor and whether that is diagonal."""
        floor, diagonal = self.process_noise_scale_tril, False
        if self.nominal is None:
            mean = correction + x if self.target == "identity" else correction
        else:
            base = self.nominal(x, u, dt)
            mean = base.mean + correction
            if floor is None:
                floor, diagonal = base.scale_tril, base.is_diagonal
        return mean, floor, diagonal

    def _noisy(self, variance: Tensor) -> Tensor:
        """Latent variance, with the learned noise where that was asked for."""
        return variance + self.gp.noise if self.noise == "predictive" else variance

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the next state given x (..., d); each row is its own test point."""
        correction, variance = self.gp(x, self._context(u))
        mean, floor, diagonal = self._parts(x, u, dt, correction)
        return self._timed(x, dt, _combine(mean, self._noisy(variance), floor, diagonal))

    def pooled(self, x: Tensor, weights: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Means at sigma points and one noise for the whole set: the weighted mean of the conditional covariances.

        Args:
            x: (..., s, d) sigma points. weights: (s,), summing to one. u, dt: with a size-1 or absent sigma-point dim.

        Returns:
            Gaussian with mean (..., s, d) and factor (..., 1, d, d): one small Cholesky a set. Diagonal (..., 1, d)
            where the floor is diagonal or absent.
        """
        context = self._context(u)
        if self.pooling == "centre":
            correction = self.gp.mean(x, context)
            average = self._noisy(self.gp.variance(weighted_sum(x, weights).unsqueeze(-2), context))
        else:
            correction, variance = self.gp(x, context)
            # The variance is convex, so a negative centre weight takes its mean below zero by rounding only.
            average = weighted_sum(self._noisy(variance), weights).clamp_min(0).unsqueeze(-2)
        mean, floor, diagonal = self._parts(x, u, dt, correction)
        if floor is not None:
            floor = _pool_factor(floor, weights, diagonal)
        return self._timed(x, dt, _combine(mean, average, floor, diagonal))

    def model_variance(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Variance (..., d) that the GP itself gives to a step from x, the floor left out."""
        return self._noisy(self.gp.variance(x, self._context(u)))

    def novelty(self, x: Tensor, u: Tensor | None = None) -> Novelty:
        """Distance of queries x (..., d) from the training data, see `Novelty`."""
        context = self._context(u)
        variance = self.gp(x, context)[1]
        return Novelty((variance / self.gp.prior_variance(x)).amax(-1), self.gp.distance(x))

    def _timed(self, x: Tensor, dt: Step, law: Gaussian) -> Gaussian:
        """Hold the law to the time step it was learned for; dt = 0 means no motion."""
        if dt is None or self.dt is None:
            return law
        if not isinstance(dt, Tensor):
            if dt == 0:
                return law._replace(mean=x + 0 * law.mean, scale_tril=torch.zeros_like(law.scale_tril))
            if abs(dt - self.dt) > 1e-6 * self.dt:
                raise ValueError(f"this GP was trained for steps of {self.dt} s, got dt = {dt}")
            return law
        still = dt == 0
        known = still | ((dt - self.dt).abs() <= 1e-6 * self.dt)
        mean = torch.where(still, x, torch.where(known, law.mean, torch.full_like(law.mean, torch.nan)))
        moving = (~still).to(law.scale_tril.dtype)
        if not law.is_diagonal and moving.dim() > 0:
            moving = moving.unsqueeze(-1)
        return law._replace(mean=mean, scale_tril=law.scale_tril * moving)


def _combine(mean: Tensor, variance: Tensor, floor: Tensor | None, diagonal: bool) -> Gaussian:
    """Gaussian with covariance diag(variance) + floor floor^T; NaN factor rows where that is not positive definite."""
    if floor is None:
        return Gaussian(mean, variance.sqrt(), EUCLIDEAN, True)
    if diagonal:
        return Gaussian(mean, (variance + floor.square()).sqrt(), EUCLIDEAN, True)
    factor, info = torch.linalg.cholesky_ex(floor @ floor.mT + torch.diag_embed(variance))
    failed = (info > 0).unsqueeze(-1).unsqueeze(-1)
    return Gaussian(mean, torch.where(failed, torch.nan, factor), EUCLIDEAN)


def _pool_factor(floor: Tensor, weights: Tensor, diagonal: bool) -> Tensor:
    """One floor for a set of sigma points where the nominal law gave one for each point."""
    axis = -2 if diagonal else -3
    if floor.dim() < -axis or floor.shape[axis] == 1:
        return floor
    if diagonal:
        return weighted_sum(floor.square(), weights).clamp_min(0).sqrt().unsqueeze(-2)
    covariance = ((floor @ floor.mT) * weights[:, None, None]).sum(-3)
    return torch.linalg.cholesky_ex(covariance)[0].unsqueeze(-3)
