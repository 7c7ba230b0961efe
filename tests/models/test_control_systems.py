"""Linear systems: values and their errors, poles, zeros, the map, and discretisation against SciPy and closed forms."""

import control as ct
import numpy as np
import pytest
import scipy.linalg
import torch
from matplotlib.figure import Figure
from scipy.integrate import quad_vec
from scipy.signal import cont2discrete

from torchfilt.models.control import (
    StateSpace,
    as_system,
    c2d,
    eig,
    hold_input,
    integrate_noise,
    pinv,
    poles,
    pzmap,
    ss,
    zeros,
)

DOUBLE, SINGLE = torch.float64, torch.float32
EPS = np.finfo(float).eps
DTYPES = pytest.mark.parametrize("dtype", [DOUBLE, SINGLE])


def tensor(value, dtype=DOUBLE):
    return torch.tensor(value, dtype=dtype)


def normal(*shape, seed=0, dtype=DOUBLE):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE).to(dtype)


def double_integrator(dtype=DOUBLE):
    return ss(tensor([[0, 1], [0, 0]], dtype), [[0], [1]], [[1, 0]])


def random_system(states=4, controls=2, outputs=3, seed=0, lead=()):
    shapes = [(states, states), (states, controls), (outputs, states), (outputs, controls)]
    return ss(*[normal(*lead, *shape, seed=seed + k) for k, shape in enumerate(shapes)])


def in_order(values, digits=9):
    return np.sort_complex(np.round(np.asarray(values), digits))


# Values ---------------------------------------------------------------------------------------------------------------


def test_matrices_may_be_numbers_arrays_and_tensors():
    system = ss([[0, 1], [0, 0]], np.array([[0.0], [1.0]]), tensor([[1, 0]], SINGLE), dt=0.5)
    assert {m.dtype for m in (system.a, system.b, system.c, system.d)} == {SINGLE}
    assert system.d.shape == (1, 1) and not system.d.any()
    assert system.dt == 0.5 and system.is_discrete and system.batch_shape == ()
    assert ss([[0, 1], [0, 0]], [[0], [1]]).a.dtype == DOUBLE
    assert ss([[0.1]], [[1]]).a.item() == 0.1


def test_without_c_the_state_comes_out():
    system = ss(tensor([[0.0, 1], [0, 0]]), tensor([[0.0], [1]]))
    assert torch.equal(system.c, torch.eye(2, dtype=DOUBLE)) and system.d.shape == (2, 1)


def test_leading_dims_broadcast_with_those_of_dt():
    system = ss(normal(3, 1, 2, 2), normal(2, 1), normal(4, 1, 2), dt=tensor([0.1, 0.2, 0.3, 0.4]))
    assert system.batch_shape == (3, 4)


def test_a_system_of_python_control_goes_in_and_out():
    theirs = ct.ss([[0.0, 1], [-2, -3]], [[0.0], [1]], [[1.0, 0]], [[0.5]], 0.25)
    for system in (ss(theirs), as_system(theirs)):
        assert system.dt == 0.25 and system.a.dtype == DOUBLE
        for ours, name in ((system.a, "A"), (system.b, "B"), (system.c, "C"), (system.d, "D")):
            np.testing.assert_array_equal(ours, getattr(theirs, name))
    back = ss(theirs).to_control()
    assert isinstance(back, ct.StateSpace) and back.dt == 0.25
    np.testing.assert_array_equal(back.A, theirs.A)
    np.testing.assert_array_equal(back.D, theirs.D)
    assert double_integrator().to_control().dt == 0
    assert as_system(system) is system and ss(system) is system


@pytest.mark.parametrize("dt", [0, None])
def test_zero_and_none_are_continuous_time(dt):
    theirs = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], dt)
    assert ss(theirs).dt is None
    assert ss([[-1.0]], [[1.0]], dt=dt).dt is None


def test_a_period_that_nobody_knows_is_refused():
    with pytest.raises(ValueError, match=r"dt=True is a discrete system whose period nobody knows"):
        ss(ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], True))
    with pytest.raises(ValueError, match=r"dt=True"):
        ss([[-1.0]], [[1.0]], dt=True)


