"""Constraints that are always there: against projections, constrained least squares and Kalman filters."""

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import torch
from oracles import kalman_oracle
from torch import nn

import torchfilt as tf
from torchfilt.testing import check_law

DOUBLE = torch.float64
RNG = np.random.default_rng(11)
D = 4
M0, ROOT = RNG.standard_normal(D), RNG.standard_normal((D, D)) + 2 * np.eye(D)
P0 = ROOT @ ROOT.T
H, GOAL = RNG.standard_normal((2, D)), RNG.standard_normal(2)  # what must hold: H x = GOAL
A, R = RNG.standard_normal((1, D)), np.array([[0.3]])  # what is measured: z = A x + noise
F, Q = 0.9 * np.eye(D) + 0.1 * RNG.standard_normal((D, D)), 0.2 * np.eye(D)
ZS = RNG.standard_normal((8, 3, 1))


def tensor(values, dtype=DOUBLE):
    return torch.as_tensor(np.array(values, dtype=float)).to(dtype)


def level(sd, kind="matrix", value=GOAL):
    """The constraint H x = value in one of its forms."""
    h = tensor(H)
    if kind == "matrix":
        return tf.PseudoMeasurement(h, 2, sd, tensor(value))
    jacobian = (lambda x: h.to(x).expand(*x.shape[:-1], 2, D)) if kind == "jacobian" else None
    return tf.PseudoMeasurement(lambda x: x @ h.to(x).mT, 2, sd, tensor(value), jacobian=jacobian)


def model(constraint, q=Q, f=F):
    law = tf.Sensors(z=tf.LinearGaussian(tensor(A), tensor(R)), level=constraint)
    prior = tf.Gaussian(tensor(M0), torch.linalg.cholesky(tensor(P0)))
    return tf.StateSpaceModel(prior, tf.LinearGaussian(tensor(f), tensor(q)), law)


GAUSSIAN = {
    "Kalman": tf.KalmanFilter,
    "extended": tf.ExtendedKalmanFilter,
    "unscented": tf.UnscentedKalmanFilter,
    "cubature": tf.CubatureKalmanFilter,
    "Gauss-Hermite": tf.GaussHermiteKalmanFilter,
}


def kinds(name):
    return ["matrix"] if name == "Kalman" else ["matrix", "function", "jacobian"]


FORMS = [(name, kind) for name in GAUSSIAN for kind in kinds(name)]


# Exact constraints --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "kind"), FORMS)
def test_an_exact_constraint_projects(name, kind):
    """x - P H^T (H P H^T)^-1 (H x - d), and the evidence N(d; H m, H P H^T)."""
    filter = GAUSSIAN[name](model(level(0.0, kind)))
    history = filter({"z": torch.full((1, 1), torch.nan, dtype=DOUBLE)}, predict_first=False)
    gain = np.linalg.solve(H @ P0 @ H.T, H @ P0).T
    np.testing.assert_allclose(history.mean[0], M0 - gain @ (H @ M0 - GOAL), rtol=1e-12)
    np.testing.assert_allclose(history.covariance[0], P0 - gain @ H @ P0, atol=1e-12 * P0.max())
    expected = scipy.stats.multivariate_normal(H @ M0, H @ P0 @ H.T).logpdf(GOAL)
    np.testing.assert_allclose(history.log_likelihood, expected, rtol=1e-12)
    along = history.covariance[0].numpy() @ H.T
    assert np.abs(along).max() < 1e-12 * P0.max(), "nothing is left unknown of what was constrained"


@pytest.mark.parametrize(("name", "kind"), FORMS)
def test_an_exact_constraint_and_a_measurement_are_constrained_least_squares(name, kind):
    """Karush, Kuhn and Tucker: least (x-m)^T P^-1 (x-m) + (z-Ax)^T R^-1 (z-Ax) under H x = d."""
    history = GAUSSIAN[name](model(level(0.0, kind)))({"z": tensor(ZS[:1, 0])}, predict_first=False)
    hessian = np.linalg.inv(P0) + A.T @ np.linalg.solve(R, A)
    right = np.linalg.solve(P0, M0) + A.T @ np.linalg.solve(R, ZS[0, 0])
    kkt = np.block([[hessian, H.T], [H, np.zeros((2, 2))]])
    solution = np.linalg.solve(kkt, np.concatenate([right, GOAL]))
    inverse = np.linalg.inv(kkt)
    np.testing.assert_allclose(history.mean[0], solution[:D], rtol=1e-11)
    np.testing.assert_allclose(history.covariance[0], inverse[:D, :D], atol=1e-11 * P0.max())
    both, noise = np.concatenate([A, H]), np.zeros((3, 3))
    noise[0, 0] = R[0, 0]
    law = scipy.stats.multivariate_normal(both @ M0, both @ P0 @ both.T + noise)
    np.testing.assert_allclose(history.log_likelihood, law.logpdf(np.concatenate([ZS[0, 0], GOAL])), rtol=1e-11)


