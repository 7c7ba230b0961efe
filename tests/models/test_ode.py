"""Fixed-step integrators: order of convergence on a problem with a known answer."""

import itertools
import math

import pytest
import torch

from torchfilt.models.ode import nystrom4, rk4


def orbit_error(method, steps):
    """Kepler ellipse with e = 0.3, one radian of mean anomaly from perigee."""
    start = torch.tensor([0.7, 0.0, 0.0, math.sqrt(1.3 / 0.7)], dtype=torch.float64)
    pull = lambda _, p: -p / torch.linalg.vector_norm(p, dim=-1, keepdim=True) ** 3  # noqa: E731
    if method == "nystrom4":
        position, _ = nystrom4(pull, start[:2], start[2:], 1.0, steps)
    else:
        position = rk4(lambda s, x: torch.cat([x[2:], pull(s, x[:2])]), start, 1.0, steps)[:2]
    anomaly = 1.0
    for _ in range(50):
        anomaly = 1.0 + 0.3 * math.sin(anomaly)
    exact = torch.tensor([math.cos(anomaly) - 0.3, math.sqrt(1 - 0.09) * math.sin(anomaly)], dtype=torch.float64)
    return float((position - exact).abs().max())


@pytest.mark.parametrize("method", ["rk4", "nystrom4"])
def test_fourth_order(method):
    errors = [orbit_error(method, steps) for steps in (8, 16, 32, 64)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert all(3.7 < order < 4.4 for order in orders), orders


@pytest.mark.parametrize("steps", [1, 3])
def test_time_enters_as_the_elapsed_fraction(steps):
    """x' = 4 s^3 dt: fourth order integrates a cubic exactly."""
    x = rk4(lambda s, x: torch.full_like(x, 4 * s**3), torch.zeros(1, dtype=torch.float64), 2.0, steps)
    torch.testing.assert_close(x, torch.full_like(x, 2.0), rtol=1e-14, atol=0)
    rest = torch.zeros(1, dtype=torch.float64)
    p, v = nystrom4(lambda s, p: torch.full_like(p, 6 * s), rest, rest, 2.0, steps)
    torch.testing.assert_close(p, torch.full_like(p, 4.0), rtol=1e-14, atol=0)
    torch.testing.assert_close(v, torch.full_like(v, 6.0), rtol=1e-14, atol=0)


def test_rows_do_not_influence_each_other():
    x = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = rk4(lambda s, x: x.sin(), x, 1.0, 4)
    assert torch.equal(together[3], rk4(lambda s, x: x.sin(), x[3], 1.0, 4))
