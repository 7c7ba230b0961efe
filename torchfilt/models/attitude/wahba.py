"""Attitude from directions alone: Wahba's problem, what its solution is worth, and a start for filters.

Directions of a place (gravity, magnetic field, a lamp) are known in world axes and seen in body axes. The attitude that
fits n of them best minimises Wahba's loss, the weighted sum of |world - R(q) body|^2 / 2 over unit vectors.

All functions look at their input and name what is wrong with it: they are for starts, not for hot loops. Weights are
relative; those that give the smallest covariance are 1 / sd^2 with sd of a direction in rad. The arithmetic is float64
whatever the dtype of the input, which the result has again: what float32 rounds away is the directions' own.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import psd_factor
from torchfilt.models.attitude.kinematics import ATTITUDE_SPACE
from torchfilt.models.attitude.rotations import from_matrix, multiply, rotate

# How near a solution may be to another, in units of rounding: a thousandth is then left of the digits.
_MARGIN = 1e3
_EPS = torch.finfo(torch.float64).eps
# Newton halves the distance where two roots nearly meet, and squares it elsewhere.
_NEWTON_STEPS = 60


class WahbaSolution(NamedTuple):
    """Quaternion (..., 4), body to world, scalar part not negative, and Wahba's loss (...) of the weights as given."""

    quaternion: Tensor
    loss: Tensor


class _Directions(NamedTuple):
    """Unit vectors (..., n, 3) of the body and the world, and their weights (..., n), float64; and the dtype given."""

    body: Tensor
    world: Tensor
    weights: Tensor
    dtype: torch.dtype


def triad(body: Tensor, world: Tensor) -> WahbaSolution:
    """Attitude of two directions: the first is met exactly, the second only tells the turn about it.

    Args:
        body: two vectors (..., 2, 3) in body axes, of any length.
        world: the same two in world axes; leading dims broadcast.

    Returns:
        The attitude, and Wahba's loss with weights of one.

    Raises:
        ValueError: shapes or dtypes that do not fit, a vector that is zero or not finite, two that lie on one line.

    Source: Black, A passive system for determining the attitude of a satellite, AIAA Journal 2 (1964).
    """
    if body.dim() < 2 or body.shape[-2] != 2:
        raise ValueError(f"triad takes two vectors, body must be (..., 2, 3), got {tuple(body.shape)}")
    seen = _directions(body, world, None)
    limit = _MARGIN * torch.finfo(body.dtype).eps
    for name, pair in (("body", seen.body), ("world", seen.world)):
        sine = torch.linalg.vector_norm(torch.linalg.cross(pair[..., 0, :], pair[..., 1, :]), dim=-1)
        _refuse(sine <= limit, sine, f"two {name} vectors must not lie on one line, sine of their angle > {limit:.1e}")
    return _solution(seen, from_matrix(_axes(seen.world) @ _axes(seen.body).mT))


def davenport_q(body: Tensor, world: Tensor, weights: Tensor | None = None) -> WahbaSolution:
    """Best attitude as the eigenvector of Davenport's matrix (4, 4) with the greatest eigenvalue.

    Args:
        body: vectors (..., n, 3) in body axes, of any length, n >= 2.
        world: the same in world axes; leading dims broadcast.
        weights: (n,) or (..., n), not negative; None: ones.

    Raises:
        ValueError: shapes or dtypes that do not fit, a vector that is zero or not finite, a weight that is negative or
            not finite, directions that leave a turn open (all on one line, or two attitudes that fit alike).

    Source: Keat, Analysis of least-squares attitude determination routine DOAOP, CSC/TM-77/6034 (1977).
    """
    seen = _directions(body, world, weights)
    profile = _profile(seen)
    _check_gap(seen, profile, _MARGIN * _EPS)
    sums, trace, cross = _davenport(profile)
    eye = torch.eye(3, dtype=profile.dtype, device=profile.device)
    top = torch.cat([sums - trace[..., None, None] * eye, cross.unsqueeze(-1)], -1)
    low = torch.cat([cross, trace.unsqueeze(-1)], -1).unsqueeze(-2)
    return _solution(seen, torch.linalg.eigh(torch.cat([top, low], -2)).eigenvectors[..., -1])


