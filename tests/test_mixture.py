"""Merging, splitting and mixture laws against plain numpy and SciPy's rotations."""

import math
import re

import numpy as np
import pytest
import torch
from oracles import mixture_oracle
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from torch.distributions import MixtureSameFamily, Normal

import torchfilt as tf
from torchfilt.mixture import InitialMixture, MixtureLaw, check_probabilities, factors_of, merge, reduce, split_gaussian

DOUBLE = torch.float64
SPACES = {
    "flat": tf.Euclidean(4),
    "product": tf.Product(tf.Euclidean(1), tf.UnitQuaternion()),
    "left": tf.Product(tf.Euclidean(1), tf.UnitQuaternion("left")),
}


def mixture(seed, n=6, e=3, lead=(), spread=2.0):
    """A flat mixture of different sizes and weights."""
    rng = np.random.default_rng(seed)
    x = torch.tensor(spread * rng.standard_normal((*lead, n, e)))
    factor = torch.tensor(0.3 * rng.standard_normal((*lead, n, e, e))).tril(-1)
    factor = factor + torch.diag_embed(torch.tensor(rng.uniform(0.2, 1.5, (*lead, n, e))))
    weights = torch.tensor(rng.dirichlet(np.ones(n), lead if lead else None))
    return tf.Particles(x, weights.log(), factor)


def listed(particles):
    factor = particles.scale_tril.expand(*particles.x.shape[:-1], -1, -1)
    return [
        (float(w), m.numpy(), (s @ s.mT).numpy())
        for w, m, s in zip(particles.weights, particles.x, factor, strict=True)
    ]


def gaussian(space="flat", e=4, seed=0, scale=1.0, lead=()):
    rng = np.random.default_rng(seed)
    mean = torch.tensor(rng.standard_normal((*lead, 4 if space == "flat" else 5)))
    square = torch.tensor(rng.standard_normal((*lead, e, e)))
    covariance = scale**2 * (square @ square.mT / e + 0.2 * torch.eye(e, dtype=DOUBLE))
    return tf.Gaussian(SPACES[space].project(mean), torch.linalg.cholesky(covariance), SPACES[space])


def close(found, expected, tolerance=1e-12):
    np.testing.assert_allclose(found.detach().numpy(), np.asarray(expected), rtol=0, atol=tolerance)


# ----------------------------------------------------------------------------------------------------------------------
# Merging


def test_merged_moments_are_those_of_the_mixture():
    many = mixture(0, lead=(3,))
    one = merge(many)
    for row in range(3):
        expected = mixture_oracle.moments(
            listed(tf.Particles(many.x[row], many.log_weights[row], many.scale_tril[row]))
        )
        close(one.mean[row], expected[0])
        close(one.covariance[row], expected[1])
    assert (one.scale_tril.triu(1) == 0).all()


def test_a_factor_that_all_share():
    many = mixture(1)
    shared = many._replace(scale_tril=many.scale_tril[:1])
    every = many._replace(scale_tril=many.scale_tril[:1].expand(6, 3, 3))
    close(merge(shared).covariance, merge(every).covariance)
    close(reduce(shared, 2).x, reduce(every, 2).x)


@pytest.mark.parametrize("side", ["right", "left"])
def test_on_rotations_the_mean_is_intrinsic_and_covariances_are_seen_from_it(side):
    """A component's columns are turned by the inverse Jacobian of the way from the mean to its centre."""
    rng = np.random.default_rng(2)
    points = Rotation.from_rotvec(0.5 * rng.standard_normal((5, 3)))
    weights = rng.dirichlet(np.ones(5))
    factors = np.tril(0.1 * rng.standard_normal((5, 3, 3)))
    space = tf.UnitQuaternion(side)
    one = merge(
        tf.Particles(torch.tensor(points.as_quat()), torch.tensor(np.log(weights)), torch.tensor(factors), space)
    )
    mean = mixture_oracle.rotation_mean(points.as_quat(), weights)
    close(one.mean * torch.sign(one.mean[3]), mean.as_quat() * np.sign(mean.as_quat()[3]))
    errors = ((mean.inv() * points) if side == "right" else (points * mean.inv())).as_rotvec()
    covariance = np.zeros((3, 3))
    for w, error, factor in zip(weights, errors, factors, strict=True):
        # mean exp(error) exp(d) = mean exp(error + J^-1 d); on the left J is that of the opposite turn.
        own = np.linalg.solve(mixture_oracle.right_jacobian(error if side == "right" else -error), factor)
        covariance += w * (np.outer(error, error) + own @ own.T)
    close(one.covariance, covariance)


