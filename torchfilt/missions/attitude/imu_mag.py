"""Attitude of a hand-moved inertial sensor with magnetometer against cameras, from wrong initial attitudes.

The gyro is integrated sample by sample over groups. Specific force and field are turned by it into the axes of the end
of a longer block and averaged there: what a body accelerates within a block is a difference of velocities, so a mean
tells more than its samples. Between the ends of blocks these sensors are silent.

The magnetometer lags behind the gyro, see `field_delay`. A lag of 14 ms is an error of 4 degrees at the rates of this
log; it is undone by a filter that runs as much later.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

import torchfilt as tf
from torchfilt.io.imu_mag_mocap import ImuMagLog, read_imu_mag_mocap
from torchfilt.missions.attitude.motion import to_ends
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import digest, run_study
from torchfilt.models.attitude import from_rotation_vector, inverse, multiply, rotate, to_rotation_vector
from torchfilt.models.attitude.kinematics import ATTITUDE_SPACE, GyroTransition, VectorMeasurement
from torchfilt.spaces import EUCLIDEAN

__all__ = [
    "FILTERS",
    "ImuMagSettings",
    "Motion",
    "field_delay",
    "follow",
    "make_filter",
    "make_motion",
    "run_imu_mag",
    "summarize",
]

FILTERS = ("mekf", "ukf", "llpf")
# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 2
# About the vertical, about a horizontal axis, about one in between.
_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0))
_MICROTESLA = 1e6
# Standing still: no faster than that, specific force that close to gravity.
_REST_RAD_S, _REST_M_S2 = 0.03, 0.3
# The lag of the magnetometer is looked for up to so many rows, by turns over the second number of rows.
_LONGEST_DELAY, _TURN_ROWS = 12, 8
_CONVERGED_DEG = 5.0


@dataclass(frozen=True)
class ImuMagSettings:
    """How the log is filtered.

    Args:
        data: folder of the log.
        angles_deg: initial errors, each about the vertical, about east and about an axis in between; 0 once.
        group: samples whose gyro is integrated to one step. block: steps whose vectors are averaged.
        accel_sd_m_s2, field_sd_microtesla: of a block's mean, an axis; body acceleration and the field's changes from
            place to place included.
        angle_random_walk_rad_sqrt_s: white noise of the gyro, its scale error in motion included.
        gyro_bias_walk_rad_s_sqrt_s: what drives the bias. rest_sd_rad_s: of a step's mean rate as a measurement of
            the bias, while the sensor stands still.
        prior_sd_deg: of the initial attitude, an axis. prior_bias_sd_rad_s: of the initial bias.
        iterations: linearisations of a measurement in the error-state filter and in each member of the bank.
        particles, seed: of the bank.
        stop_s: the log is filtered up to there; None: to the end of the movement.

    Raises:
        ValueError: a number that is not positive and finite, no angle or one outside 0 to 180.
    """

    data: str = "data/imu_mag_mocap"
    angles_deg: tuple[float, ...] = (0.0, 30.0, 90.0, 150.0, 180.0)
    group: int = 10
    block: int = 14
    accel_sd_m_s2: float = 0.5
    field_sd_microtesla: float = 2.0
    angle_random_walk_rad_sqrt_s: float = 0.01
    gyro_bias_walk_rad_s_sqrt_s: float = 1e-5
    rest_sd_rad_s: float = 1e-3
    prior_sd_deg: float = 103.0
    prior_bias_sd_rad_s: float = 0.01
    iterations: int = 5
    particles: int = 24
    seed: int = 0
    stop_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name in ("data", "angles_deg", "seed") or value is None:
                continue
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if not self.angles_deg or not all(0 <= angle <= 180 for angle in self.angles_deg):
            raise ValueError(f"angles_deg must be from 0 to 180, got {self.angles_deg}")


class Motion(NamedTuple):
    """What filters are given and scored by, k steps; world axes east, north, up.

    time_s (k,): ends of steps since the first row that the cameras see. rate_rad_s (k, 3). measurements (k, 9):
    specific force in m/s^2, field in microtesla, resting rate in rad/s, NaN where silent. step_s. truth (k, 4), NaN
    where lost. scored (k,): in movement and seen. start (4,): truth at time 0. field (3,), gravity (3,): references.
    delay_rows: of the magnetometer, undone.
    """

    time_s: Tensor
    rate_rad_s: Tensor
    measurements: Tensor
    step_s: float
    truth: Tensor
    scored: Tensor
    start: Tensor
    field: Tensor
    gravity: Tensor
    delay_rows: int


def make_motion(log: ImuMagLog, settings: ImuMagSettings) -> Motion:
    """Steps from the first row that the cameras see.

    The references are those of the standstill before the movement: the length of the specific force, and the field's
    horizontal and upward parts, without the cameras. Only the heading of the field there is theirs.

    Raises:
        ValueError: a log, or a stop, without room for one step.
    """
    seen = torch.isfinite(log.quaternion[:, 0])
    moved = log.movement.nonzero()[:, 0]
    first = int(seen.nonzero()[0])
    row_s = (log.times_s[1] - log.times_s[0]).item()
    last = int(moved[-1]) if settings.stop_s is None else min(int(settings.stop_s / row_s), len(seen) - 1)
    steps = (last - first) // settings.group
    if steps < 1:
        raise ValueError(
            f"there is no room for a step of {settings.group} rows from {first * row_s:.2f} s, when the cameras first "
            f"see the sensor, to {last * row_s:.2f} s"
        )
    rows = slice(first + 1, first + 1 + steps * settings.group)
    delay = field_delay(log)
    held = torch.cat([log.mag_t[delay:], log.mag_t[-1:].expand(delay, 3)])
    grouped = [
        values[rows].unflatten(0, (steps, settings.group))
        for values in (log.gyro_rad_s, log.accel_m_s2, held * _MICROTESLA)
    ]
    turn, force, field = to_ends(grouped[0] * row_s, grouped[1], grouped[2])
    step_s = settings.group * row_s
    still = slice(first, int(moved[0]))
    gravity, reference = _references(log, still, seen[still])
    rate = to_rotation_vector(turn) / step_s
    resting = (grouped[0].norm(dim=-1) < _REST_RAD_S).all(-1) & ((force.norm(dim=-1) - gravity[2]).abs() < _REST_M_S2)
    rest = torch.where(resting[:, None], rate, torch.nan)
    force, field = _blocks(turn, settings.block, force, field)
    ends = torch.arange(1, steps + 1) * settings.group
    truth = log.quaternion[first + ends]
    scored = log.movement[first + ends] & torch.isfinite(truth[:, 0])
    measurements = torch.cat([force, field, rest], -1)
    start = log.quaternion[first]
    return Motion(ends * row_s, rate, measurements, step_s, truth, scored, start, reference, gravity, delay)


def field_delay(log: ImuMagLog) -> int:
    """Rows by which the magnetometer lags behind the gyro: where the turns of the field fit those of the gyro best.

    The cameras play no part. Over a few rows the field in body axes turns against the gyro by the turn of so many rows
    before; the lag with the least mean square of what does not fit counts.
    """
    row_s = (log.times_s[1] - log.times_s[0]).item()
    reach = _LONGEST_DELAY + _TURN_ROWS
    starts = log.movement.nonzero()[:, 0]
    starts = starts[(starts >= reach) & (starts < len(log.movement) - _TURN_ROWS)]
    if not len(starts):
        return 0
    turns = from_rotation_vector(log.gyro_rad_s * row_s)
    misfit = []
    for lag in range(_LONGEST_DELAY + 1):
        whole = turns[starts + 1 - lag]
        for k in range(2, _TURN_ROWS + 1):
            whole = multiply(whole, turns[starts + k - lag])
        off = log.mag_t[starts + _TURN_ROWS] - rotate(inverse(whole), log.mag_t[starts])
        misfit.append(off.square().mean())
    return int(torch.stack(misfit).argmin())


def _blocks(turn: Tensor, size: int, *vectors: Tensor) -> list[Tensor]:
    """Means of blocks of steps at their last one, NaN elsewhere."""
    count = len(turn) // size
    found = [torch.full_like(v, torch.nan) for v in vectors]
    if count:
        angle = to_rotation_vector(turn[: count * size]).unflatten(0, (count, size))
        _, *means = to_ends(angle, *(v[: count * size].unflatten(0, (count, size)) for v in vectors))
        for whole, mean in zip(found, means, strict=True):
            whole[size - 1 : count * size : size] = mean
    return found


def _references(log: ImuMagLog, still: slice, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Gravity's reaction in m/s^2 and the field in microtesla, ENU."""
    force, field = log.accel_m_s2[still].mean(0), log.mag_t[still].mean(0) * _MICROTESLA
    up = (field @ force) / force.norm()
    level = (field.square().sum() - up.square()).sqrt()
    east, north, _ = rotate(log.quaternion[still][seen], log.mag_t[still][seen]).mean(0).unbind()
    along = torch.stack([east, north]) / torch.hypot(east, north)
    return torch.stack([up * 0, up * 0, force.norm()]), torch.cat([along * level, up[None]])


