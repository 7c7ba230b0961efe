"""Interacting multiple models against filterpy, plain numpy and SciPy's rotations."""

import re
import warnings

import numpy as np
import pytest
import torch
from oracles import mixture_oracle
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import torchfilt as tf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from filterpy.kalman import IMMEstimator
    from filterpy.kalman import KalmanFilter as FilterpyKalman

DOUBLE = torch.float64
DT = 0.5
JUMP = np.array([[0.95, 0.05], [0.15, 0.85]])
RATES = np.array([[-0.3, 0.2, 0.1], [0.5, -0.5, 0.0], [0.0, 0.4, -0.4]])
M0, P0 = np.array([0.0, 1.0, 0.0, -0.5]), np.diag([4.0, 1.0, 4.0, 1.0])
H, R = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]]), 0.09 * np.eye(2)


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=DOUBLE)


def close(found, expected, tolerance=1e-9):
    np.testing.assert_allclose(np.asarray(found.detach()), np.asarray(expected), rtol=0, atol=tolerance)


def mode(k):
    """Motion and noise of a target that flies straight (0), is pushed (1) or turns (2)."""
    turn = (0.0, 0.0, 0.9)[k]
    c, s = np.cos(turn * DT), np.sin(turn * DT)
    sine, versine = (DT, 0.0) if turn == 0 else (s / turn, (1 - c) / turn)
    f = np.array([[1, sine, 0, -versine], [0, c, 0, -s], [0, versine, 1, sine], [0, s, 0, c]])
    block = (1e-3, 2.0, 1e-2)[k] * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    return f, np.kron(np.eye(2), block) + 1e-9 * np.eye(4), H, R


def model(k, m0=M0, p0=P0, r=R):
    f, q, h, _ = mode(k)
    return tf.StateSpaceModel(
        tf.Gaussian(tensor(m0), torch.linalg.cholesky(tensor(p0))),
        tf.LinearGaussian(tensor(f), tensor(q)),
        tf.LinearGaussian(tensor(h), tensor(r)),
    )


def manoeuvre(seed=0, steps=40, rows=1):
    """Straight, then one sharp turn, then straight: (t, rows, 2)."""
    rng = np.random.default_rng(seed)
    x, ys = np.tile(M0, (rows, 1)), []
    for k in range(steps):
        f, q, h, r = mode(2 if steps // 3 <= k < steps // 2 else 0)
        x = x @ f.T + rng.standard_normal((rows, 4)) @ np.linalg.cholesky(q).T
        ys.append(x @ h.T + rng.standard_normal((rows, 2)) * np.sqrt(np.diag(r)))
    return np.array(ys)


def assert_equals(history, expected, row=0):
    """Probabilities, mean, covariance and evidence of a row."""
    probabilities, mean, covariance, evidence = expected
    close(history.beliefs.weights[:, row], probabilities)
    close(history.mean[:, row], mean)
    close(history.covariance[:, row], covariance)
    close(history.diagnostics.log_likelihood[:, row], evidence)


# ----------------------------------------------------------------------------------------------------------------------
# Values


def test_manoeuvring_target_equals_filterpy():
    ys, kalmans = manoeuvre(), []
    for k in range(2):
        one = FilterpyKalman(dim_x=4, dim_z=2)
        one.x, one.P = M0.copy(), P0.copy()
        one.F, one.Q, one.H, one.R = mode(k)
        kalmans.append(one)
    theirs = IMMEstimator(kalmans, np.array([0.7, 0.3]), JUMP)
    filter = tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP), initial_probabilities=tensor([0.7, 0.3]))
    ours = filter(tensor(ys), record="beliefs")
    for k, y in enumerate(ys[:, 0]):
        theirs.predict()
        theirs.update(y)
        close(ours.beliefs.weights[k, 0], theirs.mu)
        close(ours.mean[k, 0], theirs.x)
        close(ours.covariance[k, 0], theirs.P)
    assert ours.beliefs.weights[5, 0, 0] > 0.8 and ours.beliefs.weights[16:19, 0, 1].max() > 0.5  # straight, then not
    assert filter.evidence == "approximate"