@pytest.mark.parametrize("count", [1, 2, 4, 5])
def test_pairs_are_merged_in_runnalls_order(count):
    for seed in range(8):
        many = mixture(seed, n=7)
        found, expected = reduce(many, count), mixture_oracle.reduced(listed(many), count)
        expected = sorted(expected, key=lambda part: part[0])
        order = found.weights.argsort()
        close(found.weights[order], [part[0] for part in expected])
        close(found.x[order], [part[1] for part in expected])
        own = found.scale_tril[order]
        close(own @ own.mT, [part[2] for part in expected])


def test_units_do_not_change_the_order():
    many, unit = mixture(3, n=7), torch.tensor([1e-10, 1.0, 1e5], dtype=DOUBLE)
    scaled = many._replace(x=many.x * unit, scale_tril=many.scale_tril * unit.unsqueeze(-1))
    found, expected = reduce(scaled, 3), reduce(many, 3)
    close(found.x / unit, expected.x, 1e-11)
    close(found.weights, expected.weights)


@pytest.mark.parametrize("space", ["flat", "product"])
def test_reduction_keeps_mean_and_covariance(space):
    """Flat: to rounding. On a curved space to the square of the angles (0.2 rad) times the variances (0.1): 4e-3."""
    if space == "flat":
        many = mixture(4, n=9, lead=(2,))
    else:
        base = gaussian(space, scale=0.2)
        centres = base.sample(torch.randn((2, 9, 4), generator=torch.Generator().manual_seed(0), dtype=DOUBLE))
        many = mixture(4, n=9, lead=(2,))._replace(
            x=centres, space=base.space, scale_tril=0.1 * torch.eye(4, dtype=DOUBLE).expand(2, 9, 4, 4)
        )
    before, after = many.moments(), reduce(many, 3).moments()
    assert reduce(many, 3).x.shape[-2] == 3
    error = many.space.local(before[0], after[0])
    close(error, torch.zeros_like(error), 1e-12 if space == "flat" else 4e-3)
    close(after[1], before[1], 1e-12 if space == "flat" else 4e-3)


def test_rows_choose_their_own_pairs():
    rows = [mixture(seed, n=6) for seed in range(3)]
    together = tf.Particles(*(torch.stack([getattr(row, name) for row in rows]) for name in mixture(0)._fields[:3]))
    found = reduce(together, 3)
    for k, row in enumerate(rows):
        alone = reduce(row, 3)
        for name in ("x", "log_weights", "scale_tril"):
            close(getattr(found, name)[k], getattr(alone, name))
    broken = reduce(together._replace(x=together.x.index_fill(0, torch.tensor(1), torch.nan)), 3)
    for k in (0, 2):
        close(broken.x[k], found.x[k])
    assert broken.x[1].isnan().any()


def test_few_components_come_back_as_they_are():
    many = mixture(5)
    assert reduce(many, 6) is many


def test_components_without_weight_go_first():
    many = mixture(6, n=5)
    weights = many.weights.clone()
    weights[1] = weights[3] = 0
    many = many._replace(log_weights=(weights / weights.sum()).log())
    found = reduce(many, 3)
    close(found.weights.sort()[0], many.weights[[0, 2, 4]].sort()[0])
    close(found.x.sort(0)[0], many.x[[0, 2, 4]].sort(0)[0])


def test_singular_covariances_are_merged_as_well():
    many = mixture(7, n=6)
    flat = torch.diag_embed(torch.tensor([1.0, 0.5, 0.0], dtype=DOUBLE)).expand(6, 3, 3)
    many = many._replace(scale_tril=flat, x=many.x * torch.tensor([1.0, 1, 0], dtype=DOUBLE))
    found = reduce(many, 2)
    close(found.moments()[0], many.moments()[0])
    close(found.moments()[1], many.moments()[1])
    points = many._replace(scale_tril=torch.zeros_like(flat))
    close(reduce(points, 2).moments()[1], points.moments()[1])


