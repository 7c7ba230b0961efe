"""The pair tracked from angles and a range: models, filters, scores against the precise orbits."""

import time
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchfilt.filters.gaussian import UnscentedKalmanFilter
from torchfilt.filters.particle_methods import UnscentedParticleFilter
from torchfilt.gaussian import Gaussian
from torchfilt.missions.grace.data import GraceData
from torchfilt.missions.grace.learning import J2, POTENTIAL, Dynamics
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.missions.stages import Arrays, Stages
from torchfilt.model import StateSpaceModel
from torchfilt.models.relative_motion import BiasedRanging, RendezvousRadar, WithConstant
from torchfilt.noise import NoiseSource
from torchfilt.run import Filter

FILTERS = ("nominal-ukf", "gp-ukf", "mf-upf")
CaseName = Literal["kband", "radar"]
# Purposes of random numbers, keys of the noise source.
_PRIOR, _ANGLES, _RANGE = 0, 1, 2
# Options that a filter's numbers depend on, beside the training's.
_MATTERS = (
    *("tracking_hours", "degree", "runs", "seed", "range_sd_m", "radar_range_sd_m", "angle_3sigma_deg", "prior_sd_m"),
    *("prior_sd_m_s", "bias_sd_m", "outage_minutes", "outage_starts_h"),
)
_AXES = ("radial", "along", "across")


class Tracked(NamedTuple):
    """What a filter found: mean (t, rows, d), covariance (t, rows, d, d), log_likelihood (t, rows), ess (t, rows) or
    None; cpu_s of all steps and rows together.
    """

    mean: Tensor
    covariance: Tensor
    log_likelihood: Tensor
    ess: Tensor | None
    cpu_s: float


class Case(NamedTuple):
    """What a filter is given, and what it should find.

    name: "kband", the K-band range as it was recorded with its bias in the state, or "radar", a simulated range.
    measurements (t, rows, 3), NaN where not measured; rows are the runs, and for "kband" the runs once more with
    outages. prior: means (rows, d). truth (t, 6). runs: R. outages: rows of the measurements without any.
    """

    name: CaseName
    observation: nn.Module
    measurements: Tensor
    prior: Gaussian
    truth: Tensor
    runs: int
    outages: list[range]


def simulate_case(data: GraceData, settings: GraceSettings, name: CaseName) -> Case:
    """Measurements of all runs through the tracking hours.

    Angles are simulated: of the true positions, with noise, in the true chief's axes; the filters take the chief's mean
    radius instead, which turns the axes by up to 6e-5 rad (a fifth of the default noise). Runs differ by the noise of
    angles (and simulated range) and by the prior's error; the K-band record is one.
    """
    first, count, runs = settings.training_steps, settings.tracking_steps, settings.runs
    truth = data.states[first + 1 : first + 1 + count]
    source = NoiseSource(settings.seed)
    angle_sd = torch.deg2rad(torch.tensor(settings.angle_3sigma_deg / 3, dtype=torch.float64))
    range_sd = settings.range_sd_m if name == "kband" else settings.radar_range_sd_m
    chief = torch.linalg.vector_norm(data.chief.position_m, dim=-1)[:: settings.stride]
    exact = RendezvousRadar(chief[first + 1 : first + 1 + count]).measure(truth).unsqueeze(1)
    angles = exact[..., 1:] + angle_sd * source.normal((count, runs, 2), 0, _ANGLES, truth)
    if name == "kband":
        distance = data.range_m[first + 1 : first + 1 + count, None, None].expand(-1, runs, 1)
    else:
        distance = exact[..., :1] + range_sd * source.normal((count, runs, 1), 0, _RANGE, truth)
    measurements = torch.cat([distance, angles], -1)
    deviation = torch.tensor([settings.prior_sd_m] * 3 + [settings.prior_sd_m_s] * 3, dtype=torch.float64)
    start = data.states[first] + deviation * source.normal((runs, 6), 0, _PRIOR, truth)
    radius = float(chief[: first + 1].mean())
    if name == "radar":
        radar = RendezvousRadar(radius, range_sd, angle_sd, angle_sd)
        prior = Gaussian(start, torch.diag(deviation))
        return Case(name, radar, measurements, prior, truth, runs, [])
    gaps = measurements.clone()
    for rows in settings.outage_rows:
        gaps[rows.start : rows.stop] = torch.nan
    deviation = torch.cat([deviation, deviation.new_tensor([settings.bias_sd_m])])
    mean = torch.nn.functional.pad(start, (0, 1)).repeat(2, 1)
    return Case(
        name,
        BiasedRanging(radius, range_sd, angle_sd, angle_sd),
        torch.cat([measurements, gaps], 1),
        Gaussian(mean, torch.diag(deviation)),
        truth,
        runs,
        settings.outage_rows,
    )


def make_filter(name: str, case: Case, dynamics: dict[str, Dynamics], settings: GraceSettings) -> Filter[Any]:
    """A filter by its name in `FILTERS`.

    Raises:
        ValueError: unknown name.
    """
    if name not in FILTERS:
        raise ValueError(f"filter must be one of {', '.join(FILTERS)}, got {name!r}")
    transition = _dynamics_of(name, dynamics).law
    if case.name == "kband":
        transition = WithConstant(transition)
    model = StateSpaceModel(case.prior, transition, case.observation)
    return UnscentedParticleFilter(model, settings.particles) if name == "mf-upf" else UnscentedKalmanFilter(model)


def _dynamics_of(name: str, dynamics: dict[str, Dynamics]) -> Dynamics:
    return dynamics[J2 if name == "nominal-ukf" else POTENTIAL]