@pytest.mark.parametrize("rule", [tf.moments.taylor(), tf.moments.cubature()])
def test_three_models_with_gaps_equal_numpy(rule):
    """Each model its own prior; measurements missing in part and as a whole, each row its own."""
    ys = manoeuvre(1, 20, 3)
    ys[np.random.default_rng(0).uniform(size=ys.shape) < 0.3] = np.nan
    ys[7, 1] = np.nan
    jump = expm(RATES * DT)
    starts = [(M0 + 0.1 * k, (1 + k) * P0) for k in range(3)]
    filter = tf.InteractingMultipleModel([model(k, *starts[k]) for k in range(3)], tensor(jump), rule)
    ours = filter(tensor(ys), record="beliefs")
    for row in range(3):
        start = [(1 / 3, m, p) for m, p in starts]
        expected = mixture_oracle.interacting([mode(k) for k in range(3)], [jump] * 20, start, ys[:, row])
        assert_equals(ours, expected, row)


@pytest.mark.parametrize("each", [False, True], ids=["shared", "a row"])
def test_rates_are_steps_of_their_exponential(each):
    ys = manoeuvre(2, 8, 2)
    dts = np.array([0.5, 0.1, 0.0, 2.0, 1.0, 0.0, 0.3, 5.0])
    dts = dts[:, None] * np.array([1.0, 0.4]) if each else np.tile(dts[:, None], 2)
    filter = tf.InteractingMultipleModel([model(k) for k in range(3)], rates_per_s=tensor(RATES))
    ours = filter(tensor(ys), dt=tensor(dts if each else dts[:, 0]), record="beliefs")
    for row in range(2):
        jumps = [expm(RATES * dt) for dt in dts[:, row]]
        start = [(1 / 3, M0, P0)] * 3
        expected = mixture_oracle.interacting([mode(k) for k in range(3)], jumps, start, ys[:, row])
        assert_equals(ours, expected, row)


def still(scale):
    """A motion that knows dt: none over dt = 0."""
    return tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(1, dtype=DOUBLE), torch.eye(1, dtype=DOUBLE)),
        lambda x, u, dt: tf.Gaussian(x, (scale * dt * torch.ones_like(x)).abs(), is_diagonal=True),
        tf.LinearGaussian(torch.eye(1, dtype=DOUBLE), scale * torch.eye(1, dtype=DOUBLE)),
    )


@pytest.mark.parametrize("dt", [0, 0.0, torch.zeros((), dtype=DOUBLE), torch.zeros(2, dtype=DOUBLE)])
@pytest.mark.parametrize("by", ["rates_per_s", "transition_probabilities"])
def test_no_mode_changes_in_no_time(by, dt):
    chain = tensor([[-1.0, 1.0], [2.0, -2.0]]) if by == "rates_per_s" else tensor(JUMP)
    filter = tf.InteractingMultipleModel([still(1.0), still(3.0)], **{by: chain})
    state = filter.init((2,))
    state = state._replace(belief=state.belief._replace(x=tensor([[[1.0], [2.0]], [[0.0], [-1.0]]])))
    nothing = torch.full((2, 1), torch.nan, dtype=DOUBLE)
    after, _ = filter.step(state, nothing, dt=dt)
    for name in ("x", "weights", "scale_tril"):
        close(getattr(after.belief, name), getattr(state.belief, name), 1e-15)
    before, _ = filter.step(state, nothing, dt=1.0, predict_first=False)
    close(before.belief.x, state.belief.x, 0)
    moved, _ = filter.step(state, nothing, dt=1.0)
    assert (moved.belief.x - state.belief.x).abs().max() > 0.01


