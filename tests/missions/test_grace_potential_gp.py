"""The Gaussian process over a potential: posterior and evidence, the step's integrals, the law that a filter calls."""

import numpy as np
import pytest
import torch
from grace_problem import LEAD_RAD, MU, RADIUS_M, RATE, fit, learned, nominal, pair, positions
from oracles import potential_oracle as oracle

from torchfilt.missions.grace.potential import gradient_basis, kaula_deviation
from torchfilt.missions.grace.potential_gp import (
    EXTENDED_SIZE,
    PotentialGP,
    PotentialTransition,
    StepNodes,
    node_rows,
)
from torchfilt.models.relative_motion import hill_axes


@pytest.fixture(scope="module")
def world():
    return learned()


def test_posterior_and_evidence_equal_function_space_regression(world):
    gp, found, _, design, residual, _ = world
    flat, y = design[:, 3:].flatten(0, 1).numpy(), residual[:, 3:].flatten().numpy()
    noise = (found.psd_m2_s3 * 60) ** 0.5
    deviation = found.scale * kaula_deviation(4).numpy()
    mean, covariance, evidence = oracle.posterior(flat, deviation, noise, y)
    # The oracle subtracts large numbers: prior over posterior variance is 1e4 here.
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(gp.mean.numpy(), mean, rtol=0, atol=1e-6 * scale.max())
    own = (gp.factor @ gp.factor.mT).numpy()
    np.testing.assert_allclose(own, covariance, rtol=0, atol=1e-6 * scale.max() ** 2)
    assert found.loss == pytest.approx(-evidence / len(y), rel=1e-9)


def test_hyperparameters_are_at_the_maximum(world):
    _, found, _, design, residual, _ = world
    flat, y = design[:, 3:].flatten(0, 1).numpy(), residual[:, 3:].flatten().numpy()
    noise = (found.psd_m2_s3 * 60) ** 0.5

    def evidence(scale, sd):
        return oracle.posterior(flat, scale * kaula_deviation(4).numpy(), sd, y)[2]

    best = evidence(found.scale, noise)
    for factor in (0.95, 1.05):
        assert evidence(found.scale * factor, noise) < best
        assert evidence(found.scale, noise * factor) < best


def test_coefficients_lie_where_the_posterior_says():
    """Squared standardised errors of 20 worlds x 21 coefficients: chi-square, 420 degrees of freedom, up to the two
    hyperparameters; bounds at four standard deviations (false alarm 1e-4)."""
    total, scales, noises = 0.0, [], []
    for seed in range(20):
        gp, found, truth, *_ = learned(seed=seed, noise=1e-5)
        white = torch.linalg.solve(gp.factor, truth - gp.mean)
        total += float(white.square().sum())
        scales.append(found.scale)
        noises.append((found.psd_m2_s3 * 60) ** 0.5)
    assert abs(total - 420) < 4 * 840**0.5
    # Scale from 21 numbers: relative deviation 1 / sqrt(42) a world; noise from 180.
    assert abs(np.mean(scales) - 1) < 4 / (42 * 20) ** 0.5 + 0.05
    assert abs(np.mean(noises) / 1e-5 - 1) < 4 / (2 * 160 * 20) ** 0.5 + 0.01


def test_learns_nothing_from_silence():
    """Residuals of pure noise: no potential, and the noise as it is."""
    chief, relative = pair(60)
    residual = 1e-4 * torch.randn(60, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    _, found = fit(chief, relative, residual)
    assert found.scale < 0.05
    # 180 numbers: 1 / sqrt(360) = 5 % of the deviation, four of them.
    assert (found.psd_m2_s3 * 60) ** 0.5 == pytest.approx(1e-4, rel=0.22)


def exact_response(gp, start, step_s, weights):
    """Integrals of the exact path by 40 Gauss nodes: what the coefficients add to the Hill state."""
    nodes, quadrature = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(40))
    elapsed, quadrature = step_s * (nodes + 1) / 2, step_s * quadrature / 2
    time = start + elapsed
    total = torch.zeros(len(time), 3, dtype=torch.float64)
    for sign, (place, _) in ((-1, positions(time)), (1, positions(time, LEAD_RAD, 300.0))):
        angle = RATE * time
        c, s = angle.cos(), angle.sin()
        fixed = torch.stack([c * place[:, 0] + s * place[:, 1], c * place[:, 1] - s * place[:, 0], place[:, 2]], -1)
        pull = gradient_basis(fixed, gp.degree, MU) @ weights
        turned = torch.stack([c * pull[:, 0] - s * pull[:, 1], s * pull[:, 0] + c * pull[:, 1], pull[:, 2]], -1)
        total += sign * turned
    velocity = (quadrature.unsqueeze(-1) * total).sum(0)
    position = ((quadrature * (step_s - elapsed)).unsqueeze(-1) * total).sum(0)
    end = positions(torch.tensor([start + step_s], dtype=torch.float64))
    axes = hill_axes(*end)[0]
    position, velocity = axes @ position, axes @ velocity
    rate = torch.tensor([0.0, 0.0, (MU / RADIUS_M**3) ** 0.5], dtype=torch.float64)
    return torch.cat([position, velocity - torch.linalg.cross(rate, position)])