def test_what_is_no_system_is_refused():
    with pytest.raises(TypeError, match=r"must be a StateSpace or a control.StateSpace, got TransferFunction"):
        ss(ct.tf([1], [1, 1]))
    with pytest.raises(TypeError, match=r"takes a system alone"):
        ss(double_integrator(), dt=0.1)


A, B, C, D = tensor([[0.0, 1], [0, 0]]), tensor([[0.0], [1]]), tensor([[1.0, 0]]), tensor([[0.0]])


@pytest.mark.parametrize(
    "parts, error, message",
    [
        (([[1.0]], B, C, D), TypeError, r"a must be a floating-point tensor, got list"),
        ((A.long(), B, C, D), TypeError, r"a must be a floating-point tensor, got torch.int64"),
        ((A, B.float(), C, D), TypeError, r"b must have the dtype of a, torch.float64, got torch.float32"),
        ((A[0], B, C, D), ValueError, r"a must be a matrix \(\*batch, rows, columns\), got shape \(2,\)"),
        ((A[:1], B, C, D), ValueError, r"a must be \(\*batch, 2, 2\), got shape \(1, 2\)"),
        ((A, B[:1], C, D), ValueError, r"b must be \(\*batch, 2, 1\), got shape \(1, 1\)"),
        ((A, B, C[:, :1], D), ValueError, r"c must be \(\*batch, 1, 2\), got shape \(1, 1\)"),
        ((A, B, C, D[:, :0]), ValueError, r"d must be \(\*batch, 1, 1\), got shape \(1, 0\)"),
        ((A[:0, :0], B[:0], C[:, :0], D), ValueError, r"one state at least"),
        ((A, B, C * torch.nan, D), ValueError, r"c must be finite, got nan at \(0, 0\)"),
        ((A, B / 0, C, D), ValueError, r"b must be finite, got (nan|inf) at"),
        ((A, B, C, D, 0.0), ValueError, r"dt must be positive and finite, .*got 0"),
        ((A, B, C, D, -0.1), ValueError, r"dt must be positive and finite, .*got -0.1"),
        ((A, B, C, D, True), ValueError, r"dt must be positive and finite, .*got True"),
        ((A, B, C, D, tensor([0.1, torch.inf])), ValueError, r"dt must be positive and finite, .*got inf"),
        ((A, B, C, D, tensor(0.1, SINGLE)), TypeError, r"dt must have the dtype of a"),
        (
            (A.expand(2, 2, 2), B, C.expand(3, 1, 2), D),
            ValueError,
            r"leading dims must broadcast, got \{'a': \(2,\), 'b': \(\), 'c': \(3,\), 'd': \(\)\}",
        ),
        ((A.expand(2, 2, 2), B, C, D, tensor([0.1] * 3)), ValueError, r"leading dims.*'dt': \(3,\)"),
    ],
)
def test_what_does_not_fit_is_named(parts, error, message):
    with pytest.raises(error, match=message):
        StateSpace(*parts)


@pytest.mark.parametrize("function", [zeros, pzmap, StateSpace.to_control])
def test_a_batch_is_refused_where_there_can_be_one_only(function):
    with pytest.raises(ValueError, match=r"needs one system, got a batch \(2,\)"):
        function(random_system(lead=(2,)))


# Poles and zeros ------------------------------------------------------------------------------------------------------


@DTYPES
def test_poles_equal_python_control(dtype):
    """Random matrices of 4 states: eigenvalues conditioned below 100."""
    system = random_system()
    expected = ct.poles(system.to_control())
    ours = poles(ss(system.a.to(dtype), system.b.to(dtype)))
    assert ours.dtype == dtype.to_complex()
    tolerance = 100 * torch.finfo(dtype).eps
    digits = 10 if dtype == DOUBLE else 4  # conjugates are sorted by real parts that rounding has not split
    np.testing.assert_allclose(in_order(ours, digits), in_order(expected, digits), rtol=0, atol=10 * tolerance)
    np.testing.assert_array_equal(poles(system.to_control()), eig(system.a))


