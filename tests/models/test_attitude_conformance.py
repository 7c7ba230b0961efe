"""Properties that no attitude filter may lose: unit norm, no preferred world axes, no preferred sign."""

import pytest
import torch
from scipy.spatial.transform import Rotation

import torchfilt as tf
from torchfilt import moments
from torchfilt.models.attitude import ATTITUDE_SPACE, GyroTransition, VectorMeasurement, multiply, rotate
from torchfilt.particles import Particles

DOUBLE = torch.float64
STEPS, DT = 40, 0.1
UP = torch.tensor([0.0, 0.0, 9.81], dtype=DOUBLE)
FIELD = torch.tensor([3.0, 15.7, -40.9], dtype=DOUBLE)
RULES = {"taylor": moments.taylor(), "unscented": moments.unscented(), "cubature": moments.cubature()}
# Half turns map Cholesky factors on Cholesky factors, whatever the covariance; other turns turn the sigma points.
HALF_TURNS = {"half turn about x": [torch.pi, 0, 0], "half turn about z": [0, 0, torch.pi]}
TURNS = HALF_TURNS | {"any turn": [0.7, -1.1, 2.0]}
CASES = [("taylor", "any turn"), *((rule, turn) for rule in RULES for turn in HALF_TURNS)]


def normal(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def quaternion(vector):
    return torch.from_numpy(Rotation.from_rotvec(vector).as_quat(canonical=False))


CONTROLS = normal(STEPS, 3, seed=1, scale=2.0)
START = torch.cat([quaternion([0.4, -0.3, 1.0]), torch.tensor([0.01, -0.02, 0.03], dtype=DOUBLE)])
FACTOR = 0.2 * normal(6, 6, seed=2).tril() + 0.1 * torch.eye(6, dtype=DOUBLE)
FACTOR[3:] *= 0.1
LAWS = (GyroTransition(1e-2, 1e-3), VectorMeasurement(UP, 0.5), VectorMeasurement(FIELD, 2.0))


def measured():
    """A body that starts off the prior's mean, seen with noise and with gaps."""
    x = ATTITUDE_SPACE.retract(START, torch.tensor([0.2, -0.1, 0.25, 0.0, 0.01, 0.0], dtype=DOUBLE))
    ys = []
    for k in range(STEPS):
        x = LAWS[0](x, CONTROLS[k], DT).mean
        ys.append(torch.cat([law(x).mean for law in LAWS[1:]]))
    noisy = torch.stack(ys) + normal(STEPS, 6, seed=3, scale=0.5)
    noisy[5:9, 3:] = torch.nan
    return noisy


YS = measured()


def model(turn=None, sign=1.0, dtype=DOUBLE, scale=1.0):
    """The problem; the world turned by a quaternion, the prior's with another sign, or deviations scaled."""
    turn = turn if turn is not None else quaternion([0.0, 0.0, 0.0])
    mean = torch.cat([sign * multiply(turn, START[:4]), START[4:]])
    prior = tf.Gaussian(mean, scale * turned_factor(FACTOR, turn), ATTITUDE_SPACE)
    sensors = tf.Sensors(
        accelerometer=VectorMeasurement(rotate(turn, UP), 0.5 * scale),
        magnetometer=VectorMeasurement(rotate(turn, FIELD), 2.0 * scale),
    )
    prior = prior._replace(mean=prior.mean.to(dtype), scale_tril=prior.scale_tril.to(dtype))
    return tf.StateSpaceModel(prior, GyroTransition(1e-2 * scale, 1e-3 * scale), sensors).to(dtype)


def turning(turn):
    """What a turn of the world does to errors: a rotation of the first three."""
    whole = torch.eye(6, dtype=DOUBLE)
    whole[:3, :3] = torch.from_numpy(Rotation.from_quat(turn.numpy()).as_matrix())
    return whole


def turned_factor(factor, turn):
    covariance = turning(turn) @ factor @ factor.mT @ turning(turn).mT
    return torch.linalg.cholesky(covariance)


def largest(found, other, turn):
    """Largest difference of means and covariances of two beliefs, one in a turned world, in deviations."""
    back = torch.cat([multiply(turn.expand(*found.mean.shape[:-1], 4), found.mean[..., :4]), found.mean[..., 4:]], -1)
    expected = turning(turn) @ found.covariance @ turning(turn).mT
    scale = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    away = ATTITUDE_SPACE.local(back, other.mean) / scale
    apart = (other.covariance - expected) / (scale[..., None] * scale[..., None, :])
    return max(away.abs().max().item(), apart.abs().max().item())


def check_turned(found, other, turn, tolerance):
    assert largest(found, other, turn) < tolerance


# World axes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rule", "turn"), CASES)
def test_a_turned_world_turns_the_estimate(rule, turn):
    q = quaternion(TURNS[turn])
    runs = [tf.GaussianFilter(m, RULES[rule])(YS, CONTROLS, DT) for m in (model(), model(q))]
    check_turned(*runs, q, 1e-10)


@pytest.mark.parametrize("rule", ["unscented", "cubature"])
def test_any_turn_moves_sigma_points_at_the_fourth_order_only(rule):
    """Points off other axes see other fourth moments: in deviations, a mean to the third and a covariance to the
    second power of the deviations; so what is left falls by four as they are halved."""
    q, left = quaternion(TURNS["any turn"]), []
    for scale in (0.04, 0.02, 0.01):
        pair = []
        for world in (None, q):
            filter = tf.GaussianFilter(model(world, scale=scale), RULES[rule])
            clean = torch.cat([law(LAWS[0](START, CONTROLS[0], DT).mean).mean for law in LAWS[1:]])
            noise = torch.tensor([0.5, -0.3, 0.4, -2.0, 1.0, 1.5], dtype=DOUBLE)
            pair.append(filter.step(filter.init(), clean + scale * noise, CONTROLS[0], DT)[0].belief)
        left.append(largest(*pair, q))
    assert left[0] > 3.7 * left[1] > 3.7**2 * left[2] > 1e-6


@pytest.mark.parametrize(("rule", "turn"), CASES)
def test_a_turned_world_turns_a_bank(rule, turn):
    """Particles are turned with the world; what is resampled is chosen by the same numbers."""
    q = quaternion(TURNS[turn])
    filters = [tf.LocallyLinearizedParticleFilter(m, 20, RULES[rule], redraw="never") for m in (model(), model(q))]
    state = filters[0].init((3,), seed=5)
    bank = state.belief
    turned = torch.cat([multiply(q.expand_as(bank.x[..., :4]), bank.x[..., :4]), bank.x[..., 4:]], -1)
    factor = turned_factor(bank.scale_tril, q)
    states = [state, state._replace(belief=bank._replace(x=turned, scale_tril=factor))]
    for k in range(STEPS):
        steps = [f.step(s, YS[k].expand(3, 6), CONTROLS[k], DT) for f, s in zip(filters, states, strict=True)]
        states = [s for s, _ in steps]
        likelihoods = [info.log_likelihood for _, info in steps]
        torch.testing.assert_close(likelihoods[1], likelihoods[0], rtol=1e-8, atol=1e-8)
    found, other = (as_gaussian(s.belief) for s in states)
    check_turned(found, other, q, 1e-7)


def as_gaussian(bank):
    mean, covariance = bank.moments()
    return tf.Gaussian(mean, torch.linalg.cholesky(covariance), ATTITUDE_SPACE)


# Sign -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_both_signs_of_the_prior_are_one_attitude(rule):
    runs = [tf.GaussianFilter(model(sign=sign), RULES[rule])(YS, CONTROLS, DT) for sign in (1.0, -1.0)]
    check_turned(*runs, quaternion([0.0, 0.0, 0.0]), 1e-11)
    torch.testing.assert_close(runs[1].log_likelihood, runs[0].log_likelihood, rtol=1e-12, atol=0)


@pytest.mark.parametrize("rule", RULES)
def test_a_bank_of_mixed_signs_is_the_same_bank(rule):
    bank = tf.LocallyLinearizedParticleFilter(model(), 30, RULES[rule], redraw="resample")
    state = bank.init((2,), seed=7)
    signs = 1 - 2 * (torch.arange(30) % 3 == 0).to(DOUBLE)[:, None]
    mixed = torch.cat([signs * state.belief.x[..., :4], state.belief.x[..., 4:]], -1)
    states = [state, state._replace(belief=state.belief._replace(x=mixed))]
    for k in range(STEPS):
        steps = [bank.step(s, YS[k].expand(2, 6), CONTROLS[k], DT) for s in states]
        states = [s for s, _ in steps]
    assert isinstance(states[1].belief, Particles)
    found, other = (as_gaussian(s.belief) for s in states)
    check_turned(found, other, quaternion([0.0, 0.0, 0.0]), 1e-8)


# Norm -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_the_motion_keeps_the_norm(count, dtype):
    """A product, a sum of squares and a root: two units in the last place, after any number of steps."""
    law, x = GyroTransition(1e-3, 1e-5).to(dtype), START.to(dtype).expand(4, 7)
    u = normal(4, 3, seed=8, scale=3.0).to(dtype)
    worst = 0.0
    with torch.inference_mode():
        for k in range(count):
            x = law(x, u, 3e-3).mean
            if k % 1000 == 999:
                worst = max(worst, (x[:, :4].double().norm(dim=-1) - 1).abs().max().item())
    assert worst < 2 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("rule", ["taylor", "unscented"])
@pytest.mark.parametrize("count", [500, pytest.param(20_000, marks=pytest.mark.slow)])
def test_filters_keep_the_norm(rule, count, dtype):
    filter = tf.GaussianFilter(model(dtype=dtype), RULES[rule])
    state, worst = filter.init((2,)), 0.0
    y, u = YS.to(dtype), CONTROLS.to(dtype)
    with torch.inference_mode():
        for k in range(count):
            state, info = filter.step(state, y[k % STEPS].expand(2, 6), u[k % STEPS], DT)
            worst = max(worst, (state.belief.mean[:, :4].double().norm(dim=-1) - 1).abs().max().item())
    assert info.ok.all()
    assert worst < 2 * torch.finfo(dtype).eps
