"""Gravity of spherical harmonics: against Legendre functions, Laplace's equation and the closed form of J2."""

import numpy as np
import pytest
import torch
from oracles import potential_oracle as oracle

from torchfilt.missions.grace.potential import coefficient_degrees, gradient_basis, kaula_deviation
from torchfilt.models.relative_motion.gravity import EARTH_RADIUS_M, J2_EARTH, Field, j2_acceleration

MU = 3.986004415e14


def places(count, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    radius = 6.6e6 + 1e6 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return (radius * direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)).to(dtype)


def columns(degree):
    """(l, m, is sine) of each column."""
    for l in range(2, degree + 1):
        yield from ((l, m, False) for m in range(l + 1))
        yield from ((l, m, True) for m in range(1, l + 1))


def test_equals_gradients_of_legendre_functions():
    positions, degree = places(3), 13
    basis = gradient_basis(positions, degree, MU)
    names = list(columns(degree))
    assert basis.shape == (3, 3, len(names)) and len(coefficient_degrees(degree)) == len(names)
    assert coefficient_degrees(degree).tolist() == [l for l, _, _ in names]
    for k, (l, m, sine) in enumerate(names):
        for row, position in enumerate(positions.numpy()):
            expected = oracle.gradient(position, l, m, sine, MU, EARTH_RADIUS_M)
            # Differences: truncation (l step / r)^6 / 140, rounding 2 eps r / (l step) of the potential.
            size = MU / EARTH_RADIUS_M**2 * (l + 1)
            np.testing.assert_allclose(basis[row, :, k], expected, rtol=0, atol=1e-10 * size)


@pytest.mark.parametrize("degree", [2, 20, 60])
def test_field_has_no_divergence_and_no_curl(degree):
    """Harmonic and conservative, at degrees that differences cannot reach."""
    position = places(1)
    jacobian = torch.func.jacfwd(lambda p: gradient_basis(p, degree, MU)[0])(position)[..., 0, :]
    jacobian = jacobian.movedim(1, 0)  # (W, 3, 3)
    size = torch.linalg.matrix_norm(jacobian)
    assert (size > 0).all()
    trace = jacobian.diagonal(dim1=-2, dim2=-1).sum(-1)
    skew = torch.linalg.matrix_norm(jacobian - jacobian.mT)
    # Recursions of `degree` steps.
    tolerance = 50 * degree * torch.finfo(torch.float64).eps
    assert (trace.abs() / size).max() < tolerance
    assert (skew / size).max() < tolerance


def test_second_zonal_is_the_flattening():
    positions = places(5)
    expected = j2_acceleration(positions, Field(MU, J2_EARTH, EARTH_RADIUS_M))
    c20 = gradient_basis(positions, 4, MU)[..., 0]
    torch.testing.assert_close(-J2_EARTH / 5**0.5 * c20, expected, rtol=1e-13, atol=0)


def test_average_over_the_sphere_does_not_depend_on_the_order():
    """Addition theorem: sum over m of Y^2 is 2 l + 1, so radial parts give (l + 1)^2 and the others l (l + 1) of it."""
    positions, degree = places(6), 36
    square = gradient_basis(positions, degree, MU).square().sum(1)
    degrees = coefficient_degrees(degree)
    radius = torch.linalg.vector_norm(positions, dim=-1)
    for l in (2, 17, 36):
        expected = (l + 1) * (2 * l + 1) ** 2 * (MU / radius**2) ** 2 * (EARTH_RADIUS_M / radius) ** (2 * l)
        torch.testing.assert_close(square[:, degrees == l].sum(-1), expected, rtol=1e-12, atol=0)


def test_single_precision_is_kept():
    basis = gradient_basis(places(2, torch.float32), 8, MU)
    assert basis.dtype == torch.float32
    double = gradient_basis(places(2), 8, MU)
    assert (basis - double).abs().max() < 1e-5 * double.abs().max()


def test_kaula_and_range_of_degrees():
    assert kaula_deviation(3)[-1].item() == pytest.approx(1e-5 / 9)
    for degree in (1, 81):
        with pytest.raises(ValueError, match=f"degree must be from 2 to 80, got {degree}"):
            gradient_basis(places(1), degree, MU)
