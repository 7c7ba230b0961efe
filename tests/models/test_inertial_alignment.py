"""Levelling, course and standstill against attitudes that are known."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfilt.models.inertial.alignment import align_at_rest, course, level

RATE = 7.292115e-5


def attitude(heading, pitch, roll):
    """Body (RFU) to ENU by SciPy: minus heading about up, then pitch about right, then roll about forward."""
    return Rotation.from_euler("ZXY", np.stack([-heading, pitch, roll], -1))


@pytest.fixture
def angles():
    rng = np.random.default_rng(3)
    return rng.uniform(-np.pi, np.pi, 50), rng.uniform(-1.5, 1.5, 50), rng.uniform(-np.pi, np.pi, 50)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_level_gives_pitch_and_roll_back(angles, dtype):
    heading, pitch, roll = angles
    force = torch.as_tensor(9.81 * attitude(heading, pitch, roll).inv().apply([0.0, 0.0, 1.0]), dtype=dtype)
    found = level(force.reshape(5, 10, 3))
    # Rounding of the force, divided by cos(pitch) > 0.07 in roll, by itself in pitch.
    eps = torch.finfo(dtype).eps
    assert found[0].dtype == dtype and found[0].shape == (5, 10)
    np.testing.assert_allclose(found[0].flatten().numpy(), pitch, atol=10 * eps)
    np.testing.assert_allclose(np.sin(found[1].flatten().numpy() - roll), 0, atol=40 * eps)


def test_signs_of_level():
    """Nose up feels its weight's reaction forward, right side down to the left."""
    force = torch.tensor([[0.0, 0.1, 1.0], [-0.1, 0.0, 1.0], [0.0, 0.0, 0.0]])
    pitch, roll = level(force)
    tilt = np.arctan(0.1)
    np.testing.assert_allclose(pitch.numpy(), [tilt, 0, 0], atol=1e-7)
    np.testing.assert_allclose(roll.numpy(), [0, tilt, 0], atol=1e-7)


def test_course_is_clockwise_from_north():
    velocity = torch.tensor([[0.0, 2.0, 5.0], [2.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    degrees = torch.rad2deg(course(velocity))
    assert degrees.tolist() == pytest.approx([0, 90, 180, -45, 0], abs=1e-5)


def test_a_body_at_rest(angles):
    """Mean of noisy samples: attitude but for the noise's mean, and the bias without the Earth's rate."""
    heading, pitch, roll = (value[:4] for value in angles)
    latitude = np.array([0.0, 0.5, -1.0, 1.2])
    true = attitude(heading, pitch, roll)
    bias = np.array([0.01, -0.02, 0.003])
    earth = RATE * np.stack([0 * latitude, np.cos(latitude), np.sin(latitude)], -1)
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(2, 1000, 4, 3))
    noise -= noise.mean(1, keepdims=True)  # so that means are exact
    gyro = torch.as_tensor(true.inv().apply(earth) + bias + 1e-2 * noise[0])
    accel = torch.as_tensor(true.inv().apply([0.0, 0.0, 9.8]) + 0.1 * noise[1])
    found = align_at_rest(gyro, accel, torch.as_tensor(heading), torch.as_tensor(latitude))
    apart = (Rotation.from_quat(found.quaternion.numpy()).inv() * true).magnitude()
    np.testing.assert_allclose(apart, 0, atol=1e-13)
    np.testing.assert_allclose(found.gyro_bias.numpy(), np.broadcast_to(bias, (4, 3)), atol=1e-15)
    one = align_at_rest(gyro[:, 0], accel[:, 0], torch.as_tensor(heading[0]), 0.0)
    assert torch.equal(one.quaternion, found.quaternion[0]) and torch.equal(one.gyro_bias, found.gyro_bias[0])


def test_samples_that_are_none(angles):
    heading = torch.tensor(0.0)
    for gyro, accel in (
        (torch.ones(5, 3), torch.ones(4, 3)),
        (torch.ones(3), torch.ones(3)),
        (torch.ones(0, 3), torch.ones(0, 3)),
    ):
        with pytest.raises(ValueError, match=r"must both be \(t, ..., 3\) with t >= 1, got \("):
            align_at_rest(gyro, accel, heading, 0.0)
