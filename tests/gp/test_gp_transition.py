"""The GP as a transition law: means, noises, time steps, sigma-point sets and refusals."""

import pytest
import torch
from gp_problem import D, queries
from torch import nn

from torchfilt.gaussian import Gaussian
from torchfilt.gp import FrozenGP, GPTransition, one_step_targets
from torchfilt.gp.regression import GPRegression

DT = 10.0
FACTOR = torch.diag(torch.tensor([1.0, 2.0, 0.5, 0.1], dtype=torch.float64)) + 0.3 * torch.ones(4, 4).double().tril(-1)


class Nominal(nn.Module):
    """Decay with a full noise factor, or a diagonal one, or one that depends on the state."""

    def __init__(self, kind: str = "full") -> None:
        super().__init__()
        self.kind = kind

    def forward(self, x, u=None, dt=None):
        mean = 0.9 * x
        if self.kind == "diagonal":
            return Gaussian(mean, FACTOR.diagonal(), is_diagonal=True)
        if self.kind == "varying":
            return Gaussian(mean, FACTOR * (1 + x[..., :1, None].abs() / 100))
        return Gaussian(mean, FACTOR.to(x))


def phase(u):
    return torch.cat([u.cos(), u.sin()], -1)


def pairs(count=40, seed=2):
    generator = torch.Generator().manual_seed(seed)
    x, _ = queries(count, seed=seed)
    u = 6.3 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    slope = torch.randn(D, D, generator=generator, dtype=torch.float64)
    return x, u, 0.9 * x + 0.01 * x @ slope.mT * (1 + 0.3 * u.cos()) + 0.1 * u.sin()


def build(nominal, kernel="structured", target=None, **options):
    x, u, x_next = pairs()
    target = target or ("identity" if nominal is None else "residual")
    y = one_step_targets(x, u, x_next, DT, target=target, nominal=nominal)
    regression = GPRegression(x, y, phase(u), kernel=kernel)
    regression.likelihood.noise = 1e-4
    return GPTransition(regression.freeze({"target": target, "dt": DT}), nominal, context=phase, **options)


@pytest.mark.parametrize(("nominal", "target"), [(Nominal(), "residual"), (None, "identity"), (None, "next_state")])
def test_predicts_the_next_state_for_each_target(nominal, target):
    law = build(nominal, target=target)
    x, u, x_next = pairs()
    assert law.target == target
    result = law(x, u, DT)
    assert (result.mean - x_next).abs().max() < 0.05 * (x_next - 0.9 * x).abs().max()


@pytest.mark.parametrize("noise", ["predictive", "latent"])
@pytest.mark.parametrize("kind", ["full", "diagonal"])
def test_covariance_is_gp_variance_plus_floor(noise, kind):
    law = build(Nominal(kind), noise=noise)
    x, u, _ = pairs(6)
    mean, variance = law.gp(x, phase(u))
    if noise == "predictive":
        variance = variance + law.gp.noise
    floor = FACTOR if kind == "full" else FACTOR.diagonal().diag()
    result = law(x, u, DT)
    torch.testing.assert_close(result.mean, 0.9 * x + mean)
    torch.testing.assert_close(result.covariance, floor @ floor.mT + torch.diag_embed(variance))
    assert result.is_diagonal == (kind == "diagonal")
    torch.testing.assert_close(law.model_variance(x, u), variance)


def test_floor_can_be_replaced_or_absent():
    x, u, _ = pairs(6)
    replaced = build(Nominal(), process_noise_scale_tril=2 * FACTOR)
    expected = 4 * FACTOR @ FACTOR.mT + torch.diag_embed(replaced.model_variance(x, u))
    torch.testing.assert_close(replaced(x, u, DT).covariance, expected)
    bare = build(None)(x, u, DT)
    assert bare.is_diagonal
    torch.testing.assert_close(bare.variance, build(None).model_variance(x, u))


@pytest.mark.parametrize("kernel", ["structured", "ard"])
@pytest.mark.parametrize("kind", ["full", "diagonal", "varying"])
def test_pooled_is_the_weighted_mean_of_the_noises(kernel, kind):
    law = build(Nominal(kind), kernel)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(3, 5, 9, D, dtype=torch.float64, generator=generator) * 50
    u = torch.rand(3, 1, 1, 1, dtype=torch.float64, generator=generator)
    weights = torch.rand(9, dtype=torch.float64, generator=generator)
    weights = weights / weights.sum()
    each, pooled = law(x, u, DT), law.pooled(x, weights, u, DT)
    torch.testing.assert_close(pooled.mean, each.mean)
    factor = pooled.factor()
    assert factor.shape == (3, 5, 1, D, D)
    average = (each.covariance * weights[:, None, None]).sum(-3)
    torch.testing.assert_close(factor.squeeze(-3) @ factor.squeeze(-3).mT, average)
    alone = law.pooled(x[0, 0], weights, u[0, 0, 0], DT)
    torch.testing.assert_close(alone.factor(), factor[0, 0])


