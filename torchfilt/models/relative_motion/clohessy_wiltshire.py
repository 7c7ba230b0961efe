"""Clohessy-Wiltshire motion: linear relative dynamics about a circular orbit, with its exact step."""

import numpy as np
import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearForm, check_finite, hold, row_steps
from torchfilt.linalg import triangularize
from torchfilt.models.relative_motion.transforms import apply_matrix

Step = Tensor | float | None
# Gauss-Legendre nodes of the noise integral: exact to rounding for steps up to a revolution (frequency 2 n).
_NODES = 24
_HELD = ("matrix", "push", "scale_tril")


def cw_transition(mean_motion_rad_s: Tensor, dt_s: Tensor) -> Tensor:
    """State transition matrix of x'' - 2 n y' - 3 n^2 x = f_x, y'' + 2 n x' = f_y, z'' + n^2 z = f_z.

    Args:
        mean_motion_rad_s: n, scalar or (...).
        dt_s: (...).

    Returns:
        (..., 6, 6).

    Source: Clohessy and Wiltshire, Terminal guidance system for satellite rendezvous (1960).
    """
    n, t = torch.broadcast_tensors(mean_motion_rad_s, dt_s)
    angle = n * t
    s, c = angle.sin(), angle.cos()
    lag = 2 * (angle / 2).sin().square()  # 1 - cos without cancellation
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = [
        [1 + 3 * lag, zero, zero, s / n, 2 * lag / n, zero],
        [6 * (s - angle), one, zero, -2 * lag / n, (4 * s - 3 * angle) / n, zero],
        [zero, zero, c, zero, zero, s / n],
        [3 * n * s, zero, zero, c, 2 * s, zero],
        [-6 * n * lag, zero, zero, -2 * s, 1 - 4 * lag, zero],
        [zero, zero, -n * s, zero, zero, c],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def cw_input(mean_motion_rad_s: Tensor, dt_s: Tensor) -> Tensor:
    """Response (..., 6, 3) of the state to an acceleration held in Hill axes over a step; arguments as above."""
    n, t = torch.broadcast_tensors(mean_motion_rad_s, dt_s)
    angle = n * t
    s = angle.sin()
    lag = 2 * (angle / 2).sin().square()
    zero = torch.zeros_like(angle)
    rows = [
        [lag / n**2, 2 * (angle - s) / n**2, zero],
        [-2 * (angle - s) / n**2, (4 * lag - 1.5 * angle**2) / n**2, zero],
        [zero, zero, lag / n**2],
        [s / n, 2 * lag / n, zero],
        [-2 * lag / n, (4 * s - 3 * angle) / n, zero],
        [zero, zero, s / n],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def cw_noise_factor(mean_motion_rad_s: Tensor, dt_s: Tensor, acceleration_psd_m2_s3: Tensor) -> Tensor:
    """Lower factor (..., 6, 6) of the exact process noise of a white acceleration over a step.

    The integral of Phi B B^T Phi^T is a Gauss sum of outer products, so its factor is one triangularisation of their
    square roots: small steps keep all digits, which a Cholesky of the summed matrix (condition 1/dt^2) would not.
    """
    points, weights = (torch.from_numpy(a).to(dt_s) for a in np.polynomial.legendre.leggauss(_NODES))
    times = dt_s.unsqueeze(-1) * (points + 1) / 2
    responses = cw_transition(mean_motion_rad_s.unsqueeze(-1), times)[..., 3:]
    scale = (weights / 2 * dt_s.unsqueeze(-1) * acceleration_psd_m2_s3).sqrt()
    columns = responses * scale[..., None, None]
    return triangularize(columns.movedim(-3, -2).flatten(-2))


class ClohessyWiltshire(nn.Module):
    """Linear relative motion about a circular orbit; Hill state (..., 6), thrust acceleration u[..., :3] in m/s^2.

    Args:
        mean_motion_rad_s: n; number or scalar tensor (a parameter trains).
        acceleration_psd_m2_s3: white acceleration on each axis; number or scalar tensor.
        dt_s: usual time step: its matrices are made once and held. None: made at each call.

    Raises:
        ValueError: n not positive, psd negative, dt_s negative.
    """

    mean_motion_rad_s: Tensor
    acceleration_psd_m2_s3: Tensor
    matrix: Tensor
    push: Tensor
    scale_tril: Tensor

    def __init__(
        self,
        mean_motion_rad_s: Tensor | float,
        acceleration_psd_m2_s3: Tensor | float,
        dt_s: float | None = None,
    ) -> None:
        super().__init__()
        n, psd = _scalar(mean_motion_rad_s), _scalar(acceleration_psd_m2_s3)
        check_finite(n, "mean_motion_rad_s")
        if n.dim() != 0 or not bool(n.detach() > 0):
            raise ValueError(f"mean_motion_rad_s must be one positive number, got {mean_motion_rad_s}")
        if psd.dim() != 0 or not bool(psd.detach() >= 0):
            raise ValueError(f"acceleration_psd_m2_s3 must be one number >= 0, got {acceleration_psd_m2_s3}")
        if dt_s is not None and not dt_s >= 0:
            raise ValueError(f"dt_s must be >= 0, got {dt_s}")
        hold(self, "mean_motion_rad_s", n)
        hold(self, "acceleration_psd_m2_s3", psd)
        self.dt_s = dt_s
        self.held = dt_s is not None and not (n.requires_grad or psd.requires_grad)
        if self.held:
            assert dt_s is not None
            for name, value in zip(_HELD, self._make(dt_s), strict=True):
                self.register_buffer(name, value, persistent=False)
            self.register_load_state_dict_post_hook(_make_again)

    def _make(self, dt: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        n, psd = self.mean_motion_rad_s, self.acceleration_psd_m2_s3
        step = row_steps(dt, n)
        return cw_transition(n, step), cw_input(n, step), cw_noise_factor(n, step, psd)

    def _matrices(self, dt: Step) -> tuple[Tensor, Tensor, Tensor]:
        if dt is None:
            dt = self.dt_s
        if dt is None:
            raise ValueError("no time step: give dt_s to the law or dt to the call")
        if self.held and not isinstance(dt, Tensor) and dt == self.dt_s:
            return self.matrix, self.push, self.scale_tril
        return self._make(dt)

    def linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        """Matrices for thrust u (..., >= 3) and a step dt, number or (*lead, 1), s."""
        matrix, push, scale_tril = self._matrices(dt)
        offset = None if u is None else apply_matrix(push, u[..., :3].to(push.dtype))
        return LinearForm(matrix, offset, scale_tril)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the Hill state (..., 6) after a step."""
        matrix, offset, scale_tril = self.linear_form(u, dt)
        mean = apply_matrix(matrix.to(x.dtype), x)
        return Gaussian(mean if offset is None else mean + offset.to(x.dtype), scale_tril.to(x.dtype))


def _make_again(law: ClohessyWiltshire, incompatible: object) -> None:
    """Held matrices follow constants that were just loaded."""
    assert law.dt_s is not None
    for name, value in zip(_HELD, law._make(law.dt_s), strict=True):
        getattr(law, name).copy_(value)


def _scalar(value: Tensor | float) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
