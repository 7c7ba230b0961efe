"""Pole placement, stationary Kalman filter, LQR and LQG: numbers of the notes, python-control, SciPy; errors."""

import control as ct
import numpy as np
import pytest
import scipy.linalg
import torch

from torchfilt.models.control import c2d, kalman, lqgr, lqr, place, poles, ss

DOUBLE, SINGLE = torch.float64, torch.float32
DTYPES = pytest.mark.parametrize("dtype", [DOUBLE, SINGLE])
# Gains of well-conditioned problems: sensitivity of the Riccati equation below 1e4.
CLOSE = {DOUBLE: 1e-11, SINGLE: 2e-4}
PRINTED = 6e-12  # half a unit of the last digit that the notes' oracle gives


def tensor(value, dtype=DOUBLE):
    return torch.tensor(value, dtype=dtype)


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def in_order(values, digits=9):
    return np.sort_complex(np.round(np.asarray(values), digits))


def double_integrator(dtype=DOUBLE):
    return ss(tensor([[0, 1], [0, 0]], dtype), [[0], [1]], [[1, 0]])


def random_problem(seed, dt=None, lead=(), states=4, controls=2, outputs=2):
    """A system with unstable modes, weights with a cross term and noises, all of them full."""
    sizes = ((states, states), (states, controls), (outputs, states), (states + controls,) * 2, (states, 3))
    a, b, c, w, f = (normal(*lead, *size, seed=10 * seed + k) for k, size in enumerate(sizes))
    weight = w @ w.mT
    q, n, r = weight[..., :states, :states], weight[..., :states, states:], weight[..., states:, states:]
    v = normal(*lead, outputs, outputs, seed=10 * seed + 7)
    noise = torch.diag(tensor([0.5, 1.0, 2.0]))
    return ss(a, b, c, dt=dt), q, r, n, f, noise, v @ v.mT + 0.1 * torch.eye(outputs, dtype=DOUBLE)


def arrays(*tensors):
    return [t.double().numpy() for t in tensors]


# Pole placement -------------------------------------------------------------------------------------------------------


@DTYPES
def test_observers_of_the_notes(dtype):
    """L = [5, 6] of the double integrator; L = [4.5, 6.5, -3] of the chain where the bias enters with a minus sign."""
    tolerance = 100 * torch.finfo(dtype).eps
    system = double_integrator(dtype)
    gain = place(system.a.mT, system.c.mT, [-2, -3]).mT
    assert gain.dtype == dtype
    np.testing.assert_allclose(gain, [[5], [6]], rtol=tolerance)
    np.testing.assert_allclose(place(system.a.mT, system.c.mT, [-0.1, -0.3]).mT, [[0.4], [0.03]], rtol=tolerance)
    chain = tensor([[0.0, 1, 0], [0, 0, -1], [0, 0, 0]], dtype)
    gain = place(chain.mT, tensor([[1.0], [0], [0]], dtype), [-1, -1.5, -2]).mT
    np.testing.assert_allclose(gain, [[4.5], [6.5], [-3]], rtol=tolerance)


@pytest.mark.parametrize("inputs", [1, 2, 4])
@pytest.mark.parametrize("wished", [[-1, -2, -3, -4.5], [-1.1 + 2j, -1.1 - 2j, -3, -0.3]])
def test_poles_are_placed_where_python_control_places_them(inputs, wished):
    """With one input the gain is unique."""
    a, b = normal(4, 4, seed=1), normal(4, inputs, seed=2)
    gain = place(a, b, wished)
    np.testing.assert_allclose(in_order(poles(ss(a - b @ gain, b)), 8), in_order(wished, 8), rtol=0, atol=1e-8)
    if inputs == 1:
        np.testing.assert_allclose(gain, ct.place(*arrays(a, b), wished), rtol=1e-9)
        np.testing.assert_allclose(gain, ct.acker(*arrays(a, b), wished)[None], rtol=1e-9)


def test_a_pole_may_be_repeated_as_often_as_there_are_inputs():
    a, b = normal(4, 4, seed=3), normal(4, 2, seed=4)
    found = poles(ss(a - b @ place(a, b, [-1, -1, -2, -2]), b))
    np.testing.assert_allclose(in_order(found, 6), [-2, -2, -1, -1], rtol=0, atol=1e-6)


