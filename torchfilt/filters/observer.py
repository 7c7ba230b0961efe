"""Linear observers: a gain that was designed once, instead of one computed at every step."""

from typing import Any

import torch
from torch import Tensor

from torchfilt.gaussian import LOG_2PI, Gaussian, cat_columns, mask_rows
from torchfilt.laws import check_control, check_finite, row_steps
from torchfilt.linalg import apply_factor, log_abs_diagonal, psd_factor, triangularize, whiten
from torchfilt.models.control.continuous import ContinuousLinear, linear_model
from torchfilt.models.control.design import kalman
from torchfilt.models.control.systems import StateSpace, as_system, hold_input, noise_factor, ss, state_noise
from torchfilt.moments import law_space
from torchfilt.run import Evidence, Filter, check_model
from torchfilt.types import FilterState, Missing, Step, StepInfo, StepNoise


class LuenbergerObserver(Filter[Gaussian]):
    """A linear observer with a gain of one's own choice, such as one by pole placement.

    Discrete system: x- = A x + B u, then x = x- + K (y - C x- - D u), so that the error moves by (I - K C) A; a gain L
    of the predictor form, with poles of A - L C, is K = A^-1 L. dt need not be given; it must be the system's own, or
    0 for no motion.

    Continuous system: x' = A x + B u + L (y - C x - D u), solved exactly over dt with u and y held at the values of the
    step. A y that changes by itself over dt is thus taken for its value at the end, an error of order dt in the
    estimate; a discrete gain for the sampled system has none. A step with dt = 0 takes nothing in.

    A component that is NaN corrects nothing; its column of the gain is zero for the step and the row.

    Covariance and likelihood are only claimed where the noise is known: with process_noise and measurement_noise the
    belief holds the true error covariance of this gain, best or not, from the prior's on; with C as it is and the model
    true. Without them covariance and log-likelihood are NaN, and `ok` speaks of the mean alone. In continuous time the
    log-likelihood is NaN in any case: an observer that never stops has no one innovation a step.

    Args:
        system: `StateSpace` or ``control.StateSpace``, one for all rows.
        gain: K or L (d, m).
        initial: the prior, a `Gaussian`, or its mean (d,) or (*batch, d); None: zeros. A covariance plays a part only
            with noise, and must then be given.
        process_noise: of a discrete system the covariance of w in x' = A x + B u + F w, of a continuous one its
            spectral density (w, w); None: nothing claimed.
        measurement_noise: covariance (m, m), of a continuous system the spectral density.
        noise_input: F (d, w); None: the identity.

    Raises:
        TypeError: dtypes that differ, a gain that is no tensor.
        ValueError: a batch of systems, a gain or prior of another shape, a gain that is not finite, one noise without
            the other, noise without a prior that is a Gaussian; when run: a control of another size, a dt that is not
            the system's, a continuous system without dt.

    Source: Luenberger, An introduction to observers, IEEE TAC 16 (1971).
    """

    carries = Gaussian
    gain: Tensor
    evidence: Evidence = "approximate"  # innovations of a gain that is not the best are not independent

    def __init__(
        self,
        system: Any,
        gain: Tensor,
        initial: Gaussian | Tensor | None = None,
        process_noise: Tensor | None = None,
        measurement_noise: Tensor | None = None,
        noise_input: Tensor | None = None,
    ) -> None:
        plant = as_system(system)
        _check_gain(plant, gain)
        if (process_noise is None) != (measurement_noise is None):
            raise ValueError("process_noise and measurement_noise are given together, or neither")
        claims = process_noise is not None
        if claims and not isinstance(initial, Gaussian):
            raise ValueError("with noise, initial must be a Gaussian: its covariance is where the error's starts")
        if noise_input is not None and not claims:
            raise ValueError("noise_input needs process_noise beside it")
        like, (m, d) = plant.a, plant.c.shape
        process = like.new_zeros(d, d) if process_noise is None else process_noise
        measured = like.new_zeros(m, m) if measurement_noise is None else measurement_noise
        super().__init__(linear_model(plant, process, measured, _prior(initial, like), noise_input))
        self.claims, self.dt = claims, None if plant.dt is None else float(plant.dt)
        for name in ("a", "b", "c", "d"):
            self.register_buffer(name, getattr(plant, name).clone())
        self.register_buffer("gain", gain.clone())
        self.register_buffer("process_root", psd_factor(state_noise(like, process, noise_input, "process_noise")))
        self.register_buffer("measurement_root", psd_factor(measured, "measurement_noise"))
        self.whole = None if plant.is_discrete else self._continuous()

    a: Tensor
    b: Tensor
    c: Tensor
    d: Tensor
    process_root: Tensor
    measurement_root: Tensor

    def _continuous(self) -> ContinuousLinear:
        """The observer's own system where all is measured, driven by (u, y)."""
        a, b, columns = self._driven(self.gain)
        eye = torch.eye(columns.shape[-1], dtype=columns.dtype, device=columns.device)
        return ContinuousLinear(a, eye, columns, b)

    def _driven(self, gain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A - L C, the input matrix of (u, y), and the columns of the error's noise."""
        push = torch.cat([(self.b - gain @ self.d).expand(*gain.shape[:-1], self.b.shape[-1]), gain], -1)
        return self.a - gain @ self.c, push, cat_columns(self.process_root, gain @ self.measurement_root)

    def poles(self) -> Tensor:
        """Poles of the error (d,), complex: per step, or per second of a continuous system."""
        a = self.a - self.gain @ self.c if self.dt is None else self.a - self.gain @ self.c @ self.a
        return torch.linalg.eigvals(a)

    def stationary_covariance(self) -> Tensor:
        """Error covariance (d, d) that this gain settles to, after the measurement; by SciPy's Lyapunov solvers.

        Returns:
            (d, d), in the states' units.

        Raises:
            ValueError: no noise was given, or the error does not die out; the pole is named.
        """
        if not self.claims:
            raise ValueError("no covariance: the observer was made without process_noise and measurement_noise")
        poles = self.poles()
        size = poles.real if self.dt is None else poles.abs() - 1
        if bool((size >= 0).any()):
            raise ValueError(f"the error does not die out: pole {complex(poles[size.argmax()]):.6g}")
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        if self.dt is None:
            a, _, columns = self._driven(self.gain)
            solve, sign = solve_continuous_lyapunov, -1
        else:
            left = torch.eye(len(self.a), dtype=self.a.dtype, device=self.a.device) - self.gain @ self.c
            a, columns = left @ self.a, cat_columns(left @ self.process_root, self.gain @ self.measurement_root)
            solve, sign = solve_discrete_lyapunov, 1
        values, noise = (part.detach().cpu().double().numpy() for part in (a, columns @ columns.mT))
        return torch.as_tensor(solve(values, sign * noise)).to(self.a)

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Gaussian]:
        """The prior; without noise its covariance is NaN."""
        prior = self.model.prior(batch_shape)
        mean = prior.mean.expand(*batch_shape, prior.mean.shape[-1])
        factor = prior.factor() if self.claims else torch.full_like(self.a, torch.nan)
        return FilterState(Gaussian(mean, factor), 0, seed)

    def advance(
        self,
        belief: Gaussian,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Gaussian, StepInfo]:
        """See `Filter.advance`; noise is not used."""
        _check_measured(y, self.c)
        u = self.b.new_zeros(self.b.shape[-1]) if u is None else u
        check_control(u, self.b)
        observed = _observed(y, missing)
        gain = self.gain if observed is None else self.gain * observed.to(y.dtype).unsqueeze(-2)
        if self.dt is None:
            return self._flow(belief, y, u, dt if predict else 0.0, gain, observed)
        mean, root = belief.mean, belief.scale_tril
        if predict and _moves(dt, self.dt):
            mean = apply_factor(self.a, mean) + u @ self.b.mT
            root = triangularize(cat_columns(self.a @ root, self.process_root)) if self.claims else root
        expected = apply_factor(self.c, mean) + u @ self.d.mT
        innovation = _difference(y - expected, observed)
        after = mean + apply_factor(gain, innovation)
        if not self.claims:
            return Gaussian(after, root), self._unclaimed(after, innovation)
        factor, info = _fixed_gain(root, gain, self.c, self.measurement_root, innovation, observed)
        return Gaussian(after, factor), _status(info._replace(evidence=self.evidence), after, factor)

    def _flow(
        self, belief: Gaussian, y: Tensor, u: Tensor, dt: Step, gain: Tensor, observed: Tensor | None
    ) -> tuple[Gaussian, StepInfo]:
        """The observer's differential equation over dt."""
        if dt is None:
            raise ValueError("no time step: an observer of a continuous system needs dt")
        filled = y if observed is None else torch.where(observed, y, 0)
        # What is off at the start of the step: in continuous time there is no other innovation.
        expected = apply_factor(self.c, belief.mean) + u @ self.d.mT
        innovation = _difference(filled - expected, observed)
        if observed is None and self.whole is not None:
            transition, push, noise = self.whole.matrices(dt)
        else:
            step = row_steps(dt, self.a)
            a, b, columns = self._driven(gain)
            (transition, push), noise = hold_input(a, b, step), noise_factor(a, columns, step)
        assert push is not None
        lead = belief.mean.shape[:-1]
        driven = torch.cat([u.expand(*lead, u.shape[-1]), filled.expand(*lead, y.shape[-1])], -1)
        mean = apply_factor(transition, belief.mean) + apply_factor(push, driven)
        if not self.claims:
            return Gaussian(mean, belief.scale_tril), self._unclaimed(mean, innovation)
        factor = triangularize(cat_columns(transition @ belief.scale_tril, noise))
        return Gaussian(mean, factor), _status(self._unclaimed(mean, innovation), mean, factor)

    def _unclaimed(self, mean: Tensor, innovation: Tensor) -> StepInfo:
        probe = mean.sum(-1)
        return StepInfo(torch.full_like(probe, torch.nan), probe - probe == 0, innovation, evidence=self.evidence)