def oracle(sd, row, zs=ZS):
    """Kalman filter in covariance form with the constraint as two more measured numbers."""
    ys = np.concatenate([zs[:, row], np.broadcast_to(GOAL, (len(zs), 2))], -1)
    noise = np.diag([R[0, 0], sd**2, sd**2])
    return kalman_oracle.kalman(M0, P0, F, Q, np.concatenate([A, H]), noise, ys)


@pytest.mark.parametrize("sd", [0.0, 0.4])
@pytest.mark.parametrize(("name", "kind"), FORMS)
def test_a_constraint_that_the_motion_breaks_is_a_measurement_at_each_step(name, kind, sd):
    zs = ZS.copy()
    zs[2, 1] = zs[5] = np.nan
    history = GAUSSIAN[name](model(level(sd, kind)))({"z": tensor(zs)})
    for row in range(3):
        expected = oracle(sd, row, zs)
        np.testing.assert_allclose(history.mean[:, row], expected.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(history.covariance[:, row], expected.covariance, atol=1e-10)
        np.testing.assert_allclose(history.log_likelihood[row], expected.log_likelihood.sum(), rtol=1e-11)
    if sd == 0:
        np.testing.assert_allclose(history.mean.numpy() @ H.T - GOAL, 0, atol=1e-13)


def test_a_soft_constraint_tends_to_the_exact_one():
    """The difference is of second order in sd: a tenth of sd, a hundredth of it."""
    zs = {"z": tensor(ZS)}
    exact = tf.KalmanFilter(model(level(0.0)))(zs).mean
    away = [(tf.KalmanFilter(model(level(sd)))(zs).mean - exact).abs().max().item() for sd in (1e-2, 1e-3, 1e-4)]
    np.testing.assert_allclose([away[0] / away[1], away[1] / away[2]], 100, rtol=0.02)


@pytest.mark.parametrize("name", GAUSSIAN)
def test_an_exact_constraint_that_holds_already_changes_nothing(name):
    """The state stands still without noise: after the first step the constraint has nothing to say."""
    still = model(level(0.0), q=np.zeros((D, D)), f=np.eye(D))
    history = GAUSSIAN[name](still)({"z": tensor(ZS)}, throw=False)
    assert history.diagnostics.ok.all()
    both, noise = np.concatenate([A, H]), np.diag([R[0, 0], 0, 0])
    for row in range(3):
        ys = np.full((len(ZS), 3), np.nan)
        ys[:, 0], ys[0, 1:] = ZS[:, row, 0], GOAL
        expected = kalman_oracle.kalman(M0, P0, np.eye(D), np.zeros((D, D)), both, noise, ys)
        np.testing.assert_allclose(history.mean[:, row], expected.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(history.covariance[:, row], expected.covariance, atol=1e-9)
        found = history.diagnostics.log_likelihood[:, row]
        np.testing.assert_allclose(found, expected.log_likelihood, rtol=1e-9)


RULES = {
    "Taylor": tf.moments.taylor(),
    "unscented": tf.moments.unscented(),
    "cubature": tf.moments.cubature(),
    "Gauss-Hermite": tf.moments.gauss_hermite(),
}


@pytest.mark.parametrize("moves", [True, False], ids=["moving", "still"])
@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
@pytest.mark.parametrize("kind", ["matrix", "function", "jacobian"])
def test_iterations_go_with_an_exact_constraint(kind, rule, moves):
    """On linear laws a second linearisation changes nothing; a quadrature's is right to eps^(2/3), 4e-11."""
    motion = {} if moves else {"q": np.zeros((D, D)), "f": np.eye(D)}
    once = tf.KalmanFilter(model(level(0.0), **motion))({"z": tensor(ZS)})
    thrice = tf.GaussianFilter(model(level(0.0, kind), **motion), rule, iterations=3)({"z": tensor(ZS)})
    np.testing.assert_allclose(thrice.mean, once.mean, atol=1e-9)
    np.testing.assert_allclose(thrice.covariance, once.covariance, atol=1e-9)
    np.testing.assert_allclose(thrice.log_likelihood, once.log_likelihood, rtol=1e-9)


def projected(measured, noise, zs, times):
    """Mean, covariance and log-likelihood of a still state by NumPy: x = point + N s, with N the null space of H.

    The constraint conditions once, the measurements then act on s alone.
    """
    gain = np.linalg.solve(H @ P0 @ H.T, H @ P0).T
    null = scipy.linalg.null_space(H)
    mean = M0 - gain @ (H @ M0 - GOAL)
    cov = null.T @ (P0 - gain @ H @ P0) @ null
    value = scipy.stats.multivariate_normal(H @ M0, H @ P0 @ H.T).logpdf(GOAL)
    slope = measured @ null
    s = np.zeros(len(cov))
    for k in range(times):
        s, cov, more = kalman_oracle.update(s, cov, zs[k] - measured @ mean, slope, noise)
        value += more
    return mean + null @ s, null @ cov @ null.T, value


@pytest.mark.parametrize("dtype", [DOUBLE, torch.float32])
@pytest.mark.parametrize(("name", "kind"), FORMS)
def test_applied_again_and_again_is_applied_once(name, kind, dtype):
    """Forty times without motion, against NumPy in the null space of H; the evidence counts the constraint once.

    Forty updates round by 40 eps of numbers up to 10, times the condition of S (60) in the likelihood.
    """
    times = 40
    zs = np.random.default_rng(6).standard_normal((times, 1))
    filter = GAUSSIAN[name](model(level(0.0, kind), q=np.zeros((D, D)), f=np.eye(D)).to(dtype))
    history = filter({"z": tensor(zs, dtype)})
    mean, covariance, value = projected(A, R, zs, times)
    eps = torch.finfo(dtype).eps
    np.testing.assert_allclose(history.mean[-1], mean, atol=1000 * eps)
    np.testing.assert_allclose(history.covariance[-1], covariance, atol=1000 * eps)
    np.testing.assert_allclose(history.log_likelihood, value, atol=4e4 * eps)
    assert (history.mean @ tensor(H, dtype).mT - tensor(GOAL, dtype)).abs().max() < 20 * eps


KEEPS = np.array([[0.7, 0.3, 0, 0], [0.3, 0.7, 0, 0], [0, 0, 0.98, 0.2], [0, 0, -0.2, 0.98]])
LEVERS = {"still": np.eye(D), "mixing": KEEPS, "coupled": KEEPS + 0.1 * np.eye(D)[[2, 2, 3, 3]] * [[1], [1], [0], [0]]}


@pytest.mark.parametrize("motion", LEVERS)
@pytest.mark.parametrize("name", GAUSSIAN)
@pytest.mark.parametrize("dtype", [DOUBLE, torch.float32])
def test_a_wide_prior_and_a_long_way_leave_no_rounding_behind(name, motion, dtype):
    """x0 = x1 is kept by the motion; the prior is 10^6 (10^3) times as wide as what is measured, and as far away.

    Against a Kalman filter in the coordinates (x0 = x1, x2, x3), in which nothing is constrained: one number less.
    """
    # In float32 sigma points over more than 10^3 of what is measured round by as much as it is worth.
    f, steps, wide, sd = LEVERS[motion], 60, 1e4 if dtype == DOUBLE else 10.0, 1e-2
    rng = np.random.default_rng(8)
    measured = np.eye(D)[[0, 2]]
    zs = sd * rng.standard_normal((steps, 2))
    start = wide * np.array([1.0, 2.0, 3.0, 4.0])
    row = tensor([[1.0, -1.0, 0, 0]])
    law = tf.Sensors(
        z=tf.LinearGaussian(tensor(measured), scale_tril=sd * torch.eye(2).double()),
        level=tf.PseudoMeasurement(row if name == "Kalman" else lambda x: x[..., :1] - x[..., 1:2], 1, 0.0),
    )
    motion_law = tf.LinearGaussian(tensor(f), scale_tril=torch.zeros(D, D).double())
    prior = tf.Gaussian(tensor(start), wide * torch.eye(D).double())
    filter = GAUSSIAN[name](tf.StateSpaceModel(prior, motion_law, law).to(dtype))
    history = filter({"z": tensor(zs, dtype)}, predict_first=False)
    # Reduced: the first constraint leaves their mean with half the variance.
    t = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    reduce = np.linalg.pinv(t)
    found = kalman_oracle.kalman(
        reduce @ start,
        wide**2 * reduce @ reduce.T,
        reduce @ f @ t,
        np.zeros((3, 3)),
        measured @ t,
        sd**2 * np.eye(2),
        zs,
        predict_first=False,
    )
    known = [0, 1, 2] if motion == "still" else [0, 1, 2, 3]
    late = slice(20, None)  # the oracle's covariance form itself loses half the digits at first
    error = np.abs(history.mean[late].double().numpy() - found.mean[late] @ t.T)[:, known]
    scale = np.sqrt(found.covariance[late, 0, 0].min())
    # In deviations of what is known: one rounding of the prior's size, and what the oracle's covariance form loses.
    eps = torch.finfo(dtype).eps
    limit = eps * wide / scale + np.finfo(float).eps * (wide / sd) ** 2
    assert error.max() < limit * scale
    first = scipy.stats.norm(start[0] - start[1], np.sqrt(2) * wide).logpdf(0)
    total = found.log_likelihood[1:].sum()
    np.testing.assert_allclose(history.diagnostics.log_likelihood[1:].double().sum(), total, rtol=limit)
    expected = first + found.log_likelihood[0]
    # Sums of some ten terms of its own size.
    np.testing.assert_allclose(history.diagnostics.log_likelihood[0], expected, rtol=16 * eps)
    assert (history.mean[..., 0] - history.mean[..., 1]).abs()[late].max() <= 4 * eps


def test_a_soft_one_may_hold_already():
    """As the exact form does: sd 1e-6 of what was known before leaves the same to 1e-9."""
    still = model(level(1e-6), q=np.zeros((D, D)), f=np.eye(D))
    history = tf.KalmanFilter(still)({"z": tensor(ZS)})
    ys = np.full((len(ZS), 3), np.nan)
    ys[:, 0], ys[0, 1:] = ZS[:, 0, 0], GOAL
    noise = np.diag([R[0, 0], 0, 0])
    expected = kalman_oracle.kalman(M0, P0, np.eye(D), np.zeros((D, D)), np.concatenate([A, H]), noise, ys)
    np.testing.assert_allclose(history.mean[:, 0], expected.mean, atol=1e-9)
    np.testing.assert_allclose(history.covariance[:, 0], expected.covariance, atol=1e-9)


@pytest.mark.parametrize("kind", ["matrix", "function"])
def test_a_contradiction_is_reported(kind):
    """A row that is told another value, once it is certain: it fails for good, the others don't notice."""
    filter = tf.ExtendedKalmanFilter(model(level(0.0, kind), q=np.zeros((D, D)), f=np.eye(D)))
    state, _ = filter.step(filter.init((3,)), {"z": tensor(ZS[0])})
    other = tensor(GOAL).repeat(3, 1)
    same, expected = filter.step(state, {"z": tensor(ZS[1]), "level": other})
    other[1, 1] += 1e-6
    with pytest.raises(tf.FilterError, match=r"step 1, rows \[\(1,\)\]"):
        filter.step(state, {"z": tensor(ZS[1]), "level": other})
    after, info = filter.step(state, {"z": tensor(ZS[1]), "level": other}, throw=False)
    assert info.ok.tolist() == [True, False, True] and info.log_likelihood[1] == -torch.inf
    assert torch.equal(after.belief.mean[[0, 2]], same.belief.mean[[0, 2]])
    assert torch.equal(info.log_likelihood[[0, 2]], expected.log_likelihood[[0, 2]])
    _, later = filter.step(after, {"z": tensor(ZS[2])}, throw=False)
    assert later.ok.tolist() == [True, False, True]


@pytest.mark.parametrize("name", GAUSSIAN)
def test_a_constraint_that_is_said_twice(name):
    """Rows that earlier ones determine say nothing more; one that is not their sum is a contradiction."""
    rows, goal = np.concatenate([H, H[:1] + H[1:]]), np.append(GOAL, GOAL.sum())
    h = tensor(rows)

    def filtered(values):
        law = tf.PseudoMeasurement(h if name == "Kalman" else lambda x: x @ h.mT, 3, 0.0, tensor(values))
        return GAUSSIAN[name](model(law))({"z": tensor(ZS)}, throw=False)

    found, expected = filtered(goal), GAUSSIAN[name](model(level(0.0)))({"z": tensor(ZS)})
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-12)
    np.testing.assert_allclose(found.log_likelihood, expected.log_likelihood, rtol=1e-11)
    assert not filtered(goal + np.eye(3)[2] * 1e-6).diagnostics.ok.any()


def test_rows_that_miss_it_and_one_that_is_exact_in_part():
    """Among NaNs row by row, and beside a soft row of the same constraint; shared covariance stays shared."""
    sd = tensor([0.0, 0.3])
    law = level(sd)
    still = model(law, q=np.zeros((D, D)), f=np.eye(D))
    assert law.exact == (0,) and still.observation.exact == (1,)
    ys = np.concatenate([ZS, np.broadcast_to(GOAL, (8, 3, 2))], -1)
    shared = tf.KalmanFilter(still)(tensor(ys), record="beliefs")
    assert shared.beliefs.scale_tril.shape == (8, 1, D, D), "one covariance for all rows"
    ys[0, 1, 1:] = ys[1, 0, 0] = ys[3, 2] = ys[4, 2, 1] = np.nan
    history = tf.KalmanFilter(still)(tensor(ys))
    noise, both = np.diag([R[0, 0], 0, 0.09]), np.concatenate([A, H])
    for row in range(3):
        mine = ys[:, row].copy()
        mine[int(np.flatnonzero(~np.isnan(mine[:, 1]))[0]) + 1 :, 1] = np.nan
        expected = kalman_oracle.kalman(M0, P0, np.eye(D), np.zeros((D, D)), both, noise, mine)
        np.testing.assert_allclose(history.mean[:, row], expected.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(history.log_likelihood[row], expected.log_likelihood.sum(), rtol=1e-10)


def test_only_what_is_zero_and_stays_so_is_exact():
    assert not hasattr(level(0.1), "exact") and not hasattr(model(level(0.1)).observation, "exact")
    assert not hasattr(level(nn.Parameter(torch.zeros(2).double())), "exact")
    two = tf.Sensors(a=level(0.0), b=tf.LinearGaussian(tensor(A), tensor(R)), c=level(tensor([1.0, 0.0])))
    assert two.exact == (0, 1, 4)


def test_a_gate_looks_at_what_is_left():
    """The constraint that holds is no surprise; what the gate refuses is refused as without the constraint."""
    still = model(level(0.0), q=np.zeros((D, D)), f=np.eye(D))
    zs = tensor(ZS)
    zs[4, 1] += 50
    gated = tf.KalmanFilter(still, gate=0.999)({"z": zs})
    zs[4, 1] = torch.nan
    open_ = tf.KalmanFilter(still)({"z": zs})
    accepted = gated.diagnostics.accepted
    assert accepted[..., 1].all() and (~accepted[..., 0]).nonzero().tolist() == [[4, 1]]
    np.testing.assert_allclose(gated.mean, open_.mean, atol=1e-12)


@pytest.mark.parametrize("kind", ["matrix", "function"])
@pytest.mark.parametrize("make", [tf.ExtendedKalmanFilter, tf.UnscentedKalmanFilter])
def test_a_constraint_that_holds_compiles_whole_and_maps(make, kind):
    filter = make(model(level(0.0, kind), q=np.zeros((D, D)), f=np.eye(D)))
    belief, y = filter.init((3,)).belief, filter.model.observation.pack({"z": tensor(ZS[0])})
    compiled = torch.compile(lambda b, y: filter.advance(b, y), fullgraph=True, backend="eager")
    first, _ = filter.advance(belief, y)
    for start in (belief, first):
        expected, info = filter.advance(start, y)
        found, told = compiled(start, y)
        torch.testing.assert_close(found.mean, expected.mean, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(told.log_likelihood, info.log_likelihood, rtol=1e-12, atol=1e-12)
    factors = first.scale_tril.expand(3, D, D)

    def alone(mean, factor, y):
        after, info = filter.advance(tf.Gaussian(mean, factor), y)
        return after.mean, info.log_likelihood

    mean, value = torch.vmap(alone)(first.mean, factors, y)
    expected, info = filter.advance(first, y)
    torch.testing.assert_close(mean, expected.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(value, info.log_likelihood, rtol=1e-12, atol=1e-12)


# Particles ----------------------------------------------------------------------------------------------------------


def test_points_never_meet_an_exact_constraint():
    """They fail at the first step and say so; the same constraint with a width is as any measurement."""
    for filter in (tf.BootstrapFilter(model(level(0.0)), 100), tf.RegularizedParticleFilter(model(level(0.0)), 100)):
        with pytest.raises(tf.FilterError, match="step 0"):
            filter({"z": tensor(ZS)})
    count, rows = 2000, 60
    zs = tensor(ZS[:4, :1]).expand(4, rows, 1)
    found = tf.BootstrapFilter(model(level(0.5)), count)({"z": zs}, seed=2)
    ratio = (found.log_likelihood - oracle(0.5, 0, ZS[:4]).log_likelihood.sum()).exp()
    # Unbiased evidence; 4.5 standard errors, one false alarm in 10^5.
    assert abs(ratio.mean() - 1) < 4.5 * ratio.std() / rows**0.5
    assert ratio.std() < 2, "the estimate is one"


@pytest.mark.parametrize(
    ("make", "bias"),
    [
        (lambda m: tf.LocallyLinearizedParticleFilter(m, 50), 0),
        (lambda m: tf.UnscentedParticleFilter(m, 50), 5e-3),  # of the pooled redraw, of order 1/n
        (lambda m: tf.RaoBlackwellizedParticleFilter(m, 50, drawn=[0]), 0),
    ],
    ids=["bank", "unscented", "Rao-Blackwellized"],
)
def test_every_gaussian_of_a_bank_meets_an_exact_constraint(make, bias):
    """Each mean to rounding, and the mixture's mean that of the Kalman filter, 4.5 standard errors over rows."""
    rows = 80
    zs = tensor(ZS[:, :1]).expand(-1, rows, 1)
    history = make(model(level(0.0)))({"z": zs}, record="beliefs", seed=1)
    residual = history.beliefs.x @ tensor(H).mT - tensor(GOAL)
    assert residual.abs().max() < 1e-11
    assert (tensor(H) @ history.beliefs.scale_tril).abs().max() < 1e-10
    mean, error = history.mean[-1].mean(0), history.mean[-1].std(0) / rows**0.5
    assert ((mean - tensor(oracle(0.0, 0).mean[-1])).abs() < 4.5 * error + bias).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda m: tf.LocallyLinearizedParticleFilter(m, 20, redraw="never"),
        lambda m: tf.LocallyLinearizedParticleFilter(m, 20, tf.moments.unscented(), redraw="always"),
        lambda m: tf.ParticleFilter(m, 20, tf.proposals.Local(tf.moments.cubature(), iterations=2)),
        lambda m: tf.UnscentedParticleFilter(m, 20),
        lambda m: tf.RaoBlackwellizedParticleFilter(m, 20, drawn=[0]),
    ],
    ids=["bank", "redrawn", "iterated", "unscented", "Rao-Blackwellized"],
)
@pytest.mark.parametrize("kind", ["matrix", "function"])
def test_a_bank_counts_a_constraint_once(make, kind):
    """Each step or only at the first: the same particles, weights and evidence; the state stands still."""
    still = model(level(0.0, kind), q=np.zeros((D, D)), f=np.eye(D))
    filter = make(still)
    always = still.observation.complete(tensor(np.concatenate([ZS, np.full((8, 3, 2), np.nan)], -1)))
    first = always.clone()
    first[1:, :, 1:] = torch.nan
    found, expected = (filter(ys, record="beliefs", seed=3) for ys in (always, first))
    # Rounding that a redraw from singular factors and a quadrature's second linearisation (eps^(2/3)) enlarge.
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-8)
    np.testing.assert_allclose(found.log_likelihood, expected.log_likelihood, rtol=1e-8)
    np.testing.assert_allclose(found.beliefs.weights, expected.beliefs.weights, atol=1e-8)
    assert (found.beliefs.x @ tensor(H).mT - tensor(GOAL)).abs().max() < 1e-12


@pytest.mark.parametrize("kind", ["matrix", "function"])
def test_the_component_that_contradicts_it_has_no_weight(kind):
    """Three certain components of which one fails the constraint: the evidence is the others' share."""
    null = scipy.linalg.null_space(H)
    point = np.linalg.lstsq(H, GOAL, rcond=None)[0]
    means = np.stack([point, point + 0.1 * H[0], point + null[:, 0]])
    factor = np.linalg.qr((null @ np.diag([1.0, 0.5])).T, mode="r").T
    factor = tensor(np.concatenate([factor, np.zeros((D, D - factor.shape[1]))], 1))
    chances = tensor([0.3, 0.5, 0.2])
    prior = tf.InitialMixture(tf.Particles(tensor(means), chances.log(), factor.repeat(3, 1, 1)))
    law = tf.Sensors(z=tf.LinearGaussian(tensor(A), tensor(R)), level=level(0.0, kind))
    still = tf.LinearGaussian(torch.eye(D).double(), scale_tril=torch.zeros(D, D).double())
    filter = tf.GaussianSumFilter(tf.StateSpaceModel(prior, still, law), components=3)
    history = filter({"z": tensor(ZS[:3])}, record="beliefs")
    covariance = null @ np.diag([1.0, 0.25]) @ null.T
    for row in range(3):
        totals = []
        for k in (0, 2):
            args = means[k], covariance, np.eye(D), np.zeros((D, D)), A, R, ZS[:3, row]
            totals.append(np.log(chances[k].item()) + kalman_oracle.kalman(*args).log_likelihood.sum())
        np.testing.assert_allclose(history.log_likelihood[row], np.logaddexp(*totals), rtol=1e-10)
        share = np.exp(totals - np.logaddexp(*totals))
        weights = history.beliefs.weights[-1, row].sort().values
        np.testing.assert_allclose(weights, np.sort([0, *share]), atol=1e-12)


# Constraints that are not linear ------------------------------------------------------------------------------------


def speed(sd, **options):
    return tf.PseudoMeasurement(lambda x: x[..., :2].norm(dim=-1, keepdim=True), 1, sd, 1.0, **options)


def slope_of_speed(x):
    v = x[..., :2]
    return torch.cat([v / v.norm(dim=-1, keepdim=True), torch.zeros_like(v[..., :1])], -1).unsqueeze(-2)


@pytest.mark.parametrize("jacobian", [None, slope_of_speed], ids=["differentiated", "given"])
def test_unit_speed_by_iteration_is_the_constrained_optimum(jacobian):
    """The iterated filter converges to the least (x-m)^T P^-1 (x-m) under |v| = 1, by SciPy's SLSQP.

    sd 1e-5 makes the constraint hold to 1e-5^2 / variance; SLSQP stops at 1e-9 or so.
    """
    mean, root = np.array([1.3, 0.5, 2.0]), np.array([[0.4, 0, 0], [0.1, 0.3, 0], [0.2, -0.1, 0.5]])
    prior = tf.Gaussian(tensor(mean), tensor(root))
    sensors = tf.Sensors(speed=speed(1e-5, jacobian=jacobian))
    flat = tf.StateSpaceModel(prior, tf.LinearGaussian(torch.eye(3).double(), torch.eye(3).double()), sensors)
    found = tf.ExtendedKalmanFilter(flat, iterations=12)(sensors.pack({}, (1,), prior.mean), predict_first=False)
    inverse = np.linalg.inv(root @ root.T)
    best = scipy.optimize.minimize(
        lambda x: (x - mean) @ inverse @ (x - mean),
        mean,
        jac=lambda x: 2 * inverse @ (x - mean),
        constraints={"type": "eq", "fun": lambda x: np.hypot(x[0], x[1]) - 1},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 200},
    )
    np.testing.assert_allclose(found.mean[0], best.x, atol=1e-6)
    assert abs(found.mean[0, :2].norm() - 1) < 1e-8
    once = tf.ExtendedKalmanFilter(flat)(sensors.pack({}, (1,), prior.mean), predict_first=False)
    assert abs(once.mean[0, :2].norm() - 1) > 1e-4, "one linearisation is not enough here"


