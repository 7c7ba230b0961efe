"""Public conformance suite: what every law, rule, filter, resampler and space must satisfy.

Each check takes one object with a little data, raises an AssertionError that says which rule was broken and by how
much, and leaves the object as it was. A new law or filter of your own passes the same checks as those that ship::

    from torchfilt.testing import check_law
    check_law(MyLaw(), x)
"""

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import AdditiveGaussian, LinearGaussian, call_style
from torchfilt.model import StateSpaceModel, as_gaussian
from torchfilt.moments import Rule, predict, update
from torchfilt.particles import Particles, PastStep
from torchfilt.resampling import Resampler
from torchfilt.run import Filter
from torchfilt.spaces import Angle, Space
from torchfilt.symmetry import GaugedInitial, GaugedTransition, gauge_first_order, into_gauge
from torchfilt.types import FilterError, FilterState, Guarded, StepNoise

Step = Tensor | float | None

__all__ = ["check_filter", "check_law", "check_resampler", "check_rule", "check_space", "check_symmetry"]


# ----------------------------------------------------------------------------------------------------------------------
# Laws


def check_law(
    law: Callable[..., Any],
    x: Tensor,
    u: Tensor | None = None,
    dt: Step = None,
    *,
    tolerance: float = 1e-10,
    single: bool = True,
) -> None:
    """A conditional law: shapes, dtype, rows that do not know of each other, no hidden state.

    Args:
        law: called as ``law(x)``, or with u and dt where it takes them.
        x: (rows, d) states, float64, at least two rows that differ.
        u: (rows, k), (k,) or None.
        dt: number, (rows, 1) or None.
        tolerance: relative, for "batch = loop" and for short cuts against the law itself.
        single: whether the law also works in float32 after ``law.to(torch.float32)``.

    Raises:
        AssertionError: a rule is broken.
    """
    name = type(law).__name__
    _require(x.dim() == 2 and len(x) >= 2, f"{name}: give x as (rows, d) with two rows or more, got {tuple(x.shape)}")
    call = _caller(law)
    with _untouched(name):
        whole = call(x, u, dt)
        _require(
            isinstance(whole, Gaussian | torch.distributions.Distribution),
            f"{name}: a law returns a Gaussian or a torch Distribution, got {type(whole).__name__}",
        )
        value = as_gaussian(whole)
        _check_gaussian(name, value, x.shape[:-1], x.dtype)
        _same(f"{name}: two equal calls", as_gaussian(call(x, u, dt)), value)
        _check_law_rows(name, call, x, u, dt, value, tolerance)
        _check_short_cuts(name, law, x, u, dt, value, tolerance)
        if isinstance(law, nn.Module):
            _check_module(name, law, lambda module: as_gaussian(_caller(module)(x, u, dt)))
            if single:
                small = copy.deepcopy(law).to(torch.float32)
                parts: list[Any] = [part.float() if isinstance(part, Tensor) else part for part in (x, u, dt)]
                result = as_gaussian(_caller(small)(*parts))
                _check_gaussian(f"{name} in float32", result, x.shape[:-1], torch.float32)


def _caller(law: Any) -> Callable[[Tensor, Tensor | None, Step], Any]:
    style = call_style(law)
    return lambda x, u, dt: style.call(law, x, u, dt)


def _check_gaussian(name: str, law: Gaussian, lead: torch.Size, dtype: torch.dtype) -> None:
    """Shapes, dtype, finite numbers, a triangular factor."""
    mean, factor = law.mean, law.scale_tril
    _require(
        mean.shape[:-1] == lead, f"{name}: mean must be (*lead, m) with lead {tuple(lead)}, got {tuple(mean.shape)}"
    )
    for label, part in (("mean", mean), ("scale_tril", factor)):
        _require(part.dtype == dtype, f"{name}: {label} must keep the dtype {dtype} of x, got {part.dtype}")
        _require(bool(torch.isfinite(part).all()), f"{name}: {label} must be finite")
    size = law.space.tangent_size if law.space.tangent_size is not None else mean.shape[-1]
    own = (size,) if law.is_diagonal else (size, size)
    _require(
        tuple(factor.shape[-len(own) :]) == own,
        f"{name}: scale_tril must end in {own} on {law.space!r}, got {tuple(factor.shape)}",
    )
    if not law.is_diagonal:
        _require(torch.equal(factor, factor.tril()), f"{name}: scale_tril must be lower triangular")
    extra = factor.shape[: -len(own)]
    try:
        fits = torch.broadcast_shapes(extra, lead) == lead
    except RuntimeError:
        fits = False
    _require(fits, f"{name}: the leading dims {tuple(extra)} of scale_tril must broadcast to those of x, {tuple(lead)}")
    on_space = _distance(law.space, law.space.project(mean), mean)
    limit = 64 * torch.finfo(dtype).eps * max(1.0, mean.abs().max().item())
    _require(on_space <= limit, f"{name}: the mean must lie on {law.space!r}, it is {on_space:.3g} off")


def _check_law_rows(
    name: str,
    call: Callable[..., Any],
    x: Tensor,
    u: Tensor | None,
    dt: Step,
    whole: Gaussian,
    tolerance: float,
) -> None:
    """Batch = loop; another neighbour, or a sick one, changes nothing."""
    for k in range(len(x)):
        alone = as_gaussian(call(x[k : k + 1], _row(u, k), _row(dt, k)))
        _close_laws(f"{name}: row {k} alone and in the batch", alone, _pick(whole, slice(k, k + 1)), tolerance)
    once_more = as_gaussian(call(x.unsqueeze(1), _lifted(u), _lifted(dt)))
    _close_laws(f"{name}: with a second leading dim", _pick(once_more, (slice(None), 0)), whole, tolerance)
    for label, value in (("another state", x[:1] * 1.5 + 0.1), ("NaN", torch.full_like(x[:1], torch.nan))):
        try:
            other = as_gaussian(call(torch.cat([value, x[1:]]), u, dt))
        except ValueError as error:
            raise AssertionError(
                f"{name}: a row that holds {label} must not stop the others; torch distributions need "
                f"validate_args=False for that ({error})"
            ) from error
        _same(
            f"{name}: rows beside a row that holds {label}", _pick(other, slice(1, None)), _pick(whole, slice(1, None))
        )