class SteadyStateKalmanFilter(Filter[Gaussian]):
    """The Kalman filter with the gain that it settles to, from the Riccati equation: no covariance recursion.

    With ``settled`` the error is claimed to be stationary from the start: the covariance of the belief and of the
    innovation are constants that all rows share, and the prior's own covariance is not looked at. Until transients have
    died out that is a claim, not a fact; ``settled=False`` starts from the prior's covariance and carries the true
    error covariance of the constant gain (Joseph's form) instead.

    A measurement with NaN components is taken in by the exact gain for what is there, given the stationary prediction.
    The error is then no longer stationary: from that step on the true covariance is carried, per row where rows miss
    different components, with innovations and likelihood that fit, while the gain for whole measurements stays. So does
    a belief that comes from elsewhere than this filter's own `init` and steps, such as a file.

    Args:
        model: laws that give their linear form, such as of `torchfilt.models.control.linear_model`, with constant
            matrices (one system for all rows).
        dt: the time step that the gain belongs to, s; None for laws without one. At each step dt is to be left out or
            the same; 0 is no motion.
        settled: see above.

    Raises:
        TypeError: not a model, a law without linear form.
        ValueError: a batch of systems, an error that is not detectable or not stabilised by noise (the mode is named);
            when run: another dt.

    Source: Anderson and Moore, Optimal Filtering (1979).
    """

    carries = Gaussian
    gain: Tensor
    predicted: Tensor
    posterior: Tensor
    innovation_scale_tril: Tensor
    a: Tensor
    c: Tensor
    process_root: Tensor
    measurement_root: Tensor

    def __init__(self, model: Any, dt: float | None = None, settled: bool = True) -> None:
        check_model(model)
        for name in ("transition", "observation"):
            if not hasattr(getattr(model, name), "linear_form"):
                kind = type(getattr(model, name)).__name__
                raise TypeError(f"SteadyStateKalmanFilter needs linear laws; {name} is a {kind} without linear_form")
        super().__init__(model)
        if dt is not None and not 0 < dt < float("inf"):
            raise ValueError(f"dt must be positive and finite, got {dt}")
        self.dt, self.settled = dt, settled
        self.evidence = "approximate"  # stationary from the start is a claim, and a constant gain is the best only then
        a, process_root = _constants(model.transition, dt)
        c, measurement_root = _constants(model.observation, dt)
        if a.dim() != 2 or c.dim() != 2 or process_root.dim() != 2 or measurement_root.dim() != 2:
            raise ValueError(f"a stationary gain needs one system for all rows, got a matrix {tuple(a.shape)}")
        system = ss(a, a.new_zeros(len(a), 0), c, dt=1.0)
        found = kalman(system, process_root @ process_root.mT, measurement_root @ measurement_root.mT)
        predicted = psd_factor(found.covariance)
        left = torch.eye(len(a), dtype=a.dtype, device=a.device) - found.gain @ c
        values = {
            "a": a,
            "c": c,
            "process_root": process_root,
            "measurement_root": measurement_root,
            "gain": found.gain,
            "predicted": predicted,
            "posterior": triangularize(cat_columns(left @ predicted, found.gain @ measurement_root)),
            "innovation_scale_tril": triangularize(cat_columns(c @ predicted, measurement_root)),
        }
        for name, value in values.items():
            self.register_buffer(name, value.detach().clone())
        for name in ("transition", "observation"):
            rest, push = _response(getattr(model, name), dt)
            self.register_buffer(f"{name}_rest", rest)
            self.register_buffer(f"{name}_push", push)

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Gaussian]:
        """The prior's mean with the stationary covariance, or with its own (``settled=False``)."""
        prior = self.model.prior(batch_shape)
        mean = prior.mean.expand(*batch_shape, prior.mean.shape[-1])
        return FilterState(Gaussian(mean, self.posterior if self.settled else prior.factor(), prior.space), 0, seed)

    def advance(
        self,
        belief: Gaussian,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Gaussian, StepInfo]:
        """See `Filter.advance`; noise is not used."""
        _check_measured(y, self.c)
        stationary = belief.scale_tril is self.posterior
        moves = predict and _moves(dt, self.dt)
        mean, root = belief.mean, belief.scale_tril
        if moves:
            mean = belief.space.project(apply_factor(self.a, mean) + self._offset("transition", u))
        expected = apply_factor(self.c, mean) + self._offset("observation", u)
        observed = _observed(y, missing)
        filled = y if observed is None else torch.where(observed, y, expected)
        innovation = _difference(law_space(self.model.observation).local(expected, filled), observed)
        if stationary and moves and observed is None:
            return self._constant(belief, mean, innovation)
        if moves:
            root = self.predicted if stationary else triangularize(cat_columns(self.a @ root, self.process_root))
        gain = self.gain if observed is None else self._gain(observed)
        after = belief.space.retract(mean, apply_factor(gain, innovation))
        factor, info = _fixed_gain(root, gain, self.c, self.measurement_root, innovation, observed)
        return Gaussian(after, factor, belief.space), _status(info._replace(evidence=self.evidence), after, factor)

    def _offset(self, name: str, u: Tensor | None) -> Tensor | float:
        """What a law adds at the control u."""
        push: Tensor | None = getattr(self, f"{name}_push")
        if push is not None:
            if u is None:
                raise ValueError(f"the {name} has an input matrix but no control u was given")
            check_control(u, push)
            rest: Tensor = getattr(self, f"{name}_rest")
            return rest + u @ push.mT
        offset = getattr(self.model, name).linear_form(u if self._hears(name) else None, self.dt).offset
        return 0.0 if offset is None else offset

    def _hears(self, name: str) -> bool:
        return bool(getattr(getattr(self.model, name), "takes_controls", True))

    def _constant(self, belief: Gaussian, mean: Tensor, innovation: Tensor) -> tuple[Gaussian, StepInfo]:
        """Nothing but the mean moves."""
        after = belief.space.retract(mean, apply_factor(self.gain, innovation))
        scale = self.innovation_scale_tril
        nis = whiten(scale, innovation).square().sum(-1)
        log_likelihood = -0.5 * (nis + innovation.shape[-1] * LOG_2PI) - log_abs_diagonal(scale)
        info = StepInfo(log_likelihood, nis == nis, innovation, scale, nis, evidence=self.evidence)
        return Gaussian(after, self.posterior, belief.space), _status(info, after, self.posterior)

    def _gain(self, observed: Tensor) -> Tensor:
        """Gain (..., d, m) for the components that are there, given the stationary prediction."""
        top = mask_rows(cat_columns(self.c @ self.predicted, self.measurement_root), observed)
        root = triangularize(top)
        cross = (self.predicted @ (self.c @ self.predicted).mT) * observed.to(top.dtype).unsqueeze(-2)
        return torch.cholesky_solve(cross.mT.expand(*root.shape[:-1], cross.shape[-2]), root).mT


