"""Observability by the names of the states: which ones are seen, as a table and a heat map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilt.models.control.observability import Scale, rank, scale_columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 0.05
"""Parts of a direction that a table shows, of its largest."""


@dataclass(frozen=True, eq=False)
class ObservabilityReport:
    """What one set of measurements says about each state.

    title: of the sensors or manoeuvre. names: of the d states. rank, singular_values, tolerance: as in `Rank`.
    share (d,): from 0, not observed at all, to 1, observed: squared length of what is left of the state's unit vector
    in the observable subspace, states scaled. directions (d - rank, d): basis of what is not observed, in the states'
    own units, each row with a 1 at a state that no other row has. sizes (d,): what a state was scaled by.
    """

    title: str
    names: tuple[str, ...]
    rank: int
    singular_values: Tensor
    tolerance: float
    share: Tensor
    directions: Tensor
    sizes: Tensor

    @property
    def unobserved(self) -> tuple[str, ...]:
        """Names of the states that take part in a direction that is not observed."""
        least = _least(self.share)
        return tuple(name for name, share in zip(self.names, self.share.tolist(), strict=True) if 1 - share > least)

    def table(self) -> str:
        """Text: rank and what it was decided from, the share of each state, the directions that are not observed."""
        width = max(len(name) for name in self.names)
        values = self.singular_values.tolist()
        kept, dropped = values[: self.rank], values[self.rank :]
        head = f"{self.title}: " if self.title else ""
        lines = [f"{head}rank {self.rank} of {len(self.names)}"]
        lines.append(
            f"singular values: counted {_span(kept)}, not counted {_span(dropped)}, limit {self.tolerance:.1e}"
        )
        lines += [
            f"  {name:{width}s} {share:5.2f}" for name, share in zip(self.names, self.share.tolist(), strict=True)
        ]
        if len(self.directions):
            lines.append(f"not observed, in the states' units, parts below {_SHOWN:.0%} of the largest left out:")
        weight = (self.directions / self.sizes).abs()
        shown = torch.where(weight >= _SHOWN * weight.amax(-1, keepdim=True), self.directions, 0)
        lines += [f"  {self._direction(row)}" for row in shown.tolist()]
        return "\n".join(lines)

    def _direction(self, row: list[float]) -> str:
        parts = [f"{value:+.4g} {name}" for name, value in zip(self.names, row, strict=True) if value]
        return "  ".join(parts)


def observability_report(
    matrix: Tensor, names: Sequence[str], *, title: str = "", scale: Scale = None, tolerance: float | None = None
) -> ObservabilityReport:
    """Report of one matrix whose columns are states: `obsv`, `total_observability`, a Gramian, sensitivities.

    Args:
        matrix: (m, d). Of a Gramian the singular values are squares: take its factor or the sensitivities if you can.
        names: of the d states. title: of the sensors or manoeuvre.
        scale, tolerance: as in `rank`. A share compares states of different units, so it needs a scale: sizes of the
            states are the honest one.

    Returns:
        `ObservabilityReport`.

    Raises:
        TypeError: as `rank`. ValueError: as `rank`, a batch, names that are not d different ones.
    """
    scaled = scale_columns(matrix, scale)
    if matrix.dim() != 2:
        raise ValueError(f"a report is of one matrix (m, d), got shape {tuple(matrix.shape)}")
    size = matrix.shape[-1]
    names = tuple(names)
    if len(names) != size or len(set(names)) != size:
        raise ValueError(f"names must be {size} different ones, one a state, got {len(names)}: {names}")
    found = rank(scaled.detach(), tolerance)
    seen = int(found.rank)
    _, _, right = torch.linalg.svd(scaled.detach(), full_matrices=True)
    share = 1 - right[seen:].square().sum(0)
    directions = _reduced(right[seen:])
    sizes = _sizes(matrix.detach(), scale)
    directions = directions * sizes
    lead = directions.gather(-1, _leaders(right[seen:]).unsqueeze(-1))
    return ObservabilityReport(
        title, names, seen, found.singular_values, float(found.tolerance), share.clamp(0, 1), directions / lead, sizes
    )


def _least(like: Tensor) -> float:
    """Share of a unit direction up to which a state has no part in it: above rounding, below anything of use."""
    return max(1e-6, 100 * torch.finfo(like.dtype).eps)


def _sizes(matrix: Tensor, scale: Scale) -> Tensor:
    """What `scale_columns` multiplied each column by."""
    if isinstance(scale, Tensor):
        return scale.to(matrix)
    length = torch.linalg.vector_norm(matrix, dim=0)
    return torch.where(length > 0, 1 / length, 1) if scale == "columns" else torch.ones_like(length)


def _leaders(basis: Tensor) -> Tensor:
    """A column for each row of a basis (k, d), such that these columns are as far from dependent as possible."""
    from scipy import linalg

    if len(basis) == 0:
        return torch.zeros(0, dtype=torch.long)
    _, order = linalg.qr(basis.double().cpu().numpy(), mode="r", pivoting=True)
    return torch.as_tensor(order[: len(basis)].copy()).long().sort().values


def _reduced(basis: Tensor) -> Tensor:
    """The same space by rows that are easy to read: each leader in one of them only, what rounding left set to zero."""
    leaders = _leaders(basis)
    rows = torch.linalg.solve(basis[:, leaders], basis)
    return torch.where(rows.abs() > _least(rows), rows, 0)


def _span(values: list[float]) -> str:
    return f"{values[0]:.1e} to {values[-1]:.1e}" if values else "none"


def heat_map(reports: Sequence[ObservabilityReport], axes: "Axes | None" = None) -> "Axes":
    """States by sensor sets or manoeuvres: the share of each state that is observed.

    Args:
        reports: one a column, of the same states. axes: to draw on; default those of a new figure, outside pyplot.

    Returns:
        The axes; ``axes.figure.savefig`` keeps the figure.

    Raises:
        ValueError: no reports, or reports of different states.
    """
    from matplotlib.figure import Figure

    if not reports or len({report.names for report in reports}) != 1:
        raise ValueError(f"reports must be at least one, all of the same states, got {len(reports)}")
    names = reports[0].names
    if axes is None:
        size = (2.5 + 0.9 * len(reports), 1.5 + 0.27 * len(names))
        axes = Figure(figsize=size, layout="constrained").subplots()
    shares = torch.stack([report.share for report in reports], -1).cpu().numpy()
    image = axes.imshow(shares, vmin=0, vmax=1, cmap="cividis", aspect="auto")
    for (row, column), share in ((where, shares[where]) for where in _cells(shares.shape)):
        colour = "black" if share > 0.6 else "white"
        axes.text(column, row, f"{share:.2f}", ha="center", va="center", fontsize=7, color=colour)
    labels = [f"{report.title}\nrank {report.rank}" for report in reports]
    axes.set_xticks(range(len(reports)), labels, rotation=30, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.figure.colorbar(image, ax=axes, label="observed share")
    return axes


def _cells(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    return [(row, column) for row in range(shape[0]) for column in range(shape[1])]