def _check_short_cuts(
    name: str, law: Any, x: Tensor, u: Tensor | None, dt: Step, whole: Gaussian, tolerance: float
) -> None:
    """What a law offers beside the call agrees with the law itself."""
    if hasattr(law, "first_order"):
        at, _ = law.first_order(x, u, dt)
        _close_laws(f"{name}: the law of first_order and the law itself", as_gaussian(at), whole, tolerance)
    if hasattr(law, "noise_in"):
        reached = torch.zeros(whole.tangent_size, dtype=torch.bool)
        reached[law.noise_in if isinstance(law.noise_in, slice) else list(law.noise_in)] = True
        beyond = whole.factor()[..., ~reached, :]
        _require(not bool(beyond.any()), f"{name}: noise_in must name every component that noise reaches")
    if hasattr(law, "linear_form"):
        matrix, offset, factor = law.linear_form(u, dt)
        mean = (matrix @ x.unsqueeze(-1)).squeeze(-1)
        mean = mean if offset is None else mean + offset
        _close_laws(f"{name}: linear_form and the law itself", Gaussian(mean, factor, whole.space), whole, tolerance)
    if hasattr(law, "pooled"):
        weights = x.new_tensor([0.25, 0.5, 0.25])
        points = torch.stack([0.99 * x, x, 1.01 * x], -2)
        pooled = law.pooled(points, weights, _lifted(u), _lifted(dt))
        each = as_gaussian(_caller(law)(points, _lifted(u), _lifted(dt)))
        _close(f"{name}: the mean of pooled and of the law itself", pooled.mean, each.mean, tolerance)
        # A pooled noise at the centre of the set differs from the average by its curvature, so only its place is held.
        factor = pooled.factor()
        _require(
            factor.dim() == 2 or factor.shape[-3] == 1,
            f"{name}: pooled gives one factor a set, (..., 1, e, e), got {tuple(factor.shape)}",
        )
        spread = each.variance if each.variance.dim() > 1 else each.variance.expand(*each.mean.shape)
        low, high = spread.amin(-2), spread.amax(-2)
        own = factor.square().sum(-1)
        own = own.squeeze(-2) if own.dim() > 1 else own
        slack = tolerance * high + 1e-300
        inside = bool(((own >= low * 0.5 - slack) & (own <= high * 2 + slack)).all())
        _require(inside, f"{name}: pooled noise must be of the size of the noise at the points")


# ----------------------------------------------------------------------------------------------------------------------
# Symmetries


def check_symmetry(
    model: StateSpaceModel, x: Tensor, u: Tensor | None = None, dt: Step = None, *, tolerance: float = 1e-9
) -> None:
    """A model with a gauge: the laws do not notice that a state is replaced by the representative of its orbit.

    The gauge is a projection, row by row; a measurement's law is the same at x and at its representative; the motions
    from both, carried into the gauge, are the same law (noise across the orbit by the gauge's derivative); a
    ``first_order`` of the gauge is its derivative.

    Args:
        model: made with ``gauge=``.
        x: (rows, d) states, at least two rows, all apart from their representatives.
        u: (rows, k), (k,) or None.
        dt: number, (rows, 1) or None.
        tolerance: relative to the largest entry, for every comparison; absolute for tangent vectors below one.

    Raises:
        AssertionError: a rule is broken.
    """
    gauge = model.gauge
    _require(gauge is not None, "check_symmetry needs a model with a gauge: StateSpaceModel(..., gauge=...)")
    assert gauge is not None
    name = type(gauge).__name__ if isinstance(gauge, nn.Module) else getattr(gauge, "__name__", "gauge")
    _require(x.dim() == 2 and len(x) >= 2, f"{name}: give x as (rows, d) with two rows or more, got {tuple(x.shape)}")
    motion: Any = model.transition
    law = motion.law if isinstance(motion, GaugedTransition) else motion
    initial: Any = model.initial
    space = as_gaussian(initial.law() if isinstance(initial, GaugedInitial) else initial()).space
    with _untouched(name):
        there = gauge(x)
        _check_gauge(name, gauge, x, there, space, tolerance)
        seen, as_seen = (as_gaussian(model.conditional("observation", at, u, dt)) for at in (x, there))
        _close_laws(f"{name}: what is measured at a state and at its representative", as_seen, seen, tolerance)
        moved, as_moved = (into_gauge(gauge, as_gaussian(_caller(law)(at, u, dt))) for at in (x, there))
        _close_laws(
            f"{name}: the motions of a state and of its representative, in the gauge", as_moved, moved, tolerance
        )
        if hasattr(gauge, "first_order"):
            at, jacobian = gauge.first_order(x)
            _near(f"{name}: the representative of first_order", at, there, tolerance * _size(there))
            _, expected = gauge_first_order(lambda points: gauge(points), x, space)
            label = f"{name}: first_order and the derivative of the map"
            _near(label, jacobian, expected, tolerance * _size(expected))


def _check_gauge(
    name: str, gauge: Callable[[Tensor], Tensor], x: Tensor, there: Tensor, space: Space, tolerance: float
) -> None:
    """Shapes, dtype, a projection onto the space, batch = loop, neighbours."""
    _require(there.shape == x.shape, f"{name}: a representative must be {tuple(x.shape)}, got {tuple(there.shape)}")
    for single, found in ((x, there), (x.float(), gauge(x.float()))):
        _require(
            found.dtype == single.dtype, f"{name}: the gauge must keep the dtype {single.dtype}, got {found.dtype}"
        )
    _require(bool(torch.isfinite(there).all()), f"{name}: representatives must be finite")
    limit = tolerance * _size(there)
    away = (space.project(there) - there).abs().max().item()
    _require(away <= limit, f"{name}: a representative must lie on {space!r}, it is {away:.3g} off")
    apart = space.local(x, there).abs().amax(-1)
    _require(
        bool((apart > limit).all()), f"{name}: give states that are not representatives, row {int(apart.argmin())} is"
    )
    away = _distance(space, gauge(there), there)
    _require(away <= limit, f"{name}: the representative of a representative is itself, it is {away:.3g} off")
    for k in range(len(x)):
        away = _distance(space, gauge(x[k]), there[k])
        _require(away <= limit, f"{name}: row {k} alone and in the batch differ by {away:.3g}")
    beside = gauge(torch.cat([x[:1] * torch.nan, x[1:]]))
    _same(f"{name}: rows beside a row that holds NaN", beside[1:], there[1:])


