"""The Rao-Blackwellised proposal: what it draws, what it keeps, which models and arguments it refuses."""

import copy
import pickle

import numpy as np
import pytest
import torch
from oracles import particle_oracle
from particle_problem import PLANE, bias_score, gaussian, replicate, series, state_space, tensor
from rao_blackwell_problem import mixed_model, mixed_series, plain_model

import torchfilt as tf
from torchfilt.moments import cubature, taylor, unscented
from torchfilt.proposals import Prior
from torchfilt.rao_blackwell import RaoBlackwellized
from torchfilt.types import StepInput, StepNoise

# Largest of a few z-scores: a false alarm in 30,000 tests.
Z = 4.5
A4 = tensor([[1.0, 0.3, 0.1, 0.0], [0.2, 0.9, 0.0, 0.1], [0.0, 0.1, 0.8, 0.3], [0.1, 0.0, -0.2, 0.9]])
SENSOR = tf.LinearGaussian(tensor([[1.0, 0.0, 0.5, 0.0]]), tensor([[0.4]]))


def spd(size, seed):
    a = torch.randn(size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return a @ a.mT + 0.3 * torch.eye(size, dtype=torch.float64)


def normals(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def nothing_measured(noise):
    unused = torch.zeros(0, dtype=torch.float64)
    y = torch.full((1, 1), torch.nan, dtype=torch.float64)
    return StepInput(y, None, None, StepNoise(noise, unused))


def conditional(covariance, drawn):
    """Covariance of the others given the drawn components, singular or not, in NumPy."""
    P = covariance.numpy()
    others = [k for k in range(len(P)) if k not in drawn]
    cross = P[np.ix_(others, drawn)]
    return P[np.ix_(others, others)] - cross @ np.linalg.pinv(P[np.ix_(drawn, drawn)], rcond=1e-10) @ cross.T, others


@pytest.mark.parametrize("drawn", [(0,), (3,), (0, 1), (1, 3), (0, 2, 3)], ids=str)
@pytest.mark.parametrize("rule", [taylor(), cubature(), unscented()], ids=["taylor", "cubature", "unscented"])
def test_a_motion_draws_a_margin_and_conditions_the_others(rule, drawn):
    """One particle, many draws: mean and covariance of them and of the Gaussian that is left are the prediction's.

    What is left is the conditional covariance, in its place.
    """
    motion = tf.LinearGaussian(A4, 0.5 * spd(4, 1))
    model = tf.StateSpaceModel(gaussian(torch.zeros(4).double(), spd(4, 2)), motion, SENSOR)
    start = torch.zeros(4, 4, dtype=torch.float64)
    _, others = conditional(torch.eye(4), drawn)
    start[np.ix_(others, others)] = torch.linalg.cholesky(spd(len(others), 3))
    count = 200_000 if rule == taylor() else 20_000
    point = tensor([0.5, -1.0, 2.0, 0.3])
    particles = tf.Particles(point.expand(count, 4), torch.zeros(count).double(), start.unsqueeze(0))
    noise = normals(count, 4)
    proposal = RaoBlackwellized(drawn, rule)
    after = proposal(model, particles, nothing_measured(noise))
    whole = A4 @ start @ start.mT @ A4.mT + 0.5 * spd(4, 1)
    left, others = conditional(whole, list(drawn))
    own = (after.scale_tril @ after.scale_tril.mT)[0]
    np.testing.assert_allclose(own[np.ix_(others, others)], left, rtol=0, atol=1e-12)
    assert not own[list(drawn)].any() and torch.equal(after.scale_tril, after.scale_tril.tril())
    away = after.x - A4 @ point
    assert (away.mean(0).abs() < Z * whole.diagonal().sqrt() / count**0.5).all()
    found = away.mT @ away / count + own
    # Variance of a product of normals: P_ii P_jj + P_ij^2.
    spread = (whole.diagonal()[:, None] * whole.diagonal() + whole**2).sqrt() / count**0.5
    assert ((found - whole).abs() < Z * spread).all()
    assert (after.log_weight == 0).all()


def dependent(step=0.1):
    """Position and velocity pushed by one and the same acceleration, whose bias is the third component."""
    motion = tensor([[1.0, step, step**2 / 2], [0.0, 1.0, step], [0.0, 0.0, 1.0]])
    push = tensor([[step**2 / 2], [step], [0.0]])
    return motion, push


def test_drawn_components_that_determine_each_other_leave_the_others_alone():
    """Rows of the drawn part are parallel to rounding: the bias keeps what two such measurements of it leave."""
    motion, push = dependent()
    law = tf.LinearGaussian(motion, push @ push.mT)
    model = tf.StateSpaceModel(
        gaussian(torch.zeros(3).double(), torch.eye(3).double()),
        law,
        tf.LinearGaussian(tensor([[1.0, 0.0, 0.0]]), tensor([[0.1]])),
    )
    start = torch.zeros(3, 3, dtype=torch.float64)
    start[2, 2] = 2.0
    particles = tf.Particles(normals(500, 3), torch.zeros(500).double(), start.unsqueeze(0))
    after = RaoBlackwellized(slice(0, 2))(model, particles, nothing_measured(normals(500, 3, seed=1)))
    whole = motion @ start @ start.mT @ motion.mT + push @ push.mT
    left, _ = conditional(whole, [0, 1])
    np.testing.assert_allclose((after.scale_tril[0, 2, 2] ** 2).item(), left.item(), rtol=1e-7)
    assert left > 0.7
    away = after.x - particles.x @ motion.mT
    np.testing.assert_allclose(away[:, 0], 0.05 * away[:, 1], rtol=0, atol=1e-8)
    assert torch.isfinite(after.x).all() and torch.isfinite(after.log_weight).all()


def test_evidence_with_singular_noise_is_unbiased():
    motion, push = dependent(0.7)
    model = PLANE._replace(
        A=motion.numpy(), Q=(push @ push.mT).numpy(), H=np.array([[1.0, 0.0, 0.0]]), m0=np.zeros(3), P0=np.eye(3)
    )
    _, ys = particle_oracle.simulate(model, 5, 3)
    exact = particle_oracle.kalman(model, ys).log_likelihood.sum()
    filter = tf.RaoBlackwellizedParticleFilter(state_space(model), 50, drawn=slice(0, 2))
    history = filter(replicate(tensor(ys), 2000), seed=1, record="mean")
    score, mean, error = bias_score(history.log_likelihood, exact)
    assert history.diagnostics.ok.all() and error < 0.02 and abs(score) < Z, (mean, error)


def test_the_start_holds_the_prior():
    """Drawn part and left Gaussian together have the prior's moments, 100,000 particles."""
    prior = gaussian(tensor([1.0, -1, 0.5, 2]), spd(4, 5))
    proposal = RaoBlackwellized([2, 0])
    count = 100_000
    cloud = proposal.start(prior, normals(count, 4), normals(count, 4, seed=1))
    assert proposal.drawn == (0, 2) and cloud.scale_tril.shape == (1, 4, 4)
    left, others = conditional(prior.covariance, [0, 2])
    own = (cloud.scale_tril @ cloud.scale_tril.mT)[0]
    np.testing.assert_allclose(own[np.ix_(others, others)], left, rtol=0, atol=1e-12)
    P = prior.covariance
    assert ((cloud.mean - prior.mean).abs() < Z * P.diagonal().sqrt() / count**0.5).all()
    spread = (P.diagonal()[:, None] * P.diagonal() + P**2).sqrt() / count**0.5
    assert ((cloud.covariance - P).abs() < Z * spread).all()
    batch = proposal.start(prior, normals(2, 3, 5, 4), normals(2, 3, 5, 4, seed=1))
    assert batch.scale_tril.shape == (2, 3, 1, 4, 4) and batch.x.shape == (2, 3, 5, 4)


def test_the_start_of_a_torch_law_is_its_own_draw():
    """Uniform position over a map: the drawn part is the law's own; what is correlated with it follows."""
    flat = torch.distributions.Uniform(tensor([0.0, -1.0, 2.0]), tensor([10.0, 1.0, 3.0]))
    draws = flat.sample((50,))
    cloud = RaoBlackwellized([0]).start(flat, draws, normals(50, 3))
    np.testing.assert_allclose(cloud.x[:, 0], draws[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(cloud.x[:, 1:], flat.mean[1:].expand(50, 2), rtol=0, atol=1e-12)
    np.testing.assert_allclose(cloud.scale_tril[0].diagonal(), [0, 3**-0.5, 12**-0.5], rtol=1e-12)
    joint = torch.distributions.MultivariateNormal(tensor([1.0, 2.0]), tensor([[2.0, 0.9], [0.9, 1.0]]))
    draws = joint.sample((50,))
    cloud = RaoBlackwellized([0]).start(joint, draws, normals(50, 2))
    np.testing.assert_allclose(cloud.x[:, 0], draws[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(cloud.x[:, 1], 2 + 0.45 * (draws[:, 0] - 1), rtol=0, atol=1e-12)
    filter = tf.RaoBlackwellizedParticleFilter(
        tf.StateSpaceModel(joint, state_space(PLANE).transition, state_space(PLANE).observation), 30, drawn=[0]
    )
    assert filter.evidence == "linearized" and filter(series(3)[0]).diagnostics.ok.all()
    whole = RaoBlackwellized(slice(None)).start(flat, flat.sample((5,)), normals(5, 3))
    assert whole.scale_tril is None


def test_points_without_a_covariance_go_on_as_points():
    model, y = state_space(PLANE), tensor([[0.7]])
    points = tf.Particles(normals(20, 2), torch.zeros(20).double())
    step = StepInput(y, None, None, StepNoise(normals(20, 2, seed=1), y), "none")
    one, other = (proposal(model, points, step) for proposal in (RaoBlackwellized([0]), Prior()))
    assert torch.equal(one.x, other.x) and torch.equal(one.log_weight, other.log_weight)


def test_rules_agree_on_a_model_that_is_linear_in_the_part():
    """Sigma points in three dimensions find the matrices themselves: the same particles to rounding."""
    ys = mixed_series(6)
    histories = [
        tf.RaoBlackwellizedParticleFilter(plain_model(1), 30, drawn=[1], rule=rule)(ys, seed=3)
        for rule in (None, cubature(), unscented(1.0, 0.0, 2.0))
    ]
    for other in histories[1:]:
        np.testing.assert_allclose(other.mean, histories[0].mean, rtol=0, atol=1e-10)
        np.testing.assert_allclose(other.log_likelihood, histories[0].log_likelihood, rtol=0, atol=1e-10)


def test_what_is_exact():
    mixed, plain = mixed_model(), plain_model()
    assert RaoBlackwellized([0]).is_exact(mixed, 4) and RaoBlackwellized(slice(0, 2)).is_exact(mixed, 4)
    assert not RaoBlackwellized([1]).is_exact(mixed, 4) and not RaoBlackwellized([0]).is_exact(plain, 4)
    assert RaoBlackwellized(slice(None)).is_exact(plain, 4) and RaoBlackwellized([]).is_exact(state_space(PLANE), 2)
    half = tf.StateSpaceModel(mixed.initial, mixed.transition, plain.observation)
    assert not RaoBlackwellized([0]).is_exact(half, 4)
    half.observation.linear_in = slice(1, None)
    assert RaoBlackwellized([0]).is_exact(half, 4)


def test_copies_and_pickles():
    for proposal in (RaoBlackwellized(slice(0, 3), cubature()), RaoBlackwellized([3, 1])):
        assert copy.deepcopy(proposal) == proposal == pickle.loads(pickle.dumps(proposal))


def test_bad_arguments_are_refused():
    with pytest.raises(TypeError, match=r"drawn must be a slice or whole numbers, got 1\.5"):
        RaoBlackwellized([0, 1.5])
    with pytest.raises(TypeError, match="drawn must be a slice or whole numbers, got True"):
        RaoBlackwellized([True])
    with pytest.raises(ValueError, match=r"different indices from 0 on, got \[1, 1\]"):
        RaoBlackwellized([1, 1])
    with pytest.raises(ValueError, match=r"different indices from 0 on, got \[-1\]"):
        RaoBlackwellized([-1])
    with pytest.raises(TypeError, match=r"rule must be a moment rule.*got 'taylor'"):
        RaoBlackwellized([0], "taylor")
    with pytest.raises(ValueError, match=r"all particles of a row needs rule=taylor\(\)"):
        RaoBlackwellized([0], cubature(), shared=True)
    with pytest.raises(ValueError, match="expanded about itself"):
        RaoBlackwellized([0], taylor([1.0, 2.0]))
    with pytest.raises(ValueError, match=r"error components of the state, 0 to 1, got \[0, 2\]"):
        tf.RaoBlackwellizedParticleFilter(state_space(PLANE), drawn=[0, 2])
    with pytest.raises(ValueError, match="a move or a kernel walks on points"):
        tf.ParticleFilter(state_space(PLANE), 20, RaoBlackwellized([0]), move=tf.moves.MetropolisHastings())


def test_laws_that_do_not_fit_are_refused():
    plain = plain_model()
    ys = mixed_series(2)
    filter = tf.RaoBlackwellizedParticleFilter(plain, 10, drawn=[0], rule=unscented(1e-2))
    with pytest.raises(ValueError, match="negative weight can't be conditioned on"):
        filter(ys)
    wide = tf.AdditiveGaussian(lambda x: torch.cat([x, x[..., :1]], -1), torch.eye(5).double())
    model = tf.StateSpaceModel(plain.initial, wide, plain.observation)
    with pytest.raises(ValueError, match="turns 4 state numbers into 5"):
        tf.RaoBlackwellizedParticleFilter(model, 10, drawn=[0])(ys)
    turned = tf.AdditiveGaussian(lambda x: x, torch.eye(4).double(), tf.Angle(4))
    model = tf.StateSpaceModel(plain.initial, turned, plain.observation)
    with pytest.raises(ValueError, match="gives a state on Angle"):
        tf.RaoBlackwellizedParticleFilter(model, 10, drawn=[0])(ys)
