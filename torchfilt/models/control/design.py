"""Design of linear observers and controllers: pole placement, stationary Kalman filter, LQR, and both together.

Equations are solved by SciPy in float64, row by row of a batch; results come back in the dtype and on the device of the
system. No gradients are carried.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfilt.linalg import psd_factor
from torchfilt.models.control.systems import StateSpace, as_system, check_matrix, ss, state_noise

Array = NDArray[Any]

_MISSED = 1e-3
"""By how much of the largest pole those placed may be off."""


class Regulator(NamedTuple):
    """gain K (*batch, k, d) of u = -K x. cost (*batch, d, d): S, so that x^T S x is the cost to go from x.

    poles (*batch, d): of the closed loop, complex.
    """

    gain: Tensor
    cost: Tensor
    poles: Tensor


class KalmanDesign(NamedTuple):
    """gain (*batch, d, m) of the innovation. covariance (*batch, d, d): of the error, in discrete time of the predicted
    state. posterior (*batch, d, d): after the measurement, in continuous time the same. poles (*batch, d): of the
    error, complex.
    """

    gain: Tensor
    covariance: Tensor
    posterior: Tensor
    poles: Tensor


class LqgDesign(NamedTuple):
    """regulator and kalman: the two designs. closed_loop: see `lqgr`. cost (*batch): stationary, a unit of time or a
    step.
    """

    regulator: Regulator
    kalman: KalmanDesign
    closed_loop: StateSpace
    cost: Tensor


# Pole placement -------------------------------------------------------------------------------------------------------


def place(a: Tensor, b: Tensor, poles: Any) -> Tensor:
    """Gain K with which A - B K has the poles that are wished for.

    An observer is the dual: ``place(a.mT, c.mT, poles).mT`` is the gain L of A - L C. Modes that the input cannot move
    may be among the poles; they stay, and the others are placed. With several inputs many gains will do; where SciPy
    warns that its search has not converged, the poles are placed, but not by the least sensitive of them.

    Args:
        a: (*batch, d, d). b: (*batch, d, k). poles: d numbers, real or complex, or (*batch, d).

    Returns:
        (*batch, k, d).

    Raises:
        ValueError: another number of poles than states, a pole that is not finite, a complex pole without its
            conjugate, a pole wished for more often than B has independent columns (with one input: twice), a mode that
            the input cannot move and that is not among the poles, poles so sensitive that rounding of the gain alone
            moves them by a thousandth.

    Source: Tits and Yang, Globally convergent algorithms for robust pole assignment by state feedback, IEEE TAC 41
    (1996), as in ``scipy.signal.place_poles``; Popov, Belevitch and Hautus for the modes that stay.
    """
    system = ss(a, b)
    wished = poles if isinstance(poles, Tensor) else torch.as_tensor(np.asarray(poles, dtype=complex))
    wished = wished.to(torch.complex128)
    states, eps = system.a.shape[-1], torch.finfo(system.a.dtype).eps
    if wished.dim() == 0 or wished.shape[-1] != states:
        raise ValueError(f"poles must be {states} numbers, one a state, got shape {tuple(wished.shape)}")

    def design(a: Array, b: Array, wished: Array) -> tuple[Array, ...]:
        return (_place(a, b, wished, eps),)

    (gain,) = _by_rows(design, system, [(system.a, 2), (system.b, 2), (wished, 1)])
    return gain


def _place(a: Array, b: Array, wished: Array, eps: float) -> Array:
    from scipy.signal import place_poles

    wished = _paired(wished)
    basis, fixed = _split(a, b, eps)
    slack = np.sqrt(eps) * max(float(np.linalg.norm(a, 1)), float(np.abs(wished).max()))
    for mode in fixed.values:
        nearest = int(np.abs(wished - mode).argmin()) if len(wished) else -1
        if nearest < 0 or abs(wished[nearest] - mode) > slack:
            raise ValueError(
                f"the input cannot move the mode {_number(mode)} (rank [A - s I, B] < d there, by Popov, Belevitch and "
                f"Hautus), and it is not among the poles {_numbers(wished)}"
            )
        wished = np.delete(wished, nearest)
    if not basis.shape[1]:
        return np.zeros(b.T.shape)
    part_a, part_b = basis.T @ a @ basis, basis.T @ b
    rank = np.linalg.matrix_rank(part_b, tol=_tolerance(part_b, eps))
    for pole in wished:
        times = int((wished == pole).sum())
        if times > rank:
            raise ValueError(
                f"the pole {_number(pole)} is wished for {times} times, more often than B has independent columns, "
                f"which is {rank}"
            )
    gain = place_poles(part_a, part_b, wished).gain_matrix @ basis.T
    _check_placed(np.linalg.eigvals(a - b @ gain), np.concatenate([wished, fixed.values]))
    return gain


def _check_placed(reached: Array, wished: Array) -> None:
    """With many states an input, poles may depend on the last digits of the gain; or an error."""
    from scipy.optimize import linear_sum_assignment

    distance = np.abs(reached[:, None] - wished)
    worst = distance[linear_sum_assignment(distance)].max()
    if worst > _MISSED * np.abs(wished).max():
        raise ValueError(
            f"the poles {_numbers(wished)} are too sensitive to be placed in float64: they come out at "
            f"{_numbers(reached)}, off by {worst:.3g}; wish for others or place fewer with an input"
        )


def _paired(wished: Array) -> Array:
    """The poles, real ones clean, each complex one beside its conjugate; or an error."""
    if not np.isfinite(wished).all():
        raise ValueError(f"poles must be finite, got {_numbers(wished)}")
    for pole in wished:
        if (wished == pole).sum() != (wished == pole.conjugate()).sum():
            raise ValueError(
                f"complex poles come in conjugate pairs, {_number(pole)} has none among {_numbers(wished)}"
            )
    return wished


# Riccati equations ----------------------------------------------------------------------------------------------------


class _Words(NamedTuple):
    """What the two conditions are called in a problem and in its dual."""

    unstable: str
    undamped: str


_ESTIMATION = _Words(
    "no stationary Kalman filter: the measurements do not see {modes}, which {do} not decay (the pair A, C is not "
    "detectable)",
    "no stationary Kalman filter: the process noise does not reach {modes}, undamped, so that the gain there goes to "
    "zero and never settles",
)
_CONTROL = _Words(
    "no stationary regulator: the input does not move {modes}, which {do} not decay (the pair A, B is not "
    "stabilizable)",
    "no stationary regulator: the cost does not see {modes}, undamped, so that the best control leaves it alone",
)


def kalman(
    system: Any, process_noise: Tensor, measurement_noise: Tensor, noise_input: Tensor | None = None
) -> KalmanDesign:
    """Gain and covariance that the Kalman filter of a system with constant matrices settles to.

    In continuous time dx/dt = A x + B u + F w, y = C x + D u + v with white noises of spectral densities Q and R:
    A P + P Aᵀ + F Q Fᵀ − P Cᵀ R⁻¹ C P = 0 and L = P Cᵀ R⁻¹. In discrete time Q and R are covariances, P is that of the
    predicted state, K = P Cᵀ (C P Cᵀ + R)⁻¹ and the posterior covariance is (I − K C) P.

    Args:
        system: `StateSpace` or ``control.StateSpace``.
        process_noise: Q (*batch, w, w). measurement_noise: R (*batch, m, m). noise_input: F (*batch, d, w), default
            the identity.

    Returns:
        `KalmanDesign`, in the dtype and on the device of the system, without gradients.

    Raises:
        TypeError: a dtype other than the system's.
        ValueError: Q not positive semidefinite, R not positive definite, shapes that do not fit; a mode that does not
            decay and is not seen; an undamped mode that no noise reaches. The eigenvalue is named. As every rank, this
            depends on the scale of the states: what is below 10 d eps of ‖A‖ counts as zero. An equation that is too
            sensitive to be solved in float64, so that a mode of the error would not decay.

    Source: Anderson and Moore, Optimal Filtering (1979); SciPy's ``solve_continuous_are`` and ``solve_discrete_are``.
    """
    plant = as_system(system)
    noise = state_noise(plant.a, process_noise, noise_input, "process_noise")
    _check_definite(measurement_noise, "measurement_noise", plant.c.shape[-2], plant.a)
    eps = torch.finfo(plant.a.dtype).eps

    def design(a: Array, c: Array, q: Array, r: Array) -> tuple[Array, ...]:
        p = _riccati(a.T, c.T, q, r, np.zeros_like(c.T), plant.is_discrete, eps, _ESTIMATION)
        if not plant.is_discrete:
            gain = np.linalg.solve(r, c @ p).T
            return gain, p, p, np.linalg.eigvals(a - gain @ c).astype(complex)
        gain = np.linalg.solve(c @ p @ c.T + r, c @ p).T
        left = np.eye(len(a)) - gain @ c
        posterior = left @ p @ left.T + gain @ r @ gain.T
        return gain, p, posterior, np.linalg.eigvals(left @ a).astype(complex)

    return KalmanDesign(*_by_rows(design, plant, [(plant.a, 2), (plant.c, 2), (noise, 2), (measurement_noise, 2)]))


def lqr(system: Any, state_weight: Tensor, control_weight: Tensor, cross: Tensor | None = None) -> Regulator:
    """State feedback u = -K x of least cost: the integral or the sum of xᵀ Q x + uᵀ R u + 2 xᵀ N u.

    Args:
        system: `StateSpace` or ``control.StateSpace``; its outputs play no part (``ss(a, b)`` will do).
        state_weight: Q (*batch, d, d). control_weight: R (*batch, k, k). cross: N (*batch, d, k), default zero.

    Returns:
        `Regulator`, in the dtype and on the device of the system, without gradients.

    Raises:
        TypeError: a dtype other than the system's.
        ValueError: R not positive definite, [[Q, N], [Nᵀ, R]] not positive semidefinite, shapes that do not fit; a mode
            that does not decay and that the input cannot move; an undamped mode that costs nothing. The eigenvalue is
            named. An equation that is too sensitive, as in `kalman`.

    Source: Anderson and Moore, Optimal Control: Linear Quadratic Methods (1990); SciPy as in `kalman`.
    """
    plant = as_system(system)
    cross = check_weights(plant, state_weight, control_weight, cross)
    eps = torch.finfo(plant.a.dtype).eps

    def design(a: Array, b: Array, q: Array, r: Array, n: Array) -> tuple[Array, ...]:
        cost = _riccati(a, b, q, r, n, plant.is_discrete, eps, _CONTROL)
        gain = _feedback(a, b, r, n, cost, plant.is_discrete)
        return gain, cost, np.linalg.eigvals(a - b @ gain).astype(complex)

    weights = [(state_weight, 2), (control_weight, 2), (cross, 2)]
    return Regulator(*_by_rows(design, plant, [(plant.a, 2), (plant.b, 2), *weights]))


def check_weights(plant: StateSpace, state_weight: Tensor, control_weight: Tensor, cross: Tensor | None) -> Tensor:
    """The cross weight, zeros for None.

    Returns:
        N (*batch, d, k).

    Raises:
        TypeError, ValueError: as `lqr`, for the weights alone.
    """
    states, controls = plant.b.shape[-2:]
    state_noise(plant.a, state_weight, None, "state_weight")
    _check_definite(control_weight, "control_weight", controls, plant.a)
    if cross is None:
        return plant.a.new_zeros(states, controls)
    check_matrix(cross, "cross", plant.a)
    if cross.shape[-2:] != (states, controls):
        raise ValueError(f"cross must be (*batch, {states}, {controls}), got shape {tuple(cross.shape)}")
    whole = blocks([[state_weight, cross], [cross.mT, control_weight]])
    psd_factor(whole, "[[state_weight, cross], [cross^T, control_weight]]")
    return cross


def lqgr(
    system: Any,
    state_weight: Tensor,
    control_weight: Tensor,
    process_noise: Tensor,
    measurement_noise: Tensor,
    noise_input: Tensor | None = None,
    cross: Tensor | None = None,
) -> LqgDesign:
    """Regulator and Kalman filter joined: u = -K x̂, the control of least expected cost from measurements.

    The closed loop has the states (x, e), where e = x - x̂ is the error of the estimate, in discrete time of the
    predicted one; the inputs (w, v), process and measurement noise; the outputs (C x + D u, u). Its poles are those of
    the regulator and those of the filter. In discrete time the control of an instant uses the measurement of that
    instant.

    Args: as in `lqr` and `kalman`.

    Returns:
        cost (*batch): expected xᵀ Q x + uᵀ R u + 2 xᵀ N u when all is stationary, tr(S W) + tr(P Kᵀ R K) with W the
        process noise on the states; in discrete time tr(S W) + tr(P⁺ Kᵀ (R + Bᵀ S B) K).

    Raises:
        As `lqr` and `kalman`. ValueError: discrete time with D other than zero, where the control would be needed for
        the measurement that it is computed from.

    Source: Anderson and Moore, Optimal Control: Linear Quadratic Methods (1990), the separation theorem.
    """
    plant = as_system(system)
    if plant.is_discrete and plant.d.any():
        raise ValueError("d must be zero in discrete time: the control is computed from the measurement it would be in")
    regulator = lqr(plant, state_weight, control_weight, cross)
    design = kalman(plant, process_noise, measurement_noise, noise_input)
    a, b, c, d = plant.a, plant.b, plant.c, plant.d
    k, l = regulator.gain, design.gain
    f = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device) if noise_input is None else noise_input
    weight = control_weight
    if plant.is_discrete:
        weight = weight + b.mT @ regulator.cost @ b
        left = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device) - l @ c
        loop = blocks([[a - b @ k, b @ k @ left], [0 * a, a @ left]])
        noise = blocks([[f, -b @ k @ l], [f, -a @ l]])
        output = blocks([[c, 0 * c], [-k, k @ left]])
        direct = blocks([[0 * c @ f, 0 * c @ l], [0 * k @ f, -k @ l]])
    else:
        loop = blocks([[a - b @ k, b @ k], [0 * a, a - l @ c]])
        noise = blocks([[f, 0 * l], [f, -l]])
        output = blocks([[c - d @ k, d @ k], [-k, k]])
        direct = 0 * output @ noise
    pushed = (regulator.cost * state_noise(a, process_noise, noise_input, "process_noise")).sum((-2, -1))
    steered = (design.posterior * (k.mT @ weight @ k)).sum((-2, -1))
    return LqgDesign(regulator, design, StateSpace(loop, noise, output, direct, plant.dt), pushed + steered)


def _riccati(a: Array, b: Array, q: Array, r: Array, n: Array, is_discrete: bool, eps: float, words: _Words) -> Array:
    """The stabilizing solution of the regulator's equation, symmetric; or an error for the mode that forbids it."""
    from scipy.linalg import LinAlgError, solve_continuous_are, solve_discrete_are

    _, stuck = _split(a, b, eps)
    growth, doubt = _growth(stuck, a, is_discrete, eps)
    _refuse_modes(stuck.values[growth >= -doubt], words.unstable)
    # Cross weights are a feedback given beforehand.
    given = np.linalg.solve(r, n.T)
    _, hidden = _split((a - b @ given).T, _range(q - n @ given, q, eps), eps)
    growth, doubt = _growth(hidden, a, is_discrete, eps)
    _refuse_modes(hidden.values[np.abs(growth) <= doubt], words.undamped)
    solve = solve_discrete_are if is_discrete else solve_continuous_are
    unit = 1 / np.sqrt(np.diag(r))  # of each input: SciPy takes weights of very different units for singular
    try:
        solution = solve(a, b * unit, q, unit[:, None] * r * unit, s=n * unit)
    except LinAlgError as error:
        raise ValueError(f"the Riccati equation has no stabilizing solution to be found: {error}") from None
    solution = (solution + solution.T) / 2
    gain = _feedback(a, b, r, n, solution, is_discrete)
    loop = a - b @ gain
    poles = _modes(loop)
    growth, doubt = _growth(poles, loop, is_discrete, eps)
    if (growth > doubt).any():
        raise ValueError(
            f"the Riccati equation is too sensitive to be solved in float64: with the solution that is found the mode "
            f"{_number(poles.values[(growth - doubt).argmax()])} does not decay"
        )
    return solution