class _RestingRate(nn.Module):
    """A gyro that does not turn shows its bias."""

    size = 3

    def __init__(self, sd: float) -> None:
        super().__init__()
        self.sd = sd

    def forward(self, x: Tensor) -> tf.Gaussian:
        return tf.Gaussian(x[..., 4:], x.new_full((3,), self.sd), EUCLIDEAN, is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Any = None) -> tuple[tf.Gaussian, Tensor]:
        jacobian = torch.eye(6, dtype=x.dtype, device=x.device)[3:]
        return self(x), jacobian.expand(*x.shape[:-1], 3, 6)


def initial_errors(settings: ImuMagSettings) -> tuple[list[str], Tensor]:
    """Names and rotation vectors (R, 3) in world axes, rad."""
    names, found = [], []
    for angle in settings.angles_deg:
        for axis, name in zip(_AXES, ("up", "east", "oblique"), strict=True):
            if angle == 0 and name != "up":
                continue
            names.append("0" if angle == 0 else f"{angle:g} {name}")
            direction = torch.tensor(axis, dtype=torch.float64)
            found.append(direction / direction.norm() * math.radians(angle))
    return names, torch.stack(found)


def make_filter(name: str, motion: Motion, settings: ImuMagSettings) -> Any:
    """A filter whose batch rows start with the initial errors.

    Raises:
        ValueError: unknown name.
    """
    check_names([name], FILTERS, "filters")
    _, errors = initial_errors(settings)
    start = multiply(from_rotation_vector(errors), motion.start.expand(len(errors), 4))
    mean = torch.cat([start, torch.zeros_like(errors)], -1)
    deviation = [math.radians(settings.prior_sd_deg)] * 3 + [settings.prior_bias_sd_rad_s] * 3
    prior = tf.Gaussian(mean, torch.tensor(deviation, dtype=mean.dtype), ATTITUDE_SPACE, is_diagonal=True)
    sensors = tf.Sensors(
        accelerometer=VectorMeasurement(motion.gravity, settings.accel_sd_m_s2),
        magnetometer=VectorMeasurement(motion.field, settings.field_sd_microtesla),
        rest=_RestingRate(settings.rest_sd_rad_s),
    )
    gyro = GyroTransition(settings.angle_random_walk_rad_sqrt_s, settings.gyro_bias_walk_rad_s_sqrt_s)
    model = tf.StateSpaceModel(prior, gyro, sensors)
    if name == "mekf":
        return tf.ErrorStateKalmanFilter(model, iterations=settings.iterations)
    if name == "ukf":
        return tf.UnscentedKalmanFilter(model)
    rule = tf.moments.taylor()
    return tf.LocallyLinearizedParticleFilter(model, settings.particles, rule, iterations=settings.iterations)


