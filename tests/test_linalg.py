"""Factors: triangularisation, downdate, semidefinite factors, products and solutions in every shape."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from torchfilt.linalg import (
    apply_factor,
    cholesky_downdate,
    log_abs_diagonal,
    matrix_exp,
    psd_factor,
    triangularize,
    whiten,
)

DTYPES = [torch.float64, torch.float32]
seeds = st.integers(0, 2**31)


def normals(*shape, seed, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def factors(*shape, seed, dtype=torch.float64):
    """Lower triangles with a condition number of some tens."""
    lower = 0.4 * normals(*shape, shape[-1], seed=seed).tril(-1)
    diagonal = 0.5 + torch.rand(*shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    return (lower + torch.diag_embed(diagonal)).to(dtype)


# Triangularisation --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=seeds, size=st.integers(1, 7), extra=st.integers(0, 8), spread=st.floats(0, 4))
def test_triangular_factor_of_a_product(dtype, seed, size, extra, spread):
    """Equal to numpy's Cholesky factor times the condition of the product; rows may differ by orders of magnitude."""
    scale = torch.logspace(-spread / 2, spread / 2, size, dtype=torch.float64).unsqueeze(-1)
    columns = normals(3, size, size + extra, seed=seed) * scale
    factor = triangularize(columns.to(dtype))
    assert factor.dtype == dtype
    assert (factor == factor.tril()).all()
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()
    single = columns.to(dtype).double().numpy()
    product = single @ single.mT
    # Row by row: the rounding of a row is in proportion to its own length.
    length = np.sqrt(np.diagonal(product, axis1=-2, axis2=-1))
    error = np.abs(factor.double().numpy() @ factor.double().mT.numpy() - product)
    assert (error <= 16 * (size + extra) * torch.finfo(dtype).eps * length[:, :, None] * length[:, None, :]).all()


@given(seed=seeds)
def test_triangular_factor_is_numpys_cholesky(seed):
    columns = normals(4, 9, seed=seed)
    product = columns.numpy() @ columns.numpy().T
    tolerance = 8 * np.finfo(float).eps * np.linalg.cond(product)
    np.testing.assert_allclose(triangularize(columns), np.linalg.cholesky(product), rtol=0, atol=tolerance * 4)


def test_dependent_rows_have_a_factor_all_the_same():
    """A zero row, a repeated row and no noise at all: the product is right, though Cholesky would refuse."""
    columns = normals(4, 6, seed=0)
    columns[1] = 0
    columns[3] = 2 * columns[0]
    stack = torch.stack([columns, torch.zeros(4, 6, dtype=torch.float64)])
    factor = triangularize(stack)
    torch.testing.assert_close(factor @ factor.mT, stack @ stack.mT, rtol=0, atol=1e-14)
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()
    assert (factor == factor.tril()).all()


