"""Gaussian sums against every history enumerated in plain numpy, a grid, and the single recursion."""

import re

import numpy as np
import pytest
import symmetry_problem
import torch
from oracles import mixture_oracle
from scipy.stats import chi2, norm
from torch.distributions import Categorical, Independent, MixtureSameFamily, MultivariateNormal, Normal

import torchfilt as tf
from torchfilt.mixture import reduce

DOUBLE = torch.float64
F, Q = np.array([[1.0, 0.3], [-0.2, 0.9]]), np.array([[0.2, 0.05], [0.05, 0.1]])
H, R = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.3, 0.1], [0.1, 0.2]])
PUSH, BIAS = np.array([0.5, -1.0]), np.array([1.0, 2.0])
START = [
    (0.6, np.array([-1.0, 0.5]), np.diag([1.0, 0.5])),
    (0.3, np.array([2.0, 0.0]), np.array([[1.0, 0.3], [0.3, 0.4]])),
    (0.1, np.array([0.0, -3.0]), np.diag([0.2, 2.0])),
]
MOTIONS = [(0.8, np.zeros(2), Q), (0.2, PUSH, 9 * Q)]
SENSORS = [(0.9, np.zeros(2), R), (0.07, np.zeros(2), 25 * R), (0.03, BIAS, 4 * R)]


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=DOUBLE)


def close(found, expected, tolerance=1e-11):
    np.testing.assert_allclose(np.asarray(found.detach()), np.asarray(expected), rtol=0, atol=tolerance)


def law(matrix, parts):
    """A linear law, or a mixture of them."""
    laws = [tf.LinearGaussian(tensor(matrix), tensor(p), tensor(m)) for _, m, p in parts]
    return laws[0] if len(laws) == 1 else tf.MixtureLaw(laws, [w for w, _, _ in parts])


def initial(parts=None):
    w, m, p = (tensor(np.stack(part)) for part in zip(*(START if parts is None else parts), strict=True))
    return tf.InitialMixture(tf.Particles(m, w.log(), torch.linalg.cholesky(p)))


def model(start=None, motions=MOTIONS[:1], sensors=SENSORS[:1], gauge=None):
    return tf.StateSpaceModel(initial(start), law(F, motions), law(H, sensors), gauge=gauge)


def series(steps=4, rows=2, seed=0, hidden=0.0):
    rng = np.random.default_rng(seed)
    ys = 2 * rng.standard_normal((steps, rows, 2))
    ys[rng.uniform(size=ys.shape) < hidden] = np.nan
    return ys


# ----------------------------------------------------------------------------------------------------------------------
# Values


@pytest.mark.parametrize("rule", [tf.moments.taylor(), tf.moments.unscented(), tf.moments.cubature()])
@pytest.mark.parametrize(
    ("motions", "sensors", "steps"),
    [(MOTIONS[:1], SENSORS[:1], 8), (MOTIONS, SENSORS[:1], 5), (MOTIONS[:1], SENSORS, 3), (MOTIONS, SENSORS, 2)],
    ids=["prior", "motion", "measurement", "all"],
)
def test_every_history_is_followed(motions, sensors, steps, rule):
    """Gaps in the data, each row its own; as many components as there are histories."""
    ys = series(steps, 2, hidden=0.25)
    filter = tf.GaussianSumFilter(model(None, motions, sensors), rule, components=200)
    ours = filter(tensor(ys))
    assert filter.evidence == ("exact" if len(motions) + len(sensors) == 2 else "approximate")
    for row in range(2):
        parts = [[(w / sum(w for w, *_ in part), m, p) for w, m, p in part] for part in (motions, sensors)]
        mixtures, evidence = mixture_oracle.gaussian_sum(START, F, H, *parts, ys[:, row])
        close(ours.diagnostics.log_likelihood[:, row], evidence)
        for k, mixture in enumerate(mixtures):
            mean, covariance = mixture_oracle.moments(mixture)
            close(ours.mean[k, row], mean)
            close(ours.covariance[k, row], covariance)
    last = ours.final.belief
    assert last.x.shape == (2, len(mixtures[-1]), 2)
    order, expected = last.weights[1].argsort(), sorted(mixtures[-1], key=lambda part: part[0])
    close(last.weights[1][order], [w for w, _, _ in expected])
    # Histories of one weight, as where nothing is measured, may stand in another order.
    close(last.x[1].sort(0)[0], np.sort([m for _, m, _ in expected], axis=0))


