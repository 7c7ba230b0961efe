"""Measurements that arrive late: the filter goes back to where they belong and comes forward again."""

import io
import math
import pickle
from bisect import bisect_left
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple

import torch
from torch import Tensor, nn

from torchfilt.filters.mixture import InteractingMultipleModel
from torchfilt.gaussian import Gaussian
from torchfilt.history import space_to_plain
from torchfilt.laws import AdditiveGaussian, LinearGaussian, call_style
from torchfilt.particles import Centre, Particles, PastStep
from torchfilt.run import Filter
from torchfilt.sensors import PseudoMeasurement, Sensors
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion
from torchfilt.storage import NOT_OURS, IntegrityError, read_verified, write_verified
from torchfilt.symmetry import GaugedTransition
from torchfilt.types import B, FilterState, Guarded, Moded, Step, StepInfo

Split = Callable[[Tensor, float], Tensor]
Action = Literal["on time", "joined", "inserted", "replaced", "skipped"]


def held(u: Tensor, fraction: float) -> Tensor:
    """Control of a part of a step where u is held through it, such as a force or a rate: u itself."""
    return u


def proportional(u: Tensor, fraction: float) -> Tensor:
    """Control of a part of a step where u is an increment over it, such as an angle turned: its share, fraction * u.

    Raw inertial increments are so at constant rate and force. Compensated ones (dtheta, dv) are so to first order: dv
    of each part, in axes at its own start, is wrong by at most an eighth of the cross product of dtheta and dv.
    """
    return fraction * u


class Arrival(NamedTuple):
    """One entry of the log: what became of what one sensor said.

    time_s is when it was measured, arrived_s the time of the filter when it came. action: "on time"; "joined" a step
    that ends at its time; "inserted" as a step of its own, within one or at the prior; "replaced" what was there;
    "skipped", too old and not taken in. out_of_order: this sensor had said something newer before. refiltered: steps
    that were run for it.
    """

    sensor: str
    time_s: float
    arrived_s: float
    action: Action
    out_of_order: bool
    refiltered: int

    @property
    def delay_s(self) -> float:
        """How late it came, s."""
        return self.arrived_s - self.time_s


class TakenStep(NamedTuple):
    """A step that may be run again: from since_s to time_s over dt, by the control u, measured at its end.

    y (*batch, m), NaN where nothing was; before: the filter's state at its start; log_likelihood (*batch): of all that
    was measured before it.
    """

    since_s: float
    time_s: float
    dt: float
    y: Tensor
    u: Tensor | None
    before: FilterState[Any]
    log_likelihood: Tensor


class DelayedState(NamedTuple, Generic[B]):
    """A filter's state at time_s with the steps that led to it: all that a stream with late measurements needs.

    past: the steps of the horizon, oldest first. arrivals: the log of the horizon; each call also returns its own.
    newest_s: for each sensor the time of the newest measurement taken in, -inf before the first. log_likelihood
    (*batch): of all that was measured, each at its own time, whenever it came.
    """

    now: FilterState[B]
    time_s: float
    past: tuple[TakenStep, ...]
    arrivals: tuple[Arrival, ...]
    newest_s: tuple[float, ...]
    log_likelihood: Tensor

    @property
    def belief(self) -> B:
        """The belief at time_s."""
        return self.now.belief


class DelayedInfo(NamedTuple):
    """What one call did: the report of each step that was run, in order of time, and the entries of the log.

    The first of ``steps`` took the measurement in, the last ends now; none where it was skipped.
    """

    steps: tuple[StepInfo, ...]
    arrivals: tuple[Arrival, ...]


