"""Spaces: the way there and back, means, and what a space promises to transforms of torch."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import rotations_oracle as oracle

from torchfilt.linalg import is_differentiated
from torchfilt.spaces import (
    Angle,
    Euclidean,
    Product,
    Space,
    UnitQuaternion,
    centred,
    curved_components,
    steady_sum,
    transport,
    weighted_sum,
    wrap_angle,
)

DTYPES = [torch.float64, torch.float32]
SIDES = ["right", "left"]
POSE = Product(Euclidean(2), UnitQuaternion("left"), Angle(2))

seeds = st.integers(0, 2**31)
# Angles at the ends and on the way, and a breath away from the ends.
turns = st.sampled_from([0.0, 1e-300, 1e-12, 1e-7, 1e-3, math.pi - 1e-3, math.pi - 1e-7, math.pi - 1e-14, math.pi])
turns = turns | st.floats(0, math.pi)


def normals(*shape, seed, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def quaternions(*shape, seed, dtype=torch.float64):
    return UnitQuaternion().project(normals(*shape, 4, seed=seed)).to(dtype)


def around(centre, count, spread, seed, side="right"):
    """Rotations at most ``spread`` rad from a centre."""
    vectors = normals(*centre.shape[:-1], count, 3, seed=seed)
    radius = torch.rand(vectors.shape[:-1], generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    vectors = vectors / vectors.norm(dim=-1, keepdim=True) * spread * radius.unsqueeze(-1)
    return UnitQuaternion(side).retract(centre.unsqueeze(-2), vectors)


def weights_of(*shape, seed):
    return torch.softmax(normals(*shape, seed=seed), -1)


def up_to_sign(a, b):
    return torch.minimum((a - b).abs().amax(-1), (a + b).abs().amax(-1))


# Unit quaternions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("side", SIDES)
@given(seed=seeds, turn=turns)
def test_a_rotation_vector_comes_back(dtype, side, seed, turn):
    """To rounding, from the identity to half a turn; at half a turn v and its opposite are the same rotation."""
    space, eps = UnitQuaternion(side), torch.finfo(dtype).eps
    x = quaternions(seed=seed, dtype=dtype)
    axis = normals(3, seed=seed + 1)
    v = (axis / axis.norm() * turn).to(dtype)
    back = space.local(x, space.retract(x, v))
    assert back.dtype == dtype
    error = (back - v).abs().amax()
    if turn > math.pi - 32 * eps:
        error = torch.minimum(error, (back + v).abs().amax())
    assert error <= 16 * eps * max(turn, 1)
    assert back.norm() <= math.pi + 4 * eps


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("turn", [1e-3, 1e-7, 1e-12, 1e-30])
def test_small_turns_about_the_identity_keep_their_relative_precision(dtype, turn):
    space, identity = UnitQuaternion(), torch.tensor([0.0, 0, 0, 1], dtype=dtype)
    v = torch.tensor([0.3, -0.5, 0.8], dtype=dtype) * turn
    back = space.local(identity, space.retract(identity, v))
    torch.testing.assert_close(back, v, rtol=8 * torch.finfo(dtype).eps, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("side", SIDES)
@given(seed=seeds)
def test_a_rotation_is_reached_by_its_local_vector(dtype, side, seed):
    space = UnitQuaternion(side)
    x, y = quaternions(2, seed=seed, dtype=dtype)
    assert up_to_sign(space.retract(x, space.local(x, y)), y) <= 8 * torch.finfo(dtype).eps


@pytest.mark.parametrize("side", SIDES)
@given(seed=seeds, turn=turns)
def test_steps_are_those_of_scipy(side, seed, turn):
    x = quaternions(seed=seed)
    axis = normals(3, seed=seed + 1)
    v = axis / axis.norm() * turn
    ours = UnitQuaternion(side).retract(x, v)
    assert up_to_sign(ours, torch.from_numpy(oracle.retract(x.numpy(), v.numpy(), side))) <= 1e-15
    y = quaternions(seed=seed + 2)
    theirs = torch.from_numpy(oracle.local(x.numpy(), y.numpy(), side))
    torch.testing.assert_close(UnitQuaternion(side).local(x, y), theirs, rtol=0, atol=1e-13)


@pytest.mark.parametrize("side", SIDES)
@given(seed=seeds)
def test_a_quaternion_and_its_opposite_are_one_point(side, seed):
    space = UnitQuaternion(side)
    x, y = quaternions(2, seed=seed)
    v = space.local(x, y)
    assert torch.equal(space.local(-x, y), v)
    assert torch.equal(space.local(x, -y), v)
    assert up_to_sign(space.retract(-x, v), space.retract(x, v)) == 0


@given(seed=seeds)
def test_left_errors_are_right_errors_seen_from_the_world(seed):
    x, y = quaternions(2, seed=seed)
    right, left = UnitQuaternion("right").local(x, y), UnitQuaternion("left").local(x, y)
    turned = torch.from_numpy(oracle.rotate(x.numpy(), right.numpy()))
    torch.testing.assert_close(left, turned, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("side", SIDES)
def test_quaternions_stay_unit(dtype, side):
    """After 2,000 steps; without the projection the norm of float32 walks away (about 1e-6)."""
    space, x = UnitQuaternion(side), quaternions(16, seed=0, dtype=dtype)
    for k in range(2000):
        x = space.retract(x, normals(16, 3, seed=k, dtype=dtype))
    assert (x.double().norm(dim=-1) - 1).abs().max() <= 2 * torch.finfo(dtype).eps


def test_projection_restores_the_norm_and_keeps_the_direction():
    x = quaternions(5, seed=0)
    scaled = x * torch.logspace(-3, 3, 5, dtype=torch.float64)[:, None]
    torch.testing.assert_close(UnitQuaternion().project(scaled), x, rtol=1e-15, atol=1e-15)


def test_the_side_is_checked():
    with pytest.raises(ValueError, match="side must be 'left' or 'right', got 'up'"):
        UnitQuaternion("up")


# Means --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES)
@given(seed=seeds, spread=st.floats(1e-6, 1.5), count=st.integers(1, 12))
def test_quaternion_mean_minimises_the_squared_angles(side, seed, spread, count):
    """Against SciPy's least squares (good to 1e-7), and by the vanishing gradient (to rounding)."""
    points = around(quaternions(seed=seed), count, spread, seed, side)
    weights = weights_of(count, seed=seed + 5)
    mean = UnitQuaternion(side).mean(points, weights)
    assert oracle.distance(mean.numpy(), oracle.mean_by_search(points.numpy(), weights.numpy())) < 1e-7
    pulls = np.stack([oracle.local(mean.numpy(), p, side) for p in points.numpy()])
    assert np.abs(weights.numpy() @ pulls).max() < 1e-14 * max(1, spread) + 2e-15


