"""Frames: definitions by differences in time, and exact ways back."""

import numpy as np
import pytest
import torch
from oracles import relative_motion_oracle as oracle

from torchfilt.models.relative_motion import (
    frame_rate,
    from_curvilinear,
    from_hill,
    hill_axes,
    orbit_phase,
    to_curvilinear,
    to_hill,
)

R = torch.tensor([4.1e6, -3.3e6, 4.6e6], dtype=torch.float64)
V = torch.tensor([4.4e3, 6.0e3, 0.9e3], dtype=torch.float64)
A = torch.tensor([-4.5, 3.7, -5.2], dtype=torch.float64)  # gravity and a push out of the plane
S = torch.tensor([300.0, -250.0, 420.0], dtype=torch.float64)
W = torch.tensor([0.3, -0.2, 0.15], dtype=torch.float64)


def test_hill_axes_are_those_of_the_oracle():
    axes = hill_axes(R, V).numpy()
    np.testing.assert_allclose(axes, oracle.hill_matrix(R.numpy(), V.numpy()), rtol=0, atol=1e-15)


def test_relative_velocity_is_the_derivative_of_the_components():
    """The full frame rate makes velocities exact derivatives; leaving out its radial part shows (7e-4 m/s)."""

    def components(t):
        r, v = R + V * t + A * t * t / 2, V + A * t
        return hill_axes(r, v) @ (S + W * t)

    _, derivative = torch.func.jvp(components, (torch.zeros((), dtype=torch.float64),), (torch.ones_like(R[0]),))
    state = to_hill(R, V, frame_rate(R, V, A), S, W)
    torch.testing.assert_close(state[:3], components(0.0), rtol=1e-14, atol=0)
    torch.testing.assert_close(state[3:], derivative, rtol=1e-12, atol=1e-14)
    without = to_hill(R, V, frame_rate(R, V, torch.zeros(3).double()), S, W)
    assert (without[3:] - derivative).abs().max() > 1e-4


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_hill_and_back(dtype):
    rate = frame_rate(R, V, A)
    state = to_hill(*(v.to(dtype) for v in (R, V, rate, S, W)))
    assert state.dtype == dtype
    separation, velocity = from_hill(R.to(dtype), V.to(dtype), rate.to(dtype), state)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(separation, S.to(dtype), rtol=0, atol=16 * eps * 600)
    torch.testing.assert_close(velocity, W.to(dtype), rtol=0, atol=16 * eps * 1.5)


def states(count=200, size_m=3e5, seed=0):
    scale = torch.tensor([size_m] * 3 + [size_m * 1e-3] * 3, dtype=torch.float64)
    return torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * scale


@pytest.mark.parametrize("size_m", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_curvilinear_and_back_keeps_all_digits(size_m, dtype):
    """Relative rounding error whatever the size: no cancellation of the orbit's radius."""
    x = states(size_m=size_m).to(dtype)
    back = from_curvilinear(to_curvilinear(x, 7e6, 12.0), 7e6, 12.0)
    eps = torch.finfo(dtype).eps
    size = torch.linalg.vector_norm(x[:, :3], dim=-1, keepdim=True)
    speed = torch.linalg.vector_norm(x[:, 3:], dim=-1, keepdim=True) + 12.0 * size / 7e6
    assert ((back - x)[:, :3].abs() / size).max() < 32 * eps
    assert ((back - x)[:, 3:].abs() / speed).max() < 64 * eps


def test_curvilinear_rates_are_derivatives():
    x = states(50)
    radius, rate = torch.tensor(6.9e6, dtype=torch.float64), torch.tensor(-8.0, dtype=torch.float64)

    def lengths(t):
        moved = torch.cat([x[:, :3] + x[:, 3:] * t, x[:, 3:]], -1)
        return to_curvilinear(moved, radius + rate * t, rate)[:, :3]

    _, derivative = torch.func.jvp(lengths, (torch.zeros((), dtype=torch.float64),), (torch.ones_like(radius),))
    torch.testing.assert_close(to_curvilinear(x, radius, rate)[:, 3:], derivative, rtol=1e-10, atol=1e-10)


def test_a_follower_on_the_same_circle_has_no_radial_coordinate():
    angle = torch.tensor(0.03, dtype=torch.float64)
    radius = 6.8e6
    follower = torch.stack([radius * (angle.cos() - 1), radius * angle.sin(), *torch.zeros(4).double()])
    expected = torch.tensor([0, radius * 0.03, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(to_curvilinear(follower, radius), expected, rtol=1e-12, atol=1e-8)
    assert follower[0] < -3000


def test_phase_is_the_argument_of_latitude():
    inclination, node = 0.7, 2.1
    toward = torch.tensor([np.cos(node), np.sin(node), 0.0], dtype=torch.float64)
    ahead = torch.tensor(
        [-np.sin(node) * np.cos(inclination), np.cos(node) * np.cos(inclination), np.sin(inclination)]
    ).double()
    for u in (-2.5, 0.0, 1.0, 3.0):
        r = 7e6 * (np.cos(u) * toward + np.sin(u) * ahead)
        v = 7.5e3 * (np.cos(u) * ahead - np.sin(u) * toward) + 1e-5 * r
        expected = torch.tensor([np.cos(u), np.sin(u)], dtype=torch.float64)
        torch.testing.assert_close(orbit_phase(r, v), expected, rtol=0, atol=1e-14)
