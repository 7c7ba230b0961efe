"""Robustness around a filter: acquiring again what was lost, and the log of what was decided."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfilt.filters.gaussian import GaussianFilter
from torchfilt.filters.particle import ParticleFilter
from torchfilt.gates import Gate
from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.moments import Rule, check_rule_type, unscented
from torchfilt.particles import Particles
from torchfilt.run import Filter
from torchfilt.types import FilterState, Guarded, Missing, Step, StepInfo, StepNoise, choose

__all__ = ["Decision", "Gate", "Reacquire", "decisions"]


class Reacquire(Filter[Guarded]):
    """A filter that starts over when its gate has refused a sensor for too long: it may have locked on something else.

    Beside the filter runs a Gaussian filter that never sees this sensor: the belief as it would be had the sensor not
    been acquired. Where the sensor has been measured and refused for ``patience_s`` without being taken in once, the
    belief is replaced by that one, which then takes the measurement in. Silence is not refusal: through a gap the
    belief just grows. ``info.restarted`` tells the rows.

    Args:
        filter: a `GaussianFilter`, or a `ParticleFilter` with the proposal `Local`, with a gate, on a model whose
            measurement law is `torchfilt.Sensors`.
        sensor: name of the sensor.
        patience_s: time of refusals after which to start over; one counts the length of its step, so that a sensor that
            is slower than the filter needs patience_s / dt of them.
        rule: moment rule of the filter beside it; default the filter's own.

    Raises:
        TypeError: another kind of filter, not a moment rule. ValueError: no gate, no such sensor or one that the gate
            does not test, a patience that is not positive; when called, no time step.
    """

    carries = Guarded

    def __init__(
        self, filter: GaussianFilter | ParticleFilter, sensor: str, patience_s: float = 0.5, rule: Rule | None = None
    ) -> None:
        if not isinstance(filter, GaussianFilter | ParticleFilter):
            raise TypeError(f"filter must be a GaussianFilter or a ParticleFilter, got {type(filter).__name__}")
        super().__init__(filter.model)
        part = filter if isinstance(filter, GaussianFilter) else filter.proposal
        gate: Gate | None = getattr(part, "gate", None)
        if gate is None:
            raise ValueError("acquiring again goes by the refusals of a gate, this filter has none: give it gate=")
        names = getattr(filter.model.observation, "names", ())
        if sensor not in names or (gate.sensors is not None and sensor not in gate.sensors):
            raise ValueError(
                f"sensor must be one of {', '.join(names) or 'Sensors'} that the gate tests, got {sensor!r}"
            )
        if not 0 < patience_s < float("inf"):
            raise ValueError(f"patience_s must be positive and finite, got {patience_s}")
        rule = getattr(part, "rule", unscented()) if rule is None else rule
        check_rule_type(rule)
        self.filter, self.sensor, self.patience_s = filter, sensor, patience_s
        self.fallback = GaussianFilter(filter.model, rule)
        self.evidence = "approximate"
        self._place = names.index(sensor)
        columns: tuple[slice, ...] = filter.model.observation.columns  # type: ignore[attr-defined]
        self._column = columns[self._place]

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Guarded]:
        """The prior, twice; see the filter's own ``init``."""
        belief = self.filter.init(batch_shape, seed).belief
        fallback = self.fallback.init(batch_shape, seed).belief
        e = fallback.tangent_size
        # Rows may go separate ways at any step, so each has a factor of its own.
        factor = fallback.factor().expand(*batch_shape, e, e)
        if isinstance(belief, Gaussian):
            belief = belief._replace(scale_tril=factor, is_diagonal=False)
        fallback = Gaussian(fallback.mean, factor, fallback.space)
        return FilterState(Guarded(belief, fallback, fallback.mean.new_zeros(batch_shape)), 0, seed)

    def draw(self, belief: Guarded, step: int, seed: int) -> StepNoise | None:
        """As the filter's own, with the normals of a start."""
        if isinstance(self.filter, GaussianFilter) or not isinstance(belief.belief, Particles):
            return None
        return self.filter.draw_with_restart(belief.belief, step, seed)

    def advance(
        self,
        belief: Guarded,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Guarded, StepInfo]:
        """See `Filter.advance`."""
        if dt is None:
            raise ValueError("patience_s counts seconds: the step needs its dt")
        column = self._column
        watched = torch.zeros(y.shape[-1], dtype=torch.bool, device=y.device)
        watched[column] = True
        own: Any = self.filter
        after, info = own.advance(belief.belief, y, u, dt, noise, missing, predict)
        fallback, _ = self.fallback.advance(
            belief.fallback, torch.where(watched, torch.nan, y), u, dt, None, "rows", predict
        )
        measured = ~torch.isnan(y[..., column]).any(-1)
        taken = info.accepted[..., self._place]
        span = dt.squeeze(-1) if isinstance(dt, Tensor) and dt.dim() else dt
        longer = belief.refused_s + span if predict else belief.refused_s  # at the prior's own time none has gone by
        refused_s = torch.where(measured, torch.where(taken, 0, longer), belief.refused_s)
        again = refused_s >= self.patience_s
        if torch.compiler.is_compiling() or bool(again.any()):
            fresh = self._start(fallback, noise)
            only = torch.where(watched, y, torch.nan)
            fresh, told = own.advance(fresh, only, u, dt, noise, "rows", False)
            after = choose(again, fresh, after)
            info = info._replace(
                log_likelihood=torch.where(again, told.log_likelihood, info.log_likelihood),
                ok=torch.where(again, told.ok, info.ok),
            )
            if info.ess is not None:
                info = info._replace(ess=torch.where(again, told.ess, info.ess))
            refused_s = torch.where(again, 0, refused_s)
        return Guarded(after, fallback, refused_s), info._replace(restarted=again)

    def _start(self, fallback: Gaussian, noise: StepNoise | None) -> Gaussian | Particles:
        """The filter's belief made of the fallback's."""
        if isinstance(self.filter, GaussianFilter):
            return fallback
        assert noise is not None and noise.restart is not None
        return self.filter.around(fallback, noise.restart)


class Decision(NamedTuple):
    """One measurement that a gate refused, or a start over: step, row of the batch, sensor, squared innovation."""

    step: int
    row: tuple[int, ...]
    sensor: str
    gate_nis: float
    restarted: bool


def decisions(history: History, names: tuple[str, ...] = ("measurement",)) -> Iterator[Decision]:
    """The log of a run: every refusal of a gate, in order of time.

    Args:
        history: of a filter with a gate.
        names: of the sensors, as in ``model.observation.names``.

    Raises:
        ValueError: the filter had no gate, another number of sensors.
    """
    report = history.diagnostics
    if report.accepted is None or report.gate_nis is None:
        raise ValueError("no log of decisions: the filter ran without a gate")
    accepted, nis = report.accepted, report.gate_nis
    if accepted.dim() == history.mean.dim() - 1:
        accepted, nis = accepted.unsqueeze(-1), nis.unsqueeze(-1)
    if accepted.shape[-1] != len(names):
        raise ValueError(f"names must be {accepted.shape[-1]}, one a sensor, got {names}")
    for place in (~accepted).nonzero().tolist():
        step, *row, sensor = place
        again = report.restarted is not None and bool(report.restarted[tuple(place[:-1])])
        yield Decision(step, tuple(row), names[sensor], float(nis[tuple(place)]), again)
