"""Gates: measurements that do not fit what was expected are not taken in, and the decision is written down."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilt.moments import GateDecision, Linearization


@dataclass(frozen=True)
class Gate:
    """Chi-square test of the innovation, sensor by sensor.

    Of a measurement law with named parts (`torchfilt.Sensors`) each sensor is tested on its own, any other law as a
    whole. What is refused counts as not measured; belief and likelihood are those without it.

    Args:
        probability: with which a measurement that fits passes.
        outlier_log_density: log-density of a measurement that is none of ours, times how often it comes, such as
            log(0.02 / area of a field of view): what a refused measurement adds to the log-likelihood, one number for
            all sensors or one by name. In a bank of Gaussians it weighs members that refuse a measurement against
            those that take it in. None adds nothing, which is for single Gaussians only.
        sensors: names of the sensors to be tested; None for all.

    Raises:
        ValueError: a probability outside (0, 1), a density that is not finite; when used, names that the law does not
            have.
        TypeError: one name in place of several.
    """

    probability: float = 0.999
    outlier_log_density: float | Mapping[str, float] | None = None
    sensors: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if not 0 < self.probability < 1:
            raise ValueError(f"gate must be a probability in (0, 1) or None, got {self.probability}")
        if isinstance(self.sensors, str):
            raise TypeError(f"sensors must be names, such as ({self.sensors!r},), got a single one")
        density = self.outlier_log_density
        for value in density.values() if isinstance(density, Mapping) else [] if density is None else [density]:
            if not -float("inf") < value < float("inf"):
                raise ValueError(f"outlier_log_density must be finite, got {value}")

    def __call__(self, law: Any, line: Linearization, innovation: Tensor, observed: Tensor | None) -> GateDecision:
        """Decide about one measurement.

        Args:
            law: the measurement law; ``names`` and ``parts`` are looked for.
            line: its linearisation.
            innovation: (..., e), zero where not observed.
            observed: (..., e), (e,) or None for all.
        """
        size = innovation.shape[-1]
        parts: tuple[slice, ...] = getattr(law, "parts", None) or (slice(0, size),)
        names: tuple[str, ...] = getattr(law, "names", ("measurement",))
        self._check_names(names)
        there = torch.ones_like(innovation, dtype=torch.bool) if observed is None else observed.expand_as(innovation)
        rows = line.slope, line.spread(), line.negative
        tests = [_surprise(rows, innovation[..., part], there[..., part], part) for part in parts]
        nis, freedom = (torch.stack(values, -1) for values in zip(*tests, strict=True))
        chance = torch.special.gammaincc(freedom.clamp_min(1) / 2, nis / 2)
        tested = torch.tensor([self.sensors is None or name in self.sensors for name in names], device=nis.device)
        accepted = ~((chance < 1 - self.probability) & tested)  # a failed row, NaN, stays what it is
        widths = torch.tensor([part.stop - part.start for part in parts], device=nis.device)
        kept = there & accepted.repeat_interleave(widths, -1, output_size=size)
        refused = ~accepted & (freedom > 0)
        density = torch.where(refused, self._densities(names, nis), 0).sum(-1)
        return GateDecision(kept, accepted, nis, density)

    def _densities(self, names: tuple[str, ...], like: Tensor) -> Tensor:
        density = self.outlier_log_density
        if isinstance(density, Mapping):
            return like.new_tensor([density.get(name, 0.0) for name in names])
        return like.new_full((len(names),), 0.0 if density is None else density)

    def _check_names(self, names: tuple[str, ...]) -> None:
        density = self.outlier_log_density
        for name in (*(self.sensors or ()), *(density if isinstance(density, Mapping) else ())):
            if name not in names:
                raise ValueError(f"the gate names a sensor {name!r}, the measurement law has {', '.join(names)}")


def as_gate(gate: Gate | float | None) -> Gate | None:
    """A gate of its probability; None is none.

    Raises:
        ValueError: as `Gate`. TypeError: something else.
    """
    if gate is None or isinstance(gate, Gate):
        return gate
    if isinstance(gate, bool) or not isinstance(gate, int | float):
        raise TypeError(f"gate must be a Gate, a probability or None, got {type(gate).__name__}")
    return Gate(gate)


def by_sensor(values: Tensor | None, model: Any) -> Tensor | None:
    """What a gate reports (..., sensors); (...) for a law that has no named sensors."""
    if values is None or hasattr(model.observation, "names"):
        return values
    return values.squeeze(-1)


def _surprise(
    rows: tuple[Tensor, Tensor, Tensor | None], innovation: Tensor, there: Tensor, part: slice
) -> tuple[Tensor, Tensor]:
    """Squared innovation in units of its covariance (...), and how many components were there (...)."""
    present = there.to(innovation.dtype)
    slope, spread, negative = rows
    a, b = slope[..., part, :], spread[..., part, :]
    covariance = a @ a.mT + b @ b.mT
    if negative is not None:
        c = negative[..., part]
        covariance = covariance - c.unsqueeze(-1) * c.unsqueeze(-2)
    # What is not there gets unit variance and no correlation: it adds nothing.
    covariance = covariance * (present.unsqueeze(-1) * present.unsqueeze(-2)) + torch.diag_embed(1 - present)
    factor, failed = torch.linalg.cholesky_ex(covariance)
    z = torch.linalg.solve_triangular(factor, innovation.unsqueeze(-1), upper=False).squeeze(-1)
    return torch.where(failed > 0, torch.nan, z.square().sum(-1)), present.sum(-1)
