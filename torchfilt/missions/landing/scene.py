"""The landing study: a multirotor comes back to a pad with an infrared beacon, without satellites and compass.

A `Scene` is what happens in all runs of a scenario, as one batch: true states, increments of the inertial sensors, and
what barometer and camera show.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchfilt.model import StateSpaceModel
from torchfilt.models.attitude import from_rotation_vector, inverse, multiply, rotate, to_rotation_vector
from torchfilt.models.inertial.imu import seeded_normals
from torchfilt.models.inertial.strapdown import join
from torchfilt.models.landing import GRAVITY_M_S2, ROTOR_IMU, Barometer, Beacon, LandingStart, landing_model

Scenario = Literal["nominal", "false-source", "no-barometer", "pad-height", "wide-start"]
SCENARIOS: dict[Scenario, str] = {
    "nominal": "15 m, 5 m in height, 2 m/s, 3 deg of tilt, any heading",
    "false-source": "one second of another source, some metres off, before the beacon is seen",
    "no-barometer": "the beacon alone",
    "pad-height": "elevation of the pad unknown by 5 m, as a state",
    "wide-start": "10 deg of tilt and 4 m/s",
}
FILTER_RATE_HZ, IMU_RATE_HZ = 40, 200
_SAMPLES = IMU_RATE_HZ // FILTER_RATE_HZ
BAROMETER_SD_M, BEACON_SD_RAD = 0.4, math.radians(0.4)
# Purposes of random numbers, keys of the noise source.
_START, _PATH, _IMU, _BAROMETER, _BEACON, _CHANCE = range(6)
# A start is drawn again until the pad can be reached in time: about one in five is.
START_HEIGHT_M = 12.0
_DRAWS, _FARTHEST_M, _HEIGHTS_M = 64, 35.0, (5.0, 20.0)
# What is left of the height after so long at the first vertical speed must be enough too.
_SINK_ON_S = 1.0
# The approach lasts from 6 s to 9.5 s and ends at rest above the pad; then the vehicle sinks for 10 s and hovers.
_SHORTEST_S, _PER_METRE_S, _SINKING_S = 6.0, 0.1, 10.0
_ABOVE_M, _HOVER_M = 6.0, 1.5
# Sway about the way to the pad, as a share of the height, so that the pad stays in the picture.
_SWAY, _SWAY_RAD_S = 0.1, (1.1, 1.5)
# The false source is on for a second and goes out half a second before the beacon is seen, which is switched on late.
FALSE_STEPS, FALSE_LEAD_STEPS, _SWITCHED_ON_STEP, _FALSE_AWAY_M = 40, 60, 80, 4.0


@dataclass(frozen=True)
class LandingSettings:
    """What is flown.

    runs: Monte-Carlo runs, one batch; duration_s: of each, of which the default leaves 12 s after the beacon is first
    seen; dropout: share of the pictures that are lost; outlier_share: of those kept with the pad in them, how many show
    it anywhere in the field of view.

    Raises:
        ValueError: unknown scenario, numbers out of range.
    """

    scenario: Scenario = "nominal"
    runs: int = 50
    seed: int = 0
    duration_s: float = 22.0
    dropout: float = 0.1
    outlier_share: float = 0.02

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}, got {self.scenario!r}")
        if self.runs < 1:
            raise ValueError(f"runs must be at least 1, got {self.runs}")
        if not 11 <= self.duration_s <= 60:
            raise ValueError(f"duration_s must be from 11, when all approaches are over, to 60, got {self.duration_s}")
        for name in ("dropout", "outlier_share"):
            if not 0 <= getattr(self, name) <= 0.5:
                raise ValueError(f"{name} must be from 0 to 0.5, got {getattr(self, name)}")

    @property
    def steps(self) -> int:
        """Of the filter."""
        return round(self.duration_s * FILTER_RATE_HZ)

    @property
    def start(self) -> LandingStart:
        """What is known before."""
        if self.scenario == "wide-start":
            return LandingStart(START_HEIGHT_M, speed_sd_m_s=4.0, tilt_sd_rad=math.radians(10))
        return LandingStart(START_HEIGHT_M, pad_height_sd_m=5.0 if self.scenario == "pad-height" else None)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


class Scene(NamedTuple):
    """Runs of a scenario.

    truth: states (t, R, d) of `torchfilt.models.landing` at the end of each step; measurements (t, R, m): then, for the
    model's sensors side by side, NaN where one is silent; controls (t, R, 6): increments over the step; acquired (R,):
    step at whose end the beacon itself is first seen; model: with the gauge; world_model: the same without; dt: s.
    """

    truth: Tensor
    measurements: Tensor
    controls: Tensor
    acquired: Tensor
    model: StateSpaceModel
    world_model: StateSpaceModel
    dt: float


def make_scene(settings: LandingSettings) -> Scene:
    """Fly and measure; each run's numbers depend on its own seed alone."""
    seeds = [settings.seed + k for k in range(settings.runs)]
    start = _draw_start(settings, seeds)
    truth, controls = _fly(settings, seeds, start)
    sight, acquired = _look(settings, seeds, truth)
    sd = None if settings.scenario == "no-barometer" else BAROMETER_SD_M
    measurements = sight
    if sd is not None:
        height = Barometer(sd)(truth).sample(seeded_normals(seeds, (settings.steps, 1), _BAROMETER))
        measurements = torch.cat([height, sight], -1)
    model, world = (
        landing_model(settings.start, ROTOR_IMU, barometer_sd_m=sd, beacon_sd_rad=BEACON_SD_RAD, gauge=gauge)
        for gauge in (True, False)
    )
    return Scene(truth, measurements, controls, acquired, model, world, 1 / FILTER_RATE_HZ)