def test_gradients_of_merging():
    many = mixture(8, n=4, e=2)

    def moments(x, log_weights, factor):
        found = reduce(tf.Particles(x, log_weights, factor.tril()), 2)
        return *merge(found).moments(), found.log_weights

    parts = [part.clone().requires_grad_() for part in (many.x, many.log_weights, many.scale_tril)]
    assert torch.autograd.gradcheck(lambda *p: merge(tf.Particles(p[0], p[1], p[2].tril())).covariance, parts)
    found = reduce(tf.Particles(parts[0], parts[1], parts[2]), 2)
    gradient = torch.autograd.grad(found.scale_tril.square().sum() + found.x.sum(), parts)
    for k, direction in enumerate(gradient):  # along itself: the steepest difference
        step = 1e-6 * direction / direction.norm()
        ends = []
        for sign in (1, -1):
            moved = [part.detach() + (sign * step if j == k else 0) for j, part in enumerate(parts)]
            after = reduce(tf.Particles(moved[0], moved[1], moved[2]), 2)
            ends.append(after.scale_tril.square().sum() + after.x.sum())
        assert abs((ends[0] - ends[1]) / 2e-6 - direction.norm()) < 1e-6 * (1 + direction.norm())


def test_a_component_without_weight_has_a_finite_gradient():
    many = mixture(9, n=3)
    logits = torch.tensor([0.0, -math.inf, -1.0], dtype=DOUBLE, requires_grad=True)
    x = many.x.clone().requires_grad_()
    one = merge(tf.Particles(x, torch.log_softmax(logits, -1), many.scale_tril))
    gradients = torch.autograd.grad(one.scale_tril.sum() + one.mean.sum(), (x, logits))
    assert all(torch.isfinite(part).all() for part in gradients)
    assert (gradients[0][1] == 0).all()


def test_single_precision_and_vmap():
    many = mixture(10, n=6, lead=(3,))
    single = tf.Particles(*(part.float() for part in many[:3]))
    found = reduce(single, 2)
    assert found.x.dtype == found.scale_tril.dtype == found.log_weights.dtype == torch.float32
    close(found.x, reduce(many, 2).x, 1e-5)
    mapped = torch.func.vmap(lambda *parts: reduce(tf.Particles(*parts), 2).x)(*many[:3])
    close(mapped, reduce(many, 2).x)


def test_errors_of_merging():
    points = mixture(0)._replace(scale_tril=None)
    for call in (merge, factors_of, lambda m: reduce(m, 2)):
        with pytest.raises(ValueError, match="needs a factor for its components, these particles are points"):
            call(points)
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        reduce(mixture(0), 0)


# ----------------------------------------------------------------------------------------------------------------------
# Splitting


@pytest.mark.parametrize("options", [{}, {"reach": 2.5}, {"reach": 3.5, "width": 0.7}, {"width": 0.3}])
@pytest.mark.parametrize("count", [5, 12])
@pytest.mark.parametrize("axis", [0, 2, -1])
def test_split_mean_and_covariance(count, axis, options):
    whole = gaussian(lead=(2,))
    parts = split_gaussian(whole, count, axis, **options)
    assert parts.x.shape == (2, count, 4) and parts.scale_tril.shape == (2, 1, 4, 4)
    for row in range(2):
        one = tf.Particles(parts.x[row], parts.log_weights[row], parts.scale_tril[row])
        mean, covariance = mixture_oracle.moments(listed(one))
        close(torch.tensor(mean), whole.mean[row])
        close(torch.tensor(covariance), whole.covariance[row])
    # Evenly spaced centres over cells of 2 reach / count, members `width` of them wide.
    reach, width = options.get("reach", 3.0), options.get("width", 0.6)
    deviation = whole.covariance[..., axis, axis].sqrt()
    gaps = parts.x[..., axis].diff(dim=-1)
    close(gaps, (2 * reach / count * deviation).unsqueeze(-1).expand_as(gaps))
    own = (parts.scale_tril @ parts.scale_tril.mT)[..., axis, axis]
    close(own, (width * 2 * reach / count * deviation).square().unsqueeze(-1))


def test_three_members_reach_less_far():
    parts = split_gaussian(gaussian(), 3, 0)
    close(parts.x[1], gaussian().mean)
    gap = (parts.x[1] - parts.x[0])[0] / gaussian().covariance[0, 0].sqrt()
    close(gap, 2 * 1.8 / 3)


