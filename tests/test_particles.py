"""Clouds of particles: moments of numpy, effective sample size, order and threads without effect."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import rotations_oracle as rotations

from torchfilt import particles as module
from torchfilt.particles import Particles, second_moment, uniform_log_weights
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion

DTYPES = [torch.float64, torch.float32]
seeds = st.integers(0, 2**31)


def normals(*shape, seed, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def cloud(*shape, seed, dtype=torch.float64, own=None):
    """Particles (*batch, n, d) with a few weights that are zero; ``own`` leading dims of their factors."""
    log_weights = 2 * normals(*shape[:-1], seed=seed + 1)
    log_weights[..., 1:-1:5] = -torch.inf
    log_weights = torch.log_softmax(log_weights, -1).to(dtype)
    scale = None if own is None else 0.3 * normals(*own, shape[-1], shape[-1], seed=seed + 2, dtype=dtype).tril()
    return Particles(normals(*shape, seed=seed, dtype=dtype), log_weights, scale)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("batch", "own"),
    [
        ((), None),
        ((), (9,)),
        ((), (1,)),
        ((4,), None),
        ((4,), (4, 9)),
        ((4,), (4, 1)),
        ((2, 4), (2, 4, 9)),
        ((2, 4), (2, 4, 1)),
    ],
)
def test_moments_are_numpys(dtype, batch, own):
    belief = cloud(*batch, 9, 3, seed=0, dtype=dtype, own=own)
    x, weights = belief.x.double().numpy(), np.exp(belief.log_weights.double().numpy())
    mean = np.einsum("...n,...nd->...d", weights, x)
    error = x - mean[..., None, :]
    covariance = np.einsum("...n,...ni,...nj->...ij", weights, error, error)
    if own is not None:
        scale = np.broadcast_to(belief.scale_tril.double().numpy(), (*batch, 9, 3, 3))
        covariance = covariance + np.einsum("...n,...nik,...njk->...ij", weights, scale, scale)
    tolerance = 32 * torch.finfo(dtype).eps
    for ours, expected in zip((belief.mean, belief.covariance), (mean, covariance), strict=True):
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours, expected, rtol=0, atol=tolerance * (1 + np.abs(expected).max()))
    both = belief.moments()
    assert torch.equal(both[0], belief.mean) and torch.equal(both[1], belief.covariance)
    np.testing.assert_allclose(belief.weights, weights, rtol=tolerance)


@given(seed=seeds, count=st.integers(1, 40), size=st.integers(1, 6))
def test_covariances_are_symmetric_and_semidefinite(seed, count, size):
    covariance = cloud(count, size, seed=seed).covariance
    assert torch.equal(covariance, covariance.mT)
    lowest = np.linalg.eigvalsh(covariance.numpy()).min()
    assert lowest >= -16 * np.finfo(float).eps * max(covariance.abs().max().item(), 1e-300)


@given(seed=seeds)
def test_the_order_of_particles_has_no_effect(seed):
    belief = cloud(2, 11, 3, seed=seed, own=(2, 11))
    order = torch.randperm(11, generator=torch.Generator().manual_seed(seed))
    other = Particles(belief.x[:, order], belief.log_weights[:, order], belief.scale_tril[:, order])
    for a, b in zip((*belief.moments(), belief.ess), (*other.moments(), other.ess), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-14)


def test_rows_of_a_batch_are_clouds_of_their_own():
    belief = cloud(3, 11, 2, seed=5, own=(3, 11))
    for row in range(3):
        alone = Particles(belief.x[row], belief.log_weights[row], belief.scale_tril[row])
        for a, b in zip((*belief.moments(), belief.ess), (*alone.moments(), alone.ess), strict=True):
            assert torch.equal(a[row], b)


def test_moments_on_a_curved_space():
    """Mean by SciPy's least squares, errors by SciPy's rotation vectors; an angle across the cut beside it."""
    space = Product(Angle(), UnitQuaternion("left"))
    centre = torch.tensor([3.0, 0.1, -0.2, 0.3, 0.9], dtype=torch.float64)
    x = space.retract(space.project(centre), 0.5 * normals(12, 4, seed=1))
    belief = Particles(x, torch.log_softmax(normals(12, seed=2), -1), space=space)
    mean, covariance = belief.moments()
    weights = belief.weights.numpy()
    angle = rotations.circular_mean(x[:, 0].numpy(), weights)
    assert math.remainder(mean[0].item() - angle, 2 * math.pi) == pytest.approx(0, abs=1e-14)
    assert rotations.distance(mean[1:].numpy(), rotations.mean_by_search(x[:, 1:].numpy(), weights)) < 1e-7
    vectors = np.stack([rotations.local(mean[1:].numpy(), q, "left") for q in x[:, 1:].numpy()])
    errors = np.concatenate([[[math.remainder(a - angle, 2 * math.pi)] for a in x[:, 0].tolist()], vectors], -1)
    np.testing.assert_allclose(covariance, np.einsum("n,ni,nj->ij", weights, errors, errors), rtol=0, atol=1e-13)


# Effective sample size ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=seeds, count=st.integers(1, 60), spread=st.floats(0, 30))
def test_effective_sample_size(dtype, seed, count, spread):
    log_weights = torch.log_softmax(spread * normals(3, count, seed=seed), -1).to(dtype)
    ess = Particles(torch.zeros(3, count, 1, dtype=dtype), log_weights).ess
    eps = torch.finfo(dtype).eps
    expected = 1 / np.square(np.exp(log_weights.double().numpy())).sum(-1)
    np.testing.assert_allclose(
        ess, expected, rtol=16 * eps * (1 + log_weights.abs().amin().item() * 2 + math.log(count))
    )
    assert (ess >= 1 - 64 * eps).all() and (ess <= count * (1 + 64 * eps)).all()


def test_extremes_of_the_effective_sample_size():
    one = torch.full((10,), -torch.inf)
    one[3] = 0
    assert Particles(torch.zeros(10, 1), one).ess == 1
    equal = uniform_log_weights((2, 10), torch.zeros((), dtype=torch.float64))
    assert equal.shape == (2, 10) and equal.dtype == torch.float64
    torch.testing.assert_close(
        Particles(torch.zeros(2, 10, 1), equal).ess, torch.full((2,), 10.0).double(), rtol=1e-14, atol=0
    )
    # Weights far below the smallest number of the type still count in their proportion.
    tiny = torch.log_softmax(torch.tensor([0.0, 0.0, -800.0], dtype=torch.float64), -1)
    torch.testing.assert_close(Particles(torch.zeros(3, 1), tiny).ess, torch.tensor(2.0).double())


# Second moments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("size", [1, 4])
def test_row_by_row_and_all_at_once_agree_to_the_bit(monkeypatch, batch, size):
    deviation, weights = normals(*batch, 300, size, seed=0), torch.softmax(normals(*batch, 300, seed=1), -1)
    at_once = second_moment(deviation, weights)
    monkeypatch.setattr(module, "_BLOCK", 0)
    assert torch.equal(second_moment(deviation, weights), at_once)
    expected = np.einsum("...n,...ni,...nj->...ij", weights.numpy(), deviation.numpy(), deviation.numpy())
    np.testing.assert_allclose(at_once, expected, rtol=0, atol=1e-14)


def test_the_layout_in_memory_has_no_effect():
    deviation, weights = normals(3, 50, 4, seed=0), torch.softmax(normals(3, 50, seed=1), -1)
    component_first = deviation.movedim(-1, 0).contiguous().movedim(0, -1)
    assert torch.equal(second_moment(deviation, weights), second_moment(component_first, weights))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [1, 3])
def test_moments_do_not_depend_on_the_threads(dtype, size):
    """50,001 particles, enough for torch to share its sums between threads."""
    belief = cloud(50_001, size, seed=0, dtype=dtype, own=(1,))
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append((*belief.moments(), belief.ess))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_derivatives_of_the_moments():
    belief = cloud(2, 5, 2, seed=1, own=(2, 5))
    x, scale = belief.x.requires_grad_(), belief.scale_tril.requires_grad_()
    raw = normals(2, 5, seed=4).requires_grad_()

    def value(x, raw, scale):
        same = Particles(x, torch.log_softmax(raw, -1), scale)
        return *same.moments(), same.ess

    assert torch.autograd.gradcheck(value, (x, raw, scale))


@pytest.mark.parametrize("space", [Euclidean(2), Angle(2)])
def test_moments_under_vmap_and_compile(space):
    belief = cloud(3, 20, 2, seed=1, own=(3, 20))

    def value(x, log_weights, scale):
        same = Particles(x, log_weights, scale, space)
        return *same.moments(), same.ess

    arguments = belief.x, belief.log_weights, belief.scale_tril
    expected = value(*arguments)
    torch.compiler.reset()
    compiled = torch.compile(value, fullgraph=True, backend="aot_eager")
    for function in (torch.vmap(value), compiled):
        for ours, eager in zip(function(*arguments), expected, strict=True):
            torch.testing.assert_close(ours, eager, rtol=1e-13, atol=1e-14)


def test_weights_held_beside_log_weights_count_for_these_alone() -> None:
    log_weights = torch.log(torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64))
    held = (log_weights, log_weights.exp())
    cloud = Particles(torch.eye(3, dtype=torch.float64), log_weights, held=held)
    assert cloud.weights is held[1]
    other = torch.log(torch.tensor([0.7, 0.2, 0.1], dtype=torch.float64))
    torch.testing.assert_close(cloud._replace(log_weights=other).weights, other.exp(), rtol=1e-15, atol=0)
    torch.testing.assert_close(cloud._replace(log_weights=other).mean, other.exp(), rtol=1e-15, atol=0)


# Mean and errors that are kept ----------------------------------------------------------------------------------------


def kept(seed=3):
    space = Product(UnitQuaternion("left"), Angle(), Euclidean(1))
    x = space.retract(space.project(normals(2, 1, 6, seed=seed)), 0.3 * normals(2, 40, 5, seed=seed + 1))
    return Particles(x, torch.log_softmax(normals(2, 40, seed=seed + 2), -1), space=space)


def test_a_cloud_that_knows_its_centre_has_the_same_moments():
    plain = kept()
    known = plain.with_centre()
    assert known.centre is not None and known.with_centre() is known
    assert torch.equal(known.mean, plain.mean)
    for ours, theirs in zip(known.moments(), plain.moments(), strict=True):
        assert torch.equal(ours, theirs)
    assert torch.equal(known.centre.errors, plain.space.local(plain.mean.unsqueeze(-2), plain.x))


@pytest.mark.parametrize("changed", ["x", "log_weights", "space"])
def test_a_centre_counts_only_for_what_it_was_made_of(changed):
    known = kept().with_centre()
    other = {
        "x": known.space.retract(known.x, torch.full((5,), 0.1, dtype=torch.float64)),
        "log_weights": known.log_weights.flip(-1),
        "space": Product(UnitQuaternion("right"), Angle(), Euclidean(1)),
    }
    after = known._replace(**{changed: other[changed]})
    plain = Particles(after.x, after.log_weights, space=after.space)
    for ours, theirs in zip(after.moments(), plain.moments(), strict=True):
        assert torch.equal(ours, theirs)
    assert torch.equal(after.mean, plain.mean)
    assert not torch.equal(after.covariance, known.covariance)


def test_a_centre_does_not_depend_on_the_order_in_memory():
    known = kept()
    rows = known._replace(x=known.x.contiguous())
    assert rows.x.stride() != known.x.stride()
    one, other = known.with_centre().centre, rows.with_centre().centre
    assert torch.equal(one.mean, other.mean) and torch.equal(one.errors, other.errors)
