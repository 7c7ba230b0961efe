"""The one driver of every filter: the same step offline and in a stream."""

from collections.abc import Iterator, Mapping
from typing import Any, Generic, Literal

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.model import StateSpaceModel
from torchfilt.particles import Particles
from torchfilt.recording import Record, Recorder
from torchfilt.types import B, Belief, FilterError, FilterState, Missing, Step, StepInfo, StepNoise, trusted

Evidence = Literal["exact", "unbiased", "linearized", "approximate"]


class Filter(nn.Module, Generic[B]):
    """A filter is `init` and `advance`; streaming, whole series, checks and records are the same for all.

    Index convention: the prior is the state before the first measurement; each step moves it over dt and then takes
    the measurement in. ``dt = 0`` means no motion; where laws know no dt, ``predict_first=False`` says it for the first
    step.

    Attributes:
        model: the three laws.
        evidence: what log_likelihood is: "exact"; "unbiased" (its exponential is, over seeds); "linearized" (exact but
            for the linearisation of the laws); "approximate" (shrinkage or the literature's literal weights bias it).
    """

    evidence: Evidence = "exact"
    carries: type[Belief]

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        check_model(model)
        self.model = model

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[B]:
        """The prior for ``batch_shape`` independent runs."""
        raise NotImplementedError

    def draw(self, belief: B, step: int, seed: int) -> StepNoise | None:
        """Random numbers of a step; None for filters without randomness."""
        return None

    def advance(
        self,
        belief: B,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[B, StepInfo]:
        """One step as a pure function of tensors: what `torch.compile`, `torch.func` and both drivers call.

        Args:
            belief: of `init` or of the step before.
            y: (*batch, m); NaN means not measured.
            u: (*batch, k), (k,) or None.
            dt: number, (*batch, 1) or None, s.
            noise: of `draw`.
            missing: what is known of the NaNs in y, see `torchfilt.moments.update`; "rows" is always right.
            predict: False leaves the motion out.

        Returns:
            Belief after the measurement, and the report.
        """
        raise NotImplementedError

    def step(
        self,
        state: FilterState[B],
        y: Tensor | Mapping[str, Tensor | None],
        u: Tensor | None = None,
        dt: Step = None,
        *,
        predict_first: bool = True,
        throw: bool = True,
    ) -> tuple[FilterState[B], StepInfo]:
        """One measurement of a stream; the same bits as `forward` over the whole series.

        Args:
            state: of `init` or of the step before.
            y: (*batch, m); NaN means not measured. With `Sensors` also by name, (*batch, m_i) each, silent ones absent.
            u: control (*batch, k) or (k,).
            dt: number or (*batch), s.
            predict_first: False where the measurement belongs to the time of the prior itself.
            throw: raise on failed rows; False leaves it to ``info.ok``.

        Returns:
            State after the measurement, and the report.

        Raises:
            FilterError: a row failed (``throw``). TypeError, ValueError: as in `forward`.
        """
        self._check_state(state)
        batch = _batch_of(state.belief)
        if isinstance(y, Mapping):
            y = self._packed(y, tuple(batch), _like(state.belief))
        _check_tensor(y, "y")
        if y.dim() == 0:
            raise ValueError("y must be (*batch, m), got a tensor without dims")
        _check_measurements(y, state.belief, "y", y.shape[:-1])
        if u is not None:
            _check_tensor(u, "u")
            self._check_taken(u, "u")
            _check_controls(u, y, "u", u.shape[:-1], batch)
        _check_step(dt)
        if isinstance(dt, Tensor):
            if dt.dim() and dt.shape != batch:
                raise ValueError(f"dt must be a number or {tuple(batch)}, got {tuple(dt.shape)}")
            _check_step_dtype(dt, y)
            # A plain number where a series would have one: the bits of both are the same.
            dt = dt.unsqueeze(-1) if dt.dim() or dt.requires_grad else dt.item()
        missing = _missing_of(y)
        noise = self.draw(state.belief, state.step, state.seed)
        belief, info = self.advance(state.belief, y, u, dt, noise, missing, predict_first)
        if throw and not bool(info.ok.all()):
            raise FilterError(_failure(info.ok, state.step, y))
        return FilterState(belief, state.step + 1, state.seed), info

    def _packed(self, named: Mapping[str, Tensor | None], lead: tuple[int, ...] | None, like: Tensor) -> Tensor:
        """Measurements by name as one tensor."""
        pack = getattr(self.model.observation, "pack", None)
        if pack is None:
            raise TypeError(
                f"measurements by name need Sensors as the measurement law, got {type(self.model.observation).__name__}"
            )
        packed: Tensor = pack(named, lead, like)
        return packed

    def _check_taken(self, u: Tensor, name: str) -> None:
        """A control that no law would look at is a mistake."""
        if not self.model.takes_controls():
            raise ValueError(f"{name} {tuple(u.shape)} were given, but no law of the model has an argument u")

    def forward(
        self,
        measurements: Tensor | Mapping[str, Tensor | None],
        controls: Tensor | None = None,
        dt: Step = None,
        *,
        predict_first: bool = True,
        state: FilterState[B] | None = None,
        seed: int = 0,
        record: Record = "moments",
        throw: bool = True,
        progress: bool = False,
    ) -> History:
        """Filter whole series.

        Args:
            measurements: (t, *batch, m); NaN means not measured. With `Sensors` also by name, (t, *batch, m_i) each.
            controls: (t, k) shared by the batch, or (t, *batch, k).
            dt: time steps, s: a number (a tensor too), (t,) or (t, *batch).
            predict_first: False where the first measurement belongs to the time of the prior itself.
            state: where to go on from (``history.final``), with its own seed; default the prior.
            seed: of the random numbers where no state brings its own; the same seed gives the same bits for the
                same number of threads.
            record: "mean", "moments" (mean and covariance) or "beliefs" (everything that is carried).
            throw: raise on failed rows; False leaves it to ``history.diagnostics.ok``.
            progress: show a bar on a terminal.

        Returns:
            History over the t steps.

        Raises:
            FilterError: a row failed; the message names the first step, the rows and the measurement.
            TypeError, ValueError: dtype, shape, values that are not finite; the first bad entry is named.
        """
        if isinstance(measurements, Mapping):
            measurements = self._packed(measurements, None, _like(state.belief if state else self.model.prior()))
        _check_tensor(measurements, "measurements")
        if measurements.dim() < 2 or len(measurements) == 0:
            raise ValueError(f"measurements must be (t, *batch, m) with t >= 1, got {tuple(measurements.shape)}")
        if state is None:
            state = self.init(tuple(measurements.shape[1:-1]), seed)
        self._check_state(state)
        _check_measurements(measurements, state.belief, "measurements", measurements.shape[1:-1])
        if controls is not None:
            _check_tensor(controls, "controls")
            if controls.dim() < 2 or len(controls) != len(measurements):
                raise ValueError(
                    f"controls must be (t, k) or (t, *batch, k) with t = {len(measurements)}, "
                    f"got {tuple(controls.shape)}"
                )
            self._check_taken(controls, "controls")
            _check_controls(controls, measurements, "controls", controls.shape[1:-1], measurements.shape[1:-1])
        steps = _time_steps(dt, measurements)
        missing = _missing_by_step(measurements)
        recorder = Recorder(record, self.evidence, len(measurements))
        belief, start = state.belief, state.step
        _keep_memory(belief)
        for k in _counted(len(measurements), progress):
            noise = self.draw(belief, start + k, state.seed)
            u = None if controls is None else controls[k]
            predict = predict_first or k > 0
            belief, info = self.advance(belief, measurements[k], u, steps[k], noise, missing[k], predict)
            del noise  # its memory serves the next draw
            recorder.add(belief, info)
        history = recorder.finish(FilterState(belief, start + len(measurements), state.seed))
        if throw and not bool(history.diagnostics.ok.all()):
            failed = ~history.diagnostics.ok
            first = int(failed.reshape(len(failed), -1).any(1).nonzero()[0])
            raise FilterError(_failure(history.diagnostics.ok[first], start + first, measurements[first]))
        return history

    def _check_state(self, state: FilterState[B]) -> None:
        """Raise a TypeError unless this is a state of this kind of filter."""
        if not isinstance(state, FilterState):
            raise TypeError(f"state must be a FilterState, as init() gives it, got {type(state).__name__}")
        expected = getattr(self, "carries", None)
        if expected is not None and not isinstance(state.belief, expected):
            got = type(state.belief).__name__
            raise TypeError(f"state must hold the {expected.__name__} of this filter, got {got}")


def check_model(model: object) -> None:
    """Raise a TypeError unless this is a model."""
    if not isinstance(model, StateSpaceModel):
        raise TypeError(f"model must be a StateSpaceModel, got {type(model).__name__}")


def _check_tensor(value: object, name: str) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")


def _check_step_dtype(dt: Tensor, y: Tensor) -> None:
    """Time steps of another precision would change that of the whole belief."""
    if dt.is_floating_point() and dt.dtype != y.dtype:
        raise TypeError(f"dt must have the model's dtype {y.dtype}, got {dt.dtype}")


def _like(belief: Belief) -> Tensor:
    """Means (*batch, d) or particles (*batch, n, d)."""
    own = trusted(belief)
    return own.x if isinstance(own, Particles) else own.mean


def _batch_of(belief: Belief) -> torch.Size:
    return _like(belief).shape[: -1 if isinstance(trusted(belief), Gaussian) else -2]


# The largest block whose release still raises glibc's thresholds.
_LARGEST_BLOCK = 32 * 2**20 - 2**16


def _keep_memory(belief: Belief) -> None:
    """Teach the C allocator to keep blocks of a cloud's size: it returns them to the system at each step otherwise.

    glibc raises its thresholds when a large block is released; an empty block that is never touched costs nothing.
    """
    largest = _like(belief)
    if largest.device.type == "cpu":
        wanted = 16 * largest.numel() * largest.element_size()
        torch.empty(min(wanted, _LARGEST_BLOCK), dtype=torch.uint8)


def _check_measurements(y: Tensor, belief: Belief, name: str, batch: torch.Size) -> None:
    """Dtype and batch as the belief's, no infinities."""
    like = _like(belief)
    if y.dtype != like.dtype:
        raise TypeError(f"{name} must have the model's dtype {like.dtype}, got {y.dtype}")
    if batch != _batch_of(belief):
        axes = "(*batch, m)" if y.dim() == len(batch) + 1 else "(t, *batch, m)"
        raise ValueError(
            f"{name} must be {axes} with the state's *batch = {tuple(_batch_of(belief))}, got {tuple(y.shape)}"
        )
    if not _complete(y):
        _refuse(y, torch.isinf(y.detach()), f"{name} must be finite or NaN (not measured)")


def _check_controls(u: Tensor, y: Tensor, name: str, own: torch.Size, batch: torch.Size) -> None:
    """Dtype as the measurements', shared by the batch or one a row, finite."""
    if u.dtype != y.dtype:
        raise TypeError(f"{name} must have the model's dtype {y.dtype}, got {u.dtype}")
    if own not in ((), batch):
        raise ValueError(f"{name} must be shared by the *batch {tuple(batch)} or one a row, got {tuple(u.shape)}")
    _refuse(u, ~torch.isfinite(u.detach()), f"{name} must be finite")


def _check_step(dt: Step) -> None:
    """Finite and not negative."""
    if isinstance(dt, Tensor):
        _refuse(dt, ~(torch.isfinite(dt.detach()) & (dt.detach() >= 0)), "dt must be finite and >= 0")
    elif dt is not None and not isinstance(dt, int | float):
        raise TypeError(f"dt must be a number or a tensor, got {type(dt).__name__}")
    elif dt is not None and not 0 <= dt < float("inf"):
        raise ValueError(f"dt must be finite and >= 0, got {dt}")


def _refuse(values: Tensor, bad: Tensor, rule: str) -> None:
    """Raise with the rule and the first bad entry."""
    if bad.any():
        where = tuple(bad.nonzero()[0].tolist())
        raise ValueError(f"{rule}, entry {where} is {values.detach()[where].item()}")


def _time_steps(dt: Step, measurements: Tensor) -> list[Any]:
    """One entry a step: number, (*batch, 1) or None."""
    count = len(measurements)
    if not isinstance(dt, Tensor):
        _check_step(dt)
        return [dt] * count
    if dt.dim() == 0:
        dt = dt.expand(count)
    if dt.shape not in ((count,), measurements.shape[:-1]):
        raise ValueError(f"dt must be a number, ({count},) or {tuple(measurements.shape[:-1])}, got {tuple(dt.shape)}")
    _check_step(dt)
    if dt.dim() == 1 and not dt.requires_grad:
        return list(dt.tolist())  # plain numbers let laws use what they hold for their usual step
    _check_step_dtype(dt, measurements)
    return list(dt.unsqueeze(-1))


def _complete(y: Tensor) -> bool:
    """Whether the sum of all numbers is finite, and so each: one pass, and no more to look for where all is there."""
    return bool(torch.isfinite(y.detach().sum()))


def _missing_of(y: Tensor) -> Missing:
    """Pattern of one step."""
    if _complete(y):
        return "none"
    absent = torch.isnan(y)
    rows = absent.reshape(-1, absent.shape[-1])
    return "shared" if bool((rows == rows[0]).all()) else "rows"


def _missing_by_step(measurements: Tensor) -> list[Missing]:
    """Pattern of each step, looked up once for the whole series."""
    if _complete(measurements):
        return ["none"] * len(measurements)
    absent = torch.isnan(measurements)
    rows = absent.reshape(len(absent), -1, absent.shape[-1])
    some, equal = rows.flatten(1).any(1).tolist(), (rows == rows[:, :1]).flatten(1).all(1).tolist()
    return ["none" if not a else "shared" if b else "rows" for a, b in zip(some, equal, strict=True)]


def _failure(ok: Tensor, step: int, y: Tensor) -> str:
    rows = (~ok).nonzero().tolist() if ok.dim() else [[]]
    shown = [tuple(row) for row in rows[:5]]
    values = [y[row].tolist() for row in shown] if ok.dim() else y.tolist()
    more = "" if len(rows) <= 5 else f" and {len(rows) - 5} more"
    where = f"rows {shown}{more}" if ok.dim() else "the only row"
    return (
        f"step {step}, {where}: belief and likelihood must be finite and the covariance positive definite after the "
        f"measurement; it was {values}. With throw=False such rows are marked in `ok` and the others go on"
    )


def _counted(count: int, progress: bool) -> Iterator[int]:
    if not progress:
        return iter(range(count))
    from tqdm import tqdm

    return iter(tqdm(range(count), unit="step", disable=None))
