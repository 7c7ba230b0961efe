"""Laws of continuous-time systems between measurements: dx = f(x, u) dt + G dw.

The noise of a step is held by columns whose products are summed with positive weights, so that it is a covariance by
construction; no difference of large numbers is ever factorised.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearForm, LinearGaussian, call_style, check_control, check_finite, hold, row_steps
from torchfilt.linalg import apply_factor, for_points, is_differentiated, is_traced, psd_factor, triangularize
from torchfilt.model import StateSpaceModel
from torchfilt.models.control.systems import as_system, check_matrix, hold_input, noise_factor, state_noise
from torchfilt.models.ode import rk4
from torchfilt.spaces import EUCLIDEAN, Space, curved_components

Step = Tensor | float | None
Integrator = Callable[[Callable[[Tensor], Tensor], Tensor, Tensor | float], Tensor]

_HELD_STEPS = 8


class _Noise(nn.Module):
    """G times a factor of the spectral density Q; made once, or at each call where a gradient flows to either."""

    columns: Tensor
    psd: Tensor
    input: Tensor | None

    def __init__(self, psd: Tensor, noise_input: Tensor | None, d: int | None) -> None:
        super().__init__()
        factor = psd_factor(psd, "noise_psd")
        if noise_input is not None:
            check_finite(noise_input, "noise_input")
            size = "d" if d is None else d
            if (
                noise_input.dim() < 2
                or noise_input.shape[-1] != psd.shape[-1]
                or d not in (None, noise_input.shape[-2])
            ):
                raise ValueError(
                    f"noise_input must be (*batch, {size}, {psd.shape[-1]}) to fit the state and noise_psd "
                    f"{tuple(psd.shape)}, got {tuple(noise_input.shape)}"
                )
            if noise_input.dtype != psd.dtype:
                raise TypeError(f"noise_input must have noise_psd's dtype {psd.dtype}, got {noise_input.dtype}")
        elif d not in (None, psd.shape[-1]):
            raise ValueError(f"noise_psd must be {d} x {d} where no noise_input is given, got {tuple(psd.shape)}")
        self.learns = psd.requires_grad or (noise_input is not None and noise_input.requires_grad)
        if not self.learns:
            self.register_buffer("columns", factor if noise_input is None else noise_input @ factor)
            return
        hold(self, "psd", psd)
        if noise_input is None:
            self.input = None
        else:
            hold(self, "input", noise_input)

    def forward(self) -> Tensor:
        """Columns (*batch, d, q)."""
        if not self.learns:
            return self.columns
        factor = psd_factor(self.psd, "noise_psd")
        return factor if self.input is None else self.input @ factor


def _needs_step(dt: Step) -> Tensor | float:
    if dt is None:
        raise ValueError("no time step: a law of a continuous-time system needs dt")
    return dt


def _may_hold(parts: list[Tensor]) -> bool:
    """Whether matrices made of these tensors can be kept beyond the call."""
    if is_traced() or is_differentiated(*parts):
        return False
    return not torch.is_inference_mode_enabled() and not any(part.is_inference() for part in parts)


class ContinuousLinear(nn.Module):
    """Exact transition law of dx = (A x + B u) dt + G dw over any dt, with u held over the step.

    With a linear measurement law, `KalmanFilter` of this law is the continuous-discrete Kalman filter. Matrices of a
    time step given as a number are made once and held (the last eight steps), but not where a gradient flows to them,
    nor inside a compiled function.

    Args:
        a: A (d, d) or (*batch, d, d), 1/s; in a compiled function up to a 1-norm of 1e6 / dt, beyond which the noise is
            NaN.
        noise_psd: Q (q, q) or (*batch, q, q), two-sided spectral density of the white noise.
        noise_input: G (*batch, d, q); None: the identity.
        b: B (*batch, d, k) or None.

    Raises:
        TypeError: what is no floating-point tensor, dtypes that differ.
        ValueError: shapes that do not fit, numbers that are not finite, a density that is not positive semidefinite;
            when called: without dt, or u without b.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978), for the integrals.
    """

    a: Tensor
    b: Tensor | None

    def __init__(
        self, a: Tensor, noise_psd: Tensor, noise_input: Tensor | None = None, b: Tensor | None = None
    ) -> None:
        super().__init__()
        for name, matrix in (("a", a), ("noise_psd", noise_psd), ("b", b)):
            if matrix is not None:
                check_matrix(matrix, name, a)
        if a.shape[-1] != a.shape[-2]:
            raise ValueError(f"a must be a square matrix (*batch, d, d), got shape {tuple(a.shape)}")
        d = a.shape[-1]
        if b is not None and b.shape[-2] != d:
            raise ValueError(f"b must be (*batch, {d}, k) to fit a {tuple(a.shape)}, got {tuple(b.shape)}")
        self.noise = _Noise(noise_psd, noise_input, d)
        hold(self, "a", a)
        if b is None:
            self.b = None
        else:
            hold(self, "b", b)
        self._held: dict[float, tuple[Any, ...]] = {}

    @property
    def takes_controls(self) -> bool:
        """Whether u is looked at."""
        return self.b is not None

    def matrices(self, dt: Tensor | float) -> tuple[Tensor, Tensor | None, Tensor]:
        """Transition (..., d, d), input matrix (..., d, k) or None and noise factor (..., d, d) over dt.

        Args:
            dt: number or (*lead, 1), s.
        """
        parts = [part for part in (self.a, self.noise(), self.b) if part is not None]
        if isinstance(dt, Tensor) or not _may_hold(parts):
            return self._make(dt)
        # Told by identity and version: a module that is moved, loaded or called with other tensors starts anew.
        key = [(part, part._version, part.dtype, part.device) for part in parts]
        held = self._held.get(dt)
        if held is None or not all(a[0] is b[0] and a[1:] == b[1:] for a, b in zip(held[0], key, strict=True)):
            held = key, self._make(dt)
            while len(self._held) >= _HELD_STEPS:
                del self._held[next(iter(self._held))]
            self._held[dt] = held
        result: tuple[Tensor, Tensor | None, Tensor] = held[1]
        return result

    def _make(self, dt: Tensor | float) -> tuple[Tensor, Tensor | None, Tensor]:
        step = row_steps(dt, self.a)
        a = for_points(self.a, 2, step.dim())
        columns = for_points(self.noise(), 2, step.dim())
        b = a.new_zeros(*a.shape[:-1], 0) if self.b is None else for_points(self.b, 2, step.dim())
        transition, push = hold_input(a, b, step)
        return transition, push if self.b is not None else None, noise_factor(a, columns, step)

    def linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        """The matrices over dt, a number or (*lead, 1), s; u (..., k) enters the offset.

        Raises:
            ValueError: a control without b, or b without a control.
        """
        if u is not None and self.b is None:
            raise ValueError(f"a control u {tuple(u.shape)} was given, but this law has no b")
        transition, push, factor = self.matrices(_needs_step(dt))
        if push is None:
            return LinearForm(transition, None, factor)
        if u is None:
            raise ValueError("this law has an input matrix b but no control u was given")
        check_control(u, push)
        if push.dim() == 2:
            return LinearForm(transition, u @ push.mT, factor)
        return LinearForm(transition, apply_factor(push, u.expand(*push.shape[:-2], u.shape[-1])), factor)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., d) after dt."""
        matrix, offset, factor = self.linear_form(u, dt)
        lead = x.dim() - 1
        mean = apply_factor(for_points(matrix, 2, lead), x)
        mean = mean if offset is None else mean + for_points(offset, 1, lead)
        return Gaussian(mean, for_points(factor, 2, lead))