# Flight ---------------------------------------------------------------------------------------------------------------


class _Start(NamedTuple):
    """Drawn start: position, velocity (R, 3), acceleration that goes with the tilt (R, 3), heading (R,), rest (R, b).

    rest: biases of gyros and accelerometers, and the barometer's offset where it is a state.
    """

    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    yaw: Tensor
    rest: Tensor


def _draw_start(settings: LandingSettings, seeds: list[int]) -> _Start:
    """The first of each run's draws from which the pad can be reached in time."""
    start = settings.start
    normals = seeded_normals(seeds, (_DRAWS, 16), _START)
    deviation = normals.new_tensor([start.horizontal_sd_m, start.horizontal_sd_m, start.vertical_sd_m])
    position = normals[..., :3] * deviation + normals.new_tensor([0, 0, start.height_m])
    near = torch.linalg.vector_norm(position[..., :2], dim=-1) <= _FARTHEST_M
    low, high = _HEIGHTS_M
    lowest = position[..., 2] + _SINK_ON_S * normals[..., 5] * start.speed_sd_m_s
    chosen = (near & (position[..., 2] >= low) & (position[..., 2] <= high) & (lowest >= low)).int().argmax(0)
    run = torch.arange(len(seeds))
    own = normals[chosen, run]
    tilt = pad(own[:, 6:8] * start.tilt_sd_rad, (0, 1))
    thrust = rotate(from_rotation_vector(tilt), normals.new_tensor([0, 0, 1]).expand_as(tilt))
    # At first the vehicle keeps its vertical speed; then the thrust's direction tells the acceleration.
    acceleration = GRAVITY_M_S2 * (thrust / thrust[:, 2:] - normals.new_tensor([0, 0, 1]))
    rest = [own[:, 9:12] * ROTOR_IMU.gyro_bias_sd_rad_s, own[:, 12:15] * ROTOR_IMU.accel_bias_sd_m_s2]
    if start.pad_height_sd_m is not None:
        rest.append(own[:, 15:] * start.pad_height_sd_m)
    yaw = math.pi * (2 * torch.special.ndtr(own[:, 8]) - 1)
    return _Start(position[chosen, run], own[:, 3:6] * start.speed_sd_m_s, acceleration, yaw, torch.cat(rest, -1))