def test_derivatives_of_the_triangular_factor():
    columns = normals(2, 3, 5, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(triangularize, (columns,))
    assert torch.autograd.gradgradcheck(triangularize, (columns,))
    point, along = columns.detach(), normals(2, 3, 5, seed=2)
    _, tangent = torch.func.jvp(triangularize, (point,), (along,))
    # d(L L') = d(A A')
    factor = triangularize(point)
    left = tangent @ factor.mT + factor @ tangent.mT
    torch.testing.assert_close(left, along @ point.mT + point @ along.mT, rtol=0, atol=1e-13)


def test_a_factor_without_derivative_says_so_by_a_number_that_is_not_finite():
    columns = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    triangularize(columns).sum().backward()
    assert not torch.isfinite(columns.grad).any()


def test_values_are_the_same_with_and_without_gradients():
    columns = normals(5, 4, 7, seed=3)
    torch.testing.assert_close(
        triangularize(columns.clone().requires_grad_()), triangularize(columns), rtol=0, atol=1e-14
    )


def test_triangular_factors_under_vmap_and_compile():
    columns = normals(5, 3, 7, seed=3)
    expected = triangularize(columns)
    torch.testing.assert_close(torch.vmap(triangularize)(columns), expected, rtol=0, atol=1e-15)
    nested = torch.vmap(torch.vmap(triangularize))(columns.expand(2, *columns.shape))
    torch.testing.assert_close(nested[1], expected, rtol=0, atol=1e-14)
    jacobians = torch.vmap(torch.func.jacfwd(triangularize))(columns)
    torch.testing.assert_close(jacobians, torch.vmap(torch.func.jacrev(triangularize))(columns), rtol=0, atol=1e-12)
    torch.compiler.reset()
    compiled = torch.compile(triangularize, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(columns), expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(compiled(columns.clone().requires_grad_()), expected, rtol=0, atol=1e-14)


def test_rows_of_a_batch_are_factored_alone():
    columns = normals(3, 4, 6, seed=5)
    together = triangularize(torch.cat([columns, torch.full((1, 4, 6), torch.nan, dtype=torch.float64)]))
    for row in range(3):
        assert torch.equal(together[row], triangularize(columns[row]))
    assert together[3].isnan().any()


def test_too_few_columns_are_refused():
    with pytest.raises(ValueError, match=r"k >= e, got shape \(2, 4, 3\)"):
        triangularize(torch.ones(2, 4, 3))


# Downdate -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=seeds, size=st.integers(1, 7), share=st.floats(0, 0.95))
def test_downdate_is_the_factor_of_the_difference(dtype, seed, size, share):
    """The vector takes a given share of the variance in its direction; conditioning grows as 1 / (1 - share^2)."""
    factor = factors(3, size, seed=seed, dtype=dtype)
    direction = normals(3, size, seed=seed + 2, dtype=dtype)
    vector = (factor @ (share * direction / direction.norm(dim=-1, keepdim=True)).unsqueeze(-1)).squeeze(-1)
    down = cholesky_downdate(factor, vector)
    f, v = factor.double().numpy(), vector.double().numpy()
    expected = np.linalg.cholesky(f @ f.mT - v[:, :, None] * v[:, None, :])
    condition = np.linalg.cond(f).max() ** 2 / (1 - share**2)
    np.testing.assert_allclose(down, expected, rtol=0, atol=8 * size * torch.finfo(dtype).eps * condition)
    assert down.dtype == dtype


def test_a_difference_that_is_not_definite_is_nan_in_its_row_only():
    factor = factors(4, 3, seed=0)
    vector = 0.1 * normals(4, 3, seed=1)
    vector[1] = 10 * factor[1, :, 2]  # takes away more than there is, and only the last pivot notices
    vector[3] = factor[3, :, 0]  # takes away exactly all there is
    down = cholesky_downdate(factor, vector)
    assert down[1].isnan().all()
    assert down[3].isnan().all()
    assert torch.isfinite(down[[0, 2]]).all()
    assert torch.equal(down[0], cholesky_downdate(factor[0], vector[0]))


def test_downdates_under_vmap_and_compile():
    factor, vector = factors(3, 3, seed=2), 0.2 * normals(3, 3, seed=3)
    expected = cholesky_downdate(factor, vector)
    assert torch.equal(torch.vmap(cholesky_downdate)(factor, vector), expected)
    torch.compiler.reset()
    compiled = torch.compile(cholesky_downdate, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(factor, vector), expected, rtol=0, atol=1e-15)


def test_derivatives_of_the_downdate():
    factor, vector = factors(2, 3, seed=2), 0.2 * normals(2, 3, seed=3)

    def down(f, v):
        return cholesky_downdate(f.tril(), v)

    assert torch.autograd.gradcheck(down, (factor.requires_grad_(), vector.requires_grad_()))


# Factors of covariances -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=seeds, size=st.integers(1, 6), rank=st.integers(0, 6))
def test_factor_of_any_semidefinite_matrix(dtype, seed, size, rank):
    """Singular ones go by their eigenvalues: an error of eps in the matrix is one of sqrt(eps) in the factor only."""
    root = normals(2, size, min(rank, size), seed=seed, dtype=dtype)
    covariance = root @ root.mT
    covariance = (covariance + covariance.mT) / 2
    factor = psd_factor(covariance)
    assert (factor == factor.tril()).all()
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()
    scale = covariance.diagonal(dim1=-2, dim2=-1).amax(-1)
    error = (factor @ factor.mT - covariance).abs().amax((-2, -1))
    assert (error <= 128 * size * size * torch.finfo(dtype).eps * scale).all()


def test_a_singular_row_leaves_the_others_alone():
    regular = factors(2, 3, seed=0)
    regular = regular @ regular.mT
    stack = torch.cat([regular, torch.zeros(1, 3, 3, dtype=torch.float64)])
    assert torch.equal(psd_factor(stack)[:2], torch.linalg.cholesky(regular))
    assert torch.equal(psd_factor(stack)[2], torch.zeros(3, 3, dtype=torch.float64))


def test_derivatives_of_the_factor_of_a_covariance():
    root = factors(2, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: psd_factor(r @ r.mT), (root,))


@pytest.mark.parametrize(
    ("covariance", "error", "message"),
    [
        (torch.ones(3), ValueError, r"Q must be a square matrix \(\*batch, e, e\), got shape \(3,\)"),
        (torch.ones(2, 3), ValueError, r"square matrix .* got shape \(2, 3\)"),
        (torch.ones(2, 2, dtype=torch.int64), TypeError, "Q must be a floating-point tensor, got torch.int64"),
        (torch.tensor([[1.0, torch.nan], [0, 1]]), ValueError, r"Q must be finite, got nan at \(0, 1\)"),
        (torch.tensor([[1.0, 0], [0, torch.inf]]), ValueError, r"Q must be finite, got inf at \(1, 1\)"),
        (
            torch.tensor([[1.0, 0.5], [0.25, 1]]),
            ValueError,
            "Q must be symmetric, it differs from its transpose by 0.25",
        ),
        (torch.tensor([[1.0, 2], [2, 1]]), ValueError, "Q must be positive semidefinite, its lowest eigenvalue is -1"),
        (torch.tensor([[0.0, 1], [1, 0]]), ValueError, "its lowest eigenvalue is -1"),
        (torch.tensor([[-1e-3]]), ValueError, "its lowest eigenvalue is -0.001"),
        (torch.stack([torch.eye(2), -torch.eye(2)]), ValueError, r"lowest eigenvalue is -1 at \(1,\)"),
    ],
)
def test_what_is_no_covariance_is_named(covariance, error, message):
    with pytest.raises(error, match=message):
        psd_factor(covariance, "Q")


@pytest.mark.parametrize("dtype", DTYPES)
def test_rounding_is_forgiven_but_no_more(dtype):
    eps = torch.finfo(dtype).eps
    exact = torch.full((3, 3), 2.0, dtype=dtype)
    tilted = exact.clone()
    tilted[0, 1] += 8 * eps
    factor = psd_factor(tilted)
    torch.testing.assert_close(factor @ factor.mT, exact, rtol=0, atol=256 * eps)
    tilted[0, 1] += 4000 * eps
    with pytest.raises(ValueError, match="symmetric"):
        psd_factor(tilted)


# Products and solutions -----------------------------------------------------------------------------------------------

# Leading dims of the factor and of the vectors; the result has them broadcast.
SHAPES = [
    ((), ()),  # one of each
    ((), (7,)),  # shared
    ((), (4, 7)),
    ((), (2, 4, 7)),
    ((7,), (7,)),  # one a row
    ((4, 7), (4, 7)),
    ((7,), (4, 7)),
    ((1,), (7,)),  # shared by size-1 dims
    ((1,), (4, 7)),
    ((4, 1), (4, 7)),
    ((2, 4, 1), (2, 4, 7)),
    ((2, 1, 1), (2, 4, 7)),
    ((1, 7), (4, 7)),
    ((4, 7), (7,)),
    ((4, 1), (7,)),
    ((4, 7), (1, 7)),
    ((4,), ()),  # a batch of factors, one vector
    ((4, 7), ()),
    ((1,), (1,)),
    ((4, 7), (4, 1)),
]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("particle_last", [False, True])
@pytest.mark.parametrize(("factor_lead", "vector_lead"), SHAPES)
def test_products_and_solutions_in_every_shape(dtype, particle_last, factor_lead, vector_lead):
    size, eps = 3, torch.finfo(dtype).eps
    factor = factors(*factor_lead, size, seed=1, dtype=dtype)
    vectors = normals(*vector_lead, size, seed=2, dtype=dtype)
    if particle_last:
        vectors = vectors.movedim(-1, 0).contiguous().movedim(0, -1)
    f, v = factor.double().numpy(), vectors.double().numpy()
    lead = np.broadcast_shapes(factor_lead, vector_lead)
    product = apply_factor(factor, vectors)
    assert product.dtype == dtype and product.shape == (*lead, size)
    np.testing.assert_allclose(product, np.einsum("...ij,...j->...i", f, v), rtol=0, atol=16 * eps * np.abs(v).max())
    solution = whiten(factor, vectors)
    assert solution.dtype == dtype and solution.shape == (*lead, size)
    shape = (*lead, size, size)
    expected = np.linalg.solve(np.broadcast_to(f, shape), np.broadcast_to(v, shape[:-1])[..., None])[..., 0]
    np.testing.assert_allclose(
        solution, expected, rtol=0, atol=8 * eps * np.linalg.cond(f).max() * np.abs(expected).max()
    )


@pytest.mark.parametrize(("factor_lead", "vector_lead"), SHAPES)
def test_diagonal_factors_in_every_shape(factor_lead, vector_lead):
    deviations = 0.5 + normals(*factor_lead, 3, seed=1).abs()
    vectors = normals(*vector_lead, 3, seed=2)
    full = torch.diag_embed(deviations)
    product, solution = apply_factor(deviations, vectors, diagonal=True), whiten(deviations, vectors, diagonal=True)
    torch.testing.assert_close(product, apply_factor(full, vectors), rtol=1e-15, atol=1e-15)
    torch.testing.assert_close(solution, whiten(full, vectors), rtol=1e-14, atol=1e-15)
    torch.testing.assert_close(log_abs_diagonal(deviations, diagonal=True), log_abs_diagonal(full))


def substitute(factor, right):
    """Forward substitution in extended precision."""
    solution = np.zeros(right.shape, np.longdouble)
    for i in range(len(factor)):
        known = solution[..., :i] @ factor[i, :i].astype(np.longdouble)
        solution[..., i] = (right[..., i] - known) / factor[i, i]
    return solution


@given(seed=seeds, size=st.integers(1, 8), spread=st.floats(0, 12))
def test_a_shared_factor_with_units_far_apart(seed, size, spread):
    """Metres beside microradians: the way by the inverse triangle is as good, row by row, as substitution."""
    scale = torch.logspace(-spread / 2, spread / 2, size, dtype=torch.float64)
    factor = factors(size, seed=seed) * scale.unsqueeze(-1)
    residual = normals(2, 5, size, seed=seed + 1) * scale
    single = whiten(factor, residual[0, 0])
    by_inverse = whiten(factor, residual)
    inverse, lower, right = factor.inverse().abs(), factor.abs(), residual.abs().unsqueeze(-1)
    bound = 2 * size * torch.finfo(torch.float64).eps * (inverse @ lower @ inverse @ right).squeeze(-1)
    torch.testing.assert_close(by_inverse[0, 0], single, rtol=0, atol=bound[0, 0].max().item())
    expected = substitute(factor.numpy(), residual.numpy())
    assert (np.abs(by_inverse.numpy() - expected) <= bound.numpy()).all()


def test_products_keep_a_particle_last_layout():
    """Components contiguous in memory going in, contiguous coming out: no copy is made on the way."""
    vectors = normals(3, 50, seed=0).mT
    assert apply_factor(factors(3, seed=1), vectors).mT.is_contiguous()


@pytest.mark.parametrize(("factor_lead", "vector_lead"), [((), (4, 7)), ((4, 1), (4, 7)), ((4, 7), (4, 7))])
def test_derivatives_of_products_and_solutions(factor_lead, vector_lead):
    factor = factors(*factor_lead, 2, seed=1).requires_grad_()
    vectors = normals(*vector_lead, 2, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, v: apply_factor(f.tril(), v), (factor, vectors))
    assert torch.autograd.gradcheck(lambda f, v: whiten(f.tril(), v), (factor, vectors))


def test_half_the_log_determinant():
    factor = factors(5, 4, seed=0)
    _, expected = np.linalg.slogdet((factor @ factor.mT).numpy())
    np.testing.assert_allclose(log_abs_diagonal(factor), expected / 2, rtol=1e-12, atol=1e-13)
    assert log_abs_diagonal(-factor).equal(log_abs_diagonal(factor))
    assert log_abs_diagonal(torch.zeros(1, 1)).item() == -math.inf


def test_products_and_solutions_in_float64_do_not_depend_on_the_threads():
    vectors, factor = normals(6, 33_333, seed=0).mT, factors(6, seed=1)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(torch.stack([apply_factor(factor, vectors), whiten(factor, vectors)]))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(r, results[0]) for r in results)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("lead", [(), (1,), (3,), (0,)])
def test_exponentials_are_right_to_rounding_however_many_there_are(lead, dtype):
    """Against SciPy's: torch's own, of one matrix alone, is off by 1e-11 at norms of a few hundredths."""
    generator = torch.Generator().manual_seed(0)
    for norm in (0.0, 1e-3, 0.04, 0.5, 2.0):
        a = torch.randn(*lead, 4, 4, generator=generator, dtype=torch.float64)
        a = (norm * a / a.abs().sum(-2, keepdim=True).amax(-1, keepdim=True)).to(dtype)
        expected = np.array([expm(row.double().numpy()) for row in a.reshape(-1, 4, 4)]).reshape(a.shape)
        ours = matrix_exp(a)
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours.double(), expected, rtol=0, atol=8 * torch.finfo(dtype).eps * math.exp(norm))


def test_exponentials_under_vmap_compile_and_derivatives():
    a = 0.01 * torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    times = torch.tensor([0.5, 2.0, 30.0], dtype=torch.float64)
    expected = np.array([expm(a.numpy() * float(time)) for time in times])
    mapped = torch.func.vmap(lambda time: matrix_exp(a * time))(times)
    np.testing.assert_allclose(mapped, expected, rtol=0, atol=1e-15)
    compiled = torch.compile(matrix_exp, fullgraph=True, backend="eager")(a)
    np.testing.assert_allclose(compiled, expm(a.numpy()), rtol=0, atol=1e-15)
    assert torch.autograd.gradcheck(matrix_exp, a.requires_grad_())
