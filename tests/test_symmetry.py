"""Symmetries: a vehicle without a compass near a landmark, whose turned copies no measurement can tell apart.

In the vehicle's own axes the problem is linear, so that NumPy's Kalman filter knows the answer.
"""

import copy

import numpy as np
import pytest
import torch
from oracles import symmetry_oracle
from symmetry_problem import (
    DOUBLE,
    DT,
    HEADING_SD,
    HIGH,
    PRIOR_SD,
    SPACE,
    US,
    WALK,
    Drive,
    DriveWithSlope,
    NoseEast,
    camera,
    model,
    nose_east,
    own,
    ranging,
)

import torchfilt as tf
from torchfilt.gaussian import Gaussian
from torchfilt.symmetry import gauge_first_order, into_gauge
from torchfilt.testing import check_law, check_symmetry


def simulated(sd, rows, seed, us=US, wobble=0.0):
    rng = np.random.default_rng(seed)
    states, b = symmetry_oracle.simulate(rng, rows, us, DT, PRIOR_SD, HEADING_SD, WALK, wobble)
    return states, b, b / HIGH + sd * rng.standard_normal(b.shape)


def exact(sd, ys, us=US):
    """Mean (rows, 2) and covariance at the end and log-likelihood (rows) of series (steps, rows, 2)."""
    eye = np.eye(2)
    answers = [
        symmetry_oracle.kalman(us, DT, PRIOR_SD, WALK, eye / HIGH, sd**2 * eye, ys[:, row])
        for row in range(ys.shape[1])
    ]
    last = [(a.mean[-1], a.covariance[-1], a.log_likelihood.sum()) for a in answers]
    return tuple(np.array(part) for part in zip(*last, strict=True))


def in_gauge(belief):
    """Mean and covariance of the position in the vehicle's axes that a belief holds, whatever its heading."""
    if isinstance(belief, Gaussian):
        turned = into_gauge(nose_east, belief)
        return turned.mean[..., :2], turned.covariance[..., :2, :2]
    if belief.scale_tril is None:
        turned = belief._replace(x=nose_east(belief.x))
    else:
        each = into_gauge(nose_east, Gaussian(belief.x, belief.scale_tril, SPACE))
        turned = belief._replace(x=each.mean, scale_tril=each.scale_tril)
    return turned.mean[..., :2], turned.covariance[..., :2, :2]


def nees(mean, covariance, truth):
    error = truth - np.asarray(mean)
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(np.asarray(covariance)), error)


# Exact where the quotient is ----------------------------------------------------------------------------------------

GAUSSIAN = {
    "extended": tf.ExtendedKalmanFilter,
    "unscented": tf.UnscentedKalmanFilter,
    "cubature": tf.CubatureKalmanFilter,
    "Gauss-Hermite": tf.GaussHermiteKalmanFilter,
}


@pytest.mark.parametrize("gauge", [nose_east, NoseEast()], ids=["differentiated", "own derivative"])
@pytest.mark.parametrize("motion", [Drive(), DriveWithSlope()], ids=["plain", "with slope"])
@pytest.mark.parametrize("name", GAUSSIAN)
def test_gaussian_filters_in_the_gauge_are_exact(name, motion, gauge):
    """Heading zero at each start makes both laws linear; 8 steps of rounding at condition (5 / 0.1)^2."""
    _, _, ys = simulated(0.05, 5, 0)
    history = GAUSSIAN[name](model(gauge, camera(0.05), motion))(torch.tensor(ys), torch.tensor(US), DT)
    mean, covariance, log_likelihood = exact(0.05, ys)
    found = in_gauge(history.final.belief)
    np.testing.assert_allclose(found[0], mean, atol=1e-10)
    np.testing.assert_allclose(found[1].expand(5, 2, 2), covariance, atol=1e-10)
    np.testing.assert_allclose(history.log_likelihood, log_likelihood, rtol=1e-10)
    turns = history.covariance[..., 2, 2]
    assert turns.abs().max() < 1e-20, "nothing is claimed or denied along the orbit"