def test_merging_after_the_measurement_is_the_greedy_loop():
    """Three steps of prediction and update by enumeration, each followed by the oracle's own reduction."""
    ys = series(3, 1, seed=1)
    ours = tf.GaussianSumFilter(model(None, MOTIONS, SENSORS), components=5)(tensor(ys), record="beliefs")
    mixture = START
    for k, y in enumerate(ys[:, 0]):
        after, evidence = mixture_oracle.gaussian_sum(mixture, F, H, MOTIONS, SENSORS, y[None])
        mixture = mixture_oracle.reduced(after[0], 5)
        mean, covariance = mixture_oracle.moments(after[0])
        close(ours.diagnostics.log_likelihood[k, 0], evidence[0])
        close(ours.mean[k, 0], mean)
        close(ours.covariance[k, 0], covariance)
        close(ours.beliefs.weights[k, 0].sort()[0], sorted(w for w, _, _ in mixture))


def test_a_prior_of_more_components_is_reduced_at_the_start():
    filter = tf.GaussianSumFilter(model(), components=2)
    assert filter.evidence == "approximate"
    found, expected = filter.init((3,)).belief, mixture_oracle.reduced(START, 2)
    close(found.weights, np.tile([w for w, _, _ in expected], (3, 1)))
    close(found.x[1], [m for _, m, _ in expected])
    assert tf.GaussianSumFilter(model(), components=3).evidence == "exact"


def test_components_grow_to_their_number_and_are_recorded():
    """3 at first, 9 of 12 after a step: shorter steps are filled up by components without weight."""
    filter = tf.GaussianSumFilter(model(None, MOTIONS), components=9)
    history = filter(tensor(series(4)), record="beliefs")
    assert history.beliefs.x.shape == (4, 2, 9, 2)
    close(history.beliefs.weights.sum(-1), np.ones((4, 2)))
    close(history.diagnostics.ess, history.beliefs.ess)
    close(history.beliefs.mean, history.mean)
    close(history.beliefs.covariance, history.covariance)


def bent(initial_law):
    return tf.StateSpaceModel(
        initial_law,
        tf.AdditiveGaussian(lambda x: x + 0.1 * x.sin(), tensor(Q)),
        tf.AdditiveGaussian(lambda x: x + 0.2 * x.flip(-1) ** 2, tensor(R)),
    )


@pytest.mark.parametrize(
    "rule", [tf.moments.taylor(), tf.moments.unscented(0.5, 2.0, 0.0), tf.moments.gauss_hermite(3)]
)
def test_one_component_is_the_gaussian_filter(rule):
    plain = tf.Gaussian(tensor([0.5, -0.5]), torch.linalg.cholesky(tensor(R)))
    ys = tensor(series(8, 3, seed=2, hidden=0.2))
    single, bank = tf.GaussianFilter(bent(plain), rule), tf.GaussianSumFilter(bent(plain), rule)
    assert bank.evidence == "linearized"
    one, many = single(ys), bank(ys)
    close(many.mean, one.mean, 1e-12)
    close(many.covariance, one.covariance, 1e-12)
    close(many.diagnostics.log_likelihood, one.diagnostics.log_likelihood, 1e-12)
    assert many.final.belief.x.shape == (3, 1, 2)


