"""Attitude as a unit quaternion: the one file of the models that knows a quaternion's order (x y z w, Hamilton).

A quaternion of an attitude turns body components into ENU components. Body axes are x right, y forward, z up (RFU), so
that the identity is a level vehicle with its nose to the north. RoMa does the maths of rotations and loads when the
first one is made. Leading dims broadcast everywhere.
"""

import torch
from torch import Tensor

from torchfilt.spaces import wrap_angle


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions (..., 4): turn by b first, then by a."""
    import roma

    return roma.quat_product(a, b)


def inverse(q: Tensor) -> Tensor:
    """Conjugate of unit quaternions (..., 4)."""
    return torch.cat([-q[..., :3], q[..., 3:]], -1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors (..., 3) turned by unit quaternions (..., 4), for the price of two cross products.

    With q = (u, w) and t = 2 u x v the result is v + w t + u x t.
    """
    u, v = torch.broadcast_tensors(q[..., :3], v)
    twice = 2 * torch.linalg.cross(u, v)
    return v + q[..., 3:] * twice + torch.linalg.cross(u, twice)


def to_matrix(q: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    import roma

    return roma.unitquat_to_rotmat(q)


def from_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of rotation matrices (..., 3, 3); either of the two signs."""
    import roma

    return roma.rotmat_to_unitquat(matrix)


def from_rotation_vector(v: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) in rad."""
    import roma

    return roma.rotvec_to_unitquat(v)


def to_rotation_vector(q: Tensor) -> Tensor:
    """Rotation vectors (..., 3) in rad, at most pi long, of unit quaternions (..., 4)."""
    import roma

    return roma.unitquat_to_rotvec(q)


def from_euler(heading_rad: Tensor, pitch_rad: Tensor, roll_rad: Tensor) -> Tensor:
    """Attitude from heading, pitch and roll: turns by -heading about z, pitch about x, roll about y, in this order.

    Args:
        heading_rad: of the forward axis, clockwise from north, (...).
        pitch_rad: of the forward axis above the horizon, (...).
        roll_rad: about the forward axis, right side down positive, (...).

    Returns:
        (..., 4), body RFU to ENU.
    """
    half = torch.stack(torch.broadcast_tensors(heading_rad, pitch_rad, roll_rad), -1) / 2
    (sh, sp, sr), (ch, cp, cr) = half.sin().unbind(-1), half.cos().unbind(-1)
    x = ch * sp * cr + sh * cp * sr
    y = ch * cp * sr - sh * sp * cr
    z = ch * sp * sr - sh * cp * cr
    w = ch * cp * cr + sh * sp * sr
    return torch.stack([x, y, z, w], -1)


def to_euler(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Heading, pitch and roll in rad, each (...), of attitudes (..., 4); the inverse of `from_euler`.

    Heading and roll are in [-pi, pi], pitch in [-pi/2, pi/2]. With the nose straight up or down only the difference or
    the sum of heading and roll is known, and there are no derivatives; near it the angles still give the attitude back
    to rounding.

    Source: Bernardes and Viollet, Quaternion to Euler angles conversion, PLoS ONE 17 (2022).
    """
    x, y, z, w = q.unbind(-1)
    # Products of cosine or sine of (roll + heading)/2 and of (roll - heading)/2 with those of pitch/2 + 45 degrees.
    sum_sine, sum_cosine, difference_sine, difference_cosine = y - z, w - x, y + z, w + x
    half_sum = torch.atan2(sum_sine, sum_cosine)
    half_difference = torch.atan2(difference_sine, difference_cosine)
    high = torch.hypot(difference_sine, difference_cosine)
    pitch = 2 * torch.atan2(high, torch.hypot(sum_sine, sum_cosine)) - torch.pi / 2
    return wrap_angle(half_sum - half_difference), pitch, wrap_angle(half_sum + half_difference)


def skew(v: Tensor) -> Tensor:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b`` is a x b."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def mean_rotation(v: Tensor) -> Tensor:
    """Mean (..., 3, 3) of the rotation matrices between the identity and that of v (..., 3), at a constant rate.

    It turns an integral of constant components in turning axes into one in the axes at the start. It is also the left
    Jacobian of the exponential: exp(v + d) = exp(mean_rotation(v) d) exp(v) to first order in d.
    """
    square = v.square().sum(-1)
    small = square < 1e-5
    # Where the series is taken, the argument of the other branch is a harmless one: derivatives of both are formed.
    angle2 = torch.where(small, 1, square)
    angle = angle2.sqrt()
    # (1 - cos a) / a^2 and (a - sin a) / a^3; what the series leave out is below 1e-15 beside the products they weigh.
    first = torch.where(small, 1 / 2 - square / 24, 2 * (angle / 2).sin().square() / angle2)
    second = torch.where(small, 1 / 6 - square / 120, (angle - angle.sin()) / (angle2 * angle))
    cross = skew(v)
    identity = torch.eye(3, dtype=v.dtype, device=v.device)
    return identity + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def ned_frd_to_enu_rfu(q: Tensor) -> Tensor:
    """Attitude (..., 4) of body FRD to NED, given as body RFU to ENU; the map is its own inverse.

    Both pairs of axes differ by the same half turn about (1, 1, 0), so the quaternion is conjugated by it.
    """
    return torch.cat([swap_enu_ned(q[..., :3]), q[..., 3:]], -1)


def swap_enu_ned(v: Tensor) -> Tensor:
    """East-north-up components (..., 3) of north-east-down ones, and the other way round."""
    x, y, z = v.unbind(-1)
    return torch.stack([y, x, -z], -1)


def swap_rfu_frd(v: Tensor) -> Tensor:
    """Right-forward-up components (..., 3) of forward-right-down ones, and the other way round."""
    return swap_enu_ned(v)
