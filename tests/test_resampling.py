"""Resamplers: their definition in exact fractions, unbiased copies, bounds, extremes, rows and graphs."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import resampling_oracle as oracle
from scipy import stats

from torchfilt import resampling
from torchfilt.resampling import (
    Resampler,
    ess_below,
    gather_particles,
    multinomial,
    never,
    residual,
    stratified,
    systematic,
)

SCHEMES = [systematic, stratified, multinomial, residual]
schemes = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.name)
DTYPES = [torch.float64, torch.float32]
seeds = st.integers(0, 2**31)


def uniforms(scheme, *batch, n, seed):
    shape = (*batch, scheme.uniforms(n))
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def weights_of(*shape, seed, spread=2.0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.softmax(spread * torch.randn(shape, generator=generator, dtype=torch.float64), -1).to(dtype)


def counts_of(ancestors):
    n = ancestors.shape[-1]
    return torch.zeros(ancestors.shape, dtype=torch.int64).scatter_add(-1, ancestors, torch.ones_like(ancestors)), n


# The definition -------------------------------------------------------------------------------------------------------


@schemes
@given(data=st.data())
def test_ancestors_are_those_of_the_definition(scheme, data):
    """Weights are counts that sum to a power of two and uniforms are multiples of 1/64: no rounding, ties included."""
    n = 2 ** data.draw(st.integers(0, 5))
    total = 64 * n
    cuts = sorted(data.draw(st.lists(st.integers(0, total), min_size=n - 1, max_size=n - 1)))
    weights = [b - a for a, b in zip([0, *cuts], [*cuts, total], strict=True)]
    u = [
        k / 64
        for k in data.draw(st.lists(st.integers(0, 63), min_size=scheme.uniforms(n), max_size=scheme.uniforms(n)))
    ]
    ours = scheme(torch.tensor(weights, dtype=torch.float64) / total, torch.tensor(u, dtype=torch.float64))
    expected = getattr(oracle, scheme.name)(weights, u)
    assert ours.tolist() == expected


@pytest.mark.parametrize("dtype", DTYPES)
@schemes
@given(seed=seeds, n=st.integers(1, 200), spread=st.floats(0, 20))
def test_ancestors_of_any_weights(scheme, dtype, seed, n, spread):
    """Against the definition in exact fractions: not one position lies within rounding of an end in these examples."""
    weights, u = weights_of(n, seed=seed, spread=spread, dtype=dtype), uniforms(scheme, n=n, seed=seed)
    ours = scheme(weights, u)
    assert ours.dtype == torch.int64
    assert (ours.diff() >= 0).all()
    assert ours.min() >= 0 and ours.max() < n
    if scheme is not residual:  # its rounding is let off on purpose, see below
        assert ours.tolist() == getattr(oracle, scheme.name)(weights.tolist(), u.tolist())


# Copies ---------------------------------------------------------------------------------------------------------------


@schemes
@pytest.mark.parametrize("n", [1, 7, 30])
def test_copies_are_unbiased(scheme, n):
    """20,000 draws as one batch: each mean count is n w within 5.5 standard errors.

    One false alarm in 170,000 seeds for the 152 counts of all schemes.
    """
    repeats = 20_000
    weights = weights_of(n, seed=3, spread=1.0)
    weights[n // 2] = 0 if n > 1 else 1
    weights = weights / weights.sum()
    ancestors = scheme(weights.expand(repeats, n), uniforms(scheme, repeats, n=n, seed=1))
    counts = counts_of(ancestors)[0].double()
    error = counts.mean(0) - n * weights
    standard = counts.std(0) / math.sqrt(repeats)
    certain = standard == 0  # a count that never varies must be exact
    assert (error[certain].abs() < 1e-12).all()
    assert (error[~certain].abs() < 5.5 * standard[~certain]).all()
    assert (counts[:, weights == 0] == 0).all()


def test_multinomial_copies_are_multinomial():
    """Frequencies of 600,000 independent draws, and variances n w (1 - w): a false alarm in 460,000 seeds."""
    n, repeats = 30, 20_000
    weights = weights_of(n, seed=3, spread=1.0)
    counts = counts_of(multinomial(weights.expand(repeats, n), uniforms(multinomial, repeats, n=n, seed=1)))[0].double()
    assert stats.chisquare(counts.sum(0), (repeats * n * weights).numpy()).pvalue > 1e-6
    variance = n * weights * (1 - weights)
    fourth = (counts - n * weights).pow(4).mean(0)
    z = (counts.var(0) - variance) / ((fourth - variance.square()) / repeats).sqrt()
    assert z.abs().max() < 5.5


@schemes
def test_no_scheme_varies_more_than_multinomial(scheme):
    """Sum of the variances of the counts: the reason for the other three."""
    n, repeats = 30, 20_000
    weights = weights_of(n, seed=3, spread=1.0)
    counts = counts_of(scheme(weights.expand(repeats, n), uniforms(scheme, repeats, n=n, seed=1)))[0].double()
    bound = (n * weights * (1 - weights)).sum()
    if scheme is multinomial:
        assert counts.var(0).sum() == pytest.approx(bound.item(), rel=0.02)
    else:
        assert counts.var(0).sum() < 0.8 * bound


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=seeds, n=st.integers(1, 300), spread=st.floats(0, 10))
def test_bounds_of_the_copies(dtype, seed, n, spread):
    """From n w: less than 1 for systematic, less than 2 for stratified; residual keeps the whole copies."""
    weights = weights_of(4, n, seed=seed, spread=spread, dtype=dtype)
    exact = weights.double()
    share = n * exact / exact.sum(-1, keepdim=True)
    rounding = 1e-12 * n
    for scheme, low, high in ((systematic, 1, 1), (stratified, 2, 2), (residual, 1, math.inf)):
        counts, _ = counts_of(scheme(weights, uniforms(scheme, 4, n=n, seed=seed)))
        assert (counts.sum(-1) == n).all()
        assert (counts > share - low - rounding).all()
        assert (counts < share + high + rounding).all()
        if scheme is residual:
            assert (counts >= (share - rounding).floor()).all()
        if scheme is systematic:
            assert (counts >= (share - rounding).floor()).all()
            assert (counts <= (share + rounding).ceil()).all()


# Extremes -------------------------------------------------------------------------------------------------------------


@schemes
@pytest.mark.parametrize("n", [1, 2, 5, 100])
def test_one_particle_takes_all(scheme, n):
    for place in {0, n // 2, n - 1}:
        weights = torch.zeros(3, n)
        weights[:, place] = 1
        assert (scheme(weights, uniforms(scheme, 3, n=n, seed=place)) == place).all()


@schemes
@given(seed=seeds, n=st.integers(2, 50))
def test_particles_without_weight_have_no_copies(scheme, seed, n):
    weights = weights_of(5, n, seed=seed)
    dead = torch.rand(5, n, generator=torch.Generator().manual_seed(seed)) < 0.6
    dead[:, seed % n] = False
    weights = weights.masked_fill(dead, 0)
    counts, _ = counts_of(scheme(weights, uniforms(scheme, 5, n=n, seed=seed)))
    assert (counts[dead] == 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scheme", [systematic, stratified, residual], ids=lambda s: s.name)
@given(n=st.integers(1, 2000), seed=seeds)
def test_equal_weights_change_nothing(scheme, dtype, n, seed):
    """To the last particle, though n (1 / n) is below one for some n; nor does the scale of the weights matter."""
    u = uniforms(scheme, n=n, seed=seed)
    for value in (1 / n, 1.0, 1e-30):
        assert torch.equal(scheme(torch.full((n,), value, dtype=dtype), u), torch.arange(n))


@schemes
def test_weights_that_mean_nothing_give_indices_in_range(scheme):
    """NaN and zeros are for the caller to notice; the rows beside them are not touched."""
    weights = weights_of(4, 6, seed=0)
    weights[1] = torch.nan
    weights[2] = 0
    u = uniforms(scheme, 4, n=6, seed=1)
    ancestors = scheme(weights, u)
    assert ancestors.min() >= 0 and ancestors.max() < 6
    for row in (0, 3):
        assert torch.equal(ancestors[row], scheme(weights[row], u[row]))


# Rows, layouts, threads, graphs ---------------------------------------------------------------------------------------


@schemes
@given(seed=seeds, n=st.integers(1, 40))
def test_rows_of_a_batch_are_resampled_alone(scheme, seed, n):
    weights, u = weights_of(2, 3, n, seed=seed), uniforms(scheme, 2, 3, n=n, seed=seed)
    together = scheme(weights, u)
    assert together.shape == (2, 3, n)
    for row in np.ndindex(2, 3):
        assert torch.equal(together[row], scheme(weights[row], u[row]))


@schemes
def test_the_layout_in_memory_has_no_effect(scheme):
    weights, u = weights_of(4, 30, seed=0), uniforms(scheme, 4, n=30, seed=1)
    across = [tensor.mT.contiguous().mT for tensor in (weights, u)]
    assert torch.equal(scheme(*across), scheme(weights, u))


@schemes
def test_ancestors_do_not_depend_on_the_threads(scheme):
    n = 50_001
    weights, u = weights_of(n, seed=0), uniforms(scheme, n=n, seed=1)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(scheme(weights, u))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


@schemes
@pytest.mark.parametrize("shape", [(1,), (25,), (3, 25), (2, 3, 25)])
def test_one_graph_gives_the_same_ancestors(scheme, shape):
    """Compiled code counts by `scatter_add`, eager code by `bincount`."""
    weights, u = weights_of(*shape, seed=0), uniforms(scheme, *shape[:-1], n=shape[-1], seed=1)
    values = weights.unsqueeze(-1) * torch.arange(3.0)

    def value(weights, u, values):
        ancestors = scheme(weights, u)
        return ancestors, gather_particles(values, ancestors)

    torch.compiler.reset()
    compiled = torch.compile(value, fullgraph=True, backend="aot_eager")
    for ours, eager in zip(compiled(weights, u, values), value(weights, u, values), strict=True):
        assert torch.equal(ours, eager)


@pytest.mark.slow
@schemes
def test_generated_code_gives_the_same_ancestors(scheme):
    weights, u = weights_of(3, 25, seed=0), uniforms(scheme, 3, n=25, seed=1)
    torch.compiler.reset()
    assert torch.equal(torch.compile(scheme.ancestors, fullgraph=True)(weights, u), scheme(weights, u))


# Policies -------------------------------------------------------------------------------------------------------------


def test_how_many_uniforms_a_scheme_needs():
    assert [scheme.uniforms(7) for scheme in SCHEMES] == [1, 7, 7, 7]


def test_thresholds():
    assert all(scheme.threshold == math.inf for scheme in SCHEMES)
    half = ess_below(0.5, stratified)
    assert isinstance(half, Resampler)
    assert (half.threshold, half.name, half.ancestors) == (0.5, "stratified", stratified.ancestors)
    assert stratified.threshold == math.inf
    assert ess_below(1).name == "systematic"
    assert never().threshold == 0
    weights, u = weights_of(9, seed=0), uniforms(half, n=9, seed=1)
    assert torch.equal(half(weights, u), stratified(weights, u))


@pytest.mark.parametrize("fraction", [-0.1, 1.5, math.nan])
def test_a_fraction_is_a_fraction(fraction):
    with pytest.raises(ValueError, match=rf"fraction must be in \[0, 1\], got {fraction}"):
        ess_below(fraction)


# Gathering ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.int64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
@pytest.mark.parametrize("rest", [(), (4,), (4, 2)])
@pytest.mark.parametrize("n", [1, 9])
def test_gathered_rows_are_those_of_take_along_dim(dtype, batch, rest, n):
    generator = torch.Generator().manual_seed(0)
    values = (100 * torch.randn(*batch, n, *rest, generator=generator)).to(dtype)
    ancestors = torch.randint(n, (*batch, n), generator=generator)
    index = ancestors.view(*ancestors.shape, *(1 for _ in rest))
    expected = torch.take_along_dim(values, index, len(batch))
    assert torch.equal(gather_particles(values, ancestors), expected)
    if rest:  # component by component in memory, as particles are kept
        component_first = values.movedim(-1, 0).contiguous().movedim(0, -1)
        gathered = gather_particles(component_first, ancestors)
        assert torch.equal(gathered, expected)
        assert gathered.movedim(-1, 0).is_contiguous() or len(rest) > 1


def test_gradients_flow_to_the_ancestors():
    values = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    ancestors = torch.tensor([[0, 0, 2, 2, 2], [1, 1, 1, 4, 4]])
    gather_particles(values, ancestors).sum().backward()
    counts, _ = counts_of(ancestors)
    assert torch.equal(values.grad, counts.double().unsqueeze(-1).expand(2, 5, 3))


def test_the_schemes_of_the_module_are_all_tested():
    found = {value.name for value in vars(resampling).values() if isinstance(value, Resampler)}
    assert found == {scheme.name for scheme in SCHEMES}
