"""Two real logs as a filter sees them: what is known of each, its steps, its laws, the fixes to withhold.

All numbers of `TUNING` were found on the first part of a log, before ``tuned_to_s``; fixes are withheld after it only.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.filters.gaussian import CubatureKalmanFilter, ErrorStateKalmanFilter
from torchfilt.filters.particle_methods import RegularizedParticleFilter
from torchfilt.gaussian import Gaussian
from torchfilt.io.car_loop import SCORE_FROM_S, read_car_loop
from torchfilt.io.inertial import InertialLog, Reference, group_increments
from torchfilt.io.uav_thor import AIRBORNE_S, read_uav_thor
from torchfilt.model import StateSpaceModel
from torchfilt.models.attitude import from_euler, inverse, rotate
from torchfilt.models.inertial.alignment import align_at_rest, course
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.navigation import NAVIGATION_SPACE, NavigationFixes, StrapdownTransition
from torchfilt.models.inertial.strapdown import compensate, join
from torchfilt.run import Filter

Log = Literal["uav", "car"]
LOGS: dict[Log, str] = {
    "uav": "a small aircraft's flight, sensors at 50 Hz, GPS at 1 Hz, barometer",
    "car": "a car on an urban loop, sensors at 100 Hz, a receiver's smoothed fixes at 2 Hz",
}


@dataclass(frozen=True)
class LogSettings:
    """What is driven and which fixes are withheld.

    Attributes:
        log: one of `LOGS`.
        data_folder: holds the log's files; None: the one of the repository, as seen from its root.
        gaps_s: lengths without fixes, increasing.
        gap_every_s: time between starts of gaps; None: 4 s in the air, 5 s on the road.
        step_s: longest step of the filter; steps end at the fixes. Samples within a step are joined.
        stop_s: end of what is used, on the log's clock; None: all of it.
        particles: of the particle filter. seed: of its numbers.

    Raises:
        ValueError: unknown log, numbers out of range; the option is named.
    """

    log: Log = "car"
    data_folder: str | None = None
    gaps_s: tuple[float, ...] = (10.0, 30.0, 60.0)
    gap_every_s: float | None = None
    step_s: float = 0.1
    stop_s: float | None = None
    particles: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.log not in LOGS:
            raise ValueError(f"log must be one of {', '.join(LOGS)}, got {self.log!r}")
        gaps = tuple(self.gaps_s)
        if not gaps or not all(0 < a < b for a, b in zip(gaps, (*gaps[1:], math.inf), strict=True)):
            raise ValueError(f"gaps_s must be positive, finite and increasing, got {gaps}")
        for name in ("gap_every_s", "step_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if self.particles < 17:
            raise ValueError(f"particles must be at least 17, got {self.particles}")
        tuned = TUNING[self.log].tuned_to_s
        if self.stop_s is not None and not self.stop_s > tuned:
            raise ValueError(f"stop_s must be behind the part that is tuned on, {tuned} s, got {self.stop_s}")

    @property
    def folder(self) -> str:
        """Where the log's files lie."""
        return TUNING[self.log].folder if self.data_folder is None else self.data_folder

    @property
    def every_s(self) -> float:
        """Time between starts of gaps."""
        return TUNING[self.log].gap_every_s if self.gap_every_s is None else self.gap_every_s

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


# What is known of the logs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tuning:
    """Numbers of one log.

    The filter starts at the first fix from ``start_s`` on and ends at ``stop_s``; the settings below were found on
    fixes before ``tuned_to_s``, and consistency is told from ``score_from_s`` on, before and after that time.
    ``rest_until_s``: until then the vehicle stands still; None: the start is level with unknown biases.
    ``delay_s``: fixes are that much older than their time stamps. ``aid_sd``: of the barometer, m, or of the speed
    sideways and upward of a car's rear axle, m/s, which lies ``axle_m`` (right, forward, up) from the sensors.
    Densities and start deviations are those of `StrapdownTransition` and of its state.
    """

    folder: str
    start_s: float
    tuned_to_s: float
    score_from_s: float
    stop_s: float
    gap_every_s: float
    rest_until_s: float | None
    delay_s: float
    position_sd_m: tuple[float, float, float]
    velocity_sd_m_s: tuple[float, float, float]
    aid_sd: float
    axle_m: tuple[float, float, float] | None
    angle_random_walk_rad_sqrt_s: float
    velocity_random_walk_m_s_sqrt_s: float
    gyro_bias_walk_rad_s_sqrt_s: float
    accel_bias_walk_m_s2_sqrt_s: float
    start_tilt_rad: float
    start_heading_rad: float
    start_velocity_m_s: float
    start_position_m: tuple[float, float, float]
    start_gyro_bias_rad_s: float
    start_accel_bias_m_s2: float