def _size(values: Tensor) -> float:
    """The largest entry, at least one."""
    return max(1.0, values.abs().max().item())


# ----------------------------------------------------------------------------------------------------------------------
# Moment rules


def check_rule(rule: Rule, dtype: torch.dtype = torch.float64, *, size: int = 3) -> None:
    """A moment rule: exact on linear laws, rows that do not know of each other, missing components integrated out.

    Args:
        rule: such as `torchfilt.moments.unscented()`.
        dtype: float64 or float32.
        size: dimension of the state.

    Raises:
        AssertionError: a rule is broken.
    """
    name = f"{getattr(rule, 'name', type(rule).__name__)} rule"
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)

    eye = torch.eye(size, dtype=dtype)
    factor = (0.3 * normal(4, size, size)).tril() + eye
    belief = Gaussian(normal(4, size), factor)
    matrix, watch = eye + 0.3 * normal(size, size), normal(2, size)
    noise, error = 0.5 * eye, torch.tensor([[0.4, 0.0], [0.2, 0.5]], dtype=dtype)
    limit = 2e3 * torch.finfo(dtype).eps
    with _untouched(name):
        # Linear laws, once with their matrices and once as plain functions.
        for kind in ("linear_form", "function"):
            motion: Any = LinearGaussian(matrix, scale_tril=noise)
            sensor: Any = LinearGaussian(watch, scale_tril=error)
            if kind == "function":
                motion = AdditiveGaussian(lambda x: x @ matrix.mT, scale_tril=noise)
                sensor = AdditiveGaussian(lambda x: x @ watch.mT, scale_tril=error)
            ahead = predict(motion, belief, rule, None, None)
            label = f"{name}, linear law by {kind}"
            _close(f"{label}: predicted mean", ahead.mean, belief.mean @ matrix.mT, limit)
            expected = matrix @ belief.covariance @ matrix.mT + noise @ noise.mT
            _close(f"{label}: predicted covariance", ahead.covariance, expected, limit)
            _check_covariance(label, ahead.covariance)
            y = normal(4, 2)
            found = update(sensor, belief, y, rule, "none")
            _check_linear_update(label, found, belief, y, watch, error, limit)
        _check_curved_rule(name, rule, belief, normal(4, 2), limit)


def _check_linear_update(
    label: str, found: Any, prior: Gaussian, y: Tensor, watch: Tensor, error: Tensor, limit: float
) -> None:
    """The textbook update in covariance form."""
    P = prior.covariance
    S = watch @ P @ watch.mT + error @ error.mT
    residual = y - prior.mean @ watch.mT
    gain = torch.linalg.solve(S, watch @ P).mT
    mean = prior.mean + (gain @ residual.unsqueeze(-1)).squeeze(-1)
    _close(f"{label}: posterior mean", found.belief.mean, mean, limit)
    _close(f"{label}: posterior covariance", found.belief.covariance, P - gain @ watch @ P, limit)
    nis = (residual * torch.linalg.solve(S, residual)).sum(-1)
    log = -0.5 * (nis + torch.logdet(2 * math.pi * S))
    _close(f"{label}: normalised innovation squared", found.nis, nis, limit)
    _close(f"{label}: log-likelihood", found.log_likelihood, log, limit)


def _check_curved_rule(name: str, rule: Rule, belief: Gaussian, y: Tensor, limit: float) -> None:
    """On a nonlinear law: sound covariances, batch = loop, NaN components, NaN rows."""
    dtype = belief.mean.dtype
    noise = 0.3 * torch.eye(belief.tangent_size, dtype=dtype)
    motion = AdditiveGaussian(lambda x: x + 0.2 * x.sin(), scale_tril=noise)
    error = torch.tensor([[0.4, 0.0], [0.2, 0.5]], dtype=dtype)
    angle = Angle(2)
    sensor = AdditiveGaussian(lambda x: x[..., :2] + 0.1 * x[..., 1:3].cos(), space=angle, scale_tril=error)
    ahead = predict(motion, belief, rule, None, None)
    whole = update(sensor, ahead, y, rule, "none")
    for label, value in (("prediction", ahead), ("posterior", whole.belief)):
        _require(value.mean.dtype == value.scale_tril.dtype == dtype, f"{name}: the {label} must keep {dtype}")
        _require(bool(torch.isfinite(value.mean).all()), f"{name}: the {label} must be finite")
        _check_covariance(f"{name}, {label}", value.covariance)
    for k in range(len(y)):
        row = update(sensor, predict(motion, _pick(belief, k), rule, None, None), y[k], rule, "none")
        _close(f"{name}: row {k} alone and in the batch", row.belief.mean, whole.belief.mean[k], limit)
        _close(f"{name}: covariance of row {k}", row.belief.covariance, whole.belief.covariance[k], limit)
    turned = update(sensor, ahead, y + 2 * math.pi, rule, "none")
    _close(f"{name}: a measured angle and the same a turn on", turned.belief.mean, whole.belief.mean, 10 * limit)
    # Row 0 misses a component, row 1 all of them, the others nothing.
    holes = y.clone()
    holes[0, 1] = holes[1] = torch.nan
    holed = update(sensor, ahead, holes, rule, "rows")
    single = AdditiveGaussian(
        lambda x: x[..., :1] + 0.1 * x[..., 1:2].cos(), space=Angle(1), scale_tril=error[:1, :1].clone()
    )
    alone = update(single, _pick(ahead, 0), y[0, :1], rule, "none")
    _close(f"{name}: a missing component is integrated out", holed.belief.mean[0], alone.belief.mean, limit)
    _close(f"{name}: log-likelihood of what was seen", holed.log_likelihood[0], alone.log_likelihood, limit)
    _close(f"{name}: nothing seen leaves the mean", holed.belief.mean[1], ahead.mean[1], limit)
    _close(f"{name}: nothing seen leaves the covariance", holed.belief.covariance[1], ahead.covariance[1], limit)
    _require(holed.log_likelihood[1].abs().item() <= limit, f"{name}: nothing seen has log-likelihood 0")
    _close(f"{name}: rows beside rows with gaps", holed.belief.mean[2:], whole.belief.mean[2:], limit)
    sick = Gaussian(torch.cat([belief.mean[:1] * torch.nan, belief.mean[1:]]), belief.scale_tril)
    beside = update(sensor, predict(motion, sick, rule, None, None), y, rule, "none")
    _require(bool(beside.belief.mean[0].isnan().any()), f"{name}: a NaN belief must not turn into numbers")
    _same(
        f"{name}: rows beside a row of NaN", _pick(beside.belief, slice(1, None)), _pick(whole.belief, slice(1, None))
    )