@pytest.mark.parametrize("kernel", ["structured", "ard"])
def test_pooling_at_the_centre(kernel):
    law = build(Nominal("diagonal"), kernel, pooling="centre")
    x = torch.randn(5, 9, D, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 50
    u = torch.zeros(1, 1, 1, dtype=torch.float64)
    weights = torch.full((9,), 1 / 9, dtype=torch.float64)
    pooled = law.pooled(x, weights, u, DT)
    torch.testing.assert_close(pooled.mean, law(x, u, DT).mean)
    torch.testing.assert_close(pooled.variance.squeeze(-2), law(x.mean(-2), u[0], DT).variance)


def test_negative_centre_weight_keeps_a_valid_noise():
    law = build(Nominal())
    weights = torch.full((9,), 0.5, dtype=torch.float64)
    weights[0] = -3.0
    x = torch.zeros(9, D, dtype=torch.float64)
    x[1:5], x[5:] = torch.eye(D), -torch.eye(D)
    assert torch.isfinite(law.pooled(x, weights, torch.zeros(1).double(), DT).scale_tril).all()


def test_time_steps():
    law = build(Nominal())
    x, u, _ = pairs(4)
    still = law(x, u, 0.0)
    assert torch.equal(still.mean, x) and (still.scale_tril == 0).all()
    with pytest.raises(ValueError, match=r"steps of 10\.0 s, got dt = 5"):
        law(x, u, 5.0)
    dt = torch.tensor([[10.0], [0.0], [5.0], [10.0]], dtype=torch.float64)
    mixed = law(x, u, dt)
    expected = law(x, u, DT)
    torch.testing.assert_close(mixed.mean[[0, 3]], expected.mean[[0, 3]])
    torch.testing.assert_close(mixed.scale_tril[[0, 3]], expected.scale_tril[[0, 3]])
    assert torch.equal(mixed.mean[1], x[1]) and (mixed.scale_tril[1] == 0).all()
    assert torch.isnan(mixed.mean[2]).all()
    torch.testing.assert_close(law(x, u, torch.tensor(10.0).double()).mean, expected.mean)
    diagonal = build(None)(x, u, dt)
    assert (diagonal.scale_tril[1] == 0).all() and (diagonal.scale_tril[0] > 0).all()


def test_novelty_grows_away_from_the_data():
    law = build(Nominal())
    x, u, _ = pairs(5)
    inside, outside = law.novelty(x, u), law.novelty(100 * x, u)
    assert inside.variance_ratio.shape == inside.distance.shape == (5,)
    assert (inside.variance_ratio < 1).all() and (outside.variance_ratio <= 1 + 1e-12).all()
    assert (outside.distance > 20 * inside.distance).all()
    dense = build(Nominal(), "ard")
    assert (dense.novelty(100 * x, u).variance_ratio > 0.99).all()


def test_state_only_context_and_regression_argument():
    x, _, x_next = pairs()
    regression = GPRegression(x, x_next - x, kernel="ard")
    law = GPTransition(regression)
    assert law.target == "identity" and law(x, None, 3.0).mean.shape == x.shape
    frozen = regression.freeze()
    assert isinstance(frozen, FrozenGP)
    torch.testing.assert_close(law(x).mean, x + frozen.mean(x))


def test_law_works_under_transforms_and_compile():
    law = build(Nominal())
    x, u, _ = pairs(6)
    jacobian = torch.func.vmap(torch.func.jacfwd(lambda a: law(a, u[0], DT).mean))(x)
    moved = (law(x + 1e-3 * torch.eye(D)[0].double(), u[0], DT).mean - law(x, u[0], DT).mean) / 1e-3
    torch.testing.assert_close(jacobian[..., 0], moved, rtol=1e-7, atol=1e-7)
    compiled = torch.compile(lambda a, b: law(a, b, DT)[:2], fullgraph=True, backend="aot_eager")
    for got, expected in zip(compiled(x, u[0]), law(x, u[0], DT)[:2], strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)
    assert law.double().gp.noise.dtype == torch.float64
    single = build(Nominal()).float()
    assert single(x.float(), u.float(), DT).mean.dtype == torch.float32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"target": "residual"}, "needs a nominal law"),
        ({"nominal": Nominal(), "target": "identity"}, "does not take a nominal law"),
        ({"target": "guess"}, "target must be"),
        ({"context": None}, "needs a context"),
        ({"noise": "none"}, "noise must be"),
        ({"pooling": "none"}, "pooling must be"),
    ],
)
def test_refusals(arguments, message):
    x, u, x_next = pairs(8)
    gp = GPRegression(x, x_next - x, phase(u)).freeze()
    with pytest.raises(ValueError, match=message):
        GPTransition(gp, **{"context": phase, **arguments})


def test_context_needs_a_control():
    with pytest.raises(ValueError, match="no u was given"):
        build(None)(torch.zeros(D).double(), None, DT)
