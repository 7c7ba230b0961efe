"""Regularisation: optimal bandwidths, exact kernels, and what the cloud's moments become."""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import integrate, stats

import torchfilt as tf
from torchfilt.kernels import Regularize, optimal_bandwidth
from torchfilt.resampling import gather_particles, systematic

F64 = torch.float64
# One Kolmogorov-Smirnov test raises a false alarm with this probability.
FALSE_ALARM = 1e-5


def normals(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def weighted_cloud(rows=3, n=400, size=4, seed=1, dtype=F64, space=tf.Euclidean()):  # noqa: B008 (a frozen value)
    mix = torch.tril(normals(size, size, seed=9, dtype=dtype))
    x = 5 + normals(rows, n, size, seed=seed, dtype=dtype) @ mix.mT
    return tf.Particles(x, torch.log_softmax(normals(rows, n, seed=seed + 1, dtype=dtype), -1), space=space)


def resampled(cloud, seed=3):
    uniforms = torch.rand(*cloud.x.shape[:-2], 1, generator=torch.Generator().manual_seed(seed), dtype=F64)
    x = gather_particles(cloud.x, systematic(cloud.weights, uniforms))
    n = x.shape[-2]
    return tf.Particles(x, torch.full(x.shape[:-1], -math.log(n), dtype=x.dtype), space=cloud.space)


@pytest.mark.parametrize("size", [1, 2, 5, 15])
def test_gaussian_bandwidth_minimises_the_integrated_squared_error(size):
    """Against the zero of the exact error's slope for a Gaussian density (Wand and Jones, 1995, section 4.3).

    The formula is its limit for many particles. With a = e / 2 + 1 the slope's next term makes the exact bandwidth
    larger by the share 3 (a + 1) h^2 / (4 (e + 4)); what is left after it is of the order of its square.
    """
    n = 10**60
    h = optimal_bandwidth(size, n)
    a = mpmath.mpf(size) / 2 + 1

    def slope(h):
        return -1 / (n * h ** (size + 1)) - (1 - mpmath.mpf(1) / n) * h * (1 + h**2) ** -a + h * (1 + h**2 / 2) ** -a

    with mpmath.workdps(120):
        best = float(mpmath.findroot(slope, h))
    share = 0.75 * (size / 2 + 2) * h**2 / (size + 4)
    assert best / h - 1 == pytest.approx(share, abs=10 * share**2 * (size + 4) + 1e-14)


@pytest.mark.parametrize("size", [1, 2, 15])
def test_epanechnikov_bandwidth_is_the_canonical_multiple_of_the_gaussian_one(size):
    """h goes with (R(K) / m2(K)^2)^(1/(e+4)), R the integral of K^2 and m2 the variance, both by quadrature."""
    area = 2 * math.pi ** (size / 2) / math.gamma(size / 2)

    def radial(f):
        return area * integrate.quad(lambda r: f(r) * r ** (size - 1), 0, 1)[0]

    mass = radial(lambda r: 1 - r * r)
    roughness = radial(lambda r: (1 - r * r) ** 2) / mass**2
    variance = radial(lambda r: r * r * (1 - r * r)) / mass / size
    canonical = (roughness / variance**2) ** (1 / (size + 4))
    gaussian = ((4 * math.pi) ** (-size / 2)) ** (1 / (size + 4))
    support = optimal_bandwidth(size, 1000) * canonical / gaussian
    expected = support * variance**0.5  # as a share of the cloud's deviation
    assert optimal_bandwidth(size, 1000, "epanechnikov") == pytest.approx(expected, rel=1e-9)


def test_multimodal_clouds_take_half():
    assert optimal_bandwidth(3, 500, multimodal=True) == 0.5 * optimal_bandwidth(3, 500)
    assert Regularize(multimodal=True).normals(3) == 3 and Regularize("epanechnikov").normals(3) == 7


@pytest.mark.parametrize("shape", ["gaussian", "epanechnikov"])
def test_kernel_steps_follow_their_density(shape):
    """All particles in one place, so what comes out is the kernel; a cloud far away gives it the unit covariance."""
    n, size = 20_000, 2
    cloud = tf.Particles(normals(n, size), torch.full((n,), -math.log(n), dtype=F64))
    spread = torch.linalg.cholesky(cloud.covariance)
    point = cloud._replace(x=torch.zeros(n, size, dtype=F64))
    kernel = Regularize(shape, bandwidth=0.5, keep_moments=False)
    steps = kernel(cloud, point, normals(n, kernel.normals(size), seed=4)).x / 0.5
    unit = torch.linalg.solve_triangular(spread, steps.mT, upper=False).mT
    error = (2 / n) ** 0.5  # of a Gaussian's sample variance; the other kernel has lighter tails
    assert ((unit.square().mean(0) - 1).abs() < 4.5 * error).all()
    if shape == "gaussian":
        assert stats.kstest(unit[:, 0], "norm").pvalue > FALSE_ALARM
    else:
        # In the plane the share inside radius r of the unit disc is 2 r^2 - r^4.
        radius = unit.norm(dim=-1) / (size + 4) ** 0.5
        assert stats.kstest(radius, lambda r: 2 * np.clip(r, 0, 1) ** 2 - np.clip(r, 0, 1) ** 4).pvalue > FALSE_ALARM


@pytest.mark.parametrize("shape", ["gaussian", "epanechnikov"])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_moments_are_kept_to_rounding(shape, dtype):
    """Mean and covariance after the kernel are those of the weighted cloud before resampling."""
    cloud = weighted_cloud(dtype=dtype)
    kernel = Regularize(shape)
    after = kernel(cloud, resampled(cloud), normals(3, 400, kernel.normals(4), seed=5, dtype=dtype))
    mean, covariance = cloud.moments()
    scale = covariance.abs().amax((-2, -1), keepdim=True)
    slack = 1e3 * torch.finfo(dtype).eps  # of sums over 400 terms and a solve with a factor of condition about ten
    assert ((after.mean - mean).abs() < slack * (1 + mean.abs())).all()
    assert ((after.covariance - covariance).abs() < slack * scale).all()
    assert after.x.dtype == dtype and len(after.x[0].unique(dim=0)) == 400


def test_moments_are_kept_on_a_curved_space():
    """On quaternions the tangent moments at the mean are kept exactly, and the mean to second order in the spread."""
    space = tf.Product(tf.UnitQuaternion("left"), tf.Euclidean(2))
    middle = torch.tensor([0.1, -0.2, 0.3, 0.9, 1.0, 2.0], dtype=F64)
    middle = space.project(middle)
    x = space.retract(middle, 0.1 * normals(2, 500, 5))
    cloud = tf.Particles(x, torch.log_softmax(normals(2, 500, seed=2), -1), space=space)
    after = Regularize()(cloud, resampled(cloud), normals(2, 500, 5, seed=3))
    assert torch.allclose(space.local(cloud.mean, after.mean), torch.zeros(2, 5, dtype=F64), atol=1e-10)
    assert torch.allclose(after.covariance, cloud.covariance, rtol=0, atol=1e-10)
    assert torch.allclose(after.x[..., :4].norm(dim=-1), torch.ones(2, 500, dtype=F64), atol=1e-14)


def test_the_plain_kernel_widens_the_cloud():
    """By 1 + h^2, within 4.5 standard errors of a variance from 40,000 particles (1 in 150,000)."""
    n = 40_000
    cloud = tf.Particles(normals(n, 1), torch.full((n,), -math.log(n), dtype=F64))
    after = Regularize(bandwidth=0.6, keep_moments=False)(cloud, cloud, normals(n, 1, seed=6))
    growth = (after.covariance / cloud.covariance).item()
    assert abs(growth - 1.36) < 4.5 * 1.36 * (2 / n) ** 0.5


def test_only_chosen_rows_are_smoothed():
    cloud = weighted_cloud()
    copies, noise = resampled(cloud), normals(3, 400, 4, seed=5)
    after = Regularize()(cloud, copies, noise, torch.tensor([True, False, True]))
    assert torch.equal(after.x[1], copies.x[1]) and not torch.equal(after.x[0], copies.x[0])
    assert torch.equal(after.x[2], Regularize()(cloud, copies, noise).x[2])


@pytest.mark.parametrize("keep", [True, False])
def test_a_dimension_without_spread_stays_as_it_is(keep):
    """A parameter that all particles share is not smeared, and nothing becomes NaN."""
    cloud = weighted_cloud()
    x = cloud.x.clone()
    x[..., 2] = 7.0
    cloud = cloud._replace(x=x)
    after = Regularize(keep_moments=keep)(cloud, resampled(cloud), normals(3, 400, 4, seed=5)).x
    assert torch.allclose(after[..., 2], torch.full((3, 400), 7.0, dtype=F64), rtol=1e-12)
    assert (after[..., [0, 1, 3]].std(-2) > 0.1).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(shape="box"), "shape must be 'gaussian' or 'epanechnikov', got 'box'"),
        (dict(bandwidth=0.0), r"bandwidth must be in \(0, 1\).*got 0.0"),
        (dict(bandwidth=1.0), r"bandwidth must be in \(0, 1\).*got 1.0"),
        (dict(bandwidth=math.nan, keep_moments=False), "bandwidth must be positive and finite, got nan"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        Regularize(**arguments)


def test_bandwidth_needs_particles_and_dimensions():
    with pytest.raises(ValueError, match="size must be at least 1 and particles at least 2, got 0 and 5"):
        optimal_bandwidth(0, 5)
    with pytest.raises(ValueError, match="size must be at least 1 and particles at least 2, got 3 and 1"):
        optimal_bandwidth(3, 1)


@pytest.mark.parametrize("keep", [True, False])
def test_ancestors_only_save_the_way_to_the_errors(keep):
    """What is gathered and what is found again agree to the bit."""
    space = tf.Product(tf.UnitQuaternion("left"), tf.Euclidean(2))
    middle = space.project(torch.tensor([0.1, -0.2, 0.3, 0.9, 1.0, 2.0], dtype=F64))
    cloud = tf.Particles(
        space.retract(middle, 0.1 * normals(2, 300, 5)), torch.log_softmax(normals(2, 300, seed=2), -1), space=space
    )
    uniforms = torch.rand(2, 1, generator=torch.Generator().manual_seed(3), dtype=F64)
    ancestors, copies, noise = systematic(cloud.weights, uniforms), resampled(cloud), normals(2, 300, 5, seed=4)
    kernel = Regularize(keep_moments=keep)
    found, gathered = (kernel(cloud, copies, noise, None, known).x for known in (None, ancestors))
    assert torch.equal(found, gathered)
    assert torch.equal(kernel(cloud.with_centre(), copies, noise, None, ancestors).x, gathered)
