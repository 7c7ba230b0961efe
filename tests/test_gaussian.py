"""The Gaussian value: densities and marginals of SciPy, draws by their moments, geometry of its space."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import gaussian_oracle as oracle
from scipy import stats

from torchfilt.gaussian import Gaussian, cat_columns, mask_rows
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion

DTYPES = [torch.float64, torch.float32]
POSE = Product(Euclidean(2), UnitQuaternion(), Angle())
seeds = st.integers(0, 2**31)


def normals(*shape, seed, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def factors(*shape, seed, dtype=torch.float64):
    lower = 0.4 * normals(*shape, shape[-1], seed=seed).tril(-1)
    return (lower + torch.diag_embed(0.5 + normals(*shape, seed=seed + 1).abs())).to(dtype)


# (diagonal?, leading dims of the factor) for laws with mean (4, 5, 3)
FORMS = [(False, ()), (False, (1, 1)), (False, (4, 1)), (False, (1, 5)), (False, (4, 5)), (False, (5,))]
FORMS += [(True, ()), (True, (4, 1)), (True, (4, 5))]
forms = pytest.mark.parametrize(("diagonal", "lead"), FORMS)


def law_of(diagonal, lead, seed=0, dtype=torch.float64):
    factor = factors(*lead, 3, seed=seed, dtype=dtype)
    scale = factor.diagonal(dim1=-2, dim2=-1) if diagonal else factor
    return Gaussian(normals(4, 5, 3, seed=seed + 7, dtype=dtype), scale, is_diagonal=diagonal)


def marginal(law, x, observed):
    """SciPy's log-density of the observed components, row by row; zero where nothing is observed."""
    covariance = law.covariance.double().numpy()
    result = np.zeros(x.shape[:-1])
    for row in np.ndindex(*x.shape[:-1]):
        keep = observed[row]
        if keep.any():
            mean, part = law.mean.double().numpy()[row][keep], covariance[row][np.ix_(keep, keep)]
            result[row] = stats.multivariate_normal.logpdf(x[row][keep], mean, part)
    return result


def patterns(*shape):
    """All ways to miss some of the components, one after the other over the rows."""
    ways = itertools.cycle(itertools.product([True, False], repeat=shape[-1]))
    return np.array([next(ways) for _ in range(math.prod(shape[:-1]))]).reshape(shape)


# Densities ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@forms
def test_log_density_is_scipys(dtype, diagonal, lead):
    law = law_of(diagonal, lead, dtype=dtype)
    x = normals(4, 5, 3, seed=3, dtype=dtype)
    expected = marginal(law, x.double().numpy(), np.ones(x.shape, bool))
    ours = law.log_prob(x)
    assert ours.dtype == dtype
    condition = np.linalg.cond(law.factor().double().numpy()).max()
    np.testing.assert_allclose(ours, expected, rtol=64 * torch.finfo(dtype).eps * condition)


@pytest.mark.parametrize("dtype", DTYPES)
@forms
def test_missing_components_are_integrated_out(dtype, diagonal, lead):
    """All eight patterns among the rows, each with its own marginal law; NaN stands where nothing was measured."""
    law = law_of(diagonal, lead, dtype=dtype)
    x, observed = normals(4, 5, 3, seed=3, dtype=dtype), patterns(4, 5, 3)
    expected = marginal(law, x.double().numpy(), observed)
    silent = x.masked_fill(~torch.from_numpy(observed), torch.nan)
    ours = law.log_prob(silent, law.space.observed(silent))
    condition = np.linalg.cond(law.factor().double().numpy()).max()
    np.testing.assert_allclose(ours, expected, rtol=64 * torch.finfo(dtype).eps * condition, atol=0)
    # What is marked as not observed has no say, whatever its value.
    assert torch.equal(law.log_prob(x, torch.from_numpy(observed)), ours)


@forms
def test_one_pattern_for_all_rows(diagonal, lead):
    law, x = law_of(diagonal, lead), normals(4, 5, 3, seed=3)
    observed = torch.tensor([True, False, True])
    expected = marginal(law, x.numpy(), np.broadcast_to(observed.numpy(), x.shape))
    np.testing.assert_allclose(law.log_prob(x, observed), expected, rtol=1e-12)
    np.testing.assert_allclose(law.log_prob(x, torch.ones(3, dtype=torch.bool)), law.log_prob(x), rtol=1e-12)
    assert torch.equal(law.log_prob(x, torch.zeros(3, dtype=torch.bool)), torch.zeros(4, 5, dtype=torch.float64))