def test_the_default_rule_is_the_unscented_one():
    ys = tensor(series(4))
    close(
        tf.GaussianSumFilter(bent(initial()))(ys).mean,
        tf.GaussianSumFilter(bent(initial()), tf.moments.unscented())(ys).mean,
        0,
    )


@pytest.mark.parametrize("kind", ["joint", "independent", "batch"])
def test_priors_of_torch(kind):
    w, m, s = (tensor(np.stack(part)) for part in zip(*((w, m, np.diag([0.5, 1.5])) for w, m, _ in START), strict=True))
    if kind == "independent":
        parts = Independent(Normal(m, s.diagonal(dim1=-2, dim2=-1)), 1)
    elif kind == "batch":
        m = torch.stack([m, m + 1])
        parts, w = MultivariateNormal(m, scale_tril=s.expand(2, 3, 2, 2)), w.expand(2, 3)
    else:
        parts = MultivariateNormal(m, scale_tril=s)
    theirs = tf.StateSpaceModel(MixtureSameFamily(Categorical(w), parts), law(F, MOTIONS[:1]), law(H, SENSORS[:1]))
    ours = tf.StateSpaceModel(tf.InitialMixture(tf.Particles(m, w.log(), s)), theirs.transition, theirs.observation)
    ys = tensor(series(3))
    found, expected = (tf.GaussianSumFilter(each)(ys) for each in (theirs, ours))
    close(found.mean, expected.mean, 1e-14)
    close(found.log_likelihood, expected.log_likelihood, 1e-13)
    if kind == "batch":
        with pytest.raises(ValueError, match=re.escape("the prior is for a batch of (2,), not (3,)")):
            tf.GaussianSumFilter(theirs).init((3,))


def squared(prior):
    """x^2 / 5 is seen, so that the sign never is."""
    return tf.StateSpaceModel(
        prior,
        tf.LinearGaussian(tensor([[0.95]]), tensor([[0.25]])),
        tf.AdditiveGaussian(lambda x: x.square() / 5, tensor([[0.5]])),
    )


def off_the_grid(count, ys, predict_first):
    """Errors of mean (in deviations), variance (relative) and evidence of a wide prior in so many pieces."""
    pieces = tf.split_gaussian(tf.Gaussian(tensor([0.4]), tensor([[3.0]])), count, 0, reach=3.5)
    x = np.linspace(-16, 16, 2001)
    centres, sd = pieces.x[:, 0].numpy(), pieces.scale_tril.flatten()[0].item()
    start = (pieces.weights.numpy() * norm.pdf(x[:, None], centres, sd)).sum(1)
    step = norm.pdf(x[:, None], 0.95 * x, 0.5)
    likelihoods = norm.pdf(ys[:, None], x**2 / 5, np.sqrt(0.5))
    if not predict_first:
        after = start * likelihoods[0]
        evidence = after.sum() * (x[1] - x[0])
        mean = (x * after).sum() / after.sum()
        mean, variance = np.array([mean]), np.array([(x**2 * after).sum() / after.sum() - mean**2])
        total = np.log(evidence)
    else:
        mean, variance, each = mixture_oracle.grid_filter(x, start / start.sum() / (x[1] - x[0]), step, likelihoods)
        total = each.sum()
    filter = tf.GaussianSumFilter(squared(tf.InitialMixture(pieces)), tf.moments.taylor())
    ours = filter(tensor(ys[:, None]), predict_first=predict_first)
    return np.array(
        [
            np.abs(ours.mean[:, 0].numpy() - mean).max() / np.sqrt(variance.max()),
            np.abs(ours.covariance[:, 0, 0].numpy() / variance - 1).max(),
            abs(ours.log_likelihood.item() - total),
        ]
    ), variance[-1]