def test_quaternion_mean_of_float32_is_the_same_to_its_rounding():
    points, weights = around(quaternions(6, seed=1), 9, 1.0, 2), weights_of(6, 9, seed=3)
    exact = UnitQuaternion().mean(points, weights)
    single = UnitQuaternion().mean(points.float(), weights.float())
    assert single.dtype == torch.float32
    assert up_to_sign(single.double(), exact).max() < 16 * torch.finfo(torch.float32).eps


@given(seed=seeds)
def test_quaternion_mean_does_not_know_signs_nor_order(seed):
    space, points = UnitQuaternion(), around(quaternions(seed=seed), 8, 1.2, seed)
    weights = weights_of(8, seed=seed)
    mean = space.mean(points, weights)
    signs = torch.where(normals(8, 1, seed=seed + 1) < 0, -1.0, 1.0).double()
    order = torch.randperm(8, generator=torch.Generator().manual_seed(seed))
    assert up_to_sign(space.mean(points * signs, weights), mean) < 1e-14
    assert up_to_sign(space.mean(points[order], weights[order]), mean) < 1e-14


@pytest.mark.parametrize("side", SIDES)
def test_quaternion_mean_turns_with_the_points(side):
    space, points, weights = UnitQuaternion(side), around(quaternions(seed=1), 8, 1.0, 2), weights_of(8, seed=3)
    turn = oracle.retract([0, 0, 0, 1], [0.4, -2, 1.1], "right")

    def turned(q):
        return torch.from_numpy(oracle.retract(turn, oracle.local([0, 0, 0, 1], q.numpy(), "right"), "right"))

    mean = space.mean(torch.stack([turned(p) for p in points]), weights)
    assert up_to_sign(mean, turned(space.mean(points, weights))) < 1e-14


