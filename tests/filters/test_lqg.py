"""The controller that acts on an estimate: the notes' numbers, separation, the price of a stationary loop."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_discrete_lyapunov

import torchfilt as tf
from torchfilt.filters.lqg import ControllerState, LQGController, sampled_weights
from torchfilt.filters.observer import LuenbergerObserver, SteadyStateKalmanFilter
from torchfilt.models.control import c2d, place, ss
from torchfilt.models.control.continuous import linear_model
from torchfilt.models.control.design import lqgr, lqr

DOUBLE = torch.float64
PERIOD = 0.5


def double(values):
    return torch.tensor(values, dtype=DOUBLE)


A, B, C = double([[0, 1], [0, 0]]), double([[0], [1]]), double([[1, 0]])
PLANT = ss(A, B, C)
Q, W = double([[4, 0], [0, 1]]), double([[0.5]])
PSD, R = double([[0.04]]), double([[0.25]])
PRIOR = tf.Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
SAMPLED = c2d(PLANT, PERIOD, PSD, B)
DISCRETE = SAMPLED.system
R_SAMPLED = R / PERIOD


def discrete_controller(prior=PRIOR):
    return LQGController.design(DISCRETE, Q, W, SAMPLED.noise_covariance, R_SAMPLED, prior)


def loop(controller, plant=DISCRETE, dt=None):
    """The matrix (5, 5) of one period of (x, estimate, control): measured from the module, column by column."""

    def period(state):
        x, mean, control = state[:2], state[2:4], state[4:]
        x = plant.a @ x + plant.b @ control
        estimate = controller.observer.init()
        estimate = estimate._replace(belief=estimate.belief._replace(mean=mean))
        after, u = controller.step(ControllerState(estimate, control), plant.c @ x, dt)
        return torch.cat([x, after.estimate.belief.mean, u])

    return torch.stack([period(column) for column in torch.eye(5, dtype=DOUBLE)], -1)


def same_poles(found, expected, tolerance):
    """As sets: each finds its own, and none is used twice."""
    rest = list(expected)
    for pole in found:
        nearest = min(rest, key=lambda other: abs(other - pole))
        assert abs(nearest - pole) < tolerance, (found, expected)
        rest.remove(nearest)
    assert not rest


def test_the_notes_gains_and_cost():
    whole = lqgr(PLANT, Q, W, PSD, R, B)
    torch.testing.assert_close(whole.cost, double(2.07484884048), rtol=1e-11, atol=0)
    torch.testing.assert_close(discrete_controller().gain, double([[1.43844718719, 1.84232921921]]), rtol=1e-10, atol=0)


def test_poles_are_the_union_of_the_regulators_and_the_observers():
    """Separation, from the module's own steps; the control as a state of the loop adds a pole at 0."""
    for observer in (
        discrete_controller().observer,
        LuenbergerObserver(DISCRETE, double([[0.7], [0.3]])),
    ):
        controller = LQGController(observer, discrete_controller().gain)
        regulator = torch.linalg.eigvals(DISCRETE.a - DISCRETE.b @ controller.gain)
        left = (torch.eye(2, dtype=DOUBLE) - observer.gain @ C) @ DISCRETE.a
        expected = [*regulator.tolist(), *torch.linalg.eigvals(left).tolist(), 0.0]
        # Five poles of a matrix of size one, apart by a tenth or more.
        same_poles(torch.linalg.eigvals(loop(controller)).tolist(), expected, 1e-12)


def test_poles_of_a_sampled_continuous_design():
    """The continuous plant between the instants, its controls held."""
    controller = LQGController.design(PLANT, Q, W, PSD, R_SAMPLED, PRIOR, B, PERIOD)
    regulator = torch.linalg.eigvals(DISCRETE.a - DISCRETE.b @ controller.gain)
    left = (torch.eye(2, dtype=DOUBLE) - controller.observer.gain @ C) @ DISCRETE.a
    expected = [*regulator.tolist(), *torch.linalg.eigvals(left).tolist(), 0.0]
    same_poles(torch.linalg.eigvals(loop(controller, dt=PERIOD)).tolist(), expected, 1e-12)


def test_an_observer_that_does_not_hear_of_its_controls_breaks_the_separation():
    """The wrong variant: zero in place of the control of the step before."""

    class Deaf(LQGController):
        def step(self, state, y, dt=None, *, predict_first=True):
            silent = state._replace(control=torch.zeros_like(state.control))
            return super().step(silent, y, dt, predict_first=predict_first)

    right = discrete_controller()
    deaf = Deaf(right.observer, right.gain)
    found, wrong = (torch.linalg.eigvals(loop(c)).abs().max() for c in (right, deaf))
    union = max(
        torch.linalg.eigvals(DISCRETE.a - DISCRETE.b @ right.gain).abs().max(),
        torch.linalg.eigvals((torch.eye(2, dtype=DOUBLE) - right.observer.gain @ C) @ DISCRETE.a).abs().max(),
    )
    assert abs(found - union) < 1e-10 < abs(wrong - union)