def test_two_peaks_against_a_grid():
    """A wide prior in pieces under the extended filter; one Gaussian can't say what the sign is.

    What is left out of each piece is the square of its width: after one measurement half the width makes a quarter of
    the error, up to terms of the fourth order. The motion spreads pieces by 0.5 at each step, as wide as those of 24:
    six steps then make at most six times the error of one.
    """
    ys = np.array([2.2, 1.5, 2.6, 3.2, 2.0, 1.4])
    wide, narrow = (off_the_grid(count, ys[:1], False)[0] for count in (24, 48))
    assert ((wide / narrow > 3) & (wide / narrow < 5)).all(), wide / narrow
    (few, _), (many, variance) = (off_the_grid(count, ys, True) for count in (6, 24))
    assert (many < 6 * wide).all() and (many < few).all(), (many, wide, few)
    prior = tf.Gaussian(tensor([0.4]), tensor([[3.0]]))
    single = tf.ExtendedKalmanFilter(squared(prior))(tensor(ys[:, None]))
    assert abs(single.covariance[-1, 0, 0].item() / variance - 1) > 0.5


# ----------------------------------------------------------------------------------------------------------------------
# Rotations, gates, symmetry, sensors


def test_laws_on_rotations_may_be_mixtures():
    """Two turns by chance, nothing measured: each component is turned by each, and nothing else."""
    space = tf.UnitQuaternion()
    turns = tensor([[0.3, 0.0, 0.1], [0.0, -0.5, 0.2]])
    laws = [
        tf.AdditiveGaussian(
            lambda x, t=t: space.retract(x, t.expand(*x.shape[:-1], 3)), 0.01 * torch.eye(3).double(), space
        )
        for t in turns
    ]
    start = tf.Gaussian(tensor([0.0, 0, 0, 1]), 0.2 * torch.eye(3, dtype=DOUBLE), space)
    sensor = tf.AdditiveGaussian(lambda x: x[..., :3], torch.eye(3, dtype=DOUBLE))
    pieces = tf.InitialMixture(tf.split_gaussian(start, 3, 2))
    filter = tf.GaussianSumFilter(
        tf.StateSpaceModel(pieces, tf.MixtureLaw(laws, [0.25, 0.75]), sensor), tf.moments.taylor()
    )
    after, _ = filter.step(filter.init(), torch.full((3,), torch.nan, dtype=DOUBLE))
    expected = torch.cat([space.retract(pieces.x, t.expand(3, 3)) for t in turns])
    close(after.belief.x, expected, 1e-14)
    close(after.belief.weights, torch.cat([0.25 * pieces.mixture().weights, 0.75 * pieces.mixture().weights]), 1e-14)


def test_each_component_gates_for_itself():
    density, y = -6.0, np.array([-1.5, 0.3])
    gate = tf.Gate(0.99, outlier_log_density=density)
    filter = tf.GaussianSumFilter(model(), gate=gate)
    assert filter.evidence == "approximate"
    after, info = filter.step(filter.init(), tensor(y))
    logs, means, tests, taken = [], [], [], []
    for _, m, p in START:
        m, p = F @ m, F @ p @ F.T + Q
        s = H @ p @ H.T + R
        nis = (y - H @ m) @ np.linalg.solve(s, y - H @ m)
        tests.append(nis)
        taken.append(nis < chi2.ppf(0.99, 2))
        logs.append(-0.5 * (nis + np.log(np.linalg.det(2 * np.pi * s))) if taken[-1] else density)
        means.append(m + p @ H.T @ np.linalg.solve(s, y - H @ m) if taken[-1] else m)
    assert any(taken) and not all(taken)
    joint = np.array([w for w, _, _ in START]) * np.exp(logs)
    weights = joint / joint.sum()
    close(after.belief.weights, weights, 1e-12)
    close(after.belief.x, means, 1e-12)
    close(info.log_likelihood, np.log(joint.sum()), 1e-12)
    close(info.gate_nis, weights @ tests)
    assert bool(info.accepted) == (weights @ taken >= 0.5)


