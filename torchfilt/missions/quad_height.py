"""Height of a multirotor from inertial sensors, a barometer that drifts and a range finder that may be withheld.

Two stages. An attitude filter (gyro, and specific force as "up" with a wide deviation) turns specific force upright;
the heading does not enter. Then a linear Kalman filter of the vertical channel: height above ground, velocity up, bias
of the upward force, and what the barometer reads too much. Four filters differ in that last part only:

* ``inertial``: the barometer is not used.
* ``fixed``: a constant offset; the noise of the barometer is as wide as its drift makes the likelihood want it.
* ``walk``: the offset is a random walk.
* ``wander``: a slow random walk and, beside it, a first-order Gauss-Markov process.

The ground is taken as flat: height is range times the cosine of the tilt. The range finder is withheld for some seconds
again and again, and in one row for good; the height then predicted is compared with what it read.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

import torchfilt as tf
from torchfilt.io.quad_baro_range import QuadBaroRange, read_quad_baro_range
from torchfilt.laws import LinearForm
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import digest, run_study
from torchfilt.models.attitude import multiply, rotate
from torchfilt.models.attitude.kinematics import ATTITUDE_SPACE, GyroTransition, VectorMeasurement
from torchfilt.models.attitude.rotations import from_rotation_vector

__all__ = [
    "FILTERS",
    "Flight",
    "HeightSettings",
    "VerticalMotion",
    "follow",
    "make_filter",
    "make_flight",
    "run_height",
    "summarize",
    "upright",
]

FILTERS = ("inertial", "fixed", "walk", "wander")
# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 1
# Of the state: height, velocity up, bias of the upward force, slow offset and wander of the barometer.
_SIZE = 5
# Standard gravity; what the place differs by goes into the bias.
_GRAVITY_M_S2 = 9.80665
# A second of the range finder about the end of a gap is what the prediction is compared with.
_COMPARED_S = 1.0

Step = Tensor | float | None


@dataclass(frozen=True)
class HeightSettings:
    """How the log is filtered.

    Args:
        data: the archive or its folder. stop_s: the log is used up to there.
        settle_s: after the start, before anything is withheld or scored.
        split_s: settings were chosen before it; gaps that begin after it are also scored by themselves.
        range_delay_s, baro_delay_s, velocity_delay_s: by which times of arrival are moved back; the last is of the
            satellite receiver's velocity, which is a witness only.
        range_sd_m, baro_sd_m: white noise. fixed_baro_sd_m: the latter for ``fixed``.
        force_noise_m_s2_sqrt_hz: root of the spectral density of the upward force's white noise.
        force_bias_walk_m_s3_sqrt_hz: the same of what drives its bias. hold_sd_m_s2: error of a force that is held
            through a gap of the inertial sensors.
        walk_m_sqrt_s: of the offset in ``walk``. slow_walk_m_sqrt_s, wander_sd_m, wander_time_s: ``wander``.
        attitude_step_s, angle_random_walk_rad_sqrt_s, gyro_bias_walk_rad_s_sqrt_s, up_sd_m_s2: attitude filter; the
            last is of each axis of a step's mean specific force seen as "up": circling leans it by 0.7 m/s^2 for some
            10 s, which is much more noise than that a step.
        gaps_s: how long the range finder is withheld. phases: how often each, shifted.

    Raises:
        ValueError: a number that is not positive and finite (delays may be zero), no gap, a part without room for one.
    """

    data: str = "data/quad_baro_range"
    stop_s: float = 840.0
    settle_s: float = 20.0
    split_s: float = 430.0
    range_delay_s: float = 0.24
    baro_delay_s: float = 0.35
    velocity_delay_s: float = 0.2
    range_sd_m: float = 0.012
    baro_sd_m: float = 0.05
    fixed_baro_sd_m: float = 0.96
    force_noise_m_s2_sqrt_hz: float = 0.09
    force_bias_walk_m_s3_sqrt_hz: float = 0.006
    hold_sd_m_s2: float = 0.3
    walk_m_sqrt_s: float = 0.28
    slow_walk_m_sqrt_s: float = 0.08
    wander_sd_m: float = 0.4
    wander_time_s: float = 4.0
    attitude_step_s: float = 0.2
    angle_random_walk_rad_sqrt_s: float = 0.003
    gyro_bias_walk_rad_s_sqrt_s: float = 1e-4
    up_sd_m_s2: float = 7.0
    gaps_s: tuple[float, ...] = (10.0, 30.0, 60.0)
    phases: int = 4

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name in ("data", "gaps_s"):
                continue
            if name.endswith("delay_s"):
                if not 0 <= value < inf:
                    raise ValueError(f"{name} must be zero or more and finite, got {value}")
            elif not 0 < value < inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if not self.gaps_s or not all(_COMPARED_S <= gap < inf for gap in self.gaps_s):
            raise ValueError(f"gaps_s must be at least {_COMPARED_S} s and finite, got {self.gaps_s}")
        room = self.stop_s - self.settle_s
        if room < max(self.gaps_s):
            raise ValueError(f"a gap of {max(self.gaps_s)} s has no room in {room:g} s, settle_s taken off")


class Flight(NamedTuple):
    """What filters are given and compared with: k steps that end where something was measured, R rows.

    Rows: the range finder used throughout; withheld for good after settling; then each gap and phase.

    time_s, dt_s (k,). quaternion (k, 4): attitude at the end, body to a world whose third axis is up, heading free.
    control (k, 2): increment of velocity up, m/s, gravity taken off, and the deviation of its noise. range_height_m
    (k,): range times cosine of tilt, NaN where silent. baro_m (k,). witness (k, 2): on-board height, m, and the
    receiver's velocity up, m/s; no filter sees them. withheld (k, R). ends: (row, first step, last step, gap in s) of
    each gap.
    """

    time_s: Tensor
    dt_s: Tensor
    quaternion: Tensor
    control: Tensor
    range_height_m: Tensor
    baro_m: Tensor
    witness: Tensor
    withheld: Tensor
    ends: list[tuple[int, int, int, float]]


# Law ------------------------------------------------------------------------------------------------------------------


class VerticalMotion(nn.Module):
    """Vertical channel over a step; linear.

    A state is height m, velocity up m/s, bias of the upward force m/s^2, slow offset and wander of a barometer m. The
    control u (..., 2) is the measured increment of velocity in m/s and the deviation of its error. The force is taken
    as constant over the step; bias and offset are random walks, the wander is a first-order Gauss-Markov process. What
    drives the bias reaches the velocity from the next step on.

    Args:
        bias_walk_m_s3_sqrt_hz, offset_walk_m_sqrt_s: roots of the spectral densities that drive them, zero or more.
        wander_sd_m: in the long run, zero or more. wander_time_s: in which it decays to 1/e.

    Raises:
        ValueError: a negative number, a time that is not positive; when called, no control or no step.

    Source: white noise through two integrators, Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
        and Navigation (2001), section 6.2.2.
    """

    def __init__(
        self, bias_walk_m_s3_sqrt_hz: float, offset_walk_m_sqrt_s: float, wander_sd_m: float, wander_time_s: float
    ) -> None:
        super().__init__()
        scales = (bias_walk_m_s3_sqrt_hz, offset_walk_m_sqrt_s, wander_sd_m)
        if not all(0 <= value < inf for value in scales) or not 0 < wander_time_s < inf:
            raise ValueError(
                f"walks and deviations must be zero or more and the time positive, got {scales}, {wander_time_s}"
            )
        self.bias_walk, self.offset_walk, self.wander_sd_m = scales
        self.wander_time_s = wander_time_s

    def linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        """Matrix, push and noise factor of a step of dt s: numbers, or (..., 1).

        Raises:
            ValueError: no control of two numbers, or no dt.
        """
        if u is None or u.shape[-1] != 2:
            raise ValueError(f"this law needs a control u (..., 2), got {'none' if u is None else tuple(u.shape)}")
        if dt is None:
            raise ValueError("this law needs the time step dt")
        push, noise = u.unbind(-1)
        span = (dt.to(u.dtype).squeeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt) + torch.zeros_like(push)
        zero, one = torch.zeros_like(push), torch.ones_like(push)
        kept = (-span / self.wander_time_s).exp()
        driven = self.wander_sd_m * (-torch.expm1(-2 * span / self.wander_time_s)).sqrt()
        root = span.sqrt()
        matrix = _rows(
            [
                [one, span, -(span**2) / 2, zero, zero],
                [zero, one, -span, zero, zero],
                [zero, zero, one, zero, zero],
                [zero, zero, zero, one, zero],
                [zero, zero, zero, zero, kept],
            ]
        )
        factor = _rows(
            [
                [noise * span / 3**0.5, zero, zero, zero, zero],
                [noise * 3**0.5 / 2, noise / 2, zero, zero, zero],
                [zero, zero, self.bias_walk * root, zero, zero],
                [zero, zero, zero, self.offset_walk * root, zero],
                [zero, zero, zero, zero, driven],
            ]
        )
        offset = torch.stack([push * span / 2, push, zero, zero, zero], -1)
        return LinearForm(matrix, offset, factor)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tf.Gaussian:
        """Law of the state (..., 5) after a step."""
        matrix, offset, factor = self.linear_form(u, dt)
        mean = (matrix @ x.unsqueeze(-1)).squeeze(-1)
        assert offset is not None
        return tf.Gaussian(mean + offset, factor)


def _rows(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


# Flight ---------------------------------------------------------------------------------------------------------------


def make_flight(log: QuadBaroRange, settings: HeightSettings) -> Flight:
    """Steps of the flight with their upright forces, and the range finder withheld.

    Returns:
        A `Flight`.

    Raises:
        ValueError: a part of the flight outside the log.
    """
    if settings.stop_s > log.imu_time_s[-1]:
        raise ValueError(f"stop_s must be within the log, {log.imu_time_s[-1].item():g} s, got {settings.stop_s}")
    start = log.imu_time_s[0].item()
    stamps = []
    for stamp, delay in ((log.range_time_s, settings.range_delay_s), (log.baro_time_s, settings.baro_delay_s)):
        stamps.append((stamp - delay).mul(1e3).round() / 1e3)  # times of the log are whole milliseconds
    inside = [(stamp > start) & (stamp <= settings.stop_s) for stamp in stamps]
    edges = torch.cat([log.imu_time_s[:1], *(stamp[keep] for stamp, keep in zip(stamps, inside, strict=True))]).unique()
    dt = edges.diff()
    quaternion, push = upright(log, edges, settings)
    span = edges[1:]
    noise = settings.force_noise_m_s2_sqrt_hz * dt.sqrt()
    held = torch.zeros_like(dt)
    for k in log.gaps.tolist():
        first, last = log.imu_time_s[k - 1], log.imu_time_s[k]
        held += (torch.minimum(span, last) - torch.maximum(edges[:-1], first)).clamp(min=0)
    noise = (noise.square() + (settings.hold_sd_m_s2 * held).square()).sqrt()
    silent = torch.full_like(span, torch.nan)
    distance, baro = (
        silent.index_put((torch.searchsorted(span, stamp[keep]),), values[keep])
        for stamp, keep, values in zip(stamps, inside, (log.range_m, log.baro_height_m), strict=True)
    )
    up = rotate(quaternion, torch.tensor([0.0, 0.0, 1.0], dtype=span.dtype).expand(len(span), 3))[:, 2]
    fixes = log.fixes
    witness = [
        torch.from_numpy(np.interp(span.numpy(), (fixes.time_s - delay).numpy(), values.numpy()))
        for delay, values in ((0.0, fixes.height_m), (settings.velocity_delay_s, fixes.velocity_up_m_s))
    ]
    control = torch.stack([push, noise], -1)
    return Flight(span, dt, quaternion, control, distance * up, baro, torch.stack(witness, -1), *_gaps(span, settings))


@torch.no_grad()
def upright(log: QuadBaroRange, edges_s: Tensor, settings: HeightSettings) -> tuple[Tensor, Tensor]:
    """Attitude at the ends of steps and the increments of velocity up, gravity taken off.

    The attitude filter runs in steps of its own; in between the gyro alone turns the body on.

    Args:
        edges_s: (k + 1,) start of the first step and ends of all, not before the log's first time.

    Returns:
        Quaternions (k, 4), body to a world whose third axis is up; increments (k,), m/s, turned by the attitude in the
        middle of the step.
    """
    first, last = log.imu_time_s[0].item(), edges_s[-1].item()
    grid = first + settings.attitude_step_s * torch.arange(int((last - first) / settings.attitude_step_s) + 1).to(
        edges_s
    )
    angle, change = (_integral(log.imu_time_s, values, grid).diff(dim=0) for values in (log.gyro_rad_s, log.accel_m_s2))
    start = _levelled(log.accel_m_s2[log.imu_time_s <= first + 1].mean(0))
    deviation = start.new_tensor([0.05, 0.05, 0.01, 0.01, 0.01, 0.01])
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.cat([start, start.new_zeros(3)]), deviation, ATTITUDE_SPACE, is_diagonal=True),
        GyroTransition(settings.angle_random_walk_rad_sqrt_s, settings.gyro_bias_walk_rad_s_sqrt_s),
        VectorMeasurement(start.new_tensor([0.0, 0.0, _GRAVITY_M_S2]), settings.up_sd_m_s2),
    )
    step_s = settings.attitude_step_s
    history = tf.ErrorStateKalmanFilter(model)(change / step_s, angle / step_s, step_s, record="mean")
    known = torch.cat([model.prior().mean[None], history.mean])

    def attitude(at: Tensor) -> Tensor:
        k = (torch.searchsorted(grid, at, right=True) - 1).clamp(max=len(known) - 1)
        turn = _integral(log.imu_time_s, log.gyro_rad_s, at) - _integral(log.imu_time_s, log.gyro_rad_s, grid[k])
        return multiply(known[k, :4], from_rotation_vector(turn - known[k, 4:] * (at - grid[k])[:, None]))

    push = rotate(
        attitude((edges_s[1:] + edges_s[:-1]) / 2), _integral(log.imu_time_s, log.accel_m_s2, edges_s).diff(dim=0)
    )
    return attitude(edges_s[1:]), push[:, 2] - _GRAVITY_M_S2 * edges_s.diff()


def _levelled(force: Tensor) -> Tensor:
    """The shortest turn that takes a specific force (3,) to up."""
    up = force / force.norm()
    turn = torch.stack([up[1], -up[0], up[0] * 0, 1 + up[2]])
    return turn / turn.norm()


def _integral(stamp: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """Integral of values (t, 3) from the first stamp to each time; a sample stands for the time since the last one."""
    sums = torch.cat([torch.zeros_like(values[:1]), (values[1:] * stamp.diff()[:, None]).cumsum(0)])
    k = torch.searchsorted(stamp, at).clamp(1, len(stamp) - 1)
    return sums[k] - values[k] * (stamp[k] - at)[:, None]


def _gaps(stamp: Tensor, settings: HeightSettings) -> tuple[Tensor, list[tuple[int, int, int, float]]]:
    """Where the range finder is withheld (k, R), and row, first and last step and length of each gap.

    A gap is followed by as long with the range finder, and by 10 s at least.
    """
    withheld = torch.zeros(len(stamp), 2 + len(settings.gaps_s) * settings.phases, dtype=torch.bool)
    withheld[stamp > settings.settle_s, 1] = True
    ends = []
    for g, gap_s in enumerate(settings.gaps_s):
        period_s = gap_s + max(gap_s, 10.0)
        for phase in range(settings.phases):
            row, begin_s = 2 + g * settings.phases + phase, settings.settle_s + phase * period_s / settings.phases
            while begin_s + gap_s <= stamp[-1]:
                inside = (stamp > begin_s) & (stamp <= begin_s + gap_s)
                withheld[inside, row] = True
                steps = inside.nonzero()
                ends.append((row, int(steps[0]), int(steps[-1]), gap_s))
                begin_s += period_s
    return withheld, ends


# Filters --------------------------------------------------------------------------------------------------------------


def make_filter(name: str, flight: Flight, settings: HeightSettings) -> Any:
    """A filter that starts at rest at the first range, its barometer set to it; sensors ``range`` and ``baro``.

    Returns:
        A Kalman filter, float64.

    Raises:
        ValueError: unknown name.
    """
    check_names([name], FILTERS, "filters")
    walk = {"walk": settings.walk_m_sqrt_s, "wander": settings.slow_walk_m_sqrt_s}.get(name, 0.0)
    wander = settings.wander_sd_m if name == "wander" else 0.0
    height, baro = (values[values.isfinite()][0] for values in (flight.range_height_m, flight.baro_m))
    zero = torch.zeros_like(height)
    mean = torch.stack([height, zero, zero, baro - height, zero])
    prior = tf.Gaussian(mean, mean.new_tensor([0.02, 0.3, 0.3, 0.3, wander]), is_diagonal=True)
    seen = {"range": (mean.new_tensor([[1.0, 0, 0, 0, 0]]), settings.range_sd_m)}
    if name != "inertial":
        sd = settings.fixed_baro_sd_m if name == "fixed" else settings.baro_sd_m
        seen["baro"] = mean.new_tensor([[1.0, 0, 0, 1, 1]]), sd
    sensors = tf.Sensors(
        {key: tf.LinearGaussian(matrix, scale_tril=mean.new_tensor([[sd]])) for key, (matrix, sd) in seen.items()}
    )
    motion = VerticalMotion(settings.force_bias_walk_m_s3_sqrt_hz, walk, wander, settings.wander_time_s)
    return tf.KalmanFilter(tf.StateSpaceModel(prior, motion, sensors))


@torch.no_grad()
def follow(name: str, flight: Flight, settings: HeightSettings, progress: bool = False) -> Arrays:
    """Run a filter on all rows as one batch.

    Returns:
        mean, deviation (k, R, 5): the state. Of the first row, NaN where not measured by itself: range_nis, baro_nis
        (k,). log_likelihood: of the first row, all steps. cpu_s.

    Raises:
        ValueError: unknown name. torchfilt.types.FilterError: the filter failed.
    """
    tracker, begin = make_filter(name, flight, settings), time.process_time()
    measured = {"range": flight.range_height_m[:, None].masked_fill(flight.withheld, torch.nan)[..., None]}
    if name != "inertial":
        measured["baro"] = flight.baro_m[:, None, None].expand_as(measured["range"])
    history = tracker(measured, flight.control, flight.dt_s, progress=progress)
    cpu_s = time.process_time() - begin
    assert history.diagnostics.nis is not None
    nis = history.diagnostics.nis[:, 0]
    heard = flight.range_height_m.isfinite(), flight.baro_m.isfinite() & (name != "inertial")
    alone = (heard[0] & ~heard[1]) | (heard[1] & ~heard[0])
    return {
        "mean": history.mean.numpy(),
        "deviation": history.covariance.diagonal(dim1=-2, dim2=-1).sqrt().numpy(),
        "range_nis": torch.where(alone & heard[0], nis, torch.nan).numpy(),
        "baro_nis": torch.where(alone & heard[1], nis, torch.nan).numpy(),
        "log_likelihood": history.log_likelihood[0].numpy(),
        "cpu_s": np.array(cpu_s),
    }


# Study ----------------------------------------------------------------------------------------------------------------


def summarize(result: Arrays, flight: Flight, settings: HeightSettings) -> dict[str, Any]:
    """Numbers of one filter, JSON-ready, after `HeightSettings.settle_s`.

    Returns:
        used: with the range finder, row 0: range_nis, baro_nis (means; None without a barometer), to_onboard of the
        height, velocity_bias_m_s and velocity_sd_m_s of the velocity less the receiver's, before and after split_s.
        drift_m: lowest and highest reading of the barometer too much, slow offset and wander, in row 0. withheld:
        errors by the range finder while it is never used. gaps, late_gaps: errors at the ends of gaps by length in s as
        a word; the latter of gaps that begin after split_s. log_likelihood, cpu_s.

        Errors are count, median_m, p90_m, rms_m of the absolute difference, and nees: mean of the squared difference by
        its claimed variance (1 if it is honest).
    """
    stamp, height = flight.time_s.numpy(), flight.range_height_m.numpy()
    mean, deviation = result["mean"], result["deviation"]
    settled = stamp > settings.settle_s
    found: dict[str, Any] = {"used": {}}
    for name in ("range_nis", "baro_nis"):
        measured = result[name][settled & np.isfinite(result[name])]
        found["used"][name] = float(measured.mean()) if len(measured) else None
    onboard, receiver = flight.witness.numpy().T
    found["used"]["to_onboard"] = _errors((mean[:, 0, 0] - onboard)[settled])
    halves = settled & (stamp <= settings.split_s), settled & (stamp > settings.split_s)
    off = mean[:, 0, 1] - receiver
    found["used"]["velocity_bias_m_s"] = [float(off[part].mean()) if part.any() else None for part in halves]
    found["used"]["velocity_sd_m_s"] = [float(off[part].std()) if part.any() else None for part in halves]
    drift = mean[settled, 0, 3:].sum(-1)
    found["drift_m"] = [float(drift.min()), float(drift.max())]
    seen = settled & np.isfinite(height)
    claimed = np.hypot(deviation[..., 0], settings.range_sd_m)
    found["withheld"] = _errors(mean[seen, 1, 0] - height[seen], claimed[seen, 1])
    for key, since in (("gaps", 0.0), ("late_gaps", settings.split_s)):
        found[key] = {}
        for gap_s in settings.gaps_s:
            ends = [(row, last) for row, first, last, s in flight.ends if s == gap_s and stamp[first] > since]
            if ends:
                error = np.array([_at_end(mean[:, row, 0] - height, stamp, last) for row, last in ends])
                found[key][f"{gap_s:g}"] = _errors(error, np.array([claimed[last, row] for row, last in ends]))
    return found | {"log_likelihood": float(result["log_likelihood"]), "cpu_s": float(result["cpu_s"])}


def _at_end(error: Any, stamp: Any, last: int) -> float:
    """Mean of what was measured in the last second of a gap."""
    return float(np.nanmean(error[(stamp > stamp[last] - _COMPARED_S) & (np.arange(len(stamp)) <= last)]))


def _errors(error: Any, claimed: Any = None) -> dict[str, Any]:
    size = np.abs(error)
    found: dict[str, Any] = {
        "count": len(size),
        "median_m": float(np.median(size)),
        "p90_m": float(np.quantile(size, 0.9)),
        "rms_m": float(np.sqrt((size**2).mean())),
    }
    return found if claimed is None else found | {"nees": float(((error / claimed) ** 2).mean())}


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a text table: a row a filter, then a row a filter and way to withhold."""
    lines = [
        "filter     range NIS  baro NIS   to on board rms   velocity less receiver's, bias before and after the split"
    ]
    for name, row in summary["filters"].items():
        used = row["used"]
        numbers = (used["range_nis"], used["baro_nis"], used["to_onboard"]["rms_m"], *used["velocity_bias_m_s"])
        lines.append(f"{name:10s}" + "".join(f"{'-' if n is None else format(n, '.2f'):>10s}" for n in numbers))
    lines += ["", "range withheld             count  median     90 %      rms (m)     NEES"]
    for name, row in summary["filters"].items():
        parts = {"for good": row["withheld"]}
        parts |= {f"{gap} s": part for gap, part in row["gaps"].items()}
        parts |= {f"{gap} s, late": part for gap, part in row["late_gaps"].items()}
        for how, part in parts.items():
            lines.append(
                f"{name:10s} {how:>12s} {part['count']:8d}{part['median_m']:8.2f} {part['p90_m']:8.2f} "
                f"{part['rms_m']:8.2f} {part['nees']:12.2f}"
            )
    return lines


