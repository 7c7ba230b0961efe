"""Where a state or a measurement lives: Euclidean axes, angles, unit quaternions and products of them.

A space turns a tangent vector (the error, e numbers) into a point (d numbers) and back:
``retract(x, v)`` walks from x along v; ``local(x, y)`` is the v that leads from x to y. Everything else
(sampling, densities, innovations, means, covariances) follows from the two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torchfilt.linalg import is_differentiated
from torchfilt.quaternions import (
    Vector,
    conjugate,
    exponential,
    logarithm,
    product,
    quaternion,
    stack,
    turned_by_inverse_jacobian,
    turned_by_jacobian,
    vector,
)


@runtime_checkable
class Space(Protocol):
    """What filters ask of a space; points are (..., d), tangent vectors (..., e)."""

    @property
    def size(self) -> int | None:
        """Numbers in a point, d; None where any number will do."""
        ...

    @property
    def tangent_size(self) -> int | None:
        """Numbers in a tangent vector, e."""
        ...

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """Point reached from x by the tangent vector v."""
        ...

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """Tangent vector at x that leads to y (the shortest one)."""
        ...

    def project(self, x: Tensor) -> Tensor:
        """Nearest point of the space: undoes rounding, not modelling errors."""
        ...

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """Intrinsic mean of points (..., n, d) with weights (..., n) that sum to one."""
        ...

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """Small errors (..., e, k) about x as errors about ``retract(x, v)``; ``columns`` itself on a flat space.

        The derivative of ``local(retract(x, v), retract(x, v + error))`` by the error, wherever x is.
        """
        ...

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """Small errors (..., e, k) about ``retract(x, v)`` as errors about v in the chart of x: undoes `carry`."""
        ...

    def observed(self, y: Tensor) -> Tensor:
        """Which tangent components (..., e) of a measurement are there: NaN means not measured."""
        ...


# Shorter sums torch never shares between threads (its grain size).
_SHARED_SUM = 32768


def steady_sum(values: Tensor, dim: int) -> Tensor:
    """Sum over a dim, counted from the end: the same bits for any thread count.

    torch shares one long sum between threads only when there is nothing else to share; beside a copy of itself, which
    takes no memory, it stays whole.
    """
    if values.numel() == values.shape[dim] and values.numel() >= _SHARED_SUM:
        return values.expand(2, *values.shape).sum(dim)[0]
    return values.sum(dim)


def weighted_sum(values: Tensor, weights: Tensor) -> Tensor:
    """Sum over n of weights (..., n) times values (..., n, d): the same bits for any thread count."""
    return steady_sum(values * weights.unsqueeze(-1), -2)


def transport(space: Space, v: Tensor, factor: Tensor) -> Tensor:
    """Factor (..., e, e) of a covariance about x as one about ``retract(x, v)``, lower triangular again."""
    carried = space.carry(v, factor)
    if carried is factor:
        return factor
    curved = curved_components(space, factor.shape[-1])
    starts = [k for k in curved if k - 1 not in curved]
    ends = [k + 1 for k in curved if k + 1 not in curved]
    for start, end in zip(starts, ends, strict=True):
        carried = _triangular_block(carried, start, end)
    return carried


def _triangular_block(factor: Tensor, start: int, end: int) -> Tensor:
    """A factor that is lower triangular but for one diagonal block, made so by turning the block's columns."""
    turn, r = torch.linalg.qr(factor[..., start:end, start:end].mT)
    diagonal = r.diagonal(dim1=-2, dim2=-1)
    turn = turn * torch.copysign(diagonal.new_ones(()), diagonal.detach()).unsqueeze(-2)
    block = torch.nn.functional.pad((factor[..., start:, start:end] @ turn), (0, 0, start, 0))
    # What the turn leaves above the diagonal is rounding.
    return torch.cat([factor[..., :start], block, factor[..., end:]], -1).tril()


def curved_components(space: Space, size: int) -> tuple[int, ...]:
    """Which of ``size`` tangent components `Space.carry` may change."""
    if isinstance(space, Product):
        found, start = [], 0
        for part in space.spaces:
            own = int(part.tangent_size or 0)
            found += [start + k for k in curved_components(part, own)]
            start += own
        return tuple(found)
    return () if isinstance(space, Euclidean | Angle) else tuple(range(size))