def test_sigma_points_with_a_large_negative_weight_have_their_centre_as_mean():
    """Weights of an unscented rule with alpha = 1e-3: -1e6 in the middle. Rounding grows by that factor."""
    centre = quaternions(seed=4)
    offsets = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).double() * 1e-3 * math.sqrt(3) * 0.2
    points = UnitQuaternion().retract(centre, offsets)
    outer = 1 / (6 * 1e-6)
    weights = torch.tensor([1 - 6 * outer] + [outer] * 6, dtype=torch.float64)
    assert up_to_sign(UnitQuaternion().mean(points, weights), centre) < 1e-9


def test_an_outlier_without_weight_in_front_does_not_confuse_the_signs():
    """Seen from half a turn away the two points have opposite signs, and their average is the outlier itself."""
    space, centre = UnitQuaternion(), quaternions(seed=0)
    axis = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    points = space.retract(centre, torch.tensor([[math.pi], [0.3], [-0.3]], dtype=torch.float64) * axis)
    mean = space.mean(points, torch.tensor([0, 0.5, 0.5], dtype=torch.float64))
    assert up_to_sign(mean, centre) < 1e-14


def test_opposite_rotations_have_a_mean_half_way():
    """No direction is preferred: any of the minimisers will do, NaN won't."""
    half_turn = torch.tensor([[0.0, 0, 0, 1], [1, 0, 0, 0]], dtype=torch.float64)
    mean = UnitQuaternion().mean(half_turn, torch.tensor([0.5, 0.5], dtype=torch.float64))
    for end in half_turn:
        assert oracle.distance(mean.numpy(), end.numpy()) == pytest.approx(math.pi / 2, abs=1e-14)
    same = torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, -1]], dtype=torch.float64)
    assert up_to_sign(UnitQuaternion().mean(same, torch.tensor([0.5, 0.5], dtype=torch.float64)), same[0]) == 0


def test_a_vanishing_average_starts_from_the_heaviest_point():
    """With weights of both signs the average of quaternions may be zero: the answer and its gradient stay finite."""
    space = UnitQuaternion()
    points = torch.eye(4, dtype=torch.float64)[[3, 3, 0]].requires_grad_()
    weights = torch.tensor([0.75, -0.75, 0.0], dtype=torch.float64)
    mean = space.mean(points, weights)
    assert torch.equal(mean.detach(), points[0].detach())
    mean.sum().backward()
    assert torch.isfinite(points.grad).all()


@given(seed=seeds, count=st.integers(1, 12), centre=st.floats(-math.pi, math.pi), spread=st.floats(0, 1.5))
def test_mean_angle_is_the_best_of_all_cuts(seed, count, centre, spread):
    """Points within half a circle have one minimiser; the circular average only is near it."""
    offsets = (2 * torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1) * spread
    angles = wrap_angle(centre + offsets)
    weights = weights_of(count, seed=seed)
    mean = Angle().mean(angles[:, None], weights)
    expected = oracle.circular_mean(angles.numpy(), weights.numpy())
    assert abs(math.remainder(mean.item() - expected, 2 * math.pi)) < 1e-14


def test_opposite_angles_have_a_mean_half_way():
    ends = torch.tensor([[0.0, 1.0], [math.pi, 1.0 - math.pi]], dtype=torch.float64)
    mean = Angle(2).mean(ends, torch.tensor([0.5, 0.5], dtype=torch.float64))
    arcs = Angle(2).local(mean, ends).abs()
    torch.testing.assert_close(arcs, torch.full_like(arcs, math.pi / 2))


def test_angles_that_cancel_have_a_mean_near_the_first():
    """On a cross four minimisers are as good; wherever it stands, rounding has no say: the first angle has."""
    turned = torch.linspace(-3, 3, 37, dtype=torch.float64)
    cross = turned[:, None, None] + torch.tensor([[0.0], [1], [2], [-1]], dtype=torch.float64) * math.pi / 2
    cross = wrap_angle(cross).requires_grad_()
    mean = Angle().mean(cross, torch.full((37, 4), 0.25, dtype=torch.float64))
    away = wrap_angle(mean.detach()[:, 0] - turned).abs()
    torch.testing.assert_close(away, torch.full_like(away, math.pi / 4))
    mean.sum().backward()
    torch.testing.assert_close(cross.grad, torch.full_like(cross, 0.25))


