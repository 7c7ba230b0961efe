"""Local proposals: one mechanism, its policies, and what each leaves unchanged."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, gaussian, series, state_space, tensor

import torchfilt as tf
from torchfilt.moments import cubature, unscented
from torchfilt.proposals import Local, Prior
from torchfilt.resampling import ess_below, systematic
from torchfilt.types import StepInput


def cloud(rows=(3,), n=40, own=True, shared=False, seed=0, dtype=torch.float64):
    """Particles (*rows, n, 3) with uneven weights and, with ``own``, a covariance each."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(*rows, n, 3, generator=generator, dtype=torch.float64) @ tensor(
        [[2, 0, 0], [0.5, 1, 0], [0, -0.3, 0.2]]
    )
    weights = torch.rand(*rows, n, generator=generator, dtype=torch.float64) + 0.01
    log_weights = torch.log_softmax(3 * weights, -1)
    factor = None
    if own:
        count = 1 if shared else n
        factor = torch.randn(*rows, count, 3, 3, generator=generator, dtype=torch.float64).tril() * 0.4
    return tf.Particles(x.to(dtype), log_weights.to(dtype), None if factor is None else factor.to(dtype))


def normals(particles, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(particles.x.shape, generator=generator, dtype=torch.float64).to(particles.x.dtype)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("split", [0.05, 0.6, 0.95])
def test_pooled_redraw_keeps_mean_and_covariance_exactly(split, shared):
    """Tolerance 1e-10 relative: rounding times the condition of a 3 x 3 cloud."""
    before = cloud(shared=shared)
    proposal = Local(unscented(), "always", split, pooled=True)
    after = proposal.refresh(before, normals(before), None)
    for old, new in zip(before.moments(), after.moments(), strict=True):
        np.testing.assert_allclose(new, old, rtol=0, atol=1e-10 * old.abs().max().item())
    assert torch.equal(after.log_weights, before.log_weights)
    own = after.scale_tril @ after.scale_tril.mT
    np.testing.assert_allclose(own.squeeze(-3), split * before.covariance, rtol=0, atol=1e-10)
    assert not torch.allclose(after.x, before.x)


def test_pooled_redraw_in_single_precision_keeps_the_moments_to_its_own_rounding():
    before = cloud(dtype=torch.float32)
    after = Local(unscented(), "always", 0.6, pooled=True).refresh(before, normals(before), None)
    assert after.x.dtype == after.scale_tril.dtype == torch.float32
    for old, new in zip(before.moments(), after.moments(), strict=True):
        np.testing.assert_allclose(new, old, rtol=0, atol=5e-6 * old.abs().max().item())


@pytest.mark.parametrize("split", [0.0, 0.3, 1.0])
def test_split_leaves_the_moments_of_the_mixture_in_expectation(split):
    """Mean over 4000 redraws against the mixture's own moments, every entry within 5 standard errors (12 entries a
    case: a false alarm in 100,000 cases); the second moment is taken about the old mean, so that it is linear in the
    mixture."""
    before = cloud(rows=())
    wide = tf.Particles(
        before.x.expand(4000, -1, -1), before.log_weights.expand(4000, -1), before.scale_tril.expand(4000, -1, -1, -1)
    )
    after = Local(unscented(), "always", split).refresh(wide, normals(wide), None)
    mean, covariance = before.moments()
    found_mean, found_covariance = after.moments()
    offset = found_mean - mean
    second = found_covariance + offset.unsqueeze(-1) * offset.unsqueeze(-2)
    for samples, exact in ((found_mean, mean), (second, covariance)):
        error = samples.std(0) / 4000**0.5 + 1e-14
        assert ((samples.mean(0) - exact).abs() < 5 * error).all()
    if split == 0:
        assert after.scale_tril is None
    else:
        np.testing.assert_allclose(after.scale_tril, before.scale_tril.expand(4000, -1, -1, -1) * split**0.5)


def test_literal_redraw_doubles_the_local_covariance():
    before = cloud(rows=())
    wide = tf.Particles(
        before.x.expand(4000, -1, -1), before.log_weights.expand(4000, -1), before.scale_tril.expand(4000, -1, -1, -1)
    )
    after = Local(unscented(), "always", None).refresh(wide, normals(wide), None)
    own = (before.weights[:, None, None] * (before.scale_tril @ before.scale_tril.mT)).sum(0)
    offset = after.mean - before.mean
    second = after.covariance + offset.unsqueeze(-1) * offset.unsqueeze(-2)
    error = second.std(0) / 4000**0.5
    assert ((second.mean(0) - before.covariance - own).abs() < 5 * error).all()
    assert (own.diagonal() > 20 * error.diagonal()).all()


def test_redraw_on_resampling_touches_only_the_rows_that_were():
    before = cloud()
    chosen = torch.tensor([True, False, True])
    for split in (0.0, 0.5):
        after = Local(unscented(), "resample", split).refresh(before, normals(before), chosen)
        same = [torch.equal(after.x[row], before.x[row]) for row in range(3)]
        assert same == [False, True, False]
        assert torch.equal(after.scale_tril[1], before.scale_tril[1])
        np.testing.assert_allclose(after.scale_tril[0], before.scale_tril[0] * split**0.5)


def test_never_redraws():
    before = cloud()
    after = Local(unscented(), "never", 0.5).refresh(before, None, None)
    assert after is before


def test_unscented_and_locally_linearised_filters_are_one_mechanism():
    """Same class, same numbers once the arguments are the same."""
    model, (ys, _) = state_space(PLANE), series(6)
    arguments = dict(particles=30, split=0.5, redraw="resample", pooled=False, weights="marginal")
    first = tf.UnscentedParticleFilter(model, **arguments)
    second = tf.LocallyLinearizedParticleFilter(model, **arguments)
    assert type(first) is type(second) is tf.ParticleFilter
    assert first.proposal == second.proposal
    one, other = first(ys, seed=3), second(ys, seed=3)
    assert torch.equal(one.mean, other.mean) and torch.equal(one.log_likelihood, other.log_likelihood)
    direct = tf.ParticleFilter(model, 30, Local(unscented(), "resample", 0.5), ess_below(0.5))(ys, seed=3)
    assert torch.equal(one.mean, direct.mean)


def test_rules_are_exchangeable_on_a_linear_model():
    """Sigma points and derivatives agree, so the same noise gives the same particles to rounding."""
    model, (ys, _) = state_space(PLANE), series(6)
    histories = [
        tf.UnscentedParticleFilter(model, 30, rule)(ys, seed=3)
        for rule in (None, unscented(0.5, 2.0), cubature(), tf.moments.taylor())
    ]
    for other in histories[1:]:
        np.testing.assert_allclose(other.mean, histories[0].mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(other.log_likelihood, histories[0].log_likelihood, rtol=0, atol=1e-11)


def test_prior_proposal_moves_by_the_law_and_weights_by_the_measurement():
    model, y = state_space(PLANE), tensor([0.7])
    filter = tf.BootstrapFilter(model, 7, systematic)
    state = filter.init((), seed=4)
    noise = filter.draw(state.belief, 0, 4)
    after, info = filter.advance(state.belief, y, None, None, noise, "none")
    ancestors = info.ancestors
    A, Q, H, R = (tensor(part) for part in PLANE[:4])
    expected = state.belief.x[ancestors] @ A.mT + noise.proposal @ torch.linalg.cholesky(Q).mT
    np.testing.assert_allclose(after.x, expected, rtol=0, atol=1e-14)
    residual = (y - expected @ H.mT).squeeze(-1)
    weight = torch.exp(-0.5 * residual**2 / R.squeeze()) / (2 * np.pi * R.squeeze()) ** 0.5
    np.testing.assert_allclose(after.weights, weight / weight.sum(), rtol=1e-12)
    np.testing.assert_allclose(info.log_likelihood, weight.mean().log(), rtol=0, atol=1e-12)


def test_points_that_stand_still_are_weighted_only():
    """dt = 0 by predict=False: the local proposal has no law to draw from again and falls back on the measurement."""
    model, y = state_space(PLANE), tensor([[0.7]])
    local = Local(unscented(), "always", 0.0, weights="joint")
    particles = cloud(rows=(), own=False)._replace(x=cloud(rows=()).x[:, :2])
    proposed = local(model, particles, StepInput(y, None, None, None, "none", False))
    reference = Prior()(model, particles, StepInput(y, None, None, None, "none", False))
    assert torch.equal(proposed.x, particles.x) and torch.equal(proposed.log_weight, reference.log_weight)


BAD = [
    (dict(redraw="sometimes"), "redraw must be .*got 'sometimes'"),
    (dict(weights="both"), "weights must be .*got 'both'"),
    (dict(split=-0.1), r"split must be in \[0, 1\] or None, got -0.1"),
    (dict(split=1.5), r"split must be in \[0, 1\] or None, got 1.5"),
    (dict(weights="joint", split=0.5, redraw="always"), "joint weights .* split=0"),
    (dict(weights="joint", split=0.0, redraw="never"), "joint weights .* redraw='always', got 'never'"),
    (dict(pooled=True, split=0.0), "pooled redraw needs 0 < split < 1, got 0.0"),
    (dict(pooled=True, split=1.0), "pooled redraw needs 0 < split < 1, got 1.0"),
    (dict(pooled=True, split=None), "pooled redraw needs 0 < split < 1, got None"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_combinations_without_meaning_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Local(unscented(), **arguments)


def test_constructor_errors_name_the_rule():
    model = state_space(PLANE)
    with pytest.raises(ValueError, match="particles must be at least 2, got 1"):
        tf.BootstrapFilter(model, 1)
    with pytest.raises(ValueError, match="pooled redraw in 2 dimensions needs at least 4 particles, got 3"):
        tf.UnscentedParticleFilter(model, 3)
    with pytest.raises(ValueError, match="a move or a kernel walks on points"):
        tf.UnscentedParticleFilter(model, 10, move=tf.moves.MetropolisHastings())
    with pytest.raises(TypeError, match="model must be a StateSpaceModel"):
        tf.BootstrapFilter("model")
    with pytest.raises(TypeError, match="model must be a StateSpaceModel"):
        tf.KalmanFilter("model")
    with pytest.raises(TypeError, match=r"resampler must be a Resampler.*got 'systematic'"):
        tf.BootstrapFilter(model, 10, "systematic")
    for build in (tf.GaussianFilter, lambda model, rule: tf.UnscentedParticleFilter(model, 10, rule)):
        with pytest.raises(TypeError, match=r"rule must be a moment rule.*got 'unscented'"):
            build(model, unscented)
    filter = tf.BootstrapFilter(model, 10)
    with pytest.raises(ValueError, match="needs its random numbers"):
        filter.advance(filter.init().belief, tensor([0.0]))


def test_singular_process_noise_is_no_trouble_for_a_bank():
    """Rank-one noise in three dimensions: the bank only predicts and updates, it never asks for a density of x."""
    A = tensor([[1.0, 0.5, 0.1], [0.0, 1.0, 0.5], [0.0, 0.0, 0.9]])
    push = tensor([[0.02], [0.1], [0.4]])
    model = tf.StateSpaceModel(
        gaussian(torch.zeros(3).double(), torch.eye(3).double()),
        tf.LinearGaussian(A, push @ push.mT),
        tf.LinearGaussian(tensor([[1.0, 0.0, 0.0]]), tensor([[0.3]])),
    )
    ys = tensor([[0.1], [0.4], [-0.2], [0.7]])
    exact = tf.KalmanFilter(model)(ys)
    for filter in (
        tf.LocallyLinearizedParticleFilter(model, 4000, redraw="always"),
        tf.UnscentedParticleFilter(model, 4000),
    ):
        history = filter(ys, seed=5)
        assert history.diagnostics.ok.all()
        np.testing.assert_allclose(history.mean[-1], exact.mean[-1], rtol=0, atol=5 / 4000**0.5)
