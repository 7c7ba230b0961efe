"""Ultrasonic range against rays traced one by one, derivatives by autodiff, limits, clamping and noise."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from torchfilt.models.sensors.ultrasonic import UltrasonicRange
from torchfilt.spaces import Euclidean, Product, UnitQuaternion
from torchfilt.testing import check_law

DOUBLE = torch.float64
SPACE = Product(UnitQuaternion("left"), Euclidean(12))
CONE = math.radians(20)


def states(tilts, heights=2.0, seed=0):
    """(n, 16): tilted by so much about a horizontal axis after any heading."""
    generator = np.random.default_rng(seed)
    tilts = np.asarray(tilts, dtype=float)
    about = generator.uniform(0, 2 * np.pi, len(tilts))
    axis = np.stack([np.cos(about), np.sin(about), 0 * about], -1)
    turn = Rotation.from_rotvec(axis * tilts[:, None]) * Rotation.from_rotvec(
        np.outer(generator.uniform(-3, 3, len(tilts)), [0, 0, 1])
    )
    x = torch.from_numpy(generator.normal(size=(len(tilts), 16)))
    x[:, :4] = torch.from_numpy(turn.as_quat())
    x[:, 9] = torch.as_tensor(heights, dtype=DOUBLE)
    return x


def first_echo(row, half_angle, floor=0.0):
    """Shortest of many rays of the cone: rings of them about the body's down axis, met with the floor."""
    angles = np.linspace(0, half_angle, 41)[:, None]
    around = np.linspace(0, 2 * np.pi, 7200, endpoint=False)[None]
    rays = np.stack(
        np.broadcast_arrays(np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around), -np.cos(angles))
    )
    down = -(Rotation.from_quat(row[:4].numpy()).as_matrix()[2] @ rays.reshape(3, -1))
    with np.errstate(divide="ignore"):
        return ((row[9].item() - floor) / np.where(down > 0, down, 0)).min()


TILTS = np.radians([0.0, 5, 19.9, 20.1, 30, 45, 60, 75])


@pytest.mark.parametrize("half_angle", [0.0, CONE])
def test_range_is_that_of_the_first_echo(half_angle):
    """Rings are half a degree apart: the ray next to the vertical is 1 / cos(0.25 degrees) - 1 = 1e-5 too long."""
    law, x = UltrasonicRange(0.02, half_angle_rad=half_angle, floor_m=0.5), states(TILTS)
    expected = [first_echo(row, half_angle, 0.5) for row in x]
    np.testing.assert_allclose(law(x).mean[:, 0], expected, rtol=1e-5 if half_angle else 1e-12)
    assert law.size == 1


def test_closed_form_and_its_limit():
    law, tilts = UltrasonicRange(0.02, half_angle_rad=CONE), np.radians([0, 10, 50, 95, 99.9, 100.1, 120, 180])
    found = law(states(tilts, 3.0)).mean[:, 0]
    slant = np.minimum(np.maximum(tilts - CONE, 0), math.radians(80))
    np.testing.assert_allclose(found, 3.0 / np.cos(slant), rtol=1e-12)
    below = law(states([0.0, 1.0], -1.0)).mean
    assert below[0].item() == -1 and torch.isfinite(below).all()


@pytest.mark.parametrize("half_angle", [0.0, CONE])
def test_derivatives(half_angle):
    """Rows inside the cone, beyond it, at its edge's both sides, beyond the limit, level and upside down."""
    law = UltrasonicRange(0.02, 0.01, half_angle_rad=half_angle, height=8)
    x = states([*TILTS, math.radians(110), math.pi - 1e-3], 2.0)
    x[:, 8] = 1.5
    _, slope = law.first_order(x)
    for k, row in enumerate(x):
        exact = torch.func.jacfwd(lambda v, row=row: law(SPACE.retract(row, v)).mean)(torch.zeros(15, dtype=DOUBLE))
        np.testing.assert_allclose(slope[k], exact, rtol=1e-9, atol=1e-9)
    assert slope.shape == (10, 1, 15) and slope[4, 0, :3].abs().max() > 0.1
    check_law(law, x)
    # By hand: h sin(t - b) / cos(t - b)^2 for a turn that tilts further, which two level numbers share.
    beyond = TILTS[5] - half_angle
    np.testing.assert_allclose(slope[5, 0, :3].norm(), 1.5 * math.sin(beyond) / math.cos(beyond) ** 2, rtol=1e-9)