def _feedback(a: Array, b: Array, r: Array, n: Array, cost: Array, is_discrete: bool) -> Array:
    """The best gain K (k, d), given the cost to go."""
    if is_discrete:
        gain: Array = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a + n.T)
        return gain
    return np.linalg.solve(r, b.T @ cost + n.T)


class _Modes(NamedTuple):
    """Eigenvalues with the condition number of each: how far a change of the matrix moves it."""

    values: Array
    condition: Array


def _split(a: Array, b: Array, eps: float) -> tuple[Array, _Modes]:
    """Orthonormal basis (d, r) of the states that inputs reach, and the modes of the rest, which they cannot move.

    Where these are, [A - s I, B] loses rank. That alone is blind for multiple eigenvalues, which are known to the root
    of the precision only; the staircase alone takes the rounding of a mode out of reach, which grows from step to step,
    for a state in reach. So modes that the rank tells are taken out first, and the staircase finds the others.
    """
    directions = _unit_columns(b)
    kept = _complement(_unmoved(a, directions, eps))
    part = kept.T @ a @ kept
    inner, fresh = np.zeros((len(part), 0)), _orth(kept.T @ directions, _tolerance(directions, eps))
    while fresh.shape[1]:
        inner = np.hstack([inner, fresh])
        fresh = part @ fresh
        for _ in range(2):  # the second time takes away what rounding left
            fresh = fresh - inner @ (inner.T @ fresh)
        fresh = _orth(fresh, _tolerance(a, eps))
    basis = kept @ inner
    rest = _complement(basis)
    return basis, _modes(rest.T @ a @ rest)


