"""A vehicle without a compass near a landmark, whose turned copies no measurement can tell apart."""

import numpy as np
import torch
from torch import nn

import torchfilt as tf

DOUBLE = torch.float64
SPACE = tf.Product(tf.Euclidean(2), tf.Angle(1))
DT, PRIOR_SD, HEADING_SD, WALK, HIGH = 0.5, 5.0, 1.0, 0.2, 10.0
US = np.array([[2, 0.4], [2, 0.4], [1, -0.8], [3, 0.2], [0, 1], [2, -0.3], [2, 0], [1, 0.5]])


def own(x):
    """Where the vehicle is (..., 2), seen along and across its nose."""
    cosine, sine = x[..., 2].cos(), x[..., 2].sin()
    return torch.stack([cosine * x[..., 0] + sine * x[..., 1], cosine * x[..., 1] - sine * x[..., 0]], -1)


def nose_east(x):
    """The gauge: turned about the landmark until the heading is zero."""
    return torch.cat([own(x), torch.zeros_like(x[..., 2:])], -1)


class NoseEast(nn.Module):
    """The same with its derivative."""

    def __init__(self, defect=None):
        super().__init__()
        self.defect = defect

    def forward(self, x):
        return nose_east(x)

    def first_order(self, x):
        there = nose_east(x)
        cosine, sine, zero = x[..., 2].cos(), x[..., 2].sin(), torch.zeros_like(x[..., 2])
        swing = -1.0 if self.defect == "derivative" else 1.0
        rows = [[cosine, sine, swing * there[..., 1]], [-sine, cosine, -there[..., 0]], [zero, zero, zero]]
        after = there + 1e-6 if self.defect == "value" else there
        return after, torch.stack([torch.stack(row, -1) for row in rows], -2)


class Drive(nn.Module):
    """Odometry u (..., 2): speed and turn rate, in the vehicle's axes. State: east, north, heading from east."""

    def __init__(self, wobble=0.0, sd=(WALK, WALK), current=0.0):
        super().__init__()
        self.space, self.current = SPACE, current
        self.register_buffer("sd", torch.tensor([*sd, wobble], dtype=DOUBLE))

    def forward(self, x, u, dt):
        nose = torch.stack([x[..., 2].cos(), x[..., 2].sin()], -1)
        p = x[..., :2] + dt * (u[..., :1] * nose + self.current)
        heading = x[..., 2:] + dt * u[..., 1:]
        return tf.Gaussian(SPACE.project(torch.cat([p, heading], -1)), self.sd, SPACE, is_diagonal=True)


class DriveWithSlope(Drive):
    """The same with its derivative."""

    def first_order(self, x, u, dt):
        cosine, sine, one = x[..., 2].cos(), x[..., 2].sin(), torch.ones_like(x[..., 2])
        speed, zero = dt * u[..., 0], torch.zeros_like(x[..., 2])
        rows = [[one, zero, -speed * sine], [zero, one, speed * cosine], [zero, zero, one]]
        return self(x, u, dt), torch.stack([torch.stack(row, -1) for row in rows], -2)


def camera(sd):
    """The landmark in a camera that looks down from a known height."""
    return tf.AdditiveGaussian(lambda x: own(x) / HIGH, sd**2 * torch.eye(2, dtype=DOUBLE))


def ranging(sd):
    """Distance alone, from the same height: in the vehicle's axes a ring."""
    return tf.AdditiveGaussian(
        lambda x: (x[..., :2].square().sum(-1, keepdim=True) + HIGH**2).sqrt(), sd**2 * torch.eye(1, dtype=DOUBLE)
    )


def model(gauge, observation, motion=None):
    """The prior says nothing of where around the vehicle the landmark is: it is round, so that turns change nothing."""
    deviation = torch.tensor([PRIOR_SD, PRIOR_SD, HEADING_SD], dtype=DOUBLE)
    prior = tf.Gaussian(torch.zeros(3, dtype=DOUBLE), deviation, SPACE, is_diagonal=True)
    return tf.StateSpaceModel(prior, motion or Drive(), observation, gauge=gauge)