@pytest.mark.parametrize("name", GAUSSIAN)
def test_without_the_gauge_they_are_not(name):
    """The same data, a tenth of the evidence or less: the test above can fail."""
    _, _, ys = simulated(0.05, 40, 0)
    history = GAUSSIAN[name](model(None, camera(0.05)))(torch.tensor(ys), torch.tensor(US), DT)
    assert (history.log_likelihood - torch.tensor(exact(0.05, ys)[2])).mean() < -1.0


# Consistency --------------------------------------------------------------------------------------------------------


def test_without_the_gauge_certainty_is_faked_and_with_it_not():
    """24 steps, 400 runs, the gyro wobbles. A chi-square of 2 degrees has deviation 2: 4.5 standard errors are 0.45.

    Without the gauge the unscented filter ends with a heading of some 0.15 rad, of which nothing was ever measured; it
    is off by the 1 rad of the prior, its normalised error some hundred times what it should be.
    """
    us, rows = np.tile(US, (3, 1)), 400
    states, b, ys = simulated(0.02, rows, 1, us, wobble=0.1)
    runs = {
        gauge: tf.UnscentedKalmanFilter(model(gauge, camera(0.02), Drive(0.1)))(
            torch.tensor(ys), torch.tensor(us), DT, record="beliefs"
        )
        for gauge in (nose_east, None)
    }
    right = nees(*in_gauge(runs[nose_east].final.belief), b[-1])
    assert abs(right.mean() - 2) < 4.5 * right.std() / rows**0.5
    free = runs[None]
    error = SPACE.local(free.mean[-1], torch.tensor(states[-1])).numpy()
    claimed = free.covariance[-1, :, 2, 2].sqrt().mean()
    assert claimed < 0.2 and abs(error[:, 2].std() - HEADING_SD) < 0.15
    wrong = nees(free.mean[-1], free.covariance[-1], states[-1]) / 3
    assert wrong.mean() > 100
    # After the first steps the extended filter, too, thinks it can see the heading.
    naive = tf.ExtendedKalmanFilter(model(None, camera(0.02), Drive(0.1)))(torch.tensor(ys), torch.tensor(us), DT)
    assert naive.covariance[-1, :, 2, 2].sqrt().mean() < 0.2


# Particles ----------------------------------------------------------------------------------------------------------

ROWS, SD = 200, 0.2
_, _, YS = simulated(SD, ROWS, 2)
EXACT = exact(SD, YS)
BANKS = {
    "bank": lambda m: tf.LocallyLinearizedParticleFilter(m, 30),
    "Rao-Blackwellized": lambda m: tf.RaoBlackwellizedParticleFilter(m, 30, drawn=[2]),
    "bootstrap": lambda m: tf.BootstrapFilter(m, 2000),
    "regularized": lambda m: tf.RegularizedParticleFilter(m, 500),
}


def against_exact(make, gauge):
    """Ratios of evidence (rows), whitened errors of the mean (rows, 2), mean ratio of determinants of covariances."""
    history = make(model(gauge, camera(SD)))(torch.tensor(YS), torch.tensor(US), DT, record="beliefs", seed=3)
    mean, covariance = in_gauge(history.final.belief)
    ratio = np.exp(history.log_likelihood.numpy() - EXACT[2])
    root = np.linalg.cholesky(EXACT[1])
    away = np.linalg.solve(root, (mean.numpy() - EXACT[0])[..., None])[..., 0]
    return ratio, away, (np.linalg.det(covariance.numpy()) / np.linalg.det(EXACT[1])).mean()


@pytest.mark.parametrize("name", ["bank", "Rao-Blackwellized", "bootstrap"])
def test_particles_in_the_gauge_have_the_exact_evidence(name):
    """Unbiased, 4.5 standard errors over 200 runs (one false alarm in 10^5); mean and covariance the exact ones.

    The bank of 30 Gaussians leaves a mean off by a few hundredths of a deviation, 2000 points by 0.15; the
    spread of such a cloud is a few per cent small, once for each resampling.
    """
    ratio, away, spread = against_exact(BANKS[name], NoseEast())
    assert abs(ratio.mean() - 1) < 4.5 * ratio.std() / ROWS**0.5 + 1e-9
    assert np.sqrt((away**2).mean()) < (0.25 if name == "bootstrap" else 0.05)
    assert abs(spread - 1) < (0.1 if name == "bootstrap" else 0.02)


