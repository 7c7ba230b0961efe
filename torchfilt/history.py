"""What a filter did over a whole series."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.particles import Particles, PastStep
from torchfilt.spaces import EUCLIDEAN, Angle, Euclidean, Product, Space, UnitQuaternion
from torchfilt.storage import NOT_OURS, IntegrityError, read_arrays, write_arrays
from torchfilt.types import FilterState, Guarded, Moded, StepInfo, trusted

FILE_KIND = "torchfilt history"


@dataclass(frozen=True)
class History:
    """Stacked beliefs and reports over t steps.

    mean: (t, *batch, d). diagnostics: `StepInfo` with entries (t, *batch, ...). final: state to go on from.
    beliefs: stacked `Gaussian` or `Particles`, None where they were not recorded. evidence: what the log-likelihood is,
    see `torchfilt.run.Filter`.
    """

    mean: Tensor
    diagnostics: StepInfo
    final: FilterState[Any]
    evidence: str
    space: Space = EUCLIDEAN
    beliefs: Gaussian | Particles | None = None
    cloud_covariance: Tensor | None = None

    @property
    def covariance(self) -> Tensor:
        """Covariance of the error (t, *batch, e, e).

        Raises:
            ValueError: the run recorded means only.
        """
        if self.cloud_covariance is not None:
            return self.cloud_covariance
        if isinstance(self.beliefs, Gaussian):
            return self.beliefs.covariance
        raise ValueError("no covariance: the filter ran with record='mean'")

    @property
    def log_likelihood(self) -> Tensor:
        """Sum over the steps, (*batch)."""
        return self.diagnostics.log_likelihood.sum(0)

    def to_numpy(self) -> dict[str, Any]:
        """Arrays by name: mean, covariance (where recorded), log_likelihood (per step) and the diagnostics."""
        arrays = {"mean": self.mean}
        if self.beliefs is not None or self.cloud_covariance is not None:
            arrays["covariance"] = self.covariance
        arrays |= {name: value for name, value in self.diagnostics._asdict().items() if isinstance(value, Tensor)}
        return {name: value.detach().cpu().numpy() for name, value in arrays.items()}

    def to_xarray(self) -> Any:
        """The same as an `xarray.Dataset` with dims time, batch_0, ..., state (xarray is loaded here)."""
        import xarray

        batch = [f"batch_{k}" for k in range(self.mean.dim() - 2)]
        tails = {
            "mean": ["state"],
            "covariance": ["error", "error_2"],
            "innovation": ["measurement"],
            "innovation_scale_tril": ["measurement", "measurement_2"],
            "ancestors": ["particle"],
        }
        variables = {}
        for name, array in self.to_numpy().items():
            # A gate reports one entry a sensor where the measurement law names its sensors.
            by_sensor = name in ("accepted", "gate_nis") and array.ndim == self.mean.dim()
            tail = ["sensor"] if by_sensor else tails.get(name, [])
            shared = array.ndim == 1 + len(tail)
            variables[name] = (["time", *([] if shared else batch), *tail], array)
        return xarray.Dataset(variables, attrs={"evidence": self.evidence})

    def save(self, path: str | Path) -> None:
        """Write an NPZ (no pickle) with its SHA-256 manifest, atomically; the final state is in it."""
        final = trusted(self.final.belief)
        kind = "gaussian" if isinstance(final, Gaussian) else "particles"
        head = {
            "belief": kind,
            "evidence": self.evidence,
            "space": space_to_plain(self.space),
            "step": self.final.step,
            "seed": self.final.seed,
            "is_diagonal": bool(getattr(final, "is_diagonal", False)),
        }
        parts: dict[str, Tensor | None] = {"mean": self.mean, "covariance": self.cloud_covariance}
        report = self.diagnostics._asdict()
        parts |= {f"info.{name}": value for name, value in report.items() if isinstance(value, Tensor)}
        for prefix, belief in (("final", final), ("beliefs", self.beliefs)):
            if belief is not None:
                named = belief._asdict()
                parts |= {f"{prefix}.{name}": named[name] for name in named if isinstance(named[name], Tensor)}
        if isinstance(self.final.belief, Guarded):
            fallback, head["guarded"] = self.final.belief.fallback, True
            parts |= {"fallback.mean": fallback.mean, "fallback.scale_tril": fallback.scale_tril}
            parts["refused_s"] = self.final.belief.refused_s
        if isinstance(self.final.belief, Moded):
            head["moded"] = True
            parts |= {"mode": self.final.belief.mode, "since_s": self.final.belief.since_s}
        if isinstance(final, Particles):  # made on another way than from log_weights they differ in the last bit
            parts["final.weights"] = final.weights
            head["past"] = [_past_to_plain(part, f"final.past.{k}", parts) for k, part in enumerate(final.past)]
        write_arrays(path, {name: value for name, value in parts.items() if value is not None}, head, FILE_KIND)

    @classmethod
    def load(cls, path: str | Path) -> "History":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: no such file.
            IntegrityError: truncated, altered or foreign; names the file and the rule.
        """
        arrays, head = read_arrays(path, FILE_KIND)
        try:
            tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
            space = space_from_plain(head["space"])
            final = _belief(tensors, "final", head, space)
            if head.get("guarded"):
                fallback = Gaussian(tensors["fallback.mean"], tensors["fallback.scale_tril"], space)
                final = Guarded(final, fallback, tensors["refused_s"])
            if head.get("moded"):
                final = Moded(final, tensors["mode"], tensors["since_s"])
            recorded = {name for name in tensors if name.startswith("beliefs.")}
            beliefs = _belief(tensors, "beliefs", head, space) if recorded else None
            optional: dict[str, Any] = {name: tensors.get(f"info.{name}") for name in StepInfo._fields[2:]}
            optional["evidence"] = str(head["evidence"])
            info = StepInfo(tensors["info.log_likelihood"], tensors["info.ok"], **optional)
            return cls(
                tensors["mean"],
                info,
                FilterState(final, int(head["step"]), int(head["seed"])),
                str(head["evidence"]),
                space,
                beliefs,
                tensors.get("covariance"),
            )
        except NOT_OURS as error:
            raise IntegrityError(f"{path}: not a history of this version ({error})") from None


