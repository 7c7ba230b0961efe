"""Errors of an inertial navigation system as a linear system, for one steady manoeuvre at a time.

Over flat ground that does not turn, in level axes that turn with the heading (right, forward, up): seen from there, a
straight flight, an acceleration and a level turn are each constant, so a flight is piecewise constant without
approximation, and the state does not jump where one piece meets the next.

With position fixes level flight shows 11 of the 15 errors, 13 with a heading; with an acceleration after it 14, with a
turn after it 15. The Earth's rate, left out here, would show the gyro's bias about up in level flight too (12), with a
singular value four orders below the others in steps of a second.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfilt.laws import check_finite
from torchfilt.models.attitude import skew, to_matrix

INS_ERROR_NAMES = tuple(
    f"{part} {axis}"
    for part in ("attitude", "velocity", "position", "gyro bias", "accelerometer bias")
    for axis in ("right", "forward", "up")
)
"""States of `ins_error_pair`; the biases' axes are those of the body."""

INS_ERROR_SCALE = torch.tensor([1e-2] * 3 + [1.0] * 3 + [10.0] * 3 + [1e-3] * 3 + [1e-1] * 3, dtype=torch.float64)
"""Sizes that these errors have with micromachined sensors: rad, m/s, m, rad/s, m/s^2."""

_ROWS = {"position": 3, "velocity": 3, "height": 1, "speed": 1, "heading": 1, "level": 2}


def ins_error_pair(
    specific_force_m_s2: Tensor,
    turn_rate_rad_s: Tensor | float = 0.0,
    sensors: Sequence[str] = ("position",),
    attitude: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Matrices (a, c) of the 15 errors during one steady manoeuvre, for `obsv` and its relatives.

    Errors are computed minus true: attitude (rotation vector), velocity, position in the level axes, biases of gyro and
    accelerometer in body axes (measured minus true).

    Args:
        specific_force_m_s2: (*batch, 3), what the accelerometer feels, right, forward, up: [0, 0, 9.81] in level
            flight, with [0, x, 9.81] it gathers speed, a turn to the left at speed v has [-v * turn_rate, 0, 9.81].
        turn_rate_rad_s: of the heading, about up, positive to the left; number or (*batch).
        sensors: any of "position" (3 rows), "velocity" (3), "height" (1), "speed" (1: along forward), "heading" (1:
            clockwise, of the body's forward axis), "level" (2: attitude right and forward, from a vertical).
        attitude: (*batch, 4) quaternion from body to the level axes (pitch and bank); default level.

    Returns:
        a (*batch, 15, 15) and c (*batch, m, 15).

    Raises:
        TypeError: a force that is not a floating-point tensor. ValueError: shapes, NaN, unknown sensors or none, a nose
            that points straight up where the heading is measured.

    Source: Titterton and Weston, Strapdown Inertial Navigation Technology (2004), without Earth's rate and curvature;
        rows of the heading as in `torchfilt.models.inertial.error_model`.
    """
    force = specific_force_m_s2
    if not isinstance(force, Tensor) or not force.is_floating_point():
        raise TypeError("specific_force_m_s2 must be a floating-point tensor")
    if force.shape[-1:] != (3,):
        raise ValueError(f"specific_force_m_s2 must be (*batch, 3), got shape {tuple(force.shape)}")
    check_finite(force, "specific_force_m_s2")
    rate = torch.as_tensor(turn_rate_rad_s, dtype=force.dtype, device=force.device)
    check_finite(rate, "turn_rate_rad_s")
    unknown = [name for name in sensors if name not in _ROWS]
    if unknown or not sensors or isinstance(sensors, str):
        raise ValueError(f"sensors must be some of {', '.join(_ROWS)}, got {sensors!r}")
    eye = torch.eye(3, dtype=force.dtype, device=force.device)
    if attitude is not None:
        if attitude.shape[-1:] != (4,):
            raise ValueError(f"attitude must be a quaternion (*batch, 4), got shape {tuple(attitude.shape)}")
        check_finite(attitude, "attitude")
        eye = to_matrix(attitude.to(force))
    lead = torch.broadcast_shapes(force.shape[:-1], rate.shape, eye.shape[:-2])
    body = eye.expand(*lead, 3, 3)
    up = torch.nn.functional.pad(rate.unsqueeze(-1), (2, 0)).expand(*lead, 3)
    return _motion(force.expand(*lead, 3), up, body), _measured(sensors, body)


def _motion(force: Tensor, rate: Tensor, body: Tensor) -> Tensor:
    lead, zero = force.shape[:-1], torch.zeros_like(body)
    turning, unit = -skew(rate), torch.eye(3, dtype=force.dtype, device=force.device).expand(*lead, 3, 3)
    rows = [
        [turning, zero, zero, body, zero],
        [-skew(force), turning, zero, zero, body],
        [zero, unit, turning, zero, zero],
        [zero] * 5,
        [zero] * 5,
    ]
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


def _measured(sensors: Sequence[str], body: Tensor) -> Tensor:
    unit = torch.eye(15, dtype=body.dtype, device=body.device).expand(*body.shape[:-2], 15, 15)
    rows = {
        "position": unit[..., 6:9, :],
        "velocity": unit[..., 3:6, :],
        "height": unit[..., 8:9, :],
        "speed": unit[..., 4:5, :],
        "level": unit[..., 0:2, :],
    }
    if "heading" in sensors:
        ahead = body[..., 1]
        level = torch.linalg.vector_norm(ahead[..., :2], dim=-1)
        if bool((level.detach() < math.sqrt(torch.finfo(body.dtype).eps)).any()):
            raise ValueError("there is no heading where the nose points straight up or down")
        # The forward axis moves by attitude x ahead; the heading is the angle of what is left of it on the ground.
        moved = -skew(ahead)
        turned = ahead[..., 1, None] * moved[..., 0, :] - ahead[..., 0, None] * moved[..., 1, :]
        rows["heading"] = torch.nn.functional.pad(turned / level.square().unsqueeze(-1), (0, 12)).unsqueeze(-2)
    return torch.cat([rows[name] for name in sensors], -2)