@torch.no_grad()
def follow(name: str, motion: Motion, settings: ImuMagSettings, progress: bool = False) -> Arrays:
    """Run a filter from all initial errors as one batch.

    Returns:
        time_s (k,), scored (k,), mean (k, R, 7), deviation (k, R, 6), error_deg (k, R, 3): total, heading and
        inclination, NaN where the cameras saw nothing, turn_rad (k, R): heading with its sign; cpu_s.

    Raises:
        ValueError: unknown name. torchfilt.types.FilterError: the filter failed.
    """
    from tqdm import tqdm

    tracker = make_filter(name, motion, settings)
    rows = len(initial_errors(settings)[1])
    state, begin = tracker.init((rows,), settings.seed), time.process_time()
    means, deviations = [], []
    for y, u in tqdm(
        zip(motion.measurements, motion.rate_rad_s, strict=True),
        total=len(motion.time_s),
        unit="step",
        disable=None if progress else True,
    ):
        state, _ = tracker.step(state, y.expand(rows, -1), u, motion.step_s)
        belief = state.belief
        mean, covariance = belief.moments() if name == "llpf" else (belief.mean, belief.covariance)
        means.append(mean)
        deviations.append(covariance.diagonal(dim1=-2, dim2=-1).sqrt().expand(rows, -1))
    mean = torch.stack(means)
    total, turn = attitude_errors(mean[..., :4], motion.truth[:, None].expand(-1, rows, -1))
    found = {
        "time_s": motion.time_s,
        "scored": motion.scored,
        "mean": mean,
        "deviation": torch.stack(deviations),
        "error_deg": total,
        "turn_rad": turn,
    }
    return {key: value.numpy() for key, value in found.items()} | {"cpu_s": np.array(time.process_time() - begin)}