def test_poles_of_a_batch_equal_a_loop():
    batch = random_system(lead=(3, 2))
    for i, j in np.ndindex(3, 2):
        np.testing.assert_allclose(in_order(poles(batch)[i, j]), in_order(eig(batch.a[i, j])), rtol=0, atol=1e-9)


def test_pinv_equals_numpy_and_the_four_rules():
    """A matrix of rank 2, where the third singular value is rounding."""
    a = normal(5, 2) @ normal(2, 3, seed=1)
    ours = pinv(a)
    np.testing.assert_allclose(ours, np.linalg.pinv(a.numpy(), rcond=1e-12), rtol=0, atol=1e-13)
    for product, expected in ((a @ ours @ a, a), (ours @ a @ ours, ours), (a @ ours, (a @ ours).mT)):
        np.testing.assert_allclose(product, expected, rtol=0, atol=1e-13)
    both = torch.stack([a, 2 * a])
    np.testing.assert_allclose(pinv(both)[1], ours / 2, rtol=0, atol=1e-14)


@pytest.mark.parametrize("sizes", [(5, 2), (4, 1), (6, 3), (3, 3)])
def test_zeros_of_square_systems_equal_python_control(sizes):
    """With D as many zeros as states, without it fewer by the number of ports."""
    states, ports = sizes
    system = random_system(states, ports, ports, seed=7)
    for d in (system.d, 0 * system.d):
        system = ss(system.a, system.b, system.c, d)
        expected = ct.zeros(system.to_control())
        expected = expected[np.abs(expected) < 1e10]  # theirs has -3e16, an infinite one, where there are 3 ports
        np.testing.assert_allclose(in_order(zeros(system)), in_order(expected), rtol=1e-8, atol=1e-8)


def test_zeros_of_a_transfer_function_are_its_numerators():
    """(s + 2)(s + 5) above seven poles: five infinite zeros in one chain, which a plain pencil scatters."""
    theirs = ct.ss(ct.tf([1, 7, 10], np.poly([-1, -1.5, -2.5, -3, -4, -6, -7])))
    np.testing.assert_allclose(np.sort(zeros(theirs).real), [-5, -2], rtol=1e-9)
    assert zeros(double_integrator()).shape == (0,)


@DTYPES
def test_a_zero_of_more_outputs_than_inputs_is_found(dtype):
    """Both outputs pass the same (s + 3) before they part; a system without such a part has no zero."""
    common = ct.ss(ct.tf([1, 3], [1, 1]))
    parted = ct.ss(np.diag([-2.0, -4.0]), [[1.0], [1]], np.eye(2), np.zeros((2, 1)))
    system = ss(ct.series(common, parted))
    system = ss(*[m.to(dtype) for m in (system.a, system.b, system.c, system.d)])
    for one in (system, ss(system.a.mT, system.c.mT, system.b.mT, system.d.mT)):
        found = zeros(one)
        assert found.dtype == dtype.to_complex()
        np.testing.assert_allclose(found, [-3], rtol=0, atol=100 * torch.finfo(dtype).eps)
    assert zeros(random_system(5, 1, 2, seed=3)).shape == (0,)


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_the_map_shows_poles_zeros_and_the_imaginary_axis():
    system = ct.ss(ct.tf([1, 2, 5], np.poly([-1, -2, -3])))
    axes = pzmap(system)
    drawn = lines(axes)
    assert set(drawn) == {"poles", "zeros", "boundary of stability"}
    assert drawn["poles"].get_marker() == "x" and drawn["zeros"].get_marker() == "o"
    np.testing.assert_allclose(np.sort(drawn["poles"].get_xdata()), [-3, -2, -1], rtol=1e-9)
    np.testing.assert_allclose(drawn["poles"].get_ydata(), 0, atol=1e-9)
    np.testing.assert_allclose(drawn["zeros"].get_xdata(), [-1, -1], rtol=1e-9)
    np.testing.assert_allclose(np.sort(drawn["zeros"].get_ydata()), [-2, 2], rtol=1e-9)
    np.testing.assert_array_equal(drawn["boundary of stability"].get_xdata(), [0, 0])
    assert axes.get_xlabel() == "real part (1/s)" and axes.get_legend() is not None


