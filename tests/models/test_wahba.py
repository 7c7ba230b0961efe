"""Attitude from directions: against SciPy's solution of Wahba's problem, against each other, and at their edges."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfilt.models.attitude import (
    ATTITUDE_SPACE,
    attitude_covariance,
    davenport_q,
    initial_attitude,
    quest,
    triad,
    wahba_svd,
)
from torchfilt.spaces import UnitQuaternion

DOUBLE = torch.float64
BEST = {"davenport_q": davenport_q, "quest": quest, "wahba_svd": wahba_svd}


def rotations(count, angle=None, seed=0):
    """All over the group, or turns of one angle in rad about axes all over the sphere and along the three axes."""
    if angle is None:
        return Rotation.random(count, random_state=seed)
    axes = np.random.default_rng(seed).normal(size=(count, 3))
    axes[:3] = np.eye(3)
    return Rotation.from_rotvec(angle * axes / np.linalg.norm(axes, axis=1, keepdims=True))


def scene(turns, n=4, noise=0.02, seed=1, dtype=DOUBLE):
    """Vectors of any length seen by bodies of these attitudes, with weights: (k, n, 3), (k, n, 3), (k, n)."""
    rng = np.random.default_rng(seed)
    count = len(turns)
    world = rng.normal(size=(count, n, 3))
    body = np.stack([turn.inv().apply(w) for turn, w in zip(turns, world, strict=True)])
    body = (body + noise * rng.normal(size=body.shape)) * rng.uniform(0.5, 2.0, (count, n, 1))
    return (torch.from_numpy(part).to(dtype) for part in (body, world, rng.uniform(0.2, 3.0, (count, n))))


def apart(a, b):
    """Angle between attitudes, rad."""
    return UnitQuaternion().local(a.double(), b.double()).norm(dim=-1)


def expected(body, world, weights):
    """SciPy's attitude of each row, and Wahba's loss."""
    unit = [(part / part.norm(dim=-1, keepdim=True)).double().numpy() for part in (body, world)]
    rows = [Rotation.align_vectors(w, b, weights=c) for b, w, c in zip(*unit, weights.double().numpy(), strict=True)]
    turns, rms = zip(*rows, strict=True)
    # SciPy's number is the root of the weighted sum of squares.
    return torch.from_numpy(np.stack([t.as_quat() for t in turns])), torch.tensor(rms, dtype=DOUBLE).square() / 2


@pytest.mark.parametrize("angle", [None, math.pi, math.pi - 1e-9, math.pi - 1e-4, 1e-9, 0.0])
@pytest.mark.parametrize("name", BEST)
def test_best_attitudes_are_those_of_scipy(name, angle):
    body, world, weights = scene(rotations(60, angle))
    found = BEST[name](body, world, weights)
    quaternion, loss = expected(body, world, weights)
    # Random directions have a gap of 0.03 and more; the polynomial loses its square.
    assert apart(found.quaternion, quaternion).max() < (1e-11 if name == "quest" else 1e-13)
    torch.testing.assert_close(found.loss, loss, rtol=1e-9, atol=1e-15)
    assert (found.quaternion[:, 3] >= 0).all()
    np.testing.assert_allclose(found.quaternion.norm(dim=-1), 1, rtol=0, atol=4e-16)


@pytest.mark.parametrize("angle", [None, math.pi])
@pytest.mark.parametrize("name", BEST)
def test_single_precision(name, angle):
    body, world, weights = scene(rotations(60, angle), dtype=torch.float32)
    found = BEST[name](body, world, weights)
    assert found.quaternion.dtype == found.loss.dtype == torch.float32
    # The result is rounded once, to 6e-8 in each of its numbers.
    assert apart(found.quaternion, expected(body, world, weights)[0]).max() < 5e-7


@pytest.mark.parametrize("name", BEST)
def test_single_precision_takes_what_its_directions_resolve(name):
    """A degree apart all methods answer, to the rounding of the directions by the sine; with unequal weights too."""
    sine = math.radians(1.0)
    turns = rotations(40, seed=14)
    world = np.tile([[1.0, 0.0, 0.0], [math.sqrt(1 - sine**2), sine, 0.0]], (40, 1, 1))
    body = torch.from_numpy(np.stack([t.inv().apply(w) for t, w in zip(turns, world, strict=True)])).float()
    world = torch.from_numpy(world).float()
    truth = torch.from_numpy(turns.as_quat())
    assert apart(BEST[name](body, world).quaternion, truth).max() < 4 * 6e-8 / sine
    across = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = BEST[name](across, across, torch.tensor([1.0, 1e-5]))
    assert apart(found.quaternion, torch.tensor([0.0, 0.0, 0.0, 1.0])) < 1e-6
    nearly = across + torch.tensor([[0.0] * 3, [1.0, -1.0 + 1e-5, 0.0]])
    with pytest.raises(ValueError, match="lie on one line"):
        BEST[name](nearly, nearly)


@pytest.mark.parametrize(("sine", "names"), [(1e-2, tuple(BEST)), (1e-5, ("davenport_q", "wahba_svd"))])
def test_directions_close_to_each_other(sine, names):
    """A pair of directions this far apart leaves 1 / sine^2 of the digits of a turn about them."""
    turns = rotations(40, seed=3)
    rng = np.random.default_rng(4)
    first = rng.normal(size=(40, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    across = np.cross(first, rng.normal(size=(40, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    world = np.stack([first, first * math.sqrt(1 - sine**2) + across * sine], 1)
    body = torch.from_numpy(np.stack([t.inv().apply(w) for t, w in zip(turns, world, strict=True)]))
    truth = torch.from_numpy(turns.as_quat())
    for name in names:
        error = apart(BEST[name](body, torch.from_numpy(world)).quaternion, truth).max()
        # The polynomial has the fourth power of the sine in the distance of its roots.
        limit = 1e-15 / sine**2 * 50 if name != "quest" else 1e-15 / sine**4 * 50
        assert error < limit, name
    assert apart(triad(body, torch.from_numpy(world)).quaternion, truth).max() < 1e-15 / sine * 50


def test_triad_meets_the_first_direction_exactly():
    body, world, _ = scene(rotations(50, seed=5), n=2, noise=0.1)
    found = triad(body, world)
    seen, meant = (part[:, 0] / part[:, 0].norm(dim=-1, keepdim=True) for part in (body, world))
    turned = Rotation.from_quat(found.quaternion.numpy()).apply(seen.numpy())
    np.testing.assert_allclose(turned, meant, rtol=0, atol=1e-14)
    # A huge weight of the first is the same.
    for name in ("davenport_q", "wahba_svd"):
        heavy = BEST[name](body, world, torch.tensor([1e6, 1.0], dtype=DOUBLE))
        assert apart(found.quaternion, heavy.quaternion).max() < 1e-5
    # Half the weighted squares of what is left of the second.
    quaternion = Rotation.from_quat(found.quaternion.numpy())
    off = world[:, 1] / world[:, 1].norm(dim=-1, keepdim=True) - torch.from_numpy(
        quaternion.apply((body[:, 1] / body[:, 1].norm(dim=-1, keepdim=True)).numpy())
    )
    torch.testing.assert_close(found.loss, off.square().sum(-1) / 2, rtol=1e-10, atol=1e-14)


def test_leading_dims_broadcast_and_rows_stand_alone():
    body, world, weights = scene(rotations(6, seed=6))
    for solve in BEST.values():
        alone = torch.stack([solve(body[k], world[0], weights[0]).quaternion for k in range(6)])
        whole = solve(body, world[0], weights[0]).quaternion
        assert apart(whole, alone).max() < 1e-12
        assert solve(body.reshape(2, 3, 4, 3), world.reshape(2, 3, 4, 3)).quaternion.shape == (2, 3, 4)


@pytest.mark.parametrize("name", ["davenport_q", "wahba_svd", "triad"])
def test_derivatives(name):
    body, world, weights = scene(rotations(3, seed=7), n=2 if name == "triad" else 4)
    arguments = (body, world) if name == "triad" else (body, world, weights)
    solve = triad if name == "triad" else BEST[name]
    inputs = [part.clone().requires_grad_() for part in arguments]
    assert torch.autograd.gradcheck(lambda *given: solve(*given).quaternion.square(), inputs)


@pytest.mark.parametrize("name", [*BEST, "triad"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda b, w: (b[:, :1], w[:, :1]), r"\(\.\.\., n, 3\) with n >= 2|triad takes two vectors"),
        (lambda b, w: (b[..., :2], w[..., :2]), r"\(\.\.\., n, 3\)"),
        (lambda b, w: (b.index_fill(0, torch.tensor(1), math.nan), w), r"finite and not zero.*got nan in row \(1, 0\)"),
        (lambda b, w: (b, w.index_fill(0, torch.tensor(2), 0.0)), r"finite and not zero.*got 0 in row \(2, 0\)"),
        (lambda b, w: (b, w[:, :1].expand_as(w)), r"lie on one line.* in row \(\d,\)"),
        (lambda b, w: (b, w.float()), "must have one dtype"),
        (lambda b, w: (b.long(), w), "must be of a floating dtype"),
    ],
)
def test_degenerate_vectors_are_refused(name, spoil, message):
    body, world, _ = scene(rotations(3, seed=8), n=2, noise=0.0)
    solve = triad if name == "triad" else BEST[name]
    with pytest.raises(ValueError, match=message):
        solve(*spoil(body, world))


def test_weights_are_checked():
    body, world, weights = scene(rotations(3, seed=9))
    for solve in BEST.values():
        with pytest.raises(ValueError, match=r"weights must be >= 0 and finite, got -1 in row \(1, 2\)"):
            bad = weights.clone()
            bad[1, 2] = -1
            solve(body, world, bad)
        with pytest.raises(ValueError, match="weights must not all be zero"):
            solve(body, world, weights * 0)
        with pytest.raises(ValueError, match=r"weights must be \(n,\) or \(\.\.\., n\)"):
            solve(body, world, weights[:, :3])
        with pytest.raises(ValueError, match="must have the same n"):
            solve(body, world[:, :3])


def test_the_covariance_is_that_of_many_trials():
    """20,000 trials: a variance to 1 %, five standard errors 5 %; correlations of 0.007, five of them 0.035."""
    trials, sds = 20_000, torch.tensor([2e-3, 5e-3, 1e-2], dtype=DOUBLE)
    world = torch.tensor([[0.0, 0.0, 2.0], [0.1, 1.0, -2.0], [3.0, 1.0, 0.5]], dtype=DOUBLE)
    turn = Rotation.random(random_state=10)
    unit = (world / world.norm(dim=-1, keepdim=True)).numpy()
    noise = np.random.default_rng(11).normal(size=(trials, 3, 3)) * sds.numpy()[:, None]
    body = torch.from_numpy(turn.inv().apply(unit) + noise)
    found = wahba_svd(body, world, sds.square().reciprocal()).quaternion
    truth = torch.from_numpy(turn.as_quat())
    error = UnitQuaternion("left").local(truth.expand(trials, 4), found)
    covariance = attitude_covariance(world, sds)
    assert covariance.shape == (3, 3)
    root = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(root, error.mT, upper=False)
    torch.testing.assert_close(white @ white.mT / trials, torch.eye(3, dtype=DOUBLE), rtol=0, atol=0.05)
    for bad, rule in ((sds * 0, "sds_rad must be positive"), (sds[:2], r"sds_rad must be \(n,\)")):
        with pytest.raises(ValueError, match=rule):
            attitude_covariance(world, bad)
    with pytest.raises(ValueError, match="must not all lie on one line"):
        attitude_covariance(world[:1].expand(3, 3), sds)


def test_a_start_at_rest():
    """Every mean solves Wahba's problem with the vectors' own weights; the factor is that of its covariance."""
    turn = rotations(5, seed=12)
    field = torch.tensor([1.0, 18.0, -40.0], dtype=DOUBLE)
    rng = np.random.default_rng(13)
    accel = torch.from_numpy(turn.inv().apply([0.0, 0.0, 9.81]) + 0.02 * rng.normal(size=(5, 3)))
    mag = torch.from_numpy(turn.inv().apply(field.numpy()) + 0.5 * rng.normal(size=(5, 3)))
    bias = torch.tensor([1e-3, -2e-3, 3e-3], dtype=DOUBLE)
    sds = dict(accel_sd_m_s2=0.02, mag_sd=0.5, gyro_bias_sd_rad_s=1e-3)
    belief = initial_attitude(accel, mag, field, **sds, gyro_bias_rad_s=bias)
    assert belief.space == ATTITUDE_SPACE
    assert belief.mean.shape == (5, 7)
    lengths = torch.stack([accel.norm(dim=-1), mag.norm(dim=-1)], -1)
    noise = torch.tensor([0.02, 0.5], dtype=DOUBLE) / lengths
    world = torch.stack([torch.tensor([0, 0, 1], dtype=DOUBLE), field]).expand(5, 2, 3)
    quaternion, _ = expected(torch.stack([accel, mag], -2), world, noise.square().reciprocal())
    assert apart(belief.mean[:, :4], quaternion).max() < 1e-12
    assert torch.equal(belief.mean[:, 4:], bias.expand(5, 3))
    torch.testing.assert_close(belief.covariance[:, :3, :3], attitude_covariance(world, noise), rtol=1e-10, atol=0)
    torch.testing.assert_close(belief.covariance[:, 3:, 3:], (1e-6 * torch.eye(3, dtype=DOUBLE)).expand(5, 3, 3))
    assert not belief.covariance[:, :3, 3:].any()
    # Tilt comes from gravity alone to 0.02 / 9.81, so errors of attitude are of that size.
    truth = torch.from_numpy(turn.as_quat())
    assert apart(belief.mean[:, :4], truth).max() < 5 * 0.5 / 18
    alone = initial_attitude(accel[0], mag[0], field, **sds)
    assert alone.mean.shape == (7,)
    assert not alone.mean[4:].any()


@pytest.mark.parametrize("mag_sd", [0.5, 50.0, 5000.0])
def test_a_start_in_single_precision_is_that_in_double(mag_sd):
    """A heading that is hardly known beside a tilt that is: deviations to a few roundings."""
    turn = Rotation.random(random_state=15)
    field = torch.tensor([1.0, 18.0, -40.0], dtype=DOUBLE)
    accel, mag = (torch.from_numpy(turn.inv().apply(v)) for v in ([0.0, 0.0, 9.81], field.numpy()))
    sds = dict(accel_sd_m_s2=0.02, mag_sd=mag_sd, gyro_bias_sd_rad_s=1e-3)
    double = initial_attitude(accel, mag, field, **sds)
    single = initial_attitude(accel.float(), mag.float(), field.float(), **sds)
    assert single.mean.dtype == single.scale_tril.dtype == torch.float32
    assert apart(single.mean[:4], double.mean[:4]) < 1e-6
    torch.testing.assert_close(single.scale_tril.double(), double.scale_tril, rtol=2e-6, atol=1e-7 * mag_sd)
    with pytest.raises(ValueError, match=r"mag must have the dtype of accel_m_s2, torch\.float64, got torch\.float32"):
        initial_attitude(accel, mag.float(), field, **sds)


def test_starts_that_are_refused():
    up, field = torch.tensor([0.0, 0.0, 9.8], dtype=DOUBLE), torch.tensor([0.0, 18.0, -40.0], dtype=DOUBLE)
    good = dict(accel_sd_m_s2=0.02, mag_sd=0.5, gyro_bias_sd_rad_s=1e-3)
    for name in good:
        with pytest.raises(ValueError, match=f"{name} must be positive and finite, got 0"):
            initial_attitude(up, field, field, **(good | {name: 0.0}))
    with pytest.raises(ValueError, match=r"mag must be \(\.\.\., 3\)"):
        initial_attitude(up, field[:2], field, **good)
    with pytest.raises(ValueError, match="not zero"):
        initial_attitude(up * 0, field, field, **good)
    with pytest.raises(ValueError, match="one line"):
        initial_attitude(up, up, field, **good)
