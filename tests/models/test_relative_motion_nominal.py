"""Two-body and linearised motion about a known chief."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from oracles import relative_motion_oracle as oracle

from torchfilt.models.relative_motion import (
    CONTROL_SIZE,
    J2_EARTH,
    FormationSettings,
    LinearTimeVarying,
    TwoBody,
    chief_controls,
    cw_noise_factor,
    from_hill,
    phase,
    simulate_formation,
    split_control,
    training_pairs,
)

FREE = FormationSettings(j2=0.0, j3=0.0, j4=0.0, drag_coefficient=0.0)
FLAT = dataclasses.replace(FREE, j2=J2_EARTH)
LAWS = [TwoBody(1e-12), TwoBody(1e-12, j2=J2_EARTH, steps=2), LinearTimeVarying(1e-12, j2=J2_EARTH)]


@pytest.fixture(scope="module")
def pairs():
    return training_pairs(FormationSettings(eccentricity=0.02), "cloud", 40, seed=3)


@pytest.mark.parametrize(("settings", "j2"), [(FREE, None), (FLAT, J2_EARTH)])
def test_one_step_equals_two_absolute_orbits(settings, j2):
    """Tolerance: 7e6 m times eps for each of the oracle's orbits, and 3e-9 m of fourth-order error in 10 s."""
    settings = dataclasses.replace(settings, eccentricity=0.1)
    chief, relative = simulate_formation(settings, torch.tensor([0.0, 10.0]).double())
    u = chief_controls(chief)[0]
    ours = TwoBody(0.0, settings.mu_m3_s2, j2=j2)(relative[0], u, 10.0).mean
    separation, velocity = from_hill(chief.position_m[0], chief.velocity_m_s[0], chief.frame_rate_rad_s[0], relative[0])
    start = np.concatenate([chief.position_m[0], chief.velocity_m_s[0]])
    other = start + np.concatenate([separation, velocity])
    ends = [oracle.two_body(s, 10.0, settings.mu_m3_s2, settings.j2) for s in (start, other)]
    difference = ends[1] - ends[0]
    axes = oracle.hill_matrix(ends[0][:3], ends[0][3:])
    rate = np.cross(ends[0][:3], ends[0][3:])
    spin = chief.frame_rate_rad_s[1].numpy()
    assert spin[2] == pytest.approx(np.linalg.norm(rate) / np.sum(ends[0][:3] ** 2), rel=1e-12)
    position = axes @ difference[:3]
    expected = np.concatenate([position, axes @ difference[3:] - np.cross(spin, position)])
    np.testing.assert_allclose(ours[:3], expected[:3], rtol=0, atol=1.2e-8)
    np.testing.assert_allclose(ours[3:], expected[3:], rtol=0, atol=2e-11)