def test_each_row_of_a_batch_has_its_poles():
    a, b = normal(3, 3, 3, seed=5), normal(3, 1, seed=6)
    wished = tensor([[-1.0, -2, -3], [-2, -3, -4], [-3, -4, -5]])
    gain = place(a, b, wished)
    assert gain.shape == (3, 1, 3)
    for i in range(3):
        np.testing.assert_allclose(gain[i], ct.acker(*arrays(a[i], b), wished[i].numpy())[None], rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(place(a, b, wished[0])[0], gain[0])


def fixed_mode():
    """A mode at -0.7 and one pair at ±2 i out of reach of the input, hidden by a change of coordinates."""
    a = torch.zeros(5, 5, dtype=DOUBLE)
    a[:2, :2] = tensor([[0.0, 1], [3, 1]])
    a[:2, 2:] = normal(2, 3, seed=7)
    a[2, 2], a[3, 4], a[4, 3] = -0.7, 2.0, -2.0
    b = torch.zeros(5, 1, dtype=DOUBLE)
    b[1] = 1
    basis = torch.eye(5, dtype=DOUBLE) + 0.2 * normal(5, 5, seed=8)
    return basis @ a @ torch.linalg.inv(basis), basis @ b


def test_modes_out_of_reach_may_be_among_the_poles():
    a, b = fixed_mode()
    wished = [-0.7, -4, 2j, -2j, -5]
    found = poles(ss(a - b @ place(a, b, wished), b))
    np.testing.assert_allclose(in_order(found, 7), in_order(wished, 7), rtol=0, atol=1e-7)
    assert not place(a, 0 * b, poles(ss(a, b))).any()


@pytest.mark.parametrize(
    "wished, message",
    [
        ([-1, -2, -3, -4, -5], r"the input cannot move the mode .*and it is not among the poles -"),
        ([2j, -2j, -3, -4, -5], r"the input cannot move the mode -0.7 \(rank \[A - s I, B\] < d there"),
        ([-0.7, -2, -3, -4, -5], r"the input cannot move the mode [-+0-9.e]+\+2j "),
    ],
)
def test_a_mode_out_of_reach_is_named(wished, message):
    with pytest.raises(ValueError, match=message):
        place(*fixed_mode(), wished)


INTEGRATORS = (tensor([[0.0, 1], [0, 0]]), tensor([[0.0], [1]]))


@pytest.mark.parametrize(
    "wished, message",
    [
        ([-1, -1], r"the pole -1 is wished for 2 times, more often than B has independent columns, which is 1"),
        ([-1, -2 + 1j], r"complex poles come in conjugate pairs, -2\+1j has none among -1, -2\+1j"),
        ([-1], r"poles must be 2 numbers, one a state, got shape \(1,\)"),
        (-1.0, r"poles must be 2 numbers, one a state, got shape \(\)"),
        ([-1, torch.inf], r"poles must be finite, got -1, inf"),
    ],
)
def test_poles_that_cannot_be(wished, message):
    with pytest.raises(ValueError, match=message):
        place(*INTEGRATORS, wished)


def test_poles_that_rounding_alone_would_move_are_refused():
    """Thirty states in a row behind one input, all to be made as fast as the first."""
    a = torch.diag(torch.full((29,), 1.0, dtype=DOUBLE), -1) + normal(30, 30, seed=9) / 10
    with pytest.raises(ValueError, match=r"are too sensitive to be placed in float64: they come out at .*, off by"):
        place(a, torch.eye(30, 1, dtype=DOUBLE), -torch.linspace(1, 2, 30, dtype=DOUBLE))


def test_the_row_of_the_batch_is_named():
    a = torch.stack([INTEGRATORS[0], torch.zeros(2, 2, dtype=DOUBLE)])
    with pytest.raises(ValueError, match=r"the mode 0 .*at row \(1,\) of the batch"):
        place(a, INTEGRATORS[1], [-1, -2])


# Kalman filter --------------------------------------------------------------------------------------------------------


@DTYPES
def test_stationary_filter_of_the_notes(dtype):
    """The double integrator has a closed form: with w² = sqrt(Q / R), L = (sqrt(2) w, w²)."""
    design = kalman(
        double_integrator(dtype), *[tensor([[v]], dtype) for v in (0.04, 0.25)], tensor([[0.0], [1]], dtype)
    )
    tolerance = {DOUBLE: PRINTED, SINGLE: 1e-6}[dtype]
    for ours, expected in (
        (design.covariance, [[0.223606797750, 0.1], [0.1, 0.0894427191]]),
        (design.gain, [[0.894427191], [0.4]]),
    ):
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours, expected, rtol=0, atol=max(tolerance, 5e-11))
    assert torch.equal(design.posterior, design.covariance)
    assert design.poles.dtype == dtype.to_complex()
    np.testing.assert_allclose(
        in_order(design.poles, 6 if dtype == SINGLE else 12),
        in_order([-0.4472135955 - 0.4472135955j, -0.4472135955 + 0.4472135955j], 6 if dtype == SINGLE else 12),
        rtol=0,
        atol=2e-6 if dtype == SINGLE else 5e-11,
    )