@given(seed=seeds, size=st.integers(1, 6))
def test_marginals_of_strong_correlations(seed, size):
    """Two components nearly equal: dropping one must not leave its share in the other."""
    root = normals(size, size, seed=seed)
    root[-1] = root[0] * (1 + 1e-4)
    factor = torch.linalg.cholesky(root @ root.mT + 1e-6 * torch.eye(size))
    x, observed = normals(2**size, size, seed=seed + 1), patterns(2**size, size)
    law = Gaussian(torch.zeros(2**size, size, dtype=torch.float64), factor)
    expected = [oracle.log_density(e, factor.numpy(), keep) for e, keep in zip(x.numpy(), observed, strict=True)]
    ours = law.log_prob(x, torch.from_numpy(observed)).numpy()
    error = np.abs(ours - expected) / (1 + np.abs(expected))
    assert error.max() <= 64 * np.finfo(float).eps * np.linalg.cond(factor.numpy())


def test_a_missing_number_that_is_called_observed_is_nan_in_its_row():
    law = law_of(False, ())
    x = normals(4, 5, 3, seed=3)
    x[2, 1, 0] = torch.nan
    for value in (law.log_prob(x), law.log_prob(x, torch.ones(3, dtype=torch.bool))):
        assert value.isnan().nonzero().tolist() == [[2, 1]]


@forms
def test_gradients_of_a_marginal_are_finite_and_right(diagonal, lead):
    """Central differences with NaN among the measurements; parameters of what is missing get no gradient."""
    law, x = law_of(diagonal, lead), normals(4, 5, 3, seed=3)
    x = x.masked_fill(~torch.from_numpy(patterns(4, 5, 3)), torch.nan)
    mean, scale = law.mean.clone().requires_grad_(), law.scale_tril.clone().requires_grad_()

    def value(mean, scale):
        same = Gaussian(mean, scale if diagonal else scale.tril(), is_diagonal=diagonal)
        return same.log_prob(x, law.space.observed(x))

    assert torch.autograd.gradcheck(lambda m, s: value(m, s)[:2], (mean, scale))
    value(mean, scale).sum().backward()
    assert torch.isfinite(scale.grad).all()
    assert (mean.grad[x.isnan()] == 0).all()


def test_angles_count_modulo_a_turn():
    law = Gaussian(torch.tensor([3.0, -3.0], dtype=torch.float64), factors(2, seed=1), Angle(2))
    x = torch.tensor([-3.1, 3.1], dtype=torch.float64)
    expected = stats.multivariate_normal.logpdf(
        [2 * math.pi - 6.1, 6.1 - 2 * math.pi], np.zeros(2), law.covariance.numpy()
    )
    np.testing.assert_allclose(law.log_prob(x), expected, rtol=1e-13)
    torch.testing.assert_close(law.log_prob(x + 4 * math.pi), law.log_prob(x), rtol=1e-13, atol=0)


@given(seed=seeds)
def test_density_of_a_draw_is_that_of_its_noise(seed):
    """On any space, where draws stay within half a turn: the log-density is that of the noise less the log-volume."""
    start = torch.cat(
        [normals(4, 2, seed=seed), UnitQuaternion().project(normals(4, 4, seed=seed)), normals(4, 1, seed=seed)], -1
    )
    law = Gaussian(start, 0.2 * factors(4, 6, seed=seed), POSE)
    noise = normals(4, 6, seed=seed + 1)
    noise = noise / noise.norm(dim=-1, keepdim=True)
    draw = law.sample(noise)
    assert draw.shape == (4, 7)
    _, log_determinant = np.linalg.slogdet(law.covariance.numpy())
    expected = stats.norm.logpdf(noise.numpy()).sum(-1) - log_determinant / 2
    np.testing.assert_allclose(law.log_prob(draw), expected, rtol=1e-11, atol=1e-11)
    flipped = draw * torch.tensor([1, 1, -1, -1, -1, -1, 1])
    np.testing.assert_allclose(law.log_prob(flipped), expected, rtol=1e-11, atol=1e-11)


