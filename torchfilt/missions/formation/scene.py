"""The formation study: two satellites with J2-J4 and drag, a rendezvous radar, and the filters that are compared.

A `Scene` is what happens (truth, measurements of all runs as one batch, prior), a dynamics GP is what was learned, and
`make_filter` puts the two together under the name of a filter.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.filters.gaussian import UnscentedKalmanFilter
from torchfilt.filters.particle import ParticleFilter
from torchfilt.filters.particle_methods import BootstrapFilter, UnscentedParticleFilter
from torchfilt.gaussian import Gaussian
from torchfilt.gp.frozen import FrozenGP
from torchfilt.gp.transition import GPTransition
from torchfilt.laws import LinearGaussian
from torchfilt.missions.bound import cramer_rao_bound
from torchfilt.missions.formation.literal import literal_proposal
from torchfilt.model import StateSpaceModel
from torchfilt.models.relative_motion import (
    CONTROL_SIZE,
    ClohessyWiltshire,
    FormationSettings,
    HarmonicForce,
    RendezvousRadar,
    TwoBody,
    chief_controls,
    cw_input,
    cw_transition,
    phase,
    simulate_formation,
    training_pairs,
)
from torchfilt.models.relative_motion.high_fidelity import ExactFormation
from torchfilt.models.relative_motion.transforms import block_diagonal
from torchfilt.noise import NoiseSource
from torchfilt.resampling import ess_below
from torchfilt.run import Filter

LATENT = "latent-force-ukf"
FILTERS = ("cw-pf", "cw-pf-paper-noise", "cw-ukf", "gp-ukf", "mf-upf", "mf-upf-literal", LATENT, "exact-ukf")
LEARNED = ("gp-ukf", "mf-upf", "mf-upf-literal")
Case = Literal["nominal", "moved", "wide", "control", "leak"]
CASES: dict[Case, str] = {
    "nominal": "the study's formation; prior 1 m, 0.01 m/s",
    "moved": "the same filters from a start 20 m away on each axis, without training there",
    "wide": "prior of 100 m and 1 m/s",
    "control": "the deputy fires its thrusters; the filters know the thrust",
    "leak": "no known dynamics, training on the very trajectory that is then tracked: memorised, not learned",
}
# Purposes of random numbers, keys of the noise source.
_START, _RADAR = 0, 1
# A revolution of which less was seen gives no numbers.
_LEAST_EPOCHS = 20
MOVED_M = 20.0
THRUST_M_S2 = 1e-4
# Prior deviation of each coefficient of the unknown force, the size of what Clohessy-Wiltshire motion lacks, and the
# noise beside the harmonics.
LATENT_SD_M_S2 = 3e-6
LATENT_PSD_M2_S3 = 1e-12


@dataclass(frozen=True)
class StudySettings:
    """What a study depends on; the same values give the same numbers.

    Attributes:
        runs: Monte-Carlo runs, one batch. seed: of radar noise, initial errors and particles.
        case: see `CASES`.
        particles: of the unscented particle filters. bootstrap_particles: of the bootstrap filters.
        samples: training pairs. training_seed: of their deviations.
        steps: measurements, 10 s apart; 1166 are two revolutions.
        gp_psd_m2_s3: acceleration noise beside the GP's own variance. The one-step errors of the GP (6e-10 m/s) repeat
            over a quarter of a revolution, which as white noise is (6e-10)^2 * 150 / 10 s = 5e-18; twenty times that
            leaves room. With 1e-15 the GP-UKF's NEES on the second revolution is 3.7 instead of 4.3 (40 runs).
        cw_psd_m2_s3: acceleration noise tuned for Clohessy-Wiltshire motion.
        step_noise_m, step_noise_m_s: standard deviations a step of independent noise on each coordinate, the form in
            which the study gives its R^w.
    """

    runs: int = 10
    seed: int = 0
    case: Case = "nominal"
    particles: int = 100
    bootstrap_particles: int = 2000
    samples: int = 500
    training_seed: int = 0
    steps: int = 1166
    gp_psd_m2_s3: float = 1e-16
    cw_psd_m2_s3: float = 3e-9
    step_noise_m: float = 0.01
    step_noise_m_s: float = 1e-3

    def __post_init__(self) -> None:
        if self.case not in CASES:
            raise ValueError(f"case must be one of {', '.join(CASES)}, got {self.case!r}")
        least = {"runs": 1, "particles": 8, "bootstrap_particles": 2, "samples": 20, "steps": 1}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(f"{name} must be at least {bound}, got {getattr(self, name)}")
        for name in ("gp_psd_m2_s3", "cw_psd_m2_s3", "step_noise_m", "step_noise_m_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("seed", "training_seed"):
            if not 0 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be from 0 to 2147483647, got {getattr(self, name)}")

    @property
    def prior_sd(self) -> tuple[float, float]:
        """Of each position and velocity coordinate, m and m/s."""
        return (100.0, 1.0) if self.case == "wide" else (1.0, 0.01)

    def formation(self) -> FormationSettings:
        """Orbit and start of this case."""
        base = FormationSettings()
        return replace(base, relative_start=_moved(base)) if self.case == "moved" else base

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


class Scene(NamedTuple):
    """What happens.

    time_s (t,) of the measurements; states (t + 1, 6) true Hill states, the first at time zero; controls (t, 21);
    measurements (t, R, 3); prior: means (R, 6) drawn around the true start, one covariance; formation: forces.
    """

    time_s: Tensor
    states: Tensor
    controls: Tensor
    measurements: Tensor
    prior: Gaussian
    formation: FormationSettings

    @property
    def truth(self) -> Tensor:
        """True states at the measurements (t, 6)."""
        return self.states[1:]

    def revolutions(self) -> dict[str, Tensor]:
        """Masks (t,) of the revolutions that were reached; the first 1000 s, the transient, are left out."""
        period = self.formation.period_s
        count = max(1, round(float(self.time_s[-1]) / period))
        masks = {}
        for k in range(count):
            begin = max(1000.0, k * period)
            masks[f"orbit{k + 1}"] = (self.time_s > begin) & (self.time_s <= (k + 1) * period)
        return {name: mask for name, mask in masks.items() if int(mask.sum()) >= _LEAST_EPOCHS}


def make_scene(settings: StudySettings) -> Scene:
    """Simulate truth, radar and initial errors of all runs."""
    formation = settings.formation()
    time = torch.arange(settings.steps + 1, dtype=torch.float64) * formation.step_s
    thrust = _thrust(time[:-1], formation) if settings.case == "control" else None
    truth = simulate_formation(formation, time, thrust_m_s2=thrust)
    states, source = truth.relative_m_m_s, NoiseSource(settings.seed)
    # The radar sees the true geometry, whose chief is up to 14 km lower than the filters' circle.
    radius = torch.linalg.vector_norm(truth.chief.position_m[1:], dim=-1)
    law = RendezvousRadar(radius.unsqueeze(-1))(states[1:].unsqueeze(1).expand(-1, settings.runs, -1))
    measurements = law.sample(source.normal((settings.steps, settings.runs, 3), 0, _RADAR, states))
    deviation = torch.tensor(settings.prior_sd, dtype=torch.float64).repeat_interleave(3)
    start = states[0] + deviation * source.normal((settings.runs, 6), 0, _START, states)
    prior = Gaussian(start, torch.diag(deviation))
    return Scene(time[1:], states, chief_controls(truth.chief, thrust), measurements, prior, formation)


def _moved(base: FormationSettings) -> tuple[float, float, float, float, float, float]:
    """Start 20 m away on each axis, on another closed ellipse (no drift along the track)."""
    shift = [MOVED_M, MOVED_M, MOVED_M, 0.0, -2 * base.mean_motion_rad_s * MOVED_M, 0.0]
    x, y, z, vx, vy, vz = (base.deputy_start() + torch.tensor(shift, dtype=torch.float64)).tolist()
    return x, y, z, vx, vy, vz


def _thrust(time: Tensor, formation: FormationSettings) -> Tensor:
    """Burns of 200 s and their undoing on the three axes in turn, (t, 3), Hill axes, m/s^2."""
    burn = (time / 200).floor().long()
    axis = torch.nn.functional.one_hot((burn // 2) % 3, 3).to(time)
    sign = torch.where(burn % 2 == 0, 1.0, -1.0).unsqueeze(-1)
    return THRUST_M_S2 * sign * axis


def train_gp(
    settings: StudySettings, progress: bool | None = False, stop: Callable[[], bool] | None = None
) -> tuple[FrozenGP, dict[str, Any]]:
    """Learn the one-step map.

    The pairs come from the study's own formation whatever the case: the GP was not trained at the start of "moved".
    The case "leak" takes the study's form: samples of the trajectory itself, no nominal dynamics, no phase. Such a GP
    turns every state back to the curve it remembers.

    Returns:
        Frozen GP and a report: seconds, one-step error and honesty on a cloud of other draws, free roll-outs.
    """
    from torchfilt.learning import one_step_error, roll_out_error, train_transition

    formation = FormationSettings()
    leak = settings.case == "leak"
    x, u, x_next = training_pairs(
        formation, "trajectory" if leak else "cloud", settings.samples, seed=settings.training_seed
    )
    nominal = None if leak else TwoBody(settings.gp_psd_m2_s3)
    law, report = train_transition(
        x,
        u,
        x_next,
        nominal,
        dt=formation.step_s,
        context=None if leak else phase,
        target="identity" if leak else "residual",
        kernel="ard" if leak else "structured",
        noise_floor=1e-4 if leak else 1e-5,
        calibrate=not leak,
        seed=settings.training_seed,
        progress=progress,
        stop=stop,
    )
    test = training_pairs(formation, "cloud", 300, seed=settings.training_seed + 1_000_003)
    groups = {"position_m": slice(0, 3), "velocity_m_s": slice(3, 6)}
    time = torch.arange(0.0, formation.period_s, formation.step_s, dtype=torch.float64)
    truth = simulate_formation(formation, time)
    summary = {
        "seconds": report.seconds,
        "interrupted": report.interrupted,
        "one_step": one_step_error(law, *test, formation.step_s).summary(groups),
        "roll_out_one_revolution_m": roll_out_error(
            law, truth.relative_m_m_s, chief_controls(truth.chief), formation.step_s
        ),
    }
    return law.gp, summary


def learned_law(gp: FrozenGP, settings: StudySettings) -> GPTransition:
    """Transition of a GP made by `train_gp` (or read from its file)."""
    if settings.case == "leak":
        return GPTransition(gp)
    return GPTransition(gp, TwoBody(settings.gp_psd_m2_s3), context=phase)


def linear_law(settings: StudySettings, formation: FormationSettings) -> ClohessyWiltshire:
    """Clohessy-Wiltshire motion with the tuned acceleration noise."""
    return ClohessyWiltshire(formation.mean_motion_rad_s, settings.cw_psd_m2_s3, formation.step_s)


def step_noise_law(settings: StudySettings, formation: FormationSettings) -> LinearGaussian:
    """Clohessy-Wiltshire motion with independent noise on each coordinate, as the study has it."""
    n = torch.tensor(formation.mean_motion_rad_s, dtype=torch.float64)
    dt = torch.tensor(formation.step_s, dtype=torch.float64)
    deviation = torch.tensor([settings.step_noise_m, settings.step_noise_m_s], dtype=torch.float64).repeat_interleave(3)
    push = pad(cw_input(n, dt), (0, CONTROL_SIZE - 3))
    return LinearGaussian(cw_transition(n, dt), scale_tril=torch.diag(deviation), control_matrix=push)


def make_filter(name: str, scene: Scene, settings: StudySettings, gp: FrozenGP | None = None) -> Filter[Any]:
    """A filter of the study by its name.

    Args:
        name: one of `FILTERS`.
        scene: gives prior and forces.
        settings: particles and noise.
        gp: for the filters in `LEARNED`.

    Raises:
        ValueError: unknown name, or a learned filter without its GP.
    """
    if name not in FILTERS:
        raise ValueError(f"filter must be one of {', '.join(FILTERS)}, got {name!r}")
    if name in LEARNED and gp is None:
        raise ValueError(f"{name} needs the GP that train_gp makes")
    if name == LATENT:
        return _latent_force_filter(scene)
    transition: nn.Module
    if name in LEARNED:
        assert gp is not None
        transition = learned_law(gp, settings)
    elif name == "exact-ukf":
        transition = ExactFormation(scene.formation)
    elif name == "cw-pf-paper-noise":
        transition = step_noise_law(settings, scene.formation)
    else:
        transition = linear_law(settings, scene.formation)
    model = StateSpaceModel(scene.prior, transition, RendezvousRadar(scene.formation.semi_major_axis_m))
    if name.endswith("ukf"):
        return UnscentedKalmanFilter(model)
    if name.startswith("cw-pf"):
        return BootstrapFilter(model, settings.bootstrap_particles)
    if name == "mf-upf-literal":
        return ParticleFilter(model, settings.particles, literal_proposal(), ess_below(0.5))
    return UnscentedParticleFilter(model, settings.particles)


def _latent_force_filter(scene: Scene) -> Filter[Any]:
    """No training states: what Clohessy-Wiltshire motion lacks is estimated on the way, in harmonics of the phase."""
    formation = scene.formation
    law = HarmonicForce(ClohessyWiltshire(formation.mean_motion_rad_s, LATENT_PSD_M2_S3, formation.step_s), order=3)
    mean = pad(scene.prior.mean, (0, law.force_size))
    force = torch.full((law.force_size,), LATENT_SD_M_S2, dtype=torch.float64)
    factor = block_diagonal(scene.prior.factor(), torch.diag(force))
    radar = RendezvousRadar(formation.semi_major_axis_m)
    model = StateSpaceModel(Gaussian(mean, factor), law, lambda x: radar(x[..., :6]))
    return UnscentedKalmanFilter(model)


def scene_bound(scene: Scene) -> Tensor:
    """Cramér-Rao bound of the scene, covariances (t, 6, 6); `cramer_rao_bound` with the true dynamics."""
    return cramer_rao_bound(
        ExactFormation(scene.formation),
        RendezvousRadar(scene.formation.semi_major_axis_m),
        scene.prior.factor(),
        scene.states,
        scene.controls,
        scene.formation.step_s,
    )
