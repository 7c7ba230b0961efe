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
from torchfilt.models.relative_motion import phase, to_curvilinear

Say = Callable[[str], None]
# Phase GPs are trained by these names: point mass or flattened Earth as the nominal law.
_PHASE = {"two-body": "two-body + phase GP", "J2": "J2 + phase GP"}
POTENTIAL = "J2 + potential GP"


class Dynamics(NamedTuple):
    """A transition law with the controls it reads, (s, k), and what its training said (JSON-ready)."""

    law: nn.Module
    controls: Tensor
    training: dict[str, Any]


def learn(
    data: GraceData, settings: GraceSettings, *, out: str | Path | None = None, say: Say = lambda line: None
) -> dict[str, Dynamics]:
    """Learn from the training hours.

    Each law's process noise is a white acceleration of the size of its own one-step errors in those hours; the GPs'
    uncertainty comes on top.

    Args:
        data: the whole day; only the training hours are used, but for the chief's orbit, which is known.
        settings: of the run.
        out: folder for the phase GPs' checkpoints and logs, or None.
        say: receives a line for each law.

    Returns:
        Laws by name: the nominal "two-body" and "J2", each with a phase GP, and "J2 + potential GP".
    """
    result: dict[str, Dynamics] = {}
    for name in _PHASE:
        missed = residual(data, nominal_law(0.0, j2=name == "J2", step_s=settings.step_s), settings.step_s)
        psd = float(missed[: settings.training_steps, 3:].square().mean()) / settings.step_s
        law = nominal_law(psd, j2=name == "J2", step_s=settings.step_s)
        result[name] = Dynamics(law, data.controls, {"psd_m2_s3": psd})
    result[POTENTIAL] = _potential(data, settings)
    say(f"{POTENTIAL}: {_words(result[POTENTIAL].training)}")
    for name, learned in _PHASE.items():
        folder = None if out is None else Path(out) / learned.replace(" + ", "_").replace(" ", "_").lower()
        result[learned] = _phase(data, settings, name, folder)
        say(f"{learned}: {_words(result[learned].training)}")
    return result


def _words(training: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value:.4g}" for key, value in training.items() if isinstance(value, (int, float)))


def _phase(data: GraceData, settings: GraceSettings, nominal: str, folder: Path | None) -> Dynamics:
    """Structured kernel, affine in the state and periodic in the argument of latitude, trained by Lightning."""
    from torchfilt.learning import train_transition

    count = settings.training_steps
    law, report = train_transition(
        data.states[:count],
        data.controls[:count],
        data.states[1 : count + 1],
        # Beside the learned noise, no floor.
        nominal_law(0.0, j2=nominal == "J2", step_s=settings.step_s),
        dt=settings.step_s,
        context=phase,
        kernel="structured",
        seed=settings.seed,
        run_dir=folder,
        progress=False,
    )
    training = {"loss": report.loss, "epochs": report.epochs, "seconds": report.seconds, "samples": report.samples}
    return Dynamics(law, data.controls, training)


def _potential(data: GraceData, settings: GraceSettings) -> Dynamics:
    """Kernel of a random potential outside the Earth."""
    begin = time.perf_counter()
    count = settings.training_steps
    rows = slice(0, count * settings.stride + 1)
    chief = data.chief.rows(rows)
    missed = residual(data, nominal_law(0.0, j2=True, step_s=settings.step_s), settings.step_s)
    radius = torch.linalg.vector_norm(chief.position_m, dim=-1)
    place = to_curvilinear(data.relative[rows], radius)[:, :3].mean(0)
    gp, fit = fit_potential(
        chief,
        data.relative[rows],
        missed[:count],
        stride=settings.stride,
        degree=settings.degree,
        mu_m3_s2=MU_M3_S2,
        earth_rate_rad_s=EARTH_RATE_RAD_S,
        reference_m=place,
    )
    controls = gp.controls(data.chief, stride=settings.stride)
    law = PotentialTransition(nominal_law(fit.psd_m2_s3, j2=True, step_s=settings.step_s), settings.step_s)
    training = {**fit._asdict(), "degree": gp.degree, "samples": count, "seconds": time.perf_counter() - begin}
    return Dynamics(law, controls, training)