def test_a_rotation_is_measured_as_a_whole_or_not_at_all():
    mean = torch.tensor([[1.0, 2, 0, 0, 0, 1, 0.5]], dtype=torch.float64).requires_grad_()
    law = Gaussian(mean, factors(6, seed=1), POSE)
    y = torch.tensor([[1.5, torch.nan, 0.1, torch.nan, 0, 1, 0.7]], dtype=torch.float64)
    observed = law.space.observed(y)
    assert observed.tolist() == [[True, False, False, False, False, True]]
    keep = [0, 5]
    part = law.covariance.detach().numpy()[0][np.ix_(keep, keep)]
    value = law.log_prob(y, observed)
    np.testing.assert_allclose(
        value.detach(), stats.multivariate_normal.logpdf([0.5, 0.2], np.zeros(2), part), rtol=1e-12
    )
    value.sum().backward()
    assert torch.isfinite(mean.grad).all()
    assert (mean.grad[0, [1, 2, 3, 4, 5]] == 0).all()


# Draws and moments ----------------------------------------------------------------------------------------------------


@forms
def test_moments_of_the_law(diagonal, lead):
    law = law_of(diagonal, lead)
    factor = np.broadcast_to(law.factor().numpy(), (4, 5, 3, 3))
    np.testing.assert_allclose(law.covariance, factor @ factor.mT, rtol=0, atol=1e-14)
    assert law.covariance.shape == (4, 5, 3, 3)
    variance = np.broadcast_to(law.variance.numpy(), (4, 5, 3))
    np.testing.assert_allclose(variance, np.diagonal(law.covariance, axis1=-2, axis2=-1), rtol=1e-14)
    assert law.tangent_size == 3


@forms
def test_draws_have_the_moments_of_the_law(diagonal, lead):
    """40,000 draws a row; z-scores of 20 rows x 9 numbers below 5.5: a false alarm in 150,000 seeds for each form."""
    law, count = law_of(diagonal, lead), 40_000
    draws = law.sample(normals(count, 4, 5, 3, seed=11))
    assert draws.shape == (count, 4, 5, 3)
    covariance, variance = law.covariance, law.covariance.diagonal(dim1=-2, dim2=-1)
    z = (draws.mean(0) - law.mean) / (variance / count).sqrt()
    assert z.abs().max() < 5.5
    error = draws - law.mean
    sample = torch.einsum("n...i,n...j->...ij", error, error) / count
    spread = ((variance.unsqueeze(-1) * variance.unsqueeze(-2) + covariance.square()) / count).sqrt()
    assert ((sample - covariance) / spread).abs().max() < 5.5


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("space", [Euclidean(3), Angle(3)])
@pytest.mark.parametrize(
    ("mean_lead", "noise_lead"), [((), (7,)), ((7,), (7,)), ((1,), (7,)), ((4, 7), (4, 7)), ((7,), (4, 7))]
)
def test_a_draw_is_the_mean_moved_by_the_factor(dtype, space, mean_lead, noise_lead):
    """Each shape may take a way of its own to the same numbers."""
    mean, noise = 0.3 * normals(*mean_lead, 3, seed=0, dtype=dtype), 0.3 * normals(*noise_lead, 3, seed=1, dtype=dtype)
    factor = factors(3, seed=2, dtype=dtype)
    draw = Gaussian(mean, factor, space).sample(noise)
    expected = mean.double().numpy() + np.einsum("ij,...j->...i", factor.double().numpy(), noise.double().numpy())
    assert draw.dtype == dtype
    np.testing.assert_allclose(draw, expected, rtol=0, atol=16 * torch.finfo(dtype).eps)


def test_draws_without_spread_are_the_mean():
    law = Gaussian(normals(4, 3, seed=0), torch.zeros(3, dtype=torch.float64), is_diagonal=True)
    assert torch.equal(law.sample(normals(4, 3, seed=1)), law.mean)
    law = Gaussian(normals(4, 3, seed=0), torch.zeros(3, 3, dtype=torch.float64))
    assert torch.equal(law.sample(normals(4, 3, seed=1)), law.mean)


