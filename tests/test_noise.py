"""Noise: repeatable, alone with its seed, and random."""

import hashlib
import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from torchfilt.noise import STREAMS, NoiseSource

DTYPES = [torch.float64, torch.float32]
LIKE = torch.zeros((), dtype=torch.float64)


def test_the_same_key_gives_the_same_numbers_in_any_order():
    shape, keys = (3, 50, 2), list(itertools.product((0, 1, 7), (0, 1, 5)))
    source = NoiseSource(11)
    forth = {key: source.normal(shape, *key, LIKE) for key in keys}
    back = {key: NoiseSource(11).normal(shape, *key, LIKE) for key in reversed(keys)}
    for key in keys:
        assert torch.equal(forth[key], back[key])
    assert torch.equal(source.uniform((4,), 3, 2, LIKE), NoiseSource(11).uniform((4,), 3, 2, LIKE))


@pytest.mark.parametrize("dtype", DTYPES)
def test_shape_type_and_layout(dtype):
    normal = NoiseSource().normal((3, 50, 2), 1, 0, torch.zeros((), dtype=dtype))
    assert normal.shape == (3, 50, 2) and normal.dtype == dtype
    assert normal.movedim(-1, 0).is_contiguous()
    uniform = NoiseSource().uniform((3, 50), 1, 0, torch.zeros((), dtype=dtype))
    assert uniform.shape == (3, 50) and uniform.dtype == torch.float64


def test_the_global_generator_is_not_touched():
    before = torch.get_rng_state()
    NoiseSource(1).normal((100, 2), 0, 0, LIKE)
    NoiseSource(1, fast_normals=True).normal((100, 2), 0, 0, LIKE)
    NoiseSource(1).uniform((100,), 0, 0, LIKE)
    assert torch.equal(torch.get_rng_state(), before)
    # And it has no say: other global states, the same numbers.
    first = NoiseSource(1).normal((5, 2), 0, 0, LIKE)
    with torch.random.fork_rng():
        torch.manual_seed(123)
        assert torch.equal(NoiseSource(1).normal((5, 2), 0, 0, LIKE), first)


PROGRAM = """
import hashlib, sys, torch
from torchfilt.noise import NoiseSource
torch.set_num_threads(int(sys.argv[1]))
assert torch.get_num_threads() == int(sys.argv[1])
digest = hashlib.sha256()
for dtype in (torch.float64, torch.float32):
    for fast in (False, True):
        source, like = NoiseSource(5, fast), torch.zeros((), dtype=dtype)
        for shape in ((7,), (100_001, 3)):
            digest.update(source.normal(shape, 3, 1, like).contiguous().numpy().tobytes())
            digest.update(source.uniform(shape, 3, 1, like).numpy().tobytes())
print(digest.hexdigest())
"""


def test_the_number_of_threads_does_not_matter():
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(torch.cat([NoiseSource(5, fast).normal((100_001, 3), 3, 1, LIKE) for fast in (False, True)]))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


