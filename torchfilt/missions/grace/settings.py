"""What a GRACE run does, as plain numbers: the only place where they are checked."""

import math
from dataclasses import asdict, dataclass
from typing import Any

# Raised when the same settings come to mean other numbers.
_VERSION = 1


@dataclass(frozen=True)
class GraceSettings:
    """Options of a run; JSON-ready.

    Attributes:
        folder: the log, see `torchfilt.io.grace`.
        training_hours: hours from midnight that dynamics are learned from.
        tracking_hours: hours after them that the filters run through.
        step_s: time between measurements and length of the learned steps, a multiple of 20 s.
        degree: highest degree of the potential.
        runs: noise seeds, filtered as one batch.
        particles: of the particle filter.
        seed: of measurement noise, priors and particles.
        range_sd_m: of the K-band range, its constant bias left out.
        radar_range_sd_m: of the simulated range.
        angle_3sigma_deg: of the simulated angles, three standard deviations.
        prior_sd_m, prior_sd_m_s, bias_sd_m: standard deviations of the prior, each axis; priors are off by a draw.
        outage_minutes: length of the gaps without any measurement.
        outage_starts_h: hours after the start of tracking at which they begin; None: a third and three quarters of it,
            where there is room.
        settle_minutes: first part of the tracking that no error is counted in; a revolution takes 94.

    Raises:
        ValueError: numbers out of range or that do not fit each other; the option is named.
    """

    folder: str = "data/grace_2010"
    training_hours: float = 9.0
    tracking_hours: float = 6.0
    step_s: float = 60.0
    degree: int = 36
    runs: int = 5
    particles: int = 100
    seed: int = 0
    range_sd_m: float = 0.01
    radar_range_sd_m: float = 1.0
    angle_3sigma_deg: float = 0.05
    prior_sd_m: float = 100.0
    prior_sd_m_s: float = 0.1
    bias_sd_m: float = 0.1
    outage_minutes: float = 45.0
    outage_starts_h: tuple[float, ...] | None = None
    settle_minutes: float = 94.0

    def __post_init__(self) -> None:
        positive = ("range_sd_m", "radar_range_sd_m", "angle_3sigma_deg", "prior_sd_m", "prior_sd_m_s", "bias_sd_m")
        for name in (*positive, "training_hours", "tracking_hours", "step_s"):
            value = getattr(self, name)
            if not (0 < value < math.inf):
                raise ValueError(f"{name} must be positive, got {value}")
        if self.step_s % 20 or self.step_s > 120:
            raise ValueError(f"step_s must be a multiple of 20 s, at most 120 s, got {self.step_s}")
        if self.training_hours * 3600 % self.step_s or self.training_hours < 3:
            raise ValueError(f"training_hours must be whole steps, at least 3 h, got {self.training_hours}")
        if self.training_hours + max(self.tracking_hours, 4) > 24:
            raise ValueError(
                "training_hours must leave 4 h of the day for tests and room for tracking_hours, got "
                f"{self.training_hours} and {self.tracking_hours}"
            )
        for name, least in (("degree", 2), ("runs", 1), ("particles", 10), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0 <= self.settle_minutes < 60 * self.tracking_hours:
            raise ValueError(f"settle_minutes must end before the tracking does, got {self.settle_minutes}")
        for start in self.outage_starts_h or ():
            if not self._has_room(start):
                raise ValueError(
                    f"outage_starts_h must leave room for {self.outage_minutes} min within {self.tracking_hours} h, "
                    f"got {start}"
                )

    def _has_room(self, start_h: float) -> bool:
        return 0 <= start_h <= self.tracking_hours - self.outage_minutes / 60

    @property
    def stride(self) -> int:
        """Epochs of the log in a step."""
        return round(self.step_s / 10)

    @property
    def training_steps(self) -> int:
        """Steps before the held-out part."""
        return round(self.training_hours * 3600 / self.step_s)

    @property
    def tracking_steps(self) -> int:
        """Measurements of a filter."""
        return int(self.tracking_hours * 3600 / self.step_s)

    @property
    def settle_steps(self) -> int:
        """Measurements before errors count."""
        return round(self.settle_minutes * 60 / self.step_s)

    @property
    def outage_rows(self) -> list[range]:
        """Measurements that the outages take away."""
        length = round(self.outage_minutes * 60 / self.step_s)
        hours = self.outage_starts_h
        if hours is None:
            hours = tuple(h for h in (self.tracking_hours / 3, self.tracking_hours * 3 / 4) if self._has_room(h))
        starts = [round(h * 3600 / self.step_s) for h in hours]
        return [range(start, start + length) for start in starts]

    def recipe(self, *more: str) -> dict[str, Any]:
        """What a kept result depends on: the data, the training, and the options named."""
        own = self.to_dict()
        return {"version": _VERSION} | {name: own[name] for name in ("folder", "training_hours", "step_s", *more)}

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        starts = self.outage_starts_h
        return asdict(self) | {"outage_starts_h": None if starts is None else list(starts)}
