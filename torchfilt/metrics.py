"""How good an estimate is, and whether its covariance tells the truth about that."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchfilt.linalg import whiten
from torchfilt.spaces import EUCLIDEAN, Space

Verdict = Literal["overconfident", "consistent", "underconfident"]

__all__ = ["Band", "Consistency", "chi_square_band", "consistency", "nees", "nis", "rmse"]


def rmse(
    error: Tensor, groups: Mapping[str, Sequence[int] | slice] | None = None, dim: int | tuple[int, ...] = 0
) -> dict[str, Tensor]:
    """Root mean square of the error's length, for groups of coordinates.

    Args:
        error: (..., e), such as ``space.local(truth, estimate)``; a group's coordinates must share a unit.
        groups: coordinates by name, such as ``{"position_m": [0, 1, 2], "velocity_m_s": [3, 4, 5]}``; default one group
            "error" of all.
        dim: averaged over, such as 0 for time or (0, 1) for time and runs; never the last one.

    Returns:
        By name, the shape that averaging leaves.

    Raises:
        ValueError: a coordinate outside the error, an empty group, or the last dim in ``dim``.
    """
    size = error.shape[-1]
    dims = (dim,) if isinstance(dim, int) else tuple(dim)
    if any(d % error.dim() == error.dim() - 1 for d in dims):
        raise ValueError(f"dim must leave out the coordinates, the last of {error.dim()} dims, got {dim}")
    result = {}
    for name, chosen in (groups or {"error": range(size)}).items():
        index = list(range(size)[chosen]) if isinstance(chosen, slice) else list(chosen)
        if not index or not all(-size <= k < size for k in index):
            raise ValueError(f"group {name!r} must name coordinates of an error of {size}, got {index}")
        result[name] = error[..., index].square().sum(-1).mean(dims).sqrt()
    return result


def nees(estimate: Tensor, truth: Tensor, covariance: Tensor, space: Space = EUCLIDEAN) -> Tensor:
    """Normalised estimation error squared, e^T P^-1 e with e the tangent vector from estimate to truth.

    Args:
        estimate, truth: points (..., d) of the space.
        covariance: of the error, (..., e, e).
        space: where they live.

    Returns:
        (...); about e on average where the covariance is honest. NaN where it is not positive definite.

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4.
    """
    return _squared(space.local(estimate, truth), covariance)


def nis(innovation: Tensor, innovation_scale_tril: Tensor, observed: Tensor | None = None) -> Tensor:
    """Normalised innovation squared, v^T S^-1 v.

    Args:
        innovation: (..., m).
        innovation_scale_tril: factor of S, (m, m), (..., m, m), or (t, m, m) as a history reports it where the rows of
            innovations (t, *batch, m) share it.
        observed: (..., m) which components were measured; the others must have innovation zero, as the filters report.

    Returns:
        (...); about the number of measured components on average where the filter is consistent.

    Raises:
        ValueError: an innovation that is not zero where nothing was measured.
    """
    if observed is not None and bool((innovation.masked_fill(observed, 0) != 0).any()):
        raise ValueError("innovation must be zero where nothing was measured")
    factor = innovation_scale_tril
    if 2 < factor.dim() <= innovation.dim():
        factor = factor.reshape(len(factor), *[1] * (innovation.dim() + 1 - factor.dim()), *factor.shape[1:])
    factor = factor.expand(*innovation.shape, innovation.shape[-1])
    return torch.linalg.solve_triangular(factor, innovation.unsqueeze(-1), upper=False).squeeze(-1).square().sum(-1)


def _squared(error: Tensor, covariance: Tensor) -> Tensor:
    factor, failed = torch.linalg.cholesky_ex(covariance)
    factor = torch.where((failed > 0)[..., None, None], torch.nan, factor)
    factor = factor.expand(*error.shape, error.shape[-1]).reshape(-1, error.shape[-1], error.shape[-1])
    flat = error.reshape(-1, error.shape[-1])
    return whiten(factor, flat).square().sum(-1).reshape(error.shape[:-1])


@dataclass(frozen=True)
class Band:
    """Where the mean of chi-square values lies with probability ``confidence``."""

    low: float
    high: float
    expected: float
    confidence: float


def chi_square_band(freedom: float, count: float, confidence: float = 0.95) -> Band:
    """Band of the mean of ``count`` independent chi-square values, two-sided.

    Args:
        freedom: degrees of freedom of each.
        count: independent values; for correlated ones (the NEES of neighbouring steps), their effective number.
        confidence: probability of the band.

    Raises:
        ValueError: freedom or count not positive, confidence outside (0, 1).
    """
    if not (freedom > 0 and count > 0):
        raise ValueError(f"freedom and count must be positive, got {freedom} and {count}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}")
    from scipy.stats import chi2  # not needed to import the library

    tail = (1 - confidence) / 2
    low, high = (float(chi2.ppf(q, freedom * count)) / count for q in (tail, 1 - tail))
    return Band(low, high, float(freedom), confidence)


@dataclass(frozen=True)
class Consistency:
    """Verdict over runs and time.

    mean: of all values. mean_in_time (t,): over the runs at each step. inside: share of the steps whose mean over runs
    lies in ``step_band``. verdict: of the overall mean against ``band``. A finished sentence is `str` of the object.
    """

    name: str
    mean: float
    band: Band
    verdict: Verdict
    mean_in_time: Tensor
    step_band: Band
    inside: float
    runs: int

    def __str__(self) -> str:
        ratio = self.mean / self.band.expected
        words = {
            "overconfident": f"the errors are {ratio**0.5:.2f} times what the filter claims",
            "consistent": "the errors are what the filter claims",
            "underconfident": f"the errors are only {ratio**0.5:.2f} times what the filter claims",
        }
        runs = "1 run" if self.runs == 1 else f"{self.runs} runs"
        return (
            f"{self.verdict}: {words[self.verdict]}; mean {self.name} {self.mean:.3g} over {runs}, "
            f"{self.band.confidence:.0%} band {self.band.low:.3g} to {self.band.high:.3g} around "
            f"{self.band.expected:.3g}; {self.inside:.0%} of the steps inside their own band"
        )


def consistency(
    values: Tensor,
    freedom: float,
    *,
    confidence: float = 0.95,
    effective_steps: float | None = None,
    name: str = "NEES",
) -> Consistency:
    """Is a filter honest about its errors?

    Args:
        values: NEES or NIS, (t, *batch); NaN (not measured, no covariance) is left out.
        freedom: degrees of freedom of one value: e for the NEES, the number of measured components for the NIS.
        confidence: of the bands.
        effective_steps: how many of the t steps count as independent. The NIS of a right filter is white, all t; errors
            of neighbouring steps are not, and the default 1 is the safe choice: only runs count as independent.
        name: what the values are, for the sentence.

    Raises:
        ValueError: no finite value, effective_steps outside (0, t].
    """
    if values.dim() < 1 or values.numel() == 0:
        raise ValueError(f"values must be (t, *batch), got {tuple(values.shape)}")
    steps = len(values)
    effective = 1.0 if effective_steps is None else float(effective_steps)
    if not 0 < effective <= steps:
        raise ValueError(f"effective_steps must be in (0, {steps}], got {effective_steps}")
    flat = values.reshape(steps, -1).double()
    there = torch.isfinite(flat)
    if not bool(there.any()):
        raise ValueError("values must hold at least one finite number")
    runs = flat.shape[1]
    share = there.double().mean().item()
    mean = flat[there].mean().item()
    band = chi_square_band(freedom, runs * effective * share, confidence)
    count = there.sum(1)
    in_time = torch.where(there, flat, 0).sum(1) / count.clamp_min(1)
    in_time = torch.where(count > 0, in_time, torch.nan)
    step_band = chi_square_band(freedom, runs, confidence)
    seen = in_time[count > 0]
    inside = ((seen >= step_band.low) & (seen <= step_band.high)).double().mean().item()
    verdict: Verdict = "consistent"
    if mean > band.high:
        verdict = "overconfident"
    elif mean < band.low:
        verdict = "underconfident"
    return Consistency(name, mean, band, verdict, in_time, step_band, inside, runs)