def track(
    name: str,
    case: Case,
    dynamics: dict[str, Dynamics],
    settings: GraceSettings,
    *,
    stages: Stages | None = None,
    progress: bool = False,
) -> Tracked:
    """Run one filter through the tracking hours, or read what ``stages`` kept of the same run."""
    recipe = settings.recipe(*_MATTERS, *(("particles",) if name == "mf-upf" else ()))
    arrays = (stages or Stages(None)).get(
        f"{name}-{case.name}", recipe, lambda: _run_filter(name, case, dynamics, settings, progress)
    )
    mean, covariance, log_likelihood = (torch.from_numpy(arrays[key]) for key in ("mean", "covariance", "evidence"))
    ess = torch.from_numpy(arrays["ess"]) if "ess" in arrays else None
    return Tracked(mean, covariance, log_likelihood, ess, float(arrays["cpu_s"]))


@torch.no_grad()
def _run_filter(
    name: str, case: Case, dynamics: dict[str, Dynamics], settings: GraceSettings, progress: bool
) -> Arrays:
    first, count = settings.training_steps, settings.tracking_steps
    controls = _dynamics_of(name, dynamics).controls[first : first + count]
    filt = make_filter(name, case, dynamics, settings)
    begin = time.process_time()
    history = filt(case.measurements, controls, settings.step_s, seed=settings.seed, progress=progress)
    seconds = time.process_time() - begin
    size = history.mean.shape[-1]
    arrays = {
        "mean": history.mean,
        "covariance": history.covariance.expand(*history.mean.shape, size).contiguous(),
        "evidence": history.diagnostics.log_likelihood,
    }
    if history.diagnostics.ess is not None:
        arrays["ess"] = history.diagnostics.ess
    return {key: value.numpy() for key, value in arrays.items()} | {"cpu_s": np.array(seconds)}


def score(tracked: Tracked, case: Case, settings: GraceSettings) -> dict[str, Any]:
    """Errors against the precise orbits from the settled part on; JSON-ready.

    Returns:
        Root mean squares of 3-D position and velocity over time and runs, their standard deviation over runs, the same
        by axis; ``nees`` of the six numbers (6 is ideal) with the share of epochs at which its mean over runs lies in
        its 95 % chi-square band (runs share the dynamics' error and the K-band record, so a sound filter may leave the
        band more often); ESS; ms_per_step, CPU time of a step of one run; outages and bias for "kband".
    """
    settled = slice(settings.settle_steps, None)
    plain = slice(0, case.runs)
    error = tracked.mean[..., :6] - case.truth.unsqueeze(1)
    covariance = tracked.covariance[..., :6, :6]
    some, inside = error[settled, plain], covariance[settled, plain]
    nees = _nees(some, inside)
    low, high = chi_square_band(6, case.runs)
    mean = nees.mean(1)
    result: dict[str, Any] = {
        "position_rmse_m": _rms(some[..., :3]),
        "velocity_rmse_m_s": _rms(some[..., 3:]),
        "position_rmse_sd_m": _spread(some[..., :3]),
        "velocity_rmse_sd_m_s": _spread(some[..., 3:]),
        "in_plane_rmse_m": _rms(some[..., :2]),
        "axes_rmse_m": {axis: float(some[..., k].square().mean().sqrt()) for k, axis in enumerate(_AXES)},
        "nees": float(nees.mean()),
        "nees_band_95": [low, high],
        "nees_inside_band": float(((mean >= low) & (mean <= high)).double().mean()),
        "log_likelihood": float(tracked.log_likelihood[:, plain].sum(0).mean()),
        "ess": None if tracked.ess is None else float(tracked.ess[settled, plain].mean()),
        "ms_per_step": 1e3 * tracked.cpu_s / tracked.log_likelihood.numel(),
    }
    if case.name == "kband":
        last = [rows.stop - 1 for rows in case.outages]
        if last:
            end = error[last, case.runs :]
            result["outage_end"] = {
                "position_rmse_m": _rms(end[..., :3]),
                "velocity_rmse_m_s": _rms(end[..., 3:]),
                "in_plane_rmse_m": _rms(end[..., :2]),
                "nees": float(_nees(end, covariance[last, case.runs :]).mean()),
            }
        bias, variance = tracked.mean[-1, plain, 6], tracked.covariance[-1, plain, 6, 6]
        result["bias"] = {"estimate_m": float(bias.mean()), "sd_m": float(variance.mean().sqrt())}
    return result


def bias_of_record(data: GraceData, settings: GraceSettings) -> float:
    """Mean of K-band range minus the orbits' separation over the tracking hours, m."""
    first, count = settings.training_steps, settings.tracking_steps
    rows = slice(first + 1, first + 1 + count)
    gap = data.range_m[rows] - torch.linalg.vector_norm(data.states[rows, :3], dim=-1)
    return float(gap.nanmean())


def chi_square_band(size: int, runs: int, level: float = 0.95) -> tuple[float, float]:
    """Band of the mean NEES of ``runs`` independent runs with ``size`` numbers each."""
    from scipy.stats import chi2

    tail = (1 - level) / 2
    low, high = (float(chi2.ppf(p, size * runs)) / runs for p in (tail, 1 - tail))
    return low, high


def _nees(error: Tensor, covariance: Tensor) -> Tensor:
    return (error * torch.linalg.solve(covariance, error)).sum(-1)


def _rms(error: Tensor) -> float:
    return float(error.square().sum(-1).mean().sqrt())


def _spread(error: Tensor) -> float | None:
    """Standard deviation over runs of each run's root mean square; None of one run."""
    return float(error.square().sum(-1).mean(0).sqrt().std()) if error.shape[1] > 1 else None