@DTYPES
def test_discrete_filter_of_the_notes(dtype):
    step = c2d(double_integrator(dtype), 0.5, tensor([[0.04]], dtype), tensor([[0.0], [1]], dtype))
    design = kalman(step.system, step.noise_covariance, tensor([[0.5]], dtype))
    for ours, expected in (
        (design.covariance, [[0.28197291505, 0.12505781983], [0.12505781983, 0.10018961483]]),
        (design.gain, [[0.36059166453], [0.15992602483]]),
        (design.posterior, [[0.18029583226, 0.07996301242], [0.07996301242, 0.08018961483]]),
    ):
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours, expected, rtol=0, atol={DOUBLE: PRINTED, SINGLE: 1e-6}[dtype])


def settle(transition, noise, c, r, steps):
    """The recursion of the covariance, predicted one, from the identity."""
    covariance = np.eye(len(noise))
    for _ in range(steps):
        predicted = transition @ covariance @ transition.T + noise
        gain = predicted @ c.T / (c @ predicted @ c.T + r)
        covariance = (np.eye(len(noise)) - gain @ c) @ predicted
    return predicted


def test_the_recursion_settles_to_the_design_and_the_printed_one_to_nothing():
    """P = Φ P Φᵀ + Q. With the notes' Φᵀ P Φ + Q the variance of the velocity grows by 0.13 a step without end."""
    step = c2d(double_integrator(), 0.5, tensor([[0.04]]), tensor([[0.0], [1]]))
    a, c, noise = arrays(step.system.a, step.system.c, step.noise_covariance)
    design = kalman(step.system, step.noise_covariance, tensor([[0.5]]))
    np.testing.assert_allclose(settle(a, noise, c, 0.5, 200), design.covariance, rtol=0, atol=1e-13)
    thousand, two = (settle(a.T, noise, c, 0.5, steps)[1, 1] for steps in (1000, 2000))
    assert thousand > 1000 * design.covariance[1, 1]
    assert two / thousand == pytest.approx(2, rel=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_continuous_filters_equal_python_control(seed):
    system, _, _, _, f, q, r = random_problem(seed)
    design = kalman(system, q, r, f)
    gain, covariance, found = ct.lqe(*arrays(system.a, f, system.c, q, r), method="scipy")
    np.testing.assert_allclose(design.gain, gain, rtol=0, atol=CLOSE[DOUBLE] * np.abs(gain).max())
    np.testing.assert_allclose(design.covariance, covariance, rtol=0, atol=CLOSE[DOUBLE] * np.abs(covariance).max())
    np.testing.assert_allclose(in_order(design.poles, 7), in_order(found, 7), rtol=0, atol=2e-7)
    a, c, p, w = arrays(system.a, system.c, design.covariance, f @ q @ f.mT)
    residual = a @ p + p @ a.T + w - p @ c.T @ np.linalg.solve(r.numpy(), c @ p)
    assert np.abs(residual).max() < 1e-11 * np.abs(p).max() * max(1, np.abs(a).max(), np.abs(gain).max())
    single = kalman(ss(system.a.float(), system.b.float(), system.c.float()), q.float(), r.float(), f.float())
    np.testing.assert_allclose(single.gain, gain, rtol=0, atol=CLOSE[SINGLE] * np.abs(gain).max())


@pytest.mark.parametrize("seed", range(4))
def test_discrete_filters_equal_python_control(seed):
    """python-control's gain is of the predicted state: A K."""
    system, _, _, _, f, q, r = random_problem(seed, dt=0.1)
    design = kalman(system.to_control(), q, r, f)
    gain, covariance, found = ct.dlqe(*arrays(system.a, f, system.c, q, r), method="scipy")
    tolerance = CLOSE[DOUBLE] * np.abs(covariance).max()
    np.testing.assert_allclose(system.a @ design.gain, gain, rtol=0, atol=100 * CLOSE[DOUBLE] * np.abs(gain).max())
    np.testing.assert_allclose(design.covariance, covariance, rtol=0, atol=tolerance)
    np.testing.assert_allclose(in_order(design.poles, 7), in_order(found, 7), rtol=0, atol=2e-7)
    a, c, p = arrays(system.a, system.c, design.posterior)
    again = a @ p @ a.T + (f @ q @ f.mT).numpy()
    np.testing.assert_allclose(again, design.covariance, rtol=0, atol=10 * tolerance)
    information = np.linalg.inv(covariance) + c.T @ np.linalg.solve(r.numpy(), c)
    np.testing.assert_allclose(np.linalg.inv(p), information, rtol=0, atol=1e-7 * np.abs(information).max())


@pytest.mark.parametrize("dt", [None, 0.1])
def test_batches_of_designs_equal_a_loop(dt):
    """Rows of the systems and of the weights, and rows of the noise alone."""
    system, q, r, n, f, w, v = random_problem(2, dt, lead=(2, 3))
    v = v[0]
    batch = lqgr(system, q, r, w, v, f, n)
    assert batch.cost.shape == (2, 3) and batch.closed_loop.batch_shape == (2, 3) and batch.closed_loop.dt == dt
    for i, j in np.ndindex(2, 3):
        row = ss(system.a[i, j], system.b[i, j], system.c[i, j], dt=dt)
        one = lqgr(row, q[i, j], r[i, j], w, v[j], f[i, j], n[i, j])
        pairs = [*zip(batch.regulator, one.regulator, strict=True), *zip(batch.kalman, one.kalman, strict=True)]
        for ours, expected in pairs:
            np.testing.assert_array_equal(ours[i, j], expected)
        np.testing.assert_allclose(batch.cost[i, j], one.cost, rtol=1e-13)
        scale = one.closed_loop.a.abs().max().item()
        np.testing.assert_allclose(batch.closed_loop.a[i, j], one.closed_loop.a, rtol=0, atol=1e-14 * scale)
    one = kalman(double_integrator(), torch.eye(2, dtype=DOUBLE), tensor([[[1.0]], [[2.0]]]))
    assert one.gain.shape == (2, 2, 1)


def test_states_of_a_design_have_units_of_their_own():
    """Noise and measurements that differ by 1e18 in unit are no reason to refuse."""
    system = ss(torch.zeros(2, 2, dtype=DOUBLE), torch.zeros(2, 0, dtype=DOUBLE))
    q, r = tensor([1e-18, 1.0]), tensor([1e-16, 1e4])
    design = kalman(system, torch.diag(q), torch.diag(r))
    np.testing.assert_allclose(design.gain.diagonal(), (q / r).sqrt(), rtol=1e-9)


@DTYPES
def test_modes_that_decay_need_not_be_seen_nor_driven(dtype):
    """Slow biases of 1000 s beside a rate of 10 /s; one is seen but not driven, the other driven but not seen."""
    a = torch.diag(tensor([-10.0, -1e-3, -1e-3], dtype))
    system = ss(a, torch.zeros(3, 0, dtype=dtype), tensor([[1.0, 1, 0]], dtype))
    design = kalman(system, torch.diag(tensor([1.0, 0, 1e-4], dtype)), tensor([[0.1]], dtype))
    np.testing.assert_allclose(design.gain[1:], 0, atol=1e-6)
    np.testing.assert_allclose(design.covariance[2, 2], 1e-4 / 2e-3, rtol=1e-5)


def test_a_chain_of_equal_modes_that_decay_need_not_be_seen():
    """Its eigenvalue is known to the cube root of the precision only, which is far from lasting for ever."""
    chain = torch.diag(tensor([-1.0] * 3)) + torch.diag(tensor([1.0] * 2), 1)
    system = ss(torch.block_diag(chain, tensor([[0.5]])), torch.zeros(4, 0, dtype=DOUBLE), tensor([[0.0, 0, 0, 1]]))
    design = kalman(system, torch.eye(4, dtype=DOUBLE), tensor([[1.0]]))
    # The chain takes no part: a filter of the last state alone, 2 a p + 1 - p^2 = 0.
    np.testing.assert_allclose(design.gain[:, 0], [0, 0, 0, 0.5 + 1.25**0.5], rtol=1e-12, atol=1e-12)


def oscillators(turn=True):
    """Undamped modes at ±2 i, ±3 i, and an integrator, in skew coordinates."""
    a = torch.block_diag(*[tensor([[0.0, w], [-w, 0]]) for w in (2, 3)], tensor([[0.0]]))
    basis = torch.eye(5, dtype=DOUBLE) + 0.2 * normal(5, 5, seed=3) * turn
    return a, basis


def discrete(a):
    return torch.linalg.matrix_exp(0.1 * a)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_a_mode_that_is_not_seen_is_named(dt):
    a, basis = oscillators()
    a = discrete(a) if dt else a
    c = tensor([[1.0, 0, 0, 0, 0], [0, 0, 0, 0, 1]]) @ torch.linalg.inv(basis)
    system = ss(basis @ a @ torch.linalg.inv(basis), torch.zeros(5, 0, dtype=DOUBLE), c, dt=dt)
    with pytest.raises(ValueError, match=r"do not see the modes .*, which do not decay .*not detectable") as caught:
        kalman(system, torch.eye(5, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
    wanted = ["0.955336+0.29552j", "0.955336-0.29552j"] if dt else ["+3j", "-3j"]
    assert all(mode in str(caught.value) for mode in wanted), caught.value
    assert str(caught.value).count("j") == 2


@pytest.mark.parametrize("dt", [None, 1.0])
@pytest.mark.parametrize("seed", range(12))
def test_a_hidden_mode_is_named_in_any_coordinates(dt, seed):
    """Up to seven growing modes; rounding of the hidden one must not be taken for something seen."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(4, 8))
    modes = np.sort(rng.uniform(1.2, 3.0, d))
    basis, hidden = rng.normal(size=(d, d)), int(rng.integers(d))
    row = rng.normal(size=(1, d)) * (np.arange(d) != hidden)
    a = torch.tensor(basis @ np.diag(modes) @ np.linalg.inv(basis))
    c = torch.tensor(row @ np.linalg.inv(basis))
    one, weight = torch.eye(d, dtype=DOUBLE), tensor([[1.0]])
    calls = [
        lambda: kalman(ss(a, torch.zeros(d, 0, dtype=DOUBLE), c, dt=dt), one, weight),
        lambda: lqr(ss(a.mT, c.mT, dt=dt), one, weight),
        lambda: place(a.mT, c.mT, -np.arange(1.0, d + 1)),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r"(do not see|does not move|cannot move) the mode [0-9.]+[ ,]") as caught:
            call()
        named = float(str(caught.value).split("the mode ")[1].split()[0].rstrip(","))
        assert abs(named - modes[hidden]) < 1e-5


@pytest.mark.parametrize(("dt", "first"), [(None, 100.0), (1.0, 30.0)])
def test_a_solution_that_does_not_stabilize_is_refused(dt, first):
    """Five growing modes, near to each other, with one input: the feedback is beyond sixteen digits."""
    system = ss(torch.diag(first + torch.arange(5.0, dtype=DOUBLE)), torch.ones(5, 1, dtype=DOUBLE), dt=dt)
    one, weight = torch.eye(5, dtype=DOUBLE), tensor([[1.0]])
    # Which of the two is found first is a matter of rounding in SciPy.
    message = r"the Riccati equation (is too sensitive .* the mode [0-9.]+ does not decay|has no stabilizing solution)"
    with pytest.raises(ValueError, match=message):
        lqr(system, one, weight)
    with pytest.raises(ValueError, match=message):
        kalman(ss(system.a, system.b, system.b.mT, dt=dt), one, weight)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_an_undamped_mode_that_no_noise_reaches_is_named(dt):
    a, basis = oscillators()
    a = discrete(a) if dt else a
    f = basis @ tensor([[1.0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    system = ss(basis @ a @ torch.linalg.inv(basis), torch.zeros(5, 0, dtype=DOUBLE), dt=dt)
    message = r"process noise does not reach the mode (1|[-0-9.e]+), undamped, so that the gain there goes to zero"
    with pytest.raises(ValueError, match=message):
        kalman(system, torch.eye(3, dtype=DOUBLE), torch.eye(5, dtype=DOUBLE), f)


def test_chains_of_undamped_modes_are_found_though_rounding_splits_them():
    """A double integrator, in skew coordinates, that is neither driven nor seen: eigenvalues of ±1e-8."""
    a = torch.block_diag(tensor([[0.0, 1], [0, 0]]), tensor([[-1.0]]))
    basis = torch.eye(3, dtype=DOUBLE) + 0.2 * normal(3, 3, seed=13)
    a, last = basis @ a @ torch.linalg.inv(basis), tensor([[0.0, 0, 1]])
    noise, one = tensor([[1.0]]), torch.eye(3, dtype=DOUBLE)
    seen = ss(a, torch.zeros(3, 0, dtype=DOUBLE))
    with pytest.raises(ValueError, match=r"process noise does not reach the modes .*, .*, undamped"):
        kalman(seen, noise, one, basis @ last.mT)
    hidden = ss(a, torch.zeros(3, 0, dtype=DOUBLE), last @ torch.linalg.inv(basis))
    with pytest.raises(ValueError, match=r"measurements do not see the modes .*, .*, which do not decay"):
        kalman(hidden, one, noise)


ONE = tensor([[1.0]])
DRIVEN = INTEGRATORS[1]


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ((-ONE, ONE, DRIVEN), ValueError, r"process_noise must be positive semidefinite, its lowest eigenvalue is -1"),
        ((ONE, -ONE, DRIVEN), ValueError, r"measurement_noise must be positive semidefinite.*-1"),
        (
            (ONE, 0 * ONE, DRIVEN),
            ValueError,
            r"measurement_noise must be positive definite, its lowest eigenvalue is 0",
        ),
        ((ONE, torch.eye(2, dtype=DOUBLE), DRIVEN), ValueError, r"measurement_noise must be \(\*batch, 1, 1\), got"),
        ((ONE, ONE.float(), DRIVEN), TypeError, r"measurement_noise must have the dtype of a"),
        ((ONE * torch.nan, ONE, DRIVEN), ValueError, r"process_noise must be finite, got nan"),
        ((ONE, ONE), ValueError, r"process_noise must be \(\*batch, 2, 2\) or come with noise_input"),
        ((ONE, ONE, DRIVEN.mT), ValueError, r"noise_input must be \(\*batch, 2, 1\)"),
        ((ONE, ONE, tensor([[1.0], [0]])), ValueError, r"process noise does not reach the mode 0, undamped"),
    ],
)
def test_errors_of_the_filter(arguments, error, message):
    with pytest.raises(error, match=message):
        kalman(double_integrator(), *arguments)


def test_measurement_noise_of_dependent_sensors_is_not_definite():
    system = ss(INTEGRATORS[0], DRIVEN)
    with pytest.raises(ValueError, match=r"measurement_noise must be positive definite, its lowest eigenvalue is"):
        kalman(system, ONE, tensor([[1.0, 1], [1, 1]]), DRIVEN)


# Regulator ------------------------------------------------------------------------------------------------------------


@DTYPES
def test_regulators_of_the_notes(dtype):
    system = double_integrator(dtype)
    weights = torch.diag(tensor([4.0, 1.0], dtype)), tensor([[0.5]], dtype)
    tolerance = {DOUBLE: PRINTED, SINGLE: 2e-6}[dtype]
    design = lqr(system, *weights)
    assert design.gain.dtype == design.cost.dtype == dtype
    np.testing.assert_allclose(design.gain, [[2.82842712475, 2.76710213933]], rtol=0, atol=tolerance)
    np.testing.assert_allclose(design.poles.real, [-1.38355] * 2, rtol=0, atol=5e-6)
    np.testing.assert_allclose(design.poles.imag.abs(), [0.95615] * 2, rtol=0, atol=5e-6)
    sampled = lqr(c2d(system, 0.5).system, *weights)
    np.testing.assert_allclose(sampled.gain, [[1.43844718719, 1.84232921921]], rtol=0, atol=tolerance)


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_regulators_equal_python_control(seed, dt):
    system, q, r, n, *_ = random_problem(seed, dt)
    solve = ct.dlqr if dt else ct.lqr
    for cross in (None, n):
        design = lqr(system, q, r, cross)
        extra = [] if cross is None else [n.numpy()]
        gain, cost, found = solve(*arrays(system.a, system.b, q, r), *extra, method="scipy")
        # With a cross term the weights are one full matrix: the pencil's conditioning adds a factor of ten.
        np.testing.assert_allclose(design.gain, gain, rtol=0, atol=1e-10 * np.abs(gain).max())
        np.testing.assert_allclose(design.cost, cost, rtol=0, atol=1e-10 * np.abs(cost).max())
        np.testing.assert_allclose(in_order(design.poles, 7), in_order(found, 7), rtol=0, atol=2e-7)


def test_the_cost_to_go_is_what_a_run_costs():
    """A run of the discrete loop with a cross weight, added up."""
    system, q, r, n, *_ = random_problem(1, 0.1)
    design = lqr(system, q, r, n)
    x = normal(4, seed=2)
    start, total = x, 0.0
    for _ in range(400):
        u = -design.gain @ x
        total = total + x @ q @ x + u @ r @ u + 2 * x @ n @ u
        x = system.a @ x + system.b @ u
    np.testing.assert_allclose(total, start @ design.cost @ start, rtol=1e-10)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_errors_of_the_regulator_name_the_mode(dt):
    a, basis = oscillators()
    a, inverse = (discrete(a) if dt else a), torch.linalg.inv(basis)
    full, b = torch.eye(5, dtype=DOUBLE), basis @ tensor([[1.0], [0], [0], [0], [1]])
    with pytest.raises(
        ValueError, match=r"the input does not move the modes .*do not decay .*A, B is not stab"
    ) as found:
        lqr(ss(basis @ a @ inverse, b, dt=dt), full, ONE)
    assert ("0.955336+0.29552j" if dt else "+3j") in str(found.value)
    weight = inverse.mT @ torch.diag(tensor([1.0, 0, 0, 0, 1])) @ inverse
    with pytest.raises(ValueError, match=r"the cost does not see the modes .*, undamped") as found:
        lqr(ss(basis @ a @ inverse, full, dt=dt), weight, full)
    assert ("0.955336+0.29552j" if dt else "+3j") in str(found.value)


def test_a_cross_weight_can_hide_an_undamped_mode():
    """Of x' = u with cost (x + u)²: u = -x costs nothing, and what it leaves is stable; of (x - u)², unstable."""
    system = ss(tensor([[0.0]]), ONE)
    design = lqr(system, ONE, ONE, ONE)
    np.testing.assert_allclose([design.gain.item(), design.cost.item()], [1, 0], rtol=0, atol=1e-12)
    design = lqr(system, ONE, ONE, -ONE)  # the free feedback u = x grows: 2 x must be spent to turn it round
    np.testing.assert_allclose([design.gain.item(), design.cost.item()], [1, 2], rtol=1e-12)
    with pytest.raises(ValueError, match=r"the cost does not see the mode 0, undamped"):
        lqr(ss(ONE, ONE), ONE, ONE, ONE)


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ((-torch.eye(2, dtype=DOUBLE), ONE), ValueError, r"state_weight must be positive semidefinite.*is -1"),
        ((torch.eye(2, dtype=DOUBLE), -ONE), ValueError, r"control_weight must be positive semidefinite.*is -1"),
        ((torch.eye(2, dtype=DOUBLE), 0 * ONE), ValueError, r"control_weight must be positive definite.*is 0"),
        ((ONE, ONE), ValueError, r"state_weight must be \(\*batch, 2, 2\)"),
        (
            (torch.eye(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE)),
            ValueError,
            r"control_weight must be \(\*batch, 1, 1\)",
        ),
        ((torch.eye(2, dtype=DOUBLE), ONE, ONE), ValueError, r"cross must be \(\*batch, 2, 1\), got shape \(1, 1\)"),
        ((torch.eye(2, dtype=DOUBLE), ONE, DRIVEN.float()), TypeError, r"cross must have the dtype of a"),
        (
            (torch.eye(2, dtype=DOUBLE), ONE, 2 * DRIVEN),
            ValueError,
            r"\[\[state_weight, cross\], \[cross\^T, control_weight\]\] must be positive semidefinite.*is -1",
        ),
    ],
)
def test_weights_that_cannot_be(arguments, error, message):
    with pytest.raises(error, match=message):
        lqr(double_integrator(), *arguments)


# Both together --------------------------------------------------------------------------------------------------------


def stationary(loop, w, v, q, r, n):
    """Expected cost from the covariance of the closed loop, by Lyapunov."""
    a, b, c, d = arrays(loop.a, loop.b, loop.c, loop.d)
    noise = scipy.linalg.block_diag(w, v)
    pushed = b @ noise @ b.T
    solve = scipy.linalg.solve_discrete_lyapunov if loop.is_discrete else scipy.linalg.solve_continuous_lyapunov
    covariance = solve(a, pushed if loop.is_discrete else -pushed)
    states, controls = len(q), len(r)
    u, direct = c[-controls:], d[-controls:]
    own = u @ covariance @ u.T + direct @ noise @ direct.T
    shared = covariance[:states] @ u.T
    return np.trace(q @ covariance[:states, :states]) + np.trace(r @ own) + 2 * np.trace(n.T @ shared)


def test_lqg_of_the_notes_costs_the_same_by_three_formulas():
    q, r, w, v = torch.diag(tensor([4.0, 1.0])), tensor([[0.5]]), tensor([[0.04]]), tensor([[0.25]])
    design = lqgr(double_integrator(), q, r, w, v, DRIVEN)
    expected = 2.07484884048
    assert design.cost.item() == pytest.approx(expected, abs=PRINTED)
    s, p, l = arrays(design.regulator.cost, design.kalman.covariance, design.kalman.gain)
    dual = np.trace(p @ q.numpy()) + np.trace(s @ l @ v.numpy() @ l.T)
    assert dual == pytest.approx(expected, abs=PRINTED)
    by_lyapunov = stationary(design.closed_loop, *arrays(w, v, q, r), np.zeros((2, 1)))
    assert by_lyapunov == pytest.approx(expected, abs=PRINTED)


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_cost_and_separation(dt, seed):
    """The closed loop has the poles of both designs, and the cost of its covariance."""
    system, q, r, n, f, w, v = random_problem(seed, dt)
    if dt is None:
        system = ss(system.a, system.b, system.c, normal(2, 2, seed=99))
    design = lqgr(system, q, r, w, v, f, n)
    union = np.concatenate([design.regulator.poles, design.kalman.poles])
    scale = np.abs(union).max()
    np.testing.assert_allclose(in_order(poles(design.closed_loop), 6), in_order(union, 6), rtol=0, atol=2e-6 * scale)
    expected = stationary(design.closed_loop, *arrays(w, v, q, r, n))
    np.testing.assert_allclose(design.cost, expected, rtol=1e-9)
    np.testing.assert_array_equal(design.regulator.gain, lqr(system, q, r, n).gain)
    np.testing.assert_array_equal(design.kalman.gain, kalman(system, w, v, f).gain)


def test_noise_enters_all_states_unless_told():
    system, q, r, _, _, _, v = random_problem(0)
    noise = torch.eye(4, dtype=DOUBLE)
    one, other = lqgr(system, q, r, noise, v), lqgr(system, q, r, noise, v, noise)
    np.testing.assert_array_equal(one.cost, other.cost)
    np.testing.assert_array_equal(one.closed_loop.b, other.closed_loop.b)


def test_the_discrete_loop_is_what_filter_and_controller_do():
    """Answers of state and control to kicks of each noise, from the equations of the filter step by step."""
    system, q, r, _, f, w, v = random_problem(3, 0.1)
    design = lqgr(system, q, r, w, v, f)
    a, b, c, f, k, l = arrays(system.a, system.b, system.c, f, design.regulator.gain, design.kalman.gain)
    loop = design.closed_loop
    la, lb, lc, ld = arrays(loop.a, loop.b, loop.c, loop.d)
    rng = np.random.default_rng(0)
    x, predicted, z = np.zeros(4), np.zeros(4), np.zeros(8)
    for _ in range(20):
        kick_w, kick_v = rng.normal(size=3), rng.normal(size=2)
        estimate = predicted + l @ (c @ x + kick_v - c @ predicted)
        u = -k @ estimate
        kick = np.concatenate([kick_w, kick_v])
        np.testing.assert_allclose(lc @ z + ld @ kick, np.concatenate([c @ x, u]), rtol=0, atol=1e-9)
        np.testing.assert_allclose(z, np.concatenate([x, x - predicted]), rtol=0, atol=1e-9)
        x, predicted = a @ x + b @ u + f @ kick_w, a @ estimate + b @ u
        z = la @ z + lb @ kick


def test_the_continuous_loop_is_plant_observer_and_feedback():
    """The loop in (x, x̂), written by the definitions, in other coordinates; D does not reach the estimate."""
    system, q, r, _, f, w, v = random_problem(3)
    system = ss(system.a, system.b, system.c, normal(2, 2, seed=98))
    design = lqgr(system, q, r, w, v, f)
    a, b, c, d, f, k, l = arrays(system.a, system.b, system.c, system.d, f, design.regulator.gain, design.kalman.gain)
    direct = np.block([[a, -b @ k], [l @ c, a - b @ k - l @ c]])
    push = np.block([[f, np.zeros((4, 2))], [np.zeros((4, 3)), l]])
    look = np.block([[c, -d @ k], [np.zeros((2, 4)), -k]])
    turn = np.block([[np.eye(4), np.zeros((4, 4))], [np.eye(4), -np.eye(4)]])  # (x, x̂) to (x, e), its own inverse
    loop = design.closed_loop
    for ours, expected in ((loop.a, turn @ direct @ turn), (loop.b, turn @ push), (loop.c, look @ turn)):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert not loop.d.any() and loop.dt is None


def test_single_precision_goes_through():
    system, q, r, n, f, w, v = random_problem(0)
    expected = lqgr(system, q, r, w, v, f, n)
    system = ss(system.a.float(), system.b.float(), system.c.float())
    design = lqgr(system, q.float(), r.float(), w.float(), v.float(), f.float(), n.float())
    assert design.cost.dtype == design.closed_loop.a.dtype == SINGLE
    np.testing.assert_allclose(design.cost, expected.cost, rtol=CLOSE[SINGLE])


def test_a_discrete_plant_whose_measurement_needs_the_control_is_refused():
    system = ss(*INTEGRATORS, tensor([[1.0, 0]]), ONE, dt=0.1)
    with pytest.raises(ValueError, match=r"d must be zero in discrete time"):
        lqgr(system, torch.eye(2, dtype=DOUBLE), ONE, ONE, ONE, DRIVEN)