def attitude_errors(estimate: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Total, heading and inclination errors (..., 3) in deg, and the heading's with its sign (...) in rad.

    Args:
        estimate, truth: quaternions (..., 4), body to ENU.

    Source: Laidig, Caruso, Cereatti, Seel, Data 6(7), 2021: parts of the error quaternion in the world's axes.
    """
    x, y, z, w = multiply(estimate, inverse(truth)).unbind(-1)
    level, tilt = torch.hypot(z, w), torch.hypot(x, y)
    total = 2 * torch.atan2(torch.hypot(tilt, z), w.abs())
    turn = 2 * torch.atan2(z * torch.where(w < 0, -1.0, 1.0), w.abs())
    return torch.stack([total, turn.abs(), 2 * torch.atan2(tilt, level)], -1).rad2deg(), turn


def summarize(result: Arrays, motion: Motion, settings: ImuMagSettings) -> dict[str, Any]:
    """Numbers of one filter, JSON-ready.

    Returns:
        rows: by initial error: converged_s, after which the total error stays below 5 deg until the movement starts
            (None: never); rms_deg of total, heading and inclination over the scored rows, and aligned_rms_deg with the
            constant turn_deg about the vertical taken out; both None without scored rows. cpu_s.
    """
    names, _ = initial_errors(settings)
    scored = result["scored"]
    begin = int(np.argmax(scored)) if scored.any() else len(scored)
    rows = {}
    for r, name in enumerate(names):
        found: dict[str, Any] = {"converged_s": _settled(result["time_s"][:begin], result["error_deg"][:begin, r, 0])}
        found |= {"rms_deg": None, "aligned_rms_deg": None, "turn_deg": None}
        if scored.any():
            turn = float(np.arctan2(*(f(result["turn_rad"][scored, r]).mean() for f in (np.sin, np.cos))))
            mean = torch.from_numpy(result["mean"][scored, r, :4])
            back = from_rotation_vector(mean.new_tensor([0.0, 0.0, -turn]))
            aligned, _ = attitude_errors(multiply(back.expand_as(mean), mean), motion.truth[scored])
            found["rms_deg"] = _rms(result["error_deg"][scored, r])
            found["aligned_rms_deg"] = _rms(aligned.numpy())
            found["turn_deg"] = math.degrees(turn)
        rows[name] = found
    return {"rows": rows, "cpu_s": float(result["cpu_s"])}


def _rms(error: np.ndarray) -> dict[str, float]:
    return dict(zip(("total", "heading", "inclination"), np.sqrt((error**2).mean(0)).tolist(), strict=True))


def _settled(stamp: np.ndarray, error: np.ndarray) -> float | None:
    off = np.flatnonzero(error > _CONVERGED_DEG)
    if not len(off):
        return 0.0
    return float(stamp[off[-1] + 1]) if off[-1] + 1 < len(stamp) else None


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a text table, a row a filter and initial error."""
    lines = ["filter  start        settled  total heading inclin. | aligned: total heading inclin.   turn   (deg, s)"]
    for name, found in summary["filters"].items():
        for start, row in found["rows"].items():
            settled = "never" if row["converged_s"] is None else f"{row['converged_s']:.1f}"
            line = f"{name:7s} {start:12s} {settled:>7s}"
            if row["rms_deg"] is not None:
                raw, aligned = row["rms_deg"].values(), row["aligned_rms_deg"].values()
                line += "".join(f"{value:8.2f}" for value in raw) + "   |     "
                line += "".join(f"{value:8.2f}" for value in (*aligned, row["turn_deg"]))
            lines.append(line)
    return lines


def run_imu_mag(
    settings: ImuMagSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `ImuMagSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default all.
        say: told what happens, a line each. progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), settings, versions.

    Raises:
        ValueError: unknown filter. torchfilt.io.files.LogError: a damaged or foreign log.
    """
    names = FILTERS if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    motion = make_motion(read_imu_mag_mocap(settings.data), settings)
    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **asdict(settings), "motion": digest(motion)},
        follow=lambda name: follow(name, motion, settings, progress),
        summarize=lambda name, result: summarize(result, motion, settings),
        table=table,
        draw=(lambda results, folder: _figures(results, settings, folder)) if figures else None,
        say=say,
    )


def _figures(results: dict[str, Arrays], settings: ImuMagSettings, folder: Path) -> list[Path]:
    """Error of each filter from each initial error, and the gyro's bias with its deviation."""
    from torchfilt.learning.figures import save_figure
    from torchfilt.missions.figures import COLOURS, new_figure

    folder.mkdir(parents=True, exist_ok=True)
    names, _ = initial_errors(settings)
    errors, axes = new_figure(len(results), 1, (9, 3 * len(results)), "Attitude error", sharex=True)
    biases, panes = new_figure(len(results), 1, (9, 3 * len(results)), "Gyro bias, ±3 sigma", sharex=True)
    for ax, pane, (name, result) in zip(axes[:, 0], panes[:, 0], results.items(), strict=True):
        stamp = result["time_s"]
        for r, start in enumerate(names):
            ax.semilogy(stamp, result["error_deg"][:, r, 0], lw=0.7, color=COLOURS[r % len(COLOURS)], label=start)
        ax.set_ylabel(f"{name}: error, deg")
        ax.grid(alpha=0.25, lw=0.5)
        for axis in range(3):
            mean, deviation = result["mean"][:, -1, 4 + axis], result["deviation"][:, -1, 3 + axis]
            pane.fill_between(stamp, mean - 3 * deviation, mean + 3 * deviation, color=COLOURS[axis], alpha=0.2, lw=0)
            pane.plot(stamp, mean, lw=0.8, color=COLOURS[axis], label="xyz"[axis])
        pane.set_ylabel(f"{name}: bias, rad/s")
        pane.set_ylim(-0.015, 0.015)
    axes[0, 0].legend(fontsize=6, ncols=4)
    panes[0, 0].legend(fontsize=7)
    for ax in (axes[-1, 0], panes[-1, 0]):
        ax.set_xlabel("time, s")
    save_figure(errors, folder / "errors.png")
    save_figure(biases, folder / "bias.png")
    return [folder / "errors.png", folder / "bias.png"]