# ----------------------------------------------------------------------------------------------------------------------
# Filters


def check_filter(
    filter: Filter[Any],
    measurements: Tensor,
    controls: Tensor | None = None,
    dt: Step = None,
    *,
    tolerance: float = 1e-9,
    single: bool = True,
    random: bool = True,
) -> None:
    """A filter: one step for streams and series, beliefs as values, rows that do not know of each other.

    Args:
        filter: its model in float64.
        measurements: (t, rows, m) without NaN, at least four steps and two rows.
        controls: (t, k), (t, rows, k) or None.
        dt: as `Filter.forward` takes it.
        tolerance: relative, for "batch = loop", neighbours and missing data: what happens in a row may choose another
            order of sums for all of them.
        single: whether the model also works in float32.
        random: False for a filter with random numbers that do not reach the result, such as a bank that never splits.

    Raises:
        AssertionError: a rule is broken.
    """
    name = type(filter).__name__
    _require(
        measurements.dim() == 3 and measurements.shape[0] >= 4 and measurements.shape[1] >= 2,
        f"{name}: give measurements as (t, rows, m) with t >= 4 and two rows or more, got {tuple(measurements.shape)}",
    )
    run = _Run(filter, measurements, controls, dt)
    with _untouched(name):
        history = run(record="beliefs")
        _check_history(name, history, measurements)
        _check_stream(name, run, history)
        _check_seeds(name, run, history, random)
        _check_neighbours(name, run, history, tolerance)
        _check_missing(name, run, history, tolerance)
        _check_rows(name, run, tolerance)
        _check_refusals(name, run)
        _check_failure(name, run, tolerance)
        _check_module(name, filter, lambda module: run._replace(filter=module)(record="moments").mean)
        if single:
            _check_single(name, run)


class _Run:
    """A filter with its data."""

    def __init__(self, filter: Filter[Any], ys: Tensor, controls: Tensor | None, dt: Step) -> None:
        self.filter, self.ys, self.controls, self.dt = filter, ys, controls, dt

    def __call__(self, ys: Tensor | None = None, **options: Any) -> Any:
        return self.filter(self.ys if ys is None else ys, self.controls, self.dt, **{"seed": 7, **options})

    def _replace(self, **changes: Any) -> "_Run":
        parts: dict[str, Any] = {"filter": self.filter, "ys": self.ys, "controls": self.controls, "dt": self.dt}
        parts |= changes
        return _Run(**parts)

    def rows(self, keep: slice, steps: slice = slice(None)) -> "_Run":
        """Some of the steps and rows."""
        controls = None if self.controls is None else self.controls[steps]
        if controls is not None and controls.dim() == 3:
            controls = controls[:, keep]
        dt = self.dt[steps] if isinstance(self.dt, Tensor) else self.dt
        if isinstance(dt, Tensor) and dt.dim() == 2:
            dt = dt[:, keep]
        return self._replace(ys=self.ys[steps, keep], controls=controls, dt=dt)

    def at(self, k: int) -> tuple[Tensor, Tensor | None, Step]:
        """Measurement, control and time step number k, as `step` takes them."""
        dt = self.dt[k] if isinstance(self.dt, Tensor) else self.dt
        if isinstance(dt, Tensor) and dt.dim() == 0:
            dt = float(dt)
        return self.ys[k], None if self.controls is None else self.controls[k], dt


def _check_history(name: str, history: Any, ys: Tensor) -> None:
    """Shapes, dtype, finite numbers, sound covariances, weights that sum to one."""
    lead = ys.shape[:-1]
    _require(
        history.mean.shape[:-1] == lead, f"{name}: history.mean must be (t, rows, d), got {tuple(history.mean.shape)}"
    )
    e = history.covariance.shape[-1]
    _require(
        history.covariance.shape == (*lead, e, e),
        f"{name}: history.covariance must be (t, rows, e, e), got {tuple(history.covariance.shape)}",
    )
    total = history.log_likelihood
    _require(total.shape == lead[1:], f"{name}: history.log_likelihood must be (rows,), got {tuple(total.shape)}")
    diagnostics = history.diagnostics
    for label in ("log_likelihood", "ok", "nis", "ess", "acceptance_rate"):
        part = getattr(diagnostics, label)
        if part is not None:
            _require(part.shape == lead, f"{name}: diagnostics.{label} must be {tuple(lead)}, got {tuple(part.shape)}")
    for label, part in (("mean", history.mean), ("covariance", history.covariance), ("log_likelihood", total)):
        _require(part.dtype == ys.dtype, f"{name}: history.{label} must keep the dtype {ys.dtype}, got {part.dtype}")
        _require(bool(torch.isfinite(part).all()), f"{name}: history.{label} must be finite")
    _require(bool(diagnostics.ok.all()), f"{name}: diagnostics.ok must be True on sound data")
    _check_covariance(name, history.covariance)
    _require(
        history.evidence in ("exact", "unbiased", "linearized", "approximate"), f"{name}: evidence {history.evidence!r}"
    )
    beliefs = history.beliefs
    if isinstance(beliefs, Particles):
        away = torch.logsumexp(beliefs.log_weights, -1).abs().max().item()
        limit = 16 * torch.finfo(ys.dtype).eps * beliefs.weights.shape[-1] ** 0.5
        _require(away <= limit, f"{name}: weights must sum to one, they are {away:.3g} off")
        ess, n = diagnostics.ess, beliefs.weights.shape[-1]
        inside = bool(((ess > 1 - 1e-4) & (ess < n * (1 + 1e-4))).all())
        _require(inside, f"{name}: the effective sample size must lie between 1 and n = {n}")