def _fixed_gain(
    root: Tensor, gain: Tensor, c: Tensor, measurement_root: Tensor, innovation: Tensor, observed: Tensor | None
) -> tuple[Tensor, StepInfo]:
    """Factor of (I - K C) P (I - K C)^T + K R K^T, and the report: true for any gain (Joseph's form)."""
    seen = cat_columns(c @ root, measurement_root)
    seen = seen if observed is None else mask_rows(seen, observed)
    scale = triangularize(seen)
    nis = whiten(scale, innovation).square().sum(-1)
    count = innovation.shape[-1] if observed is None else observed.to(innovation.dtype).sum(-1)
    log_likelihood = -0.5 * (nis + count * LOG_2PI) - log_abs_diagonal(scale)
    factor = triangularize(cat_columns(root - gain @ (c @ root), gain @ measurement_root))
    if observed is not None:  # rows without any measurement keep what they had, to the bit
        factor = torch.where(observed.any(-1)[..., None, None], factor, root)
    return factor, StepInfo(log_likelihood, nis == nis, innovation, scale, nis)


def _status(info: StepInfo, mean: Tensor, factor: Tensor) -> StepInfo:
    probe = mean.sum(-1) + factor.sum((-2, -1))
    return info._replace(ok=probe - probe == 0)