def wheel(x):
    """Speed across the heading: a wheel does not slip sideways. State: east, north, their rates, heading from east."""
    return (x[..., 3] * x[..., 4].cos() - x[..., 2] * x[..., 4].sin()).unsqueeze(-1)


def test_wheels_that_do_not_slip_make_the_heading_known():
    """Position fixes alone say nothing of the heading; with the constraint the filter is NumPy's extended filter."""
    dt, steps = 0.5, 30
    motion = np.eye(5)
    motion[0, 2] = motion[1, 3] = dt
    noise = np.diag([0.01, 0.01, 0.1, 0.1, 0.05]) ** 2
    mean, cov = np.array([0.0, 0, 1, 0.2, 0.6]), np.diag([1.0, 1, 0.5, 0.5, 0.4]) ** 2
    rng = np.random.default_rng(4)
    time = dt * np.arange(1, steps + 1)
    fixes = np.stack([time, 0.2 * time], -1) + 0.3 * rng.standard_normal((steps, 2))
    place = tf.LinearGaussian(torch.eye(2, 5).double(), 0.09 * torch.eye(2).double())
    prior = tf.Gaussian(tensor(mean), torch.linalg.cholesky(tensor(cov)))
    law = tf.LinearGaussian(tensor(motion), tensor(noise))
    free = tf.StateSpaceModel(prior, law, tf.Sensors(fix=place))
    bound = tf.StateSpaceModel(prior, law, tf.Sensors(fix=place, wheel=tf.PseudoMeasurement(wheel, 1, 0.05)))
    without = tf.ExtendedKalmanFilter(free)({"fix": tensor(fixes)})
    found = tf.ExtendedKalmanFilter(bound)({"fix": tensor(fixes)})
    for k in range(steps):
        mean, cov = kalman_oracle.predict(mean, cov, motion, noise)
        sine, cosine = np.sin(mean[4]), np.cos(mean[4])
        row = np.array([0, 0, -sine, cosine, -mean[2] * cosine - mean[3] * sine])
        slope = np.concatenate([np.eye(2, 5), row[None]])
        shift = np.array([0, 0, mean[3] * cosine - mean[2] * sine - row @ mean])
        y = np.append(fixes[k], 0.0)
        mean, cov, value = kalman_oracle.update(mean, cov, y, slope, np.diag([0.09, 0.09, 0.0025]), shift)
        np.testing.assert_allclose(found.mean[k], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.diagnostics.log_likelihood[k], value, rtol=1e-9)
    np.testing.assert_allclose(found.covariance[-1], cov, atol=1e-10)
    expected = 0.4**2 + steps * 0.05**2
    np.testing.assert_allclose(without.covariance[-1, 4, 4], expected, rtol=1e-12)
    assert found.covariance[-1, 4, 4] < 0.05 * expected
    assert abs(found.mean[-1, 4] - np.arctan(0.2)) < 4 * found.covariance[-1, 4, 4] ** 0.5