def _check_stream(name: str, run: _Run, history: Any) -> None:
    """`step` by `step`, and resumed half-way, the same bits as in one go."""
    state = run.filter.init(tuple(run.ys.shape[1:-1]), 7)
    for k in range(len(run.ys)):
        before = copy.deepcopy(state)
        y, u, dt = run.at(k)
        following, info = run.filter.step(state, y, u, dt)
        _same(f"{name}: step {k} must not change the state it was given", state, before)
        again, _ = run.filter.step(state, y, u, dt)
        _same(f"{name}: step {k} done twice from one state", again, following)
        state = following
        _same(f"{name}: streaming and offline, mean of step {k}", state.belief.mean, history.mean[k])
        _same(
            f"{name}: streaming and offline, log-likelihood of step {k}",
            info.log_likelihood,
            history.diagnostics.log_likelihood[k],
        )
    _same(f"{name}: streaming and offline, final state", state, history.final)
    half = len(run.ys) // 2
    first = run.rows(slice(None), slice(0, half))()
    second = run.rows(slice(None), slice(half, None))(state=first.final)
    _same(f"{name}: resumed from history.final, mean", second.mean, history.mean[half:])
    _same(f"{name}: resumed from history.final, final state", second.final, history.final)


def _check_seeds(name: str, run: _Run, history: Any, random: bool) -> None:
    """The same seed, the same bits; another seed, other numbers where there is randomness."""
    again = run()
    _same(f"{name}: the same seed twice, mean", again.mean, history.mean)
    _same(f"{name}: the same seed twice, log-likelihood", again.log_likelihood, history.log_likelihood)
    belief = run.filter.init(tuple(run.ys.shape[1:-1]), 7).belief
    if random and run.filter.draw(belief, 0, 7) is not None:
        other = run(seed=8)
        _require(not torch.equal(other.mean, history.mean), f"{name}: another seed must give other random numbers")
    for record in ("mean", "moments"):
        short = run(record=record)
        _same(f"{name}: record={record!r} must not change the mean", short.mean, history.mean)


def _check_neighbours(name: str, run: _Run, history: Any, tolerance: float) -> None:
    """Other data in row 0 leaves the other rows alone."""
    moved = run.ys.clone()
    moved[:, 0] = moved[:, 0].flip(0) + 0.37
    other = run(moved, throw=False)
    label = f"{name}: rows beside a row with other data"
    _close(f"{label}, mean", other.mean[:, 1:], history.mean[:, 1:], tolerance)
    _close(f"{label}, log-likelihood", other.log_likelihood[1:], history.log_likelihood[1:], tolerance)
    _require(not torch.equal(other.mean[:, 0], history.mean[:, 0]), f"{name}: other data must give another mean")


def _check_missing(name: str, run: _Run, history: Any, tolerance: float) -> None:
    """NaN means not measured: such a row goes on by its motion alone, the others as before."""
    holes = run.ys.clone()
    holes[1, 0] = torch.nan
    gap = run(holes)
    _require(bool(torch.isfinite(gap.mean).all()), f"{name}: a row without a measurement must stay finite")
    _require(bool(gap.diagnostics.ok.all()), f"{name}: a row without a measurement has not failed")
    nothing = gap.diagnostics.log_likelihood[1, 0].abs().item()
    _require(nothing <= tolerance, f"{name}: nothing measured has log-likelihood 0, got {nothing:.3g}")
    _close(f"{name}: rows beside a row without a measurement", gap.mean[:, 1:], history.mean[:, 1:], tolerance)
    _same(f"{name}: the step before the gap", gap.mean[0], history.mean[0])
    if run.ys.shape[-1] > 1:
        holes = run.ys.clone()
        holes[1, 0, 0] = torch.nan
        part = run(holes)
        _require(bool(torch.isfinite(part.mean).all()), f"{name}: a row with one component missing must stay finite")
        between = not torch.equal(part.mean[1, 0], gap.mean[1, 0])
        _require(between, f"{name}: the components that were measured must be used")


def _check_rows(name: str, run: _Run, tolerance: float) -> None:
    """Batch = loop: each row alone, with its share of the same random numbers."""
    filter = run.filter
    rows = run.ys.shape[1]
    state = filter.init((rows,), 7)
    singles = [_belief_row(state.belief, k) for k in range(rows)]
    whole = state.belief
    for t in range(len(run.ys)):
        y, u, dt = run.at(t)
        step = dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt
        noise = filter.draw(whole, t, 7)
        parts = []
        for k in range(rows):
            own = None if noise is None else _noise_row(noise, k)
            parts.append(filter.advance(singles[k], y[k : k + 1], _row(u, k), _row(step, k), own, "none")[0])
        whole, _ = filter.advance(whole, y, u, step, noise, "none")
        singles = parts
        for k, part in enumerate(singles):
            label = f"{name}: row {k} alone and in the batch, step {t}"
            _close(label, part.mean[0], whole.mean[k], tolerance)
            _close(f"{label}, covariance", part.covariance[0], whole.covariance[k], tolerance)


def _belief_row(belief: Any, k: int) -> Any:
    if isinstance(belief, Guarded):
        return Guarded(_belief_row(belief.belief, k), _belief_row(belief.fallback, k), belief.refused_s[k : k + 1])
    if isinstance(belief, Gaussian):
        return _pick(belief, slice(k, k + 1))
    factor = belief.scale_tril
    return belief._replace(
        x=belief.x[k : k + 1],
        log_weights=belief.log_weights[k : k + 1],
        scale_tril=None if factor is None else factor[k : k + 1],
        past=tuple(PastStep(*(_row(value, k) for value in part)) for part in belief.past),
    )


def _noise_row(noise: StepNoise, k: int) -> StepNoise:
    def first(part: Tensor | None) -> Tensor | None:
        return None if part is None else part[k : k + 1]

    return noise._replace(
        proposal=first(noise.proposal),
        resampling=noise.resampling[k : k + 1],
        redraw=first(noise.redraw),
        move_normal=None if noise.move_normal is None else noise.move_normal[:, :, k : k + 1],
        move_uniform=None if noise.move_uniform is None else noise.move_uniform[:, k : k + 1],
        kernel=first(noise.kernel),
        restart=None if noise.restart is None else noise.restart[:, k : k + 1],
    )


def _check_refusals(name: str, run: _Run) -> None:
    """Bad input raises at once and names what was wrong."""
    infinite = run.ys.clone()
    infinite[1, 0, 0] = math.inf
    _raises(f"{name}: an infinite measurement", ValueError, "inf", lambda: run(infinite))
    other = torch.float32 if run.ys.dtype == torch.float64 else torch.float64
    _raises(f"{name}: a measurement of another dtype", TypeError, "dtype", lambda: run(run.ys.to(other)))
    wide = torch.cat([run.ys, run.ys[..., :1]], -1)
    _raises(f"{name}: a measurement with a component too many", ValueError, str(wide.shape[-1]), lambda: run(wide))


