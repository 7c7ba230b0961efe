"""Metropolis-Hastings on the last L states together: exact laws stay, windows travel with the belief."""

import numpy as np
import pytest
import torch
from oracles import particle_oracle, trajectory_oracle
from particle_problem import PLANE, gaussian, replicate, series, state_space, tensor
from scipy import stats

import torchfilt as tf
from torchfilt.kernels import Regularize
from torchfilt.moves import MetropolisHastings
from torchfilt.particles import PastStep
from torchfilt.resampling import ess_below
from torchfilt.spaces import Euclidean, Product, UnitQuaternion
from torchfilt.types import StepInput

F64 = torch.float64
# One Kolmogorov-Smirnov test raises a false alarm with this probability.
FALSE_ALARM = 1e-5
ROWS, N = 10, 400

# Turns and is pushed along one direction only; each measurement sees one coordinate.
PUSHED = PLANE._replace(Q=np.outer([0.5, 1.0], [0.5, 1.0]) * 0.3)


def factor_of(Q):
    """Lower factor, singular or not."""
    values, vectors = np.linalg.eigh(Q)
    r = np.linalg.qr((vectors * np.sqrt(values.clip(0))).T, mode="r")
    return (r * np.sign(np.diag(r) + (np.diag(r) == 0))[:, None]).T


