"""Linear systems as values: state space, poles and zeros, and exact discretisation of dynamics and noise."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from torchfilt.linalg import is_traced, matrix_exp, psd_factor, triangularize

Array = NDArray[np.float64]

# Eight Gauss nodes are exact to rounding where ‖A‖ h <= 1; doublings of h reach ‖A‖ dt = 2^64, in a traced function,
# where all of them are unrolled, a million.
_NODES, _WEIGHTS = (values.tolist() for values in np.polynomial.legendre.leggauss(8))
_DOUBLINGS, _TRACED_DOUBLINGS = 64, 20


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A linear system dx/dt = A x + B u, or x' = A x + B u for the next state, with y = C x + D u.

    a (*batch, d, d), b (*batch, d, k), c (*batch, m, d), d (*batch, m, k): of one floating dtype; their leading dims
    broadcast. dt: None for continuous time, else the period in s, a number or (*batch). k and m may be 0.

    Raises:
        TypeError: a matrix that is not a floating-point tensor, or dtypes that differ.
        ValueError: shapes that do not fit, numbers that are not finite, a period that is not positive.
    """

    a: Tensor
    b: Tensor
    c: Tensor
    d: Tensor
    dt: float | Tensor | None = None

    def __post_init__(self) -> None:
        for name, matrix in self._matrices().items():
            check_matrix(matrix, name, self.a)
        states, controls, outputs = self.a.shape[-1], self.b.shape[-1], self.c.shape[-2]
        wanted = {"a": (states, states), "b": (states, controls), "c": (outputs, states), "d": (outputs, controls)}
        for name, matrix in self._matrices().items():
            if matrix.shape[-2:] != wanted[name]:
                raise ValueError(f"{name} must be (*batch, {_text(wanted[name])}), got shape {tuple(matrix.shape)}")
        if states == 0:
            raise ValueError("a must have one state at least, got shape (0, 0)")
        if self.dt is not None:
            check_period(self.dt, self.a)
        try:
            self.batch_shape  # noqa: B018  (computing it is the check)
        except RuntimeError:
            shapes = {name: tuple(matrix.shape[:-2]) for name, matrix in self._matrices().items()}
            shapes |= {"dt": tuple(self.dt.shape)} if isinstance(self.dt, Tensor) else {}
            raise ValueError(f"leading dims must broadcast, got {shapes}") from None

    def _matrices(self) -> dict[str, Tensor]:
        return {"a": self.a, "b": self.b, "c": self.c, "d": self.d}

    @property
    def is_discrete(self) -> bool:
        """Whether time goes in steps."""
        return self.dt is not None

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dims of the matrices and of dt together."""
        shapes = [matrix.shape[:-2] for matrix in self._matrices().values()]
        return torch.broadcast_shapes(*shapes, self.dt.shape if isinstance(self.dt, Tensor) else ())

    def to_control(self) -> Any:
        """The same as a ``control.StateSpace`` of python-control, which must be installed.

        Raises:
            ValueError: the system is a batch.
        """
        import control

        _refuse_batch(self, "to_control")
        arrays = [matrix.detach().cpu().double().numpy() for matrix in self._matrices().values()]
        return control.ss(*arrays, 0 if self.dt is None else float(self.dt))


def ss(a: Any, b: Any = None, c: Any = None, d: Any = None, dt: float | Tensor | None = None) -> StateSpace:
    """A `StateSpace` from matrices, or from a system of python-control.

    Args:
        a: (*batch, d, d), tensor or nested numbers (these take the dtype of the tensors beside them, else float64);
            or, alone, a `StateSpace` or a ``control.StateSpace``, see `as_system`.
        b: (*batch, d, k). c: (*batch, m, d), default the identity: the state itself comes out. d: (*batch, m, k),
            default zero. dt: period in s; None or 0 for continuous time.

    Returns:
        `StateSpace`.

    Raises:
        TypeError: one argument that is no system, more arguments beside a system, dtypes that differ.
        ValueError: see `StateSpace`; dt=True, python-control's word for a period that nobody knows.
    """
    if b is None:
        if c is not None or d is not None or dt is not None:
            raise TypeError("ss takes a system alone, or matrices a and b at least")
        return as_system(a)
    given = next((value for value in (a, b, c, d) if isinstance(value, Tensor)), None)
    matrix_a, matrix_b = _as_matrix(a, given), _as_matrix(b, given)
    if c is None:
        c = torch.eye(matrix_a.shape[-1], dtype=matrix_a.dtype, device=matrix_a.device)
    matrix_c = _as_matrix(c, given)
    if d is None:
        d = matrix_c.new_zeros(matrix_c.shape[-2:-1] + matrix_b.shape[-1:])
    return StateSpace(matrix_a, matrix_b, matrix_c, _as_matrix(d, given), _period(dt))


def as_system(value: Any) -> StateSpace:
    """A `StateSpace` as it is; a ``control.StateSpace`` (known by its A, B, C, D and dt) copied to float64.

    A period of 0 is continuous time. So is python-control's None, which leaves the kind of time open.

    Raises:
        TypeError: anything else, such as a transfer function.
        ValueError: dt=True, a discrete system whose period nobody knows.
    """
    if isinstance(value, StateSpace):
        return value
    if not all(hasattr(value, name) for name in ("A", "B", "C", "D", "dt")):
        raise TypeError(f"a system must be a StateSpace or a control.StateSpace, got {type(value).__name__}")
    a, b, c, d = (torch.tensor(getattr(value, name), dtype=torch.float64) for name in "ABCD")
    return StateSpace(a, b, c, d, _period(value.dt))


# Poles and zeros ------------------------------------------------------------------------------------------------------


def eig(a: Tensor) -> Tensor:
    """Eigenvalues (*batch, d), complex, in no particular order, of a (*batch, d, d)."""
    return torch.linalg.eigvals(a)


def pinv(a: Tensor) -> Tensor:
    """Moore-Penrose inverse (*batch, n, m) of a (*batch, m, n).

    Singular values below eps max(m, n) of the largest count as zero.
    """
    return torch.linalg.pinv(a)


def poles(system: Any) -> Tensor:
    """Poles (*batch, d), complex, in no particular order: eigenvalues of A, with those that the input cannot move."""
    return eig(as_system(system).a)


def zeros(system: Any) -> Tensor:
    """Invariant zeros (z,), complex: where the pencil [[A - s I, B], [C, D]] loses rank.

    Of a system that is controllable and observable they are the transmission zeros. Infinite zeros are taken out first
    by orthogonal reductions, so that only finite ones reach the generalised eigenvalue problem; any number of inputs
    and outputs will do.

    Raises:
        ValueError: the system is a batch, whose rows may have different numbers of zeros.

    Source: Emami-Naeini and Van Dooren, Computation of zeros of linear multivariable systems, Automatica 18 (1982).
    """
    plant = as_system(system)
    _refuse_batch(plant, "zeros")
    from scipy.linalg import eigvals

    a, b, c, d = (matrix.detach().cpu().double().numpy() for matrix in plant._matrices().values())
    pencil = np.block([[a, b], [c, d]])
    tolerance = 10 * max(pencil.shape) * torch.finfo(plant.a.dtype).eps * float(np.linalg.norm(pencil))
    a, b, c, d = _without_infinite_zeros(a, b, c, d, tolerance)
    a, c, b, d = (matrix.T for matrix in _without_infinite_zeros(a.T, c.T, b.T, d.T, tolerance))
    # What is left of D is square and regular: on the null space of [C D] only A - s I remains.
    states = len(a)
    kernel = np.linalg.svd(np.hstack([c, d]))[2][len(c) :].T
    found = eigvals(np.hstack([a, b]) @ kernel, kernel[:states]) if states else np.zeros(0)
    kind = torch.complex64 if plant.a.dtype == torch.float32 else torch.complex128
    return torch.as_tensor(found).to(dtype=kind, device=plant.a.device)


def pzmap(system: Any, axes: Any = None) -> Any:
    """Poles (crosses) and zeros (circles) in the complex plane with the boundary of stability.

    The boundary is the imaginary axis, in discrete time the unit circle.

    Args:
        system: one system, no batch. axes: where to draw, default axes of a new figure.

    Returns:
        The matplotlib axes.

    Raises:
        ValueError: the system is a batch.
    """
    plant = as_system(system)
    _refuse_batch(plant, "pzmap")
    marks = {"poles": ("x", poles(plant)), "zeros": ("o", zeros(plant))}
    from matplotlib.figure import Figure

    axes = Figure(layout="constrained").add_subplot() if axes is None else axes
    boundary = {"color": "0.6", "linewidth": 1.0, "label": "boundary of stability"}
    if plant.is_discrete:
        angle = np.linspace(0, 2 * np.pi, 361)
        axes.plot(np.cos(angle), np.sin(angle), **boundary)
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.axvline(0.0, **boundary)
    for label, (marker, values) in marks.items():
        points = values.detach().cpu()
        axes.plot(points.real, points.imag, marker, fillstyle="none", label=label)
    axes.set_xlabel("real part" if plant.is_discrete else "real part (1/s)")
    axes.set_ylabel("imaginary part" if plant.is_discrete else "imaginary part (1/s)")
    axes.legend()
    return axes


# Discretisation -------------------------------------------------------------------------------------------------------


class Discretized(NamedTuple):
    """system: discrete. noise_covariance (*batch, d, d): of the noise gathered in one period, None without noise."""

    system: StateSpace
    noise_covariance: Tensor | None


def c2d(
    system: Any, dt: float | Tensor, noise_psd: Tensor | None = None, noise_input: Tensor | None = None
) -> Discretized:
    """The discrete system with the same states at the instants of sampling; exact, differentiable in all tensors.

    The input is held over each period. C and D stay: measurements are taken at the instants, with a covariance of
    their own. In filters that discretise at each step use `hold_input` and `integrate_noise`, which check nothing.

    Args:
        system: continuous `StateSpace` or ``control.StateSpace``.
        dt: period in s, a number or (*batch).
        noise_psd: (*batch, w, w) power spectral density Q of white noise in dx/dt = A x + B u + F w.
        noise_input: F (*batch, d, w), default the identity.

    Returns:
        `Discretized`.

    Raises:
        ValueError: a system that is discrete already, a period that is not positive, a density that is not positive
            semidefinite or does not fit.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978), eqs. 1.1-1.4.
    """
    plant = as_system(system)
    if plant.is_discrete:
        raise ValueError(f"c2d needs a continuous system, this one is discrete with dt = {plant.dt}")
    check_period(dt, plant.a)
    if noise_psd is None and noise_input is not None:
        raise ValueError("noise_input needs noise_psd beside it")
    covariance = None
    if noise_psd is not None:
        covariance = integrate_noise(plant.a, state_noise(plant.a, noise_psd, noise_input, "noise_psd"), dt)
    transition, push = hold_input(plant.a, plant.b, dt)
    return Discretized(StateSpace(transition, push, plant.c, plant.d, dt), covariance)


def hold_input(a: Tensor, b: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
    """Transition exp(A dt) (*batch, d, d) and the effect ∫ exp(A s) ds B (*batch, d, k) of an input that is held.

    a (*batch, d, d), b (*batch, d, k), dt in s, a number or (*batch), 0 allowed. Nothing is checked.
    """
    period = _column(dt, a)
    # The exponential works as finely as the largest entry of the block needs: unit size keeps inputs out of that.
    size = _size(b)
    top = torch.cat(_together(a * period, b / size), -1)
    block = torch.cat([top, torch.zeros_like(top[..., :1, :]).expand(*top.shape[:-2], b.shape[-1], top.shape[-1])], -2)
    states = a.shape[-1]
    whole = matrix_exp(block)[..., :states, :]
    return whole[..., :states], whole[..., states:] * (period * size)


def integrate_noise(a: Tensor, noise_psd: Tensor, dt: float | Tensor) -> Tensor:
    """Covariance ∫ exp(A s) Q exp(A s)ᵀ ds over [0, dt], symmetric.

    A Gauss sum over a part h of dt with ‖A‖ h <= 1; the rest is reached by doubling: Q(2h) = Q(h) + Φ(h) Q(h) Φ(h)ᵀ.
    Both are sums of semidefinite matrices without cancellation, so that stiff systems do not overflow, as they do in
    the block exponential, and short steps keep all digits.

    Args:
        a: (*batch, d, d). noise_psd: Q (*batch, d, d), symmetric, not checked.
        dt: in s, a number or (*batch), 0 allowed. Under torch.compile and torch.func ‖A‖ dt may reach a million.

    Returns:
        (*batch, d, d); NaN beyond the reach.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978), for the integrals.
    """
    part = _short_step(a, dt)
    covariance = _symmetric((part.weights * (part.responses @ noise_psd.unsqueeze(-3) @ part.responses.mT)).sum(-3))
    transition = part.transition
    for k in range(part.most):
        on = k < part.doublings
        covariance = torch.where(on, covariance + _symmetric(transition @ covariance @ transition.mT), covariance)
        transition = torch.where(on, transition @ transition, transition)
    return covariance


def noise_factor(a: Tensor, columns: Tensor, dt: float | Tensor) -> Tensor:
    """Lower factor of `integrate_noise` for Q = L Lᵀ, without forming a covariance; L (*batch, d, w) are the columns.

    Arguments, reach and source as there. A covariance by construction, but with a root's gradient at dt = 0.

    Returns:
        (*batch, d, d); NaN beyond the reach.
    """
    part = _short_step(a, dt)
    sums = (part.weights.sqrt() * (part.responses @ columns.unsqueeze(-3))).movedim(-3, -2).flatten(-2)
    factor = triangularize(pad(sums, (0, max(a.shape[-1] - sums.shape[-1], 0))))
    transition = part.transition
    for k in range(part.most):
        on = k < part.doublings
        factor = torch.where(on, triangularize(torch.cat([transition @ factor, factor], -1)), factor)
        transition = torch.where(on, transition @ transition, transition)
    return factor


def state_noise(a: Tensor, noise: Tensor, noise_input: Tensor | None, name: str) -> Tensor:
    """F Q Fᵀ (*batch, d, d) of noise (*batch, w, w) that enters by F (*batch, d, w), default the identity.

    Raises:
        TypeError: a dtype other than that of a.
        ValueError: Q, called ``name``, is not symmetric positive semidefinite; shapes do not fit; numbers not finite.
    """
    check_matrix(noise, name, a)
    psd_factor(noise, name)
    if noise_input is None:
        if noise.shape[-1] != a.shape[-1]:
            raise ValueError(
                f"{name} must be (*batch, {a.shape[-1]}, {a.shape[-1]}) or come with noise_input, "
                f"got shape {tuple(noise.shape)}"
            )
        return noise
    check_matrix(noise_input, "noise_input", a)
    if noise_input.shape[-2:] != (a.shape[-1], noise.shape[-1]):
        wanted = _text((a.shape[-1], noise.shape[-1]))
        raise ValueError(f"noise_input must be (*batch, {wanted}), got shape {tuple(noise_input.shape)}")
    return noise_input @ noise @ noise_input.mT


# Parts ----------------------------------------------------------------------------------------------------------------


def _without_infinite_zeros(a: Array, b: Array, c: Array, d: Array, tolerance: float) -> tuple[Array, ...]:
    """A smaller system with the same finite zeros, whose D has full row rank."""
    while True:
        left, values, _ = np.linalg.svd(d)
        rank = int((values > tolerance).sum())
        c, d = left.T @ c, (left.T @ d)[:rank]
        # Outputs that no input reaches at once must be zero: the state stays where they are.
        _, values, right = np.linalg.svd(c[rank:])
        bound = int((values > tolerance).sum())
        if bound == 0:
            return a, b, c[:rank], d
        basis = np.vstack([right[bound:], right[:bound]]).T
        a, b, c = basis.T @ a @ basis, basis.T @ b, c[:rank] @ basis
        free = len(a) - bound
        c, d = np.vstack([c[:, :free], a[free:, :free]]), np.vstack([d, b[free:]])
        a, b = a[:free, :free], b[:free]


class _ShortStep(NamedTuple):
    """A part h of a step: exp(A s) at the nodes (*batch, 8, d, d), their weights (*batch, 8, 1, 1), and exp(A h).

    doublings (*batch, 1, 1): how often h is to be doubled; most: in any row.
    """

    responses: Tensor
    weights: Tensor
    transition: Tensor
    doublings: Tensor
    most: int


def _short_step(a: Tensor, dt: float | Tensor) -> _ShortStep:
    period = _column(dt, a)
    doublings = torch.log2((_size(a) * period).detach()).ceil().clamp_min(0)
    traced = is_traced()
    limit = _TRACED_DOUBLINGS if traced else _DOUBLINGS
    most = limit if traced else int(doublings.nan_to_num(0).clamp_max(limit).max().item())
    step = (period * torch.exp2(-doublings)).masked_fill(doublings > limit, torch.nan).unsqueeze(-3)
    at = a.new_tensor([(node + 1) / 2 for node in _NODES] + [1.0])[:, None, None]
    moved = matrix_exp(a.unsqueeze(-3) * (step * at))
    weights = step * a.new_tensor([weight / 2 for weight in _WEIGHTS])[:, None, None]
    return _ShortStep(moved[..., :-1, :, :], weights, moved[..., -1, :, :], doublings, most)


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.mT) / 2


def _size(matrix: Tensor) -> Tensor:
    """1-norm (*batch, 1, 1) as a constant, 1 where the matrix is zero or has no entries."""
    if matrix.numel() == 0:
        return matrix.new_ones((*matrix.shape[:-2], 1, 1))
    size = matrix.detach().abs().sum(-2, keepdim=True).amax(-1, keepdim=True)
    return torch.where(size > 0, size, torch.ones_like(size))


def _together(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Both with the leading dims of both."""
    lead = torch.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    return first.expand(*lead, *first.shape[-2:]), second.expand(*lead, *second.shape[-2:])