class DelayedMeasurements(nn.Module, Generic[B]):
    """A stream that takes in late measurements exactly, by any filter: the belief is the one of all of them in order.

    The steps of the last ``horizon_s`` are kept in the state. A late measurement is put where it belongs, and the
    filter runs again from there: the same numbers, to the bit, as those of a filter that got each measurement at its
    time, random ones too. A time within a step splits it in two. Nothing is hidden on the module.

    Args:
        filter: any `Filter`.
        horizon_s: how far back a measurement may belong.
        split: how a control is shared when a step is split: `held`, `proportional` or a callable
            ``(u, fraction) -> u`` that gives the control of a part which lasts that fraction of the step. Only for
            motions over any time: two parts must amount to the whole, noise included. None takes only times at which
            steps end, and that of the prior.
        on_stale: what becomes of a measurement beyond the horizon or before the prior: "raise", or "skip" it and say
            so in the log.
        tolerance_s: times as near as this are the same; more than the rounding of the clock, less than a step.

    Raises:
        TypeError: not a filter, a split that is not callable. ValueError: a horizon or tolerance that is not positive
            and finite, an unknown on_stale; a split of a motion that does not look at dt, or of modes that jump by the
            step.

    Source: Larsen, Andersen, Ravn, Poulsen, Incorporation of time delayed measurements in a discrete-time Kalman
        filter, IEEE CDC (1998): recalculation through the delay, against which the approximations are measured.
    """

    def __init__(
        self,
        filter: Filter[B],
        horizon_s: float,
        *,
        split: Split | None = None,
        on_stale: Literal["raise", "skip"] = "raise",
        tolerance_s: float = 1e-6,
    ) -> None:
        super().__init__()
        _check_filter(filter)
        if split is not None and not callable(split):
            raise TypeError(f"split must be callable as split(u, fraction), or None, got {type(split).__name__}")
        for name, value in (("horizon_s", horizon_s), ("tolerance_s", tolerance_s)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if on_stale not in ("raise", "skip"):
            raise ValueError(f"on_stale must be 'raise' or 'skip', got {on_stale!r}")
        if split is not None:
            _check_divisible(filter)
        self.filter: Filter[B] = filter
        self.horizon_s, self.split = horizon_s, split
        self.on_stale, self.tolerance_s = on_stale, tolerance_s
        law = filter.model.observation
        self._sensors = law if isinstance(law, Sensors) else None
        self._constraints = tuple(
            name
            for name in getattr(self._sensors, "names", ())
            if isinstance(law.law(name), PseudoMeasurement)  # type: ignore[attr-defined]
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names in the log and in the order of ``newest_s``: those of `Sensors`, or "measurement"."""
        return ("measurement",) if self._sensors is None else self._sensors.names

    def init(
        self,
        batch_shape: tuple[int, ...] = (),
        seed: int = 0,
        time_s: float = 0.0,
        state: FilterState[B] | None = None,
    ) -> DelayedState[B]:
        """The start of a stream.

        Args:
            batch_shape, seed: as in ``filter.init``.
            time_s: of the prior. Count from the start of the run: seconds since 1970 resolve no more than 0.2 us.
            state: to go on from in place of the prior, such as ``history.final``, with its own batch and seed. What it
                has taken in already is not known here.

        Returns:
            A `DelayedState` at ``time_s``, with nothing behind it.

        Raises:
            ValueError: a time that is not finite.
        """
        _check_time(time_s)
        state = self.filter.init(batch_shape, seed) if state is None else state
        mean = state.belief.mean
        never = (-math.inf,) * len(self.sensors)
        return DelayedState(state, float(time_s), (), (), never, mean.new_zeros(mean.shape[:-1]))

    def step(
        self,
        state: DelayedState[B],
        y: Tensor | Mapping[str, Tensor | None],
        u: Tensor | None = None,
        dt: float | None = None,
        *,
        time_s: float | None = None,
        throw: bool = True,
    ) -> tuple[DelayedState[B], DelayedInfo]:
        """Move on to a new time and take in what was measured then; as ``filter.step``.

        Args:
            state: of `init` or of the call before.
            y: (*batch, m), NaN means not measured, or by name; all NaN, or {} by name, just moves on.
            u: control over the step.
            dt: length of the step, s, one number for all rows. Zero is no step: y belongs to the time already reached
                and is taken in as by `late`.
            time_s: end of the step; give it in place of dt where the clock is absolute, so that no rounding adds up.
            throw: as in ``filter.step``.

        Returns:
            The state at the end of the step, and a `DelayedInfo` of what was run for it.

        Raises:
            TypeError: dt or time_s is not a number. ValueError: both or neither given, time that runs backward, a
                control over no time. Others as in ``filter.step``.
        """
        _check_state(state)
        length, end = self._span(state.time_s, dt, time_s)
        if length == 0:
            if u is not None:
                raise ValueError("a step over no time has no control: leave u out, or give dt > 0")
            return self.late(state, y, state.time_s, throw=throw)
        values = self._tensor(state, y) if isinstance(y, Mapping) else y
        # Copies: whoever calls may fill the same buffer again.
        new = TakenStep(state.time_s, end, length, _copy(values), _copy(u), state.now, state.log_likelihood)
        after, steps = self._run(state, state.past, (new,), throw)
        spoken = self._spoken(~torch.isnan(values))
        log = [Arrival(self.sensors[k], end, end, "on time", False, 1) for k in spoken]
        return self._finish(after, log, spoken, end), DelayedInfo(steps, tuple(log))

    def late(
        self,
        state: DelayedState[B],
        y: Tensor | Mapping[str, Tensor | None],
        time_s: float,
        *,
        replace: bool = False,
        throw: bool = True,
    ) -> tuple[DelayedState[B], DelayedInfo]:
        """Take in what was measured at an earlier time, or at this one by another sensor; no time passes.

        Args:
            state: of the call before.
            y: (*batch, m), NaN means not measured, or by name. Constraints (`PseudoMeasurement`) enter a step that is
                there once, and a new one as they do any other.
            time_s: when it was measured.
            replace: put it in the place of what the same sensor said at the same time; otherwise that is an error.
            throw: as in ``filter.step``.

        Returns:
            The state at the same time as before, and a `DelayedInfo` with the steps that were run again.

        Raises:
            TypeError: time_s is not a number. ValueError: a time that is still to come, one that is too old
                (``on_stale="raise"``) or falls within a step that may not be split, a sensor that has spoken at that
                time already, nothing but NaN, another shape. Others as in ``filter.step``. The state given stays as it
                is in any case.
        """
        _check_state(state)
        _check_time(time_s)
        if time_s > state.time_s + self.tolerance_s:
            raise ValueError(
                f"the measurement is of {time_s:.12g} s, but the filter has come to {state.time_s:.12g} s only"
            )
        stale = self._stale(state, time_s)
        if stale is not None and self.on_stale == "raise":
            raise ValueError(stale)
        place, joins = (0, False) if stale is not None else self._find(state.past, time_s)
        y = self._late_values(state, y, joins)
        spoken = self._spoken(~torch.isnan(y))
        if stale is not None:
            log = self._arrivals(state, spoken, time_s, dict.fromkeys(spoken, "skipped"), 0)
            return self._finish(state, log, (), time_s), DelayedInfo((), tuple(log))
        actions: dict[int, Action] = dict.fromkeys(spoken, "joined" if joins else "inserted")
        if joins:
            again = self._spoken(~torch.isnan(y) & ~torch.isnan(state.past[place].y))
            if again and not replace:
                raise ValueError(
                    f"sensor {self.sensors[again[0]]!r} has already been taken in at {state.past[place].time_s:.12g} "
                    "s; to put this measurement in its place say replace=True"
                )
            actions |= dict.fromkeys(again, "replaced")
        rerun = self._with(state, place, joins, y, time_s)
        after, steps = self._run(state, state.past[:place], rerun, throw)
        log = self._arrivals(state, spoken, time_s, actions, len(steps))
        return self._finish(after, log, spoken, time_s), DelayedInfo(steps, tuple(log))

    # ------------------------------------------------------------------------------------------------------------------
    # Times

    def _span(self, now_s: float, dt: Step, time_s: float | None) -> tuple[float, float]:
        """Length and end of a step."""
        if (dt is None) == (time_s is None):
            raise ValueError("give exactly one of dt= and time_s=")
        if time_s is not None:
            _check_time(time_s)
            length, end = time_s - now_s, float(time_s)
        else:
            if isinstance(dt, bool) or not isinstance(dt, int | float):
                raise TypeError(f"dt must be a number, one clock for all rows, got {type(dt).__name__}")
            if not 0 <= dt < math.inf:
                raise ValueError(f"dt must be finite and >= 0, got {dt}")
            length, end = dt, now_s + dt
        if length < -self.tolerance_s:
            raise ValueError(
                f"a step must not run backward, from {now_s:.12g} to {time_s:.12g} s; a late measurement goes to late()"
            )
        return (0.0, now_s) if length <= self.tolerance_s else (length, end)

    def _stale(self, state: DelayedState[B], time_s: float) -> str | None:
        """Why a time can't be gone back to, None where it can."""
        oldest = state.time_s - self.horizon_s
        start = state.past[0].since_s if state.past else state.time_s
        if time_s < oldest - self.tolerance_s:
            return (
                f"the measurement is of {time_s:.12g} s, at {state.time_s:.12g} s the horizon of {self.horizon_s} s "
                f"reaches back to {oldest:.12g} s only"
            )
        if time_s < start - self.tolerance_s:
            return f"the measurement is of {time_s:.12g} s, before the prior at {start:.12g} s"
        return None

    def _find(self, past: tuple[TakenStep, ...], time_s: float) -> tuple[int, bool]:
        """The step that a time belongs to, and whether it ends there."""
        place = bisect_left(past, time_s - self.tolerance_s, key=lambda one: one.time_s)
        return place, place < len(past) and abs(past[place].time_s - time_s) <= self.tolerance_s

    # ------------------------------------------------------------------------------------------------------------------
    # Measurements

    def _tensor(self, state: DelayedState[B], y: Mapping[str, Tensor | None]) -> Tensor:
        like = state.log_likelihood
        return self.filter._packed(y, tuple(like.shape), like)

    def _late_values(self, state: DelayedState[B], y: Any, joins: bool) -> Tensor:
        """A late measurement as a tensor (*batch, m), of the shape that its neighbours have."""
        if isinstance(y, Mapping):
            said = any(value is not None and not bool(torch.isnan(value).all()) for value in y.values())
            y = self._tensor(state, dict.fromkeys(self._constraints) | dict(y) if joins else y)
        else:
            if not isinstance(y, Tensor):
                raise TypeError(f"y must be a tensor, or a mapping by sensor, got {type(y).__name__}")
            said = not bool(torch.isnan(y).all())
        if not said:
            raise ValueError("a late measurement must measure something, got nothing but NaN")
        like = state.past[0].y if state.past else y
        if y.dtype != like.dtype:
            raise TypeError(f"y must have the dtype {like.dtype}, got {y.dtype}")
        if y.shape != like.shape:
            raise ValueError(f"y must be {tuple(like.shape)}, as at the other steps, got {tuple(y.shape)}")
        return y.clone()

    def _spoken(self, measured: Tensor) -> tuple[int, ...]:
        """Which sensors have measured (*batch, m) anything in any row; constraints are none."""
        each = measured.reshape(-1, measured.shape[-1]).any(0).tolist()
        if self._sensors is None:
            return (0,) if any(each) else ()
        columns = zip(self._sensors.names, self._sensors.columns, strict=True)
        return tuple(k for k, (name, own) in enumerate(columns) if name not in self._constraints and any(each[own]))

    # ------------------------------------------------------------------------------------------------------------------
    # Steps

    def _with(self, state: DelayedState[B], place: int, joins: bool, y: Tensor, time_s: float) -> tuple[TakenStep, ...]:
        """The steps from ``place`` on with the measurement among them."""
        rest: tuple[TakenStep, ...] = state.past[place:]
        if joins:
            return rest[0]._replace(y=torch.where(torch.isnan(y), rest[0].y, y)), *rest[1:]
        start = rest[0].since_s if rest else state.time_s
        if abs(time_s - start) <= self.tolerance_s:  # at the prior: a step without a motion
            before, known = (rest[0].before, rest[0].log_likelihood) if rest else (state.now, state.log_likelihood)
            return TakenStep(start, start, 0.0, y, None, before, known), *rest
        return *self._halves(rest[0], y, time_s), *rest[1:]

    def _halves(self, whole: TakenStep, y: Tensor, time_s: float) -> tuple[TakenStep, TakenStep]:
        """A step as two, with a measurement between them."""
        if self.split is None:
            raise ValueError(
                f"the measurement is of {time_s:.12g} s, within the step from {whole.since_s:.12g} to "
                f"{whole.time_s:.12g} s: give split=held, split=proportional or a callable where steps may be split"
            )
        fraction = (time_s - whole.since_s) / (whole.time_s - whole.since_s)
        shares = (None, None) if whole.u is None else (self.split(whole.u, fraction), self.split(whole.u, 1 - fraction))
        first = whole._replace(time_s=float(time_s), dt=time_s - whole.since_s, y=y, u=shares[0])
        return first, whole._replace(since_s=float(time_s), dt=whole.time_s - time_s, u=shares[1])

    def _run(
        self, state: DelayedState[B], kept: tuple[TakenStep, ...], steps: tuple[TakenStep, ...], throw: bool
    ) -> tuple[DelayedState[B], tuple[StepInfo, ...]]:
        """Filter through steps, the first of which knows where it starts."""
        now, total = steps[0].before, steps[0].log_likelihood
        done, infos = list(kept), []
        for one in steps:
            done.append(one._replace(before=now, log_likelihood=total))
            now, info = self.filter.step(now, one.y, one.u, one.dt, predict_first=one.dt > 0, throw=throw)
            total = total + info.log_likelihood
            infos.append(info)
        return state._replace(now=now, time_s=steps[-1].time_s, past=tuple(done), log_likelihood=total), tuple(infos)

    # ------------------------------------------------------------------------------------------------------------------
    # The log

    def _arrivals(
        self,
        state: DelayedState[B],
        spoken: tuple[int, ...],
        time_s: float,
        actions: Mapping[int, Action],
        refiltered: int,
    ) -> list[Arrival]:
        now, late_by = state.time_s, self.tolerance_s
        return [
            Arrival(self.sensors[k], float(time_s), now, actions[k], time_s < state.newest_s[k] - late_by, refiltered)
            for k in spoken
        ]

    def _finish(
        self, state: DelayedState[B], log: list[Arrival], taken: tuple[int, ...], time_s: float
    ) -> DelayedState[B]:
        """The log written, and what lies beyond the horizon forgotten."""
        # Twice the tolerance: no time that may still come is as near as that to a step that is gone.
        oldest = state.time_s - self.horizon_s - 2 * self.tolerance_s
        newest = tuple(max(old, time_s) if k in taken else old for k, old in enumerate(state.newest_s))
        return state._replace(
            past=tuple(one for one in state.past if one.time_s >= oldest),
            arrivals=tuple(one for one in (*state.arrivals, *log) if one.arrived_s >= oldest),
            newest_s=newest,
        )


FILE_KIND = "torchfilt stream"
# All that a state is made of; nothing else is ever unpickled.
_PARTS: list[Any] = [
    DelayedState,
    TakenStep,
    Arrival,
    FilterState,
    Gaussian,
    Particles,
    Centre,
    PastStep,
    Guarded,
    Moded,
]
_PARTS += [Euclidean, Angle, UnitQuaternion, Product]


def save(state: DelayedState[Any], path: str | Path) -> None:
    """Write a state with its past and its log, atomically and with a SHA-256 manifest beside it.

    Raises:
        TypeError: not a state, a space that is not one of the library's own.
    """
    _check_state(state)
    space_to_plain(state.belief.space)
    stream = io.BytesIO()
    torch.save(state, stream)
    write_verified(path, stream.getvalue(), FILE_KIND)


def load(path: str | Path) -> DelayedState[Any]:
    """Read what `save` wrote; a stream that goes on from it gives the same bits as one that was never stopped.

    Returns:
        The state.

    Raises:
        FileNotFoundError: no such file.
        IntegrityError: truncated, altered or foreign; names the file and the rule.
    """
    data = read_verified(path, FILE_KIND)
    try:
        with torch.serialization.safe_globals(_PARTS):
            state = torch.load(io.BytesIO(data), weights_only=True)
    except (*NOT_OURS, pickle.UnpicklingError, RuntimeError, IndexError) as error:
        # Torch's own message is advice on how to trust the file nevertheless.
        raise IntegrityError(f"{path}: not a stream of this version ({type(error).__name__})") from error
    if not isinstance(state, DelayedState):
        raise IntegrityError(f"{path}: not a stream of this version (it holds a {type(state).__name__})")
    return state


# ----------------------------------------------------------------------------------------------------------------------
# Checks


def _copy(given: Any) -> Any:
    """A tensor's copy; what is none is left to the filter's own checks."""
    return given.clone() if isinstance(given, Tensor) else given


def _check_filter(filter: object) -> None:
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a Filter, got {type(filter).__name__}")


def _check_state(state: object) -> None:
    if not isinstance(state, DelayedState):
        raise TypeError(f"state must be a DelayedState, as init() gives it, got {type(state).__name__}")


def _check_time(time_s: object) -> None:
    if isinstance(time_s, bool) or not isinstance(time_s, int | float):
        raise TypeError(f"time_s must be a number, got {type(time_s).__name__}")
    if not math.isfinite(time_s):
        raise ValueError(f"time_s must be finite, got {time_s}")


def _check_divisible(filter: Filter[Any]) -> None:
    """Raise a ValueError where two parts of a step plainly would not be the whole."""
    several = isinstance(filter, InteractingMultipleModel)
    if several and getattr(filter, "rates_per_s", None) is None:
        raise ValueError(
            "modes that jump by transition_probabilities jump once a step, whatever its length: a step "
            "may be split with rates_per_s only"
        )
    for model in getattr(filter, "models") if several else [filter.model]:  # noqa: B009
        law = model.transition.law if isinstance(model.transition, GaugedTransition) else model.transition
        looks = law.style.takes_dt if isinstance(law, AdditiveGaussian) else call_style(law).takes_dt
        if isinstance(law, LinearGaussian) or not looks:
            raise ValueError(
                f"the motion, a {type(law).__name__}, does not look at dt: two parts of a step would be two steps; "
                "leave split out"
            )