def quest(body: Tensor, world: Tensor, weights: Tensor | None = None) -> WahbaSolution:
    """Best attitude by Newton's method on the characteristic polynomial of Davenport's matrix.

    The polynomial loses digits where its two greatest roots meet: vectors of equal weight must be some 0.08 deg apart,
    where `davenport_q` and `wahba_svd` do with 5e-5 deg, and 0.01 deg for vectors in float32. The closed form
    of the vector fails at turns of 180 deg, so it is taken in the four sets of axes that a half turn about x, y, z or
    none at all gives, and the best conditioned counts.

    Args, Raises: as `davenport_q`.

    Source: Shuster and Oh, Three-axis attitude determination from vector observations, J. Guidance and Control 4
        (1981), equations 63 to 76, and the method of sequential rotations in the same place.
    """
    seen = _directions(body, world, weights)
    profile = _profile(seen)
    _check_gap(seen, profile, (_MARGIN * _EPS) ** 0.5)
    greatest = _greatest_root(profile)
    half_turns = torch.eye(4, dtype=profile.dtype, device=profile.device)  # x, y, z, none: as quaternions
    signs = profile.new_tensor([[1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]])
    each = _eigenvector(profile.unsqueeze(-3) * signs.unsqueeze(-2), greatest.unsqueeze(-1))
    length = torch.linalg.vector_norm(each, dim=-1)
    best = length.argmax(-1, keepdim=True)
    chosen = each.gather(-2, best.unsqueeze(-1).expand(*best.shape, 4)).squeeze(-2) / length.gather(-1, best)
    return _solution(seen, multiply(chosen, half_turns[best.squeeze(-1)]))


def wahba_svd(body: Tensor, world: Tensor, weights: Tensor | None = None) -> WahbaSolution:
    """Best attitude by the singular values of the attitude profile: the rotation nearest to it.

    Args, Raises: as `davenport_q`.

    Source: Markley, Attitude determination using vector observations and the singular value decomposition,
        J. Astronautical Sciences 36 (1988).
    """
    seen = _directions(body, world, weights)
    profile = _profile(seen)
    _check_gap(seen, profile, _MARGIN * _EPS)
    left, _, right = torch.linalg.svd(profile)
    # A reflection would fit better where the determinants differ: the weakest axis gives way.
    sign = torch.linalg.det(left) * torch.linalg.det(right)
    last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign.sign()], -1)
    return _solution(seen, from_matrix((left * last.unsqueeze(-2)) @ right))


def attitude_covariance(world: Tensor, sds_rad: Tensor) -> Tensor:
    """Covariance (..., 3, 3) in rad^2, world axes, of the best attitude: the inverse of the Fisher information.

    Args:
        world: directions (..., n, 3) in world axes, of any length, n >= 2.
        sds_rad: standard deviation of each direction as seen, (n,) or (..., n), across it, the same both ways; the
            weights of the attitude are 1 / sds_rad^2.

    Raises:
        ValueError: shapes that do not fit, a vector that is zero or not finite, a deviation that is not positive and
            finite, directions that all lie on one line.

    Source: Shuster and Oh (1981), equation 98.
    """
    _check_vectors("world", world)
    _check_per_vector("sds_rad", sds_rad, world.shape)
    _refuse(~((sds_rad > 0) & torch.isfinite(sds_rad)), sds_rad, "sds_rad must be positive and finite")
    dtype, world = world.dtype, world.double()
    weights = sds_rad.double().square().reciprocal()
    unit = world / torch.linalg.vector_norm(world, dim=-1, keepdim=True)
    total = weights.sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=world.dtype, device=world.device)
    information = eye - ((unit * weights.unsqueeze(-1)).mT @ unit) / total
    least = torch.linalg.eigvalsh(information)[..., 0]
    limit = _MARGIN * _EPS
    rule = "directions must not all lie on one line, nor differ too much in precision"
    _refuse(least <= limit, least, f"{rule}: least share of information > {limit:.1e}")
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(information))
    return (inverse / total).to(dtype)


