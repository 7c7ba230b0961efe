"""Inertial sensors: grades, simulated output, errors at the start of navigation, and a check of logged samples.

A sensor adds a constant bias and white noise to what it senses: measured = true + bias + noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torchfilt.noise import NoiseSource

_STANDARD_GRAVITY_M_S2 = 9.80665
_ARC_MINUTE = math.radians(1 / 60)


@dataclass(frozen=True)
class ImuGrade:
    """Quality of three gyros and three accelerometers; all axes alike.

    gyro_bias_sd_rad_s, accel_bias_sd_m_s2: standard deviations of biases that stay constant from switch-on.
    angle_random_walk_rad_sqrt_s, velocity_random_walk_m_s_sqrt_s: standard deviation of the integral of the white noise
    after one second, the root of its spectral density: rad/sqrt(s) is (rad/s)/sqrt(Hz), (m/s)/sqrt(s) is
    (m/s^2)/sqrt(Hz).

    Raises:
        ValueError: a number that is negative or not finite.

    Source: IEEE Std 952 for the coefficients and their units.
    """

    gyro_bias_sd_rad_s: float
    angle_random_walk_rad_sqrt_s: float
    accel_bias_sd_m_s2: float
    velocity_random_walk_m_s_sqrt_s: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {value}")

    @staticmethod
    def from_datasheet(
        gyro_bias_sd_deg_h: float,
        angle_random_walk_deg_sqrt_h: float,
        accel_bias_sd_mg: float,
        velocity_random_walk_ug_sqrt_hz: float,
    ) -> "ImuGrade":
        """A grade in the units of data sheets: deg/h, deg/sqrt(h), milli-g, micro-g/sqrt(Hz)."""
        return ImuGrade(
            math.radians(gyro_bias_sd_deg_h) / 3600,
            math.radians(angle_random_walk_deg_sqrt_h) / 60,
            accel_bias_sd_mg * 1e-3 * _STANDARD_GRAVITY_M_S2,
            velocity_random_walk_ug_sqrt_hz * 1e-6 * _STANDARD_GRAVITY_M_S2,
        )


# Round numbers of the order that Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems
# (2013), chapter 4, gives for grades of sensors; names of grades differ between authors. The sensors behind them:
# Titterton and Weston, Strapdown Inertial Navigation Technology (2004), chapters 4 to 7.
TACTICAL = ImuGrade.from_datasheet(0.1, 0.01, 0.1, 10)
"""Fibre-optic gyros and pendulous accelerometers: 0.1 deg/h, 0.01 deg/sqrt(h), 100 ug, 10 ug/sqrt(Hz)."""
MEMS = ImuGrade.from_datasheet(10, 0.3, 1, 100)
"""Good micromachined sensors: 10 deg/h, 0.3 deg/sqrt(h), 1 mg, 100 ug/sqrt(Hz)."""


@dataclass(frozen=True)
class StartErrors:
    """Standard deviations of the errors that navigation starts with.

    ``position_sd_m`` east, north, up; ``velocity_sd_m_s`` of each axis; ``attitude_sd_rad`` about east, north and up,
    so that the last one is the heading's.

    Raises:
        ValueError: a number that is negative or not finite.
    """

    position_sd_m: tuple[float, float, float] = (10.0, 10.0, 15.0)
    velocity_sd_m_s: float = 0.8
    attitude_sd_rad: tuple[float, float, float] = (1.2 * _ARC_MINUTE, 1.2 * _ARC_MINUTE, 1.5 * _ARC_MINUTE)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not all(0 <= v < math.inf for v in (value if isinstance(value, tuple) else (value,))):
                raise ValueError(f"{name} must be finite and not negative, got {value}")


TACTICAL_START = StartErrors()
MEMS_START = StartErrors(attitude_sd_rad=(30 * _ARC_MINUTE, 30 * _ARC_MINUTE, 120 * _ARC_MINUTE))


class Increments(NamedTuple):
    """What an IMU puts out: integrals (t, ..., 3) of angular rate (rad) and specific force (m/s) over its intervals."""

    dtheta_rad: Tensor
    dvelocity_m_s: Tensor


def seeded_normals(seeds: Sequence[int], shape: tuple[int, ...], stream: int = 0) -> Tensor:
    """Standard normals (*shape[:-1], seeds, shape[-1]), float64; each seed's own, whoever its neighbours are."""
    like = torch.empty(0, dtype=torch.float64)
    return torch.stack([NoiseSource(seed).normal(shape, 0, stream, like) for seed in seeds], -2)


