"""Vertical channel of a descent by parachute: what inertial sensors without a known attitude add to a barometer.

Two models share height, vertical velocity and a vertical acceleration that is a first-order Gauss-Markov process:

* ``baro``: the barometer alone corrects them.
* ``imu``: attitude, gyro bias and the two horizontal accelerations stand beside them. The gyro turns the body. The
  accelerometer measures R(q)^T (g + acceleration) in body axes, so it is used once. Nothing else tells where down is:
  the horizontal accelerations have mean zero, so specific force points up on average, and only on average. The heading
  is unknown for good and does not matter here.

The barometer is withheld for some seconds again and again; the height then predicted is compared with the barometer's.
There is no truth in this log and no reference for the attitude.
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
from torch.nn.functional import pad

import torchfilt as tf
from torchfilt.io.rocket_descent import RocketDescent, read_rocket_descent
from torchfilt.laws import hold
from torchfilt.linalg import matrix_exp
from torchfilt.missions.attitude.motion import to_ends
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import digest, run_study
from torchfilt.models.attitude import (
    inverse,
    rotate,
    skew,
    to_matrix,
    to_rotation_vector,
)
from torchfilt.models.attitude.kinematics import GyroTransition
from torchfilt.models.sensors import atmosphere
from torchfilt.spaces import EUCLIDEAN, Euclidean, Product, UnitQuaternion

__all__ = [
    "DESCENT_SPACE",
    "FILTERS",
    "Barometer",
    "Descent",
    "DescentMotion",
    "DescentSettings",
    "SpecificForce",
    "follow",
    "gauss_markov",
    "make_descent",
    "make_filter",
    "pressure_height",
    "run_descent",
    "standard_pressure",
    "summarize",
]

FILTERS = ("baro-ekf", "baro-ukf", "imu-mekf", "imu-ukf", "imu-llpf")
# Height, velocity and acceleration up, accelerations east and north; attitude; gyro bias.
DESCENT_SPACE = Product(Euclidean(5), UnitQuaternion("left"), Euclidean(3))
# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 2
_GRAVITY_M_S2 = 9.80665
# A second of the barometer about the end of a gap is what the prediction is compared with.
_COMPARED_S = 1.0

Step = Tensor | float | None


@dataclass(frozen=True)
class DescentSettings:
    """How the log is filtered.

    Args:
        data: folder of the log.
        start_s, stop_s: part of the flight; settle_s: after the start, before anything is scored or withheld.
        group: rows of a step. barometer_every: steps from one pressure to the next; the noise of neighbours is alike.
        pressure_sd_pa: of a step's mean pressure; larger than its scatter, since its noise is not white.
        vertical_sd_m_s2, vertical_time_s: of the vertical acceleration, a Gauss-Markov process.
        horizontal_sd_m_s2, horizontal_time_s: of each horizontal one; ``imu`` only, as all that follow but the last.
        force_sd_m_s2: of a step's mean specific force; a lever arm to the body's centre included.
        angle_random_walk_rad_sqrt_s: of the gyro, its scale error while it spins included.
        gyro_bias_walk_rad_s_sqrt_s: what drives the bias. prior_bias_sd_rad_s: of the initial bias.
        prior_tilt_sd_deg: of the initial attitude, an axis; the mean levels the first specific force.
        iterations: linearisations of a measurement in the error-state filter and in each member of the bank.
        particles, seed: of the bank.
        gaps_s: how long the barometer is withheld. phases: how often each, shifted.

    Raises:
        ValueError: a number that is not positive and finite, no gap, a part that has no room for a gap.
    """

    data: str = "data/rocket_descent"
    start_s: float = 45.0
    stop_s: float = 240.0
    settle_s: float = 15.0
    group: int = 10
    barometer_every: int = 5
    pressure_sd_pa: float = 30.0
    vertical_sd_m_s2: float = 0.4
    vertical_time_s: float = 0.7
    horizontal_sd_m_s2: float = 5.0
    horizontal_time_s: float = 0.5
    force_sd_m_s2: float = 0.7
    angle_random_walk_rad_sqrt_s: float = 0.08
    gyro_bias_walk_rad_s_sqrt_s: float = 1e-4
    prior_bias_sd_rad_s: float = 0.01
    prior_tilt_sd_deg: float = 60.0
    iterations: int = 3
    particles: int = 24
    seed: int = 0
    gaps_s: tuple[float, ...] = (5.0, 10.0, 30.0)
    phases: int = 4

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name in ("data", "gaps_s", "seed"):
                continue
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if not self.gaps_s or not all(0 < gap < math.inf for gap in self.gaps_s):
            raise ValueError(f"gaps_s must be positive and finite, got {self.gaps_s}")
        room = self.stop_s - self.start_s - self.settle_s
        if room < max(self.gaps_s) + 1:
            raise ValueError(f"a gap of {max(self.gaps_s)} s has no room in {room:g} s, settle_s taken off")


class Descent(NamedTuple):
    """What filters are given and compared with, k steps and R rows: all pressures, then each gap and phase.

    time_s (k,): ends of steps. control (k, 3): mean rate in rad/s. force (k, 3): mean specific force in m/s^2, axes of
    the step's end. pressure_pa (k, R): mean of the step, NaN where silent or withheld. withheld (k, R). ends: (row,
    step, gap in s) of each gap's last step. step_s. ground_pa: pressure on the rail. smooth_m (k,): pressure height, a
    straight line through the second about the step's end. onboard (k, 2): the other filter's height and velocity.
    """

    time_s: Tensor
    control: Tensor
    force: Tensor
    pressure_pa: Tensor
    withheld: Tensor
    ends: list[tuple[int, int, float]]
    step_s: float
    ground_pa: float
    smooth_m: Tensor
    onboard: Tensor


def standard_pressure(height_m: Tensor, ground_pa: Tensor | float) -> Tensor:
    """Pressure in Pa at a height (...) in m above where it is ground_pa, the standard atmosphere scaled to it."""
    return ground_pa / atmosphere.SEA_LEVEL_PRESSURE_PA * atmosphere.pressure_pa(height_m, check=False)


def pressure_height(pressure_pa: Tensor, ground_pa: Tensor | float) -> Tensor:
    """Height (...) in m: the inverse of `standard_pressure`."""
    return atmosphere.height_m(pressure_pa / ground_pa * atmosphere.SEA_LEVEL_PRESSURE_PA, check=False)


# Laws -----------------------------------------------------------------------------------------------------------------


def gauss_markov(dt: float, time_s: float, sd: float, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Transition and noise factor (3, 3) of position, velocity and a first-order Gauss-Markov acceleration.

    Args:
        dt, time_s: step, and time in which the acceleration decays to 1/e, s. sd: its standard deviation, m/s^2.

    Source: Singer, Estimating optimal tracking filter performance for manned maneuvering targets, IEEE TAES 6 (1970);
        the integral of the noise by Van Loan, IEEE TAC 23 (1978).
    """
    flow = torch.zeros(6, 6, dtype=torch.float64)
    drift = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / time_s]], dtype=torch.float64)
    flow[:3, :3], flow[3:, 3:], flow[2, 5] = -drift, drift.mT, 2 * sd**2 / time_s
    whole = matrix_exp(flow * dt)
    transition = whole[3:, 3:].mT.contiguous()
    noise = transition @ whole[:3, 3:]
    return transition.to(dtype), torch.linalg.cholesky((noise + noise.mT) / 2).to(dtype)