@pytest.mark.parametrize("space", [Angle(2), UnitQuaternion(), UnitQuaternion("left")])
def test_rows_do_not_influence_each_other(space):
    """A wide row needs more rounds than its neighbours, a NaN row none: the others keep their bits."""
    spreads = torch.tensor([1e-3, 2.5, 0.5], dtype=torch.float64)
    if isinstance(space, Angle):
        points = normals(3, 7, 2, seed=0) * spreads[:, None, None]
    else:
        points = torch.stack([around(quaternions(seed=9), 7, s, 3) for s in spreads.tolist()])
    points = torch.cat([points, torch.full_like(points[:1], torch.nan)])
    weights = weights_of(4, 7, seed=1)
    together = space.mean(points, weights)
    assert together[3].isnan().all()
    for row in range(3):
        assert torch.equal(together[row], space.mean(points[row], weights[row]))


def test_euclidean_mean_is_the_weighted_sum():
    points, weights = normals(3, 5, 2, seed=0), weights_of(3, 5, seed=1)
    expected = np.einsum("bn,bnd->bd", weights.numpy(), points.numpy())
    np.testing.assert_allclose(Euclidean(2).mean(points, weights), expected, rtol=0, atol=1e-15)


# Angles -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@given(x=st.floats(-1e4, 1e4, width=32))
def test_wrapped_angles_are_those_of_the_ieee_remainder(dtype, x):
    eps = torch.finfo(dtype).eps
    wrapped = wrap_angle(torch.tensor(x, dtype=dtype)).item()
    assert abs(wrapped) <= math.pi + 2 * eps * max(abs(x), math.pi)
    error = math.remainder(wrapped - math.remainder(x, 2 * math.pi), 2 * math.pi)
    assert abs(error) <= 2 * eps * max(abs(x), math.pi)


@pytest.mark.parametrize("dtype", DTYPES)
def test_angles_inside_are_kept_to_the_bit(dtype):
    pi = torch.tensor(math.pi, dtype=dtype)
    inside = torch.cat([torch.linspace(-3.14, 3.14, 101, dtype=dtype), torch.stack([pi, -pi])])
    assert torch.equal(wrap_angle(inside), inside)
    outside = torch.tensor([3.15, -3.15], dtype=dtype)
    torch.testing.assert_close(wrap_angle(outside), outside - outside.sign() * 2 * math.pi)


def test_differences_across_the_cut_are_short():
    x, y = torch.tensor([3.1], dtype=torch.float64), torch.tensor([-3.1], dtype=torch.float64)
    torch.testing.assert_close(Angle().local(x, y), torch.tensor([2 * math.pi - 6.2], dtype=torch.float64))
    torch.testing.assert_close(Angle().retract(x, Angle().local(x, y)), y)
    torch.testing.assert_close(Angle().project(y - 2 * math.pi), y)


@given(seed=seeds)
def test_angles_come_back(seed):
    x, y = wrap_angle(10 * normals(2, 6, seed=seed))
    space = Angle(6)
    assert space.local(space.retract(x, space.local(x, y)), y).abs().max() < 4e-15


# Products and what all spaces share -----------------------------------------------------------------------------------


def test_a_product_is_its_parts_side_by_side():
    assert (POSE.size, POSE.tangent_size) == (8, 7)
    x = torch.cat([normals(4, 2, seed=0), quaternions(4, seed=1), normals(4, 2, seed=2)], -1)
    v = normals(4, 7, seed=3)
    turn, angle = UnitQuaternion("left"), Angle(2)
    y = POSE.retract(x, v)
    parts = [x[:, :2] + v[:, :2], turn.retract(x[:, 2:6], v[:, 2:5]), angle.retract(x[:, 6:], v[:, 5:])]
    assert torch.equal(y, torch.cat(parts, -1))
    parts = [y[:, :2] - x[:, :2], turn.local(x[:, 2:6], y[:, 2:6]), angle.local(x[:, 6:], y[:, 6:])]
    assert torch.equal(POSE.local(x, y), torch.cat(parts, -1))
    weights = weights_of(4, seed=5)
    parts = [weighted_sum(x[:, :2], weights), turn.mean(x[:, 2:6], weights), angle.mean(x[:, 6:], weights)]
    assert torch.equal(POSE.mean(x, weights), torch.cat(parts, -1))
    parts = [x[:, :2] * 2, turn.project(x[:, 2:6] * 2), angle.project(x[:, 6:] * 2)]
    assert torch.equal(POSE.project(x * 2), torch.cat(parts, -1))