def _check_failure(name: str, run: _Run, tolerance: float) -> None:
    """A row whose belief is lost says so in its status; the others go on."""
    state = run.filter.init(tuple(run.ys.shape[1:-1]), 7)
    broken = FilterState(_lost(state.belief), state.step, state.seed)
    y, u, dt = run.at(0)
    healthy, _ = run.filter.step(state, y, u, dt)
    after, info = run.filter.step(broken, y, u, dt, throw=False)
    _require(not bool(info.ok[0]), f"{name}: a row without a sound belief must report ok = False")
    _require(bool(info.ok[1:].all()), f"{name}: a failed row must not mark the others")
    _close(f"{name}: rows beside a failed row", after.belief.mean[1:], healthy.belief.mean[1:], tolerance)
    _raises(f"{name}: a failed row with throw=True", FilterError, "step 0", lambda: run.filter.step(broken, y, u, dt))


def _lost(belief: Any) -> Any:
    if isinstance(belief, Guarded):
        return belief._replace(belief=_lost(belief.belief))
    sick = torch.zeros(len(belief.mean), *[1] * (1 if isinstance(belief, Gaussian) else 2), dtype=belief.mean.dtype)
    sick[0] = torch.nan
    if isinstance(belief, Gaussian):
        return belief._replace(mean=belief.mean + sick)
    return belief._replace(x=belief.x + sick)


def _check_single(name: str, run: _Run) -> None:
    small = copy.deepcopy(run.filter).to(torch.float32)
    dt = run.dt.float() if isinstance(run.dt, Tensor) else run.dt
    controls = None if run.controls is None else run.controls.float()
    history = _Run(small, run.ys.float(), controls, dt)(record="beliefs")
    _check_history(f"{name} in float32", history, run.ys.float())


# ----------------------------------------------------------------------------------------------------------------------
# Resamplers


def check_resampler(resampler: Resampler, n: int = 50, *, draws: int = 4000, keeps_equal_weights: bool = True) -> None:
    """A resampler: valid ancestors, unbiased counts, rows that do not know of each other.

    Args:
        resampler: scheme; its policy is left to the filter and not checked here.
        n: particles.
        draws: replicates of the test of unbiasedness, whose counts are held to 5.5 standard errors: with 50 particles a
            false alarm in 500,000 checks.
        keeps_equal_weights: whether equal weights must give each particle itself (not so for multinomial).

    Raises:
        AssertionError: a rule is broken.
    """
    name = f"resampler {resampler.name!r}"
    generator = torch.Generator().manual_seed(1)
    count = resampler.uniforms(n)
    weights = torch.softmax(2 * torch.randn(n, generator=generator, dtype=torch.float64), -1)
    weights[3] = 0
    weights = weights / weights.sum()
    wide = weights.expand(draws, n).contiguous()
    uniforms = torch.rand(draws, count, generator=generator, dtype=torch.float64)
    with _untouched(name):
        ancestors = resampler(wide, uniforms)
        _check_ancestors(name, ancestors, (draws, n), n)
        counts = torch.nn.functional.one_hot(ancestors, n).sum(-2).double()
        _require(bool((counts[:, 3] == 0).all()), f"{name}: a particle of weight zero must never be chosen")
        # Copies come in whole numbers, so a fraction that no draw happened to show has a deviation all the same.
        fraction = (n * weights).frac()
        error = torch.maximum(counts.std(0), (fraction * (1 - fraction)).sqrt()) / draws**0.5
        away = (counts.mean(0) - n * weights).abs()
        # Bernstein's bound at the probability of 5.5 deviations.
        excess = away - 5.5 * error - 10 / draws
        worst = int(excess.argmax())
        _require(
            bool((excess <= 0).all()),
            f"{name}: the expected number of copies must be n times the weight, {n * weights[worst]:.4f} for particle "
            f"{worst}; the mean of {draws} draws is {counts.mean(0)[worst]:.4f} +- {error[worst]:.4f}",
        )
        single = torch.stack([resampler(wide[k], uniforms[k]) for k in range(3)])
        _require(torch.equal(single, ancestors[:3]), f"{name}: rows alone and in the batch must be equal")
        other = wide.clone()
        other[0] = other[0].flip(-1)
        _require(
            torch.equal(resampler(other, uniforms)[1:], ancestors[1:]),
            f"{name}: the weights of a row must not change its neighbours' ancestors",
        )
        deep = resampler(wide[:6].view(2, 3, n), uniforms[:6].view(2, 3, count))
        _require(torch.equal(deep.view(6, n), ancestors[:6]), f"{name}: more leading dims must change nothing")
        _check_ancestors(name, resampler(wide[:2].float(), uniforms[:2]), (2, n), n)
        _check_extremes(name, resampler, weights, count, keeps_equal_weights)


def _check_ancestors(name: str, ancestors: Tensor, shape: tuple[int, ...], n: int) -> None:
    _require(ancestors.dtype == torch.int64, f"{name}: ancestors must be int64, got {ancestors.dtype}")
    _require(ancestors.shape == shape, f"{name}: ancestors must be {shape}, got {tuple(ancestors.shape)}")
    low, high = ancestors.min().item(), ancestors.max().item()
    _require(low >= 0 and high < n, f"{name}: ancestors must lie in [0, {n}), they reach from {low} to {high}")
    _require(bool((ancestors.diff(dim=-1) >= 0).all()), f"{name}: ancestors must ascend")