def _unmoved(a: Array, directions: Array, eps: float) -> Array:
    """Orthonormal basis (d, u) of what [A - s I, B] leaves out at the eigenvalues s of A, real and imaginary parts."""
    states = len(a)
    size = float(np.linalg.norm(a, 2)) or 1.0
    found = []
    for value in np.linalg.eigvals(a):
        left, values, _ = np.linalg.svd(np.hstack([a - value * np.eye(states), size * directions]))
        out = left[:, values <= 10 * states * eps * size]
        found += [out.real, out.imag]
    return _orth(np.hstack(found), np.sqrt(eps))


def _modes(a: Array) -> _Modes:
    from scipy.linalg import eig

    if not len(a):
        return _Modes(np.zeros(0, dtype=complex), np.zeros(0))
    found: Any = eig(a, left=True, right=True)
    values, left, right = found
    overlap = np.abs((left.conj() * right).sum(0))
    return _Modes(values, 1 / np.maximum(overlap, np.finfo(float).tiny))


def _growth(modes: _Modes, a: Array, is_discrete: bool, eps: float) -> tuple[Array, Array]:
    """How far each mode is beyond the boundary of stability, and how well that is known."""
    count = max(len(modes.values), 1)
    small = 10 * len(a) * eps
    # A chain of `count` equal modes is known to that root of the precision, never less.
    condition = np.minimum(modes.condition, small ** (1 / count - 1))
    size = max(float(np.linalg.norm(a, 1)), 1.0 if is_discrete else 0.0)
    return (np.abs(modes.values) - 1 if is_discrete else modes.values.real), small * size * condition