def test_missing_components_of_a_product():
    y = torch.tensor([[1.0, torch.nan, 0, 0, 0, 1, torch.nan, 2], [1, 2, torch.nan, 0, 0, 1, 1, 2]])
    expected = [[True, False, True, True, True, False, True], [True, True, False, False, False, True, True]]
    assert POSE.observed(y).tolist() == expected
    assert Euclidean().observed(y[0]).tolist() == (~torch.isnan(y[0])).tolist()


def test_products_are_compared_by_their_parts():
    assert Product(Euclidean(2), Angle()) == Product(Euclidean(2), Angle(1))
    assert hash(Product(Euclidean(2), Angle())) == hash(Product(Euclidean(2), Angle(1)))
    assert Product(Euclidean(2), Angle()) != Product(Angle(), Euclidean(2))
    assert repr(Product(Euclidean(2))) == "Product(Euclidean(size=2))"


def test_a_product_needs_parts_with_a_size():
    with pytest.raises(ValueError, match=r"must state its size, got Euclidean\(size=None\)"):
        Product(Euclidean(), Angle())
    with pytest.raises(ValueError, match="at least one space"):
        Product()


def rotations(*shape, seed):
    return around(quaternions(seed=8).expand(*shape[:-1], 4), shape[-1], 1.0, seed)


SPACES = [
    (Euclidean(3), lambda *shape, seed: normals(*shape, 3, seed=seed)),
    (Angle(2), lambda *shape, seed: 0.4 * normals(*shape, 2, seed=seed) + 3),
    (UnitQuaternion(), rotations),
    (UnitQuaternion("left"), rotations),
    (
        Product(Euclidean(1), UnitQuaternion()),
        lambda *s, seed: torch.cat([normals(*s, 1, seed=seed), rotations(*s, seed=seed)], -1),
    ),
]
spaces = pytest.mark.parametrize(("space", "draw"), SPACES, ids=[repr(s[0]) for s in SPACES])


@spaces
def test_a_space_is_what_filters_ask_for(space, draw):
    assert isinstance(space, Space)
    assert draw(2, seed=0).shape == (2, space.size)
    x, y = draw(2, seed=0)
    v = space.local(x, y)
    assert v.shape == (space.tangent_size,)
    assert space.observed(y).shape == (space.tangent_size,)
    torch.testing.assert_close(space.local(x, space.retract(x, v)), v, rtol=0, atol=1e-14)
    torch.testing.assert_close(space.local(x, x), torch.zeros_like(v), rtol=0, atol=1e-15)


@spaces
def test_leading_dims_broadcast(space, draw):
    x, v = draw(3, seed=0), 0.1 * normals(5, 1, space.tangent_size, seed=1)
    y = space.retract(x, v)
    assert y.shape == (5, 3, space.size)
    assert torch.equal(y[4, 2], space.retract(x[2], v[4, 0]))
    assert torch.equal(space.local(x, y)[4, 2], space.local(x[2], y[4, 2]))


