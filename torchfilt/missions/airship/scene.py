"""Simulator of the airship study: moored at a mast, cruise along waypoints in a hall, approach of a landing spot.

The path is that of the airship's equations of motion under a controller that knows the truth, in gusts: a Gauss-Markov
air velocity, constant over each step. The inertial sensors and all others ride in the gondola; the truth that
navigation is asked for is the gondola's.

Horizontal position is not observable from inertial sensors, barometer, magnetometer and a sonar over a clear floor: all
of them stay the same under a shift of the whole hall. Ranges to ultrasonic beacons at the hall's upper corners make it
observable, and with it, as soon as the ship accelerates, the heading. Tables stand in the hall: what the sonar measures
above them is not the height.
"""

import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfilt.models.airship import Airship, AirshipTransition
from torchfilt.models.attitude import from_euler, inverse, multiply, rotate, to_euler, to_rotation_vector
from torchfilt.models.inertial.imu import ImuGrade, seeded_normals
from torchfilt.models.landing import GRAVITY_M_S2
from torchfilt.models.sensors.barometer import BarometricAltimeter, first_order_lag
from torchfilt.models.sensors.magnetometer import Magnetometer, field_enu
from torchfilt.models.sensors.ultrasonic import UltrasonicRange
from torchfilt.spaces import wrap_angle

FILTER_RATE_HZ = 20
HALL_M = (40.0, 20.0, 8.0)
MAST_M = (4.0, 4.0, 2.5)
"""Where the hull's centre is moored, nose to the east."""
WAYPOINTS_M = ((33.0, 5.0, 3.5), (33.0, 14.0, 5.0), (20.0, 15.0, 3.0), (8.0, 14.0, 4.5), (18.0, 6.0, 3.5))
LANDING_M = (22.0, 10.0)
LANDED_HEIGHT_M = 1.2
"""Of the hull's centre, 0.7 m of it below the gondola."""
BEACONS_M = ((0.5, 0.5, 7.0), (39.5, 0.5, 7.8), (39.5, 19.5, 7.0), (0.5, 19.5, 7.8))
"""Not in one plane with each other, so that the height is not mirrored."""
PILLAR_M = (20.0, 12.0, 2.0)
CLEAR_M = 5.0
"""So far around the landing spot, and around the mast, the floor is clear."""
ANCHORED, CRUISE, APPROACH = range(3)

TRUTH_NAMES = (
    *(f"quaternion_{axis}" for axis in "xyzw"),
    *(f"velocity_{axis}_m_s" for axis in "xyz"),
    *(f"position_{axis}_m" for axis in "xyz"),
    *(f"gyro_bias_{axis}_rad_s" for axis in "xyz"),
    *(f"accel_bias_{axis}_m_s2" for axis in "xyz"),
    "barometer_lagged_m",
    "barometer_offset_m",
    *(f"hard_iron_{axis}_ut" for axis in "xyz"),
)
"""The first 16 are the state of `torchfilt.models.landing`."""
LAGGED, OFFSET, HARD_IRON = 16, 17, 18

BLIMP_IMU = ImuGrade(
    gyro_bias_sd_rad_s=math.radians(0.1),
    angle_random_walk_rad_sqrt_s=math.radians(0.01),
    accel_bias_sd_m_s2=0.05,
    velocity_random_walk_m_s_sqrt_s=0.002,
)
"""Cheap micromachined sensors on a hull that hardly shakes."""
_SHIP = Airship()

# Purposes of random numbers, keys of the noise source.
_START, _GUSTS, _IMU, _BIAS, _BAROMETER, _OFFSET, _ULTRASONIC, _MAGNETOMETER, _BEACONS, _CHANCE = range(10)
# Mooring: springs and dampers at the nose and at the gondola, N/m and N s/m.
_SPRING_N_M, _DAMPER_N_S_M = 4.0, 2.0
# On the map: a waypoint is reached within the first distance; within the second of the landing spot the ship starts to
# sink; within the third it keeps its heading and goes to and fro.
_REACHED_M, _ABOVE_M, _NEAR_M, _SINK_M_S = 2.0, 1.5, 0.7, 0.2
_MOST_THRUST_N, _MOST_MOMENT_N_M = 0.4, 0.25


