"""Classical series with answers found by other programs: the bootstrap filter, and our own grid, reproduce them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import grid_oracle
from oracles.grid_oracle import normal_log_density

import torchfilt as tf

CLASSIC = Path(__file__).parents[1] / "data" / "classic"


def tensor(values):
    return torch.as_tensor(np.asarray(values, dtype=float))


def exchange_rates():
    """100 diff(log(rate)) of the pound in dollars."""
    lines = (CLASSIC / "GBP_vs_USD_9798.txt").read_text().splitlines()
    rates = [float(parts[3]) for parts in map(str.split, lines) if len(parts) == 4 and parts[0].isdigit()]
    return 100 * np.diff(np.log(rates))


class LogVolatility(torch.nn.Module):
    """Y ~ N(0, exp X)."""

    def forward(self, x):
        return tf.Gaussian(torch.zeros_like(x), (x / 2).exp(), is_diagonal=True)


def model(mean, variance, step, noise, observation):
    return tf.StateSpaceModel(
        tf.Gaussian(tensor([mean]), tensor([[variance**0.5]])),
        tf.AdditiveGaussian(step, tensor([[noise**2]])),
        observation,
    )


def volatility():
    mu, rho, s = -1.02, 0.9702, 0.178

    def step(x):
        return mu + rho * (x - mu)

    laws = model(mu, s**2 / (1 - rho**2), step, s, LogVolatility())
    return (
        laws,
        exchange_rates(),
        dict(
            points=np.linspace(-8, 6, 1201),
            initial=lambda x: normal_log_density(x, mu, s**2 / (1 - rho**2)),
            transition=lambda after, x: normal_log_density(after, step(x), s**2),
            observation=lambda y, x: normal_log_density(y, 0.0, np.exp(x)),
        ),
    )


def additive(noise):
    return tf.AdditiveGaussian(lambda x: x, tensor([[noise**2]]))


def nutria():
    def step(x):
        return x + 0.15 - 0.12 * (torch.exp(0.1 * x) if isinstance(x, torch.Tensor) else np.exp(0.1 * x))

    return (
        model(0.0, 1.0, step, 0.47, additive(0.39)),
        np.loadtxt(CLASSIC / "nutria.txt"),
        dict(
            points=np.linspace(-8, 10, 1501),
            initial=lambda x: normal_log_density(x, 0.0, 1.0),
            transition=lambda after, x: normal_log_density(after, step(x), 0.47**2),
            observation=lambda y, x: normal_log_density(y, x, 0.39**2),
        ),
    )


def scalar():
    ys = np.loadtxt(CLASSIC / "simulated_linGauss_T100_varX1_varY.04_rho.9.txt")
    return (
        model(0.0, 1 / (1 - 0.81), lambda x: 0.9 * x, 1.0, additive(0.2)),
        ys,
        dict(
            points=np.linspace(-14, 14, 1501),
            initial=lambda x: normal_log_density(x, 0.0, 1 / (1 - 0.81)),
            transition=lambda after, x: normal_log_density(after, 0.9 * x, 1.0),
            observation=lambda y, x: normal_log_density(y, x, 0.04),
        ),
    )


# Log-likelihood, last filtered mean and variance, as listed beside the data.
ANSWERS = {
    "volatility": (volatility, -492.4542426, -1.8344585, 0.2401856),
    "nutria": (nutria, -78.3153601, 2.6761473, 0.1031855),
    "scalar": (scalar, -149.3812412, None, None),
}


@pytest.fixture(scope="module")
def grids():
    """Our own quadrature of each problem, once."""
    found = {}
    for name, (problem, *_) in ANSWERS.items():
        _, ys, grid = problem()
        logs, means, variances = grid_oracle.grid_filter(**grid, ys=ys, predict_first=False)
        found[name] = logs.sum(), means[-1], variances[-1]
    return found


@pytest.mark.parametrize("name", ANSWERS)
def test_own_grid_reproduces_the_listed_answers(name, grids):
    """Seven decimals are listed."""
    _, log, mean, variance = ANSWERS[name]
    found = grids[name]
    assert found[0] == pytest.approx(log, abs=6e-8)
    if mean is not None:
        assert found[1] == pytest.approx(mean, abs=6e-8) and found[2] == pytest.approx(variance, abs=6e-8)


def check(filter, ys, runs, answer, seed=1):
    """Log-likelihood and last mean against a grid; 4.5 standard errors, false alarm 1 in 75,000.

    E log Z is below log Z by half its variance, which is added; the rest of the expansion is of third order.
    """
    data = tensor(ys).reshape(-1, 1, 1).expand(-1, runs, 1)
    history = filter(data, predict_first=False, seed=seed)
    log, mean = history.log_likelihood, history.mean[-1, :, 0]
    variance = log.var()
    corrected = log.mean() + variance / 2
    error = (variance / runs + variance**2 / (2 * runs)) ** 0.5
    assert error < 0.25
    assert abs(corrected - answer[0]) < 4.5 * error, (corrected.item(), answer[0], error.item())
    assert abs(mean.mean() - answer[1]) < 4.5 * mean.std() / runs**0.5 + answer[2] ** 0.5 / filter.particles
    spread = history.covariance[-1, :, 0, 0]
    assert abs(spread.mean() - answer[2]) < 4.5 * spread.std() / runs**0.5 + 5 * answer[2] / filter.particles


@pytest.mark.parametrize("name", ANSWERS)
def test_bootstrap_filter_reproduces_the_answers(name, grids):
    laws, ys, _ = ANSWERS[name][0]()
    # The scalar model's measurements are five times as sharp as its motion: few particles survive each step.
    check(tf.BootstrapFilter(laws, 8000 if name == "scalar" else 500), ys, 40, grids[name])


@pytest.mark.parametrize("name", ["nutria", "scalar"])
def test_gaussian_bank_reproduces_the_answers(name, grids):
    """Mildly curved: the linearisation inside each particle is far below the Monte Carlo error."""
    laws, ys, _ = ANSWERS[name][0]()
    filter = tf.UnscentedParticleFilter(laws, 50, redraw="always", split=0.0, pooled=False, weights="joint")
    check(filter, ys, 40, grids[name])