def test_a_step_of_one_row_may_take_no_time():
    filter = tf.InteractingMultipleModel([still(1.0), still(3.0)], tensor(JUMP))
    state = filter.init((2,))
    after, _ = filter.step(state, torch.full((2, 1), torch.nan, dtype=DOUBLE), dt=tensor([0.0, 0.7]))
    close(after.belief.weights, [[0.5, 0.5], [0.5, 0.5] @ JUMP], 1e-15)


def test_identical_models_are_the_single_filter():
    ys = manoeuvre(3, 15, 2)
    ys[4, 0] = np.nan
    single = tf.KalmanFilter(model(0))(tensor(ys))
    bank = tf.InteractingMultipleModel(
        [model(0)] * 3, tensor(expm(RATES)), initial_probabilities=tensor([0.2, 0.5, 0.3])
    )
    ours = bank(tensor(ys))
    close(ours.mean, single.mean, 1e-11)
    close(ours.covariance, single.covariance, 1e-11)
    close(ours.diagnostics.log_likelihood, single.diagnostics.log_likelihood, 1e-11)


def test_one_model_is_the_exact_filter():
    ys = manoeuvre(3, 5)
    alone = tf.InteractingMultipleModel([model(0)], torch.ones(1, 1, dtype=DOUBLE))
    assert alone.evidence == "exact"
    close(alone(tensor(ys)).mean, tf.KalmanFilter(model(0))(tensor(ys)).mean, 1e-12)
    nonlinear = tf.StateSpaceModel(
        model(0).initial, lambda x: tf.Gaussian(x, torch.eye(4, dtype=DOUBLE)), model(0).observation
    )
    assert tf.InteractingMultipleModel([nonlinear], torch.ones(1, 1, dtype=DOUBLE)).evidence == "linearized"


@pytest.mark.parametrize("truth", [0, 1])
def test_the_right_model_is_found(truth):
    """A mode that stays, 100 runs of 60 steps, noise of deviation 1 or 2.

    The log-ratio is a scaled chi-square variable of 60 degrees less a constant: a run ends below 0.9 with a chance
    below 1e-3, three of 100 with one below 2e-4.
    """
    filter = tf.InteractingMultipleModel([still(1.0), still(4.0)], torch.eye(2, dtype=DOUBLE))
    rng = np.random.default_rng(truth)
    sd = (1.0, 2.0)[truth]
    x = rng.standard_normal(100)
    ys = tensor(x + sd * rng.standard_normal((60, 100))).unsqueeze(-1)
    found = filter(ys, dt=1e-3, record="beliefs").beliefs.weights[-1, :, truth]
    assert (found > 0.9).sum() >= 98 and found.median() > 0.9999


def test_a_mode_that_is_not_reached_has_no_weight():
    """From mode 0 no way leads to mode 1; nor does one lead back. It keeps the Gaussian that it has."""
    ys = manoeuvre(4, 10)
    start = tensor([1.0, 0.0])
    filter = tf.InteractingMultipleModel(
        [model(0), model(1, M0 + 1, 2 * P0)], torch.eye(2, dtype=DOUBLE), initial_probabilities=start
    )
    ours = filter(tensor(ys), record="beliefs")
    assert (ours.beliefs.weights[..., 1] == 0).all() and torch.isfinite(ours.beliefs.x).all()
    close(ours.beliefs.x[:, :, 1], tf.KalmanFilter(model(1, M0 + 1, 2 * P0))(tensor(ys)).mean, 1e-11)
    close(ours.mean, tf.KalmanFilter(model(0))(tensor(ys)).mean, 1e-12)
    close(ours.log_likelihood, tf.KalmanFilter(model(0))(tensor(ys)).log_likelihood, 1e-11)


# ----------------------------------------------------------------------------------------------------------------------
# Rotations, gates, sensors, controls