@dataclass(frozen=True)
class AirshipSettings:
    """What is flown and measured.

    runs: one batch, of which each has the seed after the last one's. anchored_s, cruise_s, approach_s: durations.
    gust_sd_m_s, gust_time_s: of each axis of the air's velocity and of its memory; half of it up.
    imu: white noise and constant biases; gyro_bias_walk_rad_s_sqrt_s, accel_bias_walk_m_s2_sqrt_s: random walks on top.
    barometer_hz, barometer_sd_m, barometer_lag_s, barometer_offset_sd_m, barometer_walk_m_sqrt_s: rate, noise, time
        constant, offset at the start and its random walk.
    ultrasonic_hz, ultrasonic_delay_s, ultrasonic_dropout: of the sonar below; the delay is a whole number of steps.
    clutter_m: height of the tables in the hall, which the sonar sees instead of the floor; 0 for none.
    magnetometer_hz, magnetometer_sd_ut, hard_iron_sd_ut: hard iron that a calibration has left over, constant.
    pillar_moment_a_m2: magnetic moment of a steel pillar, pointing up; 0 for none.
    beacon_hz, beacon_sd_m, beacon_dropout: ranges to the beacons.

    The numbers are round ones of the order of cheap sensors' data sheets; none is a particular sensor's.

    Raises:
        ValueError: numbers out of range, a rate that does not divide the filter's, a delay between two steps.
    """

    runs: int = 20
    seed: int = 0
    anchored_s: float = 30.0
    cruise_s: float = 120.0
    approach_s: float = 75.0
    gust_sd_m_s: float = 0.05
    gust_time_s: float = 8.0
    imu: ImuGrade = BLIMP_IMU
    gyro_bias_walk_rad_s_sqrt_s: float = 1e-5
    accel_bias_walk_m_s2_sqrt_s: float = 1e-4
    barometer_hz: int = 10
    barometer_sd_m: float = 0.15
    barometer_lag_s: float = 0.5
    barometer_offset_sd_m: float = 1.0
    barometer_walk_m_sqrt_s: float = 0.05
    ultrasonic_hz: int = 10
    ultrasonic_delay_s: float = 0.1
    ultrasonic_dropout: float = 0.05
    clutter_m: float = 0.8
    magnetometer_hz: int = 10
    magnetometer_sd_ut: float = 0.5
    hard_iron_sd_ut: float = 1.0
    pillar_moment_a_m2: float = 0.0
    beacon_hz: int = 2
    beacon_sd_m: float = 0.03
    beacon_dropout: float = 0.05

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise ValueError(f"runs must be at least 1, got {self.runs}")
        numbers = {name: value for name, value in vars(self).items() if isinstance(value, float)}
        for name, value in numbers.items():
            signed = name == "pillar_moment_a_m2"
            if not math.isfinite(value) or (value < 0 and not signed):
                raise ValueError(f"{name} must be finite{'' if signed else ' and not negative'}, got {value}")
        for name in ("gust_time_s", "barometer_lag_s", "barometer_sd_m", "magnetometer_sd_ut", "beacon_sd_m"):
            if not numbers[name] > 0:
                raise ValueError(f"{name} must be positive, got {numbers[name]}")
        for name in ("ultrasonic_dropout", "beacon_dropout"):
            if not numbers[name] <= 0.5:
                raise ValueError(f"{name} must be from 0 to 0.5, got {numbers[name]}")
        for name in ("barometer_hz", "ultrasonic_hz", "magnetometer_hz", "beacon_hz"):
            rate = getattr(self, name)
            if rate < 1 or FILTER_RATE_HZ % rate:
                raise ValueError(f"{name} must divide the filter's rate, {FILTER_RATE_HZ}, got {rate}")
        for name in ("anchored_s", "cruise_s", "approach_s", "ultrasonic_delay_s"):
            count = numbers[name] * FILTER_RATE_HZ
            if abs(count - round(count)) > 1e-9:
                raise ValueError(f"{name} must be whole steps of {1 / FILTER_RATE_HZ} s, got {numbers[name]}")
        if self.steps < 1:
            raise ValueError("the durations must not all be zero")

    @property
    def steps(self) -> int:
        """Number of steps of the filter."""
        return round((self.anchored_s + self.cruise_s + self.approach_s) * FILTER_RATE_HZ)

    def to_dict(self) -> dict[str, Any]:
        """All settings as numbers and dicts, JSON-ready."""
        return asdict(self)