def test_noise_grows_with_distance():
    law, x = UltrasonicRange(0.02, 0.05), states([0.0, 0, 0], [0.5, 4.0, -1.0])
    np.testing.assert_allclose(law(x).scale_tril[:, 0], [0.045, 0.22, 0.02], rtol=1e-14)
    least, share = (nn.Parameter(torch.tensor(v, dtype=DOUBLE)) for v in (0.02, 0.05))
    UltrasonicRange(least, share)(x[1:2]).scale_tril.sum().backward()
    assert least.grad.item() == 1 and share.grad.item() == pytest.approx(4.0)


def test_limits():
    law = UltrasonicRange(0.01, half_angle_rad=CONE, min_range_m=0.3, max_range_m=5.0, max_tilt_rad=0.6, delay_s=0.12)
    assert law.delay_s == 0.12 and UltrasonicRange(0.01).delay_s == 0
    tilts = [0.0, 0.0, 0.0, 0.0, 0.59, 0.61]
    x = states(tilts, [0.29, 0.31, 4.99, 5.01, 1.0, 1.0])
    assert law.in_view(x).tolist() == [False, True, True, False, True, False]
    shown = law.simulate(x, torch.zeros(6, 1, dtype=DOUBLE))
    expected = [0.3, 0.31, 4.99, math.nan, 1 / math.cos(0.59 - CONE), math.nan]
    np.testing.assert_allclose(shown[:, 0], expected, rtol=1e-14)
    taken = law.measured(shown)[:, 0]
    np.testing.assert_allclose(taken, [math.nan, *expected[1:]], rtol=1e-14)
    # Steeply tilted, the slant is what is too far.
    assert not UltrasonicRange(0.01, max_range_m=5.0, max_tilt_rad=1.0).in_view(states([0.9], 4.5))


def test_simulated_noise():
    """Mean and spread of 4,000 readings, to five standard errors (false alarm 1e-6); readings beyond are no echoes."""
    law, noise = UltrasonicRange(0.02, 0.05), torch.randn(4000, 1, generator=torch.Generator().manual_seed(3)).double()
    off = law.simulate(states([0.0], 2.0).expand(4000, 16), noise) - 2.0
    assert abs(off.mean().item()) < 5 * 0.12 / 4000**0.5
    assert abs(off.std().item() / 0.12 - 1) < 5 / 8000**0.5
    far = law.simulate(states([0.0], 5.9).expand(4000, 16), noise)
    assert torch.equal(torch.isnan(far), 5.9 + (0.02 + 0.05 * 5.9) * noise > 6.0)


def test_single_precision_and_compile():
    law, x = UltrasonicRange(0.02, 0.05, half_angle_rad=CONE), states(TILTS)
    single = law.first_order(x.float())
    assert single[0].mean.dtype == single[1].dtype == torch.float32
    # At most 75 degrees of tilt: h / cos^2 of 55 degrees beyond the cone is up to 6, by a dozen roundings of the turn.
    np.testing.assert_allclose(single[1], law.first_order(x)[1], atol=12 * 6 * torch.finfo(torch.float32).eps, rtol=0)
    compiled = torch.compile(law.first_order, fullgraph=True, backend="eager")(x)
    torch.testing.assert_close(compiled[1], law.first_order(x)[1])
    torch.testing.assert_close(torch.func.vmap(lambda row: law(row).mean)(x), law(x).mean)
    batch = law.first_order(x.reshape(2, 4, 16))[1]
    torch.testing.assert_close(batch.reshape(8, 1, 15), law.first_order(x)[1], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(noise_m=0.0), "noise_m must be one positive finite number, got 0"),
        (dict(noise_m=torch.ones(2)), "noise_m must be one positive finite number"),
        (dict(noise_share=-0.1), "noise_share must be one finite number >= 0, got -0.1"),
        (dict(half_angle_rad=1.4), "half_angle_rad must be at least 0 and below 80 degrees, 1.396, got 1.4"),
        (dict(max_tilt_rad=-0.1), "max_tilt_rad must be at least 0 and below 80 degrees"),
        (dict(min_range_m=2.0, max_range_m=2.0), "ranges must be 0 <= min_range_m < max_range_m, got 2.0 and 2.0"),
        (dict(delay_s=-1.0), "delay_s must be finite and not negative, got -1"),
        (dict(floor_m=math.nan), "floor_m must be finite, got nan"),
        (dict(height=3), "height must be an index behind the quaternion, 4 or more, got 3"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        UltrasonicRange(**{"noise_m": 0.02, **options})


def test_refuses_a_state_without_the_height():
    with pytest.raises(ValueError, match=r"the state must have more than 9 numbers, got \(2, 7\)"):
        UltrasonicRange(0.02)(torch.zeros(2, 7))