@pytest.mark.parametrize("prior", ["ours", "torch"])
def test_a_mixture_as_prior_of_a_symmetric_model(prior):
    """Components are stated by their representatives, and motions set out from them: as from a prior so stated."""
    space = symmetry_problem.SPACE if prior == "ours" else tf.Euclidean(3)
    rng = np.random.default_rng(0)
    x = tensor(rng.standard_normal((3, 3)) * [4.0, 4.0, 1.0])
    factor = torch.diag_embed(tensor(rng.uniform(0.3, 1.0, (3, 3))))
    log_weights = tensor([0.5, 0.3, 0.2]).log()
    gauge = symmetry_problem.NoseEast()
    if prior == "ours":
        start = tf.InitialMixture(tf.Particles(x, log_weights, factor, space))
        motion = symmetry_problem.Drive(0.1)
    else:
        start = MixtureSameFamily(Categorical(logits=log_weights), MultivariateNormal(x, scale_tril=factor))
        motion = tf.AdditiveGaussian(lambda x: x, 0.1 * torch.eye(3, dtype=DOUBLE))
    found = tf.StateSpaceModel(start, motion, symmetry_problem.camera(0.3), gauge=gauge)
    turned, jacobian = gauge.first_order(x)
    covariance = jacobian @ factor @ factor.mT @ jacobian.mT
    belief = tf.GaussianSumFilter(found).init().belief
    close(belief.x, turned, 1e-13)
    close(belief.scale_tril @ belief.scale_tril.mT, covariance, 1e-13)
    if prior == "ours":
        us, ys = tensor(symmetry_problem.US[:4]), tensor(0.3 * rng.standard_normal((4, 1, 2)))
        stated = tf.Particles(belief.x, belief.log_weights, belief.scale_tril, space)
        expected = tf.StateSpaceModel(tf.InitialMixture(stated), motion, symmetry_problem.camera(0.3), gauge=gauge)
        histories = [tf.GaussianSumFilter(each)(ys, us, symmetry_problem.DT) for each in (found, expected)]
        close(histories[0].mean, histories[1].mean, 1e-10)
        close(histories[0].log_likelihood, histories[1].log_likelihood, 1e-10)


def test_a_symmetric_motion_may_be_a_mixture():
    """Both of its laws set out from representatives."""
    laws = [symmetry_problem.Drive(0.1), symmetry_problem.Drive(0.1, current=1.0)]
    both = symmetry_problem.model(
        symmetry_problem.NoseEast(), symmetry_problem.camera(0.3), tf.MixtureLaw(laws, [0.5, 0.5])
    )
    filter, u = tf.GaussianSumFilter(both), tensor(symmetry_problem.US[0])
    start = filter.init().belief._replace(x=tensor([[2.0, -1.0, 0.7]]))
    nothing = torch.full((2,), torch.nan, dtype=DOUBLE)
    after, _ = filter.step(filter.init()._replace(belief=start), nothing, u, symmetry_problem.DT)
    for k, motion in enumerate(laws):
        alone = tf.GaussianSumFilter(
            symmetry_problem.model(symmetry_problem.NoseEast(), symmetry_problem.camera(0.3), motion)
        )
        one, _ = alone.step(alone.init()._replace(belief=start), nothing, u, symmetry_problem.DT)
        close(after.belief.x[k], one.belief.x[0], 1e-13)
        close(after.belief.scale_tril[k], one.belief.scale_tril[0], 1e-13)


