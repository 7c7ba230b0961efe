"""Dynamics learned from the first hours: two nominal laws and what Gaussian processes add to them."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchfilt.gp.frozen import FrozenGP
from torchfilt.gp.transition import GPTransition
from torchfilt.io.grace import EARTH_RATE_RAD_S
from torchfilt.missions.grace.data import MU_M3_S2, GraceData, nominal_law, residual
from torchfilt.missions.grace.potential_gp import PotentialTransition, fit_potential
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.stages import Arrays, Stages
from torchfilt.models.relative_motion import TwoBody, phase, to_curvilinear
from torchfilt.storage import IntegrityError

Say = Callable[[str], None]
POINT_MASS, J2, POTENTIAL = "two-body", "j2", "j2-potential-gp"
# Nominal laws and the phase GPs that learn their residual.
PHASE = {POINT_MASS: "two-body-phase-gp", J2: "j2-phase-gp"}


class Dynamics(NamedTuple):
    """A transition law with the controls it reads, (s, k), and what its training said (JSON-ready)."""

    law: nn.Module
    controls: Tensor
    training: dict[str, Any]


def learn(
    data: GraceData,
    settings: GraceSettings,
    *,
    stages: Stages | None = None,
    say: Say = lambda line: None,
    progress: bool | None = False,
) -> dict[str, Dynamics]:
    """Learn all laws from the training hours.

    Args:
        data: the whole day; only the training hours are used, but for the chief's orbit, which is known.
        settings: of the run.
        stages: keeps what was learned, and gives it back to the same settings.
        say: receives a line for each learned law.
        progress: show a bar for each training; None: on a terminal only.

    Returns:
        Laws by name: nominal "two-body" and "j2", each with a phase GP on top, and "j2-potential-gp".
    """
    stages = stages or Stages(None)
    result = nominal_dynamics(data, settings)
    for nominal, name in PHASE.items():
        result[name] = learn_phase(data, settings, nominal, stages, progress)
        say(f"{name}: {_words(result[name].training)}")
    result[POTENTIAL] = learn_potential(data, settings, stages)
    say(f"{POTENTIAL}: {_words(result[POTENTIAL].training)}")
    return result


def _words(training: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value:.4g}" for key, value in training.items() if isinstance(value, (int, float)))


def nominal_dynamics(data: GraceData, settings: GraceSettings) -> dict[str, Dynamics]:
    """The two nominal laws, each with a white acceleration of the size of its own one-step errors in training."""
    result = {}
    for name in PHASE:
        missed = residual(data, _nominal(name, 0.0, settings), settings.step_s)[: settings.training_steps]
        psd = float(missed[:, 3:].square().mean()) / settings.step_s
        result[name] = Dynamics(_nominal(name, psd, settings), data.controls, {"psd_m2_s3": psd})
    return result


def learn_phase(
    data: GraceData,
    settings: GraceSettings,
    nominal: str,
    stages: Stages | None = None,
    progress: bool | None = False,
) -> Dynamics:
    """Residual of a nominal law by the structured kernel, affine in the state and periodic in the argument of latitude.

    Trained by Lightning. Its noise is what it learned: the nominal law has none of its own here.
    """
    stages = stages or Stages(None)
    path = stages.path(PHASE[nominal], settings.recipe("seed"))
    law = _nominal(nominal, 0.0, settings)
    if path is not None and path.is_file():
        try:
            gp = FrozenGP.load(path)
            return Dynamics(GPTransition(gp, law, context=phase), data.controls, gp.settings["training"])
        except IntegrityError as error:
            stages.say(f"{error}; trained again")
    from torchfilt.learning import train_transition

    count = settings.training_steps
    learned, report = train_transition(
        data.states[:count],
        data.controls[:count],
        data.states[1 : count + 1],
        law,
        dt=settings.step_s,
        context=phase,
        kernel="structured",
        seed=settings.seed,
        progress=progress,
    )
    training = {"loss": report.loss, "epochs": report.epochs, "seconds": report.seconds, "samples": report.samples}
    learned.gp.settings["training"] = training
    if path is not None:
        learned.gp.save(path)
    return Dynamics(learned, data.controls, training)


def learn_potential(data: GraceData, settings: GraceSettings, stages: Stages | None = None) -> Dynamics:
    """Residual of J2 motion by the kernel of a random potential outside the Earth."""
    stages = stages or Stages(None)
    kept = stages.get(POTENTIAL, settings.recipe("degree"), lambda: _fit_and_collapse(data, settings))
    training = {name: float(kept[name]) for name in ("scale", "psd_m2_s3", "loss", "seconds")}
    law = PotentialTransition(_nominal(J2, training["psd_m2_s3"], settings), settings.step_s)
    training |= {"degree": settings.degree, "samples": settings.training_steps}
    return Dynamics(law, torch.from_numpy(kept["controls"]), training)


def _fit_and_collapse(data: GraceData, settings: GraceSettings) -> Arrays:
    """Hyperparameters and the controls of the whole day."""
    begin = time.perf_counter()
    count = settings.training_steps
    rows = slice(0, count * settings.stride + 1)
    chief, relative = data.chief.rows(rows), data.relative[rows]
    radius = torch.linalg.vector_norm(chief.position_m, dim=-1)
    gp, fit = fit_potential(
        chief,
        relative,
        residual(data, _nominal(J2, 0.0, settings), settings.step_s)[:count],
        stride=settings.stride,
        degree=settings.degree,
        mu_m3_s2=MU_M3_S2,
        earth_rate_rad_s=EARTH_RATE_RAD_S,
        reference_m=to_curvilinear(relative, radius)[:, :3].mean(0),
    )
    controls = gp.controls(data.chief, stride=settings.stride).numpy()
    numbers = {name: np.array(value) for name, value in fit._asdict().items()}
    return {"controls": controls, **numbers, "seconds": np.array(time.perf_counter() - begin)}


def _nominal(name: str, psd_m2_s3: float, settings: GraceSettings) -> TwoBody:
    return nominal_law(psd_m2_s3, j2=name == J2, step_s=settings.step_s)