@forms
def test_the_same_law_in_torch_distributions(diagonal, lead):
    law, x = law_of(diagonal, lead), normals(4, 5, 3, seed=3)
    same = law.to_distribution()
    assert isinstance(same, torch.distributions.MultivariateNormal)
    assert same.batch_shape == (4, 5)
    torch.testing.assert_close(same.log_prob(x), law.log_prob(x), rtol=1e-12, atol=0)
    torch.testing.assert_close(same.covariance_matrix, law.covariance)


def test_other_spaces_have_no_torch_distribution():
    with pytest.raises(TypeError, match=r"only a Euclidean Gaussian .* lives on Angle\(size=2\)"):
        Gaussian(torch.zeros(2), torch.eye(2), Angle(2)).to_distribution()
    assert Gaussian(torch.zeros(2), torch.eye(2), Euclidean(2)).to_distribution().event_shape == (2,)


# Transforms and parts -------------------------------------------------------------------------------------------------


@forms
def test_gradients_of_density_and_draw(diagonal, lead):
    law = law_of(diagonal, lead)
    mean, scale = law.mean.clone().requires_grad_(), law.scale_tril.clone().requires_grad_()
    x, noise = normals(4, 5, 3, seed=3).requires_grad_(), normals(4, 5, 3, seed=4).requires_grad_()

    def value(mean, scale, x, noise):
        same = Gaussian(mean, scale if diagonal else scale.tril(), is_diagonal=diagonal)
        return same.log_prob(x)[:1, :2], same.sample(noise)[:1, :2]

    assert torch.autograd.gradcheck(value, (mean, scale, x, noise))


@pytest.mark.parametrize("missing", [False, True])
def test_one_row_at_a_time_by_vmap(missing):
    law, x = law_of(False, (4, 5)), normals(4, 5, 3, seed=3)
    observed = torch.from_numpy(patterns(4, 5, 3)) if missing else torch.ones(4, 5, 3, dtype=torch.bool)

    def one(mean, scale, x, observed):
        return Gaussian(mean, scale).log_prob(x, observed if missing else None)

    rows = torch.vmap(torch.vmap(one))(law.mean, law.scale_tril, x, observed)
    torch.testing.assert_close(rows, law.log_prob(x, observed if missing else None), rtol=1e-13, atol=0)
    alone = one(law.mean[2, 3], law.scale_tril[2, 3], x[2, 3], observed[2, 3])
    torch.testing.assert_close(alone, rows[2, 3], rtol=1e-13, atol=0)


def test_density_and_draw_in_one_graph():
    law, x, observed = law_of(False, ()), normals(4, 5, 3, seed=3), torch.from_numpy(patterns(4, 5, 3))

    def value(mean, scale, x):
        same = Gaussian(mean, scale)
        return same.log_prob(x), same.log_prob(x, observed), same.sample(x)

    torch.compiler.reset()
    compiled = torch.compile(value, fullgraph=True, backend="aot_eager")
    for ours, eager in zip(compiled(law.mean, law.scale_tril, x), value(law.mean, law.scale_tril, x), strict=True):
        torch.testing.assert_close(ours, eager, rtol=1e-14, atol=1e-15)


def test_masked_rows_are_independent_unit_noise():
    columns, observed = normals(3, 4, seed=0), torch.tensor([[True, True, True], [True, False, True]])
    masked = mask_rows(columns, observed)
    assert masked.shape == (2, 3, 7)
    product = (masked @ masked.mT).numpy()
    expected = (columns @ columns.mT).numpy()
    np.testing.assert_allclose(product[0], expected, rtol=0, atol=1e-15)
    keep = np.ix_([0, 2], [0, 2])
    np.testing.assert_allclose(product[1][keep], expected[keep], rtol=0, atol=1e-15)
    assert product[1][1].tolist() == [0, 1, 0]


def test_blocks_side_by_side_share_what_is_shared():
    assert cat_columns(torch.ones(3, 2), torch.zeros(3, 1)).shape == (3, 3)
    joined = cat_columns(torch.ones(3, 2), 2 * torch.ones(5, 1, 3, 1), torch.zeros(4, 3, 0))
    assert joined.shape == (5, 4, 3, 3)
    assert torch.equal(joined[4, 3], torch.tensor([[1.0, 1, 2]] * 3))