def test_sensors_by_name_and_controls():
    first, second = (tf.LinearGaussian(tensor(H[k : k + 1]), tensor(R[k : k + 1, k : k + 1])) for k in range(2))
    motion = tf.LinearGaussian(tensor(F), tensor(Q), control_matrix=tensor(np.eye(2)))
    pushed = tf.MixtureLaw([motion, law(F, MOTIONS[1:])], [0.7, 0.3])
    named = tf.StateSpaceModel(initial(), pushed, tf.Sensors(level=first, rate=second))
    joint = tf.StateSpaceModel(initial(), pushed, law(H, [(1, np.zeros(2), np.diag(np.diag(R)))]))
    ys, us = series(4, 2), tensor(series(4, 2, seed=3))
    parts = {"level": tensor(ys[..., :1]), "rate": tensor(ys[..., 1:])}
    found, expected = tf.GaussianSumFilter(named)(parts, us), tf.GaussianSumFilter(joint)(tensor(ys), us)
    close(found.mean, expected.mean, 1e-11)
    gated = tf.GaussianSumFilter(named, gate=tf.Gate(0.99, {"rate": -5.0}, sensors=("rate",)))(parts, us).diagnostics
    assert gated.accepted.shape == gated.gate_nis.shape == (4, 2, 2) and gated.accepted[..., 0].all()
    shared = tf.GaussianSumFilter(joint)(tensor(ys), us[:, 0])
    close(shared.mean[:, 0], expected.mean[:, 0], 1e-11)


def test_dt_a_row():
    drift = lambda x, u, dt: tf.Gaussian(x + dt, 0.1 + 0 * x, is_diagonal=True)  # noqa: E731
    rush = lambda x, u, dt: tf.Gaussian(x + 5 * dt, 0.1 + 0 * x, is_diagonal=True)  # noqa: E731
    filter = tf.GaussianSumFilter(
        tf.StateSpaceModel(
            initial([(1.0, *START[0][1:])]), tf.MixtureLaw([drift, rush], [0.5, 0.5]), law(H, SENSORS[:1])
        )
    )
    nothing = torch.full((2, 2), torch.nan, dtype=DOUBLE)
    after, _ = filter.step(filter.init((2,)), nothing, dt=tensor([1.0, 0.2]))
    close(after.belief.x, START[0][1] + np.array([[[1.0], [5.0]], [[0.2], [1.0]]]), 1e-12)


# ----------------------------------------------------------------------------------------------------------------------
# As a module


def test_scores():
    """Of the evidence by weights of prior and laws, means and noise, nothing merged: finite differences."""
    ys = tensor(series(2, 1))

    def evidence(prior, x, share, noise):
        start = tf.InitialMixture(
            tf.Particles(x, torch.log_softmax(prior, -1), torch.eye(2, dtype=DOUBLE).expand(2, 2, 2))
        )
        sensors = [tf.LinearGaussian(tensor(H), scale_tril=torch.diag(s * noise)) for s in (1.0, 5.0)]
        law = tf.MixtureLaw(sensors, torch.softmax(share, -1))
        filter = tf.GaussianSumFilter(tf.StateSpaceModel(start, tf.LinearGaussian(tensor(F), tensor(Q)), law))
        return filter(ys).log_likelihood

    parts = tensor([0.1, -0.3]), tensor([[0.0, 1.0], [2.0, -1.0]]), tensor([1.0, -1.0]), tensor([0.5, 0.7])
    assert torch.autograd.gradcheck(evidence, [part.requires_grad_() for part in parts], atol=1e-6)


def test_weights_count_by_their_ratio():
    """As for the other filters: a step of an optimiser that leaves the simplex changes nothing but the ratio."""
    weights = torch.nn.Parameter(tensor([0.8, 0.2]))
    laws = [tf.LinearGaussian(tensor(H), tensor(r)) for _, _, r in SENSORS[:2]]
    filter = tf.GaussianSumFilter(tf.StateSpaceModel(initial(), law(F, MOTIONS[:1]), tf.MixtureLaw(laws, weights)))
    ys = tensor(series(3, 1))
    before = filter(ys).log_likelihood
    before.sum().backward()
    assert abs((weights.grad * weights).sum()) < 1e-12 < weights.grad.abs().min()
    with torch.no_grad():
        weights *= 3
    close(filter(ys).log_likelihood, before.detach())


