"""Vectors and quaternions by components, for laws in the loop of a particle filter.

A component of all particles lies flat in memory: an operation on it costs what memory costs, where a small matrix or a
row of three numbers a particle costs several times as much. All functions broadcast over the shape of the components.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

Vector = tuple[Tensor, Tensor, Tensor]


class Quaternion(NamedTuple):
    """Vector part and scalar part of a unit quaternion."""

    axis: Vector
    scalar: Tensor

    def parts(self) -> list[Tensor]:
        """The four components in the order of `torchfilt.models.attitude`."""
        return [*self.axis, self.scalar]


def vector(parts: Sequence[Tensor]) -> Vector:
    """Three components."""
    x, y, z = parts
    return x, y, z


def quaternion(q: Tensor) -> Quaternion:
    """Components of unit quaternions (..., 4)."""
    x, y, z, w = q.unbind(-1)
    return Quaternion((x, y, z), w)


def stack(parts: Sequence[Tensor]) -> Tensor:
    """Components (...) as a vector (..., d), component by component in memory."""
    return torch.stack(torch.broadcast_tensors(*parts)).movedim(0, -1)


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
    """Vector v turned by q: with t = 2 axis x v the result is v + scalar t + axis x t."""
    once = cross(q.axis, v)
    twice = cross(q.axis, once)
    parts = zip(v, once, twice, strict=True)
    return vector([torch.add(x, torch.addcmul(t, q.scalar, o), alpha=2) for x, o, t in parts])


def rotate_back(q: Quaternion, v: Vector) -> Vector:
    """Vector v turned by the inverse of q, which is q with the other sign of the scalar."""
    return rotate(Quaternion(q.axis, -q.scalar), v)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product."""
    parts = zip(cross(a.axis, b.axis), a.axis, b.axis, strict=True)
    axis = [torch.addcmul(torch.addcmul(c, a.scalar, y), x, b.scalar) for c, x, y in parts]
    scalar = a.scalar * b.scalar
    for x, y in zip(a.axis, b.axis, strict=True):
        scalar = torch.addcmul(scalar, x, y, value=-1)
    return Quaternion(vector(axis), scalar)


def half_rotation(v: Vector) -> Quaternion:
    """Quaternion of half the rotation vector v, to rounding up to |v| = 0.5 rad, to 3e-13 up to 1 rad.

    By series: no division by a length that may be zero, where the derivative would be lost.
    """
    square = (v[0].square() + v[1].square() + v[2].square()) / 16  # of the angle in the quaternion's sine and cosine
    sine = (((square / 72 - 1) * square / 42 + 1) * square / 20 - 1) * square / 6 + 1
    cosine = (((square / 56 - 1) * square / 30 + 1) * square / 12 - 1) * square / 2 + 1
    quarter = sine / 4
    return Quaternion((v[0] * quarter, v[1] * quarter, v[2] * quarter), cosine)
