"""The step as a pure function: compiled, vectorised, differentiated; nothing global is touched."""

import random

import numpy as np
import pytest
import torch
from gaussian_problem import RULES, model, problem, tensor

import torchfilt as tf

EYE = torch.eye(2, dtype=torch.float64)


def bent():
    return tf.StateSpaceModel(
        tf.Gaussian(tensor([0.3, -0.2]), 0.5 * EYE),
        tf.AdditiveGaussian(lambda x, u, dt: x + dt * torch.sin(x) + u, 0.1 * EYE),
        tf.AdditiveGaussian(lambda x: x**2 + x, 0.2 * EYE),
    )


def inputs(rows=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    y, u = (torch.randn(rows, k, generator=generator, dtype=torch.float64) for k in (2, 1))
    return y, u


@pytest.mark.slow
# The compiler of torch 2.13 calls what torch 2.13 deprecates.
@pytest.mark.parametrize(
    ("rule", "form", "missing"),
    [
        ("taylor", "linear", "none"),
        ("taylor", "bent", "rows"),
        ("unscented", "bent", "none"),
        ("unscented", "linear", "rows"),
        ("unscented-negative-centre", "bent", "rows"),
    ],
)
def test_compiled_step_equals_the_eager_one(rule, form, missing):
    """One graph without breaks, over a chain of steps with other numbers in them: no second compilation."""
    torch.compiler.reset()
    p = problem(0, d=2, m=2)
    filter = tf.GaussianFilter(bent() if form == "bent" else model(p, "linear"), RULES[rule])
    graphs = []

    def count(graph, example):
        graphs.append(graph)
        return graph.forward

    counted = torch.compile(filter.advance, fullgraph=True, backend=count)
    compiled = torch.compile(filter.advance, fullgraph=True)
    start = filter.init((3,)).belief
    one = two = start._replace(scale_tril=start.scale_tril.expand(3, 2, 2).contiguous())
    for k in range(3):
        y, u = inputs(seed=k)
        if missing == "rows":
            y[0, 0] = y[1] = torch.nan
        dt = torch.full((3, 1), 0.3 + 0.1 * k, dtype=torch.float64)
        counted(one, y, u, dt, None, missing)
        one, found = compiled(one, y, u, dt, None, missing)
        two, expected = filter.advance(two, y, u, dt, None, missing)
        torch.testing.assert_close(one.mean, two.mean, rtol=0, atol=1e-10)
        torch.testing.assert_close(one.scale_tril, two.scale_tril, rtol=0, atol=1e-10)
        torch.testing.assert_close(found.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-10)
        assert torch.equal(found.ok, expected.ok)
    # The first factor is contiguous, later ones are a block of a larger matrix: two graphs, then no more.
    assert len(graphs) <= 2


@pytest.mark.parametrize("missing", ["none", "rows"])
@pytest.mark.parametrize("rule", RULES)
def test_vmap_over_the_step_is_the_batch(rule, missing):
    filter = tf.GaussianFilter(bent(), RULES[rule], 2)
    y, u = inputs()
    if missing == "rows":
        y[0, 1] = y[2] = torch.nan
    dt = tensor([[0.3], [0.5], [0.0]])
    start = filter.init((3,)).belief
    factors = start.scale_tril * tensor([1.0, 0.5, 2.0])[:, None, None]

    def advance(mean, factor, y, u, dt):
        belief, info = filter.advance(tf.Gaussian(mean, factor), y, u, dt, None, missing)
        return belief.mean, belief.scale_tril, info.log_likelihood, info.ok

    found = torch.func.vmap(advance)(start.mean, factors, y, u, dt)
    expected = advance(start.mean, factors, y, u, dt)
    for one, two in zip(found[:3], expected[:3], strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-12)
    assert torch.equal(found[3], expected[3])


@pytest.mark.parametrize("rule", ["taylor", "unscented", "unscented-negative-centre"])
def test_forward_and_reverse_derivatives_of_a_step_agree(rule):
    filter = tf.GaussianFilter(bent(), RULES[rule])
    y, u = inputs(1)
    factor = filter.init().belief.scale_tril

    def evidence(mean):
        return filter.advance(tf.Gaussian(mean, factor), y[0], u[0], 0.3, None, "none")[1].log_likelihood

    mean = tensor([0.3, -0.2])
    forward, reverse = (transform(evidence)(mean) for transform in (torch.func.jacfwd, torch.func.jacrev))
    torch.testing.assert_close(forward, reverse, rtol=0, atol=1e-12)
    step = 1e-6
    numeric = [(evidence(mean + step * e) - evidence(mean - step * e)) / (2 * step) for e in EYE]
    torch.testing.assert_close(forward, torch.stack(numeric), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_is_the_models_whatever_the_default(dtype):
    p = problem(1)
    other = torch.float64 if dtype == torch.float32 else torch.float32
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(other)
        for rule in RULES.values():
            for form in ("functions", "linear"):
                filter = tf.GaussianFilter(model(p, form, dtype), rule, 2)
                p.ys[1, 0, 0] = np.nan
                history = filter(tensor(p.ys, dtype), tensor(p.us, dtype), tensor(p.dts, dtype))
                found = (history.mean, history.covariance, *history.diagnostics[:1], *history.diagnostics[2:5])
                assert {part.dtype for part in found} == {dtype}
        assert torch.get_default_dtype() == other
    finally:
        torch.set_default_dtype(before)


def test_global_state_is_left_alone():
    p = problem(2)
    before = torch.random.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
    flags = torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()
    for rule in RULES.values():
        tf.GaussianFilter(model(p), rule)(tensor(p.ys), tensor(p.us), tensor(p.dts))
    assert torch.equal(torch.random.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])
    assert random.getstate() == before[2]
    assert flags == (torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled())


def test_inputs_are_left_alone():
    p = problem(3, hidden=0.3)
    given = [tensor(p.ys), tensor(p.us), tensor(p.dts)]
    kept = [value.clone() for value in given]
    laws = model(p)
    state = {name: value.clone() for name, value in laws.state_dict().items()}
    tf.UnscentedKalmanFilter(laws)(*given)
    for value, old in zip(given, kept, strict=True):
        assert torch.equal(value.nan_to_num(), old.nan_to_num())
    for name, value in laws.state_dict().items():
        assert torch.equal(value, state[name]), name


def test_thread_count_changes_no_bit():
    """Float64; batch large enough for torch to share work between threads."""
    p = problem(4, rows=400, steps=3)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(
                [tf.GaussianFilter(model(p), rule)(tensor(p.ys), tensor(p.us), 0.5) for rule in RULES.values()]
            )
    finally:
        torch.set_num_threads(threads)
    for one, two in zip(*results, strict=True):
        assert torch.equal(one.mean, two.mean)
        assert torch.equal(one.covariance, two.covariance)
        assert torch.equal(one.diagnostics.log_likelihood, two.diagnostics.log_likelihood)


def test_iterations_below_one_are_refused():
    with pytest.raises(ValueError, match="iterations must be at least 1, got 0"):
        tf.ExtendedKalmanFilter(bent(), iterations=0)