class Case:
    """Trajectories of L states drawn exactly from their law given L measurements, and how a move is applied to them.

    On the transition target every trajectory goes out from a point of its own; on the predictive one the first state
    has a prior N(m, P) that all share.
    """

    def __init__(self, target, length, linear=PLANE, seed=0, missing=False):
        rng = np.random.default_rng(seed)
        self.target, self.length, self.linear = target, length, linear
        A, Q, H, R, m0, P0 = linear
        self.G = factor_of(Q)
        _, ys = particle_oracle.simulate(linear, length, seed)
        if missing:
            ys[length // 2] = np.nan
        self.ys = ys
        shape = (ROWS, N, 2)
        self.origin = m0 + rng.normal(size=shape) @ np.linalg.cholesky(P0).T
        start, P = (self.origin @ A.T, Q) if target == "transition" else (np.array([0.4, -0.1]), 1.3 * P0)
        self.start, self.P = start, P
        self.law = trajectory_oracle.window(start, P, A, self.G, H, R, ys)
        root = np.linalg.cholesky(self.law.covariance)
        drawn = self.law.mean + rng.normal(size=(ROWS, N, len(root))) @ root.T
        self.states = [drawn @ part.T for part in self.law.states]
        self.noises = [None, *np.split(drawn[..., 2:], length - 1, -1)] if length > 1 else [None]

    def levels(self, j):
        """What step j adds to the log-target."""
        H, R = self.linear.H, self.linear.R
        level = stats.norm.logpdf(self.ys[j, 0], (self.states[j] @ H.T)[..., 0], np.sqrt(R[0, 0]))
        level = np.zeros((ROWS, N)) if np.isnan(self.ys[j, 0]) else level
        if self.target == "transition":
            before = self.origin if j == 0 else self.states[j - 1]
            apart = self.states[j] - before @ self.linear.A.T
            level = level + stats.multivariate_normal(cov=self.linear.Q).logpdf(apart)
        return tensor(level)

    def part(self, j):
        origin = self.origin if j == 0 else self.states[j - 1]
        noise = None if self.noises[j] is None or self.target == "transition" else tensor(self.noises[j])
        # Of the later steps' fits nothing is asked here, but that there are some.
        mean = factor = None
        if self.target == "predictive":
            mean = tensor(self.start).expand(ROWS, 1, 2)
            factor = tensor(np.linalg.cholesky(self.P)).expand(ROWS, 1, 2, 2)
        return PastStep(
            tensor(origin),
            noise,
            self.levels(j),
            mean,
            factor,
            torch.ones(ROWS, 1, dtype=torch.bool),
            tensor(self.ys[j]).expand(ROWS, 1, 1),
            None,
            None,
            "rows",
        )

    def model(self, linear=None):
        A, Q, H, R, m0, P0 = (tensor(part) for part in linear or self.linear)
        motion = tf.LinearGaussian(A, scale_tril=tensor(factor_of(Q.numpy())))
        return tf.StateSpaceModel(gaussian(m0, P0), motion, tf.LinearGaussian(H, R))

    def move(self, steps, scale=None, matched=False, linear=None, change=None, dtype=F64):
        """The states after the move, list of (ROWS, N, 2)."""
        move = MetropolisHastings(steps, scale, self.target, self.length, matched)
        past = tuple(self.part(j) for j in range(self.length - 1))
        past = tuple(change(part) for part in past) if change else past
        last = self.part(self.length - 1)
        equal = torch.full((ROWS, N), -np.log(N), dtype=F64)
        before = tf.Particles(last.origin, equal, past=past)
        after = tf.Particles(tensor(self.states[-1]), equal)
        generator = torch.Generator().manual_seed(7)
        count = move.drawn_states(len(past))
        noise = tf.StepNoise(
            last.noise,
            torch.zeros(1),
            move_normal=torch.randn(steps, count, ROWS, N, 2, generator=generator, dtype=F64),
            move_uniform=torch.rand(steps, ROWS, N, generator=generator, dtype=F64),
        )
        moved = move(self.model(linear), before, after, StepInput(last.y, None, None, noise, "rows"))
        kept = moved.particles.past
        assert len(kept) == self.length - 1 and moved.acceptance_rate.shape == (ROWS,)
        # The window has moved on by a step: what it kept starts from its own first state.
        return [*(part.origin.numpy() for part in kept), moved.particles.x.numpy()]

    def worst(self, states):
        """Smallest p-value of the states' components against their exact law."""
        values = []
        for x, part in zip(states, self.law.states, strict=True):
            z = (x - self.law.mean @ part.T) / np.sqrt(np.diag(part @ self.law.covariance @ part.T))
            values += [stats.kstest(component.ravel(), "norm").pvalue for component in np.moveaxis(z, -1, 0)]
        return min(values)


TARGETS = [("transition", PLANE), ("predictive", PLANE), ("predictive", PUSHED)]
IDS = ["transition", "predictive", "predictive-singular"]


@pytest.mark.parametrize("length", [3, 5])
@pytest.mark.parametrize(("target", "linear"), TARGETS, ids=IDS)
def test_exact_trajectories_stay_exact(target, linear, length):
    """Drawn from the law of the last L states, moved 25 times: every component of every state keeps its law.

    Ten tests of 4000 draws at most, a false alarm in 10,000 runs.
    """
    case = Case(target, length, linear)
    assert case.worst(case.states) > FALSE_ALARM
    moved = case.move(25, 0.4 if target == "transition" else None)
    assert all((a != b).any(-1).mean() > 0.8 for a, b in zip(moved, case.states, strict=True))
    assert case.worst(moved) > FALSE_ALARM


@pytest.mark.parametrize(("target", "linear"), TARGETS, ids=IDS)
def test_a_gap_in_the_window_is_integrated_out(target, linear):
    case = Case(target, 3, linear, missing=True)
    moved = case.move(25, 0.4 if target == "transition" else 0.8)
    assert case.worst(moved) > FALSE_ALARM


def test_matched_normals_keep_the_law_too():
    case = Case("predictive", 3, PUSHED)
    moved = case.move(25, 0.6, matched=True)
    assert case.worst(moved) > FALSE_ALARM
    assert not np.array_equal(moved[-1], case.move(25, 0.6)[-1])


def without_likelihood(part):
    return part._replace(used=torch.zeros_like(part.used), level=torch.zeros_like(part.level))


WRONG = {
    "transition, motion": ("transition", dict(linear=PLANE._replace(Q=2 * PLANE.Q))),
    "transition, first likelihood left out": ("transition", dict(change=without_likelihood)),
    "predictive, likelihoods": ("predictive", dict(linear=PUSHED._replace(R=4 * PUSHED.R))),
    "predictive, first likelihoods left out": ("predictive", dict(change=without_likelihood)),
    "predictive, prior": ("predictive", dict(change=lambda part: part._replace(factor=1.3 * part.factor))),
    "predictive, noise": (
        "predictive",
        dict(change=lambda part: part._replace(noise=None if part.noise is None else 2 * part.noise)),
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_the_invariance_test_would_see_what_is_wrong(name):
    """The same test with one part of the target changed: a p-value of chance would be above 1e-8."""
    target, options = WRONG[name]
    case = Case(target, 3, PLANE if target == "transition" else PUSHED)
    assert case.worst(case.move(40, 0.4 if target == "transition" else 0.8, **options)) < 1e-8


def test_trajectories_from_elsewhere_find_their_law():
    """All states start two units off; after 400 walks on the transition target nothing of it is left."""
    case = Case("transition", 2)
    away = [x + 2.0 for x in case.states]
    case.states = away
    assert case.worst(away) < 1e-100
    assert case.worst(case.move(400, 0.6)) > FALSE_ALARM


@pytest.mark.parametrize("window", [2, 4])
@pytest.mark.parametrize(("target", "linear"), TARGETS, ids=IDS)
def test_filtering_and_smoothing_marginals_of_a_whole_filter(target, linear, window):
    """One particle a row, drawn by the weights, of 600 rows with 400 particles: x_k and x_{k-1} against their laws."""
    ys, _ = series(5, model=linear)
    move = MetropolisHastings(3, None, target, window)
    history = tf.BootstrapFilter(Case(target, 2, linear).model(), 400, move=move)(replicate(ys, 600), seed=3)
    final = history.final.belief
    assert len(final.past) == window - 1
    uniforms = torch.rand(600, 1, generator=torch.Generator().manual_seed(4), dtype=F64)
    picked = (final.weights.cumsum(-1) < uniforms).sum(-1).clamp_max(399)
    A, Q, H, R, m0, P0 = linear
    start, P = A @ m0, A @ P0 @ A.T + Q
    law = trajectory_oracle.window(start, P, A, factor_of(Q), H, R, ys.numpy())
    for x, part in ((final.x, law.states[-1]), (final.past[-1].origin, law.states[-2])):
        draws = x[torch.arange(600), picked].numpy()
        z = (draws - law.mean @ part.T) / np.sqrt(np.diag(part @ law.covariance @ part.T))
        for component in z.T:
            assert stats.kstest(component, "norm").pvalue > FALSE_ALARM


def test_matched_normals_and_longer_windows_keep_the_covariance_of_constants():
    """Nothing forgets what a move does to the cloud: the mean logarithm of 20 rows' deviations over the exact ones.

    Standard errors 0.03 at most. The figures of docs/filters.md.
    """
    eye = torch.eye(4, dtype=F64)
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(4, dtype=F64), eye),
        tf.LinearGaussian(eye, scale_tril=0 * eye),
        tf.LinearGaussian(eye, 25 * eye),
    )
    ys = 5 * torch.randn(100, 1, 4, generator=torch.Generator().manual_seed(0), dtype=F64).expand(-1, 20, -1)
    exact = torch.logdet(tf.KalmanFilter(model)(ys).covariance[-1])
    found = {}
    for window, matched in ((1, False), (1, True), (4, False), (4, True)):
        move = MetropolisHastings(1, None, "predictive", window, matched)
        covariance = tf.BootstrapFilter(model, 200, move=move)(ys, seed=1).covariance[-1]
        found[window, matched] = (torch.logdet(covariance) - exact).mean().item() / 8
    assert -0.45 < found[1, False] < -0.25
    assert -0.25 < found[4, False] < -0.1
    assert -0.2 < found[1, True] < -0.05
    assert -0.1 < found[4, True] < -0.02


# Quaternions


ATTITUDE = Product(UnitQuaternion("left"), Euclidean(1))


def turned(x):
    step = torch.tensor([0.2, -0.1, 0.3], dtype=x.dtype)
    turn = UnitQuaternion("left").retract(x[..., :4], step.expand(*x.shape[:-1], 3))
    return torch.cat([turn, 0.8 * x[..., 4:] + 0.3 * x[..., :1]], -1)


def sight(x):
    q, rest = x[..., :4], x[..., 4:]
    return torch.cat([2 * (q[..., :1] * q[..., 1:2] + q[..., 2:3] * q[..., 3:4]), rest], -1)


@pytest.mark.parametrize("target", ["transition", "predictive"])
@pytest.mark.parametrize("length", [1, 3])
def test_attitudes_keep_their_law(target, length):
    """Unit quaternions beside a line: draws of the posterior by rejection, moved, against others that are not.

    Two samples of 3000 in each tangent component of the first and the last state. All trajectories start from one
    point, so that the first state's law is the fit of its own prediction.
    """
    generator = torch.Generator().manual_seed(1)
    root = 0.2 * torch.tensor([[1.0, 0, 0, 0], [0.3, 0.8, 0, 0], [-0.4, 0.2, 0.9, 0], [0.5, 0.1, 0, 1]], dtype=F64)
    model = tf.StateSpaceModel(
        tf.Gaussian(tensor([0, 0, 0, 1, 0]), torch.eye(4, dtype=F64), ATTITUDE),
        tf.AdditiveGaussian(turned, scale_tril=root, space=ATTITUDE),
        tf.AdditiveGaussian(sight, scale_tril=0.3 * torch.eye(2, dtype=F64)),
    )
    path = origin = ATTITUDE.project(tensor([0.1, -0.2, 0.4, 0.9, 0.3])).unsqueeze(0)
    ys, states, noises, total = [], [], [], 0.0
    x = origin.expand(60_000, 5)
    for _ in range(length):
        noises.append(torch.randn(60_000, 4, generator=generator, dtype=F64))
        x = model.transition(x).sample(noises[-1])
        states.append(x)
        path = turned(path)
        ys.append(sight(path) + 0.1)
        total = total + model.observation(x).log_prob(ys[-1])
    best = -length * (2 * np.log(0.3) + np.log(2 * np.pi))
    kept = torch.rand(60_000, generator=generator, dtype=F64).log() < total - best
    assert kept.sum() >= 6000
    fresh, states, noises = (
        [x[kept][part] for x in whole]
        for whole, part in ((states, slice(3000)), (states, slice(3000, 6000)), (noises, slice(3000, 6000)))
    )
    move = MetropolisHastings(20, 0.5, target, length)
    equal, past = torch.full((3000,), -np.log(3000), dtype=F64), []
    origins = [origin.expand(3000, 5), *states]
    for j in range(length - 1):
        level, fit = model.observation(states[j]).log_prob(ys[j]), (None, None, None)
        if target == "transition":
            level = level + model.transition(origins[j]).log_prob(states[j])
        else:
            fit = noises[j], model.transition(origin).mean, root.unsqueeze(0)
        used = torch.ones(1, dtype=torch.bool)
        past.append(PastStep(origins[j], fit[0], level, *fit[1:], used, ys[j], None, None, "none"))
    random = tf.StepNoise(
        noises[-1],
        torch.zeros(1),
        move_normal=torch.randn(20, move.drawn_states(length - 1), 3000, 4, generator=generator, dtype=F64),
        move_uniform=torch.rand(20, 3000, generator=generator, dtype=F64),
    )
    before, after = (tf.Particles(origins[k], equal, None, ATTITUDE, past=tuple(past)) for k in (-2, -1))
    result = move(model, before, after, StepInput(ys[-1], None, None, random, "none"))
    assert result.acceptance_rate > 0.2
    moved = [*(part.origin for part in result.particles.past), result.particles.x]
    for j in (0, length - 1):
        one, other = (ATTITUDE.local(fresh[j][0], x[j]) for x in (fresh, moved))
        for a, b in zip(one.mT, other.mT, strict=True):
            assert stats.ks_2samp(a, b).pvalue > FALSE_ALARM


# The window as part of the belief


MOVES = {
    "transition": MetropolisHastings(2, 0.3, window=3),
    "predictive": MetropolisHastings(1, None, "predictive", 3),
    "matched": MetropolisHastings(2, 0.5, "predictive", 4, matched=True),
}


def swinging(dtype=F64):
    """Control and time step in both laws, two measured components."""

    def swing(x, u, dt):
        return x + dt * torch.stack([x[..., 1], -x[..., 0].sin() + u[..., 0]], -1)

    def seen(x, u, dt):
        return x + 0.1 * u[..., :1] * dt

    Q, R = tensor(0.05 * PLANE.Q, dtype), tensor(0.3 * np.eye(2), dtype)
    return tf.StateSpaceModel(
        gaussian(tensor([0.3, 0.0], dtype), tensor(0.5 * np.eye(2), dtype)),
        tf.AdditiveGaussian(swing, Q),
        tf.AdditiveGaussian(seen, R),
    )


def problem(dtype=F64):
    """Series (7, 2, 2) with gaps in rows and components, controls a row, time steps a row."""
    rng = np.random.default_rng(5)
    ys, us = rng.normal(0, 0.5, (7, 2, 2)), rng.normal(0, 0.3, (7, 2, 1))
    ys[2, 0] = ys[3, 1, 0] = np.nan
    dts = rng.uniform(0.05, 0.2, (7, 2))
    return tensor(ys, dtype), tensor(us, dtype), tensor(dts, dtype)


def same(a, b):
    """Bit for bit through tuples."""
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(one, other) for one, other in zip(a, b, strict=True))
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(torch.nan_to_num(a), torch.nan_to_num(b))
    return a == b


