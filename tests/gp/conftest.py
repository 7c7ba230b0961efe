"""Fixtures of this folder; the oracles lie beside it."""

from collections.abc import Callable

import pytest
import torch
from gp_problem import outputs, queries

from torchfilt.gp.regression import GPRegression


@pytest.fixture
def make() -> Callable[..., GPRegression]:
    """Regression with fixed hyperparameters that differ by output."""

    def build(
        kernel: str = "structured", shared: bool = False, count: int = 40, noise: float = 1e-3, dtype=torch.float64
    ) -> GPRegression:
        x, phase = queries(count, seed=2, dtype=dtype)
        regression = GPRegression(x, outputs(x, phase), phase, kernel=kernel, shared=shared)
        generator = torch.Generator().manual_seed(3)
        with torch.no_grad():
            for parameter in regression.kernel.parameters():
                parameter += 0.3 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64).to(dtype)
        regression.likelihood.noise = noise**2 * torch.linspace(1, 2, regression.likelihood.noise.numel())[:, None]
        return regression

    return build
