"""A small system to learn: a rotation whose rate depends on a phase."""

import numpy as np
import torch


def phase(u):
    return torch.cat([u.cos(), u.sin()], -1)


def pairs(count=60, seed=0, noise=1e-4):
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    x, u = torch.randn(count, 2, **options), 6.3 * torch.rand(count, 1, **options)
    turned = torch.stack([-x[:, 1], x[:, 0]], -1)
    return x, u, x + 0.1 * turned * (1 + 0.5 * u.cos()) + noise * torch.randn(count, 2, **options)


def write_log(path, count=60, seed=0, **arrays):
    """The pairs as an NPZ file; arrays replace or add, None leaves one out."""
    x, u, x_next = pairs(count, seed)
    content = {"x": x.numpy(), "u": u.numpy(), "x_next": x_next.numpy(), "dt": 1.0, "time": np.arange(count), **arrays}
    np.savez(path, **{name: array for name, array in content.items() if array is not None})