class Barometer(nn.Module):
    """Pressure where a body was lag_s ago; a state starts with height and velocity, up.

    Args:
        ground_pa: pressure at height 0. sd_pa: of the noise. lag_s: half of what a mean pressure is taken over.
        tangent_size: components of the state's error.
    """

    size = 1

    def __init__(self, ground_pa: float, sd_pa: float, lag_s: float, tangent_size: int) -> None:
        super().__init__()
        self.ground_pa, self.sd_pa, self.lag_s, self.tangent_size = ground_pa, sd_pa, lag_s, tangent_size

    def forward(self, x: Tensor) -> tf.Gaussian:
        """Law of the pressure (..., 1) at states (..., d)."""
        mean = standard_pressure(self._then(x), self.ground_pa)
        return tf.Gaussian(mean, x.new_full((1,), self.sd_pa), EUCLIDEAN, is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[tf.Gaussian, Tensor]:
        """The law at x and its derivative (..., 1, e) by the error of x."""
        law = self(x)
        temperature = atmosphere.temperature_k(self._then(x), check=False)
        slope = -atmosphere.GRAVITY_M_S2 * law.mean / (atmosphere.GAS_CONSTANT_J_KG_K * temperature)
        row = pad(torch.cat([slope, -self.lag_s * slope], -1), (0, self.tangent_size - 2))
        return law, row.unsqueeze(-2)

    def _then(self, x: Tensor) -> Tensor:
        """Height (..., 1) lag_s ago."""
        return x[..., :1] - self.lag_s * x[..., 1:2]


class SpecificForce(nn.Module):
    """Accelerometer of a body that accelerates: R(q)^T (acceleration + g up) + noise, states on `DESCENT_SPACE`.

    Args:
        sd_m_s2: of the noise, an axis.
    """

    size = 3

    def __init__(self, sd_m_s2: float) -> None:
        super().__init__()
        self.sd_m_s2 = sd_m_s2

    def forward(self, x: Tensor) -> tf.Gaussian:
        """Law of the specific force (..., 3), body axes, at states (..., 12)."""
        return self._law(rotate(inverse(x[..., 5:9]), self._world(x)))

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[tf.Gaussian, Tensor]:
        """The law at x and its derivative (..., 3, 11) by the error of x."""
        world = self._world(x)
        to_body = to_matrix(x[..., 5:9]).mT
        by_acceleration = to_body[..., [2, 0, 1]]
        columns = torch.cat([pad(by_acceleration, (2, 0)), to_body @ skew(world)], -1)
        return self._law((to_body @ world.unsqueeze(-1)).squeeze(-1)), pad(columns, (0, 3))

    def _law(self, mean: Tensor) -> tf.Gaussian:
        return tf.Gaussian(mean, mean.new_full((3,), self.sd_m_s2), EUCLIDEAN, is_diagonal=True)

    @staticmethod
    def _world(x: Tensor) -> Tensor:
        return torch.stack([x[..., 3], x[..., 4], x[..., 2] + _GRAVITY_M_S2], -1)


class DescentMotion(nn.Module):
    """Motion of states (..., 12) on `DESCENT_SPACE` over steps of one length; u (..., 3) is the measured rate, rad/s.

    Args:
        settings: see `DescentSettings`. step_s: length of a step.
    """

    matrix: Tensor
    factor: Tensor

    def __init__(self, settings: DescentSettings, step_s: float) -> None:
        super().__init__()
        self.step_s, self.space = step_s, DESCENT_SPACE
        vertical, noise = gauss_markov(step_s, settings.vertical_time_s, settings.vertical_sd_m_s2)
        decay = math.exp(-step_s / settings.horizontal_time_s)
        driven = settings.horizontal_sd_m_s2 * math.sqrt(1 - decay**2)
        walks = settings.angle_random_walk_rad_sqrt_s, settings.gyro_bias_walk_rad_s_sqrt_s
        self.gyro = GyroTransition(*walks)
        level = torch.eye(2, dtype=noise.dtype)
        turning = torch.tensor(walks, dtype=noise.dtype).repeat_interleave(3) * math.sqrt(step_s)
        hold(self, "matrix", torch.block_diag(vertical, level * decay))
        hold(self, "factor", torch.block_diag(noise, level * driven, turning.diag()))

    def forward(self, x: Tensor, u: Tensor | None = None) -> tf.Gaussian:
        """Law of the state a step later."""
        turned = self.gyro(x[..., 5:], u, self.step_s).mean
        return self._law(x, turned)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[tf.Gaussian, Tensor]:
        """The law at x and the derivative (..., 11, 11) of its mean's error by the error of x."""
        turned, jacobian = self.gyro.first_order(x[..., 5:], u, self.step_s)
        moved = self.matrix.to(x.dtype).expand(*jacobian.shape[:-2], 5, 5)
        rows = torch.cat([pad(moved, (0, 6)), pad(jacobian, (5, 0))], -2)
        return self._law(x, turned.mean), rows

    def _law(self, x: Tensor, turned: Tensor) -> tf.Gaussian:
        mean = torch.cat([x[..., :5] @ self.matrix.to(x.dtype).mT, turned], -1)
        return tf.Gaussian(mean, self.factor.to(x.dtype), self.space)


# Data -----------------------------------------------------------------------------------------------------------------


def make_descent(log: RocketDescent, settings: DescentSettings) -> Descent:
    """Steps of the descent, with the barometer withheld in all rows but the first.

    Raises:
        ValueError: a part of the flight outside the log.
    """
    row_s = ((log.times_s[-1] - log.times_s[0]) / (len(log.times_s) - 1)).item()
    margin = _COMPARED_S / 2
    if settings.start_s < log.times_s[0] + margin or settings.stop_s > log.times_s[-1] - margin:
        raise ValueError(
            f"start_s and stop_s must be {margin} s inside the log, {log.times_s[0].item():g} to "
            f"{log.times_s[-1].item():g} s, got {settings.start_s} and {settings.stop_s}"
        )
    first = int((log.times_s < settings.start_s).sum())
    steps = int((settings.stop_s - settings.start_s) / row_s + 1e-6) // settings.group
    rows = slice(first + 1, first + 1 + steps * settings.group)
    gyro, accel, pressure = (
        values[rows].unflatten(0, (steps, settings.group))
        for values in (log.gyro_rad_s, log.accel_m_s2, log.pressure_pa)
    )
    step_s = settings.group * row_s
    turn, force = to_ends(gyro * row_s, accel)
    ground = log.pressure_pa[log.times_s < 0].median().item()
    last = first + settings.group * torch.arange(1, steps + 1)
    stamp = log.times_s[last]
    withheld, ends = _gaps(steps, step_s, settings)
    heard = torch.arange(1, steps + 1) % settings.barometer_every == 0
    measured = torch.where(heard[:, None] & ~withheld, pressure.mean(-1)[:, None], torch.nan)
    smooth = _smooth(pressure_height(log.pressure_pa, ground), last, round(margin / row_s))
    other = [
        torch.from_numpy(np.interp(stamp.numpy(), log.onboard.times_s.numpy(), values.numpy()))
        for values in (log.onboard.height_m, log.onboard.velocity_m_s)
    ]
    rate = to_rotation_vector(turn) / step_s
    return Descent(stamp, rate, force, measured, withheld, ends, step_s, ground, smooth, torch.stack(other, -1))


def _smooth(height: Tensor, at: Tensor, half: int) -> Tensor:
    """Mean over the rows within half about each row: a straight line's value there."""
    return height.unfold(0, 2 * half + 1, 1).mean(-1)[at - half]


def _gaps(steps: int, step_s: float, settings: DescentSettings) -> tuple[Tensor, list[tuple[int, int, float]]]:
    """Where the barometer is withheld (k, R), and row, last step and length of each gap.

    A gap is followed by as long with the barometer, and by 10 s at least.
    """
    withheld = torch.zeros(steps, 1 + len(settings.gaps_s) * settings.phases, dtype=torch.bool)
    ends, settle = [], round(settings.settle_s / step_s)
    for g, gap_s in enumerate(settings.gaps_s):
        length = max(1, round(gap_s / step_s))
        period = length + max(length, round(10.0 / step_s))
        for phase in range(settings.phases):
            row = 1 + g * settings.phases + phase
            for begin in range(settle + phase * period // settings.phases, steps - length + 1, period):
                withheld[begin : begin + length, row] = True
                ends.append((row, begin + length - 1, gap_s))
    return withheld, ends


# Filters --------------------------------------------------------------------------------------------------------------


def make_filter(name: str, descent: Descent, settings: DescentSettings) -> Any:
    """A filter that starts from the barometer's first second and, with inertial sensors, a levelled specific force.

    Raises:
        ValueError: unknown name.
    """
    check_names([name], FILTERS, "filters")
    slope = (descent.smooth_m[-1] - descent.smooth_m[0]) / (descent.time_s[-1] - descent.time_s[0])
    zero = descent.smooth_m.new_zeros(3)
    channel = torch.stack([descent.smooth_m[0], slope, slope * 0])
    deviation = [5.0, 10.0, settings.vertical_sd_m_s2]
    lag_s = descent.step_s / 2
    space: Any = EUCLIDEAN
    if name.startswith("baro"):
        matrix, factor = gauss_markov(descent.step_s, settings.vertical_time_s, settings.vertical_sd_m_s2)
        transition: Any = tf.LinearGaussian(matrix, scale_tril=factor)
        mean = channel
        sensors = tf.Sensors(barometer=Barometer(descent.ground_pa, settings.pressure_sd_pa, lag_s, 3))
    else:
        transition, space = DescentMotion(settings, descent.step_s), DESCENT_SPACE
        mean = torch.cat([channel, zero[:2], _levelled(descent.force[0]), zero])
        # The heading is a choice of axes, hence known.
        tilt = math.radians(settings.prior_tilt_sd_deg)
        deviation += [settings.horizontal_sd_m_s2] * 2 + [tilt, tilt, math.radians(1.0)]
        deviation += [settings.prior_bias_sd_rad_s] * 3
        barometer = Barometer(descent.ground_pa, settings.pressure_sd_pa, lag_s, 11)
        sensors = tf.Sensors(barometer=barometer, force=SpecificForce(settings.force_sd_m_s2))
    prior = tf.Gaussian(mean, torch.tensor(deviation, dtype=mean.dtype), space, is_diagonal=True)
    model = tf.StateSpaceModel(prior, transition, sensors)
    if name == "baro-ekf":
        return tf.ExtendedKalmanFilter(model)
    if name == "imu-mekf":
        return tf.ErrorStateKalmanFilter(model, iterations=settings.iterations)
    if name == "imu-llpf":
        rule = tf.moments.taylor()
        return tf.LocallyLinearizedParticleFilter(model, settings.particles, rule, iterations=settings.iterations)
    return tf.UnscentedKalmanFilter(model)


def _levelled(force: Tensor) -> Tensor:
    """The shortest turn that takes a specific force (3,) to up."""
    up = force / force.norm()
    turn = torch.stack([up[1], -up[0], up[0] * 0, 1 + up[2]])
    return turn / turn.norm()


@torch.no_grad()
def follow(name: str, descent: Descent, settings: DescentSettings, progress: bool = False) -> Arrays:
    """Run a filter on all rows as one batch.

    Returns:
        mean (k, R, 3): height, velocity and acceleration up; deviation (k, R, 3). Of the first row, NaN for the bank
        and where nothing is measured: nis (k,), by measured number, and barometer_nis (k,). log_likelihood: of the
        first row, all steps. cpu_s.

    Raises:
        ValueError: unknown name. torchfilt.types.FilterError: the filter failed.
    """
    from tqdm import tqdm

    tracker, inertial = make_filter(name, descent, settings), name.startswith("imu")
    steps, rows = descent.pressure_pa.shape
    state, begin = tracker.init((rows,), settings.seed), time.process_time()
    kept, likelihood = [], 0.0
    for k in tqdm(range(steps), unit="step", disable=None if progress else True):
        y, u = descent.pressure_pa[k, :, None], None
        if inertial:
            y, u = torch.cat([y, descent.force[k].expand(rows, 3)], -1), descent.control[k]
        state, info = tracker.step(state, y, u)
        mean, covariance = (
            state.belief.moments() if name == "imu-llpf" else (state.belief.mean, state.belief.covariance)
        )
        deviation = covariance.diagonal(dim1=-2, dim2=-1)[..., :3].sqrt().expand(rows, 3)
        kept.append((mean[:, :3], deviation, _nis(info, y[0])))
        likelihood += info.log_likelihood[0].item()
    mean, deviation, nis = (torch.stack(values).numpy() for values in zip(*kept, strict=True))
    return {
        "mean": mean,
        "deviation": deviation,
        "nis": nis[:, 0],
        "barometer_nis": nis[:, 1],
        "log_likelihood": np.array(likelihood),
        "cpu_s": np.array(time.process_time() - begin),
    }


def _nis(info: Any, y: Tensor) -> Tensor:
    """Of the first row's measurement by its numbers, and of its barometer, the first of them; NaN where there is none.

    The factor is triangular: its corner is the deviation of the first innovation by itself.
    """
    heard = torch.isfinite(y)
    found = y.new_full((2,), torch.nan)
    if info.nis is None or not heard.any():
        return found
    found[0] = info.nis[0] / heard.sum()
    if heard[0]:
        factor = info.innovation_scale_tril.expand(*info.innovation.shape, -1)
        found[1] = (info.innovation[0, 0] / factor[0, 0, 0]).square()
    return found


# Study ----------------------------------------------------------------------------------------------------------------


def summarize(result: Arrays, descent: Descent, settings: DescentSettings) -> dict[str, Any]:
    """Numbers of one filter, JSON-ready, after `DescentSettings.settle_s`.

    Returns:
        descent_m_s: median downward velocity. nis, barometer_nis: means, None for the bank. onboard_height_m,
        onboard_velocity_m_s: median differences to the on-board filter (ours less theirs). gaps: by length in s as a
        word: count, median_m, rms_m and worst_m of the absolute difference to the barometer, and ratio, the root mean
        square of that difference by the claimed deviation (1 if it is honest). log_likelihood, cpu_s.
    """
    late = slice(round(settings.settle_s / descent.step_s), None)
    mean = result["mean"]
    height, velocity = np.median(mean[late, 0, :2] - descent.onboard[late].numpy(), 0).tolist()
    found: dict[str, Any] = {"descent_m_s": float(-np.median(mean[late, 0, 1]))}
    for name in ("nis", "barometer_nis"):
        measured = result[name][late][np.isfinite(result[name][late])]
        found[name] = float(measured.mean()) if len(measured) else None
    found |= {"onboard_height_m": height, "onboard_velocity_m_s": velocity, "gaps": {}}
    for gap_s in settings.gaps_s:
        row, step = np.array([(row, step) for row, step, length in descent.ends if length == gap_s]).T
        error = mean[step, row, 0] - descent.smooth_m.numpy()[step]
        found["gaps"][f"{gap_s:g}"] = {
            "count": len(row),
            "median_m": float(np.median(np.abs(error))),
            "rms_m": float(np.sqrt((error**2).mean())),
            "worst_m": float(np.abs(error).max()),
            "ratio": float(np.sqrt(((error / result["deviation"][step, row, 0]) ** 2).mean())),
        }
    return found | {"log_likelihood": float(result["log_likelihood"]), "cpu_s": float(result["cpu_s"])}


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a text table: a row a filter, then a row a filter and gap."""
    lines = ["filter      down m/s    NIS  barometer's   to on board: m    m/s"]
    for name, row in summary["filters"].items():
        nis = "".join(f"{'-' if row[key] is None else format(row[key], '.2f'):>9s}" for key in ("nis", "barometer_nis"))
        lines.append(
            f"{name:11s} {row['descent_m_s']:8.2f} {nis}      "
            f"{row['onboard_height_m']:12.2f}{row['onboard_velocity_m_s']:9.2f}"
        )
    lines += ["", "without barometer for   count  median    rms   worst (m)   rms by claimed sigma"]
    for name, row in summary["filters"].items():
        for gap, part in row["gaps"].items():
            lines.append(
                f"{name:11s} {gap:>6s} s {part['count']:8d} {part['median_m']:8.1f}{part['rms_m']:8.1f}"
                f"{part['worst_m']:8.1f} {part['ratio']:14.2f}"
            )
    return lines


def run_descent(
    settings: DescentSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `DescentSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default all.
        say: told what happens, a line each. progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), settings, versions.

    Raises:
        ValueError: unknown filter. torchfilt.io.files.LogError: a damaged or foreign log.
    """
    names = FILTERS if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    descent = make_descent(read_rocket_descent(settings.data), settings)
    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **asdict(settings), "descent": digest(descent)},
        follow=lambda name: follow(name, descent, settings, progress),
        summarize=lambda name, result: summarize(result, descent, settings),
        table=table,
        draw=(lambda results, folder: _figures(results, descent, folder)) if figures else None,
        say=say,
    )