def run(controller, runs, steps, seed):
    """Mean cost of a step over the second half, and its standard error over independent runs."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(shape, generator=generator, dtype=DOUBLE)

    root = torch.linalg.cholesky(SAMPLED.noise_covariance)
    x, state, cost = PRIOR.sample(draw(runs, 2)), controller.init((runs,)), torch.zeros(runs, dtype=DOUBLE)
    for k in range(steps):
        x = x @ DISCRETE.a.mT + state.control @ DISCRETE.b.mT + draw(runs, 2) @ root.mT
        state, u = controller.step(state, x @ C.mT + draw(runs, 1) * R_SAMPLED.sqrt())
        if k >= steps // 2:
            cost = cost + ((x @ Q) * x).sum(-1) + ((u @ W) * u).sum(-1)
    each = cost / (steps - steps // 2)
    return each.mean().item(), each.std().item() / runs**0.5


def test_the_stationary_cost_is_the_formulas():
    """2,000 runs; within four standard errors (false alarm 6e-5). Another gain or a deaf observer costs more."""
    expected = lqgr(DISCRETE, Q, W, SAMPLED.noise_covariance, R_SAMPLED).cost.item()
    mean, error = run(discrete_controller(), 2000, 120, seed=1)
    assert error < 0.01 * expected and abs(mean - expected) < 4 * error
    other = LQGController(discrete_controller().observer, 1.5 * discrete_controller().gain)
    dearer, error = run(other, 2000, 120, seed=1)
    assert dearer > expected + 4 * error


def test_the_cost_of_the_loop_by_lyapunov():
    """The same cost without drawing: the covariance of (x, estimate, control) in the module's own loop."""
    controller = discrete_controller()
    gain, k = controller.observer.gain, controller.gain
    matrix = loop(controller).numpy()
    # Noise w moves x and, through the measurement, the estimate and the control; v only these.
    estimate = torch.cat([gain @ C, gain], -1)
    push = torch.cat([torch.eye(2, 3, dtype=DOUBLE), estimate, -k @ estimate]).numpy()
    noise = torch.block_diag(SAMPLED.noise_covariance, R_SAMPLED).numpy()
    spread = solve_discrete_lyapunov(matrix, push @ noise @ push.T)
    cost = np.trace(Q.numpy() @ spread[:2, :2]) + W.item() * spread[4, 4]
    expected = lqgr(DISCRETE, Q, W, SAMPLED.noise_covariance, R_SAMPLED).cost.item()
    assert cost == pytest.approx(expected, rel=1e-11)


def test_a_continuous_loop_of_short_steps_costs_what_the_continuous_formula_says():
    """The notes' 2.07484884048 as the limit of sampled designs: the excess is of second order.

    With poles of at most 1.7 / s: below the cost times (1.7 dt)^2, and 4 to the next order, 1.7 (0.02 - 0.01) s.
    """
    excess = []
    for dt in (0.02, 0.01):
        sampled = c2d(PLANT, dt, PSD, B)
        state, control, cross = sampled_weights(PLANT, Q, W, dt)
        whole = lqgr(sampled.system, state, control, sampled.noise_covariance, R / dt, cross=cross)

        # What the noise within a step costs can not be steered: the trace of Q times its covariance, integrated.
        def spread(s, dt=dt):
            moved = expm(A.numpy() * s) @ B.numpy()
            return 0.04 * moved @ moved.T * (dt - s)

        within = quad_vec(spread, 0, dt)
        cost = (whole.cost.item() + np.trace(Q.numpy() @ within[0])) / dt
        excess.append(cost - 2.07484884048)
    assert 0 < excess[1] < 2.075 * (1.7 * 0.01) ** 2 and excess[0] / excess[1] == pytest.approx(4, rel=0.017)


def test_sampled_weights_by_quadrature():
    cross = double([[0.3], [-0.1]])
    found = sampled_weights(PLANT, Q, W, 0.7, cross)
    whole = np.block([[A.numpy(), B.numpy()], [np.zeros((1, 3))]])
    inside = np.block([[Q.numpy(), cross.numpy()], [cross.numpy().T, W.numpy()]])
    expected = quad_vec(lambda s: expm(whole * s).T @ inside @ expm(whole * s), 0, 0.7, epsabs=1e-13)[0]
    np.testing.assert_allclose(found.state.numpy(), expected[:2, :2], rtol=1e-11)
    np.testing.assert_allclose(found.control.numpy(), expected[2:, 2:], rtol=1e-11)
    np.testing.assert_allclose(found.cross.numpy(), expected[:2, 2:], rtol=1e-11)