def _observed(y: Tensor, missing: Missing) -> Tensor | None:
    """Mask (..., m) of what was measured, (m,) where rows share it, None where nothing is missing."""
    if missing == "none":
        return None
    observed = ~torch.isnan(y)
    return observed.reshape(-1, observed.shape[-1])[0] if missing == "shared" else observed


def _difference(innovation: Tensor, observed: Tensor | None) -> Tensor:
    return innovation if observed is None else torch.where(observed, innovation, 0)


def _moves(dt: Step, period: float | None) -> bool:
    """Whether there is motion; a step other than the one that the gain belongs to is an error."""
    if dt is None:
        return True
    if isinstance(dt, Tensor):
        raise ValueError("the gain belongs to one time step: dt must be left out, or be this number or 0")
    if dt == 0:
        return False
    if period is None or abs(dt - period) > 1e-6 * period:
        raise ValueError(f"the gain belongs to the time step {period}, got dt = {dt}")
    return True


def _constants(law: Any, dt: float | None) -> tuple[Tensor, Tensor]:
    """Matrix and factor of a law's linear form at rest."""
    matrix, _, factor = law.linear_form(_at_rest(law), dt)
    return matrix, factor


def _at_rest(law: Any) -> Tensor | None:
    """A control of zeros where the law wants one, by its input matrix."""
    for name in ("control_matrix", "b"):
        matrix = getattr(law, name, None)
        if isinstance(matrix, Tensor):
            return matrix.new_zeros(matrix.shape[-1])
    return None


