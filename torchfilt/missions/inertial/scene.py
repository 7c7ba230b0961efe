"""The SINS/SAR study: a reconnaissance flight, an inertial system that drifts, and fixes of position and heading.

A `Scene` is what happens (the system's own computations, its true errors and the fixes, all runs as one batch);
`make_filter` puts a scene's model together under the name of a filter.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.filters.gaussian import CubatureKalmanFilter, ErrorStateKalmanFilter
from torchfilt.filters.mixture import GaussianSumFilter
from torchfilt.filters.particle_methods import (
    BootstrapFilter,
    RaoBlackwellizedParticleFilter,
    RegularizedParticleFilter,
    ResampleMoveParticleFilter,
)
from torchfilt.gaussian import Gaussian
from torchfilt.kernels import Regularize
from torchfilt.mixture import InitialMixture, split_gaussian
from torchfilt.model import StateSpaceModel
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.error_model import (
    InertialErrorFixes,
    InertialErrorTransition,
    add_error,
    error_of,
    sins_inputs,
    start_law,
)
from torchfilt.models.inertial.flight import fly, reconnaissance
from torchfilt.models.inertial.imu import (
    MEMS,
    MEMS_START,
    TACTICAL,
    TACTICAL_START,
    ImuGrade,
    StartErrors,
    measure,
    seeded_normals,
)
from torchfilt.models.inertial.strapdown import Navigation
from torchfilt.moments import taylor
from torchfilt.run import Filter

Scenario = Literal["sins-sar", "mems", "heading-unknown", "outliers"]
SCENARIOS: dict[Scenario, str] = {
    "sins-sar": "tactical sensors, fixes of heading, position and height every second",
    "mems": "micromachined sensors and a start to match",
    "heading-unknown": "heading off by 60 deg, tilt by 10', drift of 1 deg/h, and no heading fix",
    "outliers": "15 % of the fixes with ten times their noise, which the particle filters' law knows",
}
ARC_MINUTE = math.radians(1 / 60)
IMU_RATE_HZ = 100
# Purposes of random numbers, keys of the noise source.
_START, _IMU, _FIX, _OUTLIER = range(4)
# Members of a bank of Gaussian filters, where the heading is unknown 10 deg of it apart; and which error that is.
_BANK, _HEADING = 36, 2
"""Share of the fixes that are outliers, and how many times their noise is larger."""
OUTLIER_SHARE, OUTLIER_FACTOR = 0.15, 10.0


@dataclass(frozen=True)
class InertialSettings:
    """What is flown and how well it is tracked.

    runs: Monte-Carlo runs, one batch; steps: fixes, one a second; particles: of the particle filters, but for
    ``conditional_particles`` of the Rao-Blackwellised one; window: states that the trajectory moves look back on.

    Raises:
        ValueError: unknown scenario, numbers out of range.
    """

    scenario: Scenario = "sins-sar"
    runs: int = 8
    seed: int = 0
    steps: int = 1000
    particles: int = 2000
    conditional_particles: int = 1000
    window: int = 5
    position_sd_m: float = 10.0
    height_sd_m: float = 10.0
    heading_sd_rad: float = 6 * ARC_MINUTE

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}, got {self.scenario!r}")
        if not 1 <= self.steps <= 1000:
            raise ValueError(f"steps must be from 1 to 1000, the length of the flight in s, got {self.steps}")
        for name, least in (("runs", 1), ("particles", 17), ("conditional_particles", 2), ("window", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")

    @property
    def grade(self) -> ImuGrade:
        """Of the sensors."""
        if self.scenario == "heading-unknown":
            return replace(TACTICAL, gyro_bias_sd_rad_s=math.radians(1) / 3600)
        return MEMS if self.scenario == "mems" else TACTICAL

    @property
    def start(self) -> StartErrors:
        """What navigation starts with."""
        if self.scenario == "heading-unknown":
            return replace(TACTICAL_START, attitude_sd_rad=(10 * ARC_MINUTE, 10 * ARC_MINUTE, math.radians(60)))
        return MEMS_START if self.scenario == "mems" else TACTICAL_START

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


class Scene(NamedTuple):
    """A flight with its runs.

    truth: error states (t, R, 16) after each step; fixes: computed minus fix, heading (rad), east, north, up (m),
    (t, R, 4); controls (t, R, 20); flight: true navigation, leading dim t; sins: computed navigation, leading dims
    (t, R); model: the three laws; heavy: the same with the outliers in its measurement law, else the same object.
    """

    truth: Tensor
    fixes: Tensor
    controls: Tensor
    flight: Navigation
    sins: Navigation
    model: StateSpaceModel
    heavy: StateSpaceModel


def make_scene(settings: InertialSettings) -> Scene:
    """Fly, measure and let the inertial system drift; each run's numbers depend on its own seed alone."""
    seeds = [settings.seed + k for k in range(settings.runs)]
    flight = fly(reconnaissance(), torch.arange(settings.steps * IMU_RATE_HZ + 1, dtype=torch.float64) / IMU_RATE_HZ)
    first = Navigation(*(part[0] for part in flight.navigation))
    origin = LocalMetres(*(float(part) for part in first[2:]))
    prior = start_law(settings.start, settings.grade)
    error = prior.sample(seeded_normals(seeds, (1, 15), _START)[0])
    drift, bias = error[..., 10:13], error[..., 13:16]
    imu = measure(
        flight.dtheta_rad,
        flight.dvelocity_m_s,
        1 / IMU_RATE_HZ,
        settings.grade,
        drift,
        bias,
        seeded_normals(seeds, (len(flight.dtheta_rad), 6), _IMU),
    )
    run = sins_inputs(add_error(first, error, origin), *imu, 1 / IMU_RATE_HZ, samples=IMU_RATE_HZ)
    true = Navigation(*(part[IMU_RATE_HZ::IMU_RATE_HZ].unsqueeze(1) for part in flight.navigation))
    truth = error_of(run.navigation, true, origin, drift, bias)
    model, heavy = _models(settings, origin, prior)
    law = model.conditional("observation", truth, run.u)
    noise = seeded_normals(seeds, (settings.steps, 4), _FIX)
    if settings.scenario == "outliers":
        picked = torch.special.ndtr(seeded_normals(seeds, (settings.steps, 1), _OUTLIER)) < OUTLIER_SHARE
        noise = torch.where(picked, OUTLIER_FACTOR * noise, noise)
    assert isinstance(law, Gaussian)
    fixes = law.sample(noise)
    if settings.scenario == "heading-unknown":
        fixes[..., 0] = torch.nan
    return Scene(truth, fixes, run.u, Navigation(*(part.squeeze(1) for part in true)), run.navigation, model, heavy)