def test_a_sampled_design_is_cheaper_between_the_instants_than_one_of_the_instants_alone():
    """Weights at the instants alone give another gain; measured by what the held loop costs, sampled ones win."""
    weights = sampled_weights(PLANT, Q, W, PERIOD)
    controller = LQGController.design(PLANT, Q, W, PSD, R_SAMPLED, PRIOR, B, PERIOD)
    torch.testing.assert_close(controller.gain, lqr(DISCRETE, *weights).gain)
    naive = discrete_controller().gain

    def price(gain):
        closed = (DISCRETE.a - DISCRETE.b @ gain).numpy()
        spread = solve_discrete_lyapunov(closed, np.eye(2))
        left = np.vstack([np.eye(2), -gain.numpy()])
        inside = np.block(
            [[weights.state.numpy(), weights.cross.numpy()], [weights.cross.numpy().T, weights.control.numpy()]]
        )
        return np.trace(inside @ left @ spread @ left.T)

    assert price(controller.gain) < price(naive) * (1 - 1e-5)


def test_cross_weights_reach_the_gain():
    cross = double([[0.3], [0.2]])
    with_cross = LQGController.design(DISCRETE, Q, W, SAMPLED.noise_covariance, R_SAMPLED, PRIOR, cross=cross)
    torch.testing.assert_close(with_cross.gain, lqr(DISCRETE, Q, W, cross).gain)
    assert not torch.allclose(with_cross.gain, discrete_controller().gain)
    sampled = LQGController.design(PLANT, Q, W, PSD, R_SAMPLED, PRIOR, B, PERIOD, cross)
    torch.testing.assert_close(sampled.gain, lqr(DISCRETE, *sampled_weights(PLANT, Q, W, PERIOD, cross)).gain)


def test_noise_input_and_any_filter_will_do():
    given = LQGController.design(DISCRETE, Q, W, double([[0.1]]), R_SAMPLED, PRIOR, B)
    whole = LQGController.design(DISCRETE, Q, W, 0.1 * B @ B.mT, R_SAMPLED, PRIOR)
    torch.testing.assert_close(given.observer.gain, whole.observer.gain, rtol=1e-9, atol=0)
    model = linear_model(DISCRETE, SAMPLED.noise_covariance, R_SAMPLED, PRIOR)
    recursive = LQGController(tf.KalmanFilter(model), discrete_controller().gain)
    constant = discrete_controller()
    one, other = recursive.init((3,)), constant.init((3,))
    for k in range(120):
        y = torch.full((3, 1), 0.1 * (k % 7), dtype=DOUBLE)
        one, u = recursive.step(one, y)
        other, v = constant.step(other, y)
    torch.testing.assert_close(u, v, rtol=1e-9, atol=1e-11)
    continuous = LuenbergerObserver(PLANT, place(A.mT, C.mT, double([-2.0, -3.0])).mT)
    controller = LQGController(continuous, lqr(PLANT, Q, W).gain)
    state, u = controller.step(controller.init(), double([1.0]), 0.01)
    torch.testing.assert_close(u, -(controller.gain @ state.estimate.belief.mean))


def test_the_first_measurement_and_the_first_control():
    controller = discrete_controller(tf.Gaussian(double([1.0, 0.0]), torch.eye(2, dtype=DOUBLE)))
    y = double([2.0])
    at_once, _ = controller.step(controller.init(), y, predict_first=False)
    expected = double([1.0, 0.0]) + controller.observer.gain[:, 0]
    torch.testing.assert_close(at_once.estimate.belief.mean, expected)
    pushed, _ = controller.step(controller.init(control=double([3.0])), y)
    plain, _ = controller.step(controller.init(), y)
    left = torch.eye(2, dtype=DOUBLE) - controller.observer.gain @ C
    moved = pushed.estimate.belief.mean - plain.estimate.belief.mean
    torch.testing.assert_close(moved, 3 * (left @ B_SAMPLED)[:, 0])


B_SAMPLED = DISCRETE.b


def test_a_missing_measurement_steers_by_the_prediction():
    controller = discrete_controller()
    state, _ = controller.step(controller.init((2,)), double([[1.0], [1.0]]))
    after, u = controller.step(state, double([[torch.nan], [0.5]]))
    predicted = DISCRETE.a @ state.estimate.belief.mean[0] + DISCRETE.b @ state.control[0]
    torch.testing.assert_close(after.estimate.belief.mean[0], predicted)
    torch.testing.assert_close(u[0], -controller.gain @ predicted)


