"""The two-satellite truth against an independent propagator and against its own parts."""

import dataclasses

import numpy as np
import pytest
import torch

from torchfilt.models.relative_motion import (
    ClohessyWiltshire,
    FormationSettings,
    from_hill,
    propagate_formation,
    propagate_relative,
    simulate_formation,
    training_pairs,
)

PAPER = FormationSettings()


def rms(error):
    return float(error.square().sum(-1).mean().sqrt())


@pytest.mark.parametrize("density", [0.0, 1.454e-10])
def test_agrees_with_an_independent_propagator(density):
    """One revolution, both satellites, J2 to J4, drag made a thousand times the real one: 1e-6 m is 1.3e-13 of the
    path; both integrators are asked for 1e-12 or better a step."""
    brahe = pytest.importorskip("brahe")
    brahe.set_global_eop_provider(brahe.StaticEOPProvider.from_zero())
    settings = dataclasses.replace(
        PAPER,
        mu_m3_s2=brahe.GM_EARTH,
        earth_radius_m=brahe.R_EARTH,
        density_kg_m3=density,
        earth_rate_rad_s=brahe.OMEGA_EARTH,
    )
    times = (600.0, 5830.0)
    chief, relative = simulate_formation(settings, torch.tensor([0.0, *times]).double())
    separation, velocity = from_hill(chief.position_m, chief.velocity_m_s, chief.frame_rate_rad_s, relative)
    value = brahe.ParameterSource.value
    air = brahe.AtmosphericModel.exponential(settings.scale_height_m, density, settings.density_height_m)
    ends = []
    for who, mass in ((0, settings.chief_mass_kg), (1, settings.deputy_mass_kg)):
        force = brahe.ForceModelConfig(
            gravity=brahe.GravityConfiguration.earth_zonal(brahe.ZonalHarmonicsDegree.J4),
            drag=brahe.DragConfiguration(air, area=value(1.0), cd=value(2.2)) if density else None,
            mass=value(mass),
            frame_transform=brahe.FrameTransformationModel.EARTH_ROTATION_ONLY,
        )
        numerics = brahe.NumericalPropagationConfig.default().with_method(brahe.IntegrationMethod.DP54)
        numerics = numerics.with_rel_tol(1e-13).with_abs_tol(1e-9).with_max_step(5.0)
        epoch = brahe.Epoch.from_datetime(2024, 1, 1, 0, 0, 0.0, 0.0, brahe.TimeSystem.UTC)
        start = torch.cat([(chief.position_m + who * separation)[0], (chief.velocity_m_s + who * velocity)[0]])
        propagator = brahe.NumericalOrbitPropagator(epoch, start.numpy(), numerics, force)
        states = []
        for t in times:
            propagator.propagate_to(epoch + t)
            states.append(propagator.current_state()[:3])
        ends.append(np.array(states))
        np.testing.assert_allclose(states, (chief.position_m + who * separation)[1:], rtol=0, atol=1.5e-6)
    np.testing.assert_allclose(ends[1] - ends[0], separation[1:], rtol=0, atol=1.5e-6)


def test_clohessy_wiltshire_misses_by_the_known_amount():
    """The published study's orbit: linear motion is off by 1.75e-4 m and 3.5e-5 m/s a step of 10 s."""
    time = torch.arange(584, dtype=torch.float64) * 10
    x = simulate_formation(PAPER, time).relative_m_m_s
    error = ClohessyWiltshire(PAPER.mean_motion_rad_s, 0.0, 10.0)(x[:-1]).mean - x[1:]
    assert rms(error[:, :3]) == pytest.approx(1.75e-4, rel=0.01)
    assert rms(error[:, 3:]) == pytest.approx(3.50e-5, rel=0.01)


def test_steps_and_trajectory_are_one_motion():
    """Interpolated trajectory against separate steps: below a tenth of the best learned residual (4e-9 m)."""
    time = torch.arange(0, 1200, 10, dtype=torch.float64)
    chief, relative = simulate_formation(PAPER, time)
    step = propagate_formation(chief[1][:-1], chief[2][:-1], relative[:-1], 10.0, PAPER)
    assert (step.relative_m_m_s - relative[1:])[:, :3].norm(dim=-1).max() < 4e-10
    assert (step.chief.position_m - chief.position_m[1:]).abs().max() < 1e-7
    again = propagate_relative(chief[1][:-1], chief[2][:-1], relative[:-1], 10.0, PAPER, chief[3][:-1])
    assert torch.equal(again, step.relative_m_m_s)