def test_scores_through_merging():
    ys = tensor(series(4, 1))
    push = torch.nn.Parameter(tensor(PUSH))

    def evidence():
        laws = [law(F, MOTIONS[:1]), tf.LinearGaussian(tensor(F), tensor(Q), push)]
        mixed = tf.StateSpaceModel(initial(), tf.MixtureLaw(laws, [0.8, 0.2]), law(H, SENSORS))
        return tf.GaussianSumFilter(mixed, components=4)(ys).log_likelihood.sum()

    gradient = torch.autograd.grad(evidence(), push)[0]
    for k in range(2):
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                push[k] += sign * 1e-6
                ends.append(evidence().item())
                push[k] -= sign * 1e-6
        assert abs((ends[0] - ends[1]) / 2e-6 - gradient[k].item()) < 1e-7 * max(1, abs(gradient[k].item())) + 1e-8


def test_the_module_moves_with_all_its_laws():
    both = model(None, MOTIONS, SENSORS)
    ys = tensor(series(3))
    expected = tf.GaussianSumFilter(both, components=6)(ys)
    filter = tf.GaussianSumFilter(both, components=6).float()
    found = filter(ys.float())
    assert found.mean.dtype == torch.float32
    close(found.mean, expected.mean, 1e-4)
    other = tf.GaussianSumFilter(
        model([(1 / 3, *START[0][1:])] * 3, [(0.5, p, q) for _, p, q in MOTIONS], SENSORS), components=6
    )
    other.load_state_dict(tf.GaussianSumFilter(model(None, MOTIONS, SENSORS)).state_dict())
    close(other(ys).mean, expected.mean, 0)


def test_saved_loaded_and_resumed(tmp_path):
    ys = tensor(series(6))
    filter = tf.GaussianSumFilter(model(None, MOTIONS, SENSORS), components=6)
    whole, first = filter(ys, record="beliefs"), filter(ys[:4], record="beliefs")
    first.save(tmp_path / "run.npz")
    loaded = tf.History.load(tmp_path / "run.npz")
    assert torch.equal(loaded.beliefs.scale_tril, first.beliefs.scale_tril)
    rest = filter(ys[4:], state=loaded.final, record="beliefs")
    assert torch.equal(rest.mean, whole.mean[4:]) and torch.equal(rest.beliefs.weights, whole.beliefs.weights[4:])


def test_vmap_over_the_step_is_the_batch():
    filter = tf.GaussianSumFilter(model(None, MOTIONS, SENSORS), components=4)
    start, y = filter.init((3,)).belief, tensor(series(1, 3)[0])

    def advance(x, log_weights, factor, y):
        after, info = filter.advance(tf.Particles(x, log_weights, factor), y)
        return after.x, after.log_weights, after.scale_tril, info.log_likelihood

    parts = start.x, start.log_weights, start.scale_tril, y
    for one, two in zip(torch.func.vmap(advance)(*parts), advance(*parts), strict=True):
        close(one, two, 1e-11)


@pytest.mark.slow
def test_compiled_step_equals_eager():
    torch._dynamo.reset()
    filter = tf.GaussianSumFilter(model(None, MOTIONS), components=4)
    compiled = torch.compile(filter.advance, fullgraph=True)
    eager = fast = filter.init((2,)).belief
    for y in tensor(series(3)):
        eager, info = filter.advance(eager, y, None, None, None, "none")
        fast, fast_info = compiled(fast, y, None, None, None, "none")
        close(fast.x, eager.x, 1e-11)
        close(fast.weights, eager.weights, 1e-11)
        close(fast_info.log_likelihood, info.log_likelihood, 1e-11)


