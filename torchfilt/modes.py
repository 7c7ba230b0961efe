"""Navigation modes: an explicit state machine that selects sensors and filter, with a reason for each switch."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfilt.filters.gaussian import GaussianFilter
from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.linalg import is_traced
from torchfilt.particles import Particles
from torchfilt.run import Filter
from torchfilt.sensors import Sensors
from torchfilt.types import FilterState, Missing, Moded, Step, StepInfo, StepNoise, choose

__all__ = ["Mode", "NavigationModes", "Situation", "Switch", "Switched", "switches"]


@dataclass(frozen=True)
class Mode:
    """What is done in a mode.

    Args:
        name: of the mode. filter: that runs in it. sensors: names of the sensors, constraints included, that it
            listens to; None for all.
    """

    name: str
    filter: Filter[Any]
    sensors: tuple[str, ...] | None = None


class Situation(NamedTuple):
    """What a condition may look at, after the measurement of a step; tensors of rows (*batch, ...).

    belief: after the step. y (*batch, m): all that was measured, NaN where silent, whatever the mode listens to; u
    (*batch, k), (k,) or None. since_s (*batch): time in the mode, this step included. info: the filter's report.
    measured: by sensor's name, whether it has measured (*batch).
    """

    belief: Gaussian | Particles
    y: Tensor
    u: Tensor | None
    since_s: Tensor
    info: StepInfo
    measured: dict[str, Tensor]


@dataclass(frozen=True)
class Switch:
    """One way from a mode to another.

    Args:
        source, target: names of modes. reason: a sentence for the log. when: condition on a `Situation`, gives bool
            (*batch).
    """

    source: str
    target: str
    reason: str
    when: Callable[[Situation], Tensor]


class NavigationModes(Filter[Moded]):
    """Modes of navigation, each row of the batch in its own.

    A step runs the filter of the mode on the sensors of the mode; the others are as not measured. Then the switches of
    the mode are asked in the order given; the first whose condition holds is taken, from the next step on. The mode
    and the time in it are part of the belief, so that streams, resumed runs and `DelayedMeasurements` decide as they
    did before. ``info.mode`` and ``info.switch`` are the log, `switches` reads it.

    Args:
        modes: the first is where a run starts. Their filters are one and the same, or `GaussianFilter` each, on one
            model whose measurement law is `torchfilt.Sensors`.
        switches: ways between them.

    Raises:
        TypeError: modes, switches or filters of another kind. ValueError: no mode, a name given twice or unknown, a
            sensor that is not there, filters on several models or only some of them with a gate; when called, no time
            step, a condition that does not give one bool a row.
    """

    carries = Moded
    allowed: Tensor

    def __init__(self, modes: Sequence[Mode], switches: Sequence[Switch] = ()) -> None:
        modes, switches = tuple(modes), tuple(switches)
        _check(modes, switches)
        super().__init__(modes[0].filter.model)
        self.modes, self.switches = modes, switches
        self.names = tuple(mode.name for mode in modes)
        distinct = list({id(mode.filter): mode.filter for mode in modes}.values())
        self.filters = torch.nn.ModuleList(distinct)
        self._runs = tuple(tuple(k for k, mode in enumerate(modes) if mode.filter is one) for one in distinct)
        self._ways = tuple((self.names.index(way.source), self.names.index(way.target)) for way in switches)
        self.evidence = "approximate"  # what a mode does not listen to is not in it
        sensors = self._sensors
        allowed = torch.zeros(len(modes), sensors.size, dtype=torch.bool)
        for k, mode in enumerate(modes):
            for name in sensors.names if mode.sensors is None else mode.sensors:
                allowed[k, sensors.columns[sensors.names.index(name)]] = True
        self.register_buffer("allowed", allowed, persistent=False)

    @property
    def _sensors(self) -> Sensors:
        law: Any = self.model.observation
        return law

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Moded]:
        """The prior in the first mode; see the filters' own ``init``."""
        belief = self.modes[0].filter.init(batch_shape, seed).belief
        if isinstance(belief, Gaussian):
            # Rows may go separate ways at any step, so each has a factor of its own.
            e = belief.tangent_size
            belief = Gaussian(belief.mean, belief.factor().expand(*batch_shape, e, e), belief.space)
        since = belief.mean.new_zeros(batch_shape)
        return FilterState(Moded(belief, torch.zeros_like(since, dtype=torch.long), since), 0, seed)

    def draw(self, belief: Moded, step: int, seed: int) -> StepNoise | None:
        """As the filter's own."""
        return self.modes[0].filter.draw(belief.belief, step, seed)

    def advance(
        self,
        belief: Moded,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Moded, StepInfo]:
        """A step of the filter of each row's mode, then the switches; see `Filter.advance`.

        Raises:
            ValueError: no dt.
        """
        if dt is None:
            raise ValueError("modes count the seconds in them: the step needs its dt")
        heard = torch.where(self.allowed[belief.mode], y, torch.nan)
        after, info = self._filtered(belief, heard, u, dt, noise, predict)
        span = dt.squeeze(-1) if isinstance(dt, Tensor) and dt.dim() else dt
        since = belief.since_s + span if predict else belief.since_s  # at the prior's own time none has gone by
        measured = {
            name: ~torch.isnan(y[..., own]).any(-1)
            for name, own in zip(self._sensors.names, self._sensors.columns, strict=True)
        }
        mode, switch = self._switched(belief.mode, Situation(after, y, u, since, info, measured))
        info = info._replace(mode=belief.mode, switch=switch, evidence=self.evidence)
        return Moded(after, mode, torch.where(switch >= 0, 0, since)), info

    def _filtered(
        self, belief: Moded, y: Tensor, u: Tensor | None, dt: Step, noise: StepNoise | None, predict: bool
    ) -> tuple[Any, StepInfo]:
        """Each filter that a row needs, and of its answers the rows that asked."""
        found: tuple[Any, StepInfo] | None = None
        traced = is_traced()
        for one, modes in zip(self.filters, self._runs, strict=True):
            rows = None
            if len(self.filters) > 1:
                rows = (belief.mode.unsqueeze(-1) == belief.mode.new_tensor(modes)).any(-1)
                if not traced and not bool(rows.any()):
                    continue
            tracker: Any = one
            new = tracker.advance(belief.belief, y, u, dt, noise, "rows", predict)
            found = new if found is None or rows is None else _merged(rows, new, found)
        assert found is not None
        return found

    def _switched(self, mode: Tensor, situation: Situation) -> tuple[Tensor, Tensor]:
        """Modes after the step, and the number of the switch that was taken, -1 for none."""
        switch, after = torch.full_like(mode, -1), mode
        for k, (way, (source, target)) in enumerate(zip(self.switches, self._ways, strict=True)):
            holds = way.when(situation)
            if not isinstance(holds, Tensor) or holds.dtype != torch.bool or holds.shape != mode.shape:
                got = f"{holds.dtype} {tuple(holds.shape)}" if isinstance(holds, Tensor) else type(holds).__name__
                raise ValueError(
                    f"the condition from {way.source!r} to {way.target!r} must give bool {tuple(mode.shape)}, got {got}"
                )
            taken = holds & (mode == source) & (switch < 0)
            switch, after = torch.where(taken, k, switch), torch.where(taken, target, after)
        return after, switch