@pytest.mark.slow
def test_a_process_with_other_threads_draws_the_same():
    def run(threads):
        environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
        command = [sys.executable, "-c", PROGRAM, str(threads)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    one = run(1)
    assert len(one) == 2 * hashlib.sha256().digest_size
    assert run(2) == one


@given(seed=st.integers(-(2**70), 2**70), step=st.integers(0, 2**40), stream=st.integers(0, STREAMS - 1))
def test_seeds_are_in_the_range_of_torch(seed, step, stream):
    key = NoiseSource(seed).seed_of(step, stream)
    assert 0 <= key < 2**63
    assert key == NoiseSource(seed).seed_of(step, stream)


@pytest.mark.parametrize("seed", [0, 1, -1, 2**63])
def test_steps_and_streams_of_a_seed_never_share_numbers(seed):
    """torch's CPU generator reads 32 bits. Of 80,000 seeds taken at random two would agree in them with chance 0.53."""
    source = NoiseSource(seed)
    keys = {source.seed_of(step, stream) & 0xFFFFFFFF for step in range(5000) for stream in range(STREAMS)}
    assert len(keys) == 5000 * STREAMS


@pytest.mark.parametrize("stream", [-1, STREAMS])
def test_streams_are_numbered(stream):
    with pytest.raises(ValueError, match=rf"stream must be in \[0, 16\), got {stream}"):
        NoiseSource().normal((2,), 0, stream, LIKE)


def test_neighbouring_keys_are_uncorrelated():
    """276 pairs of sequences of 20,000 normals: |z| < 5.5 has a false alarm in 95,000 choices of keys."""
    keys = list(itertools.product((0, 1), (0, 1, 2, 3), (0, 1, 2)))
    count = 20_000
    draws = torch.stack([NoiseSource(seed).normal((count,), step, stream, LIKE) for seed, step, stream in keys])
    z = (np.corrcoef(draws) * np.sqrt(count))[np.triu_indices(len(keys), 1)]
    assert np.abs(z).max() < 5.5
    # The z-scores themselves are standard normal (Kolmogorov-Smirnov, a false alarm in a million).
    assert stats.kstest(z, "norm").pvalue > 1e-6


def test_components_of_a_draw_are_uncorrelated_along_each_dim():
    """The same test within one draw: 6 components, 4 rows, 5,000 particles, also between neighbours."""
    draw = NoiseSource(3).normal((4, 5000, 6), 2, 0, LIKE)
    flat = draw.movedim(1, -1).reshape(24, 5000)
    z = (np.corrcoef(flat) * np.sqrt(5000))[np.triu_indices(24, 1)]
    assert np.abs(z).max() < 5.5
    lag = (flat[:, 1:] * flat[:, :-1]).mean(-1) * np.sqrt(4999)
    assert lag.abs().max() < 5.5


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("fast", [False, True])
def test_normals_are_normal(dtype, fast):
    """Kolmogorov-Smirnov with 60,000 numbers, a false alarm in a million."""
    draws = NoiseSource(2, fast).normal((20_000, 3), 0, 0, torch.zeros((), dtype=dtype))
    assert stats.kstest(draws.double().flatten(), "norm").pvalue > 1e-6
    assert stats.kstest(draws.double().square().sum(-1), "chi2", args=(3,)).pvalue > 1e-6


def test_uniforms_are_uniform():
    draws = NoiseSource(2).uniform((60_000,), 0, 0, LIKE)
    assert draws.min() >= 0 and draws.max() < 1
    assert stats.kstest(draws, "uniform").pvalue > 1e-6
    assert (draws != draws.float().double()).any()  # finer than float32


def test_fast_normals_are_those_of_float32():
    fast = NoiseSource(4, fast_normals=True).normal((30, 2), 1, 1, LIKE)
    single = NoiseSource(4).normal((30, 2), 1, 1, LIKE.float())
    assert fast.dtype == torch.float64
    assert torch.equal(fast, single.double())
    assert not torch.equal(fast, NoiseSource(4).normal((30, 2), 1, 1, LIKE))


def test_large_draws_are_normal_across_blocks_and_pairs():
    """Made by pairs, block by block: each false alarm of the tests below is one in a million."""
    count = 200_001  # odd, and four blocks
    draws = NoiseSource(8).normal((count,), 0, 0, LIKE)
    assert stats.kstest(draws, "norm").pvalue > 1e-6
    assert len(torch.unique(draws)) == count
    half = (count + 1) // 2
    first, second = draws[: count - half], draws[half:]  # cosines and sines of the same angles
    for power in (1, 2, 4):
        z = np.corrcoef(first**power, second**power)[0, 1] * np.sqrt(count - half)
        assert abs(z) < 4.9
    # The angle of a pair is uniform and tells nothing of its length.
    angle, length = torch.atan2(second, first), torch.hypot(first, second)
    assert stats.kstest((angle / (2 * np.pi) + 0.5), "uniform").pvalue > 1e-6
    assert abs(stats.spearmanr(angle, length).statistic) * np.sqrt(count - half) < 4.9


def test_no_uniform_makes_an_infinite_normal(monkeypatch):
    """The generator may give zero, and the largest number below one."""
    for value in (0.0, 1 - 2**-53):
        monkeypatch.setattr(
            torch, "rand", lambda shape, value=value, **_: torch.full(shape, value, dtype=torch.float64)
        )
        draws = NoiseSource(0).normal((5000,), 0, 0, LIKE)
        assert torch.isfinite(draws).all() and draws.abs().max() < 8.6
