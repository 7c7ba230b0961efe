"""Invariants under random data: weights, order, rows, dtype, seeds, threads, streams."""

import subprocess
import sys

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from particle_problem import PLANE, POLICIES, series, state_space, tensor

import torchfilt as tf
from torchfilt.moves import MetropolisHastings
from torchfilt.resampling import ess_below

JOINT = dict(redraw="always", split=0.0, pooled=False, weights="joint")
FILTERS = {
    "bootstrap": lambda model, n=30: tf.BootstrapFilter(model, n, ess_below(0.5)),
    "moved": lambda model, n=30: tf.BootstrapFilter(model, n, move=MetropolisHastings(2)),
    "joint": lambda model, n=30: tf.UnscentedParticleFilter(model, n, **JOINT),
    "bank": lambda model, n=30: tf.LocallyLinearizedParticleFilter(model, n, redraw="resample"),
    "pooled": lambda model, n=30: tf.UnscentedParticleFilter(model, n),
}
DTYPES = st.sampled_from([torch.float64, torch.float32])
names = st.sampled_from(sorted(FILTERS))
# Up to 12 deviations from the prior's own measurements: enough to starve a cloud of 30 particles.
data = st.lists(st.floats(-12, 12), min_size=6, max_size=6)


@given(names, data, DTYPES, st.integers(0, 2**40))
def test_beliefs_are_sound(name, values, dtype, seed):
    """Weights sum to one, covariances are symmetric and positive semidefinite, dtype is kept, ESS in [1, n]."""
    ys = tensor(values, dtype).reshape(3, 2, 1)
    history = FILTERS[name](state_space(PLANE, dtype))(ys, seed=seed, record="beliefs")
    beliefs, eps = history.beliefs, torch.finfo(dtype).eps
    assert beliefs.x.dtype == history.mean.dtype == history.log_likelihood.dtype == history.covariance.dtype == dtype
    assert (beliefs.log_weights.exp().sum(-1) - 1).abs().max() < 200 * eps
    assert (history.diagnostics.ess > 1 - 1e-3).all() and (history.diagnostics.ess < 30 * (1 + 1e-3)).all()
    covariance = history.covariance
    assert torch.equal(covariance, covariance.mT)
    scale = covariance.diagonal(dim1=-2, dim2=-1).amax(-1)
    assert (torch.linalg.eigvalsh(covariance).amin(-1) > -100 * eps * scale).all()
    assert torch.isfinite(history.mean).all() and history.diagnostics.ok.all()


@given(names, data, st.integers(0, 2**40), st.randoms(use_true_random=False))
def test_order_of_the_particles_does_not_matter_to_the_moments(name, values, seed, random):
    history = FILTERS[name](state_space(PLANE))(tensor(values).reshape(6, 1), seed=seed)
    belief = history.final.belief
    order = list(range(belief.x.shape[-2]))
    random.shuffle(order)
    factor = belief.scale_tril
    if factor is not None and factor.shape[-3] > 1:
        factor = factor[order]
    shuffled = tf.Particles(belief.x[order], belief.log_weights[order], factor, belief.space)
    for one, other in zip(belief.moments(), shuffled.moments(), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * max(1, one.abs().max().item()))
    np.testing.assert_allclose(belief.ess, shuffled.ess, rtol=1e-10)