def _fly(settings: LandingSettings, seeds: list[int], start: _Start) -> tuple[Tensor, Tensor]:
    """True states at the ends of the steps, and what the inertial sensors report over the steps.

    The thrust carries weight and acceleration along body z, the heading is free: this is the attitude. Increments are
    differences of true attitudes and velocities, sampled at 200 Hz, with biases and noise, joined to one a step. True
    positions are the trapezoidal sums of true velocities, as the model has it; from the curve that was planned they
    stay away by less than a millimetre.
    """
    shape = seeded_normals(seeds, (1, 4), _PATH)[0]
    time = torch.arange(settings.steps * _SAMPLES + 1, dtype=torch.float64).unsqueeze(-1) / IMU_RATE_HZ
    curve = _Curve(start, math.pi * (2 * torch.special.ndtr(shape[:, :2]) - 1))
    along = time.expand(-1, len(seeds)).contiguous()
    one = torch.ones_like(along)

    def velocity_of(t: Tensor) -> Tensor:
        velocity: Tensor = torch.func.jvp(curve, (t,), (one,))[1]
        return velocity

    found = torch.func.jvp(velocity_of, (along,), (one,))
    velocity, acceleration = found[0], found[1]
    yaw = start.yaw + 0.3 * (1 + torch.special.ndtr(shape[:, 2])) * torch.sin(0.5 * along) * shape[:, 3].sign()
    weight = acceleration.new_tensor([0, 0, GRAVITY_M_S2])
    attitude = _attitude(acceleration + weight, yaw)
    dtheta = to_rotation_vector(multiply(inverse(attitude[:-1]), attitude[1:]))
    dv = rotate(inverse(attitude[:-1]), velocity.diff(dim=0) + weight / IMU_RATE_HZ)
    sensed = torch.cat([dtheta, dv], -1) + start.rest[:, :6] / IMU_RATE_HZ
    densities = [ROTOR_IMU.angle_random_walk_rad_sqrt_s] * 3 + [ROTOR_IMU.velocity_random_walk_m_s_sqrt_s] * 3
    sensed = sensed + seeded_normals(seeds, (len(sensed), 6), _IMU) * sensed.new_tensor(densities) / IMU_RATE_HZ**0.5
    grouped = sensed.unflatten(0, (settings.steps, _SAMPLES)).movedim(1, -2)
    controls = torch.cat(join(grouped[..., :3], grouped[..., 3:]), -1)
    at = velocity[::_SAMPLES]
    position = start.position + ((at[1:] + at[:-1]) / (2 * FILTER_RATE_HZ)).cumsum(0)
    rest = start.rest.expand(settings.steps, *start.rest.shape)
    return torch.cat([attitude[_SAMPLES::_SAMPLES], at[1:], position, rest], -1), controls


class _Curve:
    """Planned position (..., R, 3) at times (..., R): from the start to a point above the pad, then down, swaying."""

    def __init__(self, start: _Start, phase: Tensor) -> None:
        self.arrival = _SHORTEST_S + _PER_METRE_S * torch.linalg.vector_norm(start.position[:, :2], dim=-1)
        self.phase = phase
        end = start.position.new_tensor([0, 0, _ABOVE_M])
        duration = self.arrival.unsqueeze(-1)
        # In units of the duration; the last four conditions, at rest with no jerk, give the last four coefficients.
        first = [start.position - end, start.velocity * duration, start.acceleration * duration**2 / 2]
        powers = torch.arange(7, dtype=phase.dtype)
        rows = []
        for order in range(4):
            factor = torch.ones_like(powers)
            for k in range(order):
                factor = factor * (powers - k)
            rows.append(factor)
        at_end = torch.stack(rows)
        known = torch.stack(first)
        others = torch.linalg.solve(at_end[:, 3:], -(at_end[:, :3] @ known.flatten(1))).unflatten(1, known.shape[1:])
        self.end, self.coefficients = end, torch.cat([known, others])

    def __call__(self, time: Tensor) -> Tensor:
        s = (time / self.arrival).clamp(max=1).unsqueeze(-1)
        path = self.coefficients[-1]
        for coefficient in reversed(self.coefficients[:-1]):
            path = path * s + coefficient
        path = path + self.end
        sink = _smooth_step((time - self.arrival) / _SINKING_S) * (_ABOVE_M - _HOVER_M)
        swelling = _smooth_step(time / self.arrival) * _SWAY * (_ABOVE_M - sink)
        sway = [swelling * torch.sin(rate * time + self.phase[:, k]) for k, rate in enumerate(_SWAY_RAD_S)]
        return path + torch.stack([*sway, -sink], -1)


