"""Attitudes against SciPy's rotations and against what heading, pitch and roll mean."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfilt.models import attitude
from torchfilt.models.attitude import rotations
from torchfilt.spaces import UnitQuaternion

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def unit(*shape, seed=0):
    return UnitQuaternion().project(normal(*shape, 4, seed=seed))


def angles(count=200, seed=1):
    """Headings and rolls all round, pitches up to 89.9 degrees."""
    u = 2 * torch.rand(3, count, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE) - 1
    return torch.pi * u[0], 1.569 * u[1], torch.pi * u[2]


def same(found, expected, size=1.0):
    """Entries of size one after a dozen roundings."""
    np.testing.assert_allclose(np.asarray(found), expected, rtol=0, atol=16 * EPS * size)


A, B, V = unit(50, seed=2), unit(50, seed=3), normal(50, 3, seed=4)


def test_products_and_turns_are_those_of_scipy():
    a, b = Rotation.from_quat(A), Rotation.from_quat(B)
    # Both signs are one attitude; SciPy keeps the sign of the Hamilton product.
    same(attitude.multiply(A, B), (a * b).as_quat(canonical=False))
    same(attitude.inverse(A), A.numpy() * [-1, -1, -1, 1])
    same(attitude.rotate(A, V), a.apply(V), size=4)
    same(attitude.to_matrix(A), a.as_matrix())
    again = attitude.from_matrix(torch.from_numpy(a.as_matrix()))
    same(attitude.to_matrix(again), a.as_matrix())


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-4, 1.0, 3.1])
def test_rotation_vectors_of_any_size(size):
    v = size * V / V.norm(dim=-1, keepdim=True)
    q = attitude.from_rotation_vector(v)
    same(q, Rotation.from_rotvec(v).as_quat(canonical=False))
    for sign in (1, -1):
        np.testing.assert_allclose(attitude.to_rotation_vector(sign * q), v, rtol=1e-13, atol=4 * EPS)


def test_leading_dims_broadcast():
    q, v = A[:3].unsqueeze(1), V[:7]
    turned = attitude.rotate(q, v)
    assert turned.shape == (3, 7, 3)
    same(turned[1, 2], attitude.rotate(A[1], V[2]), size=4)
    assert attitude.rotate(A[0], V).shape == (50, 3) and attitude.rotate(A, V[0]).shape == (50, 3)
    assert torch.equal(attitude.multiply(q, B[:7])[2, 3], attitude.multiply(A[2], B[3]))
    heading = torch.zeros((), dtype=DOUBLE)
    assert attitude.from_euler(heading, V[:, :1], V[:, 1]).shape == (50, 50, 4)


def test_heading_pitch_and_roll_mean_what_they_say():
    heading, pitch, roll = angles()
    q = attitude.from_euler(heading, pitch, roll)
    same(q, Rotation.from_euler("ZXY", torch.stack([-heading, pitch, roll], -1)).as_quat(canonical=False))
    forward = attitude.rotate(q, torch.tensor([0.0, 1.0, 0.0], dtype=DOUBLE))
    level = pitch.cos()
    same(forward, torch.stack([heading.sin() * level, heading.cos() * level, pitch.sin()], -1))
    # Nose to the east, a roll of a right angle: the right side points down and the top to the south.
    q = attitude.from_euler(*torch.tensor([torch.pi / 2, 0.0, torch.pi / 2], dtype=DOUBLE))
    same(attitude.rotate(q, torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE)), [0, 0, -1])
    same(attitude.rotate(q, torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE)), [0, -1, 0])
    zero = torch.zeros((), dtype=DOUBLE)
    same(attitude.from_euler(zero, zero, zero), [0, 0, 0, 1])


def test_euler_angles_and_back():
    given = angles()
    q = attitude.from_euler(*given)
    for sign in (1, -1):
        found = torch.stack(attitude.to_euler(3 * sign * q))  # a norm that is not one does not count
        away = UnitQuaternion().local(q, attitude.from_euler(*found))
        assert away.abs().max() < 16 * EPS
        # Heading and roll are divided by the cosine of the pitch.
        error = (found - torch.stack(given)).abs() * given[1].cos()
        assert error.max() < 16 * EPS


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-8])
def test_near_the_vertical_the_attitude_keeps_its_digits(gap):
    """An arc sine would be off by the root of the rounding (1.5e-8), a heading and roll of their own by 1 / gap eps."""
    pitch = torch.pi / 2 - torch.tensor(gap, dtype=DOUBLE)
    for sign in (1, -1):
        q = attitude.from_euler(torch.tensor(0.4, dtype=DOUBLE), sign * pitch, torch.tensor(-1.1, dtype=DOUBLE))
        found = attitude.to_euler(q)
        assert abs(found[1] - sign * pitch) < 4 * EPS
        assert UnitQuaternion().local(q, attitude.from_euler(*found)).abs().max() < 16 * EPS


def test_skew_is_the_cross_product():
    a, b = normal(20, 3), normal(20, 3, seed=9)
    same((attitude.skew(a) @ b.unsqueeze(-1)).squeeze(-1), np.cross(a, b), size=10)
    assert torch.equal(attitude.skew(a), -attitude.skew(a).mT)


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-3, 3.1e-3, 3.2e-3, 0.5, 2.0, 6.0])
def test_mean_rotation_is_the_mean_of_the_rotations(size):
    """Gauss's quadrature of SciPy's matrices; a series ends at 3.16e-3 rad."""
    v = size * (V / V.norm(dim=-1, keepdim=True))[:10].numpy()
    points, weights = np.polynomial.legendre.leggauss(24)
    turns = [w / 2 * Rotation.from_rotvec((p + 1) / 2 * v).as_matrix() for p, w in zip(points, weights, strict=True)]
    same(attitude.mean_rotation(torch.from_numpy(v)), sum(turns))


def test_mean_rotation_is_the_left_jacobian_of_the_exponential():
    def turned(d):
        return attitude.to_rotation_vector(
            attitude.multiply(attitude.from_rotation_vector(V[0] + d), attitude.from_rotation_vector(-V[0]))
        )

    jacobian = torch.func.jacfwd(turned)(torch.zeros(3, dtype=DOUBLE))
    same(attitude.mean_rotation(V[0]), jacobian, size=4)


def test_attitudes_of_north_east_down():
    """Aircraft convention: yaw about down, pitch about right, roll about forward, in this order (z, y, x)."""
    heading, pitch, roll = angles()
    aircraft = torch.from_numpy(Rotation.from_euler("ZYX", torch.stack([heading, pitch, roll], -1)).as_quat())
    q = attitude.ned_frd_to_enu_rfu(aircraft)
    away = UnitQuaternion().local(attitude.from_euler(heading, pitch, roll), q)
    assert away.abs().max() < 16 * EPS
    assert torch.equal(attitude.ned_frd_to_enu_rfu(q), aircraft)
    # The same vector in both pairs of axes.
    v = normal(200, 3)
    ned = attitude.rotate(aircraft, attitude.swap_rfu_frd(v))
    same(attitude.swap_enu_ned(ned), attitude.rotate(q, v), size=4)
    assert torch.equal(attitude.swap_enu_ned(torch.tensor([1.0, 2.0, 3.0])), torch.tensor([2.0, 1.0, -3.0]))


FUNCTIONS = {
    "multiply": (attitude.multiply, (A[:4], B[:4])),
    "inverse": (attitude.inverse, (A[:4],)),
    "rotate": (attitude.rotate, (A[:4], V[:4])),
    "to_matrix": (attitude.to_matrix, (A[:4],)),
    "from_matrix": (attitude.from_matrix, (attitude.to_matrix(A[:4]),)),
    "from_rotation_vector": (attitude.from_rotation_vector, (V[:4],)),
    "to_rotation_vector": (attitude.to_rotation_vector, (A[:4],)),
    "from_euler": (attitude.from_euler, angles(4)),
    "to_euler": (attitude.to_euler, (A[:4],)),
    "skew": (attitude.skew, (V[:4],)),
    "mean_rotation": (attitude.mean_rotation, (torch.cat([1e-3 * V[:2], V[2:4]]),)),
    "ned_frd_to_enu_rfu": (attitude.ned_frd_to_enu_rfu, (A[:4],)),
    "swap_enu_ned": (attitude.swap_enu_ned, (V[:4],)),
    "swap_rfu_frd": (attitude.swap_rfu_frd, (V[:4],)),
}


def test_every_function_is_in_the_table():
    own = {n: f for n, f in vars(rotations).items() if getattr(f, "__module__", "") == rotations.__name__}
    public = {n for n in own if not n.startswith("_")}
    assert public == set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_vmap_and_single_precision(name):
    function, inputs = FUNCTIONS[name]
    assert torch.autograd.gradcheck(function, [x.clone().requires_grad_() for x in inputs], check_forward_ad=True)
    whole, rows = function(*inputs), torch.vmap(function)(*inputs)
    single = function(*(x.float() for x in inputs))
    pairs = zip(*((v if isinstance(v, tuple) else (v,)) for v in (whole, rows, single)), strict=True)
    for value, mapped, low in pairs:
        torch.testing.assert_close(mapped, value, rtol=0, atol=4 * EPS)
        assert low.dtype == torch.float32
        torch.testing.assert_close(low.double(), value, rtol=0, atol=1e-5)  # eps 1.2e-7, angles up to pi


@pytest.mark.parametrize("name", FUNCTIONS)
def test_one_graph(name):
    function, inputs = FUNCTIONS[name]
    compiled = torch.compile(function, fullgraph=True, backend="eager", dynamic=False)
    torch.testing.assert_close(compiled(*inputs), function(*inputs), rtol=0, atol=0)


def test_nothing_heavy_loads_before_a_rotation_is_made():
    program = "import sys; from torchfilt.models import attitude; from torchfilt.models.inertial import navigation\n"
    program += "print([name for name in ('roma', 'scipy', 'torch._dynamo') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
