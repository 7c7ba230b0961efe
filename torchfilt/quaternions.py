"""Vectors and unit quaternions by components, for what runs once for every particle.

A component of all particles lies flat in memory: an operation on it costs what memory costs, where a row of four
numbers a particle, as RoMa has it, costs several times as much. Order x y z w, Hamilton product, as in RoMa, which is
what the formulas are tested against. All functions broadcast over the shape of the components.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

Vector = tuple[Tensor, Tensor, Tensor]


class Quaternion(NamedTuple):
    """Vector part and scalar part."""

    axis: Vector
    scalar: Tensor

    def parts(self) -> list[Tensor]:
        """The four components."""
        return [*self.axis, self.scalar]


def vector(parts: Sequence[Tensor]) -> Vector:
    """Three components."""
    x, y, z = parts
    return x, y, z


def quaternion(q: Tensor) -> Quaternion:
    """Components of quaternions (..., 4)."""
    x, y, z, w = q.unbind(-1)
    return Quaternion((x, y, z), w)


def stack(parts: Sequence[Tensor]) -> Tensor:
    """Components (...) as a vector (..., d), component by component in memory."""
    if any(part.shape != parts[0].shape for part in parts):
        parts = torch.broadcast_tensors(*parts)
    return torch.stack(list(parts)).movedim(0, -1)


def minus(a: Vector, b: Vector) -> Vector:
    """Difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def apply(matrix: Sequence[Tensor], v: Sequence[Tensor]) -> Vector:
    """Matrix, nine entries row by row, times v."""
    rows = (matrix[0:3], matrix[3:6], matrix[6:9])
    return vector([torch.addcmul(torch.addcmul(r[0] * v[0], r[1], v[1]), r[2], v[2]) for r in rows])


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return (
        torch.addcmul(a[1] * b[2], a[2], b[1], value=-1),
        torch.addcmul(a[2] * b[0], a[0], b[2], value=-1),
        torch.addcmul(a[0] * b[1], a[1], b[0], value=-1),
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Vector v turned by unit quaternions: with t = 2 axis x v the result is v + scalar t + axis x t."""
    x, y, z = once = cross(q.axis, v)
    twice, w = cross(q.axis, once), q.scalar
    return (
        torch.add(v[0], torch.addcmul(twice[0], w, x), alpha=2),
        torch.add(v[1], torch.addcmul(twice[1], w, y), alpha=2),
        torch.add(v[2], torch.addcmul(twice[2], w, z), alpha=2),
    )


def rotate_back(q: Quaternion, v: Vector) -> Vector:
    """Vector v turned by the inverse of q, which is q with the other sign of the scalar."""
    return rotate(Quaternion(q.axis, -q.scalar), v)


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of unit quaternions."""
    return Quaternion((-q.axis[0], -q.axis[1], -q.axis[2]), q.scalar)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product: turn by b first, then by a."""
    (p, q, r), s = a
    (x, y, z), w = b
    i, j, k = cross(a.axis, b.axis)
    axis = (
        torch.addcmul(torch.addcmul(i, s, x), p, w),
        torch.addcmul(torch.addcmul(j, s, y), q, w),
        torch.addcmul(torch.addcmul(k, s, z), r, w),
    )
    scalar = torch.addcmul(torch.addcmul(s * w, p, x, value=-1), q, y, value=-1)
    return Quaternion(axis, torch.addcmul(scalar, r, z, value=-1))


def exponential(v: Vector, share: float = 1.0) -> Quaternion:
    """Unit quaternion of ``share`` of the rotation vector v in rad.

    The length is kept off zero by less than rounding notices, so that no vector is a special case and derivatives stay.
    """
    length = (_square(v) + _tiny(v[0].dtype)).sqrt()
    half = length * (0.5 * share)
    scale = half.sin() / length
    return Quaternion((v[0] * scale, v[1] * scale, v[2] * scale), half.cos())


def logarithm(q: Quaternion) -> Vector:
    """Rotation vector, at most pi long, of quaternions of any norm but zero; q and -q have the same."""
    length = torch.addcmul(_square(q.axis), q.scalar, q.scalar, value=_tiny(q.scalar.dtype)).sqrt()
    sign = torch.copysign(q.scalar.new_ones(()), q.scalar.detach())
    twice = torch.atan2(length, q.scalar * sign) * 2
    scale = twice / (length * sign)
    return q.axis[0] * scale, q.axis[1] * scale, q.axis[2] * scale


def turned_by_jacobian(v: Vector, error: Vector) -> Vector:
    """J(v) error, where exp(v + error) = exp(J(v) error) exp(v) to first order in the error: the left Jacobian.

    J = I + (1 - cos a) / a^2 [v] + (a - sin a) / a^3 [v]^2 with a the length of v, at most a turn.
    """
    square = _square(v)
    small = square < 1e-2
    # Where the series is taken the other branch gets a harmless argument: derivatives of both are formed.
    angle2 = torch.where(small, 1, square)
    angle = angle2.sqrt()
    first = torch.where(small, _series(square, _COSINE), 2 * (0.5 * angle).sin().square() / angle2)
    second = torch.where(small, _series(square, _SINE), (angle - angle.sin()) / (angle2 * angle))
    return _second_order(v, error, first, second)


def turned_by_inverse_jacobian(v: Vector, error: Vector) -> Vector:
    """The inverse of `turned_by_jacobian`, for v shorter than a turn: I - [v] / 2 + (1 - a/2 cot a/2) / a^2 [v]^2.

    Source: Barfoot, State Estimation for Robotics (2017), section 7.1.5.
    """
    square = _square(v)
    small = square < 1e-2
    angle2 = torch.where(small, 1, square)
    half = 0.5 * angle2.sqrt()
    second = torch.where(small, _series(square, _COTANGENT), (1 - half * half.cos() / half.sin()) / angle2)
    return _second_order(v, error, torch.full_like(second, -0.5), second)


def _second_order(v: Vector, error: Vector, first: Tensor, second: Tensor) -> Vector:
    """Error + first v x error + second v x (v x error)."""
    once = cross(v, error)
    twice = cross(v, once)
    x, y, z = (torch.addcmul(torch.addcmul(e, first, o), second, t) for e, o, t in zip(error, once, twice, strict=True))
    return x, y, z


# (1 - cos a) / a^2 and (a - sin a) / a^3 in powers of a^2: what is left out below 0.01 is less than rounding.
_COSINE = (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)
_SINE = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)

# (1 - a/2 cot a/2) / a^2 in the same way.
_COTANGENT = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)


def _series(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    total = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = torch.add(x * total, coefficient)
    return total


def _square(v: Vector) -> Tensor:
    """Square of the length."""
    return torch.addcmul(torch.addcmul(v[0] * v[0], v[1], v[1]), v[2], v[2])


def _tiny(dtype: torch.dtype) -> float:
    """What may be added to the square of a small angle: sin(a) / a and atan(a) / a change by less than rounding."""
    return torch.finfo(dtype).eps / 4
