"""Small-matrix algebra on factors: one triangularisation serves every square-root recursion."""

import torch
from torch import Tensor
from torch.autograd import forward_ad


def is_traced() -> bool:
    """Whether the code runs under torch.compile or a transform of torch.func, where no branch may ask for numbers."""
    return torch.compiler.is_compiling() or bool(torch._C._are_functorch_transforms_active())


def is_differentiated(*tensors: Tensor) -> bool:
    """Whether a derivative is taken with respect to any of the tensors, in reverse or in forward mode."""
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return True
    if torch.compiler.is_compiling():
        return False
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def triangularize(columns: Tensor) -> Tensor:
    """Lower-triangular factor of ``columns @ columns.mT`` by one QR, without forming the product.

    Args:
        columns: (*batch, e, k) with k >= e, any finite numbers.

    Returns:
        (*batch, e, e), lower triangular, diagonal >= 0. Where the rows are linearly dependent the factor has a zero on
        its diagonal and no derivative (it behaves as a square root at zero): gradients are NaN or infinite there.

    Raises:
        ValueError: fewer columns than rows.
    """
    if columns.shape[-1] < columns.shape[-2]:
        raise ValueError(f"columns must be (*batch, e, k) with k >= e, got shape {tuple(columns.shape)}")
    # mode="r" is half the work, but has no derivative and fails under nested `torch.vmap`; "reduced" does it all.
    whole = is_differentiated(columns) or torch._C._are_functorch_transforms_active()
    mode = "reduced" if whole else "r"
    r = torch.linalg.qr(columns.mT, mode=mode).R
    diagonal = r.diagonal(dim1=-2, dim2=-1)
    sign = torch.copysign(diagonal.new_ones(()), diagonal.detach())
    return (r * sign.unsqueeze(-1)).mT


def matrix_exp(matrices: Tensor) -> Tensor:
    """Exponential (*batch, d, d) of matrices (*batch, d, d)."""
    # Of one matrix alone torch's is off by up to 3e-11 where the norm is below 0.05 (2e-6 in float32, below 1); of two
    # at once it takes another polynomial, right to rounding.
    if matrices.shape[:-2].numel() > 1:
        return torch.linalg.matrix_exp(matrices)
    return torch.linalg.matrix_exp(torch.stack([matrices, matrices]))[0]


_BLOCK = 1024


def steady_triangularize(columns: Tensor) -> Tensor:
    """`triangularize` of many columns (*batch, e, k) in blocks: the same bits for any thread count.

    LAPACK shares one long factorisation between threads, which then round differently; blocks are too short for that.
    """
    while columns.shape[-1] >= 2 * _BLOCK:
        count = columns.shape[-1] // _BLOCK - 1  # the last block takes the rest, so that none is short
        head, rest = columns[..., : count * _BLOCK], columns[..., count * _BLOCK :]
        factors = triangularize(head.unflatten(-1, (count, _BLOCK)).movedim(-2, -3))
        columns = torch.cat([factors.movedim(-3, -2).flatten(-2), triangularize(rest)], -1)
    return triangularize(columns)


def cholesky_downdate(factor: Tensor, vector: Tensor) -> Tensor:
    """Lower factor of ``factor @ factor.mT - vector vector^T`` by hyperbolic rotations.

    Args:
        factor: (*batch, e, e) lower triangular.
        vector: (*batch, e).

    Returns:
        (*batch, e, e); all NaN in the rows of the batch where the difference is not positive definite.

    Source: Golub and Van Loan, Matrix Computations, section 6.5.
    """
    columns = []
    rest = vector
    for j in range(factor.shape[-1]):
        column = factor[..., :, j]
        pivot = torch.sqrt(column[..., j] ** 2 - rest[..., j] ** 2).unsqueeze(-1)
        cosine = column[..., j : j + 1] / pivot
        sine = rest[..., j : j + 1] / pivot
        columns.append(cosine * column - sine * rest)
        rest = cosine * rest - sine * column
    result = torch.stack(columns, dim=-1).tril()
    # A negative pivot spoils the columns from its own on; a zero one leaves infinities. One look tells both.
    broken = ~torch.isfinite(result).all(-1, keepdim=True).all(-2, keepdim=True)
    return result.masked_fill(broken, torch.nan)


