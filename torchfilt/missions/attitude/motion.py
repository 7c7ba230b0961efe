"""Small turns of a gyro joined, with what was sensed on the way seen from where they end."""

import torch
from torch import Tensor

from torchfilt.models.attitude import from_rotation_vector, inverse, multiply, rotate


def to_ends(angle: Tensor, *vectors: Tensor) -> tuple[Tensor, ...]:
    """Turn (k, 4) of groups of small turns (k, n, 3), rad, and means of vectors (k, n, 3) in the axes of their ends."""
    turns = from_rotation_vector(angle)
    after = torch.zeros_like(turns[:, 0])
    after[:, 3] = 1
    sums = [torch.zeros_like(v[:, 0]) for v in vectors]
    for i in reversed(range(angle.shape[1])):
        sums = [total + rotate(inverse(after), v[:, i]) for total, v in zip(sums, vectors, strict=True)]
        after = multiply(turns[:, i], after)
    return after, *(total / angle.shape[1] for total in sums)
