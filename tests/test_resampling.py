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
from torchfilt.particles import Particles
from torchfilt.resampling import (
    KldSize,
    Resampler,
    ess_below,
    gather_particles,
    kld_adaptive,
    kld_bound,
    multinomial,
    never,
    residual,
    stratified,
    systematic,
)
from torchfilt.spaces import UnitQuaternion

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


@schemes
@given(data=st.data())
def test_any_number_of_positions_is_that_of_the_definition(scheme, data):
    """More and fewer than there are particles, another number in each row; counts and shares without rounding."""
    n = 2 ** data.draw(st.integers(0, 4))
    counts = [2 ** data.draw(st.integers(0, 6)) for _ in range(2)]
    width = max(counts) + data.draw(st.integers(0, 2))
    rows = []
    for _ in counts:
        cuts = sorted(data.draw(st.lists(st.integers(0, 64 * n), min_size=n - 1, max_size=n - 1)))
        rows.append([b - a for a, b in zip([0, *cuts], [*cuts, 64 * n], strict=True)])
    size = scheme.uniforms(width)
    u = [[k / 64 for k in data.draw(st.lists(st.integers(0, 63), min_size=size, max_size=size))] for _ in counts]
    weights, uniforms = torch.tensor(rows, dtype=torch.float64) / (64 * n), torch.tensor(u, dtype=torch.float64)
    ours = scheme(weights, uniforms, torch.tensor(counts), width)
    assert ours.shape == (2, width) and (ours.diff() >= 0).all() and ours.min() >= 0 and ours.max() < n
    for k, m in enumerate(counts):
        assert ours[k, :m].tolist() == getattr(oracle, scheme.name)(rows[k], u[k], m)
        alone = scheme(weights[k], uniforms[k], torch.tensor(m), width)
        assert torch.equal(alone, ours[k])


@pytest.mark.parametrize("batch", [(), (3,)])
@schemes
@given(seed=seeds, n=st.integers(1, 60))
def test_as_many_positions_as_particles_change_no_bit(scheme, batch, seed, n):
    weights, u = weights_of(*batch, n, seed=seed), uniforms(scheme, *batch, n=n, seed=seed)
    assert torch.equal(scheme(weights, u, torch.full(batch, n), n), scheme(weights, u))


@schemes
@pytest.mark.parametrize("m", [7, 90])
def test_copies_of_another_number_are_unbiased(scheme, m):
    """20,000 draws of m positions from 30 weights: each mean count is m w within 5.5 standard errors."""
    n, repeats = 30, 20_000
    weights = weights_of(n, seed=3, spread=1.0)
    counts = torch.full((repeats,), m)
    ancestors = scheme(weights.expand(repeats, n), uniforms(scheme, repeats, n=m, seed=1), counts, m)
    found = torch.zeros(repeats, n).scatter_add(-1, ancestors, torch.ones(repeats, m)).double()
    fraction = (m * weights).frac()
    # A copy that no draw happened to make has a deviation all the same.
    standard = torch.maximum(found.std(0), (fraction * (1 - fraction)).sqrt()) / repeats**0.5
    assert ((found.mean(0) - m * weights).abs() < 5.5 * standard + 10 / repeats).all()


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


@schemes
def test_one_graph_gives_any_number_of_ancestors(scheme):
    weights, u = weights_of(3, 25, seed=0), uniforms(scheme, 3, n=40, seed=1)
    counts = torch.tensor([40, 7, 25])
    torch.compiler.reset()
    compiled = torch.compile(lambda *parts: scheme(*parts, 40), fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(weights, u, counts), scheme(weights, u, counts, 40))


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


# How many particles ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delta", [0.2, 0.05, 0.01, 0.001])
@pytest.mark.parametrize("epsilon", [0.02, 0.5])
def test_the_bound_is_a_quantile_of_chi_square(epsilon, delta):
    """Wilson and Hilferty's cube is 3 % off with one degree of freedom, 0.7 % with nine, 0.04 % with 99 at most."""
    bins = torch.tensor([2, 3, 4, 5, 10, 100, 5000])
    ours = kld_bound(bins, epsilon, delta)
    exact = stats.chi2.ppf(1 - delta, bins.numpy() - 1) / (2 * epsilon)
    away = (ours / torch.from_numpy(exact) - 1).abs()
    assert (away[:4] < 0.031).all() and away[4] < 0.007 and (away[5:] < 4e-4).all()
    assert kld_bound(torch.tensor(1), epsilon, delta) == 0