@pytest.mark.parametrize("side", ["right", "left"])
def test_modes_are_mixed_on_rotations(side):
    """Mean intrinsic, columns by the Jacobian of the way to the mixed mean; then small noise is added."""
    space, noise = tf.UnitQuaternion(side), 1e-3
    rng = np.random.default_rng(5)
    points = Rotation.from_rotvec(0.5 * rng.standard_normal((2, 3)))
    factors = np.tril(0.2 * rng.standard_normal((2, 3, 3))) + 0.1 * np.eye(3)
    law = tf.AdditiveGaussian(lambda x: x, noise**2 * torch.eye(3, dtype=DOUBLE), space)
    models = [
        tf.StateSpaceModel(
            tf.Gaussian(tensor(q), tensor(s), space), law, lambda x: tf.Gaussian(x[..., :1], torch.eye(1))
        )
        for q, s in zip(points.as_quat(), factors, strict=True)
    ]
    weights = np.array([0.6, 0.4])
    filter = tf.InteractingMultipleModel(models, tensor(JUMP), tf.moments.taylor(), tensor(weights))
    after, _ = filter.step(filter.init(), torch.full((1,), torch.nan, dtype=DOUBLE))
    close(after.belief.weights, weights @ JUMP, 1e-14)
    for j in range(2):
        came = weights * JUMP[:, j] / (weights @ JUMP[:, j])
        mean = mixture_oracle.rotation_mean(points.as_quat(), came)
        found = Rotation.from_quat(after.belief.x[j].numpy())
        assert (mean.inv() * found).magnitude() < 1e-12
        errors = (mean.inv() * points if side == "right" else points * mean.inv()).as_rotvec()
        covariance = noise**2 * np.eye(3)
        for w, error, factor in zip(came, errors, factors, strict=True):
            own = np.linalg.solve(mixture_oracle.right_jacobian(error if side == "right" else -error), factor)
            covariance += w * (np.outer(error, error) + own @ own.T)
        own = after.belief.scale_tril[j]
        close(own @ own.mT, covariance, 1e-12)


def test_each_mode_gates_for_itself():
    """A measurement that only the restless mode believes; the calm one keeps its prediction."""
    density = -4.0
    gate = tf.Gate(0.99, outlier_log_density=density)
    filter = tf.InteractingMultipleModel([model(0), model(1, r=25 * R)], tensor(JUMP), gate=gate)
    y = np.array([8.0, -1.0])
    state = filter.init()
    after, info = filter.step(state, tensor(y))
    logs, means, tests = [], [], []
    for k, r in enumerate((R, 25 * R)):
        f, q, h, _ = mode(k)
        m, p = f @ M0, f @ P0 @ f.T + q
        s = h @ p @ h.T + r
        nis = (y - h @ m) @ np.linalg.solve(s, y - h @ m)
        taken = nis < chi2.ppf(0.99, 2)
        tests.append((nis, taken))
        logs.append(-0.5 * (nis + np.log(np.linalg.det(2 * np.pi * s))) if taken else density)
        means.append(m + p @ h.T @ np.linalg.solve(s, y - h @ m) if taken else m)
    assert [taken for _, taken in tests] == [False, True]
    joint = np.array([0.5, 0.5]) @ JUMP * np.exp(logs)
    weights = joint / joint.sum()
    close(after.belief.weights, weights, 1e-12)
    close(after.belief.x, means, 1e-12)
    close(info.log_likelihood, np.log(joint.sum()), 1e-12)
    close(info.gate_nis, weights @ [nis for nis, _ in tests], 1e-11)
    assert bool(info.accepted) == (weights[1] >= 0.5)
    assert filter.evidence == "approximate"