def _figures(results: dict[str, Arrays], descent: Descent, folder: Path) -> list[Path]:
    """Height and velocity of the first row with 3 sigma, and the differences after gaps."""
    from torchfilt.learning.figures import save_figure
    from torchfilt.missions.figures import COLOURS, TRUTH, new_figure

    folder.mkdir(parents=True, exist_ok=True)
    stamp, written = descent.time_s.numpy(), []
    smooth, onboard = descent.smooth_m.numpy(), descent.onboard.numpy()
    for column, name, label in ((0, "height", "height less barometer, m"), (1, "velocity", "velocity, m/s")):
        figure, axes = new_figure(
            len(results), 1, (9, 2.2 * len(results)), f"{name.capitalize()}, ±3 sigma", sharex=True
        )
        base = smooth if column == 0 else 0.0
        for ax, colour, (title, result) in zip(axes[:, 0], COLOURS, results.items(), strict=False):
            mean, wide = result["mean"][:, 0, column] - base, 3 * result["deviation"][:, 0, column]
            ax.fill_between(stamp, mean - wide, mean + wide, color=colour, alpha=0.2, lw=0)
            ax.plot(stamp, onboard[:, column] - base, color=TRUTH, lw=1, label="on board")
            ax.plot(stamp, mean, color=colour, lw=0.8, label=title)
            ax.set_ylabel(label, fontsize=8)
            ax.legend(fontsize=7)
            ax.set_ylim(*((-20, 20) if column == 0 else (-50, 0)))
            ax.grid(alpha=0.25, lw=0.5)
        axes[-1, 0].set_xlabel("time since lift-off, s")
        written.append(folder / f"{name}.png")
        save_figure(figure, written[-1])
    figure, axes = new_figure(1, 1, (7, 4.5), "Height after a gap, less the barometer")
    for k, (title, result) in enumerate(results.items()):
        place = [length * (1 + 0.04 * (k - len(results) / 2)) for _, _, length in descent.ends]
        error = [result["mean"][step, row, 0] - smooth[step] for row, step, _ in descent.ends]
        axes[0, 0].plot(place, error, ".", ms=4, alpha=0.6, color=COLOURS[k % len(COLOURS)], label=title)
    lengths = sorted({length for _, _, length in descent.ends})
    axes[0, 0].set_xscale("log")
    axes[0, 0].set_xticks(lengths, [f"{length:g}" for length in lengths])
    axes[0, 0].set_xticks([], minor=True)
    axes[0, 0].set_xlabel("without barometer, s")
    axes[0, 0].set_ylabel("m")
    axes[0, 0].grid(alpha=0.25, lw=0.5)
    axes[0, 0].legend(fontsize=7)
    written.append(folder / "gaps.png")
    save_figure(figure, written[-1])
    return written