@pytest.mark.parametrize(("epsilon", "delta"), [(0.05, 0.05), (0.02, 0.2)])
def test_divergence_is_below_epsilon_as_often_as_promised(epsilon, delta):
    """A known distribution over 20 bins, 20,000 multinomial draws of the adaptive number.

    The bound takes the likelihood ratio for chi-square; with 15 draws a bin on average it is so to half a percent of
    probability, which is let off, and 4.5 standard errors: a false alarm in 300,000 tests.
    """
    repeats, n = 20_000, 20
    weights = torch.softmax(0.3 * torch.arange(n, dtype=torch.float64).sin(), -1)
    cloud = Particles(torch.arange(n, dtype=torch.float64).unsqueeze(-1), weights.log())
    policy = kld_adaptive(1.0, epsilon, delta, 2, multinomial)
    count = int(policy.size(cloud, weights, 5000))
    assert count == math.ceil(kld_bound(torch.tensor(n), epsilon, delta))
    draws = policy(
        weights.expand(repeats, n),
        uniforms(multinomial, repeats, n=count, seed=5),
        torch.full((repeats,), count),
        count,
    )
    share = torch.zeros(repeats, n).double().scatter_add(-1, draws, torch.ones(repeats, count).double()) / count
    divergence = torch.special.xlogy(share, share / weights).sum(-1)
    kept = (divergence <= epsilon).double().mean()
    error = (delta * (1 - delta) / repeats) ** 0.5
    assert abs(kept - (1 - delta)) < 4.5 * error + 0.005
    # Half as many would not do.
    half = draws[:, torch.randperm(count, generator=torch.Generator().manual_seed(0))[: count // 2]]
    share = torch.zeros(repeats, n).double().scatter_add(-1, half, torch.ones(half.shape).double()) / half.shape[-1]
    assert (torch.special.xlogy(share, share / weights).sum(-1) <= epsilon).double().mean() < 0.6


def counted(x, widths, heaviest):
    """Bins that points fall in, one by one."""
    return len({tuple(math.floor(v / w + 0.5) for v, w in zip(row - heaviest, widths, strict=True)) for row in x})


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("widths", [0.5, (0.5, 2.0, 1.0), (math.inf, 0.7, math.inf), (1e-9, 1e-9, 1e-9)], ids=str)
def test_occupied_bins_are_counted(widths, dtype):
    """Against a set of cells, with a grid around the heaviest particle; in the last case 2^90 cells are in the box."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 300, 3, generator=generator, dtype=torch.float64).to(dtype)
    weights = torch.full((2, 300), 1 / 300, dtype=dtype)
    weights[0, 17] *= 1.5
    cloud = Particles(x, weights.log())
    sized = kld_adaptive(torch.tensor(widths) if isinstance(widths, tuple) else widths).size
    found = sized.bins(cloud, weights, 1000)
    each = widths if isinstance(widths, tuple) else (widths,) * 3
    finite = [k for k in range(3) if each[k] < math.inf]
    for row, heaviest in ((0, 17), (1, 0)):
        points = x[row][:, finite]
        cells = [np.float64(each[k]) for k in finite]
        centred = (points - points[heaviest]).double().numpy()
        if dtype == torch.float64 or widths != (1e-9,) * 3:
            assert found[row] == counted(centred, cells, 0.0)
    assert torch.equal(sized.bins(cloud._replace(x=x[1], log_weights=weights[1].log()), weights[1], 1000), found[1])
    order = torch.randperm(300, generator=generator)
    mixed = sized.bins(Particles(x[0, order], weights[0, order].log()), weights[0, order], 1000)
    assert mixed == found[0]


def test_bins_of_next_to_no_weight_do_not_count():
    """A bin counts from a share of about 1 / maximum on."""
    x = torch.arange(4, dtype=torch.float64).unsqueeze(-1)
    weights = torch.tensor([0.6, 0.39, 0.0099, 0.0001], dtype=torch.float64)
    sized = kld_adaptive(1.0).size
    cloud = Particles(x, weights.log())
    assert [int(sized.bins(cloud, weights, m)) for m in (1, 10, 100, 10_000)] == [1, 2, 3, 4]


def test_bins_of_attitudes_are_those_of_rotation_vectors():
    space = UnitQuaternion()
    start = torch.tensor([[0.5, 0.5, 0.5, 0.5]], dtype=torch.float64)
    turns = 0.2 * torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.4, 0, 0]], dtype=torch.float64)
    x = space.retract(start, turns)
    weights = torch.tensor([0.3, 0.2, 0.2, 0.2, 0.1], dtype=torch.float64)
    cloud = Particles(x * torch.tensor([[1], [-1], [1], [-1], [-1]]), weights.log(), None, space)
    assert kld_adaptive(0.2).size.bins(cloud, weights, 100) == 4


def test_counts_lie_between_their_limits():
    x = torch.stack([torch.zeros(50), torch.linspace(0, 49, 50)]).double().unsqueeze(-1)
    weights = torch.full((2, 50), 0.02, dtype=torch.float64)
    sized = kld_adaptive(1.0, 0.5, 0.01, 30).size
    exact = math.ceil(kld_bound(torch.tensor(50), 0.5, 0.01))
    assert exact == 75
    assert sized(Particles(x, weights.log()), weights, 1000).tolist() == [30, 75]
    assert sized(Particles(x, weights.log()), weights, 60).tolist() == [30, 60]


def test_adaptive_resamplers_keep_scheme_and_policy():
    adaptive = ess_below(0.4, kld_adaptive([1.0, 2.0], 0.1, 0.2, 7, stratified))
    assert (adaptive.name, adaptive.threshold, adaptive.one_uniform) == ("stratified", 0.4, False)
    assert adaptive.size == KldSize((1.0, 2.0), 0.1, 0.2, 7)
    assert kld_adaptive(1.0, resampler=ess_below(0.4)).threshold == 0.4
    default = kld_adaptive(0.5)
    assert default.size == KldSize(0.5, 0.05, 0.01, 50) and default.name == "systematic"
    weights, u = weights_of(9, seed=0), uniforms(systematic, n=9, seed=1)
    assert torch.equal(default(weights, u), systematic(weights, u))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(bin_widths=0.0), r"bin_widths must be positive.*got \(0\.0,\)"),
        (dict(bin_widths=math.nan), r"bin_widths must be positive.*got \(nan,\)"),
        (dict(bin_widths=[1.0, -2.0]), r"bin_widths must be positive.*got \(1\.0, -2\.0\)"),
        (dict(bin_widths=[math.inf, math.inf]), "not all infinite"),
        (dict(bin_widths=[]), r"got \(\)"),
        (dict(bin_widths=torch.ones(2, 2)), "one or one a component"),
        (dict(bin_widths=1.0, epsilon=0.0), r"epsilon must be positive, got 0\.0"),
        (dict(bin_widths=1.0, delta=1.0), r"delta must be in \(0, 1\), got 1\.0"),
        (dict(bin_widths=1.0, minimum=1), "minimum must be at least 2, got 1"),
    ],
)
def test_adaptive_resamplers_refuse_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        kld_adaptive(**arguments)


def test_a_scheme_of_fixed_number_can_not_adapt():
    own = Resampler("own", lambda weights, u: systematic(weights, u), one_uniform=True)
    with pytest.raises(TypeError, match="the scheme 'own' must take counts and a width"):
        kld_adaptive(1.0, resampler=own)


# Gathering ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.int64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
@pytest.mark.parametrize("rest", [(), (4,), (4, 2)])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (9, 9), (9, 4), (3, 8)])
def test_gathered_rows_are_those_of_take_along_dim(dtype, batch, rest, n, m):
    generator = torch.Generator().manual_seed(0)
    values = (100 * torch.randn(*batch, n, *rest, generator=generator)).to(dtype)
    ancestors = torch.randint(n, (*batch, m), generator=generator)
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