def _merged(rows: Tensor, new: tuple[Any, StepInfo], old: tuple[Any, StepInfo]) -> tuple[Any, StepInfo]:
    """Answers of one filter in its rows, of the others elsewhere."""

    def pick(a: Any, b: Any) -> Any:
        if not isinstance(a, Tensor):
            return a
        room = max(a.dim(), b.dim()) - rows.dim()
        return torch.where(rows.reshape(rows.shape + (1,) * room), a, b)

    return choose(rows, new[0], old[0]), StepInfo(*(pick(a, b) for a, b in zip(new[1], old[1], strict=True)))


class Switched(NamedTuple):
    """One switch that was taken: at the end of which step, in which row of the batch, from where to where, and why."""

    step: int
    row: tuple[int, ...]
    source: str
    target: str
    reason: str


def switches(history: History, filter: NavigationModes) -> Iterator[Switched]:
    """The log of a run: every switch, in order of time.

    Args:
        history: of ``filter``.

    Returns:
        An iterator of `Switched`.

    Raises:
        ValueError: a history of a filter without modes.
    """
    taken = history.diagnostics.switch
    if taken is None:
        raise ValueError("no log of switches: the filter ran without modes")
    for place in (taken >= 0).nonzero().tolist():
        way = filter.switches[int(taken[tuple(place)])]
        yield Switched(place[0], tuple(place[1:]), way.source, way.target, way.reason)


def _check(modes: tuple[Mode, ...], switches: tuple[Switch, ...]) -> None:
    if not modes:
        raise ValueError("modes must hold at least one Mode")
    for mode in modes:
        if not isinstance(mode, Mode) or not isinstance(mode.filter, Filter):
            raise TypeError(f"modes must be Mode(name, filter, sensors), got {mode!r}")
    for way in switches:
        if not isinstance(way, Switch) or not callable(way.when):
            raise TypeError(f"switches must be Switch(source, target, reason, when), got {way!r}")
    _check_filters([mode.filter for mode in modes])
    names = [mode.name for mode in modes]
    if len(set(names)) < len(names):
        raise ValueError(f"names of modes must differ, got {', '.join(names)}")
    known = getattr(modes[0].filter.model.observation, "names")  # noqa: B009
    for mode in modes:
        for sensor in mode.sensors or ():
            if sensor not in known:
                raise ValueError(f"sensors of mode {mode.name!r} must be of {', '.join(known)}, got {sensor!r}")
    for way in switches:
        for name in (way.source, way.target):
            if name not in names:
                raise ValueError(f"a switch must lead between modes {', '.join(names)}, got {name!r}")


def _check_filters(filters: list[Filter[Any]]) -> None:
    first = filters[0]
    if not isinstance(first.model.observation, Sensors):
        raise TypeError(f"modes select Sensors, the measurement law is a {type(first.model.observation).__name__}")
    if first.carries not in (Gaussian, Particles):
        raise TypeError(f"a filter of a mode must carry a Gaussian or Particles, got {first.carries.__name__}")
    for one in filters[1:]:
        if one is first:
            continue
        if not isinstance(one, GaussianFilter) or not isinstance(first, GaussianFilter):
            kinds = f"{type(first).__name__} and {type(one).__name__}"
            raise TypeError(f"modes share one filter, or have a GaussianFilter each, got {kinds}")
        if one.model is not first.model:
            raise ValueError("filters of all modes must have the same model, got several")
        if (one.gate is None) != (first.gate is None):
            raise ValueError("either all filters of the modes have a gate or none, got some of each")