_SPACES = {"Euclidean": Euclidean, "Angle": Angle, "UnitQuaternion": UnitQuaternion}


def space_to_plain(space: Space) -> Any:
    """A space as JSON-ready values.

    Raises:
        TypeError: a space that is not one of the library's own.
    """
    if isinstance(space, Product):
        return ["Product", [space_to_plain(part) for part in space.spaces]]
    name = type(space).__name__
    if _SPACES.get(name) is not type(space):
        raise TypeError(f"only the library's own spaces can be saved, got {space!r}")
    return [name, dict(vars(space))]


def space_from_plain(value: Any) -> Space:
    """The inverse of `space_to_plain`."""
    name, content = value
    if name == "Product":
        return Product(*(space_from_plain(part) for part in content))
    space: Space = _SPACES[name](**content)
    return space


def _belief(tensors: dict[str, Tensor], prefix: str, head: dict[str, Any], space: Space) -> Any:
    own = {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}
    if head["belief"] == "gaussian":
        return Gaussian(own["mean"], own["scale_tril"], space, bool(head["is_diagonal"]))
    log_weights, weights = own["log_weights"], own.get("weights")
    held = None if weights is None else (log_weights, weights)
    past = head.get("past", []) if prefix == "final" else []
    steps = tuple(_past_from_plain(plain, f"past.{k}", own) for k, plain in enumerate(past))
    return Particles(own["x"], log_weights, own.get("scale_tril"), space, held, past=steps)


def _past_to_plain(part: PastStep, prefix: str, arrays: dict[str, Tensor | None]) -> dict[str, Any]:
    """Put a past step's tensors into ``arrays``; what is left of it, ready for JSON."""
    fields = part._asdict()
    arrays |= {f"{prefix}.{name}": value for name, value in fields.items() if isinstance(value, Tensor)}
    return {name: value for name, value in fields.items() if value is not None and not isinstance(value, Tensor)}


def _past_from_plain(plain: dict[str, Any], prefix: str, arrays: dict[str, Tensor]) -> PastStep:
    """The inverse of `_past_to_plain`."""
    fields: dict[str, Any] = {name: arrays.get(f"{prefix}.{name}", plain.get(name)) for name in PastStep._fields}
    return PastStep(**fields)