def _check_extremes(name: str, resampler: Resampler, weights: Tensor, count: int, keeps_equal_weights: bool) -> None:
    """Uniforms at the ends of [0, 1), one particle with all the weight, equal weights."""
    n = len(weights)
    last = 1 - 1e-9  # nearer to one, the sum of a position and the uniform rounds up
    for value in (0.0, 0.5, last):
        uniforms = torch.full((count,), value, dtype=torch.float64)
        ancestors = resampler(weights, uniforms)
        _check_ancestors(f"{name} with uniforms {value}", ancestors, (n,), n)
        _require(not bool((ancestors == 3).any()), f"{name}: uniforms {value} choose a particle of weight zero")
        for k in (0, n // 2, n - 1):
            lone = torch.zeros(n, dtype=torch.float64)
            lone[k] = 1
            chosen = resampler(lone, uniforms)
            _require(bool((chosen == k).all()), f"{name}: particle {k} has all the weight, uniforms {value}")
        # A uniform at an end of its range decides by the last bit of a sum: no rule there.
        if keeps_equal_weights and value == 0.5:
            equal = resampler(torch.full((n,), 1 / n, dtype=torch.float64), uniforms)
            _require(torch.equal(equal, torch.arange(n)), f"{name}: equal weights must give each particle itself")


# ----------------------------------------------------------------------------------------------------------------------
# Spaces


def check_space(space: Space, points: Tensor, *, reach: float = 0.4, tolerance: float | None = None) -> None:
    """A space: `retract` and `local` undo each other, the mean is a mean, rows do not know of each other.

    Args:
        space: the space.
        points: (rows, d) on the space, at least two rows.
        reach: size of the tangent vectors walked along; for curved spaces inside their injectivity radius.
        tolerance: absolute for tangent vectors; default 200 roundings at the size of the points.

    Raises:
        AssertionError: a rule is broken.
    """
    name = repr(space)
    dtype = points.dtype
    scale = max(1.0, points.abs().max().item())
    limit = tolerance if tolerance is not None else 200 * torch.finfo(dtype).eps * scale
    rows, d = points.shape
    with _untouched(name):
        e = space.local(points, points).shape[-1]
        _require(space.size in (None, d), f"{name}: size must be {d}, got {space.size}")
        _require(space.tangent_size in (None, e), f"{name}: tangent_size must be {e}, got {space.tangent_size}")
        generator = torch.Generator().manual_seed(2)
        steps = reach * (2 * torch.rand(rows, e, generator=generator, dtype=torch.float64) - 1).to(dtype)
        there = space.retract(points, steps)
        for label, part in (
            ("retract", there),
            ("local", space.local(points, there)),
            ("project", space.project(there)),
        ):
            _require(part.dtype == dtype, f"{name}: {label} must keep the dtype {dtype}, got {part.dtype}")
            _require(bool(torch.isfinite(part).all()), f"{name}: {label} must be finite")
        _require(there.shape == points.shape, f"{name}: retract must give (rows, {d}), got {tuple(there.shape)}")
        _near(f"{name}: local(x, retract(x, v)) is v", space.local(points, there), steps, limit)
        _near(f"{name}: local(x, x) is zero", space.local(points, points), torch.zeros_like(steps), limit)
        away = _distance(space, space.retract(points, torch.zeros_like(steps)), points)
        _require(away <= limit, f"{name}: retract(x, 0) must be x, it is {away:.3g} off")
        away = _distance(space, space.project(there), there)
        _require(away <= limit, f"{name}: retract must end on the space, it is {away:.3g} off")
        back = space.retract(points, space.local(points, points.flip(0)))
        away = _distance(space, back, points.flip(0))
        _require(away <= limit, f"{name}: retract(x, local(x, y)) must be y, it is {away:.3g} off")
        _check_space_carry(name, space, points, steps, limit)
        _check_space_rows(name, space, points, steps, limit)
        _check_space_mean(name, space, points, reach, limit, generator)
        observed = space.observed(points)
        _require(
            observed.dtype == torch.bool and observed.shape == steps.shape, f"{name}: observed must be bool (rows, e)"
        )
        _require(bool(observed.all()), f"{name}: all components of a point without NaN are observed")
        nothing = space.observed(torch.full_like(points, torch.nan))
        _require(not bool(nothing.any()), f"{name}: nothing is observed of a point of NaN")


def _check_space_carry(name: str, space: Space, points: Tensor, steps: Tensor, limit: float) -> None:
    """Errors about x, seen from the end of a step, change as the derivative of the two charts says."""
    there = space.retract(points, steps)
    identity = torch.eye(steps.shape[-1], dtype=points.dtype, device=points.device)

    def seen_from_there(error: Tensor) -> Tensor:
        return space.local(there, space.retract(points, steps + error))

    columns = torch.func.vmap(
        lambda direction: torch.func.jvp(seen_from_there, (torch.zeros_like(steps),), (direction.expand_as(steps),))[1]
    )(identity)
    carried = space.carry(steps, identity).expand(*steps.shape, -1)
    _near(f"{name}: carry is the derivative of the change of chart", carried, columns.movedim(0, -1), limit)
    back = space.carry_back(steps, space.carry(steps, identity)).expand(*steps.shape, -1)
    _near(f"{name}: carry_back undoes carry", back, identity.expand(*steps.shape, -1), limit)


def _check_space_rows(name: str, space: Space, points: Tensor, steps: Tensor, limit: float) -> None:
    """Batch = loop; a sick neighbour changes nothing."""
    there = space.retract(points, steps)
    for k in range(len(points)):
        away = _distance(space, space.retract(points[k], steps[k]), there[k])
        _require(away <= limit, f"{name}: retract of row {k} alone and in the batch differ by {away:.3g}")
    sick = torch.cat([points[:1] * torch.nan, points[1:]])
    _same(f"{name}: retract beside a row of NaN", space.retract(sick, steps)[1:], there[1:])
    _same(f"{name}: local beside a row of NaN", space.local(sick, there)[1:], space.local(points, there)[1:])


def _check_space_mean(
    name: str, space: Space, points: Tensor, reach: float, limit: float, generator: torch.Generator
) -> None:
    """Equal points, order of the points, and the condition that defines an intrinsic mean."""
    rows, e = points.shape[0], space.local(points, points).shape[-1]
    vectors = reach * (2 * torch.rand(rows, 7, e, generator=generator, dtype=torch.float64) - 1).to(points.dtype)
    cloud = space.retract(points.unsqueeze(-2), vectors)
    weights = torch.rand(rows, 7, generator=generator, dtype=torch.float64).to(points.dtype) + 0.1
    weights = weights / weights.sum(-1, keepdim=True)
    mean = space.mean(cloud, weights)
    _require(mean.shape == points.shape, f"{name}: mean must be (rows, d), got {tuple(mean.shape)}")
    pull = (weights.unsqueeze(-1) * space.local(mean.unsqueeze(-2), cloud)).sum(-2)
    _near(f"{name}: weighted tangent vectors at the mean sum to zero", pull, torch.zeros_like(pull), limit)
    order = torch.randperm(7, generator=generator)
    away = _distance(space, space.mean(cloud[:, order], weights[:, order]), mean)
    _require(away <= 4 * limit, f"{name}: the order of the points changes the mean by {away:.3g}")
    equal = space.mean(points.unsqueeze(-2).expand(rows, 7, -1), weights)
    away = _distance(space, equal, points)
    _require(away <= limit, f"{name}: the mean of equal points is {away:.3g} off")
    single = space.mean(cloud[0], weights[0])
    away = _distance(space, single, mean[0])
    _require(away <= 4 * limit, f"{name}: the mean of row 0 alone and in the batch differ by {away:.3g}")


# ----------------------------------------------------------------------------------------------------------------------
# Parts that the checks share


def _row(value: Any, k: int) -> Any:
    """Row k of a control or time step that has rows."""
    return value[k : k + 1] if isinstance(value, Tensor) and value.dim() > 1 else value


def _lifted(value: Any) -> Any:
    """The same with room for another axis."""
    return value.unsqueeze(1) if isinstance(value, Tensor) and value.dim() > 1 else value


def _pick(law: Gaussian, key: Any) -> Gaussian:
    """Rows of a Gaussian; a factor that they share stays shared."""
    own = 1 if law.is_diagonal else 2
    scale = law.scale_tril
    if scale.dim() > own:
        scale = scale.expand(*law.mean.shape[:-1], *scale.shape[-own:])[key]
    return law._replace(mean=law.mean[key], scale_tril=scale)


def _check_module(name: str, module: nn.Module, call: Callable[[Any], Any]) -> None:
    """Copies are independent and equal; `state_dict` brings a spoiled copy back."""
    reference = call(module)
    clone = copy.deepcopy(module)
    _same(f"{name}: a deep copy", call(clone), reference)
    held = clone.state_dict()
    for entry in held.values():
        if entry.is_floating_point():
            entry.mul_(1.5)
    _same(f"{name}: the original after its copy was changed", call(module), reference)
    missing, unexpected = clone.load_state_dict(module.state_dict())
    _require(not missing and not unexpected, f"{name}: state_dict does not fit its own copy: {missing} {unexpected}")
    _same(f"{name}: after load_state_dict", call(clone), reference)


@contextmanager
def _untouched(name: str) -> Iterator[None]:
    """Global state is the user's: random numbers, default dtype, threads, gradient mode."""

    def state() -> tuple[Any, ...]:
        return torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()

    before, generator = state(), torch.get_rng_state()
    yield
    _require(state() == before, f"{name}: default dtype, threads and gradient mode must be left alone")
    _require(torch.equal(torch.get_rng_state(), generator), f"{name}: the global random generator must be left alone")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise AssertionError(message)


def _raises(what: str, kind: type[Exception], word: str, call: Callable[[], object]) -> None:
    try:
        call()
    except kind as error:
        _require(word in str(error), f"{what} must raise a message with {word!r}, it says: {error}")
        return
    except Exception as error:
        raise AssertionError(f"{what} must raise {kind.__name__}, got {type(error).__name__}: {error}") from error
    raise AssertionError(f"{what} must raise {kind.__name__}")


def _same(what: str, found: Any, expected: Any) -> None:
    """Bit for bit, through tuples; NaN equals NaN."""
    if isinstance(expected, Tensor):
        equal = found.shape == expected.shape and found.dtype == expected.dtype
        if not (equal and torch.equal(torch.nan_to_num(found), torch.nan_to_num(expected))):
            size = (found - expected).abs().max().item() if equal else math.nan
            raise AssertionError(f"{what}: must be the same bits, they differ by {size:.3g}")
    elif isinstance(expected, tuple):
        _require(len(found) == len(expected), f"{what}: must have {len(expected)} parts, got {len(found)}")
        for one, other in zip(found, expected, strict=True):
            _same(what, one, other)
    else:
        _require(found == expected, f"{what}: must be {expected!r}, got {found!r}")


def _close(what: str, found: Tensor, expected: Tensor, tolerance: float) -> None:
    """Relative to the largest entry."""
    scale = max(1.0, expected.abs().max().item())
    _near(what, found, expected, tolerance * scale)


def _near(what: str, found: Tensor, expected: Tensor, limit: float) -> None:
    if found.shape != expected.shape:
        raise AssertionError(f"{what}: shapes differ, {tuple(found.shape)} and {tuple(expected.shape)}")
    away = (found - expected).abs().max().item()
    if not away <= limit:
        raise AssertionError(f"{what}: differ by {away:.3g}, allowed {limit:.3g}")


def _close_laws(what: str, found: Gaussian, expected: Gaussian, tolerance: float) -> None:
    away = _distance(expected.space, found.mean, expected.mean)
    limit = tolerance * max(1.0, expected.mean.abs().max().item())
    _require(away <= limit, f"{what}: means differ by {away:.3g}, allowed {limit:.3g}")
    largest = expected.covariance.abs().max().item()
    difference = (found.covariance - expected.covariance).abs().max().item()
    limit = tolerance * largest
    _require(difference <= limit, f"{what}: covariances differ by {difference:.3g}, allowed {limit:.3g}")


def _distance(space: Space, x: Tensor, y: Tensor) -> float:
    """Largest tangent component between points: q and -q are the same point, and so are angles a turn apart."""
    return float(space.local(y, x).abs().max().item())


def _check_covariance(name: str, covariance: Tensor) -> None:
    """Symmetric, positive semidefinite to rounding."""
    scale = covariance.abs().amax((-2, -1), keepdim=True)
    skew = ((covariance - covariance.mT).abs() / scale.clamp_min(1e-300)).max().item()
    eps = torch.finfo(covariance.dtype).eps
    _require(skew <= 16 * eps, f"{name}: covariances must be symmetric, relative difference {skew:.3g}")
    # Scaled to unit diagonal, so that units do not decide what counts as rounding.
    root = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    root = torch.where(root == 0, 1, root)
    scaled = covariance / (root.unsqueeze(-1) * root.unsqueeze(-2))
    lowest = torch.linalg.eigvalsh(scaled.double()).min().item()
    _require(lowest >= -64 * eps, f"{name}: covariances must be positive semidefinite, lowest eigenvalue {lowest:.3g}")