# Their values write themselves --------------------------------------------------------------------------------------


def test_values_are_written_unless_told_otherwise():
    sensors = tf.Sensors(z=tf.LinearGaussian(tensor(A), tensor(R)), level=level(0.1))
    z = tensor(ZS[0])
    y = sensors.pack({"z": z})
    assert torch.equal(y, torch.cat([z, tensor(GOAL).expand(3, 2)], -1))
    assert sensors.pack({}, (3,), z).isnan().tolist() == [[True, False, False]] * 3
    assert sensors.pack({"z": z, "level": None}).isnan().tolist() == [[False, True, True]] * 3
    other = torch.tensor([[1.0, torch.nan], [2.0, 3.0], [torch.nan, torch.nan]], dtype=DOUBLE)
    given = sensors.pack({"z": z, "level": other})
    assert torch.equal(given[:, 1:].nan_to_num(-9), other.nan_to_num(-9))
    whole = torch.cat([tensor([[1.0], [torch.nan], [2.0]]), other], -1)
    done = sensors.complete(whole)
    assert torch.equal(done[:, 0].nan_to_num(-9), whole[:, 0].nan_to_num(-9)) and not done[:, 1:].isnan().any()
    assert done[0].tolist() == [1.0, 1.0, GOAL[1]] and done[2, 1:].tolist() == GOAL.tolist()
    single = sensors.pack({"z": z.float()})
    assert single.dtype == torch.float32 and torch.equal(single[0, 1:], tensor(GOAL, torch.float32))