def test_the_map_in_discrete_time_shows_the_unit_circle_on_the_axes_given():
    axes = Figure().add_subplot()
    system = ss(tensor([[0.5, 0.2], [-0.2, 0.5]]), tensor([[0.0], [1]]), tensor([[1.0, 0]]), dt=0.1)
    assert pzmap(system, axes) is axes
    x, y = lines(axes)["boundary of stability"].get_data()
    np.testing.assert_allclose(np.hypot(x, y), 1, rtol=4 * EPS)
    assert axes.get_xlabel() == "real part" and axes.get_aspect() == 1.0
    np.testing.assert_allclose(np.sort(lines(axes)["poles"].get_ydata()), [-0.2, 0.2], rtol=1e-12)


# Discretisation -------------------------------------------------------------------------------------------------------


@DTYPES
def test_double_integrator_equals_its_closed_form(dtype):
    """Also the numbers of the notes: dt = 0.5, Q = 0.04."""
    eps = torch.finfo(dtype).eps
    for dt in (1e-4, 0.5, 3.0, 1e3):
        step = c2d(double_integrator(dtype), dt, tensor([[0.04]], dtype), tensor([[0.0], [1]], dtype))
        assert step.system.dt == dt and step.system.a.dtype == dtype
        np.testing.assert_allclose(step.system.a, [[1, dt], [0, 1]], rtol=4 * eps)
        np.testing.assert_allclose(step.system.b, [[dt**2 / 2], [dt]], rtol=4 * eps)
        np.testing.assert_array_equal(step.system.c, [[1, 0]])
        expected = 0.04 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        np.testing.assert_allclose(step.noise_covariance, expected, rtol=32 * eps)
    notes = c2d(double_integrator(), 0.5, tensor([[0.04]]), tensor([[0.0], [1]])).noise_covariance
    np.testing.assert_allclose(notes, [[0.00166667, 0.005], [0.005, 0.02]], rtol=0, atol=4e-9)


@pytest.mark.parametrize("dt", [0.01, 0.3, 2.0])
def test_random_systems_equal_scipy(dt):
    """Conditioning: exp(2 ‖A‖ dt) at the worst, below 1e6 here."""
    system = random_system(seed=11)
    factor = normal(4, 2, seed=20)
    step = c2d(system, dt, torch.eye(2, dtype=DOUBLE), factor)
    arrays = [m.numpy() for m in (system.a, system.b, system.c, system.d)]
    a, b, c, d, _ = cont2discrete(arrays, dt)
    found = step.system
    for ours, theirs in zip((found.a, found.b, found.c, found.d), (a, b, c, d), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-13)

    def rate(s):
        pushed = scipy.linalg.expm(arrays[0] * s) @ factor.numpy()
        return pushed @ pushed.T

    expected, error = quad_vec(rate, 0, dt, epsabs=0, epsrel=1e-13)
    assert error < 1e-11 * np.abs(expected).max()
    np.testing.assert_allclose(step.noise_covariance, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_no_noise_no_covariance():
    assert c2d(double_integrator(), 0.1).noise_covariance is None


RATES = np.array([1000.0, 30.0, 1.0, 0.0])


def stiff():
    """Modes from 1000 /s to an integrator, in skew coordinates."""
    basis = np.eye(4) + 0.3 * normal(4, 4, seed=5).numpy()
    noise = normal(4, 4, seed=6).numpy()
    noise = noise @ noise.T
    inverse = np.linalg.inv(basis)
    return basis, -basis @ np.diag(RATES) @ inverse, noise, inverse @ noise @ inverse.T


@pytest.mark.parametrize("dtype, size", [(DOUBLE, EPS), (SINGLE, 1.2e-7)])
@pytest.mark.parametrize("dt", [1e-3, 0.1, 1.0, 20.0])
def test_stiff_systems_and_long_periods_equal_the_closed_form(dt, dtype, size):
    """In modal axes the integral is (1 - exp(-(p + q) t)) / (p + q).

    A rounding of A by eps ‖A‖ moves the integrator off zero by that much, over dt: the error is of size eps ‖A‖ dt
    times the condition of the modes (16), however it is computed.
    """
    basis, a, noise, modal = stiff()
    rates = RATES[:, None] + RATES
    span = np.where(rates > 0, -np.expm1(-rates * dt) / np.where(rates > 0, rates, 1), dt)
    expected = basis @ (modal * span) @ basis.T
    norm = np.abs(a).sum(0).max()
    ours = integrate_noise(tensor(a, dtype), tensor(noise, dtype), dt).double().numpy()
    np.testing.assert_array_equal(ours, ours.T)
    tolerance = 16 * size * max(1.0, norm * dt)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=tolerance * np.abs(expected).max())
    assert np.linalg.eigvalsh(ours).min() > -tolerance * np.abs(expected).max()
    push, transition = (m.double().numpy() for m in hold_input(tensor(a, dtype), tensor(noise, dtype), dt)[::-1])
    exact = basis @ np.diag(np.exp(-RATES * dt)) @ np.linalg.inv(basis)
    held = np.where(RATES > 0, -np.expm1(-RATES * dt) / np.where(RATES > 0, RATES, 1), dt)
    np.testing.assert_allclose(transition, exact, rtol=0, atol=tolerance * np.abs(exact).max())
    exact = basis @ np.diag(held) @ np.linalg.inv(basis) @ noise
    np.testing.assert_allclose(push, exact, rtol=0, atol=tolerance * np.abs(exact).max())


