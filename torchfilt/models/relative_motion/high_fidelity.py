"""Motion of the deputy under everything the truth has (J2, J3, J4, drag), as a law on batches: what filters can reach.

The difference of the two orbits is integrated, as in `truth`, so that a step keeps its digits; the chief's own motion
is interpolated from the control and computed once a control, not once a particle.
"""

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold
from torchfilt.models.ode import rk4
from torchfilt.models.relative_motion.chief import Control, split_control
from torchfilt.models.relative_motion.gravity import Field, acceleration, central_difference
from torchfilt.models.relative_motion.nominal import _frame_changes, _quintic, _thrust_nodes
from torchfilt.models.relative_motion.transforms import apply_matrix, white_acceleration_factor
from torchfilt.models.relative_motion.truth import FormationSettings

Step = Tensor | float | None


class ExactFormation(nn.Module):
    """Relative motion with the truth's own forces; called as ``law(x, u, dt)`` with the chief's orbit in u.

    Agrees with `propagate_relative` to 1e-8 m a step of 10 s in low orbit (tested).

    Args:
        settings: forces.
        acceleration_psd_m2_s3: process noise, white acceleration on each axis; zero for a model without error.
        steps: integration steps of fourth order in a time step.

    Raises:
        ValueError: negative psd, fewer than one step.
    """

    acceleration_psd_m2_s3: Tensor

    def __init__(self, settings: FormationSettings, acceleration_psd_m2_s3: float = 0.0, steps: int = 1) -> None:
        super().__init__()
        if not acceleration_psd_m2_s3 >= 0:
            raise ValueError(f"acceleration_psd_m2_s3 must be >= 0, got {acceleration_psd_m2_s3}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        self.settings, self.steps = settings, steps
        hold(self, "acceleration_psd_m2_s3", torch.tensor(acceleration_psd_m2_s3, dtype=torch.float64))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the relative state (..., 6) at the end of a step of dt seconds, Hill axes at both ends."""
        if dt is None:
            raise ValueError("this law needs the time step: call it as law(x, u, dt) with dt in seconds")
        control = split_control(u)
        into, out = _frame_changes(control)
        chief = _chief_nodes(control, dt, self.settings, self.steps)

        def rates(fraction: float, state: Tensor) -> Tensor:
            node = round(2 * self.steps * fraction)
            position, velocity, pull, thrust = (part[..., node, :] for part in chief)
            separation, relative_velocity = state.split(3, -1)
            far = perturbation(
                position + separation, velocity + relative_velocity, _deputy_drag(self.settings), self.settings
            )
            change = central_difference(separation, position, self.settings.mu_m3_s2) + (far - pull) + thrust
            return torch.cat([relative_velocity, change], -1)

        mean = apply_matrix(out, rk4(rates, apply_matrix(into, x), dt, self.steps))
        if isinstance(dt, Tensor):
            mean = torch.where(dt == 0, x, mean)
        elif dt == 0:
            mean = x.expand_as(mean)
        return Gaussian(mean, white_acceleration_factor(self.acceleration_psd_m2_s3, dt, control.end_frame_rate_rad_s))


def perturbation(
    position_m: Tensor, velocity_m_s: Tensor, ballistic_m2_kg: float, settings: FormationSettings
) -> Tensor:
    """Acceleration (..., 3) by J2, J3, J4 and drag, inertial axes with z along the pole, m/s^2.

    Args:
        position_m, velocity_m_s: (..., 3).
        ballistic_m2_kg: C_D A / m.
        settings: forces.
    """
    square = position_m.square().sum(-1, keepdim=True)
    radius = square.sqrt()
    outward = position_m / radius
    s = outward[..., 2:]
    s2, ratio = s * s, settings.earth_radius_m / radius
    pull = settings.mu_m3_s2 / square
    # Derivatives of the Legendre polynomials, degrees 2 to 5.
    d2, d3 = 3 * s, 7.5 * s2 - 1.5
    d4, d5 = s * (17.5 * s2 - 7.5), s2 * (39.375 * s2 - 26.25) + 1.875
    c2 = settings.j2 * pull * ratio**2
    c3 = settings.j3 * pull * ratio**3
    c4 = settings.j4 * pull * ratio**4
    pole = position_m.new_tensor([0.0, 0.0, 1.0])
    gravity = (c2 * d3 + c3 * d4 + c4 * d5) * outward - (c2 * d2 + c3 * d3 + c4 * d4) * pole
    spin = position_m.new_tensor([0.0, 0.0, settings.earth_rate_rad_s])
    wind = velocity_m_s - torch.linalg.cross(spin.expand_as(position_m), position_m)
    height = radius - (settings.earth_radius_m + settings.density_height_m)
    density = settings.density_kg_m3 * torch.exp(-height / settings.scale_height_m)
    speed = torch.linalg.vector_norm(wind, dim=-1, keepdim=True)
    return gravity - (0.5 * ballistic_m2_kg) * density * speed * wind


def _chief_drag(settings: FormationSettings) -> float:
    return settings.drag_coefficient * settings.chief_area_m2 / settings.chief_mass_kg


def _deputy_drag(settings: FormationSettings) -> float:
    return settings.drag_coefficient * settings.deputy_area_m2 / settings.deputy_mass_kg


def _chief_nodes(
    control: Control, dt: Tensor | float, settings: FormationSettings, steps: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Chief's position, velocity and perturbing acceleration, and the deputy's thrust, at 2 steps + 1 times of a step.

    Position by the quintic through both ends, velocity by the line between them (drag alone needs it).

    Returns:
        Four tensors (*lead, 2 steps + 1, 3), inertial axes.
    """
    field, drag = Field(settings.mu_m3_s2), _chief_drag(settings)
    ends = []
    for position, velocity in (
        (control.position_m, control.velocity_m_s),
        (control.end_position_m, control.end_velocity_m_s),
    ):
        force = acceleration(position, field) + perturbation(position, velocity, drag, settings)
        ends += [position, velocity * dt, force * (dt * dt)]
    count = 2 * steps + 1
    weights = control.position_m.new_tensor(_quintic(count))
    nodes = weights @ torch.stack(torch.broadcast_tensors(*ends), -2)
    fraction = torch.linspace(0, 1, count, dtype=nodes.dtype, device=nodes.device).unsqueeze(-1)
    first, last = control.velocity_m_s.unsqueeze(-2), control.end_velocity_m_s.unsqueeze(-2)
    velocity = first + fraction * (last - first)
    return nodes, velocity, perturbation(nodes, velocity, drag, settings), _thrust_nodes(control, nodes)