def test_a_kernel_in_the_gauge_does_not_smear_the_orbit():
    """Regularisation about one nose: evidence within some per cent, and the covariance; about many noses: neither."""
    ratio, away, spread = against_exact(BANKS["regularized"], nose_east)
    assert abs(np.log(ratio).mean()) < 0.15 and np.sqrt((away**2).mean()) < 0.3 and abs(spread - 1) < 0.15
    ratio, away, spread = against_exact(BANKS["regularized"], None)
    assert np.log(ratio).mean() < -0.15 and spread > 1.3


def test_a_bank_without_the_gauge_loses_evidence():
    """Each of its Gaussians is bent along the orbit."""
    ratio, _, spread = against_exact(BANKS["bank"], None)
    assert np.log(ratio).mean() < -0.3 and spread > 1.1


def test_a_pooled_redraw_leaves_the_orbit_alone():
    ratio, away, _ = against_exact(lambda m: tf.UnscentedParticleFilter(m, 30), nose_east)
    assert np.isfinite(ratio).all() and np.sqrt((away**2).mean()) < 0.3


@pytest.mark.parametrize("gauge", [nose_east, None], ids=["gauge", "free"])
def test_ranges_alone_leave_a_ring_whose_evidence_is_that_of_many_particles(gauge):
    """Bootstrap filters with and without the gauge against 400,000 of NumPy's points in the vehicle's axes.

    A cloud of points does not care for the gauge: it is the same law of what is measured. The reference itself is sure
    to about 0.3 %, which is added to 4.5 standard errors.
    """
    wobble, sd, rows = 0.15, 1.0, 150
    _, b, _ = simulated(sd, 1, 5, wobble=wobble)
    rng = np.random.default_rng(6)
    ys = np.sqrt((b[:, 0] ** 2).sum(-1, keepdims=True) + HIGH**2) + sd * rng.standard_normal((len(US), 1))

    def log_density(y, b):
        away = y[0] - np.sqrt((b**2).sum(-1) + HIGH**2)
        return -0.5 * (away / sd) ** 2 - np.log(sd * np.sqrt(2 * np.pi))

    total, mean, covariance = symmetry_oracle.bootstrap(rng, 400_000, US, DT, PRIOR_SD, WALK, wobble, log_density, ys)
    filter = tf.BootstrapFilter(model(gauge, ranging(sd), Drive(wobble)), 400)
    history = filter(torch.tensor(ys).unsqueeze(1).expand(-1, rows, 1), torch.tensor(US), DT, record="beliefs")
    ratio = (history.log_likelihood - total).exp()
    assert abs(ratio.mean() - 1) < 4.5 * ratio.std() / rows**0.5 + 0.01
    found, spread = in_gauge(history.final.belief)
    error = found.std(0) / rows**0.5
    assert (abs(found.mean(0) - torch.tensor(mean)) < 4.5 * error + 0.03).all()
    # A cloud's own covariance is short of the spread of its mean.
    whole = spread.mean(0) + found.T.cov()
    np.testing.assert_allclose(whole, covariance, atol=0.08 * np.trace(covariance))


# The map and its derivative -----------------------------------------------------------------------------------------

X = torch.tensor([[1.0, 2.0, 0.5], [-3.0, 1.0, -2.5], [0.3, -4.0, 3.0]], dtype=DOUBLE)
U = torch.tensor([[1.0, 0.3], [2.0, -0.4], [0.5, 1.0]], dtype=DOUBLE)


def test_a_gaussian_in_the_gauge_is_that_of_its_draws():
    """First order: mean by the map, covariance by finite draws with small deviations, 5 standard errors."""
    factor = 1e-4 * torch.tensor([[1.0, 0, 0], [0.5, 2, 0], [-0.3, 0.4, 0.7]], dtype=DOUBLE)
    turned = into_gauge(nose_east, tf.Gaussian(X[0], factor, SPACE))
    assert torch.equal(turned.mean, nose_east(X[0])) and torch.equal(turned.scale_tril, turned.scale_tril.tril())
    draws = tf.Gaussian(X[0], factor, SPACE).sample(
        torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    )
    spread = nose_east(draws).T.cov()
    deviation = turned.variance.sqrt()
    limit = 5 * (2 / 200_000) ** 0.5 * deviation.unsqueeze(-1) * deviation + 1e-12
    assert ((spread - turned.covariance).abs() <= limit).all()
    assert turned.variance[2] == 0