def test_response_of_a_step_converges_with_its_length(world):
    """Simpson's rule: relative error of order 4 for velocities, 3 or better for positions."""
    gp = world[0]
    weights = gp.mean
    errors = []
    for step in (240.0, 120.0, 60.0):
        chief, relative = pair(3, step)
        nodes, rows = StepNodes.of(chief, 2), node_rows(len(chief.time_s), 2)
        found = gp.response(nodes, relative[rows][..., :3]) @ weights
        worst = torch.zeros(2, dtype=torch.float64)
        for k in range(3):
            expected = exact_response(gp, k * step, step, weights)
            apart = (found[k] - expected).unflatten(0, (2, 3)).norm(dim=-1) / expected.unflatten(0, (2, 3)).norm(dim=-1)
            worst = torch.maximum(worst, apart)
        errors.append(worst)
    position, velocity = torch.stack(errors).T
    # The frame rate of the chief follows the J2 field here, the exact path does not: 1e-6 of the velocity.
    assert velocity[2] < 1e-4 and position[2] < 1e-3
    assert velocity[0] / velocity[1] > 11 and velocity[1] / velocity[2] > 11
    assert position[0] / position[1] > 6 and position[1] / position[2] > 6


def test_law_is_the_nominal_and_the_posterior_of_the_step(world):
    gp, _, _, _, _, (chief, relative) = world
    controls = gp.controls(chief, stride=2)
    assert controls.shape == (60, EXTENDED_SIZE)
    law, base = PotentialTransition(nominal(), 60.0), nominal()
    nodes, rows = StepNodes.of(chief, 2), node_rows(len(chief.time_s), 2)
    # Off the reference by hundreds of metres, the same all through the step.
    shift = torch.tensor([300.0, -800.0, 500.0], dtype=torch.float64)
    place = controls[:, 45:48].unsqueeze(1)
    x = torch.cat([controls[:, 45:48] + shift, relative[rows[:, 0], 3:]], -1)
    predicted, before = law(x, controls, 60.0), base(x, controls[:, :21], 60.0)
    response = gp.response(nodes, place.expand(-1, 3, -1) + shift)
    expected = response @ gp.mean
    size = expected.unflatten(-1, (2, 3)).norm(dim=-1).mean(0).repeat_interleave(3)
    # Reference places of the three nodes differ by nothing on a circle; the second-order term is (0.5 km / 1700 km)^2.
    assert ((predicted.mean - before.mean - expected) / size).abs().max() < 1e-4
    there = gp.response(nodes, place.expand(-1, 3, -1))
    covariance = before.covariance + there @ gp.factor @ gp.factor.mT @ there.mT
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    scaled = (predicted.covariance - covariance) / (deviation.unsqueeze(-1) * deviation.unsqueeze(-2))
    # What is left of the prior's deviation (1e-3) after learning is its thousandth: 1e6 eps, some dozens of times.
    assert scaled.abs().max() < 1e-8


def test_batch_equals_loop_and_dtype_is_kept(world):
    gp, _, _, _, _, (chief, relative) = world
    controls, law = gp.controls(chief, stride=2), PotentialTransition(nominal(), 60.0)
    cloud = relative[:4].unsqueeze(0) + torch.randn(5, 4, 6, generator=torch.Generator().manual_seed(0)).double()
    together = law(cloud, controls[:4], 60.0)
    for row in range(5):
        for k in range(4):
            alone = law(cloud[row, k], controls[k], 60.0)
            torch.testing.assert_close(together.mean[row, k], alone.mean, rtol=1e-13, atol=1e-9)
            torch.testing.assert_close(together.covariance[row, k], alone.covariance, rtol=1e-11, atol=0)
    single = law(cloud.float(), controls[:4], 60.0)
    assert single.mean.dtype == single.scale_tril.dtype == torch.float32
    # A position of 226 km in float32 is known to 8 mm.
    assert (single.mean - together.mean).abs().max() < 0.1


def test_misuse_names_the_rule(world):
    gp, _, _, _, _, (chief, relative) = world
    controls, law = gp.controls(chief, stride=2), PotentialTransition(nominal(), 60.0)
    with pytest.raises(ValueError, match=r"control u \(\.\.\., 69\).*got shape \(21,\)"):
        law(relative[0], controls[0, :21], 60.0)
    with pytest.raises(ValueError, match="got none"):
        law(relative[0], None, 60.0)
    for dt in (30.0, 0.0, None, torch.tensor([61.0])):
        with pytest.raises(ValueError, match=r"steps of 60\.0 s"):
            law(relative[0], controls[0], dt)
    for stride in (1, 3):
        with pytest.raises(ValueError, match=f"stride must be even.*got {stride}"):
            gp.controls(chief, stride=stride)
    with pytest.raises(ValueError, match=r"dt_s must be positive, got 0"):
        PotentialTransition(nominal(), 0.0)
    with pytest.raises(ValueError, match=r"degree 4 needs mean \(21,\)"):
        PotentialGP(torch.zeros(5), torch.zeros(5, 5), 4, MU, RATE, torch.zeros(3))