def test_a_stream_by_names_knows_the_constraint():
    """Steps by name, with a sensor silent in between, are the completed series to the bit; None switches off."""
    filter = tf.KalmanFilter(model(level(0.1)))
    law = filter.model.observation
    zs = tensor(ZS)
    zs[3] = torch.nan
    history = filter(law.complete(torch.cat([zs, torch.full((8, 3, 2), torch.nan, dtype=DOUBLE)], -1)))
    state = filter.init((3,))
    for k in range(8):
        state, _ = filter.step(state, {} if k == 3 else {"z": zs[k]})
        assert torch.equal(state.belief.mean, history.mean[k])
    off, _ = filter.step(state, {"level": None})
    free = filter.predict(state.belief)
    assert torch.equal(off.belief.mean, free.mean)


# The law itself -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["matrix", "function", "jacobian"])
def test_conformance(kind):
    x = tensor(RNG.standard_normal((4, D)))
    check_law(level(tensor([0.1, 0.3]), kind), x)
    offers = {"matrix": "linear_form", "jacobian": "first_order"}
    assert [n for n in offers.values() if hasattr(level(0.1, kind), n)] == [o for k, o in offers.items() if k == kind]


def test_controls_and_time_steps_reach_the_function_and_its_jacobian():
    law = tf.PseudoMeasurement(
        lambda x, u, dt: x[..., :1] * dt - u, 1, 0.1, jacobian=lambda x, dt: dt * torch.eye(1, 2).double()
    )
    x, u = tensor([[1.0, 2], [3, 4]]), tensor([[0.5], [0.25]])
    at, jacobian = tf.Sensors(c=law).first_order(x, u, 0.5)
    assert law.takes_controls and at.mean.tolist() == [[0.0], [1.25]] and jacobian.tolist() == [[0.5, 0.0]]
    assert not level(0.1).takes_controls and not level(0.1, "function").takes_controls


