"""Gaussian process over the gravity that a nominal law leaves out, learned from the steps of a pair in one log.

The residual of a step is not a free function of the state: it is the double integral of a difference of gravity at two
places. So the prior is put on the potential: harmonic outside the Earth, isotropic, with Kaula's spectrum and two
hyperparameters (its scale, and white acceleration for what the series leaves out). The process is a Bayesian linear
regression on (degree + 1)^2 - 4 coefficients, exact to rounding. Its posterior is collapsed once along the known orbit
of the chief, to an affine map of the state a step, and reaches the filter inside the control.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import triangularize
from torchfilt.missions.grace.potential import coefficient_degrees, gradient_basis, kaula_deviation
from torchfilt.models.relative_motion import CONTROL_SIZE, ChiefOrbit, chief_controls, from_curvilinear, hill_axes

# Offset of the step (6), its slope in position (6 x 3), the position it refers to (3), lower factor (21).
_TABLE = (6, 18, 3, 21)
EXTENDED_SIZE = CONTROL_SIZE + sum(_TABLE)
_SLOPE_STEP_M = 1000.0
_CHUNK = 64


class PotentialFit(NamedTuple):
    """Hyperparameters by marginal likelihood.

    scale: of Kaula's spectrum. psd_m2_s3: white acceleration. loss: negative log marginal likelihood per number.
    """

    scale: float
    psd_m2_s3: float
    loss: float


class PotentialGP(nn.Module):
    """Posterior over the normalised coefficients of a potential, degrees 2 to ``degree``.

    Args:
        mean: (W,) coefficients. factor: (W, W), their covariance is factor factor^T.
        degree: highest degree. mu_m3_s2: what the coefficients refer to.
        earth_rate_rad_s: the Earth-fixed axes are the inertial ones at time zero and turn about z at this rate.
        reference_m: place of the deputy (radial, along, across) in curvilinear coordinates, about which `controls` is
            affine; where the deputy was in the training hours.
    """

    mean: Tensor
    factor: Tensor
    reference_m: Tensor

    def __init__(
        self, mean: Tensor, factor: Tensor, degree: int, mu_m3_s2: float, earth_rate_rad_s: float, reference_m: Tensor
    ) -> None:
        super().__init__()
        size = len(coefficient_degrees(degree))
        if mean.shape != (size,) or factor.shape != (size, size) or reference_m.shape != (3,):
            raise ValueError(
                f"degree {degree} needs mean ({size},), factor ({size}, {size}) and reference (3,), got "
                f"{tuple(mean.shape)}, {tuple(factor.shape)} and {tuple(reference_m.shape)}"
            )
        self.degree, self.mu_m3_s2, self.earth_rate_rad_s = degree, mu_m3_s2, earth_rate_rad_s
        for name, value in (("mean", mean), ("factor", factor), ("reference_m", reference_m)):
            self.register_buffer(name, value.detach().clone())

    @torch.no_grad()
    def controls(self, chief: ChiefOrbit, *, stride: int) -> Tensor:
        """Controls of the chief's steps with what the process knows about each: see `PotentialTransition`.

        Args:
            chief: known orbit at evenly spaced epochs.
            stride: epochs in a step, even: the middle of a step is one of them.

        Returns:
            (steps, 69).

        Raises:
            ValueError: odd stride.
        """
        nodes = StepNodes.of(chief, stride)
        reference = pad(self.reference_m, (0, 3))
        tables = []
        for rows in torch.arange(len(nodes.dt_s)).split(_CHUNK):
            part = StepNodes(*(value[rows] for value in nodes))
            radius = torch.linalg.vector_norm(part.position_m, dim=-1)
            place = from_curvilinear(reference, radius)[..., :3]
            shifts = pad(_SLOPE_STEP_M * torch.eye(3, dtype=place.dtype), (0, 0, 1, 0))
            moved = (place.unsqueeze(-2) + shifts).movedim(-2, 0)  # (4, n, 3 nodes, 3)
            own = self._basis(part.position_m, part.time_s)
            centre, *beside = (self._step(part, at, own) for at in moved)
            offset = centre @ self.mean
            slope = torch.stack([(step @ self.mean - offset) / _SLOPE_STEP_M for step in beside], -1)
            factor = triangularize(centre @ self.factor)
            lower = factor[..., *torch.tril_indices(6, 6)]
            tables.append(torch.cat([offset, slope.flatten(-2), place[:, 0], lower], -1))
        return torch.cat([chief_controls(chief, stride=stride), torch.cat(tables)], -1)

    def response(self, nodes: "StepNodes", deputy_hill_m: Tensor) -> Tensor:
        """What unit coefficients add to the Hill state of a deputy at (n, 3 nodes, 3) over a step: (n, 6, W)."""
        return self._step(nodes, deputy_hill_m, self._basis(nodes.position_m, nodes.time_s))

    def _basis(self, position_m: Tensor, time_s: Tensor) -> Tensor:
        """Basis (n, 3 nodes, 3, W) at inertial positions (n, 3 nodes, 3), inertial axes."""
        angle = self.earth_rate_rad_s * time_s
        fixed = gradient_basis(_turn(position_m, -angle, -1).flatten(0, 1), self.degree, self.mu_m3_s2)
        return _turn(fixed.unflatten(0, time_s.shape), angle.unsqueeze(-1), -2)

    def _step(self, nodes: "StepNodes", deputy_hill_m: Tensor, chief_basis: Tensor) -> Tensor:
        """As `response`, given the basis at the chief."""
        deputy = nodes.position_m + (nodes.axes.mT @ deputy_hill_m.unsqueeze(-1)).squeeze(-1)
        first, middle, last = (self._basis(deputy, nodes.time_s) - chief_basis).unbind(1)
        dt = nodes.dt_s[:, None, None]
        # Simpson's rule for the integrals of a and of (t_end - t) a; gravity's change with the displacement itself is a
        # share (n dt)^2 / 6 of it, under 1e-3.
        axes = nodes.axes[:, -1]
        velocity = axes @ ((first + 4 * middle + last) * (dt / 6))
        position = axes @ ((first + 2 * middle) * (dt * dt / 6))
        rate = nodes.end_rate_rad_s.unsqueeze(-1).expand_as(position)
        return torch.cat([position, velocity - torch.linalg.cross(rate, position, dim=-2)], -2)


class StepNodes(NamedTuple):
    """Chief at start, middle and end of n steps.

    time_s (n, 3); position_m (n, 3, 3) inertial; axes (n, 3, 3, 3), inertial to Hill; end_rate_rad_s (n, 3) of the Hill
    frame at the end; dt_s (n,).
    """

    time_s: Tensor
    position_m: Tensor
    axes: Tensor
    end_rate_rad_s: Tensor
    dt_s: Tensor

    @classmethod
    def of(cls, chief: ChiefOrbit, stride: int) -> "StepNodes":
        """Nodes of steps of ``stride`` epochs.

        Raises:
            ValueError: odd stride.
        """
        rows = node_rows(len(chief.time_s), stride)
        axes = hill_axes(chief.position_m, chief.velocity_m_s)
        time = chief.time_s[rows]
        return cls(
            time, chief.position_m[rows], axes[rows], chief.frame_rate_rad_s[rows[:, 2]], time[:, 2] - time[:, 0]
        )


def node_rows(epochs: int, stride: int) -> Tensor:
    """Rows (n, 3) of start, middle and end of the steps in evenly spaced epochs."""
    if stride < 2 or stride % 2:
        raise ValueError(f"stride must be even, so that a step has an epoch in its middle; got {stride}")
    start = torch.arange(0, epochs - stride, stride)
    return torch.stack([start, start + stride // 2, start + stride], -1)


def fit_potential(
    chief: ChiefOrbit,
    relative: Tensor,
    residual: Tensor,
    *,
    stride: int,
    degree: int,
    mu_m3_s2: float,
    earth_rate_rad_s: float,
    reference_m: Tensor,
) -> tuple[PotentialGP, PotentialFit]:
    """Learn the potential from the velocity increments of a pair.

    Position increments are not used: they say the same over again, with the log's rounding on top.

    Args:
        chief: at t evenly spaced epochs, inertial, time zero being where Earth-fixed and inertial axes agree.
        relative: Hill states (t, 6) of the deputy at the same epochs.
        residual: what the nominal law misses at the end of each step of ``stride`` epochs, (n, 6).
        degree, mu_m3_s2, earth_rate_rad_s, reference_m: see `PotentialGP`.

    Returns:
        The posterior, and the hyperparameters with their marginal likelihood.
    """
    deviation = kaula_deviation(degree)
    size = len(deviation)
    empty = torch.zeros(size, dtype=torch.float64)
    prior = PotentialGP(empty, torch.zeros(size, size).double(), degree, mu_m3_s2, earth_rate_rad_s, reference_m)
    nodes, rows = StepNodes.of(chief, stride), node_rows(len(chief.time_s), stride)
    gram, moment = torch.zeros(size, size, dtype=torch.float64), empty.clone()
    for part in torch.arange(len(rows)).split(_CHUNK):
        some = StepNodes(*(value[part] for value in nodes))
        design = prior.response(some, relative[rows[part]][..., :3])[:, 3:] * deviation
        flat = design.flatten(0, 1)
        gram += flat.mT @ flat
        moment += flat.mT @ residual[part, 3:].flatten()
    values, vectors = torch.linalg.eigh(gram)
    values = values.clamp_min(0)
    projected = vectors.mT @ moment
    energy, count = float(residual[:, 3:].square().sum()), residual[:, 3:].numel()
    scale, noise, loss = _maximise(values, projected, energy, count)
    shrink = scale**2 / (1 + values * (scale**2 / noise**2))
    mean = deviation * (vectors @ (shrink * projected / noise**2))
    factor = deviation.unsqueeze(-1) * vectors * shrink.sqrt()
    gp = PotentialGP(mean, factor, degree, mu_m3_s2, earth_rate_rad_s, reference_m)
    return gp, PotentialFit(scale, noise**2 / float(nodes.dt_s[0]), loss)


def _maximise(values: Tensor, projected: Tensor, energy: float, count: int) -> tuple[float, float, float]:
    """Scale, noise deviation and loss at the maximum of the marginal likelihood.

    In the eigenvectors of the design's Gram matrix (eigenvalues ``values``, data ``projected``, |y|^2 = ``energy``) the
    likelihood is a sum over coefficients, so a step costs W operations.
    """
    start = 0.5 * math.log(energy / count)
    logs = torch.tensor([0.0, start - 2.0], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([logs], max_iter=100, tolerance_grad=1e-9, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        scale2, noise2 = (2 * logs).exp()
        ratio = scale2 / noise2
        fit = (energy - (projected.square() * ratio / (1 + values * ratio)).sum()) / noise2
        volume = torch.log1p(values * ratio).sum() + count * (noise2.log() + math.log(2 * math.pi))
        return (fit + volume) / (2 * count)

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss()
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(closure)
    scale, noise = logs.detach().exp().tolist()
    return scale, noise, float(loss().detach())


class PotentialTransition(nn.Module):
    """A nominal law plus what a `PotentialGP` knows; its controls come from `PotentialGP.controls`.

    The process is evaluated at the deputy's reference place and affine about it, the variance constant: over the 2 km
    that the deputy strays in a formation of 200 km this loses 1e-9 m/s^2.

    Args:
        nominal: law(x, u, dt) whose residual was learned; its own noise stays, the process's uncertainty adds to it.
        dt_s: length of the steps that the controls were made for.
    """

    def __init__(self, nominal: nn.Module, dt_s: float) -> None:
        super().__init__()
        if not dt_s > 0:
            raise ValueError(f"dt_s must be positive, got {dt_s}")
        self.nominal, self.dt_s = nominal, dt_s

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
        """Law of the relative state (..., 6) at the end of a step; u is (..., 69)."""
        if u is None or u.shape[-1] != EXTENDED_SIZE:
            got = "none" if u is None else f"shape {tuple(u.shape)}"
            raise ValueError(f"this law reads a control u (..., {EXTENDED_SIZE}) of PotentialGP.controls, got {got}")
        if dt is None or bool((torch.as_tensor(dt) - self.dt_s).abs().gt(1e-6 * self.dt_s).any()):
            raise ValueError(f"the controls were made for steps of {self.dt_s} s, got dt = {dt}")
        base = self.nominal(x, u[..., :CONTROL_SIZE], dt)
        offset, slope, place, lower = u[..., CONTROL_SIZE:].to(x.dtype).split(_TABLE, -1)
        moved = x[..., :3] - place
        correction = offset + (slope.unflatten(-1, (6, 3)) * moved.unsqueeze(-2)).sum(-1)
        known = u.new_zeros(*u.shape[:-1], 6, 6, dtype=x.dtype)
        known[..., *torch.tril_indices(6, 6)] = lower
        lead = torch.broadcast_shapes(base.scale_tril.shape[:-2], known.shape[:-2])
        columns = torch.cat([base.scale_tril.expand(*lead, 6, 6), known.expand(*lead, 6, 6)], -1)
        return Gaussian(base.mean + correction, triangularize(columns))


def _turn(vectors: Tensor, angle: Tensor, axis: int) -> Tensor:
    """Vectors turned about z by an angle whose dims are the leading ones; ``axis`` holds x, y, z."""
    x, y, z = vectors.unbind(axis)
    c, s = angle.cos(), angle.sin()
    return torch.stack([c * x - s * y, s * x + c * y, z], axis)