def initial_attitude(
    accel_m_s2: Tensor,
    mag: Tensor,
    field: Tensor,
    *,
    accel_sd_m_s2: float,
    mag_sd: float,
    gyro_bias_sd_rad_s: float,
    gyro_bias_rad_s: Tensor | None = None,
) -> Gaussian:
    """Belief on `ATTITUDE_SPACE` of a body at rest, from averages of its accelerometer and magnetometer.

    Args:
        accel_m_s2: specific force (..., 3) in body axes, which points up in the world.
        mag: magnetic field (..., 3) in body axes, in the unit of ``mag_sd``.
        field: the same in world axes, (3,) or (..., 3); its direction counts.
        accel_sd_m_s2, mag_sd: of each axis of an *average*: biases, iron nearby and a field that is not quite known
            count, not only noise.
        gyro_bias_sd_rad_s: of each axis; with `gyro_bias_rad_s` (..., 3) as its mean, zero where None, such as the
            average of the gyro over the same time.

    Raises:
        ValueError: shapes or dtypes that do not fit, a vector that is zero or not finite, force and field on one line,
            a deviation that is not positive and finite.
    """
    given = {"accel_sd_m_s2": accel_sd_m_s2, "mag_sd": mag_sd, "gyro_bias_sd_rad_s": gyro_bias_sd_rad_s}
    for name, value in given.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{name} must be positive and finite, got {value}")
    for name, vectors in (("accel_m_s2", accel_m_s2), ("mag", mag), ("field", field)):
        if vectors.dim() < 1 or vectors.shape[-1] != 3:
            raise ValueError(f"{name} must be (..., 3), got {tuple(vectors.shape)}")
        if vectors.dtype != accel_m_s2.dtype:
            raise ValueError(f"{name} must have the dtype of accel_m_s2, {accel_m_s2.dtype}, got {vectors.dtype}")
    up = field.new_tensor([0.0, 0.0, 1.0]).expand_as(field)
    body, world = torch.stack(torch.broadcast_tensors(accel_m_s2, mag), -2), torch.stack([up, field], -2)
    _check_vectors("body (acceleration, field)", body)
    lengths = torch.linalg.vector_norm(body, dim=-1)
    sds_rad = body.new_tensor([accel_sd_m_s2, mag_sd], dtype=torch.float64) / lengths
    quaternion = wahba_svd(body, world, sds_rad.square().reciprocal()).quaternion
    world = world.expand(*quaternion.shape[:-1], 2, 3)
    bias = quaternion.new_zeros(3) if gyro_bias_rad_s is None else gyro_bias_rad_s
    mean = torch.cat([quaternion, bias.expand(*quaternion.shape[:-1], 3)], -1)
    own = psd_factor(attitude_covariance(world.double(), sds_rad)).to(mean.dtype)
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device)
    factor = torch.cat(
        [
            torch.nn.functional.pad(own, (0, 3)),
            torch.nn.functional.pad(eye * gyro_bias_sd_rad_s, (3, 0)).expand(*own.shape[:-2], 3, 6),
        ],
        -2,
    )
    return Gaussian(mean, factor, ATTITUDE_SPACE)


# Parts of the methods -------------------------------------------------------------------------------------------------


def _axes(pair: Tensor) -> Tensor:
    """Right-handed axes (..., 3, 3), one a column: the first vector, the common normal, and what is across both."""
    first, second = pair.unbind(-2)
    normal = torch.linalg.cross(first, second)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return torch.stack([first, normal, torch.linalg.cross(first, normal)], -1)


def _profile(seen: _Directions) -> Tensor:
    """Sum of weight world body^T (..., 3, 3), weights that sum to one: best matched by the matrix of the attitude."""
    share = seen.weights / seen.weights.sum(-1, keepdim=True)
    return (seen.world * share.unsqueeze(-1)).mT @ seen.body


