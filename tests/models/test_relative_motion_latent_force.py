"""Unknown periodic acceleration: the law against an integrated truth, and learning it from radar alone."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchfilt as tf
from torchfilt.models import relative_motion as rm

N = 0.0011


def law(order: int = 2, drift: float = 0.0) -> rm.HarmonicForce:
    return rm.HarmonicForce(rm.ClohessyWiltshire(N, 1e-12, 10.0), order, drift)


def controls(steps: int, dt: float) -> torch.Tensor:
    """Chief on a circular orbit of rate N in an inclined plane, starting 0.3 rad past the node."""
    angle = 0.3 + N * dt * torch.arange(steps + 1, dtype=torch.float64)
    tilt = 0.5
    radius = 7e6

    def along(c: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
        return radius * torch.stack([c, s * np.cos(tilt), s * np.sin(tilt)], -1)

    position, velocity = along(angle.cos(), angle.sin()), N * along(-angle.sin(), angle.cos())
    rate = torch.tensor([0.0, 0.0, N], dtype=torch.float64).expand(steps + 1, 3)
    return rm.chief_controls(rm.ChiefOrbit(dt * torch.arange(steps + 1).double(), position, velocity, rate))


def test_a_step_is_the_integral_of_the_forced_equations() -> None:
    steps, dt = 30, 10.0
    model = law()
    generator = np.random.default_rng(0)
    start = generator.standard_normal(6) * np.repeat([100.0, 0.1], 3)
    coefficients = generator.standard_normal((3, 5)) * 1e-5

    def rates(t: float, s: np.ndarray) -> np.ndarray:
        u = 0.3 + N * t
        force = coefficients @ np.array([1, np.cos(u), np.cos(2 * u), np.sin(u), np.sin(2 * u)])
        x, _, z, vx, vy, vz = s
        return np.array([vx, vy, vz, 2 * N * vy + 3 * N**2 * x, -2 * N * vx, -(N**2) * z]) + np.r_[0, 0, 0, force]

    truth = solve_ivp(rates, (0, steps * dt), start, rtol=1e-12, atol=1e-12).y[:, -1]
    x = torch.from_numpy(np.r_[start, coefficients.ravel()])
    for u in controls(steps, dt):
        x = model(x, u, dt).mean
    # The force is taken at the middle of a step: relative error (2 n dt)^2 / 24 of its second harmonic, 2e-5, on a
    # displacement of 1e-5 t^2 / 2 = 0.45 m and a velocity of 3 mm/s.
    assert np.abs(x[:3].numpy() - truth[:3]).max() < 5e-5
    assert np.abs(x[3:6].numpy() - truth[3:]).max() < 5e-7
    assert torch.equal(x[6:], torch.from_numpy(coefficients.ravel()))


def test_matrices_and_call_agree_and_batch_over_controls() -> None:
    model, u = law(drift=1e-20), controls(4, 10.0)
    x = torch.randn(4, model.force_size + 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    batched = model(x, u, 10.0)
    form = model.linear_form(u, 10.0)
    torch.testing.assert_close(
        batched.mean, (form.matrix @ x.unsqueeze(-1)).squeeze(-1) + form.offset, rtol=1e-13, atol=0
    )
    for k in range(4):
        torch.testing.assert_close(model(x[k], u[k], 10.0).mean, batched.mean[k], rtol=1e-13, atol=1e-15)
    deviation = (1e-20 * 10.0) ** 0.5
    torch.testing.assert_close(
        batched.scale_tril.diagonal(dim1=-2, dim2=-1)[..., 6:].unique(), torch.tensor([deviation]).double()
    )


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="order must be at least 1, got 0"):
        law(order=0)
    with pytest.raises(ValueError, match="drift_psd_m2_s5 must be >= 0, got -1"):
        law(drift=-1.0)
    with pytest.raises(ValueError, match="chief's orbit"):
        law()(torch.zeros(21, dtype=torch.float64), None, 10.0)


@pytest.mark.slow
def test_radar_alone_teaches_the_force_within_three_orbits() -> None:
    settings, runs = rm.FormationSettings(), 8
    orbit = 583
    truth = rm.simulate_formation(settings, 10.0 * torch.arange(3 * orbit + 1).double())
    radar = rm.RendezvousRadar(settings.semi_major_axis_m)
    generator = torch.Generator().manual_seed(0)
    states = truth.relative_m_m_s
    noise = torch.randn(3 * orbit, runs, 3, generator=generator, dtype=torch.float64)
    y = radar(states[1:]).mean.unsqueeze(1) + radar.standard_deviation * noise
    model = rm.HarmonicForce(rm.ClohessyWiltshire(settings.mean_motion_rad_s, 1e-12, 10.0), 3)
    deviation = torch.cat([torch.tensor([1.0] * 3 + [0.01] * 3), torch.full((model.force_size,), 3e-6)]).double()
    start = torch.zeros(runs, len(deviation), dtype=torch.float64)
    start[:, :6] = states[0] + deviation[:6] * torch.randn(runs, 6, generator=generator, dtype=torch.float64)
    prior = tf.Gaussian(start, torch.diag(deviation))
    filtered = tf.UnscentedKalmanFilter(tf.StateSpaceModel(prior, model, lambda x: radar(x[..., :6])))(
        y, rm.chief_controls(truth.chief), 10.0
    )
    error = (filtered.mean[..., :6] - states[1:].unsqueeze(1))[2 * orbit :]
    rmse = error.square().unflatten(-1, (2, 3)).sum(-1).mean(0).sqrt().median(0).values
    assert rmse[0] < 0.04 and rmse[1] < 8e-5, rmse
    covariance = filtered.covariance[2 * orbit :, :, :6, :6]
    nees = (error.unsqueeze(-2) @ torch.linalg.solve(covariance, error.unsqueeze(-1))).mean()
    assert 3 < nees < 8, nees


def test_a_time_step_as_a_number_is_not_rounded_on_its_way() -> None:
    model, u = law(drift=1e-20), controls(1, 0.1)[0]
    exact = model.linear_form(u, torch.tensor([0.1], dtype=torch.float64))
    for one, other in zip(model.linear_form(u, 0.1), exact, strict=True):
        assert one is other is None or torch.equal(one, other)
