"""A small learning problem shared by the tests of this folder."""

import torch
from torch import Tensor

D, P = 4, 3


def phase_of(angle: Tensor) -> Tensor:
    return torch.stack([angle.cos(), angle.sin()], -1)


def queries(count: int, seed: int = 1, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(count, D, generator=generator, dtype=torch.float64) * 100 + 30
    angle = 6.3 * torch.rand(count, generator=generator, dtype=torch.float64)
    return x.to(dtype), phase_of(angle).to(dtype)


def outputs(x: Tensor, phase: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    slope = torch.randn(P, D, generator=generator, dtype=torch.float64).to(x)
    return 0.01 * (x @ slope.mT) * (1 + 0.3 * phase[..., :1]) + 0.2 * phase[..., 1:] + 3