def _column(dt: float | Tensor, like: Tensor) -> Tensor:
    """The period as (*batch, 1, 1)."""
    return torch.as_tensor(dt, dtype=like.dtype, device=like.device)[..., None, None]


def _as_matrix(value: Any, like: Tensor | None) -> Tensor:
    if isinstance(value, Tensor):
        return value
    tensor = torch.as_tensor(np.asarray(value))  # by way of NumPy, whose numbers are double
    wanted = torch.float64 if like is None else like.dtype
    return tensor.to(dtype=wanted, device=None if like is None else like.device)


def _period(dt: Any) -> Any:
    """The period by our convention, None for continuous time, from python-control's."""
    if dt is True:
        raise ValueError("dt=True is a discrete system whose period nobody knows; give the period in s")
    return None if dt is None or (not isinstance(dt, Tensor) and dt == 0) else dt


def check_period(dt: float | Tensor, like: Tensor) -> None:
    """Refuse what is no positive finite period, a number or a tensor (*batch) of the dtype of ``like``.

    Raises:
        TypeError: another dtype. ValueError: a period that is not positive and finite.
    """
    values = torch.as_tensor(dt, dtype=None if isinstance(dt, Tensor) else like.dtype).detach()
    if isinstance(dt, Tensor) and dt.dtype != like.dtype:
        raise TypeError(f"dt must have the dtype of a, {like.dtype}, got {dt.dtype}")
    bad = ~(torch.isfinite(values) & (values > 0))
    if isinstance(dt, bool) or bad.any():
        wrong = dt if isinstance(dt, bool) else values[bad].flatten()[0].item()
        raise ValueError(f"dt must be positive and finite, in s (None for continuous time), got {wrong}")


