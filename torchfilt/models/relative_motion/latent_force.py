"""Relative motion under an unknown acceleration that repeats with the orbit, learned while filtering."""

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.gp.fourier import harmonics
from torchfilt.laws import LinearForm, hold, row_steps
from torchfilt.models.relative_motion.chief import Control, orbit_phase, split_control
from torchfilt.models.relative_motion.clohessy_wiltshire import ClohessyWiltshire, cw_input
from torchfilt.models.relative_motion.transforms import apply_matrix, block_diagonal

Step = Tensor | float | None


class HarmonicForce(nn.Module):
    """Clohessy-Wiltshire motion plus an acceleration in harmonics of the chief's argument of latitude u.

    State (..., 6 + 3 (2 M + 1)): the Hill state, then for each Hill axis the coefficients of
    (1, cos u, ..., cos M u, sin u, ..., sin M u) in m/s^2. The differential perturbations of a formation repeat with
    the orbit, so a few constants hold them. Linear in the state: an exact Kalman filter applies.

    Args:
        law: linear relative motion; its noise is what the harmonics leave out.
        order: M.
        drift_psd_m2_s5: white rate of change of each coefficient; zero keeps them constant.

    Raises:
        ValueError: order below 1, negative drift.

    Source: Alvarez, Luengo, Lawrence, Linear latent force models using Gaussian processes, IEEE TPAMI 35 (2013), for
        the idea; the force here is a trigonometric polynomial of the phase.
    """

    drift_psd_m2_s5: Tensor

    def __init__(self, law: ClohessyWiltshire, order: int = 3, drift_psd_m2_s5: Tensor | float = 0.0) -> None:
        super().__init__()
        if order < 1:
            raise ValueError(f"order must be at least 1, got {order}")
        drift = drift_psd_m2_s5 if isinstance(drift_psd_m2_s5, Tensor) else torch.tensor(drift_psd_m2_s5).double()
        if not bool((drift.detach() >= 0).all()):
            raise ValueError(f"drift_psd_m2_s5 must be >= 0, got {drift_psd_m2_s5}")
        self.law, self.order = law, order
        hold(self, "drift_psd_m2_s5", drift)

    @property
    def force_size(self) -> int:
        """Number of coefficients, 3 (2 M + 1)."""
        return 3 * (2 * self.order + 1)

    def linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        """Matrices for controls (*lead, 21) and a step dt in s; the force is that of the middle of the step."""
        control = split_control(u)
        step = self.law.dt_s if dt is None else dt
        if step is None:
            raise ValueError("no time step: give dt_s to the law or dt to the call")
        motion = self.law.linear_form(u, step)
        basis = self._basis(control).to(motion.matrix)
        n = self.law.mean_motion_rad_s
        length = row_steps(step, n)
        push = cw_input(n, length)
        # Column block of axis a: response to a unit acceleration along it, times the harmonics.
        force = (push.unsqueeze(-1) * basis[..., None, None, :]).flatten(-2)
        lead = torch.broadcast_shapes(force.shape[:-2], motion.matrix.shape[:-2])
        size = self.force_size
        keep = torch.eye(size, dtype=force.dtype, device=force.device).expand(*lead, size, size)
        top = torch.cat([motion.matrix.expand(*lead, 6, 6), force.expand(*lead, 6, size)], -1)
        matrix = torch.cat([top, torch.nn.functional.pad(keep, (6, 0))], -2)
        drift = (self.drift_psd_m2_s5 * length).sqrt().unsqueeze(-1).expand(*length.shape, size)
        factor = block_diagonal(motion.scale_tril, torch.diag_embed(drift))
        offset = None if motion.offset is None else torch.nn.functional.pad(motion.offset, (0, size))
        return LinearForm(matrix, offset, factor)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 6 + 3 (2 M + 1)) after a step."""
        matrix, offset, scale_tril = self.linear_form(u, dt)
        mean = apply_matrix(matrix.to(x.dtype), x)
        return Gaussian(mean if offset is None else mean + offset.to(x.dtype), scale_tril.to(x.dtype))

    def _basis(self, control: Control) -> Tensor:
        """Harmonics of the phase half-way through the step, (*lead, 2 M + 1)."""
        begin = orbit_phase(control.position_m, control.velocity_m_s)
        end = orbit_phase(control.end_position_m, control.end_velocity_m_s)
        return harmonics(begin + end, self.order)