def run_height(
    settings: HeightSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `HeightSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default all.
        say: told what happens, a line each. progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), settings, versions.

    Raises:
        ValueError: unknown filter, a part outside the log. torchfilt.io.files.LogError: a damaged or foreign log.
    """
    names = FILTERS if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    flight = make_flight(read_quad_baro_range(settings.data), settings)
    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **asdict(settings), "flight": digest(flight)},
        follow=lambda name: follow(name, flight, settings, progress),
        summarize=lambda name, result: summarize(result, flight, settings),
        table=table,
        draw=(lambda results, folder: _figures(results, flight, settings, folder)) if figures else None,
        say=say,
    )


def _figures(results: dict[str, Arrays], flight: Flight, settings: HeightSettings, folder: Path) -> list[Path]:
    """Height without the range finder, what the barometer reads too much, and errors at the ends of gaps."""
    from torchfilt.learning.figures import save_figure
    from torchfilt.missions.figures import COLOURS, TRUTH, new_figure

    folder.mkdir(parents=True, exist_ok=True)
    stamp, height, baro = (values.numpy() for values in (flight.time_s, flight.range_height_m, flight.baro_m))
    figure, axes = new_figure(2, 1, (9, 6), sharex=True)
    top, low = axes[:, 0]
    top.set_title("Height, range finder withheld after settling; ±3 sigma", fontsize=9)
    low.set_title("What the barometer reads too much, range finder in use", fontsize=9)
    raw = baro - np.interp(stamp, stamp[np.isfinite(height)], height[np.isfinite(height)])
    low.plot(stamp, raw, ".", ms=1, color=TRUTH, label="barometer less range")
    for colour, (name, result) in zip(COLOURS, results.items(), strict=False):
        if name == "inertial":  # leaves the axes within seconds
            continue
        mean, wide = result["mean"][:, 1, 0], 3 * result["deviation"][:, 1, 0]
        top.fill_between(stamp, mean - wide, mean + wide, color=colour, alpha=0.12, lw=0)
        top.plot(stamp, mean, color=colour, lw=0.7, label=name)
        low.plot(stamp, result["mean"][:, 0, 3:].sum(-1), color=colour, lw=0.7, label=name)
    top.plot(stamp[np.isfinite(height)], height[np.isfinite(height)], color="0.0", lw=0.8, label="range finder")
    top.set_ylim(-4, 10)
    low.set_xlabel("time, s")
    for ax in (top, low):
        ax.set_ylabel("m")
        ax.grid(alpha=0.25, lw=0.5)
        ax.legend(fontsize=7, ncols=5)
    written = [folder / "height.png"]
    save_figure(figure, written[-1])
    figure, axes = new_figure(1, 1, (7, 4.5), "Height after a gap of the range finder, less its reading")
    for k, (name, result) in enumerate(results.items()):
        place = [gap_s * (1 + 0.05 * (k - len(results) / 2)) for *_, gap_s in flight.ends]
        error = [abs(_at_end(result["mean"][:, row, 0] - height, stamp, last)) for row, _, last, _ in flight.ends]
        axes[0, 0].plot(place, error, ".", ms=4, alpha=0.6, color=COLOURS[k % len(COLOURS)], label=name)
    ax = axes[0, 0]
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks(settings.gaps_s, [f"{length:g}" for length in settings.gaps_s])
    ax.set_xticks([], minor=True)
    ax.set_xlabel("without range finder, s")
    ax.set_ylabel("m")
    ax.grid(alpha=0.25, lw=0.5)
    ax.legend(fontsize=7)
    written.append(folder / "gaps.png")
    save_figure(figure, written[-1])
    return written