def test_what_the_component_does_not_explain_is_kept():
    """Given the component, each member is the Gaussian itself."""
    whole = gaussian()
    p = whole.covariance
    parts = split_gaussian(whole, 9, 1)
    own = (parts.scale_tril @ parts.scale_tril.mT)[0]
    slope = p[:, 1] / p[1, 1]
    close(own[:, 1] / own[1, 1], slope)
    close(own - own[1, 1] * torch.outer(slope, slope), p - p[1, 1] * torch.outer(slope, slope))
    close(parts.x - whole.mean, torch.outer(parts.x[:, 1] - whole.mean[1], slope))


def test_the_density_is_that_of_the_gaussian():
    """The row ends at three deviations: total variation of a few times the 0.27 % beyond, and the ripple of 0.2 %."""
    whole = tf.Gaussian(torch.zeros(1, dtype=DOUBLE), torch.tensor([[2.0]], dtype=DOUBLE))
    parts = split_gaussian(whole, 12, 0)
    x = np.linspace(-12, 12, 4001)[:, None]
    density = sum(w * multivariate_normal(m, p).pdf(x) for w, m, p in listed(_spread(parts)))
    apart = 0.5 * np.abs(density - multivariate_normal([0], [[4.0]]).pdf(x)).sum() * (x[1, 0] - x[0, 0])
    assert apart < 0.01


def _spread(parts):
    return parts._replace(scale_tril=parts.scale_tril.expand(*parts.x.shape[:-1], -1, -1))


@pytest.mark.parametrize("axis", [0, 1, 3])
@pytest.mark.parametrize("space", ["product", "left"])
def test_split_on_rotations(space, axis):
    """Seen from the mean, through the inverse of the exponential map's derivative, the moments are exact."""
    whole = gaussian(space, scale=0.4)
    parts = split_gaussian(whole, 7, axis)
    errors = whole.space.local(whole.mean, parts.x)
    start = Rotation.from_quat(whole.mean[1:].numpy())
    covariance, mean = np.zeros((4, 4)), np.zeros(4)
    for w, x, factor in zip(parts.weights, parts.x, parts.scale_tril, strict=True):
        there = Rotation.from_quat(x[1:].numpy())
        turn = (start.inv() * there if space == "product" else there * start.inv()).as_rotvec()
        error = np.array([float(x[0] - whole.mean[0]), *turn])
        back = np.eye(4)
        back[1:, 1:] = np.linalg.inv(mixture_oracle.right_jacobian(turn if space == "product" else -turn))
        own = back @ factor.numpy()
        mean += float(w) * error
        covariance += float(w) * (np.outer(error, error) + own @ own.T)
    close(torch.tensor(mean), np.zeros(4))
    close(torch.tensor(covariance), whole.covariance)
    close(merge(parts).mean - whole.mean, np.zeros(5))
    assert errors.abs().max() > 0.3


def test_one_member_is_the_gaussian():
    whole = gaussian("product", lead=(2,))
    parts = split_gaussian(whole, 1, 0)
    assert torch.equal(parts.x[:, 0], whole.mean) and torch.equal(parts.scale_tril[:, 0], whole.scale_tril)
    close(parts.weights, np.ones((2, 1)))


def test_split_of_a_diagonal_in_single_precision_with_gradient():
    deviation = torch.tensor([1.0, 2.0], requires_grad=True)
    parts = split_gaussian(tf.Gaussian(torch.zeros(2), deviation, is_diagonal=True), 8, 1)
    assert parts.x.dtype == parts.scale_tril.dtype == parts.log_weights.dtype == torch.float32
    covariance = parts.moments()[1]
    close(covariance, np.diag([1.0, 4.0]), 1e-5)
    close(torch.autograd.grad(covariance[1, 1], deviation)[0], [0.0, 4.0], 1e-5)


def test_errors_of_splitting():
    whole = gaussian()
    for count in (0, 2, -3):
        with pytest.raises(ValueError, match=f"count must be 1 or at least 3, got {count}"):
            split_gaussian(whole, count, 0)
    for axis in (4, -5):
        with pytest.raises(ValueError, match=f"axis must be from -4 to 3, got {axis}"):
            split_gaussian(whole, 5, axis)
    with pytest.raises(ValueError, match=r"reach and width must be positive, got -1\.0 and 0\.6"):
        split_gaussian(whole, 5, 0, reach=-1.0)
    with pytest.raises(ValueError, match=r"reach and width must be positive, got 3\.0 and 0"):
        split_gaussian(whole, 5, 0, width=0)
    for options in ({"reach": 1.0}, {"width": 2.0}):
        with pytest.raises(ValueError, match="can't have the variance of the whole: take another reach or width"):
            split_gaussian(whole, 5, 0, **options)
    flat = tf.Gaussian(torch.zeros(2, dtype=DOUBLE), torch.tensor([1.0, 0.0], dtype=DOUBLE), is_diagonal=True)
    with pytest.raises(ValueError, match="component 1 must have a variance above zero to be split along"):
        split_gaussian(flat, 5, 1)


