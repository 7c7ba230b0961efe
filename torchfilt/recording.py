"""Collecting what a filter does, step by step, into a history."""

import math
from typing import Any, Literal

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.history import History
from torchfilt.particles import Particles
from torchfilt.types import Belief, FilterState, StepInfo, trusted

Record = Literal["mean", "moments", "beliefs"]
# Below so many numbers a step, keeping references and stacking them at the end takes fewer calls than copying at once.
_LARGE = 16_384


class Series:
    """One quantity along time.

    Large values without gradients are copied at once into one block, in the memory order they have: they are still in
    the processor's cache, and their own memory can be used again. The others are stacked at the end.

    Args:
        steps: how many there will be at most.
        at_once: copy small values at once as well. Beside large tensors that come and go each small one that stays
            keeps a hole of their size open in the heap.
        axis: of the particles, where there are some; steps with fewer than others are filled up.
        filling: what with; None for copies of the last one.
    """

    def __init__(
        self, steps: int, axis: int | None = None, filling: float | None = None, at_once: bool = False
    ) -> None:
        self.steps, self.axis, self.filling, self.at_once = steps, axis, filling, at_once
        self.values: list[Tensor] = []
        self.block: Tensor | None = None
        self.count = 0

    def add(self, value: Tensor) -> None:
        """The next step's value."""
        if self.count == 0 and (self.at_once or value.numel() >= _LARGE) and not value.requires_grad:
            self.block = _block_like(value, self.steps)
        self.count += 1
        if self.block is None:
            self.values.append(value)
        elif value.shape == self.block.shape[1:] and not value.requires_grad:
            self.block[self.count - 1].copy_(value)
        else:
            self.values = [*self.block[: self.count - 1].unbind(0), value]
            self.block = None

    def stacked(self) -> Tensor:
        """All values, time first; steps whose rows share a value are widened where other steps have one a row."""
        if self.block is not None:
            return self.block[: self.count]
        values = self.values
        if self.axis is not None:
            most = max(value.shape[self.axis] for value in values)
            values = [_filled(value, most, self.axis, self.filling) for value in values]
        shapes = {value.shape for value in values}
        if len(shapes) == 1:
            return torch.stack(values)
        widest = torch.broadcast_shapes(*shapes)
        return torch.stack([value.expand(widest) for value in values])


def _filled(value: Tensor, most: int, axis: int, filling: float | None) -> Tensor:
    """With ``most`` particles; one that all share stays one."""
    n = value.shape[axis]
    if n in (1, most):
        return value
    shape = list(value.shape)
    shape[axis] = most - n
    last = value.narrow(axis, n - 1, 1).expand(shape)
    return torch.cat([value, last if filling is None else last.new_full(shape, filling)], axis)


def _block_like(value: Tensor, steps: int) -> Tensor:
    """Empty (steps, *shape), each step in the memory order of ``value``."""
    strides = value.stride()
    order = sorted(range(value.dim()), key=lambda axis: strides[axis], reverse=True)
    block = value.new_empty((steps, *(value.shape[axis] for axis in order)))
    return block.movedim(tuple(range(1, value.dim() + 1)), tuple(axis + 1 for axis in order))


class Recorder:
    """Collects beliefs and reports step by step, keeping as much as ``record`` says.

    Args:
        record: "mean", "moments" or "beliefs".
        evidence: of the filter.
        steps: how many there will be.

    Raises:
        ValueError: unknown ``record``.
    """

    def __init__(self, record: Record, evidence: str, steps: int) -> None:
        if record not in ("mean", "moments", "beliefs"):
            raise ValueError(f"record must be 'mean', 'moments' or 'beliefs', got {record!r}")
        self.record, self.evidence, self.steps = record, evidence, steps
        self.series: dict[str, Series] = {}
        self.at_once = False

    def add(self, belief: Belief, info: StepInfo) -> None:
        """Take in one step."""
        belief = trusted(belief)
        if not self.series and isinstance(belief, Particles):
            self.at_once = belief.x.numel() >= _LARGE
        if isinstance(belief, Gaussian):
            self._put("mean", belief.mean)
            if self.record != "mean":
                self._put("scale_tril", belief.scale_tril)
        else:
            self._add_cloud(belief)
        for name, value in zip(info._fields, info, strict=True):
            if isinstance(value, Tensor) and self._wanted(name):
                self._put(f"info.{name}", value, -1 if name == "ancestors" else None)

    def _add_cloud(self, belief: Particles) -> None:
        if self.record == "mean":
            self._put("mean", belief.mean)
            return
        mean, covariance = belief.moments()
        self._put("mean", mean)
        self._put("covariance", covariance)
        if self.record == "beliefs":
            self._put("x", belief.x, -2)
            self._put("log_weights", belief.log_weights, -1, -math.inf)
            if belief.scale_tril is not None:
                self._put("scale_tril", belief.scale_tril, -3)

    def _wanted(self, name: str) -> bool:
        if name == "ancestors":
            return self.record == "beliefs"
        return self.record != "mean" or not name.startswith("innovation")

    def _put(self, name: str, value: Tensor, axis: int | None = None, filling: float | None = None) -> None:
        series = self.series.get(name)
        if series is None:
            series = self.series[name] = Series(self.steps, axis, filling, self.at_once)
        series.add(value)

    def finish(self, final: FilterState[Any]) -> History:
        """The history of all steps taken in."""
        found = {name: series.stacked() for name, series in self.series.items() if self._whole(series)}
        mean, space = found["mean"], final.belief.space
        report: dict[str, Any] = {name: found.get(f"info.{name}") for name in StepInfo._fields}
        info = StepInfo(**{**report, "evidence": self.evidence})
        beliefs: Gaussian | Particles | None = None
        if isinstance(trusted(final.belief), Gaussian) and "scale_tril" in found:
            factor = found["scale_tril"]
            # Room for batch dims where all rows share one factor a step.
            factor = factor.reshape(len(factor), *[1] * (mean.dim() + 1 - factor.dim()), *factor.shape[1:])
            beliefs = Gaussian(mean, factor, space)
        elif "x" in found:
            beliefs = Particles(found["x"], found["log_weights"], found.get("scale_tril"), space)
        return History(mean, info, final, self.evidence, space, beliefs, found.get("covariance"))

    def _whole(self, series: Series) -> bool:
        """Whether every step gave a value."""
        return series.count == self.series["mean"].count