def _models(
    settings: InertialSettings, origin: LocalMetres, prior: Gaussian
) -> tuple[StateSpaceModel, StateSpaceModel]:
    grade = settings.grade
    transition = InertialErrorTransition(
        origin, grade.angle_random_walk_rad_sqrt_s, grade.velocity_random_walk_m_s_sqrt_s
    )
    deviations = (settings.heading_sd_rad, settings.position_sd_m, settings.height_sd_m)
    model = StateSpaceModel(prior, transition, InertialErrorFixes(*deviations))
    if settings.scenario != "outliers":
        return model, model
    law = InertialErrorFixes(*deviations, outlier_share=OUTLIER_SHARE, outlier_factor=OUTLIER_FACTOR)
    return model, StateSpaceModel(prior, transition, law)


# ----------------------------------------------------------------------------------------------------------------------
# Filters by name


def _filters(scene: Scene, settings: InertialSettings) -> dict[str, Callable[[], Filter[Any]]]:
    n, model, heavy = settings.particles, scene.model, scene.heavy
    attitude = range(3)
    return {
        "es-kf": lambda: ErrorStateKalmanFilter(model),
        "es-kf-gated": lambda: ErrorStateKalmanFilter(model, gate=0.999),
        "es-kf-open": lambda: ErrorStateKalmanFilter(model, feedback=False),
        "ckf": lambda: CubatureKalmanFilter(model),
        "bank-36": lambda: _bank(model),
        "sir": lambda: BootstrapFilter(heavy, n),
        "rpf-plain": lambda: RegularizedParticleFilter(heavy, n, Regularize(keep_moments=False)),
        "rpf": lambda: RegularizedParticleFilter(heavy, n),
        "mpf": lambda: ResampleMoveParticleFilter(heavy, n),
        "mpf-window": lambda: ResampleMoveParticleFilter(heavy, n, window=settings.window),
        "mpf-literal": lambda: ResampleMoveParticleFilter(heavy, n, window=settings.window, target="transition"),
        "rbpf": lambda: RaoBlackwellizedParticleFilter(model, settings.conditional_particles, drawn=attitude),
        "rbpf-shared": lambda: RaoBlackwellizedParticleFilter(
            model, settings.conditional_particles, drawn=attitude, shared=True
        ),
    }


FILTERS = (
    "es-kf", "es-kf-gated", "es-kf-open", "ckf", "bank-36", "sir", "rpf-plain", "rpf", "mpf", "mpf-window",
    "mpf-literal", "rbpf", "rbpf-shared",
)  # fmt: skip
# What each scenario is about.
DEFAULT: dict[Scenario, tuple[str, ...]] = {
    "sins-sar": (
        "es-kf",
        "es-kf-open",
        "ckf",
        "sir",
        "rpf-plain",
        "rpf",
        "mpf",
        "mpf-window",
        "mpf-literal",
        "rbpf",
        "rbpf-shared",
    ),
    "mems": ("es-kf", "es-kf-open", "ckf", "rpf", "mpf", "rbpf"),
    "heading-unknown": ("es-kf", "ckf", "bank-36", "sir", "rpf", "mpf"),
    "outliers": ("es-kf", "es-kf-gated", "sir", "rpf", "mpf"),
}


def _bank(model: StateSpaceModel) -> GaussianSumFilter:
    """Gaussians in a row over three deviations of the heading to either side, each an extended Kalman filter."""
    pieces = InitialMixture(split_gaussian(model.prior(), _BANK, _HEADING))
    return GaussianSumFilter(StateSpaceModel(pieces, model.transition, model.observation), taylor(), components=_BANK)


def make_filter(name: str, scene: Scene, settings: InertialSettings) -> Filter[Any]:
    """The filter called ``name``, one of `FILTERS`, for a scene.

    Raises:
        ValueError: unknown name.
    """
    makers = _filters(scene, settings)
    if name not in makers:
        raise ValueError(f"filter must be one of {', '.join(FILTERS)}, got {name!r}")
    return makers[name]()