@pytest.mark.parametrize("shared", [False, True], ids=["rows", "shared"])
@pytest.mark.parametrize("resampler", [ess_below(0.7), tf.resampling.systematic], ids=["adaptive", "always"])
@pytest.mark.parametrize("name", MOVES)
def test_streamed_resumed_and_loaded_the_bits_are_the_same(name, resampler, shared, tmp_path):
    ys, us, dts = problem()
    if shared:
        us, dts = us[:, 0], 0.1
    filter = tf.BootstrapFilter(swinging(), 60, resampler, MOVES[name])
    whole = filter(ys, us, dts, seed=3)
    assert (whole.diagnostics.acceptance_rate > 0.05).all()
    state = filter.init((2,), 3)
    lengths = []
    for k in range(7):
        state, _ = filter.step(state, ys[k], us[k], dts if shared else dts[k])
        assert torch.equal(state.belief.mean, whole.mean[k])
        lengths.append(len(state.belief.past))
    assert lengths == [min(k + 1, MOVES[name].window - 1) for k in range(7)]
    assert same(state.belief, whole.final.belief)
    for cut in (1, 4):
        parts = dts if shared else dts[:cut]
        first = filter(ys[:cut], us[:cut], parts, seed=3)
        first.save(tmp_path / "run.npz")
        loaded = tf.History.load(tmp_path / "run.npz")
        assert same(loaded.final.belief.past, first.final.belief.past)
        for start in (first.final, loaded.final):
            second = filter(ys[cut:], us[cut:], dts if shared else dts[cut:], state=start)
            assert torch.equal(second.mean, whole.mean[cut:])
            assert same(second.final.belief.past, whole.final.belief.past)