TUNING: dict[Log, Tuning] = {
    # The start is in flight and knows next to nothing: level and along the course within 20 deg. The receiver's errors
    # of position are slow; 1.5 m is what they are, not what they change by within a second. The barometer wanders by
    # metres within minutes; a large white noise stands for that.
    "uav": Tuning(
        folder="data/uav_thor75",
        start_s=240.0,
        tuned_to_s=357.8,
        score_from_s=250.0,
        stop_s=AIRBORNE_S[1],
        gap_every_s=4.0,
        rest_until_s=None,
        delay_s=0.05,
        position_sd_m=(1.5, 1.5, 2.5),
        velocity_sd_m_s=(0.14, 0.14, 0.37),
        aid_sd=8.0,
        axle_m=None,
        angle_random_walk_rad_sqrt_s=1e-3,
        velocity_random_walk_m_s_sqrt_s=0.05,
        gyro_bias_walk_rad_s_sqrt_s=3e-5,
        accel_bias_walk_m_s2_sqrt_s=1e-3,
        start_tilt_rad=math.radians(20),
        start_heading_rad=math.radians(23),
        start_velocity_m_s=0.5,
        start_position_m=(3.0, 3.0, 4.0),
        start_gyro_bias_rad_s=math.radians(1),
        start_accel_bias_m_s2=0.3,
    ),
    # The receiver smooths its fixes: millimetres are what they scatter by, while they are off by most of a metre
    # together.
    "car": Tuning(
        folder="data/car_urban_loop",
        start_s=9.5,
        tuned_to_s=160.0,
        score_from_s=SCORE_FROM_S,
        stop_s=math.inf,
        gap_every_s=5.0,
        rest_until_s=8.0,
        delay_s=0.0,
        position_sd_m=(0.006, 0.006, 0.02),
        velocity_sd_m_s=(0.055, 0.055, 0.055),
        aid_sd=0.2,
        axle_m=(0.0, -1.7, 0.0),
        angle_random_walk_rad_sqrt_s=2e-4,
        velocity_random_walk_m_s_sqrt_s=0.045,
        gyro_bias_walk_rad_s_sqrt_s=1e-5,
        accel_bias_walk_m_s2_sqrt_s=1e-3,
        start_tilt_rad=0.03,
        start_heading_rad=math.radians(15),
        start_velocity_m_s=0.3,
        start_position_m=(1.0, 1.0, 2.0),
        start_gyro_bias_rad_s=1e-3,
        start_accel_bias_m_s2=0.2,
    ),
}


@dataclass(frozen=True)
class Variant:
    """A filter and what it is given: the aid beside the satellites, the delay of their fixes."""

    filter: Literal["es-kf", "ckf", "rpf"]
    aided: bool
    delayed: bool = True


VARIANTS: dict[Log, dict[str, Variant]] = {
    "uav": {
        "es-kf": Variant("es-kf", aided=False),
        "es-kf-barometer": Variant("es-kf", aided=True),
        "es-kf-undelayed": Variant("es-kf", aided=False, delayed=False),
        "ckf-barometer": Variant("ckf", aided=True),
        "rpf-barometer": Variant("rpf", aided=True),
    },
    "car": {
        "es-kf": Variant("es-kf", aided=False),
        "es-kf-constraint": Variant("es-kf", aided=True),
        "ckf-constraint": Variant("ckf", aided=True),
    },
}
# The particle filter takes as long as all others together.
DEFAULT: dict[Log, tuple[str, ...]] = {
    "uav": ("es-kf", "es-kf-barometer", "es-kf-undelayed", "ckf-barometer"),
    "car": ("es-kf", "es-kf-constraint", "ckf-constraint"),
}


