"""A pair on a circular polar orbit, without the log: everything is a function of time."""

import torch

from torchfilt.missions.grace.potential import kaula_deviation
from torchfilt.missions.grace.potential_gp import StepNodes, fit_potential, node_rows
from torchfilt.models.relative_motion import J2_EARTH, Field, TwoBody, chief_orbit, hill_states

MU = 3.986004415e14
RATE = 7.2921158553e-5
RADIUS_M = 6.84e6
LEAD_RAD = 0.033


def positions(time_s, lead=0.0, height=0.0):
    """Inertial position and velocity (t, 3) on a circle inclined by 89 degrees."""
    n = (MU / RADIUS_M**3) ** 0.5
    angle, r = n * time_s + lead, RADIUS_M + height
    ahead = torch.tensor([0.6 * 0.0175, 0.8 * 0.0175, 0.99985], dtype=torch.float64)
    node = torch.tensor([0.8, -0.6, 0.0], dtype=torch.float64)
    c, s = angle.cos().unsqueeze(-1), angle.sin().unsqueeze(-1)
    return r * (c * node + s * ahead), r * n * (c * ahead - s * node)


def pair(steps, step_s=60.0, parts=2):
    """Chief at the epochs of ``steps`` steps, ``parts`` epochs a step, and the deputy's Hill states."""
    time = torch.arange(steps * parts + 1, dtype=torch.float64) * (step_s / parts)
    chief = chief_orbit(time, *positions(time), Field(MU, J2_EARTH))
    return chief, hill_states(chief, *positions(time, LEAD_RAD, 300.0))


def fit(chief, relative, residual, degree=4):
    """The learner with this problem's constants."""
    return fit_potential(
        chief,
        relative,
        residual,
        stride=2,
        degree=degree,
        mu_m3_s2=MU,
        earth_rate_rad_s=RATE,
        reference_m=torch.tensor([300.0, LEAD_RAD * RADIUS_M, 0.0], dtype=torch.float64),
    )


def learned(steps=60, degree=4, seed=0, noise=2e-6, scale=1.0):
    """A posterior from simulated residuals of coefficients drawn from the prior; also those and the design."""
    chief, relative = pair(steps)
    size = (degree + 1) ** 2 - 4
    empty, _ = fit(chief, relative, torch.ones(steps, 6, dtype=torch.float64), degree)
    nodes, rows = StepNodes.of(chief, 2), node_rows(len(chief.time_s), 2)
    design = empty.response(nodes, relative[rows][..., :3])
    generator = torch.Generator().manual_seed(seed)
    truth = scale * kaula_deviation(degree) * torch.randn(size, generator=generator, dtype=torch.float64)
    residual = design @ truth
    residual[:, 3:] += noise * torch.randn(steps, 3, generator=generator, dtype=torch.float64)
    gp, found = fit(chief, relative, residual, degree)
    return gp, found, truth, design, residual, (chief, relative)


def nominal(psd=1e-12):
    """J2 motion about the chief."""
    return TwoBody(psd, MU, j2=J2_EARTH, steps=3)