@pytest.mark.parametrize("name", MOVES)
def test_what_the_belief_keeps_of_the_past_belongs_together(name):
    """Each origin leads to the next by its own noise, and each level is the log-density of what it leads to."""
    model, (ys, us, dts) = swinging(), problem()
    belief = tf.BootstrapFilter(model, 60, ess_below(0.7), MOVES[name])(ys, us, dts, seed=2).final.belief
    states = [*(part.origin for part in belief.past[1:]), belief.x]
    for k, (part, x) in enumerate(zip(belief.past, states, strict=True), 7 - len(belief.past)):
        u, dt = us[k].unsqueeze(-2), dts[k, :, None, None]
        assert torch.equal(part.u, u) and torch.equal(part.dt, dt) and same(part.y, ys[k].unsqueeze(-2))
        law, seen = model.transition(part.origin, u, dt), model.observation(x, u, dt)
        level = seen.log_prob(part.y, ~part.y.isnan())
        if name == "transition":
            assert part.noise is None and part.mean is None and part.factor is None
            level = level + law.log_prob(x)
        else:
            np.testing.assert_allclose(law.sample(part.noise), x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(part.level, level, rtol=0, atol=1e-11)


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own"])
def test_the_fit_is_of_the_weighted_predicted_cloud(own):
    """Mean and covariance of the mixture of all particles' laws, with weights that differ and noise of each its own."""

    class Motion(torch.nn.Module):
        def forward(self, x):
            size = 0.2 + x[..., :1].square() if own else torch.ones(1, dtype=F64)
            return tf.Gaussian(x.sin(), size.unsqueeze(-1) * tensor([[0.5, 0.0], [0.2, 0.3]]))

    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, Motion(), linear.observation)
    move = MetropolisHastings(1, 0.5, "predictive", 2)
    filter = tf.BootstrapFilter(model, 300, tf.resampling.never(), move)
    ys = replicate(tensor([[0.5], [0.1]]), 3)
    before, _ = filter.step(filter.init((3,), 1), ys[0])
    part = filter.step(before, ys[1])[0].belief.past[-1]
    law, weights = Motion()(before.belief.x), before.belief.weights.numpy()
    assert weights.max() > 100 * weights.min()
    mean = np.einsum("bn,bnd->bd", weights, law.mean)
    apart = law.mean.numpy() - mean[:, None]
    covariance = np.einsum("bn,bni,bnj->bij", weights, apart, apart)
    covariance += np.einsum("bn,bnij->bij", weights, law.covariance)
    np.testing.assert_allclose(part.mean[:, 0], mean, rtol=0, atol=1e-13)
    np.testing.assert_allclose((part.factor @ part.factor.mT)[:, 0], covariance, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", MOVES)
def test_rows_do_not_know_of_each_other(name):
    """Other data in row 0; then row 1 alone with its share of the random numbers is the suite's matter."""
    ys, us, dts = problem()
    filter = tf.BootstrapFilter(swinging(), 60, ess_below(0.7), MOVES[name])
    other = ys.clone()
    other[:, 0] = other[:, 0].flip(0)
    one, two = filter(ys, us, dts, seed=1), filter(other, us, dts, seed=1)
    np.testing.assert_allclose(one.mean[:, 1], two.mean[:, 1], rtol=0, atol=1e-10)
    assert not torch.equal(one.mean[:, 0], two.mean[:, 0])


@pytest.mark.parametrize("name", MOVES)
def test_single_precision(name):
    ys, us, dts = problem(torch.float32)
    history = tf.BootstrapFilter(swinging(torch.float32), 200, move=MOVES[name])(ys, us, dts, seed=1)
    final = history.final.belief
    assert history.mean.dtype == final.x.dtype == torch.float32 and history.diagnostics.ok.all()
    floats = [part for step in final.past for part in step if isinstance(part, torch.Tensor) and part.dtype != bool]
    assert all(part.dtype in (torch.float32, torch.bool) for part in floats)
    double = tf.BootstrapFilter(swinging(), 200, move=MOVES[name])(*problem(), seed=1)
    assert (history.mean - double.mean).abs().max() < 0.3  # other ancestors here and there, the same law


@pytest.mark.parametrize("name", MOVES)
def test_gradients_reach_every_law_and_stay_finite(name):
    ys, _ = series(5)
    theta = tensor([1.0, 1.0]).requires_grad_()
    A, Q, H, R, m0, P0 = (tensor(part) for part in PLANE)
    model = tf.StateSpaceModel(
        tf.Gaussian(m0, torch.linalg.cholesky(P0)),
        tf.LinearGaussian(A * theta[0], Q),
        tf.LinearGaussian(H * theta[1], R),
    )
    log = tf.BootstrapFilter(model, 60, move=MOVES[name])(ys, seed=1).log_likelihood
    (gradient,) = torch.autograd.grad(log, theta)
    assert torch.isfinite(gradient).all() and (gradient != 0).all()


def test_nothing_measured_accepts_every_predictive_move():
    """No likelihood, no ratio; the cloud stays the exact prediction, 5 standard errors of the mean."""
    ys = torch.full((6, 1), torch.nan, dtype=F64)
    move = MetropolisHastings(1, 0.7, "predictive", 3)
    history = tf.BootstrapFilter(state_space(PLANE), 2000, move=move)(ys, seed=2)
    assert (history.diagnostics.acceptance_rate == 1).all()
    exact = tf.KalmanFilter(state_space(PLANE))(ys)
    # Each of the six moves draws anew, so deviations of n^-1/2 add up.
    deviation = exact.covariance.diagonal(dim1=-2, dim2=-1).sqrt() * (7 / 2000) ** 0.5
    assert ((history.mean - exact.mean).abs() < 5 * deviation).all()


class Bounded(torch.nn.Module):
    """A measurement is within 2 of the first coordinate, or impossible."""

    def forward(self, x):
        return torch.distributions.Uniform(x[..., :1] - 2, x[..., :1] + 2, validate_args=False)


@pytest.mark.parametrize("target", ["transition", "predictive"])
def test_a_measurement_that_no_particle_explains_leaves_the_window(target):
    """Row 0 sees something impossible at step 2: all goes on as if it had seen nothing then."""
    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, linear.transition, Bounded())
    ys = torch.zeros(6, 2, 1, dtype=F64)
    ys[2, 0] = 1e6
    filter = tf.BootstrapFilter(model, 300, move=MetropolisHastings(1, 0.3, target, 3))
    history = filter(ys, seed=1, throw=False)
    ok, rate = history.diagnostics.ok, history.diagnostics.acceptance_rate
    assert (~ok).sum() == 1 and not ok[2, 0] and torch.isfinite(history.mean).all()
    assert (rate > 0.3).all()
    unseen = filter(torch.where(ys > 1e5, torch.nan, ys), seed=1)
    np.testing.assert_allclose(history.mean, unseen.mean, rtol=0, atol=1e-12)
    assert torch.equal(rate, unseen.diagnostics.acceptance_rate)