def centred(space: Space, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Intrinsic mean (..., d) of points (..., n, d) and their errors from it (..., n, e), ``local(mean, points)``.

    A curved space has the errors at hand when it has found the mean.
    """
    if isinstance(space, Angle | UnitQuaternion | Product):
        return space.centred(points, weights)
    mean = space.mean(points, weights)
    return mean, space.local(mean.unsqueeze(-2), points)


@dataclass(frozen=True)
class Euclidean:
    """Plain vectors of ``size`` numbers (any number when None)."""

    size: int | None = None

    @property
    def tangent_size(self) -> int | None:
        """The same as ``size``."""
        return self.size

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """``x + v``."""
        return x + v

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """``y - x``."""
        return y - x

    def project(self, x: Tensor) -> Tensor:
        """``x`` itself."""
        return x

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """Weighted sum."""
        return weighted_sum(points, weights)

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """The columns themselves."""
        return columns

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """The columns themselves."""
        return columns

    def observed(self, y: Tensor) -> Tensor:
        """Each number on its own."""
        return ~torch.isnan(y)


EUCLIDEAN = Euclidean()


def wrap_angle(x: Tensor) -> Tensor:
    """Angle in [-pi, pi] rad (to the rounding of x) equal to x modulo a turn; exact where x is already inside."""
    turns = torch.round(x / (2 * torch.pi))
    return x - turns * (2 * torch.pi)


@dataclass(frozen=True)
class Angle:
    """``size`` independent angles in radians; every difference is wrapped to [-pi, pi]."""

    size: int = 1

    @property
    def tangent_size(self) -> int:
        """The same as ``size``."""
        return self.size

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """Wrapped sum."""
        return wrap_angle(x + v)

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """Wrapped difference."""
        return wrap_angle(y - x)

    def project(self, x: Tensor) -> Tensor:
        """Wrapped angle."""
        return wrap_angle(x)

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """Circular start, then the intrinsic iteration.

        Where the circular average vanishes (opposite angles of equal weight) the iteration starts from the angle of the
        heaviest weight, the first among equals: a stationary point, though not the only one.
        """
        return self._iterated(points, weights)[0]

    def centred(self, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """The `mean`, and what each point (..., n, d) is off it."""
        mean, errors = self._iterated(points, weights)
        return mean, self.local(mean.unsqueeze(-2), points) if errors is None else errors

    def _iterated(self, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor | None]:
        sine, cosine = weighted_sum(points.sin(), weights), weighted_sum(points.cos(), weights)
        vanishes = torch.hypot(sine, cosine) < _vanishing(weights).unsqueeze(-1)
        # The limit of the iteration does not depend on where it starts, and `atan2` has no derivative at zero.
        start = torch.where(vanishes, _heaviest(points, weights), torch.atan2(sine, cosine)).detach()
        return _intrinsic_mean(self, points, weights, start)

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """The columns themselves."""
        return columns

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """The columns themselves."""
        return columns

    def observed(self, y: Tensor) -> Tensor:
        """Each angle on its own."""
        return ~torch.isnan(y)


@dataclass(frozen=True)
class UnitQuaternion:
    """Rotations as unit quaternions, order x y z w (RoMa's); q and -q are the same point.

    The tangent is a rotation vector in rad. ``side="right"`` puts the error on the right, ``q * exp(v)`` (body axes of
    a body-to-world quaternion); ``"left"`` puts it on the left, ``exp(v) * q`` (world axes).
    """

    side: str = "right"

    def __post_init__(self) -> None:
        if self.side not in ("left", "right"):
            raise ValueError(f"side must be 'left' or 'right', got {self.side!r}")

    @property
    def size(self) -> int:
        """Four numbers."""
        return 4

    @property
    def tangent_size(self) -> int:
        """Three numbers."""
        return 3

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """Rotation x turned by the rotation vector v; the norm is restored."""
        start, step = quaternion(x), exponential(vector(v.unbind(-1)))
        turned = product(start, step) if self.side == "right" else product(step, start)
        return self.project(stack(turned.parts()))

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """Rotation vector (at most pi long) that turns x into y; a norm that is not one does not count."""
        back, end = conjugate(quaternion(x)), quaternion(y)
        return stack(logarithm(product(back, end) if self.side == "right" else product(end, back)))

    def project(self, x: Tensor) -> Tensor:
        """Normalised quaternion."""
        return x * x.square().sum(-1, keepdim=True).rsqrt()

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """Sign-aligned normalised average, then the intrinsic iteration.

        To machine precision for points up to 1.5 rad from their mean. Where the average vanishes (opposite rotations)
        the iteration starts from the point of the heaviest weight, the first among equals: a stationary point, though
        not the only one.

        Source: Pennec, Computing the mean of geometric features, INRIA report 3371 (1998).
        """
        return self._iterated(points, weights)[0]

    def centred(self, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """The `mean`, and the errors (..., n, 3) of all points from it."""
        mean, errors = self._iterated(points, weights)
        return mean, self.local(mean.unsqueeze(-2), points) if errors is None else errors

    def _iterated(self, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor | None]:
        heaviest = _heaviest(points, weights)
        side = torch.copysign(weights.new_ones(()), (points * heaviest.unsqueeze(-2)).sum(-1).detach())
        average = weighted_sum(points, weights * side)
        vanishes = torch.linalg.vector_norm(average, dim=-1, keepdim=True) < _vanishing(weights).unsqueeze(-1)
        # The limit of the iteration does not depend on where it starts.
        start = self.project(torch.where(vanishes, heaviest, average).detach())
        return _intrinsic_mean(self, points, weights, start, curved=True)

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """Columns times the Jacobian of the exponential map, of the side of the error.

        Source: Mueller, Hehn, D'Andrea, Covariance correction step for Kalman filtering with an attitude, JGCD 40
            (2017), which takes its first two terms.
        """
        return self._turned(turned_by_jacobian, v, columns)

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """Columns times the inverse of that Jacobian; for v shorter than a turn."""
        return self._turned(turned_by_inverse_jacobian, v, columns)

    def _turned(self, by: Callable[[Vector, Vector], Vector], v: Tensor, columns: Tensor) -> Tensor:
        backward = v if self.side == "left" else -v
        return stack(by(vector(backward.unsqueeze(-1).unbind(-2)), vector(columns.unbind(-2)))).mT

    def observed(self, y: Tensor) -> Tensor:
        """All of it or nothing."""
        return (~torch.isnan(y).any(-1, keepdim=True)).expand(*y.shape[:-1], 3)


class Product:
    """Several spaces side by side: ``Product(Euclidean(6), UnitQuaternion())`` has d = 10, e = 9."""

    def __init__(self, *spaces: Space) -> None:
        if not spaces:
            raise ValueError("Product needs at least one space")
        for space in spaces:
            if space.size is None or space.tangent_size is None:
                raise ValueError(f"a space inside a Product must state its size, got {space!r}; write Euclidean(n)")
        self.spaces = spaces
        self._sizes = [int(space.size or 0) for space in spaces]
        self._tangent_sizes = [int(space.tangent_size or 0) for space in spaces]

    def __repr__(self) -> str:
        return f"Product({', '.join(map(repr, self.spaces))})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Product) and self.spaces == other.spaces

    def __hash__(self) -> int:
        return hash(self.spaces)

    @property
    def size(self) -> int:
        """Sum of the sizes."""
        return sum(self._sizes)

    @property
    def tangent_size(self) -> int:
        """Sum of the tangent sizes."""
        return sum(self._tangent_sizes)

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """Each part along its own tangent."""
        parts = zip(self.spaces, x.split(self._sizes, -1), v.split(self._tangent_sizes, -1), strict=True)
        return _side_by_side([space.retract(a, b) for space, a, b in parts])

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """Each part's own tangent vector."""
        parts = zip(self.spaces, x.split(self._sizes, -1), y.split(self._sizes, -1), strict=True)
        return _side_by_side([space.local(a, b) for space, a, b in parts])

    def project(self, x: Tensor) -> Tensor:
        """Each part by its own rule."""
        parts = zip(self.spaces, x.split(self._sizes, -1), strict=True)
        return _side_by_side([space.project(a) for space, a in parts])

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """Each part's own mean."""
        parts = zip(self.spaces, points.split(self._sizes, -1), strict=True)
        return _side_by_side([space.mean(a, weights) for space, a in parts])

    def centred(self, points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Each part's own mean and errors."""
        parts = zip(self.spaces, points.split(self._sizes, -1), strict=True)
        means, errors = zip(*(centred(space, a, weights) for space, a in parts), strict=True)
        return _side_by_side(means), _side_by_side(errors)

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """Each part's rows by its own rule."""
        return self._by_parts([space.carry for space in self.spaces], v, columns)

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """Each part's rows by its own rule."""
        return self._by_parts([space.carry_back for space in self.spaces], v, columns)

    def _by_parts(self, rules: list[Callable[[Tensor, Tensor], Tensor]], v: Tensor, columns: Tensor) -> Tensor:
        rows = columns.split(self._tangent_sizes, -2)
        parts = zip(rules, v.split(self._tangent_sizes, -1), rows, strict=True)
        carried = [rule(step, part) for rule, step, part in parts]
        if all(after is before for after, before in zip(carried, rows, strict=True)):
            return columns
        lead = torch.broadcast_shapes(*(part.shape[:-2] for part in carried))
        return torch.cat([part.expand(*lead, *part.shape[-2:]) for part in carried], -2)

    def observed(self, y: Tensor) -> Tensor:
        """Each part by its own rule."""
        parts = zip(self.spaces, y.split(self._sizes, -1), strict=True)
        return torch.cat([space.observed(a) for space, a in parts], -1)


def _side_by_side(parts: Sequence[Tensor]) -> Tensor:
    """Parts (..., k_i) as one (..., k), component by component in memory: what follows works on components."""
    return torch.cat([part.movedim(-1, 0) for part in parts]).movedim(0, -1)


def _heaviest(points: Tensor, weights: Tensor) -> Tensor:
    """Point (..., d) of the largest weight in magnitude, the first among equals."""
    best = weights.abs().argmax(-1, keepdim=True).unsqueeze(-1)
    # One set of weights may serve a batch of point sets.
    best = best.expand(*points.shape[:-2], 1, 1)
    return torch.take_along_dim(points, best, -2).squeeze(-2)


def _vanishing(weights: Tensor) -> Tensor:
    """Length below which the direction of an average of unit vectors is mostly rounding."""
    return weights.abs().sum(-1) * torch.finfo(weights.dtype).eps ** 0.5


def _intrinsic_mean(
    space: Space, points: Tensor, weights: Tensor, start: Tensor, *, curved: bool = False, iterations: int = 20
) -> tuple[Tensor, Tensor | None]:
    """Mean by the fixed-point iteration ``m <- retract(m, sum of w local(m, x))``, and the errors from it if at hand.

    Rows stop one by one, never because of others. In a curved space a round multiplies the error by a factor, at most
    the mean of ``|w| angle^2 / 8`` (for angles below 2.7 rad), which foretells that the next one would change nothing.
    The derivative gains the same factor a round and starts from nothing, so its rounds are counted too.
    """
    mean, scale = start, weights.abs()
    tolerance = 8 * torch.finfo(points.dtype).eps * scale.sum(-1, keepdim=True)
    differentiated = is_differentiated(points, weights)
    active = torch.ones(mean.shape[:-1], dtype=torch.bool, device=mean.device).unsqueeze(-1)
    for rounds in range(1, iterations + 1):
        errors = space.local(mean.unsqueeze(-2), points)
        step = weighted_sum(errors, weights)
        size = step.detach().abs().amax(-1, keepdim=True)
        active = active & (size > tolerance)
        if not differentiated and _all_false(active):
            return mean, errors
        new = space.retract(mean, step)
        # A row that has stopped keeps its value, to the bit, and goes on with its derivative.
        mean = (
            torch.where(active, new, mean)
            if not differentiated
            else new + (torch.where(active, new, mean) - new).detach()
        )
        unfinished = active
        if curved:
            factor = (errors.detach().square().sum(-1) * scale.detach()).sum(-1, keepdim=True) / 8
            active = active & (factor * size > tolerance)
            unfinished = active | (factor**rounds > tolerance) if differentiated else active
        if _all_false(unfinished):
            break
    return mean, None


def _all_false(flags: Tensor) -> bool:
    """Whether no flag is set; False where a tensor can't be read, under `torch.compile` and `torch.vmap`."""
    if torch.compiler.is_compiling():
        return False
    try:
        return not flags.any()
    except RuntimeError as error:
        if "data-dependent" not in str(error):
            raise
        return False