class Mounting(NamedTuple):
    """Where the car's nose points, seen from the sensors' forward axis: rad, clockwise and upward."""

    yaw_rad: float = 0.0
    pitch_rad: float = 0.0


# A log in steps ------------------------------------------------------------------------------------------------------


class Drive(NamedTuple):
    """A log in t steps of a filter, f of which end at a fix.

    time_s, dt_s (t,): end and length of the steps; controls (t, 6): increments over them; fix (t,): number of the fix
    at the end of the step, -1 for none. fix_time_s (f,), position_m, velocity_m_s (f, 3): of the fixes, ENU metres of
    ``origin``. measurements (f, m); by_satellite (m,): which of their components a gap takes away. attitude_rad (f, 3):
    heading, pitch and roll of the log's reference at the fixes. model: the three laws; its prior is the fix before the
    first step.
    """

    time_s: Tensor
    dt_s: Tensor
    controls: Tensor
    fix: Tensor
    fix_time_s: Tensor
    position_m: Tensor
    velocity_m_s: Tensor
    measurements: Tensor
    by_satellite: Tensor
    attitude_rad: Tensor
    origin: LocalMetres
    model: StateSpaceModel

    @property
    def fixes(self) -> NavigationFixes:
        """The measurement law."""
        law = self.model.observation
        assert isinstance(law, NavigationFixes)
        return law


def read_log(settings: LogSettings) -> InertialLog:
    """The settings' log.

    Raises:
        torchfilt.io.files.LogError: its reader refuses a file, which is named with the row.
        FileNotFoundError: a file is missing.
    """
    return read_car_loop(settings.folder) if settings.log == "car" else read_uav_thor(settings.folder)


def make_drive(
    log: InertialLog,
    settings: LogSettings,
    variant: Variant,
    mounting: Mounting | None = None,
    stop_s: float = math.inf,
) -> Drive:
    """A log in steps, with the laws of a variant.

    Args:
        log: of `read_log`. settings, variant: see there.
        mounting: the sensors are turned by it, so that body axes become the car's.
        stop_s: earlier end than that of the settings.

    Raises:
        ValueError: fewer than two fixes between start and end.
    """
    tuning = TUNING[settings.log]
    if mounting is not None:
        log = _turned(log, mounting)
    gnss = log.gnss
    time = gnss.time_s - (tuning.delay_s if variant.delayed else 0.0)
    last = min(tuning.stop_s, stop_s, log.time_s[-1].item(), math.inf if settings.stop_s is None else settings.stop_s)
    used = (time >= tuning.start_s) & (time <= last)
    if used.sum() < 2:
        raise ValueError(f"{int(used.sum())} fixes from {tuning.start_s} to {last:.6g} s, at least 2 are needed")
    time, velocity = time[used], gnss.velocity_m_s[used]
    latitude, longitude, height = gnss.latitude_rad[used], gnss.longitude_rad[used], gnss.height_m[used]
    origin = LocalMetres(latitude[0].item(), longitude[0].item(), height[0].item())
    position = origin.to_metres(latitude, longitude, height)
    edges = step_edges(time, settings.step_s)
    dt, controls = step_controls(log, edges)
    law = _fixes_law(settings.log, variant)
    parts = {"position": position, "velocity": velocity}
    if "body_velocity" in law.parts:
        parts["body_velocity"] = position.new_tensor([0.0, torch.nan, 0.0]).expand(len(time), 3)
    if "height" in law.parts:
        parts["height"] = _pressure_height(log, time)
    measurements = law.assemble(**parts)
    by_satellite = torch.zeros(measurements.shape[-1], dtype=torch.bool)
    by_satellite[law.parts["position"]] = by_satellite[law.parts["velocity"]] = True
    ends = edges[1:]
    fix = torch.full(ends.shape, -1)
    fix[torch.searchsorted(ends, time[1:])] = torch.arange(len(time) - 1)
    return Drive(
        ends,
        dt,
        controls,
        fix,
        time[1:],
        position[1:],
        velocity[1:],
        measurements[1:],
        by_satellite,
        _attitude_at(log.reference, time[1:]),
        origin,
        StateSpaceModel(_start(log, tuning, position[0], velocity[0], origin), _motion_law(tuning, origin), law),
    )