def test_the_window_starts_at_the_first_predicted_state():
    """A measurement at the prior's own time comes before it; in the middle of a run it starts the window anew."""
    ys, _ = series(4)
    filter = tf.BootstrapFilter(state_space(PLANE), 50, move=MOVES["predictive"])
    state = filter.init((), 1)
    state, info = filter.step(state, ys[0], predict_first=False)
    assert state.belief.past == () and info.acceptance_rate is None
    for k, length in ((1, 1), (2, 2), (3, 2)):
        state, info = filter.step(state, ys[k])
        assert len(state.belief.past) == length and info.acceptance_rate > 0
    state, _ = filter.step(state, ys[0], predict_first=False)
    assert state.belief.past == ()


def test_states_of_other_filters():
    """A longer past is cut, a shorter one grows, none at all starts a window; one of another target is refused."""
    ys, _ = series(8)
    model = state_space(PLANE)
    long, short, plain, other = (
        tf.BootstrapFilter(model, 50, move=move)
        for move in (MetropolisHastings(1, None, "predictive", 5), MOVES["predictive"], None, MOVES["transition"])
    )
    states = {name: f(ys[:6], seed=1).final for name, f in (("long", long), ("short", short), ("plain", plain))}
    assert [len(state.belief.past) for state in states.values()] == [4, 2, 0]
    assert len(short.step(states["long"], ys[6])[0].belief.past) == 2
    assert len(long.step(states["short"], ys[6])[0].belief.past) == 3
    assert len(long.step(states["plain"], ys[6])[0].belief.past) == 1
    assert plain.step(states["long"], ys[6])[0].belief.past == ()
    with pytest.raises(ValueError, match=r"past was kept by a move on another target than 'transition'"):
        other.step(states["long"], ys[6])
    restarted = states["long"]._replace(belief=states["long"].belief._replace(past=()))
    assert len(other.step(restarted, ys[6])[0].belief.past) == 1