@pytest.mark.parametrize("law", [TwoBody, LinearTimeVarying])
def test_order_of_convergence(law):
    """Halving the step divides the error by sixteen; steps of 240 s, judged by 64 of them."""
    chief, relative = simulate_formation(FREE, torch.tensor([0.0, 240.0]).double())
    u = chief_controls(chief)[0]

    def end(steps):
        return law(0.0, FREE.mu_m3_s2, steps=steps)(relative[0], u, 240.0).mean

    best = end(64)
    errors = [float((end(steps) - best)[:3].norm()) for steps in (1, 2, 4, 8)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert all(3.7 < order < 4.4 for order in orders), orders


def test_a_revolution_of_steps_follows_the_truth():
    """Unperturbed motion: 583 steps of 10 s; 3e-9 m a step, grown along the track by 3 n t: below 583 * 19 * 3e-9."""
    time = torch.arange(584, dtype=torch.float64) * 10
    chief, relative = simulate_formation(dataclasses.replace(FREE, eccentricity=0.05), time)
    x, law = relative[0], TwoBody(0.0, FREE.mu_m3_s2)
    for u in chief_controls(chief):
        x = law(x, u, 10.0).mean
    assert (x - relative[-1])[:3].norm() < 583 * 19 * 3e-9


def test_linearised_matrix_is_the_slope_of_the_exact_motion(pairs):
    """Both integrators make the same steps, so the Jacobian at zero separation agrees to rounding."""
    _, u, _ = pairs
    exact, linear = TwoBody(0.0, j2=J2_EARTH, steps=2), LinearTimeVarying(0.0, j2=J2_EARTH, steps=2)
    slope = torch.func.jacfwd(lambda x: exact(x, u[7], 30.0).mean)(torch.zeros(6, dtype=torch.float64))
    # J2 is differenced at 7e6 m: 1e-2 m/s^2 over 7e6 m in its derivative is exact in forward mode.
    torch.testing.assert_close(linear.linear_form(u[7], 30.0).matrix, slope, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("law", LAWS)
def test_jacobian_equals_central_differences(law, pairs):
    """Steps of 1 m and 1e-3 m/s: rounding 2e-16 * 1e3 m / 1 m, truncation from third derivatives 1e-19."""
    x, u, _ = pairs
    jacobian = torch.func.jacfwd(lambda x: law(x, u[0], 10.0).mean)(x[0])
    step = torch.tensor([1.0] * 3 + [1e-3] * 3, dtype=torch.float64).diag()
    ends = law(torch.stack([x[0] + step, x[0] - step]), u[0], 10.0).mean
    size = torch.tensor([1.0] * 3 + [1e-3] * 3, dtype=torch.float64)
    difference = ((ends[0] - ends[1]) / 2).mT / size
    torch.testing.assert_close(jacobian * size, difference * size, rtol=0, atol=2e-12)


def test_process_noise_is_that_of_a_white_acceleration(pairs):
    """Gravity's gradient over the step is left out: relative error (n dt)^2 times a small factor."""
    _, u, _ = pairs
    n, dt = FREE.mean_motion_rad_s, 10.0
    factor = TwoBody(1e-12).forward(torch.zeros(6).double(), u[0], dt).scale_tril
    expected = cw_noise_factor(torch.tensor(n).double(), torch.tensor(dt).double(), torch.tensor(1e-12).double())
    q, e = factor @ factor.mT, expected @ expected.mT
    deviation = e.diagonal().sqrt()
    # CW's axes turn at n, this chief's (e = 0.02) at up to 4 % more.
    assert ((q - e) / torch.outer(deviation, deviation)).abs().max() < 4 * (n * dt) ** 2 + 0.06 * n * dt
    assert torch.equal(factor, factor.tril())


@pytest.mark.parametrize("law", LAWS)
def test_batches_equal_single_calls(law, pairs):
    """States with their own controls, shared controls, sigma points: the same numbers to rounding of 1 km."""
    x, u, _ = pairs
    single = torch.stack([law(a, b, 10.0).mean for a, b in zip(x, u, strict=True)])
    tight = {"rtol": 0.0, "atol": 2e-12}
    torch.testing.assert_close(law(x, u, 10.0).mean, single, **tight)
    torch.testing.assert_close(torch.func.vmap(lambda a, b: law(a, b, 10.0).mean)(x, u), single, **tight)
    clouds, shared = x.reshape(4, 10, 6), u[:4].unsqueeze(1)
    result = law(clouds, shared, 10.0)
    assert result.mean.shape == (4, 10, 6)
    assert result.scale_tril.shape[:-2] in ((), (4, 1))
    torch.testing.assert_close(result.mean[2, 3], law(x[23], u[2], 10.0).mean, **tight)
    points = clouds.unsqueeze(2).expand(4, 10, 13, 6)
    torch.testing.assert_close(law(points, shared.unsqueeze(2), 10.0).mean[2, 3, 5], result.mean[2, 3], **tight)
    torch.testing.assert_close(law(clouds, u[0], 10.0).mean[2, 3], law(x[23], u[0], 10.0).mean, **tight)


@pytest.mark.parametrize("law", LAWS)
def test_time_steps_of_their_own(law, pairs):
    x, u, _ = pairs
    clouds, shared = x.reshape(4, 10, 6), u[:4].unsqueeze(1)
    dt = torch.tensor([10.0, 0.0, 5.0, 10.0], dtype=torch.float64).reshape(4, 1, 1)
    result = law(clouds, shared, dt)
    torch.testing.assert_close(result.mean[0], law(clouds[0], u[0], 10.0).mean, rtol=0, atol=2e-12)
    torch.testing.assert_close(result.mean[2], law(clouds[2], u[2], 5.0).mean, rtol=0, atol=2e-12)
    torch.testing.assert_close(result.scale_tril[2, 0], law(clouds[2], u[2], 5.0).scale_tril, rtol=1e-13, atol=0)
    assert torch.equal(result.mean[1], clouds[1])
    assert not result.scale_tril[1].any()
    still = law(x[0], u[0], 0.0)
    assert torch.equal(still.mean, x[0])
    assert not still.scale_tril.any()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("control_dtype", [torch.float32, torch.float64])
def test_float32_loses_only_its_own_rounding(law, control_dtype, pairs):
    """Separations of 1 km: a few eps of 1 km, not of the orbit's radius (0.4 m)."""
    x, u, _ = pairs
    result = law(x.float(), u.to(control_dtype), 10.0)
    assert result.mean.dtype == result.scale_tril.dtype == torch.float32
    error = (result.mean - law(x, u, 10.0).mean).abs()
    assert error[:, :3].max() < 8 * torch.finfo(torch.float32).eps * 1e3
    assert error[:, 3:].max() < 8 * torch.finfo(torch.float32).eps * 1.0


@pytest.mark.parametrize("law", [TwoBody, LinearTimeVarying])
def test_thrust_acts_in_hill_axes(law):
    """Against the truth's own thrust: differs only by the unthrusted difference plus gravity's change with it."""
    time = torch.arange(4, dtype=torch.float64) * 60
    thrust = torch.tensor([[2e-3, -1e-3, 3e-3], [0, 1e-3, 0], [-1e-3, 0, 1e-3]], dtype=torch.float64)
    chief, pushed = simulate_formation(FLAT, time, thrust_m_s2=thrust)
    model = law(0.0, FLAT.mu_m3_s2, j2=J2_EARTH, steps=4)
    ours = model(pushed[:-1], chief_controls(chief, thrust), 60.0).mean
    without = model(pushed[:-1], chief_controls(chief), 60.0).mean
    # The law lets the orbit normal move linearly over the step: w_x n dt^2 / 8 = 5e-7 rad on a displacement of 7 m.
    # Linearisation drops 4e-8 m/s^2, 1e-4 m in 60 s.
    assert (ours - pushed[1:])[:, :3].norm(dim=-1).max() < (4e-6 if law is TwoBody else 2e-4)
    assert (without - pushed[1:])[:, :3].norm(dim=-1).min() > 1.0


def test_noise_density_trains(pairs):
    x, u, x_next = pairs
    law = TwoBody(torch.nn.Parameter(torch.tensor(1e-10, dtype=torch.float64)))
    (-law(x, u, 10.0).log_prob(x_next).mean()).backward()
    assert torch.isfinite(law.acceleration_psd_m2_s3.grad)
    assert law.acceleration_psd_m2_s3.grad != 0


def test_gradients_pass_gradcheck(pairs):
    x, u, _ = pairs
    scale = torch.tensor([1.0] * 3 + [1e-3] * 3, dtype=torch.float64)
    law = TwoBody(0.0, j2=J2_EARTH)
    unit = (x[0] / scale).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: law(v * scale, u[0], 10.0).mean / scale, (unit,), eps=1e-2, atol=1e-7)


@pytest.mark.parametrize("law", LAWS)
def test_the_whole_graph_is_traced(law, pairs):
    """No graph break; the back end only replays the operations."""
    x, u, _ = pairs
    traced = torch.compile(lambda x, u: law(x, u, 10.0).mean, fullgraph=True, backend="eager")
    torch.testing.assert_close(traced(x, u), law(x, u, 10.0).mean, rtol=0, atol=0)


@pytest.mark.slow
def test_compiled_numbers_are_the_same(pairs):
    x, u, _ = pairs
    law = TwoBody(1e-12, j2=J2_EARTH)
    compiled = torch.compile(lambda x, u: law(x, u, 10.0).mean, fullgraph=True)
    torch.testing.assert_close(compiled(x, u), law(x, u, 10.0).mean, rtol=0, atol=2e-12)


def test_controls_hold_both_ends():
    time = torch.arange(5, dtype=torch.float64) * 10
    chief = simulate_formation(FREE, time).chief
    push = torch.ones(3).double()
    u = chief_controls(chief, push)
    assert u.shape == (4, CONTROL_SIZE)
    control = split_control(u)
    assert torch.equal(control.thrust_m_s2, torch.ones(4, 3).double())
    assert torch.equal(control.end_position_m[:-1], control.position_m[1:])
    assert torch.equal(control.frame_rate_rad_s, chief.frame_rate_rad_s[:-1])
    assert torch.equal(control.end_velocity_m_s, chief.velocity_m_s[1:])
    assert chief_controls(chief, stride=2).shape == (2, CONTROL_SIZE)
    first = chief_controls(chief, push, first=True)
    assert torch.equal(first[1:], u)
    assert torch.equal(first[0, 3:12], first[0, 12:])
    assert not first[0, :3].any()
    assert phase(u).shape == (4, 2)
    start = FREE.perigee_rad + FREE.true_anomaly_rad
    expected = torch.tensor([math.cos(start), math.sin(start)], dtype=torch.float64)
    torch.testing.assert_close(phase(u)[0], expected, rtol=0, atol=1e-14)


def test_wrong_use_is_named():
    chief = simulate_formation(FREE, torch.tensor([0.0, 10.0]).double()).chief
    u = chief_controls(chief)[0]
    x = torch.zeros(6).double()
    with pytest.raises(ValueError, match="chief's orbit"):
        TwoBody(0.0)(x, None, 10.0)
    with pytest.raises(ValueError, match="shape"):
        LinearTimeVarying(0.0)(x, u[:20], 10.0)
    with pytest.raises(ValueError, match="time step"):
        TwoBody(0.0)(x, u)
    with pytest.raises(ValueError, match="steps"):
        TwoBody(0.0, steps=0)
    with pytest.raises(ValueError, match="acceleration_psd"):
        LinearTimeVarying(-1.0)
    with pytest.raises(ValueError, match="mu_m3_s2"):
        TwoBody(0.0, -1.0)
    with pytest.raises(ValueError, match="epochs"):
        chief_controls(chief, stride=3)
    with pytest.raises(ValueError, match="thrust"):
        chief_controls(chief, torch.zeros(2, 3))