def step_edges(events_s: Tensor, longest_s: float) -> Tensor:
    """Times (k + 1,) that cut the spans between successive events (f,) into equal steps of at most ``longest_s``."""
    span = events_s.diff()
    # A part in 1e6 of a step is rounding of the stamps.
    count = (span / longest_s - 1e-6).ceil().clamp(min=1).long()
    first = count.cumsum(0) - count
    place = torch.arange(int(count.sum())) - first.repeat_interleave(count)
    parts = events_s[:-1].repeat_interleave(count) + (span / count).repeat_interleave(count) * place
    return torch.cat([parts, events_s[-1:]])


def step_controls(log: InertialLog, edges_s: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths (k,) and increments (k, 6) of the steps between times (k + 1,): the samples' own, joined.

    A sample's rate and force are constant over its interval; coning between samples is not made up for.

    Raises:
        ValueError: a step that holds a gap of the log.
    """
    steps = group_increments(log, times_s=edges_s)
    if not steps.whole.all():
        k = int((~steps.whole).nonzero()[0])
        raise ValueError(f"no inertial samples within the step that ends at {steps.time_s[k].item():.6g} s")
    span = steps.sample_dt_s[..., None]
    samples = ((values * span).unsqueeze(-2) for values in (steps.gyro_rad_s, steps.accel_m_s2))
    return steps.dt_s, torch.cat(join(*compensate(*samples)), -1)


def _turned(log: InertialLog, mounting: Mounting) -> InertialLog:
    angles = log.time_s.new_tensor([mounting.yaw_rad, mounting.pitch_rad, 0.0])
    back = inverse(from_euler(*angles))
    return log._replace(gyro_rad_s=rotate(back, log.gyro_rad_s), accel_m_s2=rotate(back, log.accel_m_s2))


def _pressure_height(log: InertialLog, time: Tensor) -> Tensor:
    """Barometric height (f, 1) above the origin, that is, with its zero at the first fix."""
    if log.pressure_height_m is None:
        raise ValueError("this log has no barometer")
    height = log.pressure_height_m[torch.searchsorted(log.time_s, time, right=True) - 1]
    return (height - height[0]).unsqueeze(-1)


def _attitude_at(reference: Reference, time: Tensor) -> Tensor:
    """Heading, pitch and roll (f, 3) between the reference's own times; angles are joined on the circle."""
    angles = torch.stack([reference.heading_rad, reference.pitch_rad, reference.roll_rad], -1)
    k = torch.searchsorted(reference.time_s, time).clamp(1, len(reference.time_s) - 1)
    before, after = reference.time_s[k - 1], reference.time_s[k]
    share = ((time - before) / (after - before)).unsqueeze(-1)
    sine, cosine = (value[k - 1] * (1 - share) + value[k] * share for value in (angles.sin(), angles.cos()))
    return torch.atan2(sine, cosine)


# Laws ----------------------------------------------------------------------------------------------------------------


def _fixes_law(log: Log, variant: Variant) -> NavigationFixes:
    tuning = TUNING[log]
    aid: dict[str, Any] = {}
    if variant.aided and tuning.axle_m is not None:
        aid = {"body_velocity_sd_m_s": tuning.aid_sd, "axle_m": torch.tensor(tuning.axle_m, dtype=torch.float64)}
    elif variant.aided:
        aid = {"height_sd_m": tuning.aid_sd}
    position, velocity = (torch.tensor(v, dtype=torch.float64) for v in (tuning.position_sd_m, tuning.velocity_sd_m_s))
    return NavigationFixes(position_sd_m=position, velocity_sd_m_s=velocity, **aid)


def _motion_law(tuning: Tuning, origin: LocalMetres) -> StrapdownTransition:
    return StrapdownTransition(
        origin,
        angle_random_walk_rad_sqrt_s=tuning.angle_random_walk_rad_sqrt_s,
        velocity_random_walk_m_s_sqrt_s=tuning.velocity_random_walk_m_s_sqrt_s,
        gyro_bias_walk_rad_s_sqrt_s=tuning.gyro_bias_walk_rad_s_sqrt_s,
        accel_bias_walk_m_s2_sqrt_s=tuning.accel_bias_walk_m_s2_sqrt_s,
    )


def _start(log: InertialLog, tuning: Tuning, position: Tensor, velocity: Tensor, origin: LocalMetres) -> Gaussian:
    """What is known at the first fix: its course as heading, tilt and gyro bias from standstill where there was one."""
    heading, zero = course(velocity), torch.zeros_like(velocity)
    if tuning.rest_until_s is None:
        quaternion, gyro_bias = from_euler(heading, zero[0], zero[0]), zero
    else:
        still = log.time_s < tuning.rest_until_s
        quaternion, gyro_bias = align_at_rest(
            log.gyro_rad_s[still], log.accel_m_s2[still], heading, origin.latitude_rad
        )
    deviation = [
        *(tuning.start_tilt_rad, tuning.start_tilt_rad, tuning.start_heading_rad),
        *[tuning.start_velocity_m_s] * 3,
        *tuning.start_position_m,
        *[tuning.start_gyro_bias_rad_s] * 3,
        *[tuning.start_accel_bias_m_s2] * 3,
    ]
    mean = torch.cat([quaternion, velocity, position, gyro_bias, zero])
    return Gaussian(mean, torch.diag(mean.new_tensor(deviation)), NAVIGATION_SPACE)


def make_filter(drive: Drive, variant: Variant, settings: LogSettings) -> Filter[Any]:
    """The variant's filter on the laws of a drive."""
    makers: dict[str, Callable[[], Filter[Any]]] = {
        "es-kf": lambda: ErrorStateKalmanFilter(drive.model),
        "ckf": lambda: CubatureKalmanFilter(drive.model),
        "rpf": lambda: RegularizedParticleFilter(drive.model, settings.particles),
    }
    return makers[variant.filter]()


# Gaps ----------------------------------------------------------------------------------------------------------------


class Gaps(NamedTuple):
    """G gaps that begin after a fix: ``before`` (G,) is its number, ``last`` (k, G) the withheld fix that ends each of
    the k lengths. Gaps of one start lie in each other, so one row of a batch serves all lengths.
    """

    before: Tensor
    last: Tensor

    def withheld(self, fixes: int) -> Tensor:
        """Which of the fixes (fixes, G) the longest gap of each start takes away."""
        number = torch.arange(fixes).unsqueeze(-1)
        return (number > self.before) & (number <= self.last[-1])


def make_gaps(drive: Drive, settings: LogSettings) -> Gaps:
    """Starts at equal times behind what was tuned on, as many as have room for the longest gap.

    Raises:
        ValueError: there is no room for any.
    """
    time = drive.fix_time_s
    first = TUNING[settings.log].tuned_to_s + settings.every_s
    room = time[-1].item() - settings.gaps_s[-1] - first
    # Stamps jitter by much less than a fix's interval.
    count = math.floor((room + 0.5 * time.diff().median().item()) / settings.every_s) + 1
    if count < 1:
        raise ValueError(
            f"gaps_s: no room for {settings.gaps_s[-1]:g} s between {first:g} s and the last fix at {time[-1]:.6g} s"
        )
    starts = first + settings.every_s * torch.arange(count, dtype=time.dtype)
    before = torch.searchsorted(time, starts + 1e-6, right=True) - 1
    ends = time[before] + time.new_tensor(settings.gaps_s).unsqueeze(-1)
    last = (time - ends.unsqueeze(-1)).abs().argmin(-1)
    return Gaps(before, last)