def test_sensors_by_name():
    ys = manoeuvre(6, 6, 2)
    first, second = (tf.LinearGaussian(tensor(H[k : k + 1]), tensor(R[:1, :1])) for k in range(2))
    named = [
        tf.StateSpaceModel(one.initial, one.transition, tf.Sensors(east=first, north=second))
        for one in (model(0), model(1))
    ]
    gate = tf.Gate(1 - 1e-12, outlier_log_density=-9.0)
    ours = tf.InteractingMultipleModel(named, tensor(JUMP), gate=gate)
    parts = {"east": tensor(ys[..., :1]), "north": tensor(ys[..., 1:])}
    found = ours(parts)
    expected = tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP))(tensor(ys))
    close(found.mean, expected.mean, 1e-11)
    assert found.diagnostics.accepted.shape == found.diagnostics.gate_nis.shape == (6, 2, 2)
    assert found.diagnostics.accepted.all()


def test_controls_reach_the_models_that_take_them():
    eye = torch.eye(1, dtype=DOUBLE)
    initial = tf.Gaussian(torch.zeros(1, dtype=DOUBLE), eye)
    pushed = tf.StateSpaceModel(initial, tf.LinearGaussian(eye, eye, control_matrix=eye), tf.LinearGaussian(eye, eye))
    free = tf.StateSpaceModel(initial, tf.LinearGaussian(eye, eye), tf.LinearGaussian(eye, eye))
    filter = tf.InteractingMultipleModel([free, pushed], tensor(JUMP))
    nothing = torch.full((2, 1), torch.nan, dtype=DOUBLE)
    for u in (tensor([3.0]), tensor([[3.0], [-1.0]])):
        after, _ = filter.step(filter.init((2,)), nothing, u)
        close(after.belief.x[:, :, 0], [[0.0, 3.0], [0.0, float(u.expand(2, 1)[1])]], 1e-14)
    with pytest.raises(ValueError, match="no law of the model has an argument u"):
        tf.InteractingMultipleModel([free, free], tensor(JUMP)).step(filter.init((2,)), nothing, tensor([3.0]))


# ----------------------------------------------------------------------------------------------------------------------
# As a module


def test_scores_of_chain_and_noise():
    """Derivative of the evidence by the rates, the first probabilities and a measurement noise: finite differences."""
    ys = tensor(manoeuvre(7, 5))

    def evidence(rates, start, scale):
        generator = torch.stack([torch.stack([-rates[0], rates[0]]), torch.stack([rates[1], -rates[1]])])
        models = [
            tf.StateSpaceModel(one.initial, one.transition, tf.LinearGaussian(tensor(H), scale_tril=torch.diag(scale)))
            for one in (model(0), model(1))
        ]
        share = torch.softmax(start, -1)
        filter = tf.InteractingMultipleModel(models, None, None, share, rates_per_s=generator)
        return filter(ys, dt=DT).log_likelihood

    parts = tensor([0.2, 0.4]), tensor([0.3, -0.2]), tensor([0.3, 0.5])
    assert torch.autograd.gradcheck(evidence, [part.requires_grad_() for part in parts], atol=1e-5)


def test_a_chance_of_zero_has_a_finite_gradient():
    chain = torch.nn.Parameter(tensor([[1.0, 0.0], [0.1, 0.9]]))
    filter = tf.InteractingMultipleModel([model(0), model(1)], chain, initial_probabilities=tensor([1.0, 0.0]))
    filter(tensor(manoeuvre(8, 4))).log_likelihood.sum().backward()
    assert dict(filter.named_parameters())["transition_probabilities"] is chain
    assert torch.isfinite(chain.grad).all()


def test_saved_loaded_and_resumed(tmp_path):
    ys = tensor(manoeuvre(9, 8, 2))
    filter = tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP))
    whole, first = filter(ys, record="beliefs"), filter(ys[:5], record="beliefs")
    first.save(tmp_path / "run.npz")
    loaded = tf.History.load(tmp_path / "run.npz")
    rest = filter(ys[5:], state=loaded.final, record="beliefs")
    assert torch.equal(rest.mean, whole.mean[5:]) and torch.equal(rest.beliefs.weights, whole.beliefs.weights[5:])
    other = tf.InteractingMultipleModel([model(0), model(0)], tensor(np.eye(2)))
    other.load_state_dict(filter.state_dict())
    assert torch.equal(other(ys).mean, whole.mean)