def _davenport(profile: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Parts S, s and z of Davenport's matrix [[S - s I, z], [z^T, s]]: q^T K q is one less the loss."""
    B = profile
    sums = B + B.mT
    # Sum of body x world; the sign goes with quaternions that turn the body's vectors into the world's.
    cross = torch.stack([B[..., 2, 1] - B[..., 1, 2], B[..., 0, 2] - B[..., 2, 0], B[..., 1, 0] - B[..., 0, 1]], -1)
    return sums, B.diagonal(dim1=-2, dim2=-1).sum(-1), cross


def _minors(matrix: Tensor) -> Tensor:
    """Trace of the adjugate of a symmetric (..., 3, 3)."""
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (trace.square() - matrix.square().sum((-2, -1))) / 2


def _greatest_root(profile: Tensor) -> Tensor:
    """Greatest eigenvalue (...) of Davenport's matrix: from one, which is above it, Newton falls to it."""
    S, s, z = _davenport(profile)
    Sz = (S @ z.unsqueeze(-1)).squeeze(-1)
    a, b = s.square() - _minors(S), s.square() + z.square().sum(-1)
    c, d = torch.linalg.det(S) + (z * Sz).sum(-1), Sz.square().sum(-1)
    root = torch.ones_like(s)
    for _ in range(_NEWTON_STEPS):
        square = root.square()
        value = (square - a) * (square - b) - c * root + c * s - d
        slope = 2 * root * (2 * square - a - b) - c
        new = root - value / slope
        # A step that does not fall is rounding: the row has arrived.
        falls = (slope > 0) & (new < root)
        if not bool(falls.any()):
            break
        root = torch.where(falls, new, root)
    return root


def _eigenvector(profile: Tensor, root: Tensor) -> Tensor:
    """Column (..., 4) of the adjugate of K - root I of the scalar part; it vanishes at turns of 180 deg."""
    S, s, z = _davenport(profile)
    alpha = root.square() - s.square() + _minors(S)
    Sz = (S @ z.unsqueeze(-1)).squeeze(-1)
    SSz = (S @ Sz.unsqueeze(-1)).squeeze(-1)
    axis = alpha.unsqueeze(-1) * z + (root - s).unsqueeze(-1) * Sz + SSz
    scalar = (root + s) * alpha - torch.linalg.det(S)
    return torch.cat([axis, scalar.unsqueeze(-1)], -1)


def _solution(seen: _Directions, quaternion: Tensor) -> WahbaSolution:
    quaternion = quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    # One less the eigenvalue would lose the digits of a loss that is small.
    off = seen.world - rotate(quaternion.unsqueeze(-2), seen.body)
    loss = (seen.weights * off.square().sum(-1)).sum(-1) / 2
    return WahbaSolution(quaternion.to(seen.dtype), loss.to(seen.dtype))


# Checks ---------------------------------------------------------------------------------------------------------------


def _directions(body: Tensor, world: Tensor, weights: Tensor | None) -> _Directions:
    _check_vectors("body", body)
    _check_vectors("world", world)
    if body.dtype != world.dtype:
        raise ValueError(f"body and world must have one dtype, got {body.dtype} and {world.dtype}")
    if body.shape[-2] != world.shape[-2]:
        raise ValueError(f"body and world must have the same n, got {tuple(body.shape)} and {tuple(world.shape)}")
    body, world = torch.broadcast_tensors(body, world)
    if weights is None:
        weights = torch.ones_like(body[..., 0])
    _check_per_vector("weights", weights, body.shape)
    _refuse(~((weights >= 0) & torch.isfinite(weights)), weights, "weights must be >= 0 and finite")
    total = weights.sum(-1)
    _refuse(total <= 0, total, "weights must not all be zero")
    dtype = body.dtype
    body, world = (v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (body.double(), world.double()))
    return _Directions(body, world, weights.double().expand(body.shape[:-1]), dtype)


def _check_vectors(name: str, vectors: Tensor) -> None:
    if vectors.dim() < 2 or vectors.shape[-1] != 3 or vectors.shape[-2] < 2:
        raise ValueError(f"{name} must be (..., n, 3) with n >= 2, got {tuple(vectors.shape)}")
    if not vectors.is_floating_point():
        raise ValueError(f"{name} must be of a floating dtype, got {vectors.dtype}")
    length = torch.linalg.vector_norm(vectors, dim=-1)
    _refuse(~(torch.isfinite(length) & (length > 0)), length, f"{name} vectors must be finite and not zero, length > 0")


def _check_per_vector(name: str, values: Tensor, shape: torch.Size) -> None:
    if values.dim() < 1 or values.shape[-1] != shape[-2] or values.dim() > len(shape) - 1:
        raise ValueError(f"{name} must be (n,) or (..., n) for vectors {tuple(shape)}, got {tuple(values.shape)}")


def _check_gap(seen: _Directions, profile: Tensor, limit: float) -> None:
    """Half the distance between the two greatest eigenvalues, by singular values: zero where a turn is left open."""
    rule = "directions must tell one attitude, not lie on one line, be mirrored or have weights too unequal: gap"
    gap = _gap(profile)
    _refuse(gap <= limit, gap, f"{rule} > {limit:.1e}")
    if seen.dtype != profile.dtype:
        # Directions apart by an angle have a gap of its square over 4, whatever they weigh: is it more than rounding?
        gap = _gap(_profile(seen._replace(weights=(seen.weights > 0).to(profile.dtype))))
        limit = (_MARGIN * torch.finfo(seen.dtype).eps) ** 2 / 4
        _refuse(gap <= limit, gap, f"{rule} in {seen.dtype} > {limit:.1e}")


def _gap(profile: Tensor) -> Tensor:
    _, second, third = torch.linalg.svdvals(profile).unbind(-1)
    return second + torch.linalg.det(profile).sign() * third


def _refuse(bad: Tensor, values: Tensor, rule: str) -> None:
    """Raise for the first of the bad values, named with its row."""
    if not bool(bad.any()):
        return
    row = tuple(bad.nonzero()[0].tolist())
    place = f" in row {row}" if row else ""
    raise ValueError(f"{rule}, got {values[row].item():.6g}{place}")