def test_the_textbook_block_overflows_where_ours_does_not():
    """One fast stable mode: Van Loan's block holds exp(+1000)."""
    a, q, dt = np.array([[-1000.0]]), np.array([[2.0]]), 1.0
    with np.errstate(all="ignore"):
        block = scipy.linalg.expm(np.block([[-a, q], [0 * a, a.T]]) * dt)
        textbook = block[1:, 1:].T @ block[:1, 1:]
    assert not np.isfinite(textbook).all()
    np.testing.assert_allclose(integrate_noise(tensor(a), tensor(q), dt), [[1e-3]], rtol=1e-12)


def test_tiny_steps_leave_a_positive_definite_covariance():
    """A chain of three integrators: correlations do not depend on dt, so neither may definiteness."""
    chain = torch.diag(torch.ones(2, dtype=DOUBLE), 1)
    noise = torch.diag(tensor([0.0, 0.0, 1.0]))
    for dt in (1e-5, 1e-2, 10.0):
        ours = integrate_noise(chain, noise, dt).numpy()
        powers = np.array([dt**2 / 2, dt, 1.0])
        closed = np.outer(powers, powers) * dt / np.add.outer([2, 1, 0], [3, 2, 1])
        np.testing.assert_allclose(ours, closed, rtol=1e-13)
        scale = np.sqrt(np.diag(ours))
        assert np.linalg.eigvalsh(ours / np.outer(scale, scale)).min() > 1e-3