# ----------------------------------------------------------------------------------------------------------------------
# Laws


def test_initial_mixture_gives_its_moments():
    many = mixture(11, lead=(2,))
    law = InitialMixture(many)
    mean, covariance = many.moments()
    close(law().mean, mean)
    close(law().covariance, covariance)
    assert set(law.state_dict()) == {"x", "log_weights", "scale_tril"}
    assert law.float()().mean.dtype == torch.float32
    assert torch.equal(InitialMixture(many).mixture().x, many.x)


def test_initial_mixture_keeps_parameters():
    many = mixture(12)
    law = InitialMixture(many._replace(x=torch.nn.Parameter(many.x)))
    assert [name for name, _ in law.named_parameters()] == ["x"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_tril": None}, "needs a factor for its components"),
        ({"x": torch.full((6, 3), torch.inf, dtype=DOUBLE)}, "x must be finite"),
        ({"scale_tril": torch.full((6, 3, 3), torch.nan, dtype=DOUBLE)}, "scale_tril must be finite"),
        ({"scale_tril": torch.ones(6, 3, 3, dtype=DOUBLE)}, "lower triangular"),
        ({"log_weights": torch.zeros(6, dtype=DOUBLE)}, "weights must sum to one, they sum to 6"),
        ({"log_weights": torch.full((6,), torch.nan, dtype=DOUBLE)}, "weights must be finite"),
        ({"log_weights": torch.full((5,), -math.log(5), dtype=DOUBLE)}, "got (6, 3), (5,) and (6, 3, 3)"),
        ({"scale_tril": torch.eye(3, dtype=DOUBLE)}, "got (6, 3), (6,) and (3, 3)"),
        ({"scale_tril": torch.eye(3, dtype=DOUBLE).expand(4, 3, 3)}, "got (6, 3), (6,) and (4, 3, 3)"),
        ({"scale_tril": torch.eye(2, dtype=DOUBLE).expand(6, 2, 2)}, "got (6, 3), (6,) and (6, 2, 2)"),
        ({"scale_tril": torch.eye(3, dtype=DOUBLE).expand(2, 6, 3, 3)}, "got (6, 3), (6,) and (2, 6, 3, 3)"),
    ],
)
def test_errors_of_the_initial_mixture(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        InitialMixture(mixture(0)._replace(**change))


def test_the_initial_mixture_takes_particles_only():
    with pytest.raises(TypeError, match="mixture must be Particles with factors, got Gaussian"):
        InitialMixture(gaussian())


def linear(scale, push=0.0):
    eye = torch.eye(2, dtype=DOUBLE)
    return tf.LinearGaussian(eye, scale**2 * eye, torch.full((2,), push, dtype=DOUBLE))


def test_mixture_law_is_one_of_several():
    law = MixtureLaw([linear(1.0), linear(5.0, 2.0)], [0.9, 0.1])
    x = torch.tensor(np.random.default_rng(0).standard_normal((3, 4, 2)))
    y = x + 1.5
    expected = np.log(
        0.9 * np.exp(-((1.5**2) / 2) * 2) / (2 * np.pi) + 0.1 * np.exp(-(0.5**2) / 50 * 2) / (2 * np.pi * 25)
    )
    close(law(x).log_prob(y), np.full((3, 4), expected))
    assert isinstance(law(x), MixtureSameFamily)
    assert "law_1.matrix" in law.state_dict() and not law.takes_controls
    single = law.float()(x.float())
    assert single.mean.dtype == torch.float32


def test_mixture_law_passes_controls_and_step():
    plain = lambda x: tf.Gaussian(x, torch.ones(2, dtype=DOUBLE), is_diagonal=True)  # noqa: E731
    pushed = lambda x, u, dt: tf.Gaussian(x + u * dt, torch.ones(2, dtype=DOUBLE), is_diagonal=True)  # noqa: E731
    law = MixtureLaw([plain, pushed], torch.tensor([0.25, 0.75], dtype=DOUBLE))
    assert law.takes_controls
    x, u = torch.zeros(3, 2, dtype=DOUBLE), torch.tensor([1.0, 2.0], dtype=DOUBLE)
    close(law(x, u, 2.0).mean, np.tile([1.5, 3.0], (3, 1)))
    eye = torch.eye(2, dtype=DOUBLE)
    controlled = tf.LinearGaussian(eye, eye, control_matrix=eye)
    assert MixtureLaw([linear(1.0), controlled], [0.5, 0.5]).takes_controls


def test_mixture_weights_can_be_learned():
    weights = torch.nn.Parameter(torch.tensor([0.5, 0.5], dtype=DOUBLE))
    law = MixtureLaw([linear(1.0), linear(5.0)], weights)
    law(torch.zeros(2, dtype=DOUBLE)).log_prob(torch.ones(2, dtype=DOUBLE)).backward()
    one, other = (multivariate_normal(np.zeros(2), s * np.eye(2)).pdf(np.ones(2)) for s in (1, 25))
    # Categorical normalises its weights, so the derivative along both of them is zero.
    close(weights.grad, (np.array([one, other]) - (one + other) / 2) / ((one + other) / 2))


def test_other_filters_take_a_mixture_law():
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE)),
        linear(0.5),
        MixtureLaw([linear(1.0), linear(5.0, 1.0)], [0.9, 0.1]),
    )
    ys = torch.tensor(np.random.default_rng(1).standard_normal((3, 2)))
    kalman = tf.UnscentedKalmanFilter(model)(ys)
    # Mean 0.1 and variance 0.9 + 2.5 + 0.09 of the noise; the means' offsets are along (1, 1).
    noise = (0.9 + 0.1 * 25) * np.eye(2) + 0.09 * np.ones((2, 2))
    expected = mixture_oracle.gaussian_sum(
        [(1.0, np.zeros(2), np.eye(2))], np.eye(2), np.eye(2), [(1, 0, 0.25 * np.eye(2))], [(1, 0.1, noise)], ys.numpy()
    )
    close(kalman.log_likelihood, expected[1].sum())
    particles = tf.BootstrapFilter(model, 20000)(ys)
    exact = tf.GaussianSumFilter(model)(ys)
    # 20000 particles: the log-evidence of a step has a deviation below 0.01; 4.5 of them: one in 1e5 seeds.
    assert abs(particles.log_likelihood - exact.log_likelihood) < 0.045 * 3**0.5


