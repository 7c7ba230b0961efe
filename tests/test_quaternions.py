"""Quaternions by components against SciPy, RoMa and 40 digits of mpmath."""

import mpmath
import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation

from torchfilt import quaternions
from torchfilt.quaternions import Quaternion, quaternion, stack, vector

DTYPES = [torch.float64, torch.float32]
# From no turn at all to a breath before half a turn, and the sizes where the length drowns in what is added to it.
ANGLES = [0.0, 1e-300, 1e-30, 1e-12, 1e-9, 1e-8, 3e-8, 1e-7, 1e-4, 1e-3, 0.1, 1.0, 3.0, 3.1415]


def normal(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def turns(angle, count=20, dtype=torch.float64):
    v = normal(count, 3, seed=1)
    return (v / v.norm(dim=-1, keepdim=True) * angle).to(dtype)


def test_the_same_as_scipy():
    """Entries of size one after a dozen roundings."""
    a, b, v = (normal(50, n, seed=n) for n in (4, 5, 3))
    a, b = (q / q.norm(dim=-1, keepdim=True) for q in (a, b[:, :4]))
    one, two = (Rotation.from_quat(q.numpy()) for q in (a, b))
    p, q, w = quaternion(a), quaternion(b), vector(v.unbind(-1))
    limit = {"rtol": 0, "atol": 4e-15}
    np.testing.assert_allclose(stack(quaternions.rotate(p, w)), one.apply(v), **limit)
    np.testing.assert_allclose(stack(quaternions.rotate_back(p, w)), one.inv().apply(v), **limit)
    product = Rotation.from_quat(stack(quaternions.product(p, q).parts()).numpy())
    assert (product * (one * two).inv()).magnitude().max() < 4e-15
    np.testing.assert_allclose(stack(quaternions.cross(w, w[::-1])), np.cross(v, v.flip(-1)), **limit)
    np.testing.assert_allclose(stack(quaternions.minus(w, w[::-1])), v - v.flip(-1), rtol=0, atol=0)
    matrix = normal(50, 9, seed=9)
    found = stack(quaternions.apply(matrix.unbind(-1), w))
    np.testing.assert_allclose(found, np.einsum("nij,nj->ni", matrix.unflatten(-1, (3, 3)), v), rtol=0, atol=1e-14)


def test_the_order_and_the_product_are_romas():
    a, b = normal(2, 50, 4, seed=2)
    found = stack(quaternions.product(quaternion(a), quaternion(b)).parts())
    torch.testing.assert_close(found, roma.quat_product(a, b), rtol=0, atol=1e-14)
    turned = stack(quaternions.conjugate(quaternion(a)).parts())
    assert torch.equal(turned, roma.quat_conjugation(a))
    v = normal(50, 3, seed=3)
    there = stack(quaternions.exponential(vector(v.unbind(-1))).parts())
    torch.testing.assert_close(there, roma.rotvec_to_unitquat(v), rtol=0, atol=1e-15)
    back = stack(quaternions.logarithm(quaternion(there)))
    torch.testing.assert_close(back, roma.unitquat_to_rotvec(there), rtol=0, atol=4e-15)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_are_exact_at_every_size(dtype, angle):
    """Each component to a few roundings of itself, but for the cosine near its zero. In float32 1e-300 is zero."""
    v = turns(angle, dtype=dtype)
    q = stack(quaternions.exponential(vector(v.unbind(-1))).parts())
    back = stack(quaternions.logarithm(quaternion(q)))
    assert q.dtype == back.dtype == dtype
    limit = 4 * torch.finfo(dtype).eps
    with mpmath.workdps(40):
        for given, found, returned in zip(v.tolist(), q.tolist(), back.tolist(), strict=True):
            half = mpmath.sqrt(sum(mpmath.mpf(x) ** 2 for x in given)) / 2
            scale = mpmath.sin(half) / half / 2 if half else mpmath.mpf(1) / 2
            expected = [*(scale * x for x in given), mpmath.cos(half)]
            np.testing.assert_allclose(found, [float(x) for x in expected], rtol=limit, atol=limit * (angle >= 3))
            length = mpmath.sqrt(sum(mpmath.mpf(x) ** 2 for x in found[:3]))
            scale = 2 * mpmath.atan2(length, found[3]) / length if length else 2 / mpmath.mpf(found[3])
            np.testing.assert_allclose(returned, [float(scale * x) for x in found[:3]], rtol=limit, atol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, 3.0])
def test_a_share_of_a_turn(angle):
    v = turns(angle)
    third = quaternions.exponential(vector(v.unbind(-1)), 1 / 3)
    whole = quaternions.product(third, quaternions.product(third, third))
    expected = quaternions.exponential(vector(v.unbind(-1)))
    torch.testing.assert_close(stack(whole.parts()), stack(expected.parts()), rtol=0, atol=1e-15)


def test_a_logarithm_knows_neither_sign_nor_norm():
    q = normal(50, 4, seed=6)
    expected = stack(quaternions.logarithm(quaternion(q)))
    assert torch.equal(stack(quaternions.logarithm(quaternion(-q))), expected)
    torch.testing.assert_close(stack(quaternions.logarithm(quaternion(1e-9 * q))), expected, rtol=1e-14, atol=0)
    assert expected.norm(dim=-1).max() <= torch.pi
    half_turn = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    found = stack(quaternions.logarithm(quaternion(half_turn)))
    assert found.tolist() == [0, 0, pytest.approx(np.pi, rel=1e-15)]


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-3, 2.0])
def test_derivatives_are_romas(angle):
    """Those of RoMa after a projection, which a logarithm of any norm has built in. There and back is the identity: it
    has no second ones; what is left near zero is rounding / 1e-8.
    """

    def there(v):
        return stack(quaternions.exponential(vector(v.unbind(-1))).parts())

    def back(q):
        return stack(quaternions.logarithm(quaternion(q)))

    v = turns(angle, 1)[0]
    q = there(v)
    first = torch.func.jacrev(there)(v), torch.func.jacrev(back)(q)
    unit = torch.func.jacrev(lambda q: roma.unitquat_to_rotvec(q / q.norm()))(q)
    expected = torch.func.jacrev(roma.rotvec_to_unitquat)(v), unit
    for ours, theirs in zip(first, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-14)
    assert torch.autograd.gradcheck(there, v.requires_grad_())
    assert torch.autograd.gradcheck(back, q.detach().requires_grad_())
    second = torch.func.hessian(lambda v: back(there(v)).sum())(v.detach())
    assert second.abs().max() < 1e-7


def test_a_half_turn_has_derivatives():
    q = torch.tensor([0.6, 0, 0.8, 0.0], dtype=torch.float64)
    ours = torch.func.jacrev(lambda q: stack(quaternions.logarithm(quaternion(q))))(q)
    torch.testing.assert_close(ours[:, 3], -2 * q[:3])


def test_components_lie_flat():
    q = quaternion(normal(7, 5, 4))
    assert stack(q.parts()).stride() == (5, 1, 35)
    mixed = stack([torch.zeros(5), torch.ones(7, 1)])
    assert mixed.shape == (7, 5, 2)
    assert Quaternion(q.axis, q.scalar).parts()[3] is q.scalar