@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_units_of_input_and_noise_do_not_cost_precision(size):
    system, factor = random_system(seed=30), normal(4, 4, seed=31)
    noise = factor @ factor.mT
    one = c2d(system, 0.7, noise)
    many = c2d(ss(system.a, size * system.b, system.c), 0.7, size * noise)
    np.testing.assert_allclose(many.system.b / size, one.system.b, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(many.system.a, one.system.a, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(many.noise_covariance / size, one.noise_covariance, rtol=1e-13)


def test_a_batch_equals_a_loop_with_a_period_for_each_row():
    """Rows differ in how often they are doubled."""
    system = random_system(lead=(3,), seed=40)
    factor = normal(3, 4, 2, seed=50)
    dt = tensor([0.01, 0.5, 4.0])
    noise = torch.diag(tensor([1.0, 3.0]))
    batch = c2d(system, dt, noise, factor)
    assert batch.system.batch_shape == (3,) and torch.equal(batch.system.dt, dt)
    for i in range(3):
        row = ss(system.a[i], system.b[i], system.c[i], system.d[i])
        one = c2d(row, float(dt[i]), noise, factor[i])
        for ours, expected in (
            (batch.system.a[i], one.system.a),
            (batch.system.b[i], one.system.b),
            (batch.noise_covariance[i], one.noise_covariance),
        ):
            np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-13 * expected.abs().max().item())
    several = c2d(double_integrator(), dt, noise)
    assert several.system.a.shape == (3, 2, 2) and several.noise_covariance.shape == (3, 2, 2)


def test_no_time_means_no_motion():
    push, noise = normal(2, 1), torch.eye(2, dtype=DOUBLE)
    transition, held = hold_input(A, push, 0.0)
    assert torch.equal(transition, torch.eye(2, dtype=DOUBLE)) and not held.any()
    assert not integrate_noise(A, noise, 0.0).any()


def test_gradients_reach_matrices_noise_and_period():
    a, b = normal(3, 3, seed=1).requires_grad_(), normal(3, 1, seed=2).requires_grad_()
    factor, dt = normal(3, 3, seed=3).requires_grad_(), tensor([0.3, 2.0]).requires_grad_()

    def run(a, b, factor, dt):
        step = c2d(ss(a, b), dt, factor @ factor.mT)
        return step.system.a, step.system.b, step.noise_covariance

    assert torch.autograd.gradcheck(run, (a, b, factor, dt))


def test_transforms_and_compilation_see_the_same_numbers():
    """The traced loop is unrolled whole: up to a million in ‖A‖ dt."""
    basis, a, noise, _ = stiff()
    a, noise, push = tensor(a), tensor(noise), tensor(basis[:, :1].copy())
    dts = tensor([0.0, 1e-3, 0.2, 5.0])

    def run(dt):
        return (*hold_input(a, push, dt), integrate_noise(a, noise, dt))

    expected = run(dts)
    mapped = torch.func.vmap(run)(dts)
    compiled = torch.compile(run, fullgraph=True, backend="eager")(dts)
    for ours in (mapped, compiled):
        for one, other in zip(ours, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)
    _, slope = torch.func.jvp(lambda dt: integrate_noise(a, noise, dt), (tensor(0.2),), (tensor(1.0),))
    end = torch.linalg.matrix_exp(0.2 * a)
    np.testing.assert_allclose(slope, end @ noise @ end.mT, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ((ss(A, B, C, dt=0.1), 0.1), ValueError, r"needs a continuous system, this one is discrete with dt = 0.1"),
        ((ss(A, B, C), 0.0), ValueError, r"dt must be positive and finite, .*got 0"),
        ((ss(A, B, C), torch.nan), ValueError, r"dt must be positive and finite, .*got nan"),
        ((ss(A, B, C), tensor([0.1, -1.0])), ValueError, r"dt must be positive and finite, .*got -1"),
        ((ss(A, B, C), 0.1, None, B), ValueError, r"noise_input needs noise_psd"),
        ((ss(A, B, C), 0.1, tensor([[1.0]])), ValueError, r"noise_psd must be \(\*batch, 2, 2\) or come with"),
        ((ss(A, B, C), 0.1, tensor([[1.0]]), C), ValueError, r"noise_input must be \(\*batch, 2, 1\), got.*\(1, 2\)"),
        ((ss(A, B, C), 0.1, tensor([[-1.0]]), B), ValueError, r"noise_psd must be positive semi.*eigenvalue is -1"),
        ((ss(A, B, C), 0.1, tensor([[torch.nan]]), B), ValueError, r"noise_psd must be finite"),
        ((ss(A, B, C), 0.1, tensor([[1.0]], SINGLE), B), TypeError, r"noise_psd must have the dtype of a"),
        ((ss(A, B, C), 0.1, [[1.0]], B), TypeError, r"noise_psd must be a floating-point tensor, got list"),
        ((ss(A, B, C), 0.1, tensor([[1.0]]), B * torch.inf), ValueError, r"noise_input must be finite"),
        ((object(), 0.1), TypeError, r"a system must be a StateSpace or a control.StateSpace, got object"),
    ],
)
def test_errors_of_discretisation(arguments, error, message):
    with pytest.raises(error, match=message):
        c2d(*arguments)