def measure(
    dtheta_rad: Tensor,
    dvelocity_m_s: Tensor,
    interval_s: float,
    grade: ImuGrade,
    gyro_bias_rad_s: Tensor,
    accel_bias_m_s2: Tensor,
    noise: Tensor,
) -> Increments:
    """What sensors of a grade report.

    Args:
        dtheta_rad, dvelocity_m_s: true increments (t, 3) in body axes.
        interval_s: over which they were integrated.
        grade: gives the white noise.
        gyro_bias_rad_s, accel_bias_m_s2: (*batch, 3).
        noise: standard normals (t, *batch, 6), gyros first, such as those of `seeded_normals`.

    Raises:
        ValueError: an interval that is not positive.
    """
    if not interval_s > 0:
        raise ValueError(f"interval_s must be positive, got {interval_s}")
    batch = noise.dim() - 2
    root = math.sqrt(interval_s)

    def sensed(true: Tensor, bias: Tensor, density: float, white: Tensor) -> Tensor:
        true = true.reshape(len(true), *[1] * batch, 3)
        return true + bias * interval_s + density * root * white

    turn, push = noise.split(3, -1)
    return Increments(
        sensed(dtheta_rad, gyro_bias_rad_s, grade.angle_random_walk_rad_sqrt_s, turn),
        sensed(dvelocity_m_s, accel_bias_m_s2, grade.velocity_random_walk_m_s_sqrt_s, push),
    )


# Logged samples -------------------------------------------------------------------------------------------------------

# Above the range of any gyro for vehicles, 2000 deg/s, and of their accelerometers, 20 g.
MAX_RATE_RAD_S = 35.0
MAX_FORCE_M_S2 = 200.0

Array = npt.NDArray[np.float64]


def check_imu(
    times_s: Tensor | npt.NDArray[np.floating],
    gyro_rad_s: Tensor | npt.NDArray[np.floating],
    accel_m_s2: Tensor | npt.NDArray[np.floating],
    max_gap_s: float = 0.1,
) -> None:
    """Refuse samples that no IMU can have taken, or that are in other units.

    Args:
        times_s: (t,).
        gyro_rad_s: angular rate (t, 3).
        accel_m_s2: specific force (t, 3).
        max_gap_s: longest time between two samples.

    Raises:
        ValueError: shapes that do not fit; NaN or infinity; times that stand still, run backwards or leave a gap; an
            angular rate above 35 rad/s; a specific force above 200 m/s^2 or of 1 g where m/s^2 are meant. The message
            names the rule, the sample, its time and its value.
    """
    times, gyro, accel = (_plain(values) for values in (times_s, gyro_rad_s, accel_m_s2))
    if times.ndim != 1 or len(times) == 0 or not gyro.shape == accel.shape == (len(times), 3):
        raise ValueError(
            "times_s must be (t,) with gyro_rad_s and accel_m_s2 (t, 3) and at least one sample, "
            f"got {times.shape}, {gyro.shape}, {accel.shape}"
        )
    for name, values in (("times_s", times), ("gyro_rad_s", gyro), ("accel_m_s2", accel)):
        finite = np.isfinite(values.reshape(len(times), -1)).all(1)
        _refuse(f"{name} must be finite", np.logical_not(finite), times, values)
    _check_order(times, max_gap_s)
    rate = np.linalg.norm(gyro, axis=1)
    hint = f"; as degrees per second the largest would be {math.radians(rate.max()):.3g} rad/s: which unit is it?"
    _refuse(f"angular rate must be at most {MAX_RATE_RAD_S:g} rad/s", rate > MAX_RATE_RAD_S, times, rate, hint)
    force = np.linalg.norm(accel, axis=1)
    _refuse(f"specific force must be at most {MAX_FORCE_M_S2:g} m/s^2", force > MAX_FORCE_M_S2, times, force)
    middle = float(np.median(force))
    if 0.8 < middle < 1.25:
        raise ValueError(
            f"specific force must be in m/s^2: its median over {len(times)} samples is {middle:.4g}, "
            f"as if in g; multiply by {_STANDARD_GRAVITY_M_S2}"
        )


def _plain(values: Tensor | npt.NDArray[np.floating]) -> Array:
    return np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)


def _check_order(times: Array, max_gap_s: float) -> None:
    """Time stamps increase and leave no gap; each fault is told at the later of its two samples."""
    step = np.concatenate([[max_gap_s / 2], np.diff(times)])
    before = np.concatenate([times[:1], times[:-1]])
    for rule, bad in (
        ("times_s must increase, this one is repeated", step == 0),
        ("times_s must increase, this one goes backward", step < 0),
        (f"times_s must leave no gap above {max_gap_s:g} s", step > max_gap_s),
    ):
        if bad.any():
            k = int(bad.argmax())
            raise ValueError(f"{rule}: sample {k} at {times[k]:.9g} s follows sample {k - 1} at {before[k]:.9g} s")


def _refuse(rule: str, bad: npt.NDArray[np.bool_], times: Array, values: Array, hint: str = "") -> None:
    """Raise a ValueError that names the first bad sample."""
    if bad.any():
        k = int(bad.argmax())
        raise ValueError(f"{rule}: sample {k} at {times[k]:.9g} s is {np.array2string(values[k], precision=6)}{hint}")