# Refusals


def test_what_does_not_go_together_is_refused():
    model = state_space(PLANE)
    with pytest.raises(ValueError, match=r"a kernel breaks the link .* window of 3 states"):
        tf.ParticleFilter(model, 50, tf.proposals.Prior(), move=MOVES["predictive"], kernel=Regularize())
    joint = dict(redraw="always", split=0.0, pooled=False, weights="joint")
    with pytest.raises(ValueError, match=r"window of 3 states replays the noise that Prior\(\) drew .* Local\("):
        tf.UnscentedParticleFilter(model, 50, **joint, move=MOVES["predictive"])
    with pytest.raises(ValueError, match="matched move in 2 dimensions needs at least 6 particles, got 5"):
        tf.BootstrapFilter(model, 5, move=MOVES["matched"])


def test_joint_proposals_take_a_window_of_transitions():
    """Densities ask for no noise: the filter keeps its exact marginals."""
    ys, exact = series(4)
    joint = dict(redraw="always", split=0.0, pooled=False, weights="joint")
    filter = tf.UnscentedParticleFilter(state_space(PLANE), 300, **joint, move=MOVES["transition"])
    history = filter(replicate(ys, 200), seed=1)
    error = history.mean[-1].std(0) / 200**0.5
    assert ((history.mean[-1].mean(0) - tensor(exact.mean[-1])).abs() < 5 * error + 2e-3).all()
    assert (history.diagnostics.acceptance_rate > 0.1).all()