def _smooth_step(s: Tensor) -> Tensor:
    """From 0 to 1 as s does, three derivatives are zero at both ends."""
    s = s.clamp(0, 1)
    return s**4 * (35 + s * (-84 + s * (70 - 20 * s)))


def _attitude(force: Tensor, yaw: Tensor) -> Tensor:
    """Quaternions (..., 4): turned by yaw about the vertical, then by the shortest way until body z is along force."""
    x, y, z = normalize(force, dim=-1).unbind(-1)
    tilt = normalize(torch.stack([-y, x, torch.zeros_like(x), 1 + z], -1), dim=-1)
    turn = torch.stack([torch.zeros_like(yaw), torch.zeros_like(yaw), torch.sin(yaw / 2), torch.cos(yaw / 2)], -1)
    return multiply(tilt, turn)


# Camera ---------------------------------------------------------------------------------------------------------------


def _look(settings: LandingSettings, seeds: list[int], truth: Tensor) -> tuple[Tensor, Tensor]:
    """What the camera shows, (t, R, 2), and the steps (R,) at which the beacon itself is first seen."""
    camera = Beacon(BEACON_SD_RAD)
    noise = seeded_normals(seeds, (settings.steps, 2), _BEACON)
    chance = torch.special.ndtr(seeded_normals(seeds, (settings.steps, 4), _CHANCE))
    kept = chance[..., 0] >= settings.dropout
    seen = camera.in_view(truth) & kept
    if settings.scenario == "false-source":
        seen[:_SWITCHED_ON_STEP] = False
    false = seen & (chance[..., 1] < settings.outlier_share)
    anywhere = (2 * chance[..., 2:] - 1) * chance.new_tensor(camera.limits)
    sight = torch.where(false.unsqueeze(-1), anywhere, camera(truth).sample(noise))
    sight = torch.where(seen.unsqueeze(-1), sight, torch.nan)
    acquired = (seen & ~false).int().argmax(0)
    if settings.scenario == "false-source":
        first = seen.int().argmax(0)  # an outlier may come before
        sight = _with_false_source(sight, truth, first, kept, noise)
    return sight, acquired


def _with_false_source(sight: Tensor, truth: Tensor, first: Tensor, kept: Tensor, noise: Tensor) -> Tensor:
    """Sights with a second on which a bright source on the ground is seen as the pad is, from any distance.

    It lies where the camera looks in the middle of the second, at least 4 m from the pad.
    """
    camera = Beacon(BEACON_SD_RAD, range_m=math.inf)
    begin = first - FALSE_LEAD_STEPS
    middle = truth[begin + FALSE_STEPS // 2, torch.arange(len(first))]
    position = middle[:, 7:10]
    down = rotate(middle[:, :4], position.new_tensor([0, 0, -1]).expand_as(position))
    ground = position - down * (position[:, 2:] / down[:, 2:])
    away = torch.linalg.vector_norm(ground, dim=-1, keepdim=True)
    ground = ground * (_FALSE_AWAY_M / away).clamp(min=1)
    shifted = truth - pad(ground, (7, truth.shape[-1] - 10))
    step = torch.arange(len(truth)).unsqueeze(-1)
    on = (step >= begin) & (step < begin + FALSE_STEPS) & kept & camera.in_view(shifted)
    return torch.where(on.unsqueeze(-1), camera(shifted).sample(noise), sight)