def test_the_derivative_given_and_the_one_found_are_the_same():
    for x in (X, X[0], X.view(1, 3, 1, 3)):
        for mine, found in zip(NoseEast().first_order(x), gauge_first_order(nose_east, x, SPACE), strict=True):
            np.testing.assert_allclose(mine, found, atol=1e-14)


def test_a_model_with_a_gauge():
    plain, gauged = model(None, camera(SD)), model(nose_east, camera(SD))
    assert torch.equal(plain.representative(X), X) and torch.equal(gauged.representative(X), nose_east(X))
    assert gauged.prior().variance[2] == 0 and plain.prior().variance[2] == HEADING_SD**2
    assert gauged.takes_controls() and not gauged.is_linear()
    with pytest.raises(TypeError, match=r"gauge must be a map of states, called as gauge.x., got float"):
        tf.StateSpaceModel(plain.initial, Drive(), camera(SD), gauge=1.0)
    twin = copy.deepcopy(gauged).float()
    assert twin.conditional("transition", X.float(), U.float(), DT).mean.dtype == torch.float32
    for motion in (Drive(), DriveWithSlope()):
        check_law(model(NoseEast(), camera(SD), motion).transition, X, U, DT)


# The check ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", [nose_east, NoseEast()], ids=["plain", "with derivative"])
def test_the_symmetric_model_passes(gauge):
    for law in (camera(SD), ranging(0.5), tf.Sensors(camera=camera(SD), range=ranging(0.5))):
        check_symmetry(model(gauge, law, Drive(0.1)), X, U, DT)


def compass(x):
    return tf.Gaussian(x[..., 2:], torch.full((1,), 0.1, dtype=x.dtype), tf.Angle(1), is_diagonal=True)


def louder_north(x):
    return tf.Gaussian(own(x), 1 + x[..., 1:2].square() * torch.eye(2, dtype=x.dtype)[0], is_diagonal=True)


def half_way(x):
    return torch.cat([x[..., :2], 0.5 * x[..., 2:]], -1)


def mixes(x):
    return nose_east(x) + 1e-6 * torch.nan_to_num(x[..., :1]).mean() * torch.eye(3, dtype=x.dtype)[0]


def double(x):
    return nose_east(x.double())


def short(x):
    return own(x)


def infinite(x):
    return nose_east(x) / torch.zeros_like(x)


def unwrapped(x):
    return torch.cat([own(x), torch.full_like(x[..., 2:], 7.0)], -1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gauge": None}, "needs a model with a gauge"),
        ({"gauge": half_way}, "half_way: the representative of a representative is itself, it is 0.75 off"),
        ({"gauge": mixes}, "mixes: (the representative of a rep|row 0 alone and in the batch)"),
        ({"gauge": double}, "double: the gauge must keep the dtype torch.float32, got torch.float64"),
        ({"gauge": short}, r"short: a representative must be \(3, 3\), got \(3, 2\)"),
        ({"gauge": unwrapped}, r"unwrapped: a representative must lie on Product\(.*\), it is 6.28 off"),
        ({"gauge": infinite}, "infinite: representatives must be finite"),
        ({"gauge": NoseEast("derivative")}, "NoseEast: first_order and the derivative of the map"),
        ({"gauge": NoseEast("value")}, "NoseEast: the representative of first_order"),
        ({"observation": compass}, "what is measured at a state and at its representative: means"),
        ({"observation": louder_north}, "what is measured at a state and at its representative: covariances"),
        ({"motion": Drive(current=0.3)}, "the motions of a state and of its representative, in the gauge: means"),
        ({"motion": Drive(sd=(0.1, 0.5))}, "the motions of a state and .* in the gauge: covariances"),
        ({"x": nose_east(X)}, "give states that are not representatives, row 0 is"),
        ({"x": X[0]}, r"give x as \(rows, d\) with two rows or more, got \(3,\)"),
    ],
)
def test_what_breaks_the_symmetry_is_found(options, message):
    broken = model(
        options.get("gauge", nose_east), options.get("observation", camera(SD)), options.get("motion", Drive(0.1))
    )
    with pytest.raises(AssertionError, match=message):
        check_symmetry(broken, options.get("x", X), U, DT)