def _response(law: Any, dt: float | None) -> tuple[Tensor | None, Tensor | None]:
    """Offset without control, and its derivative by the control (e, k); None where the law is to be asked each time."""
    rest = _at_rest(law)
    if rest is None:
        return None, None
    offset = law.linear_form(rest, dt).offset.detach()
    each = law.linear_form(torch.eye(len(rest), dtype=rest.dtype, device=rest.device), dt).offset.detach()
    return offset.clone(), (each - offset).mT.contiguous()


def _check_measured(y: Tensor, c: Tensor) -> None:
    if y.shape[-1] != len(c):
        raise ValueError(f"the measurement has {y.shape[-1]} numbers, the system gives {len(c)}")


def _check_gain(plant: StateSpace, gain: Tensor) -> None:
    """One finite gain for one system."""
    if plant.batch_shape:
        raise ValueError(f"an observer needs one system for all rows, got a batch {tuple(plant.batch_shape)}")
    if not isinstance(gain, Tensor):
        raise TypeError(f"gain must be a tensor (d, m), got {type(gain).__name__}")
    if gain.shape != (len(plant.a), len(plant.c)):
        raise ValueError(f"gain must be ({len(plant.a)}, {len(plant.c)}) = (d, m), got {tuple(gain.shape)}")
    check_finite(gain, "gain")
    if gain.dtype != plant.a.dtype:
        raise TypeError(f"gain must have the system's dtype {plant.a.dtype}, got {gain.dtype}")


def _prior(initial: Gaussian | Tensor | None, like: Tensor) -> Gaussian:
    """A Gaussian; where only a mean is known its deviations are zero and play no part."""
    if isinstance(initial, Gaussian):
        return initial
    mean = like.new_zeros(len(like)) if initial is None else initial
    if mean.shape[-1:] != like.shape[-1:]:
        raise ValueError(f"initial must be a mean (*batch, {len(like)}), got shape {tuple(mean.shape)}")
    return Gaussian(mean, like.new_zeros(len(like)), is_diagonal=True)