def test_errors_of_the_mixture_law():
    with pytest.raises(ValueError, match="a mixture needs two laws or more, got 1"):
        MixtureLaw([linear(1.0)], [1.0])
    with pytest.raises(TypeError, match=re.escape("a law is called as law(x) or law(x, u, dt), got int")):
        MixtureLaw([linear(1.0), 3], [0.5, 0.5])
    with pytest.raises(ValueError, match=re.escape("weights must be (2,), one a law, got (3,)")):
        MixtureLaw([linear(1.0), linear(2.0)], [0.5, 0.3, 0.2])
    for weights, message in (
        ([0.5, 0.6], "weights must sum to one, they sum to 1.1"),
        ([1.5, -0.5], "weights must not be negative, got -0.5"),
        ([math.nan, 1.0], "weights must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            MixtureLaw([linear(1.0), linear(2.0)], weights)
    x = torch.zeros(2, dtype=DOUBLE)
    with pytest.raises(TypeError, match="only Gaussians on a Euclidean space make a MixtureSameFamily, got Normal"):
        MixtureLaw([linear(1.0), lambda x: Normal(x, 1.0)], [0.5, 0.5])(x)
    angles = tf.AdditiveGaussian(lambda x: x, torch.eye(2, dtype=DOUBLE), tf.Angle(2))
    with pytest.raises(TypeError, match=re.escape("got one on Angle(size=2)")):
        MixtureLaw([linear(1.0), angles], [0.5, 0.5])(x)


def test_probabilities_in_rows():
    check_probabilities(torch.tensor([[0.5, 0.5], [1.0, 0.0]]), "rows")
    with pytest.raises(ValueError, match=r"rows must sum to one, they sum to 1\.5"):
        check_probabilities(torch.tensor([[0.5, 0.5], [1.0, 0.5]]), "rows")