@given(names, data, data, st.integers(0, 2**40))
def test_rows_do_not_know_of_each_other(name, values, others, seed):
    """Row 1 with two different neighbours in row 0."""
    filter = FILTERS[name](state_space(PLANE))
    first = torch.stack([tensor(values), tensor(others)], 1).unsqueeze(-1)
    second = torch.stack([tensor(values[::-1]), tensor(others)], 1).unsqueeze(-1)
    one, other = filter(first, seed=seed), filter(second, seed=seed)
    np.testing.assert_allclose(one.mean[:, 1], other.mean[:, 1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.log_likelihood[1], other.log_likelihood[1], rtol=0, atol=1e-9)


@given(names, data, st.integers(0, 2**40), st.integers(1, 5))
def test_streams_and_resumed_runs_have_the_same_bits(name, values, seed, cut):
    filter = FILTERS[name](state_space(PLANE))
    ys = tensor(values).reshape(6, 1)
    whole = filter(ys, seed=seed)
    state, means = filter.init((), seed), []
    for y in ys:
        state, _ = filter.step(state, y)
        means.append(state.belief.mean)
    assert torch.equal(torch.stack(means), whole.mean)
    resumed = filter(ys[cut:], state=filter(ys[:cut], seed=seed).final)
    assert torch.equal(resumed.mean, whole.mean[cut:])
    assert torch.equal(resumed.final.belief.x, whole.final.belief.x)
    assert torch.equal(resumed.final.belief.log_weights, whole.final.belief.log_weights)


@pytest.mark.parametrize("policy", POLICIES)
def test_every_scheme_streams(policy):
    ys, _ = series(5)
    filter = tf.BootstrapFilter(state_space(PLANE), 50, POLICIES[policy])
    whole, again = filter(ys, seed=1), filter(ys, seed=1)
    assert torch.equal(whole.mean, again.mean) and not torch.equal(whole.mean, filter(ys, seed=2).mean)
    state = filter.init((), 1)
    for y in ys:
        state, _ = filter.step(state, y)
    assert torch.equal(state.belief.x, whole.final.belief.x)


def test_a_saved_history_resumes_with_the_same_bits(tmp_path):
    """Belief, step and seed travel in the file."""
    ys, _ = series(6)
    for name in ("bootstrap", "bank"):
        filter = FILTERS[name](state_space(PLANE))
        whole = filter(ys, seed=5)
        filter(ys[:3], seed=5).save(tmp_path / name)
        loaded = tf.History.load(tmp_path / name)
        resumed = filter(ys[3:], state=loaded.final)
        assert torch.equal(resumed.mean, whole.mean[3:])


def test_a_state_can_branch():
    """One state, two futures; neither changes the other."""
    filter = FILTERS["bootstrap"](state_space(PLANE))
    state, _ = filter.step(filter.init((), 1), tensor([0.3]))
    left, _ = filter.step(state, tensor([1.0]))
    right, _ = filter.step(state, tensor([-1.0]))
    again, _ = filter.step(state, tensor([1.0]))
    assert torch.equal(left.belief.x, again.belief.x) and left.belief.mean[0] > right.belief.mean[0]


def test_fast_normals_are_their_own_sequence_and_as_good():
    """float32 draws cast to float64: another sequence, the dtype kept, the same law (means within 5 deviations)."""
    ys, exact = series(5)
    history = tf.BootstrapFilter(state_space(PLANE), 4000, fast_normals=True)(ys, seed=1)
    assert history.mean.dtype == torch.float64
    assert not torch.equal(history.mean, tf.BootstrapFilter(state_space(PLANE), 4000)(ys, seed=1).mean)
    deviation = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2) / 4000)
    # Resampling adds variance: twice the deviation of independent draws.
    assert (np.abs(history.mean.numpy() - exact.mean) < 10 * deviation).all()


PROGRAM = """
import sys
import torch
torch.set_num_threads(int(sys.argv[1]))
sys.path[:0] = sys.argv[2:]
import hashlib
from test_particle_invariants import FILTERS
from particle_problem import PLANE, series, state_space
digest = hashlib.sha256()
for name in sorted(FILTERS):
    n = 3000 if name in ("joint", "bank") else 20000
    history = FILTERS[name](state_space(PLANE), n)(series(2)[0], seed=3)
    for part in (history.mean, history.covariance, history.log_likelihood, history.final.belief.x):
        digest.update(part.contiguous().numpy().tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_one_thread_and_two_give_the_same_bits():
    """Large clouds, so that sums are big enough to be shared out."""
    paths = [p for p in sys.path if p.endswith(("tests", "filters"))]
    runs = [
        subprocess.run([sys.executable, "-c", PROGRAM, threads, *paths], capture_output=True, text=True, check=True)
        for threads in ("1", "2")
    ]
    first, second = (run.stdout.strip() for run in runs)
    assert len(first) == 64 and first == second
