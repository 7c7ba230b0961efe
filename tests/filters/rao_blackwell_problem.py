"""A mixed linear and nonlinear model, as laws and as the oracle takes it, shared by the tests of its filter."""

import numpy as np
import torch
from oracles.rao_blackwell_oracle import Mixed
from particle_problem import tensor
from torch import nn

import torchfilt as tf

# Lindsten and Schon, Identification of mixed linear/nonlinear state-space models, CDC 2010, section VI.
AL = np.array([[1.0, 0.3, 0.0], [0.0, 0.92, -0.3], [0.0, 0.3, 0.92]])
AN = np.array([[1.0, 0.0, 0.0]])
C = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0]])
MIXED = Mixed(
    fn=np.arctan,
    An=lambda n: AN,
    fl=lambda n: np.zeros(3),
    Al=lambda n: AL,
    Q=0.01 * np.eye(4),
    h=lambda n: np.array([0.1 * n[0] ** 2 * np.sign(n[0]), 0.0]),
    C=lambda n: C,
    R=0.1 * np.eye(2),
)


class Motion(nn.Module):
    """The oracle's motion with the drawn component at ``place``; its matrix has no particle axis unless ``wide``."""

    linear_in = slice(0, 4)

    def __init__(self, place=0, wide=False):
        super().__init__()
        self.place, self.wide = place, wide
        others = [k for k in range(4) if k != place]
        self.order = [place, *others]
        matrix = torch.full((4, 4), torch.nan, dtype=torch.float64)  # the drawn column is not looked at
        matrix[place, others], matrix[np.ix_(others, others)] = tensor(AN[0]), tensor(AL)
        self.register_buffer("matrix", matrix)
        self.register_buffer("scale", 0.1 * torch.eye(4, dtype=torch.float64))
        self.linear_in = others

    def forward(self, x):
        others = self.order[1:]
        mean = x[..., others] @ self.matrix[:, others].mT
        push = torch.zeros_like(mean)
        push[..., self.place] = x[..., self.place].atan()
        return tf.Gaussian(mean + push, self.scale)

    def first_order(self, x, u=None, dt=None):
        matrix = self.matrix.expand(*x.shape[:-1], 4, 4) if self.wide else self.matrix
        return self(x), matrix


class Sensor(nn.Module):
    """The oracle's measurement."""

    def __init__(self, place=0, wide=False):
        super().__init__()
        self.place, self.wide = place, wide
        self.linear_in = [k for k in range(4) if k != place]
        matrix = torch.full((2, 4), torch.nan, dtype=torch.float64)
        matrix[:, self.linear_in] = tensor(C)
        self.register_buffer("matrix", matrix)
        self.register_buffer("scale", 0.1**0.5 * torch.eye(2, dtype=torch.float64))

    def forward(self, x):
        n = x[..., self.place]
        curved = torch.stack([0.1 * n * n.abs(), torch.zeros_like(n)], -1)
        return tf.Gaussian(curved + x[..., self.linear_in] @ self.matrix[:, self.linear_in].mT, self.scale)

    def first_order(self, x, u=None, dt=None):
        matrix = self.matrix.expand(*x.shape[:-1], 2, 4) if self.wide else self.matrix
        return self(x), matrix


def mixed_model(place=0, wide=False):
    """Start: unit covariance, correlated between the parts."""
    factor = torch.eye(4, dtype=torch.float64)
    factor[1:, 0] = tensor([0.5, -0.3, 0.2])
    order = Motion(place).order
    covariance = torch.empty(4, 4, dtype=torch.float64)
    covariance[np.ix_(order, order)] = factor @ factor.mT
    initial = tf.Gaussian(torch.zeros(4, dtype=torch.float64), torch.linalg.cholesky(covariance))
    return tf.StateSpaceModel(initial, Motion(place, wide), Sensor(place, wide))


def plain_model(place=0):
    """The same laws as functions: derivatives by forward mode, one covariance a particle."""
    mixed = mixed_model(place)
    motion, sensor = mixed.transition, mixed.observation
    return tf.StateSpaceModel(
        mixed.initial,
        tf.AdditiveGaussian(lambda x: motion(x).mean, scale_tril=motion.scale),
        tf.AdditiveGaussian(lambda x: sensor(x).mean, scale_tril=sensor.scale),
    )


def mixed_series(steps, seed=0):
    """Measurements (steps, 2)."""
    generator = np.random.default_rng(seed)
    n, l = generator.normal(size=1), generator.normal(size=3)
    ys = []
    for _ in range(steps):
        w = 0.1 * generator.normal(size=4)
        n, l = np.arctan(n) + AN @ l + w[:1], AL @ l + w[1:]
        ys.append(MIXED.h(n) + C @ l + 0.1**0.5 * generator.normal(size=2))
    return tensor(np.array(ys))