def test_noise_of_a_torch_distribution_cannot_be_replayed():
    class Heavy(torch.nn.Module):
        def forward(self, x):
            return torch.distributions.StudentT(5.0, 0.9 * x, 0.3, validate_args=False)

    linear = state_space(PLANE)
    model = tf.StateSpaceModel(linear.initial, Heavy(), linear.observation)
    ys, _ = series(3)
    with pytest.raises(TypeError, match="replays the noise of a Gaussian transition, this one is a StudentT"):
        tf.BootstrapFilter(model, 50, move=MOVES["predictive"])(ys)
    for move in (MOVES["transition"], MetropolisHastings(1, None, "predictive")):
        assert (tf.BootstrapFilter(model, 50, move=move)(ys, seed=1).diagnostics.acceptance_rate > 0.1).all()


# The named filter


def test_resample_move_filter_is_its_parts():
    model, ys = state_space(PLANE), series(8)[0]
    default = tf.ResampleMoveParticleFilter(model)
    assert default.move == MetropolisHastings(1, None, "predictive", 1, matched=True)
    assert default.kernel == Regularize() and default.particles == 1000 and default.evidence == "approximate"
    window = tf.ResampleMoveParticleFilter(model, 60, window=3)
    assert window.move == MetropolisHastings(1, None, "predictive", 3, matched=True) and window.kernel is None
    literal = tf.ResampleMoveParticleFilter(model, 60, 2, 3, 0.4, "transition", resampler=ess_below(0.5))
    by_hand = tf.BootstrapFilter(model, 60, ess_below(0.5), MetropolisHastings(3, 0.4, "transition", 2))
    assert torch.equal(literal(ys, seed=2).mean, by_hand(ys, seed=2).mean) and literal.evidence == "unbiased"
    kernel = Regularize(bandwidth=0.3)
    smoothed = tf.ResampleMoveParticleFilter(model, 60, kernel=kernel, fast_normals=True)
    move = MetropolisHastings(1, None, "predictive", matched=True)
    parts = tf.ParticleFilter(model, 60, tf.proposals.Prior(), move=move, kernel=kernel, fast_normals=True)
    assert torch.equal(smoothed(ys, seed=2).mean, parts(ys, seed=2).mean)
    with pytest.raises(ValueError, match="a kernel breaks the link"):
        tf.ResampleMoveParticleFilter(model, 60, window=3, kernel=kernel)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
def test_compiled_step_equals_eager_once_the_window_is_full(name):
    """One graph; rounding of a few steps, and decisions that a larger error would turn over."""
    torch._dynamo.reset()
    ys, us, dts = problem()
    filter = tf.BootstrapFilter(swinging(), 60, move=MOVES[name])
    compiled = torch.compile(filter.advance, fullgraph=True)
    eager = filter(ys[:4], us[:4], dts[:4], seed=1).final.belief
    fast = eager
    for k in range(4, 7):
        noise = filter.draw(eager, k, 1)
        eager, info = filter.advance(eager, ys[k], us[k], dts[k].unsqueeze(-1), noise, "none")
        fast, fast_info = compiled(fast, ys[k], us[k], dts[k].unsqueeze(-1), noise, "none")
        np.testing.assert_allclose(fast.x, eager.x, rtol=0, atol=1e-10)
        for one, other in zip(fast.past, eager.past, strict=True):
            np.testing.assert_allclose(one.origin, other.origin, rtol=0, atol=1e-10)
        assert torch.equal(fast_info.acceptance_rate, info.acceptance_rate) and fast_info.ok.all()