class ContinuousTransition(nn.Module):
    """Transition law of dx = f(x, u) dt + G dw: mean, transition matrix and noise covariance integrated together.

    The mean follows x' = f(x, u), u held over dt; the transition matrix Phi' = F Phi with F = df/dx along the mean; the
    noise is the integral of Phi(dt, s) G Q G^T Phi(dt, s)^T by Simpson's rule, whose weights are positive, so that it
    is a covariance whatever the step. As the ODE for the covariance is linear, its solution from any P is
    Phi P Phi^T + noise: `ExtendedKalmanFilter` of this law is the continuous-discrete extended filter, dP/dt = F P +
    P F^T + G Q G^T, in square-root form. Unscented and particle filters move their points by the same law.

    All are of fourth order in dt / steps. A chain of n integrators from noise to state needs n <= 2 steps + 1 for a
    noise of full rank; where noise passes three or more, Simpson's rule leaves 4 % of the last variance at one step.

    Args:
        drift: f(x, u) -> x' (..., d), batched over leading dims; u may be absent. A module is registered.
        noise_psd: Q (q, q), spectral density of the white noise.
        noise_input: G (d, q); None: the identity.
        steps: equal parts of dt, each two Runge-Kutta steps and one Simpson rule.
        space: where the state lives, Euclidean axes and angles; the derivative is that of the components.
        jacobian: F(x, u) -> (..., d, d), of the same arguments as drift; None: by forward-mode differentiation.
        integrator: (f, z, dt) -> z at the end of z' = f(z), with z (..., n), dt a number or (..., 1); None: one step of
            `torchfilt.models.ode.rk4`. Adaptive ones share their step between the rows of a batch, and most neither
            compile nor vmap.

    Raises:
        TypeError: drift, jacobian or integrator is not callable; dtypes that differ.
        ValueError: steps below 1, a curved space, a density that is not positive semidefinite, shapes that do not fit;
            when called: without dt, a drift or Jacobian of another shape.

    Sources: Jazwinski, Stochastic Processes and Filtering Theory (1970); Särkkä and Solin, Applied Stochastic
        Differential Equations (2019).
    """

    def __init__(
        self,
        drift: Callable[..., Tensor],
        noise_psd: Tensor,
        noise_input: Tensor | None = None,
        steps: int = 1,
        space: Space = EUCLIDEAN,
        jacobian: Callable[..., Tensor] | None = None,
        integrator: Integrator | None = None,
    ) -> None:
        super().__init__()
        for name, value in (("drift", drift), ("jacobian", jacobian), ("integrator", integrator)):
            if not callable(value) and (name == "drift" or value is not None):
                raise TypeError(f"{name} must be a function, got {type(value).__name__}")
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise ValueError(f"steps must be a whole number of at least 1, got {steps}")
        if curved_components(space, int(space.tangent_size or 0)):
            raise ValueError(f"space must be made of Euclidean axes and angles, got {space!r}")
        self.noise = _Noise(noise_psd, noise_input, space.size)
        self.drift, self.jacobian, self.integrator = drift, jacobian, integrator
        self.style = call_style(drift)
        self.jacobian_style = self.style if jacobian is None else call_style(jacobian)
        self.steps, self.space = steps, space

    @property
    def takes_controls(self) -> bool:
        """Whether the drift looks at u."""
        return self.style.takes_u

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., d) after dt."""
        return self.first_order(x, u, dt)[0]

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the transition matrix Phi (..., d, d).

        Args:
            x: (..., d).
            u: control (..., k) or None.
            dt: number or (..., 1), s.

        Returns:
            The law, and Phi: the derivative of the mean by x.

        Raises:
            ValueError: noise of another size than the state.
        """
        half = _needs_step(dt) / (2 * self.steps)
        columns, d = self.noise(), x.shape[-1]
        if columns.shape[-2] != d:
            raise ValueError(f"the noise reaches {columns.shape[-2]} numbers, the state {tuple(x.shape)} has {d}")
        eye = torch.eye(d, dtype=x.dtype, device=x.device).expand(*x.shape, d)
        gain = for_points(columns, 2, x.dim() - 1).expand(*x.shape, -1)
        # Simpson's weights over all parts are 1 4 2 4 ... 2 4 1 times a third of a half part.
        width = half.unsqueeze(-1) if isinstance(half, Tensor) and half.dim() > 0 else half
        transition, noise = eye, gain * (width / 3) ** 0.5
        for k in range(1, 2 * self.steps + 1):
            x, ahead = self._half(x, eye, u, half)
            weight = 1 if k == 2 * self.steps else 4 if k % 2 else 2
            transition = ahead @ transition
            noise = torch.cat([ahead @ noise, gain * (weight * width / 3) ** 0.5], -1)
        if noise.shape[-1] < d:
            noise = torch.nn.functional.pad(noise, (0, d - noise.shape[-1]))
        return Gaussian(self.space.project(x), triangularize(noise), self.space), transition

    def _half(self, x: Tensor, eye: Tensor, u: Tensor | None, dt: Tensor | float) -> tuple[Tensor, Tensor]:
        """State and transition matrix after dt, of one ODE of d + d^2 numbers."""
        d = x.shape[-1]

        def derivative(z: Tensor) -> Tensor:
            rate, matrix = self._rates(z[..., :d], z[..., d:].unflatten(-1, (d, d)), u)
            return torch.cat([rate, matrix.flatten(-2)], -1)

        start = torch.cat([x, eye.flatten(-2)], -1)
        if self.integrator is None:
            end = rk4(lambda s, z: derivative(z), start, dt)
        else:
            end = self.integrator(derivative, start, dt)
        return end[..., :d], end[..., d:].unflatten(-1, (d, d))

    def _rates(self, x: Tensor, transition: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """The rates f of the state and F Phi of the transition matrix."""
        if self.jacobian is not None:
            rate = self._called(x, u)
            matrix = self.jacobian_style.call(self.jacobian, x, u, None)
            if matrix.shape[-2:] != (x.shape[-1], x.shape[-1]):
                raise ValueError(f"jacobian must give (..., {x.shape[-1]}, {x.shape[-1]}), got {tuple(matrix.shape)}")
            return rate, matrix @ transition
        # One row per column of Phi; each evaluates the same state, so any of them tells its rate.
        points = x.unsqueeze(-2).expand_as(transition).contiguous()
        controls = u.unsqueeze(-2) if u is not None and u.dim() > 1 else u
        rate, slope = torch.func.jvp(lambda at: self._called(at, controls), (points,), (transition.mT,))[:2]
        return rate[..., 0, :], slope.mT

    def _called(self, x: Tensor, u: Tensor | None) -> Tensor:
        rate: Tensor = self.style.call(self.drift, x, u, None)
        if rate.shape != x.shape:
            raise ValueError(f"drift must turn x {tuple(x.shape)} into as many numbers, got {tuple(rate.shape)}")
        return rate


def linear_model(
    system: Any,
    process_noise: Tensor,
    measurement_noise: Tensor,
    initial: Gaussian,
    noise_input: Tensor | None = None,
) -> StateSpaceModel:
    """A linear system with noise as a model for every filter: discrete laws, or exact ones of any dt.

    Args:
        system: `StateSpace` or ``control.StateSpace``, or a batch of them. A continuous one moves between
            measurements; these are taken at instants.
        process_noise: of a discrete system the covariance of w in x' = A x + B u + F w, of a continuous one its
            spectral density; (w, w).
        measurement_noise: covariance of a measurement (m, m). A density R of continuous measurements, averaged over dt,
            is the covariance R / dt.
        initial: the prior.
        noise_input: F (d, w); None: the identity.

    Returns:
        A `StateSpaceModel` with the systems' batch.
    """
    plant = as_system(system)
    noise = state_noise(plant.a, process_noise, noise_input, "process_noise")
    if plant.is_discrete:
        motion: nn.Module = LinearGaussian(plant.a, noise, control_matrix=_given(plant.b))
    else:
        motion = ContinuousLinear(plant.a, process_noise, noise_input, _given(plant.b))
    return StateSpaceModel(initial, motion, LinearGaussian(plant.c, measurement_noise, control_matrix=_given(plant.d)))


def _given(matrix: Tensor) -> Tensor | None:
    """None where the matrix has no effect."""
    return matrix if matrix.numel() and bool((matrix != 0).any()) else None