def test_vmap_over_the_step_is_the_batch():
    filter = tf.InteractingMultipleModel([model(0), model(1)], rates_per_s=tensor([[-1.0, 1.0], [2.0, -2.0]]))
    start = filter.init((3,)).belief
    start = start._replace(x=start.x + 0.1 * torch.arange(3, dtype=DOUBLE)[:, None, None])
    y, dt = tensor(manoeuvre(10, 1, 3)[0]), tensor([[0.5], [0.0], [2.0]])

    def advance(x, log_weights, factor, y, dt):
        after, info = filter.advance(tf.Particles(x, log_weights, factor), y, None, dt)
        return after.x, after.log_weights, after.scale_tril, info.log_likelihood

    parts = start.x, start.log_weights, start.scale_tril, y, dt
    for one, two in zip(torch.func.vmap(advance)(*parts), advance(*parts), strict=True):
        close(one, two, 1e-12)


@pytest.mark.slow
def test_compiled_step_equals_eager():
    torch._dynamo.reset()
    filter = tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP))
    compiled = torch.compile(filter.advance, fullgraph=True)
    eager = fast = filter.init((2,)).belief
    for y in tensor(manoeuvre(11, 4, 2)):
        eager, info = filter.advance(eager, y, None, None, None, "none")
        fast, fast_info = compiled(fast, y, None, None, None, "none")
        close(fast.x, eager.x, 1e-11)
        close(fast.weights, eager.weights, 1e-11)
        close(fast_info.log_likelihood, info.log_likelihood, 1e-11)


def test_a_failed_row_is_reported_and_the_others_go_on():
    ys = tensor(manoeuvre(12, 5, 3))
    filter = tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP))
    state = filter.init((3,))
    broken = state.belief._replace(x=state.belief.x.index_fill(0, torch.tensor(1), torch.nan))
    with pytest.raises(tf.FilterError, match="row"):
        filter.step(state._replace(belief=broken), ys[0])
    found = filter(ys, state=state._replace(belief=broken), throw=False)
    assert found.diagnostics.ok.tolist() == [[True, False, True]] * 5
    assert torch.equal(found.mean[:, ::2], filter(ys).mean[:, ::2])


# ----------------------------------------------------------------------------------------------------------------------
# Errors

SMALL = tf.StateSpaceModel(
    tf.Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE)), lambda x: x, lambda x: x
)
TURNING = tf.StateSpaceModel(
    tf.Gaussian(torch.zeros(4, dtype=DOUBLE), torch.eye(4, dtype=DOUBLE), tf.Angle(4)), lambda x: x, lambda x: x
)


