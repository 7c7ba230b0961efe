"""Dynamics learned from the first hours: two nominal laws and what Gaussian processes add to them."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfilt.io.grace import EARTH_RATE_RAD_S
from torchfilt.missions.grace.data import MU_M3_S2, GraceData, nominal_law, residual
from torchfilt.missions.grace.potential_gp import PotentialTransition, fit_potential
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.models.relative_motion import TwoBody, phase, to_curvilinear

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
    data: GraceData, settings: GraceSettings, *, out: str | Path | None = None, say: Say = lambda line: None
) -> dict[str, Dynamics]:
    """Learn all laws from the training hours.

    Args:
        data: the whole day; only the training hours are used, but for the chief's orbit, which is known.
        settings: of the run.
        out: folder for the phase GPs' checkpoints and logs, or None.
        say: receives a line for each learned law.

    Returns:
        Laws by name: nominal "two-body" and "j2", each with a phase GP on top, and "j2-potential-gp".
    """
    result = nominal_dynamics(data, settings)
    for nominal, name in PHASE.items():
        result[name] = learn_phase(data, settings, nominal, None if out is None else Path(out) / name)
        say(f"{name}: {_words(result[name].training)}")
    result[POTENTIAL] = learn_potential(data, settings)
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


def learn_phase(data: GraceData, settings: GraceSettings, nominal: str, folder: Path | None = None) -> Dynamics:
    """Residual of a nominal law by the structured kernel, affine in the state and periodic in the argument of latitude.

    Trained by Lightning. Its noise is what it learned: the nominal law has none of its own here.
    """
    from torchfilt.learning import train_transition

    count = settings.training_steps
    law, report = train_transition(
        data.states[:count],
        data.controls[:count],
        data.states[1 : count + 1],
        _nominal(nominal, 0.0, settings),
        dt=settings.step_s,
        context=phase,
        kernel="structured",
        seed=settings.seed,
        run_dir=folder,
        progress=False,
    )
    training = {"loss": report.loss, "epochs": report.epochs, "seconds": report.seconds, "samples": report.samples}
    return Dynamics(law, data.controls, training)


def learn_potential(data: GraceData, settings: GraceSettings) -> Dynamics:
    """Residual of J2 motion by the kernel of a random potential outside the Earth."""
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
    controls = gp.controls(data.chief, stride=settings.stride)
    law = PotentialTransition(_nominal(J2, fit.psd_m2_s3, settings), settings.step_s)
    training = {**fit._asdict(), "degree": gp.degree, "samples": count, "seconds": time.perf_counter() - begin}
    return Dynamics(law, controls, training)


def _nominal(name: str, psd_m2_s3: float, settings: GraceSettings) -> TwoBody:
    return nominal_law(psd_m2_s3, j2=name == J2, step_s=settings.step_s)
