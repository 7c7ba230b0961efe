"""The structured GP as what it is: a Bayesian linear regression on (harmonics of the phase) x (1, z).

On the unit circle the squared exponential is a Fourier series, exp(-|f - f'|^2 / 2 l^2) = sum_n c_n cos n(u - u'), with
c_n from Bessel functions that fall faster than any power. Everything is solved by one QR of [design / noise; I]: the
normal equations, and the kernel matrix itself, would square the condition number.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

# Coefficients below this share of the whole are dropped: far under the noise floor squared (1e-10) and under rounding.
_SERIES_TAIL = 1e-22


def harmonics(phase: Tensor, count: int) -> Tensor:
    """(1, cos u, ..., cos Mu, sin u, ..., sin Mu) of phase (..., 2) = (cos u, sin u); returns (..., 2M + 1)."""
    orders = torch.arange(1, count + 1, dtype=phase.dtype, device=phase.device)
    angle = torch.atan2(phase[..., 1:], phase[..., :1]) * orders
    return torch.cat([torch.ones_like(phase[..., :1]), angle.cos(), angle.sin()], -1)


def series_roots(lengthscale: Tensor) -> Tensor:
    """Square roots of the Fourier coefficients of the squared exponential on the unit circle.

    Args:
        lengthscale: (p,), of the chord |f - f'|.

    Returns:
        (p, 2M + 1) in the order of `harmonics`; M is where every series has fallen below 1e-22.

    Source: Abramowitz and Stegun, 9.6.34 (generating function of the modified Bessel functions).
    """
    from scipy.special import ive  # needed at freezing only

    kappa = lengthscale.detach().double().cpu().square().reciprocal().numpy()[:, None]
    count = 4
    while float(ive(count + 1, kappa).max()) > _SERIES_TAIL:
        count += 1
    orders = torch.arange(count + 1).numpy()[None]
    c = torch.as_tensor(ive(orders, kappa))
    return torch.cat([c[:, :1], 2 * c[:, 1:], 2 * c[:, 1:]], 1).sqrt()


class WeightPosterior(NamedTuple):
    """Posterior of the weights, standardised units.

    weights (H, p, 1 + d) and factor (H, p, 1 + d, K): the covariance of the weights is factor factor^T over (H, 1 + d).
    residual (p, S): outputs minus fitted mean. basis (p, S, K): orthonormal columns whose product basis basis^T is the
    smoother that takes the outputs to their fitted mean.
    """

    weights: Tensor
    factor: Tensor
    residual: Tensor
    basis: Tensor


def weight_posterior(
    z: Tensor, phase: Tensor, y: Tensor, prior: Tensor, lengthscale: Tensor, noise: Tensor
) -> WeightPosterior:
    """Exact posterior of the structured GP given training data.

    Args:
        z: (S, d) standardised states. phase: (S, 2) on the unit circle. y: (S, p) standardised outputs.
        prior: (p, 1 + d) prior standard deviations. lengthscale: (p,). noise: (p,) variances.

    Raises:
        ValueError: a phase is off the unit circle.
    """
    off = (torch.linalg.vector_norm(phase, dim=-1) - 1).abs().max().item() if len(phase) else 0.0
    if not off <= 1e-6:
        raise ValueError(
            f"the context of a structured GP is (cos u, sin u) on the unit circle, largest miss is {off:.3g}"
        )
    roots = series_roots(lengthscale).to(z)
    f = harmonics(phase, (roots.shape[1] - 1) // 2)
    h = pad(z, (1, 0), value=1.0)
    scale = (roots.unsqueeze(-1) * prior.unsqueeze(-2)).flatten(-2)  # (p, K)
    products = (f.unsqueeze(-1) * h.unsqueeze(-2)).flatten(-2)  # (S, K)
    deviation = noise.sqrt()[:, None, None]
    design = products * scale.unsqueeze(-2) / deviation
    size = scale.shape[-1]
    identity = torch.eye(size, dtype=z.dtype, device=z.device).expand(len(prior), size, size)
    q, r = torch.linalg.qr(torch.cat([design, identity], -2))
    basis, outputs = q[:, : len(z)], y.mT.unsqueeze(-1)
    data = basis.mT @ (outputs / deviation)
    weights = torch.linalg.solve_triangular(r, data, upper=True).squeeze(-1) * scale
    factor = torch.linalg.solve_triangular(r, identity, upper=True) * scale.unsqueeze(-1)
    shape = (f.shape[-1], h.shape[-1])
    return WeightPosterior(
        weights.unflatten(-1, shape).transpose(0, 1).contiguous(),
        factor.unflatten(-2, shape).transpose(0, 1).contiguous(),
        (outputs - deviation * (basis @ data)).squeeze(-1),
        basis,
    )