def test_it_is_a_module():
    controller = discrete_controller()
    assert "gain" in controller.state_dict() and isinstance(controller.observer, SteadyStateKalmanFilter)
    small = discrete_controller().float()
    _, u = small.step(small.init((2,)), torch.ones(2, 1))
    assert u.dtype == torch.float32
    trained = LQGController(controller.observer, torch.nn.Parameter(controller.gain))
    _, u = trained.step(trained.init(), double([1.0]))
    u.sum().backward()
    assert trained.gain.grad is not None and trained.gain.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: LQGController(3, Q), TypeError, "observer must be a filter"),
        (lambda: LQGController(discrete_controller().observer, Q[0]), ValueError, r"gain must be \(k, d\)"),
        (
            lambda: LQGController(discrete_controller().observer, double([[1.0] * 3])),
            ValueError,
            r"d = 2, got .*\(1, 3\)",
        ),
        (
            lambda: LQGController(discrete_controller().observer, Q.float()),
            TypeError,
            "dtype torch.float64, got torch.fl",
        ),
        (
            lambda: LQGController(discrete_controller().observer, [[1.0, 2.0]]),
            TypeError,
            "gain must be a tensor .* list",
        ),
        (lambda: LQGController(discrete_controller().observer, Q / 0), ValueError, "gain must be finite"),
        (lambda: discrete_controller().init((2,), torch.zeros(1)), ValueError, r"control must be \(2, 1\)"),
        (lambda: LQGController.design(PLANT, Q, W, PSD, R, PRIOR, B), ValueError, "a continuous system needs dt"),
        (
            lambda: LQGController.design(DISCRETE, Q, W, PSD, R, PRIOR, B, 0.1),
            ValueError,
            "the system is discrete with dt = 0.5",
        ),
        (lambda: LQGController.design(ss(A, B, C, R), Q, W, PSD, R, PRIOR, B, 0.1), ValueError, "d must be zero"),
        (
            lambda: LQGController.design(DISCRETE, Q, -W, PSD, R, PRIOR, B),
            ValueError,
            "control_weight must be positive",
        ),
    ],
)
def test_errors(make, error, message):
    with pytest.raises(error, match=message):
        make()


INDEFINITE = double([[4.0, 0.0], [0.0, -0.1]])  # over half a second the whole is positive all the same


@pytest.mark.parametrize(
    ("weights", "error", "message"),
    [
        ((INDEFINITE, W), ValueError, "state_weight must be positive semidefinite, its lowest eigenvalue is -0.1"),
        ((double([[4.0, 1.0], [0.0, 1.0]]), W), ValueError, "state_weight must be symmetric"),
        ((Q.float(), W), TypeError, "state_weight must have the dtype of a"),
        ((torch.eye(3, dtype=DOUBLE), W), ValueError, "state_weight must be"),
        ((Q, 0 * W), ValueError, "control_weight must be positive definite, its lowest eigenvalue is 0"),
        ((Q, torch.eye(2, dtype=DOUBLE)), ValueError, r"control_weight must be \(\*batch, 1, 1\)"),
        ((Q, W, W), ValueError, r"cross must be \(\*batch, 2, 1\)"),
        ((Q, W, double([[5.0], [0.0]])), ValueError, r"\[\[state_weight, cross\].* must be positive semidefinite"),
    ],
)
def test_weights_are_looked_at_before_they_are_sampled(weights, error, message):
    state, control, *cross = weights
    with pytest.raises(error, match=message):
        sampled_weights(PLANT, state, control, PERIOD, *cross)
    with pytest.raises(error, match=message):
        LQGController.design(PLANT, state, control, PSD, R_SAMPLED, PRIOR, B, PERIOD, *cross)


def test_sampled_weights_of_a_batch_equal_a_loop():
    a, dt = torch.stack([A, A - torch.eye(2, dtype=DOUBLE)]), double([0.2, 0.7])
    cross = double([[[0.1], [0.0]], [[0.0], [0.2]]])
    batch = sampled_weights(ss(a, B, C), Q, W, dt, cross)
    for row in range(2):
        system = ss(a[row], B, C).to_control()
        for whole, one in zip(batch, sampled_weights(system, Q, W, float(dt[row]), cross[row]), strict=True):
            torch.testing.assert_close(whole[row], one, rtol=1e-13, atol=1e-15)
    with pytest.raises(ValueError, match=r"this one is discrete with dt = 0\.5"):
        sampled_weights(DISCRETE, Q, W, PERIOD)
    with pytest.raises(ValueError, match=r"dt must be positive and finite, .* got -1"):
        sampled_weights(PLANT, Q, W, -1.0)


def test_the_pages_examples_run():
    """docs/linear_systems.md, one block after the other, each with its own assertions."""
    text = (Path(__file__).parents[2] / "docs/linear_systems.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(blocks) == 5 and all("assert" in block for block in blocks)
    names = {}
    for block in blocks:
        exec(compile(block, "docs/linear_systems.md", "exec"), names)