def test_a_failed_row_is_reported_and_the_others_go_on():
    filter, ys = tf.GaussianSumFilter(model(None, MOTIONS, SENSORS), components=4), tensor(series(4, 3))
    state = filter.init((3,))
    x = state.belief.x.clone()
    x[1, 2, 0] = torch.nan  # one component of many
    state = state._replace(belief=state.belief._replace(x=x))
    with pytest.raises(tf.FilterError, match="row"):
        filter.step(state, ys[0])
    found = filter(ys, state=state, throw=False)
    assert found.diagnostics.ok.tolist() == [[True, False, True]] * 4
    assert torch.equal(found.mean[:, ::2], filter(ys).mean[:, ::2])


def test_errors():
    with pytest.raises(ValueError, match="components must be at least 1, got 0"):
        tf.GaussianSumFilter(model(), components=0)
    with pytest.raises(TypeError, match="gate must be a Gate or None, got float"):
        tf.GaussianSumFilter(model(), gate=0.99)
    with pytest.raises(ValueError, match="a gate of several Gaussians needs outlier_log_density"):
        tf.GaussianSumFilter(model(), gate=tf.Gate(0.99))
    with pytest.raises(TypeError, match="rule"):
        tf.GaussianSumFilter(model(), 3)
    with pytest.raises(TypeError, match="StateSpaceModel"):
        tf.GaussianSumFilter(initial())
    scalar = tf.StateSpaceModel(
        MixtureSameFamily(Categorical(tensor([0.5, 0.5])), Normal(tensor([0.0, 1.0]), 1.0)),
        law(F, MOTIONS[:1]),
        law(H, SENSORS[:1]),
    )
    with pytest.raises(ValueError, match=re.escape("a mixture as initial law draws states (d,), this one has ()")):
        tf.GaussianSumFilter(scalar)
    filter = tf.GaussianSumFilter(model())
    state = filter.init()
    with pytest.raises(ValueError, match="needs a factor for its components"):
        filter.step(state._replace(belief=state.belief._replace(scale_tril=None)), torch.zeros(2, dtype=DOUBLE))
    assert reduce(state.belief, 3) is state.belief


def test_measurements_by_name_of_a_mixture_of_sensors():
    """A clean sensor or a dirty one beside another: by name or side by side is the same; the gate's log has both."""
    eye = torch.eye(2, dtype=DOUBLE)
    level = tf.PseudoMeasurement(torch.ones(1, 2, dtype=DOUBLE), 1, 0.5, 0.3)
    fine, rough = (tf.LinearGaussian(eye[:1], variance * eye[:1, :1]) for variance in (0.1, 4.0))
    laws = [tf.Sensors(a=law, b=tf.LinearGaussian(eye[1:], eye[:1, :1]), level=level) for law in (fine, rough)]
    prior, motion = tf.Gaussian(torch.zeros(2, dtype=DOUBLE), eye), tf.LinearGaussian(eye, 0.1 * eye)
    model = tf.StateSpaceModel(prior, motion, tf.MixtureLaw(laws, [0.8, 0.2]))
    tracker = tf.GaussianSumFilter(model, components=4, gate=tf.Gate(0.99, -5.0))
    z = torch.tensor([0.4], dtype=DOUBLE)
    named, info = tracker.step(tracker.init(), {"a": z})
    packed, _ = tracker.step(tracker.init(), torch.tensor([0.4, torch.nan, 0.3], dtype=DOUBLE))
    assert torch.equal(named.belief.x, packed.belief.x) and info.accepted.shape == (3,)
    # Other names, or a constraint of another value, would make another measurement of the same words.
    other = tf.PseudoMeasurement(torch.ones(1, 2, dtype=DOUBLE), 1, 0.5, 0.7)
    for last in (tf.Sensors(a=fine, c=fine, level=level), tf.Sensors(a=fine, b=fine, level=other), fine):
        mixed = tf.GaussianSumFilter(tf.StateSpaceModel(prior, motion, tf.MixtureLaw([laws[0], last], [0.5, 0.5])))
        with pytest.raises(TypeError, match="measurements by name need Sensors"):
            mixed.step(mixed.init(), {"a": z})
