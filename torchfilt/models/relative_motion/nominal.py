"""Motion of the deputy about the chief's known orbit: exact differential gravity, or its linearisation.

Both laws are called as ``law(x, u, dt)`` with the chief's orbit in the control u (see `chief`), so either can be the
nominal dynamics of a learned transition. Quantities of the chief are computed once a control, not once a particle, in
the precision of u: u may stay float64 where x is float32. Between the two ends of a step the chief is interpolated by
the quintic through positions, velocities and gravity (error below 1e-5 m for a 60 s step in low orbit).
"""

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearForm, hold
from torchfilt.models.ode import nystrom4
from torchfilt.models.relative_motion.chief import Control, split_control
from torchfilt.models.relative_motion.frames import hill_axes
from torchfilt.models.relative_motion.gravity import (
    EARTH_RADIUS_M,
    MU_M3_S2,
    Field,
    acceleration,
    difference,
    gradient,
)
from torchfilt.models.relative_motion.transforms import (
    apply_matrix,
    rate_matrix,
    rotate_columns,
    white_acceleration_factor,
)

Step = Tensor | float | None


class TwoBody(nn.Module):
    """Deputy under the same gravity as the chief, integrated as the difference of the two, without linearisation.

    Args:
        acceleration_psd_m2_s3: process noise, white acceleration on each axis; number or scalar tensor (a parameter
            trains).
        mu_m3_s2: gravitational parameter.
        j2: flattening coefficient for the pair's differential gravity; None for a point mass.
        earth_radius_m: radius that j2 refers to.
        steps: integration steps of fourth order in a time step; one serves 10 s in low orbit.

    Raises:
        ValueError: negative psd, mu or step count that make no sense.
    """

    acceleration_psd_m2_s3: Tensor

    def __init__(
        self,
        acceleration_psd_m2_s3: Tensor | float,
        mu_m3_s2: float = MU_M3_S2,
        *,
        j2: float | None = None,
        earth_radius_m: float = EARTH_RADIUS_M,
        steps: int = 1,
    ) -> None:
        super().__init__()
        self.field = _field(mu_m3_s2, j2, earth_radius_m)
        self.steps = _positive_steps(steps)
        hold(self, "acceleration_psd_m2_s3", _psd(acceleration_psd_m2_s3))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the relative state (..., 6) at the end of a step of dt seconds, Hill axes at both ends."""
        control, dt = split_control(u), _needed(dt)
        radius, thrust = _chief_nodes(control, dt, self.field, self.steps)
        radius, thrust = radius.to(x.dtype), thrust.to(x.dtype)
        into, out = _frame_changes(control)
        inertial = apply_matrix(into.to(x.dtype), x)

        def pull(fraction: float, separation: Tensor) -> Tensor:
            node = round(2 * self.steps * fraction)
            return difference(separation, radius[..., node, :], self.field) + thrust[..., node, :]

        separation, velocity = nystrom4(pull, inertial[..., :3], inertial[..., 3:], _cast(dt, x), self.steps)
        mean = apply_matrix(out.to(x.dtype), torch.cat([separation, velocity], -1))
        return Gaussian(_still(mean, x, dt), _noise(self.acceleration_psd_m2_s3, control, dt).to(x.dtype))


class LinearTimeVarying(nn.Module):
    """Motion linearised about the chief's known orbit, whatever its eccentricity: one 6 x 6 matrix a step.

    Arguments as in `TwoBody`. Good while the separation is a small part of the orbit's radius: the neglected term is
    of order 3 n^2 s^2 / r (4e-8 m/s^2 at 500 m).
    """

    acceleration_psd_m2_s3: Tensor

    def __init__(
        self,
        acceleration_psd_m2_s3: Tensor | float,
        mu_m3_s2: float = MU_M3_S2,
        *,
        j2: float | None = None,
        earth_radius_m: float = EARTH_RADIUS_M,
        steps: int = 1,
    ) -> None:
        super().__init__()
        self.field = _field(mu_m3_s2, j2, earth_radius_m)
        self.steps = _positive_steps(steps)
        hold(self, "acceleration_psd_m2_s3", _psd(acceleration_psd_m2_s3))

    def linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        """State transition matrix, displacement by the thrust and noise factor for controls (*lead, 21)."""
        control, dt = split_control(u), _needed(dt)
        radius, thrust = _chief_nodes(control, dt, self.field, self.steps)
        slopes = gradient(radius, self.field)
        into, out = _frame_changes(control)
        # Columns: six initial states and the response to the thrust from rest.
        push = torch.nn.functional.pad(thrust.unsqueeze(-1), (6, 0))
        start = torch.nn.functional.pad(into, (0, 1))

        def pull(fraction: float, separation: Tensor) -> Tensor:
            node = round(2 * self.steps * fraction)
            return slopes[..., node, :, :] @ separation + push[..., node, :, :]

        h = dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt
        separation, velocity = nystrom4(pull, start[..., :3, :], start[..., 3:, :], h, self.steps)
        response = out @ torch.cat([separation, velocity], -2)
        matrix, offset = response[..., :6], response[..., 6]
        if not isinstance(dt, Tensor) and dt == 0:
            matrix = torch.eye(6, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
        elif isinstance(dt, Tensor):
            identity = torch.eye(6, dtype=matrix.dtype, device=matrix.device)
            matrix = torch.where((dt == 0).unsqueeze(-1), identity, matrix)
        return LinearForm(matrix, offset, _noise(self.acceleration_psd_m2_s3, control, dt))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the relative state (..., 6) at the end of a step of dt seconds."""
        matrix, offset, scale_tril = self.linear_form(u, dt)
        assert offset is not None
        mean = apply_matrix(matrix.to(x.dtype), x) + offset.to(x.dtype)
        return Gaussian(mean, scale_tril.to(x.dtype))