@spaces
@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.7, 3.0])
def test_derivatives_of_the_way_there_and_back(space, draw, turn):
    """Central differences of float64 are good to 1e-6; at and near the zero vector as well."""
    x = draw(2, seed=0)[0].requires_grad_()
    v = torch.full((space.tangent_size,), turn / math.sqrt(space.tangent_size), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(space.retract, (x, v))
    end = space.retract(x, v).detach().requires_grad_()
    if turn < 3.0:  # central differences of the rotations near half a turn would step over the cut
        assert torch.autograd.gradcheck(lambda a, b: space.local(space.project(a), space.project(b)), (x, end))


@spaces
@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.05, 0.0999, 0.1001, 0.7, 3.0])
@pytest.mark.parametrize("dtype", DTYPES)
def test_errors_seen_from_another_point(space, draw, turn, dtype):
    """Against the derivative of the two charts in float64; the series and the closed form meet at 0.1 rad."""
    x = draw(2, seed=0)[0]
    v = turn * torch.nn.functional.normalize(normals(space.tangent_size, seed=2), dim=0)
    there = space.retract(x, v)
    exact = torch.func.jacfwd(lambda e: space.local(there, space.retract(x, v + e)))(torch.zeros_like(v))
    columns = normals(space.tangent_size, 4, seed=3)
    carried = space.carry(v.to(dtype), columns.to(dtype))
    assert carried.dtype == dtype
    # 1 - cos a and a - sin a lose what a is below a turn: 1e3 roundings at most.
    limit = 1e3 * torch.finfo(dtype).eps
    torch.testing.assert_close(carried.double(), exact @ columns, rtol=0, atol=limit)
    back = space.carry_back(v.to(dtype), columns.to(dtype))
    assert back.dtype == dtype
    torch.testing.assert_close(back.double(), torch.linalg.solve(exact, columns), rtol=0, atol=limit)


@spaces
def test_a_factor_is_transported_as_its_covariance(space, draw):
    e = space.tangent_size
    v = 0.5 * normals(3, e, seed=4)
    factor = torch.linalg.cholesky(torch.eye(e, dtype=torch.float64) + 0.5)
    moved = transport(space, v, factor)
    jacobian = space.carry(v, torch.eye(e, dtype=torch.float64))
    torch.testing.assert_close(
        moved @ moved.mT, (jacobian @ factor @ factor.mT @ jacobian.mT).expand_as(moved @ moved.mT)
    )
    assert torch.equal(moved, moved.tril())
    changed = set((jacobian - torch.eye(e)).abs().amax(-1).nonzero()[:, -1].tolist()) if jacobian.dim() > 2 else set()
    assert changed == set(curved_components(space, e))


@spaces
@pytest.mark.parametrize("symmetric", [False, True])
def test_derivatives_of_the_mean(space, draw, symmetric):
    """A symmetric set starts at its mean: the value needs no rounds, the derivative does."""
    if symmetric:
        v = 0.5 * torch.cat([torch.eye(space.tangent_size), -torch.eye(space.tangent_size)]).double()
        points, weights = space.retract(draw(1, seed=0)[0], v), torch.full((len(v),), 1 / len(v), dtype=torch.float64)
    else:
        points, weights = draw(5, seed=0), weights_of(5, seed=1)

    def mean(p, w):
        return space.mean(space.project(p), w / w.sum())

    assert torch.autograd.gradcheck(mean, (points.requires_grad_(), weights.requires_grad_()))
    points, weights = points.detach(), weights.detach()
    forward = torch.func.jacfwd(mean)(points, weights)
    torch.testing.assert_close(forward, torch.func.jacrev(mean)(points, weights), rtol=0, atol=1e-12)
    tangent = normals(*points.shape, seed=4)
    along = torch.func.jvp(lambda p: mean(p, weights), (points,), (tangent,))[1]
    torch.testing.assert_close(along, torch.einsum("and,nd->a", forward, tangent), rtol=0, atol=1e-12)


@spaces
@pytest.mark.parametrize("gradients", [False, True])
def test_mean_and_errors_in_one_are_the_two(space, draw, gradients):
    points, weights = draw(3, 7, seed=0).requires_grad_(gradients), weights_of(3, 7, seed=1)
    mean, errors = centred(space, points, weights)
    assert torch.equal(mean, space.mean(points, weights))
    assert torch.equal(errors, space.local(mean.unsqueeze(-2), points))
    if gradients:
        ours = torch.autograd.grad(errors.sum(), points, retain_graph=True)
        theirs = torch.autograd.grad(space.local(space.mean(points, weights).unsqueeze(-2), points).sum(), points)
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-14)


class Shifted(Euclidean):
    """A space of a user, with no more than a space must have."""


def test_errors_on_a_space_that_only_has_a_mean():
    points, weights = normals(5, 2, seed=0), weights_of(5, seed=1)
    mean, errors = centred(Shifted(2), points, weights)
    assert torch.equal(mean, weighted_sum(points, weights)) and torch.equal(errors, points - mean)