class Scene(NamedTuple):
    """Runs of a mission; k-th rows belong to the end of step k, at time (k + 1) dt.

    start (R, 21), truth (t, R, 21): what `TRUTH_NAMES` says, before and after the steps, at the gondola.
    ship (t, R, 13): state of `torchfilt.models.airship` at the hull's centre. thrust (t, R, 3): control over the step.
    air (t, R, 3): the air's velocity over the step, m/s, world axes.
    controls (t, R, 6): compensated increments (dtheta, dv) of the inertial sensors over the step.
    measurements: by sensor, NaN where it is silent: "barometer" (t, R, 1) height in m; "ultrasonic" (t, R, 1) range
    in m as the sensor puts it out, of `ultrasonic_delay_s` before; "magnetometer" (t, R, 3) in body axes, microtesla;
    "beacons" (t, R, 4) in m.
    phase (t,): ANCHORED, CRUISE or APPROACH. time (t,): s. dt: s. settings: what was asked for.
    """

    start: Tensor
    truth: Tensor
    ship: Tensor
    thrust: Tensor
    air: Tensor
    controls: Tensor
    measurements: dict[str, Tensor]
    phase: Tensor
    time: Tensor
    dt: float
    settings: AirshipSettings


def make_scene(settings: AirshipSettings) -> Scene:
    """Fly and measure; each run's numbers depend on its own seed alone.

    Returns:
        A `Scene`.
    """
    seeds = [settings.seed + k for k in range(settings.runs)]
    dt = 1 / FILTER_RATE_HZ
    first, flown, thrust, air = _fly(settings, seeds)
    ship = torch.cat([first.unsqueeze(0), flown])
    inertial = torch.cat([gondola(ship), _biases(settings, seeds)], -1)
    truth = torch.cat([inertial, _slow_numbers(settings, seeds, inertial[..., 9:10])], -1)
    controls = _increments(settings, seeds, inertial)
    measurements = _measure(settings, seeds, truth)
    count = torch.arange(settings.steps)
    phase = (count >= round(settings.anchored_s * FILTER_RATE_HZ)).long()
    phase += (count >= round((settings.anchored_s + settings.cruise_s) * FILTER_RATE_HZ)).long()
    time = (count.double() + 1) * dt
    return Scene(truth[0], truth[1:], flown, thrust, air, controls, measurements, phase, time, dt, settings)


def gondola(ship: Tensor) -> Tensor:
    """Attitude, velocity and position (..., 10) of the gondola, of states (..., 13) of the hull's centre."""
    q, arm = ship[..., :4], ship.new_tensor([0, 0, _SHIP.gondola_height_m])
    moved = rotate(q, torch.linalg.cross(ship[..., 10:], arm.expand_as(ship[..., 10:])))
    return torch.cat([q, ship[..., 4:7] + moved, ship[..., 7:10] + rotate(q, arm)], -1)


# Flight ---------------------------------------------------------------------------------------------------------------


