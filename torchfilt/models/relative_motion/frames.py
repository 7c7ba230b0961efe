"""Inertial, Hill and curvilinear descriptions of one satellite relative to another.

Hill axes of the chief: x radial outward, z along the orbit normal (r x v), y = z x x (along track). A relative state is
[x y z vx vy vz] in m and m/s; the velocities are the derivatives of the components, seen in the rotating frame, whose
angular rate in its own axes is w = (r f_h / h, 0, h / r^2), f_h being the chief's perturbing acceleration along z.
Leading dims are free; all functions are differentiable and keep float32 accurate by working on differences.
"""

import torch
from torch import Tensor


def hill_axes(position_m: Tensor, velocity_m_s: Tensor) -> Tensor:
    """Rotation from inertial to Hill axes.

    Args:
        position_m, velocity_m_s: chief, inertial, (..., 3).

    Returns:
        (..., 3, 3), rows x, y, z: ``axes @ inertial`` has Hill components.
    """
    x = position_m / torch.linalg.vector_norm(position_m, dim=-1, keepdim=True)
    normal = torch.linalg.cross(x, velocity_m_s)
    z = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return torch.stack([x, torch.linalg.cross(z, x), z], -2)


def frame_rate(position_m: Tensor, velocity_m_s: Tensor, acceleration_m_s2: Tensor) -> Tensor:
    """Angular rate of the Hill frame in rad/s, Hill axes.

    Args:
        position_m, velocity_m_s: chief, inertial, (..., 3).
        acceleration_m_s2: of the chief, inertial, (..., 3); only its part along the orbit normal counts, so the
            perturbing acceleration alone gives the same.

    Returns:
        (..., 3): (r f_h / h, 0, h / r^2).
    """
    momentum = torch.linalg.cross(position_m, velocity_m_s)
    h = torch.linalg.vector_norm(momentum, dim=-1)
    square = position_m.square().sum(-1)
    f_h = (acceleration_m_s2 * momentum).sum(-1) / h
    return torch.stack([square.sqrt() * f_h / h, torch.zeros_like(h), h / square], -1)


def to_hill(
    position_m: Tensor,
    velocity_m_s: Tensor,
    frame_rate_rad_s: Tensor,
    separation_m: Tensor,
    relative_velocity_m_s: Tensor,
) -> Tensor:
    """Relative state of the deputy in the chief's rotating frame.

    Args:
        position_m, velocity_m_s: chief, inertial, (..., 3).
        frame_rate_rad_s: of the chief's Hill frame, Hill axes, (..., 3).
        separation_m, relative_velocity_m_s: deputy minus chief, inertial, (..., 3).

    Returns:
        (..., 6).
    """
    axes = hill_axes(position_m, velocity_m_s)
    rho = (axes @ separation_m.unsqueeze(-1)).squeeze(-1)
    velocity = (axes @ relative_velocity_m_s.unsqueeze(-1)).squeeze(-1)
    rate, rho = torch.broadcast_tensors(frame_rate_rad_s, rho)
    return torch.cat(torch.broadcast_tensors(rho, velocity - torch.linalg.cross(rate, rho)), -1)


def from_hill(
    position_m: Tensor, velocity_m_s: Tensor, frame_rate_rad_s: Tensor, relative: Tensor
) -> tuple[Tensor, Tensor]:
    """Inertial separation (m) and relative velocity (m/s), deputy minus chief: the inverse of `to_hill`.

    Args:
        position_m, velocity_m_s: chief, inertial, (..., 3).
        frame_rate_rad_s: Hill axes, (..., 3).
        relative: (..., 6).

    Returns:
        Two tensors (..., 3).
    """
    back = hill_axes(position_m, velocity_m_s).mT
    rho, velocity = relative[..., :3], relative[..., 3:]
    rate, rho = torch.broadcast_tensors(frame_rate_rad_s, rho)
    velocity = velocity + torch.linalg.cross(rate, rho)
    return (back @ rho.unsqueeze(-1)).squeeze(-1), (back @ velocity.unsqueeze(-1)).squeeze(-1)


def to_curvilinear(relative: Tensor, radius_m: Tensor | float, radial_rate_m_s: Tensor | float = 0.0) -> Tensor:
    """Radius difference and two arcs, with their derivatives: the curvature of the orbit leaves the radial axis.

    The deputy at distance R_d from the Earth's centre, longitude t in the chief's orbital plane and latitude p above
    it becomes (R_d - R_c, R_c t, R_c p). Exact; no difference of large numbers is formed.

    Args:
        relative: Hill state (..., 6).
        radius_m: of the chief, R_c, number or (...).
        radial_rate_m_s: its derivative, number or (...).

    Returns:
        (..., 6): three lengths in m and their time derivatives in m/s.
    """
    x, y, z, vx, vy, vz = relative.unbind(-1)
    a, va = radius_m + x, radial_rate_m_s + vx
    plane2 = a * a + y * y
    plane = plane2.sqrt()
    far2 = plane2 + z * z
    far = far2.sqrt()
    longitude, latitude = torch.atan2(y, a), torch.atan2(z, plane)
    radial = (x * (2 * radius_m + x) + y * y + z * z) / (far + radius_m)
    # a - R_d = -(y^2 + z^2) / (R_d + a) multiplies the chief's own radial rate.
    radial_velocity = (a * vx + y * vy + z * vz - radial_rate_m_s * (y * y + z * z) / (far + a)) / far
    longitude_rate = (a * vy - y * va) / plane2
    latitude_rate = (vz * plane2 - z * (a * va + y * vy)) / (plane * far2)
    along = radius_m * longitude_rate + radial_rate_m_s * longitude
    across = radius_m * latitude_rate + radial_rate_m_s * latitude
    return torch.stack([radial, radius_m * longitude, radius_m * latitude, radial_velocity, along, across], -1)


def from_curvilinear(curvilinear: Tensor, radius_m: Tensor | float, radial_rate_m_s: Tensor | float = 0.0) -> Tensor:
    """Hill state of curvilinear coordinates: the inverse of `to_curvilinear`, as exact.

    Args:
        curvilinear: (..., 6), see `to_curvilinear`.
        radius_m, radial_rate_m_s: of the chief, numbers or (...).

    Returns:
        (..., 6).
    """
    radial, along, across, radial_velocity, along_velocity, across_velocity = curvilinear.unbind(-1)
    longitude, latitude = along / radius_m, across / radius_m
    longitude_rate = (along_velocity - radial_rate_m_s * longitude) / radius_m
    latitude_rate = (across_velocity - radial_rate_m_s * latitude) / radius_m
    sin_t, cos_t = longitude.sin(), longitude.cos()
    sin_p, cos_p = latitude.sin(), latitude.cos()
    far, far_rate = radius_m + radial, radial_rate_m_s + radial_velocity
    # 1 - cos p cos t without cancellation
    bend = 2 * ((longitude / 2).sin().square() * cos_p + (latitude / 2).sin().square())
    x = radial - far * bend
    y = far * cos_p * sin_t
    z = far * sin_p
    vx = (
        radial_velocity * (1 - bend)
        - radial_rate_m_s * bend
        - far * (latitude_rate * sin_p * cos_t + longitude_rate * cos_p * sin_t)
    )
    vy = far_rate * cos_p * sin_t + far * (longitude_rate * cos_p * cos_t - latitude_rate * sin_p * sin_t)
    vz = far_rate * sin_p + far * latitude_rate * cos_p
    return torch.stack([x, y, z, vx, vy, vz], -1)
