"""The chief's known orbit, and how it reaches a transition law: as a control vector of 21 numbers.

Layout of a control, SI units: thrust acceleration of the deputy in Hill axes [0:3]; chief at the start of the step:
inertial position [3:6], velocity [6:9], Hill frame rate in Hill axes [9:12]; the same at the end [12:15], [15:18],
[18:21].
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.models.relative_motion.frames import frame_rate, to_hill
from torchfilt.models.relative_motion.gravity import Field, acceleration

CONTROL_SIZE = 21


class ChiefOrbit(NamedTuple):
    """Known orbit of the chief at t epochs.

    time_s (t,); position_m, velocity_m_s (t, 3) inertial; frame_rate_rad_s (t, 3) of its Hill frame, Hill axes.
    """

    time_s: Tensor
    position_m: Tensor
    velocity_m_s: Tensor
    frame_rate_rad_s: Tensor

    def rows(self, key: slice | Tensor) -> "ChiefOrbit":
        """Some of the epochs."""
        return ChiefOrbit(*(value[key] for value in self))


class Control(NamedTuple):
    """A control vector by its parts, each (..., 3); the field order is the layout."""

    thrust_m_s2: Tensor
    position_m: Tensor
    velocity_m_s: Tensor
    frame_rate_rad_s: Tensor
    end_position_m: Tensor
    end_velocity_m_s: Tensor
    end_frame_rate_rad_s: Tensor


def chief_orbit(time_s: Tensor, position_m: Tensor, velocity_m_s: Tensor, field: Field) -> ChiefOrbit:
    """Orbit of a logged chief; the frame rate's perturbing part comes from the field's J2.

    A small error in that part is harmless: it defines what "relative velocity" means, and every conversion uses the
    same definition.

    Args:
        time_s: (t,).
        position_m, velocity_m_s: inertial, z along the pole, (t, 3).
        field: gravity.
    """
    rate = frame_rate(position_m, velocity_m_s, acceleration(position_m, field))
    return ChiefOrbit(time_s, position_m, velocity_m_s, rate)


def hill_states(chief: ChiefOrbit, position_m: Tensor, velocity_m_s: Tensor) -> Tensor:
    """Relative states (t, 6) of a deputy with inertial position and velocity (t, 3) at the chief's epochs."""
    return to_hill(
        chief.position_m,
        chief.velocity_m_s,
        chief.frame_rate_rad_s,
        position_m - chief.position_m,
        velocity_m_s - chief.velocity_m_s,
    )


def chief_controls(
    chief: ChiefOrbit, thrust_m_s2: Tensor | None = None, *, stride: int = 1, first: bool = False
) -> Tensor:
    """Controls for the steps between the epochs.

    Args:
        chief: at t epochs.
        thrust_m_s2: acceleration of the deputy by its thrusters in Hill axes, held over each step, (steps, 3) or (3,).
        stride: epochs in a step.
        first: put a row before the others with the chief standing at the first epoch, for a filter whose first
            measurement comes at the prior's own time (dt = 0).

    Returns:
        (steps, 21), steps = (t - 1) // stride, one more with ``first``.

    Raises:
        ValueError: fewer than two epochs, thrust of another shape.
    """
    ends = torch.cat([chief.position_m, chief.velocity_m_s, chief.frame_rate_rad_s], -1)[::stride]
    if len(ends) < 2:
        raise ValueError(f"chief must have at least two epochs a stride of {stride} apart, got {len(chief.time_s)}")
    thrust = ends.new_zeros(len(ends) - 1, 3)
    if thrust_m_s2 is not None:
        if thrust_m_s2.shape not in ((3,), thrust.shape):
            raise ValueError(f"thrust_m_s2 must be {tuple(thrust.shape)} or (3,), got {tuple(thrust_m_s2.shape)}")
        thrust = thrust + thrust_m_s2
    controls = torch.cat([thrust, ends[:-1], ends[1:]], -1)
    if not first:
        return controls
    standing = torch.cat([ends.new_zeros(3), ends[0], ends[0]])
    return torch.cat([standing.unsqueeze(0), controls])


def split_control(u: Tensor | None) -> Control:
    """Parts of a control (..., 21).

    Raises:
        ValueError: no control, or another number of entries.
    """
    if u is None or u.shape[-1] != CONTROL_SIZE:
        got = "none" if u is None else f"shape {tuple(u.shape)}"
        raise ValueError(f"this law reads the chief's orbit from a control u (..., {CONTROL_SIZE}), got {got}")
    return Control(*u.split(3, -1))


def phase(u: Tensor) -> Tensor:
    """Cosine and sine of the chief's argument of latitude at the start of a step.

    Args:
        u: control (..., 21).

    Returns:
        (..., 2); NaN for an orbit in the equator's plane, which has no node to count from.
    """
    return orbit_phase(u[..., 3:6], u[..., 6:9])


def orbit_phase(position_m: Tensor, velocity_m_s: Tensor) -> Tensor:
    """Cosine and sine of the argument of latitude of inertial states (..., 3); (..., 2)."""
    momentum = torch.linalg.cross(position_m, velocity_m_s)
    node = torch.stack([-momentum[..., 1], momentum[..., 0]], -1)
    # z = r sin(i) sin(u) and |node| = h sin(i)
    scale = torch.linalg.vector_norm(position_m, dim=-1) * torch.linalg.vector_norm(node, dim=-1)
    cosine = (node * position_m[..., :2]).sum(-1) / scale
    sine = position_m[..., 2] * torch.linalg.vector_norm(momentum, dim=-1) / scale
    return torch.stack([cosine, sine], -1)