def _refuse_modes(values: Array, sentence: str) -> None:
    if len(values):
        several = len(values) > 1
        modes = f"the mode{'s' if several else ''} {_numbers(values)}"
        raise ValueError(sentence.format(modes=modes, do="do" if several else "does"))


def _range(q: Array, whole: Array, eps: float) -> Array:
    """Columns that span the range of a semidefinite matrix, found at the scale of each state."""
    diagonal = np.diag(q)
    scale = np.sqrt(np.where(diagonal > 10 * len(q) * eps * np.diag(whole), diagonal, 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    values, vectors = np.linalg.eigh(inverse[:, None] * q * inverse)
    return scale[:, None] * vectors[:, values > 10 * len(q) * eps]


# Parts ----------------------------------------------------------------------------------------------------------------


def _tolerance(matrix: Array, eps: float) -> float:
    """What counts as zero beside a matrix."""
    return 10 * max(matrix.shape) * eps * float(np.linalg.norm(matrix, 1)) if matrix.size else 0.0


def _unit_columns(matrix: Array) -> Array:
    """Columns of length one, but those that are zero: the unit of an input plays no part in what it reaches."""
    length = np.linalg.norm(matrix, axis=0)
    return matrix / np.where(length > 0, length, 1.0)


def _orth(matrix: Array, tolerance: float) -> Array:
    """Orthonormal basis of the range."""
    left, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return left[:, values > tolerance]


def _complement(basis: Array) -> Array:
    """Orthonormal basis (d, d - r) of what is orthogonal to that of a basis (d, r)."""
    return np.linalg.svd(basis)[0][:, basis.shape[1] :] if basis.shape[1] else np.eye(len(basis))


def blocks(rows: list[list[Tensor]]) -> Tensor:
    """One matrix of many, whose leading dims broadcast."""
    lead = torch.broadcast_shapes(*[block.shape[:-2] for row in rows for block in row])
    wide = [torch.cat([block.expand(*lead, *block.shape[-2:]) for block in row], -1) for row in rows]
    return torch.cat(wide, -2)


def _check_definite(matrix: Tensor, name: str, size: int, like: Tensor) -> None:
    check_matrix(matrix, name, like)
    psd_factor(matrix, name)
    if matrix.shape[-1] != size:
        raise ValueError(f"{name} must be (*batch, {size}, {size}), got shape {tuple(matrix.shape)}")
    values = matrix.detach()
    scale = values.diagonal(dim1=-2, dim2=-1).rsqrt()
    # At the scale of each entry: units that differ are no singularity.
    balanced = scale[..., :, None] * values * scale[..., None, :]
    flat = ~torch.isfinite(scale).all(-1)
    lowest = torch.linalg.eigvalsh(torch.where(flat[..., None, None], values, balanced)).amin(-1)
    singular = flat | (lowest <= 10 * size * torch.finfo(values.dtype).eps)
    if singular.any():
        worst = torch.linalg.eigvalsh(values[singular]).amin()
        raise ValueError(f"{name} must be positive definite, its lowest eigenvalue is {worst.item():.6g}")


def _by_rows(
    function: Callable[..., tuple[Array, ...]], system: StateSpace, tensors: list[tuple[Tensor, int]]
) -> list[Tensor]:
    """The function of float64 arrays for each row of the batch, its results stacked in the dtype of the system."""
    lead = torch.broadcast_shapes(*[tensor.shape[: tensor.dim() - own] for tensor, own in tensors])
    arrays = []
    for tensor, own in tensors:
        wide = torch.complex128 if tensor.is_complex() else torch.float64
        tensor = tensor.detach().to(device="cpu", dtype=wide)
        arrays.append(tensor.expand(lead + tensor.shape[tensor.dim() - own :]).numpy())
    found = []
    for row in np.ndindex(*lead):
        try:
            found.append(function(*[array[row] for array in arrays]))
        except ValueError as error:
            raise ValueError(f"{error}, at row {row} of the batch" if lead else str(error)) from None
    real = system.a.dtype
    results = []
    for parts in zip(*found, strict=True):
        stacked = torch.as_tensor(np.stack(parts)).reshape(lead + parts[0].shape)
        kind = real.to_complex() if stacked.is_complex() else real
        results.append(stacked.to(dtype=kind, device=system.a.device))
    return results


def _number(value: complex) -> str:
    return f"{value.real:.6g}" if abs(value.imag) == 0 else f"{complex(value):.6g}"


def _numbers(values: Array) -> str:
    return ", ".join(_number(value) for value in values)