def test_rows_of_a_batch_agree_with_single_steps():
    """The batch shares step sizes but all of them are far inside the tolerance."""
    x, u, _ = training_pairs(PAPER, "cloud", 20, seed=5)
    together = propagate_relative(u[:, 3:6], u[:, 6:9], x, 10.0, PAPER)
    alone = torch.cat([propagate_relative(u[k, 3:6], u[k, 6:9], x[k : k + 1], 10.0, PAPER) for k in range(20)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-11)


def test_thrust_for_a_step_equals_the_trajectory_with_thrust():
    time = torch.tensor([0.0, 10.0, 25.0], dtype=torch.float64)
    thrust = torch.tensor([[1e-3, 2e-3, -1e-3], [0.0, 1e-3, 0.0]], dtype=torch.float64)
    chief, relative = simulate_formation(PAPER, time, thrust_m_s2=thrust)
    end = propagate_formation(chief[1][1], chief[2][1], relative[1:2], 15.0, PAPER, thrust_m_s2=thrust[1])
    torch.testing.assert_close(end.relative_m_m_s[0], relative[2], rtol=0, atol=1e-10)
    free = simulate_formation(PAPER, time).relative_m_m_s
    gained = (relative - free)[-1]
    cw = ClohessyWiltshire(PAPER.mean_motion_rad_s, 0.0)
    linear = torch.zeros(6, dtype=torch.float64)
    for u, dt in zip(thrust, (10.0, 15.0), strict=True):
        linear = cw(linear, u, dt).mean
    torch.testing.assert_close(gained, linear, rtol=1e-4, atol=1e-6)  # J2 and curvature on a displacement of 1 m


def test_starts_later_and_elsewhere():
    start = torch.tensor([10.0, -20.0, 5.0, 0.01, -0.02, 0.03], dtype=torch.float64)
    late = simulate_formation(PAPER, torch.tensor([30.0, 60.0]).double(), start)
    whole = simulate_formation(PAPER, torch.tensor([0.0, 30.0, 60.0]).double(), start)
    torch.testing.assert_close(late.relative_m_m_s, whole.relative_m_m_s[1:], rtol=0, atol=1e-10)
    torch.testing.assert_close(whole.relative_m_m_s[0], start, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("kind", ["trajectory", "cloud", "arcs"])
def test_training_pairs_are_steps_of_the_truth(kind):
    x, u, x_next = training_pairs(PAPER, kind, 60, seed=1)
    assert x.shape == x_next.shape == (60, 6)
    assert u.shape == (60, 21)
    truth = propagate_formation(u[:, 3:6], u[:, 6:9], x, 10.0, PAPER, u[:, 9:12])
    torch.testing.assert_close(truth.relative_m_m_s, x_next, rtol=0, atol=1e-10)
    torch.testing.assert_close(torch.cat(truth.chief[1:], -1), u[:, 12:], rtol=0, atol=1e-7)
    if kind == "arcs":
        assert torch.equal(x[1:6], x_next[:5])
    again = training_pairs(PAPER, kind, 60, seed=1)
    assert all(torch.equal(a, b) for a, b in zip((x, u, x_next), again, strict=True))


def test_a_trajectory_is_a_curve_and_a_cloud_is_a_region():
    """Rank of the states, lengths in m and speeds in m / (1/n): two directions hold all of a single trajectory."""

    def directions(kind):
        x = training_pairs(PAPER, kind, 100, seed=0)[0]
        scaled = x / torch.tensor([1.0] * 3 + [PAPER.mean_motion_rad_s] * 3, dtype=torch.float64)
        values = torch.linalg.svdvals(scaled)
        return int((values > 0.01 * values[0]).sum())

    assert directions("trajectory") == 2
    assert directions("cloud") == 6


def test_another_revolution_has_other_pairs():
    first = training_pairs(PAPER, "cloud", 10)[1]
    second = training_pairs(PAPER, "cloud", 10, span_s=(PAPER.period_s, 2 * PAPER.period_s))[1]
    assert (first[:, 3:6] - second[:, 3:6]).norm(dim=-1).min() > 1e3


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: training_pairs(PAPER, "orbit", 10), "kind"),
        (lambda: training_pairs(PAPER, "arcs", 15), "multiple"),
        (lambda: training_pairs(PAPER, "cloud", 5, span_s=(0.0, 5.0)), "span_s"),
        (lambda: simulate_formation(PAPER, torch.tensor([1.0, 0.0])), "increasing"),
        (lambda: simulate_formation(PAPER, torch.tensor([0.0, 1.0]), thrust_m_s2=torch.zeros(2, 3)), "thrust"),
    ],
)
def test_wrong_use_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