def check_matrix(matrix: Any, name: str, like: Tensor) -> None:
    """Refuse what is no finite matrix (*batch, rows, columns) of the dtype of ``like``, under its name.

    Raises:
        TypeError: no floating-point tensor, or another dtype. ValueError: another shape, a number that is not
        finite.
    """
    if not isinstance(matrix, Tensor) or not matrix.is_floating_point():
        kind = matrix.dtype if isinstance(matrix, Tensor) else type(matrix).__name__
        raise TypeError(f"{name} must be a floating-point tensor, got {kind}")
    if matrix.dtype != like.dtype:
        raise TypeError(f"{name} must have the dtype of a, {like.dtype}, got {matrix.dtype}")
    if matrix.dim() < 2:
        raise ValueError(f"{name} must be a matrix (*batch, rows, columns), got shape {tuple(matrix.shape)}")
    bad = ~torch.isfinite(matrix.detach())
    if bad.any():
        place = tuple(bad.nonzero()[0].tolist())
        raise ValueError(f"{name} must be finite, got {matrix[place].item()} at {place}")


def _refuse_batch(system: StateSpace, who: str) -> None:
    if system.batch_shape:
        raise ValueError(f"{who} needs one system, got a batch {tuple(system.batch_shape)}")


def _text(shape: tuple[int, ...]) -> str:
    return ", ".join(str(size) for size in shape)