def _fly(settings: AirshipSettings, seeds: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First state, states at the ends of the steps, thrust and air over the steps."""
    draws = seeded_normals(seeds, (1, 12), _START)[0]
    air = _gusts(settings, seeds)
    law, pilot = AirshipTransition(_SHIP), _Pilot(settings)
    moored = draws.new_tensor(MAST_M).expand(len(seeds), 3)
    heading = math.pi / 2 + math.radians(5) * draws[:, 0]
    q = from_euler(heading, *(math.radians(0.5) * draws[:, 1:3]).unbind(-1))
    x = torch.cat([q, 0.005 * draws[:, 3:6], moored, 0.002 * draws[:, 6:9]], -1)
    first, mast = x, _Mast(torch.cat([from_euler(heading, *torch.zeros_like(draws[:, :2]).unbind(-1)), x[:, 4:]], -1))
    states, thrusts = [], []
    released = round(settings.anchored_s * FILTER_RATE_HZ)
    for k in range(settings.steps):
        if k < released:
            thrust, wrench = torch.zeros_like(moored), mast.pull(x)
        else:
            thrust = pilot.steer(k, x)
            wrench = thrust @ law.thrust_map.mT
        x = law.advance(x, wrench, air[k], 1 / FILTER_RATE_HZ)
        states.append(x)
        thrusts.append(thrust)
    return first, torch.stack(states), torch.stack(thrusts), air


def _gusts(settings: AirshipSettings, seeds: list[int]) -> Tensor:
    """Gauss-Markov air velocity (t, R, 3) from its stationary law."""
    noise = seeded_normals(seeds, (settings.steps, 3), _GUSTS)
    keep = math.exp(-1 / (FILTER_RATE_HZ * settings.gust_time_s))
    value, path = noise[0], []
    for draw in noise:
        path.append(value)
        value = keep * value + math.sqrt(1 - keep**2) * draw
    return torch.stack(path) * noise.new_tensor([1, 1, 0.5]) * settings.gust_sd_m_s


class _Mast:
    """Springs and dampers that hold nose and gondola where they are in a state (R, 13)."""

    def __init__(self, x: Tensor) -> None:
        self.points = x.new_tensor([[0, _SHIP.length_m / 2, 0], [0, 0, _SHIP.gondola_height_m]])
        self.held = self._at(x)[0]

    def _at(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Places and velocities (2, R, 3) of the two points."""
        arms = self.points.unsqueeze(1).expand(2, len(x), 3)
        spin = torch.linalg.cross(x[:, 10:].expand_as(arms), arms)
        return x[:, 7:10] + rotate(x[:, :4], arms), x[:, 4:7] + rotate(x[:, :4], spin)

    def pull(self, x: Tensor) -> Tensor:
        """Force and moment (R, 6) in body axes."""
        place, velocity = self._at(x)
        force = rotate(inverse(x[:, :4]), _SPRING_N_M * (self.held - place) - _DAMPER_N_S_M * velocity)
        arms = self.points.unsqueeze(1).expand_as(force)
        return torch.cat([force, torch.linalg.cross(arms, force)], -1).sum(0)


class _Pilot:
    """Cascaded proportional control of heading, speed and height by the true state; remembers the next waypoint."""

    def __init__(self, settings: AirshipSettings) -> None:
        self.goals = torch.tensor(WAYPOINTS_M, dtype=torch.float64)
        self.spot = torch.tensor([*LANDING_M, self.goals[:, 2].min()], dtype=torch.float64)
        self.next = torch.zeros(settings.runs, dtype=torch.long)
        self.height = torch.full((settings.runs,), MAST_M[2], dtype=torch.float64)
        self.sinking = torch.zeros(settings.runs, dtype=torch.bool)
        self.approach = round((settings.anchored_s + settings.cruise_s) * FILTER_RATE_HZ)

    def steer(self, k: int, x: Tensor) -> Tensor:
        """Thrust (R, 3) over step k."""
        landing = k >= self.approach
        goal = self.spot.expand(len(x), 3) if landing else self.goals[self.next]
        away = goal[:, :2] - x[:, 7:9]
        distance = torch.linalg.vector_norm(away, dim=-1)
        if not landing:
            self.next = (self.next + (distance < _REACHED_M)) % len(self.goals)
        self._plan_height(goal[:, 2], distance, landing)
        through = rotate(inverse(x[:, :4]), x[:, 4:7])
        bearing = wrap_angle(torch.atan2(away[:, 0], away[:, 1]) - to_euler(x[:, :4])[0])  # off the nose, to the right
        turn = torch.where(distance < _NEAR_M, 0, bearing) if landing else bearing
        wanted = turn.cos().clamp_min(0.2)
        if landing:
            wanted = (0.2 * distance * bearing.cos()).clamp(-1, 1)
        # Stiffer than Munk's moment less the fins', 0.42 N m by the angle at 1 m/s: the hull stays along its path.
        moment = -0.5 * turn - 0.8 * x[:, 12]
        forward = 0.1 * wanted * wanted.abs() + 0.6 * (wanted - through[:, 1])
        up = 0.25 * (self.height - x[:, 9]) - 0.8 * x[:, 6]
        limits = x.new_tensor([_MOST_THRUST_N, _MOST_THRUST_N, _MOST_MOMENT_N_M])
        return torch.stack([forward, up, moment], -1).clamp(-limits, limits)

    def _plan_height(self, goal: Tensor, distance: Tensor, landing: bool) -> None:
        """Move the height that is asked for; over the spot down to the ground."""
        if landing:
            self.sinking = self.sinking | (distance < _ABOVE_M)
            goal = torch.where(self.sinking, LANDED_HEIGHT_M, goal)
        step = _SINK_M_S / FILTER_RATE_HZ
        self.height = self.height + (goal - self.height).clamp(-step, step)


# Inertial sensors -----------------------------------------------------------------------------------------------------


def _walk(settings: AirshipSettings, seeds: list[int], size: int, stream: int) -> Tensor:
    """Sums (t + 1, R, size) of standard normals per root of a second, from zero."""
    steps = seeded_normals(seeds, (settings.steps, size), stream) / FILTER_RATE_HZ**0.5
    return pad(steps.cumsum(0), (0, 0, 0, 0, 1, 0))


def _biases(settings: AirshipSettings, seeds: list[int]) -> Tensor:
    """Biases (t + 1, R, 6) of gyros and accelerometers."""
    start = seeded_normals(seeds, (2, 6), _START)[1]
    grade = settings.imu
    sizes = start.new_tensor([grade.gyro_bias_sd_rad_s] * 3 + [grade.accel_bias_sd_m_s2] * 3)
    walks = [settings.gyro_bias_walk_rad_s_sqrt_s] * 3 + [settings.accel_bias_walk_m_s2_sqrt_s] * 3
    return start * sizes + _walk(settings, seeds, 6, _BIAS) * start.new_tensor(walks)


def _increments(settings: AirshipSettings, seeds: list[int], inertial: Tensor) -> Tensor:
    """Compensated increments (t, R, 6) over the steps, of states (t + 1, R, 16).

    Differences of the true attitudes and velocities, exact whatever happens within a step. The biases at the start of
    the step are put in as they come out of a strapdown that does not know them: the force is turned by angles that the
    gyro's bias made too large. To second order, as `torchfilt.models.landing` takes them out.
    """
    dt, grade = 1 / FILTER_RATE_HZ, settings.imu
    q, velocity, bias = inertial[..., :4], inertial[..., 4:7], inertial[:-1, ..., 10:] * dt
    dtheta = to_rotation_vector(multiply(inverse(q[:-1]), q[1:]))
    dv = rotate(inverse(q[:-1]), velocity.diff(dim=0) + velocity.new_tensor([0, 0, GRAVITY_M_S2 * dt]))
    spin, shove = bias.split(3, -1)
    turned = torch.linalg.cross(spin, dv) + torch.linalg.cross(dtheta + spin, shove)
    sensed = torch.cat([dtheta + spin, dv + shove + turned / 2], -1)
    densities = [grade.angle_random_walk_rad_sqrt_s] * 3 + [grade.velocity_random_walk_m_s_sqrt_s] * 3
    noise = seeded_normals(seeds, (settings.steps, 6), _IMU)
    return sensed + noise * noise.new_tensor(densities) * dt**0.5


# Other sensors --------------------------------------------------------------------------------------------------------


def _slow_numbers(settings: AirshipSettings, seeds: list[int], height: Tensor) -> Tensor:
    """Lagged height, the barometer's offset and hard iron (t + 1, R, 5), of heights (t + 1, R, 1)."""
    start = seeded_normals(seeds, (3, 4), _START)[2]
    lagged = [height[0]]
    for before, after in pairwise(height):
        lagged.append(first_order_lag(lagged[-1], before, after, 1 / FILTER_RATE_HZ, settings.barometer_lag_s))
    offset = start[:, :1] * settings.barometer_offset_sd_m
    walk = _walk(settings, seeds, 1, _OFFSET) * settings.barometer_walk_m_sqrt_s
    iron = (start[:, 1:] * settings.hard_iron_sd_ut).expand(len(height), -1, -1)
    return torch.cat([torch.stack(lagged), offset + walk, iron], -1)


def field_ut(settings: AirshipSettings, position: Tensor) -> Tensor:
    """Magnetic field (..., 3) in the hall, world axes, microtesla: the Earth's and an upright dipole's in the pillar.

    The Earth's: 48 microtesla, 65 degrees down, 3 degrees east of north, as in central Europe.

    Source: Jackson, Classical Electrodynamics (1998), equation 5.56.
    """
    earth = field_enu(48.0, math.radians(65), math.radians(3)).to(position.dtype)
    away = position - position.new_tensor(PILLAR_M)
    # Within half a metre there is steel.
    distance = torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp_min(0.5)
    ray = away / distance
    up = position.new_tensor([0, 0, 1.0])
    return earth + 0.1 * settings.pillar_moment_a_m2 * (3 * ray[..., 2:] * ray - up) / distance**3


def clutter_m(settings: AirshipSettings, position: Tensor) -> Tensor:
    """Height (...), m, of what stands below positions (..., 3), m: tables of 4 m by 3 m, like a chessboard."""
    across, along = (position[..., k] / size for k, size in ((0, 4.0), (1, 3.0)))
    table = (across.floor() + along.floor()) % 2 == 0
    clear = [
        torch.linalg.vector_norm(position[..., :2] - position.new_tensor(p[:2]), dim=-1) for p in (LANDING_M, MAST_M)
    ]
    return settings.clutter_m * (table & (torch.minimum(*clear) > CLEAR_M)).to(position.dtype)


def ultrasonic_law(settings: AirshipSettings) -> UltrasonicRange:
    """The sonar below the gondola: 1 cm and 0.5 % of the range, 15 degrees, 0.25 m to 6 m."""
    return UltrasonicRange(0.01, 0.005, min_range_m=0.25, max_range_m=6.0, delay_s=settings.ultrasonic_delay_s)


def _measure(settings: AirshipSettings, seeds: list[int], truth: Tensor) -> dict[str, Tensor]:
    """What the sensors put out at the ends of the steps, of truth (t + 1, R, 21)."""
    now = truth[1:]
    count = (settings.steps,)
    barometer = BarometricAltimeter(sd_m=settings.barometer_sd_m, lagged=LAGGED, offset=OFFSET)
    magnetometer = Magnetometer(field_ut(settings, now[..., 7:10]), settings.magnetometer_sd_ut, hard_iron_at=HARD_IRON)
    heard = torch.arange(settings.steps) + 1 - round(settings.ultrasonic_delay_s * FILTER_RATE_HZ)
    above = truth[heard.clamp_min(0)].clone()
    above[..., 9] -= clutter_m(settings, above[..., 7:10])
    echo = ultrasonic_law(settings).simulate(above, seeded_normals(seeds, (*count, 1), _ULTRASONIC))
    echo = echo.masked_fill((heard < 0)[:, None, None], math.nan)
    arm = now[..., None, 7:10] - now.new_tensor(BEACONS_M)
    ranges = torch.linalg.vector_norm(arm, dim=-1)
    ranges = ranges + settings.beacon_sd_m * seeded_normals(seeds, (*count, 4), _BEACONS)
    lost = torch.special.ndtr(seeded_normals(seeds, (*count, 5), _CHANCE))
    noise = seeded_normals(seeds, (*count, 1), _BAROMETER)
    readings = {
        "barometer": (barometer(now).sample(noise), settings.barometer_hz),
        "ultrasonic": (
            echo.masked_fill(lost[..., 4:] < settings.ultrasonic_dropout, math.nan),
            settings.ultrasonic_hz,
        ),
        "magnetometer": (
            magnetometer(now).sample(seeded_normals(seeds, (*count, 3), _MAGNETOMETER)),
            settings.magnetometer_hz,
        ),
        "beacons": (ranges.masked_fill(lost[..., :4] < settings.beacon_dropout, math.nan), settings.beacon_hz),
    }
    return {name: _at_rate(values, rate) for name, (values, rate) in readings.items()}


def _at_rate(values: Tensor, rate_hz: int) -> Tensor:
    """Every so manyth row; NaN between."""
    every = FILTER_RATE_HZ // rate_hz
    silent = (torch.arange(len(values)) + 1) % every != 0
    return values.masked_fill(silent[:, None, None], math.nan)