def test_its_width_trains_as_kalman_oracle_says():
    """Gradient of the log-likelihood by sd, against complex steps through NumPy's filter."""
    sd = nn.Parameter(tensor([0.4, 0.4]))
    filter = tf.KalmanFilter(model(level(sd)))
    assert dict(filter.named_parameters()).keys() == {"model.observation.laws.level.sd"}
    filter({"z": tensor(ZS)}).log_likelihood.sum().backward()
    ys = np.concatenate([ZS, np.broadcast_to(GOAL, (8, 3, 2))], -1)

    def total(theta):
        noise = np.zeros((3, 3), dtype=theta.dtype)
        noise[[0, 1, 2], [0, 1, 2]] = [R[0, 0], theta[0] ** 2, theta[1] ** 2]
        both = np.concatenate([A, H])
        return sum(kalman_oracle.kalman(M0, P0, F, Q, both, noise, ys[:, r]).log_likelihood.sum() for r in range(3))

    np.testing.assert_allclose(sd.grad, kalman_oracle.score(total, np.array([0.4, 0.4])), rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        ((torch.sin, 0, 0.1), {}, ValueError, "size must be at least 1, got 0"),
        ((torch.sin, 2, -0.1), {}, ValueError, "sd must not be negative, got -0.1"),
        ((torch.sin, 2, torch.ones(3)), {}, ValueError, r"sd must be a number or \(2,\), got \(3,\)"),
        ((torch.sin, 2, float("nan")), {}, ValueError, "sd must be finite"),
        ((torch.sin, 2, 0.1, torch.ones(1)), {}, ValueError, r"value must be a number or \(2,\), got \(1,\)"),
        ((torch.sin, 2, 0.1, float("inf")), {}, ValueError, "value must be finite"),
        ((3.0, 2, 0.1), {}, TypeError, "function must be callable or a matrix as a tensor, got float"),
        ((torch.ones(3, 2), 2, 0.1), {}, ValueError, r"a matrix must be \(2, d\), got \(3, 2\)"),
        ((torch.ones(2, 2) / 0, 2, 0.1), {}, ValueError, "matrix must be finite"),
        ((torch.ones(2, 2), 2, 0.1), {"jacobian": torch.cos}, ValueError, "a matrix is its own jacobian"),
    ],
)
def test_bad_constraints(arguments, options, error, message):
    with pytest.raises(error, match=message):
        tf.PseudoMeasurement(*arguments, **options)


def test_a_function_of_another_size():
    with pytest.raises(ValueError, match=r"function must turn x \(3, 4\) into \(\*lead, 2\), got \(3, 4\)"):
        tf.PseudoMeasurement(torch.sin, 2, 0.1)(torch.zeros(3, 4))