def psd_factor(covariance: Tensor, name: str = "covariance") -> Tensor:
    """Lower-triangular factor of a symmetric positive semidefinite matrix, singular ones included.

    Args:
        covariance: (*batch, e, e).
        name: how the caller calls the matrix, for the error.

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: not square, not finite, not symmetric or with a negative eigenvalue; the value is named.
    """
    if not isinstance(covariance, Tensor) or not covariance.is_floating_point():
        got = covariance.dtype if isinstance(covariance, Tensor) else type(covariance).__name__
        raise TypeError(f"{name} must be a floating-point tensor, got {got}")
    if covariance.dim() < 2 or covariance.shape[-1] != covariance.shape[-2]:
        raise ValueError(f"{name} must be a square matrix (*batch, e, e), got shape {tuple(covariance.shape)}")
    values = covariance.detach()
    finite = torch.isfinite(values)
    if not finite.all():
        raise ValueError(f"{name} must be finite, got {_first(values, ~finite)}")
    scale = values.diagonal(dim1=-2, dim2=-1).abs().amax(-1)
    slack = 64 * torch.finfo(covariance.dtype).eps * covariance.shape[-1]
    skew = (values - values.mT).abs().amax((-2, -1))
    skewed = skew > slack * scale
    if skewed.any():
        raise ValueError(f"{name} must be symmetric, it differs from its transpose by {_first(skew, skewed)}")
    factor, info = torch.linalg.cholesky_ex(covariance)
    if not info.any():
        return factor
    eigenvalues, vectors = torch.linalg.eigh(covariance)
    lowest = eigenvalues.detach().amin(-1)
    negative = lowest < -slack * scale
    if negative.any():
        raise ValueError(f"{name} must be positive semidefinite, its lowest eigenvalue is {_first(lowest, negative)}")
    singular = triangularize(vectors * eigenvalues.clamp_min(0).sqrt().unsqueeze(-2))
    return torch.where((info == 0)[..., None, None], factor, singular)


def _first(values: Tensor, bad: Tensor) -> str:
    """The first bad value, with its place where there are several."""
    place = tuple(bad.nonzero()[0].tolist())
    return f"{values[place].item():.6g}" + (f" at {place}" if place else "")


def apply_factor(factor: Tensor, vectors: Tensor, *, diagonal: bool = False) -> Tensor:
    """``factor @ v`` for each vector, one matrix product when the factor is shared.

    The library behind the product may round differently with another number of threads; in float64 it seldom does.

    Args:
        factor: (e, e), (*batch, 1, e, e) or one per vector (*batch, n, e, e); with ``diagonal``, (..., e).
        vectors: (*batch, n, e).
    """
    if diagonal:
        return factor * vectors
    if vectors.dim() == 1:
        return factor @ vectors if factor.dim() == 2 else (factor @ vectors.unsqueeze(-1)).squeeze(-1)
    if factor.dim() == 2:
        return (factor @ vectors.mT).mT  # keeps a particle-last memory layout particle-last
    if factor.shape[-3] == 1:
        return (factor.squeeze(-3) @ vectors.mT).mT
    return (factor @ vectors.unsqueeze(-1)).squeeze(-1)


def for_points(values: Tensor, own: int, lead: int) -> Tensor:
    """Room for points in what has one entry a row of the batch: (*batch, own dims) to (*batch, 1, ..., own dims).

    Args:
        values: shared by all rows (own dims only), or with leading dims.
        own: how many dims belong to the entry itself.
        lead: leading dims of the points.
    """
    missing = lead - (values.dim() - own)
    if values.dim() == own or missing <= 0:
        return values
    return values.reshape(*values.shape[: values.dim() - own], *[1] * missing, *values.shape[values.dim() - own :])


def whiten(factor: Tensor, residual: Tensor, *, diagonal: bool = False) -> Tensor:
    """``factor^-1 @ r`` for each residual; shapes as in `apply_factor`."""
    if diagonal:
        return residual / factor
    if residual.dim() == 1:
        return torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False).squeeze(-1)
    if factor.dim() == 2:
        if residual.dim() == 2:
            # From the right: the solver takes a particle-last layout as it lies, without a copy.
            return torch.linalg.solve_triangular(factor.mT, residual, upper=True, left=False)
        # Broadcasting a shared factor would copy it for each row; inverting the small triangle once is cheaper.
        identity = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        return (torch.linalg.solve_triangular(factor, identity, upper=False) @ residual.mT).mT
    if factor.shape[-3] == 1:
        return torch.linalg.solve_triangular(factor.squeeze(-3), residual.mT, upper=False).mT
    return torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False).squeeze(-1)


def log_abs_diagonal(factor: Tensor, *, diagonal: bool = False) -> Tensor:
    """Sum of ``log |diagonal|``: half the log-determinant of the covariance. Shape (...)."""
    values = factor if diagonal else factor.diagonal(dim1=-2, dim2=-1)
    return values.abs().log().sum(-1)