@pytest.mark.parametrize(
    ("models", "arguments", "kind", "message"),
    [
        ([], {}, ValueError, "models must hold one model or more, got none"),
        ([3], {}, TypeError, "int"),
        ([0, 1], {}, ValueError, "give exactly one of transition_probabilities= and rates_per_s="),
        ([0, 1], {"transition_probabilities": JUMP, "rates_per_s": JUMP}, ValueError, "give exactly one of"),
        ([0, 1], {"transition_probabilities": np.eye(3)}, ValueError, "transition_probabilities must be (2, 2) for 2"),
        ([0, 1], {"rates_per_s": np.eye(3)}, ValueError, "rates_per_s must be (2, 2) for 2 models, got (3, 3)"),
        (
            [0, 1],
            {"transition_probabilities": JUMP, "initial_probabilities": np.ones(3) / 3},
            ValueError,
            "initial_probabilities must be (2,) for 2 models, got (3,)",
        ),
        (
            [0, 1],
            {"transition_probabilities": JUMP, "initial_probabilities": np.array([0.5, 0.6])},
            ValueError,
            "initial_probabilities must sum to one, they sum to 1.1",
        ),
        (
            [0, 1],
            {"transition_probabilities": JUMP.T},
            ValueError,
            "rows of transition_probabilities must sum to one, they sum to 0.9",
        ),
        (
            [0, 1],
            {"transition_probabilities": np.array([[1.5, -0.5], [0, 1]])},
            ValueError,
            "rows of transition_probabilities must not be negative, got -0.5",
        ),
        ([0, 1], {"rates_per_s": JUMP}, ValueError, "rows of rates_per_s must sum to zero, one sums to 1"),
        (
            [0, 1],
            {"rates_per_s": np.array([[1.0, -1.0], [0, 0]])},
            ValueError,
            "rates_per_s off the diagonal must not be negative, got -1",
        ),
        ([0, 1], {"rates_per_s": np.full((2, 2), np.inf)}, ValueError, "rates_per_s must be finite"),
        ([0, SMALL], {"transition_probabilities": JUMP}, ValueError, "model 1 has 2 state numbers, model 0 4"),
        ([0, TURNING], {"transition_probabilities": JUMP}, ValueError, "model 1 lives on Angle(size=4), model 0 on"),
        ([0, 1], {"transition_probabilities": JUMP, "rule": 3}, TypeError, "rule"),
        ([0, 1], {"transition_probabilities": JUMP, "gate": 0.9}, TypeError, "gate must be a Gate or None, got float"),
        (
            [0, 1],
            {"transition_probabilities": JUMP, "gate": tf.Gate(0.9)},
            ValueError,
            "a gate of several Gaussians needs outlier_log_density",
        ),
    ],
)
def test_errors(models, arguments, kind, message):
    models = [model(one) if one in (0, 1) else one for one in models]
    arguments = {name: tensor(value) if isinstance(value, np.ndarray) else value for name, value in arguments.items()}
    with pytest.raises(kind, match=re.escape(message)):
        tf.InteractingMultipleModel(models, **arguments)


def test_errors_of_types_and_steps():
    with pytest.raises(TypeError, match=r"transition_probabilities must be a tensor, got list"):
        tf.InteractingMultipleModel([model(0), model(1)], JUMP.tolist())
    with pytest.raises(TypeError, match=r"must have the models' dtype torch.float64, got torch.float32"):
        tf.InteractingMultipleModel([model(0), model(1)], tensor(JUMP).float())
    with pytest.raises(TypeError, match=r"model 1 has dtype torch.float32, model 0 torch.float64"):
        tf.InteractingMultipleModel([model(0), model(1).float()], tensor(JUMP))
    filter = tf.InteractingMultipleModel([model(0), model(1)], rates_per_s=tensor([[-1.0, 1.0], [2.0, -2.0]]))
    with pytest.raises(ValueError, match="rates_per_s need the length of the step: give dt"):
        filter.step(filter.init(), torch.zeros(2, dtype=DOUBLE))
    batch = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(3, 4, dtype=DOUBLE), torch.eye(4, dtype=DOUBLE)),
        model(0).transition,
        model(0).observation,
    )
    filter = tf.InteractingMultipleModel([batch, model(1)], tensor(JUMP))
    assert filter.init((3,)).belief.x.shape == (3, 2, 4)
    with pytest.raises(ValueError, match=re.escape("the prior is for a batch of (3,), not (2,)")):
        filter.init((2,))
    with pytest.raises(ValueError, match="needs a factor for its components"):
        state = filter.init((3,))
        filter.step(state._replace(belief=state.belief._replace(scale_tril=None)), torch.zeros(3, 2, dtype=DOUBLE))


def test_a_single_model_is_told_so():
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(1), torch.eye(1)),
        tf.LinearGaussian(torch.eye(1), torch.eye(1)),
        tf.LinearGaussian(torch.eye(1), torch.eye(1)),
    )
    with pytest.raises(TypeError, match="models must be a sequence of models, got a single one"):
        tf.InteractingMultipleModel(model, torch.eye(1))