def _field(mu_m3_s2: float, j2: float | None, earth_radius_m: float) -> Field:
    if not (mu_m3_s2 > 0 and earth_radius_m > 0):
        raise ValueError(f"mu_m3_s2 and earth_radius_m must be positive, got {mu_m3_s2} and {earth_radius_m}")
    return Field(mu_m3_s2, 0.0 if j2 is None else j2, earth_radius_m)


def _positive_steps(steps: int) -> int:
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    return steps


def _psd(value: Tensor | float) -> Tensor:
    psd = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
    if psd.dim() != 0 or not bool(psd.detach() >= 0):
        raise ValueError(f"acceleration_psd_m2_s3 must be one number >= 0, got {value}")
    return psd


def _needed(dt: Step) -> Tensor | float:
    if dt is None:
        raise ValueError("this law needs the time step: call it as law(x, u, dt) with dt in seconds")
    return dt


def _cast(dt: Tensor | float, x: Tensor) -> Tensor | float:
    return dt.to(x.dtype) if isinstance(dt, Tensor) else dt


def _still(mean: Tensor, x: Tensor, dt: Tensor | float) -> Tensor:
    """No motion where dt = 0, whatever epochs the control names."""
    if isinstance(dt, Tensor):
        return torch.where(dt == 0, x, mean)
    return x.expand_as(mean) if dt == 0 else mean


def _noise(psd: Tensor, control: Control, dt: Tensor | float) -> Tensor:
    rate = control.end_frame_rate_rad_s
    return white_acceleration_factor(psd.to(rate.dtype), dt, rate)


def _frame_changes(control: Control) -> tuple[Tensor, Tensor]:
    """Matrices from the Hill state at the start to inertial axes, and from there to the Hill state at the end."""
    start = hill_axes(control.position_m, control.velocity_m_s)
    end = hill_axes(control.end_position_m, control.end_velocity_m_s)
    turn = start.mT
    spin = rate_matrix(-control.frame_rate_rad_s)  # the way back has the other sign: v + w x p
    into = torch.cat([turn @ spin[..., :3, :], turn @ spin[..., 3:, :]], -2)
    return into, rotate_columns(rate_matrix(control.end_frame_rate_rad_s), end)


def _chief_nodes(control: Control, dt: Tensor | float, field: Field, steps: int) -> tuple[Tensor, Tensor]:
    """Chief's position and the deputy's thrust acceleration, inertial axes, at 2 steps + 1 equidistant times.

    Returns:
        Two tensors (*lead, 2 steps + 1, 3).
    """
    first, last = control.position_m, control.end_position_m
    data = [
        first,
        control.velocity_m_s * dt,
        acceleration(first, field) * (dt * dt),
        last,
        control.end_velocity_m_s * dt,
        acceleration(last, field) * (dt * dt),
    ]
    weights = first.new_tensor(_quintic(2 * steps + 1))
    nodes = weights @ torch.stack(torch.broadcast_tensors(*data), -2)
    return nodes, _thrust_nodes(control, nodes)


def _thrust_nodes(control: Control, nodes: Tensor) -> Tensor:
    """Thrust held in Hill axes, turned to inertial axes at the nodes; the orbit normal moves linearly between them."""
    count = nodes.shape[-2]
    fraction = torch.linspace(0, 1, count, dtype=nodes.dtype, device=nodes.device).unsqueeze(-1)
    start = torch.linalg.cross(control.position_m, control.velocity_m_s).unsqueeze(-2)
    stop = torch.linalg.cross(control.end_position_m, control.end_velocity_m_s).unsqueeze(-2)
    normal = start + fraction * (stop - start)
    x = nodes / torch.linalg.vector_norm(nodes, dim=-1, keepdim=True)
    y = torch.linalg.cross(*torch.broadcast_tensors(normal, x))
    y = y / torch.linalg.vector_norm(y, dim=-1, keepdim=True)
    z = torch.linalg.cross(x, y)
    fx, fy, fz = control.thrust_m_s2.unsqueeze(-2).split(1, -1)
    return fx * x + fy * y + fz * z


def _quintic(count: int) -> list[list[float]]:
    """Weights of (p0, v0 dt, a0 dt^2, p1, v1 dt, a1 dt^2) at equidistant fractions of a step."""
    rows = []
    for k in range(count):
        s = k / (count - 1)
        s2, s3, s4, s5 = s**2, s**3, s**4, s**5
        rise = 10 * s3 - 15 * s4 + 6 * s5
        rows.append(
            [
                1 - rise,
                s - 6 * s3 + 8 * s4 - 3 * s5,
                0.5 * s2 - 1.5 * s3 + 1.5 * s4 - 0.5 * s5,
                rise,
                -4 * s3 + 7 * s4 - 3 * s5,
                0.5 * s3 - s4 + 0.5 * s5,
            ]
        )
    return rows