def test_products_lie_component_by_component():
    """What follows works on components; a row of eight numbers a particle would cost several times as much."""
    x, v = torch.cat([normals(4, 2, seed=0), quaternions(4, seed=1), normals(4, 2, seed=2)], -1), normals(4, 7, seed=3)
    y = POSE.retract(x, v)
    assert y.stride() == POSE.local(x, y).stride() == POSE.project(x).stride() == (1, 4)


@spaces
def test_values_are_the_same_with_and_without_gradients(space, draw):
    points, weights = draw(2, 5, seed=0), weights_of(2, 5, seed=1)
    assert torch.equal(space.mean(points, weights), space.mean(points.clone().requires_grad_(), weights).detach())


@spaces
def test_vmap_gives_what_leading_dims_give(space, draw):
    x, y = draw(2, 3, seed=0)
    v = 0.1 * normals(3, space.tangent_size, seed=2)
    points, weights = draw(3, 5, seed=3), weights_of(3, 5, seed=4)
    torch.testing.assert_close(torch.vmap(space.retract)(x, v), space.retract(x, v), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.vmap(space.local)(x, y), space.local(x, y), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.vmap(space.mean)(points, weights), space.mean(points, weights), rtol=0, atol=1e-15)


@spaces
def test_one_graph_gives_what_eager_gives(space, draw):
    x, v = draw(3, seed=0), 0.1 * normals(3, space.tangent_size, seed=2)

    def there_and_back(x, v):
        y = space.retract(x, v)
        return space.local(x, y), space.project(y)

    torch.compiler.reset()
    compiled = torch.compile(there_and_back, fullgraph=True, backend="aot_eager")
    for ours, eager in zip(compiled(x, v), there_and_back(x, v), strict=True):
        torch.testing.assert_close(ours, eager, rtol=0, atol=2e-15)


@pytest.mark.parametrize(
    ("space", "draw"),
    [SPACES[1], pytest.param(*SPACES[2], marks=pytest.mark.slow), pytest.param(*SPACES[4], marks=pytest.mark.slow)],
)
def test_one_graph_of_the_mean(space, draw):
    """All rounds are unrolled: a graph of a thousand operations for a rotation."""
    points, weights = draw(2, 5, seed=3), weights_of(2, 5, seed=4)
    torch.compiler.reset()
    compiled = torch.compile(space.mean, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(points, weights), space.mean(points, weights), rtol=0, atol=2e-15)


# Sums ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(50_001, 1), (50_001, 3), (2, 50_001, 1)])
def test_sums_do_not_depend_on_the_threads(shape):
    """torch splits a lone sum of more than 32,768 numbers between its threads, and then rounds it in another order."""
    values, weights = normals(*shape, seed=0), weights_of(*shape[:-1], seed=1)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(weighted_sum(values, weights))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(r, results[0]) for r in results)
    expected = np.einsum("...n,...nd->...d", weights.numpy(), values.numpy())
    np.testing.assert_allclose(results[0], expected, rtol=0, atol=1e-15)


def test_a_sum_counts_its_dim_from_the_end():
    values = torch.arange(6.0).view(1, 6, 1)
    assert torch.equal(steady_sum(values, -2), torch.tensor([[15.0]]))
    assert torch.equal(steady_sum(torch.arange(6.0).view(2, 3), -2), torch.tensor([3.0, 5.0, 7.0]))


def test_derivatives_are_noticed_in_both_modes():
    x = torch.ones(2)
    seen = []

    def look(x):
        seen.append(is_differentiated(x))
        return x

    look(x)
    look(x.clone().requires_grad_())
    with torch.no_grad():
        look(x.clone().requires_grad_())
    torch.func.jvp(look, (x,), (x,))
    torch.func.vjp(look, x)
    torch.vmap(look)(x)
    assert seen == [False, True, False, True, True, False]


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_norm_of_a_measured_quaternion_does_not_count(side: str) -> None:
    space = UnitQuaternion(side)
    x = space.project(torch.tensor([0.1, -0.2, 0.3, 0.9], dtype=torch.float64))
    y = space.project(torch.tensor([0.3, 0.2, -0.1, 0.8], dtype=torch.float64))
    torch.testing.assert_close(space.local(x, 1.7 * y), space.local(x, y), rtol=1e-14, atol=1e-15)
