"""Inertial navigation on real logs, with withheld fixes as the truth: what a gap costs, and whether the filter knows.

Row 0 of a run has all fixes; each other row misses its own for the longest gap, and shorter gaps are how it began.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.io.inertial import InertialLog
from torchfilt.metrics import chi_square_band
from torchfilt.missions.inertial.log_scene import (
    DEFAULT,
    LOGS,
    TUNING,
    VARIANTS,
    Drive,
    Gaps,
    LogSettings,
    Mounting,
    Variant,
    make_drive,
    make_filter,
    make_gaps,
    read_log,
)
from torchfilt.missions.stages import Arrays, Stages, check_names
from torchfilt.missions.study import digest, run_study
from torchfilt.models.attitude import inverse, rotate, to_euler
from torchfilt.particles import Particles
from torchfilt.spaces import wrap_angle
from torchfilt.types import FilterState, StepInfo

__all__ = [
    "LogSettings",
    "find_mounting",
    "follow",
    "run_log",
    "run_variant",
    "summarize",
    "table",
]

# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 1
# Slower than that, a car's course says little about where it is mounted.
_MOUNTING_SPEED_M_S = 3.0
_HORIZONTAL = slice(0, 2)


# Runs ----------------------------------------------------------------------------------------------------------------


def run_variant(
    name: str, log: InertialLog, settings: LogSettings, mounting: Mounting | None = None, progress: bool = False
) -> Arrays:
    """Filter a log, with all gaps as rows of one batch; a particle filter without gaps.

    Args:
        name: one of the log's `VARIANTS`. log: of `read_log`. settings: see there.
        mounting: turns the sensors, see `find_mounting`.
        progress: show a bar on a terminal.

    Returns:
        What `follow` gives, and of the G gaps gap_before (G,), gap_last (k, G): numbers of fixes, see `Gaps`.

    Raises:
        ValueError: unknown name. torchfilt.types.FilterError: the filter failed.
    """
    variants = VARIANTS[settings.log]
    if name not in variants:
        raise ValueError(f"variant must be one of {', '.join(variants)}, got {name!r}")
    variant = variants[name]
    drive = make_drive(log, settings, variant, mounting)
    gaps = make_gaps(drive, settings)
    if variant.filter == "rpf":
        gaps = Gaps(gaps.before[:0], gaps.last[:, :0])
    result = follow(drive, variant, settings, gaps, progress)
    return result | {"gap_before": gaps.before.numpy(), "gap_last": gaps.last.numpy()}


@torch.no_grad()
def follow(
    drive: Drive, variant: Variant, settings: LogSettings, gaps: Gaps | None = None, progress: bool = False
) -> Arrays:
    """Run a filter through a drive.

    Until the first gap begins all rows are one. The filter is fed step by step, since a history of all rows'
    covariances at all steps would take gigabytes.

    Args:
        gaps: of `make_gaps`, not for particle filters; None: row 0 alone.

    Returns:
        Of row 0 at the f fixes: time_s (f,); mean (f, 16); deviation (f, 15) tangent; angle_sd_rad (f, 3) of heading,
        pitch and roll; rate_rad_s (f,) about the body's up; nis, freedom (f,) and of each part of the fixes
        nis_<part>, freedom_<part> (f,) and whitened_<part> (f, size), see `_by_part`; position_m (f, 3) of the fix,
        attitude_rad (f, 3) of the reference.
        Of the G gaps gap_error_m (f, G, 3), estimate minus fix, and gap_covariance_m2 (f, G, 3, 3) claimed for it, NaN
        outside the gap. log_likelihood of row 0, cpu_s, steps: numbers.

    Raises:
        ValueError: gaps for a particle filter. torchfilt.types.FilterError: the filter failed.
    """
    from tqdm import tqdm

    tracker = make_filter(drive, variant, settings)
    count = 0 if gaps is None else len(gaps.before)
    record = _Record(drive, count)
    branch = None
    if gaps is not None and count:
        record.withheld[:, 1:] = gaps.withheld(len(drive.fix_time_s))
        branch = int(gaps.before[0]) + 1  # the first fix that any row misses
    silent = torch.full_like(drive.measurements[0], torch.nan)
    state = tracker.init((1,), settings.seed)
    width, likelihood, begin = 1, 0.0, time.process_time()
    lengths, numbers = drive.dt_s.tolist(), drive.fix.tolist()
    for k in tqdm(range(len(lengths)), unit="step", disable=None if progress else True):
        i = numbers[k]
        if i == branch:
            width = 1 + count
            state = _branched(state, width)
        y = silent if i < 0 else drive.measurements[i]
        if i >= 0 and width > 1:
            y = torch.where(record.withheld[i, :, None] & drive.by_satellite, torch.nan, y)
        state, info = tracker.step(state, y.expand(width, -1), drive.controls[k], lengths[k])
        likelihood += float(info.log_likelihood[0])
        if i >= 0:
            record.add(i, state.belief, info, drive.controls[k, 2] / lengths[k])
    told = {"log_likelihood": likelihood, "cpu_s": time.process_time() - begin, "steps": len(lengths)}
    return record.arrays() | {key: np.array(value) for key, value in told.items()}


class _Record:
    """What `follow` keeps, a fix at a time; withheld (f, 1 + G): which fixes a row misses, none as long as unset."""

    def __init__(self, drive: Drive, gaps: int) -> None:
        fixes = len(drive.fix_time_s)
        self.drive = drive
        self.withheld = torch.zeros(fixes, 1 + gaps, dtype=torch.bool)
        self.rows: dict[str, list[Tensor]] = {}
        self.errors = drive.position_m.new_full((fixes, gaps, 3), torch.nan)
        self.claims = drive.position_m.new_full((fixes, gaps, 3, 3), torch.nan)
        self.fix_covariance = torch.diag(drive.fixes.standard_deviation[drive.fixes.parts["position"]].square())

    def add(self, i: int, belief: Gaussian | Particles, info: StepInfo, rate: Tensor) -> None:
        """Fix i; rate: the step's mean about the body's up, biased."""
        mean, covariance = _moments(belief)
        step = _of_row(mean[0], covariance[0]) | _by_part(info, self.drive.measurements[i], self.drive.fixes.parts)
        step["rate_rad_s"] = rate - mean[0, 12]
        for key, value in step.items():
            self.rows.setdefault(key, []).append(value)
        if len(mean) > 1:
            inside = self.withheld[i, 1:]
            self.errors[i, inside] = mean[1:][inside, 7:10] - self.drive.position_m[i]
            self.claims[i, inside] = covariance[1:][inside, 6:9, 6:9] + self.fix_covariance

    def arrays(self) -> Arrays:
        """By name, leading dim f."""
        fixed = {
            "time_s": self.drive.fix_time_s,
            "position_m": self.drive.position_m,
            "attitude_rad": self.drive.attitude_rad,
            "gap_error_m": self.errors,
            "gap_covariance_m2": self.claims,
        }
        series = {key: torch.stack(values) for key, values in self.rows.items()}
        return {key: value.numpy() for key, value in (series | fixed).items()}


def _branched(state: FilterState[Any], rows: int) -> FilterState[Any]:
    """One row as many equal ones."""
    belief = state.belief
    if not isinstance(belief, Gaussian):
        raise ValueError("gaps are rows of one batch, which is made for Gaussian beliefs; got particles")
    factor = belief.scale_tril.expand(rows, *belief.scale_tril.shape[-2:])
    return state._replace(belief=Gaussian(belief.mean.expand(rows, -1), factor, belief.space))


def _moments(belief: Gaussian | Particles) -> tuple[Tensor, Tensor]:
    """Mean (R, 16) and covariance (R, 15, 15)."""
    mean, covariance = belief.moments() if isinstance(belief, Particles) else (belief.mean, belief.covariance)
    return mean, covariance.expand(*mean.shape[:-1], *covariance.shape[-2:])


def _of_row(mean: Tensor, covariance: Tensor) -> dict[str, Tensor]:
    """Mean, deviations, and the deviations of heading, pitch and roll as far as the nose is level."""
    east, north, _ = rotate(mean[:4], mean.new_tensor([0.0, 1.0, 0.0])).unbind(-1)
    zero, one = torch.zeros_like(east), torch.ones_like(east)
    along = torch.stack([zero, zero, one, north, -east, zero, east, north, zero]).reshape(3, 3)
    along = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    angle = (along @ covariance[:3, :3] @ along.mT).diagonal().sqrt()
    return {"mean": mean, "deviation": covariance.diagonal().sqrt(), "angle_sd_rad": angle}


def _by_part(info: StepInfo, y: Tensor, parts: dict[str, slice]) -> dict[str, Tensor]:
    """Of row 0 the NIS of each part of a measurement and of all of it, with how many components were measured.

    ``whitened_<part>``: innovation by its own standard deviation, NaN for what was not measured; its correlation from
    one fix to the next shows errors that are not white. Empty for filters that have no innovation.
    """
    if info.innovation is None or info.innovation_scale_tril is None or info.nis is None:
        return {}
    innovation, factor = info.innovation[0], info.innovation_scale_tril
    factor = factor.reshape(-1, *factor.shape[-2:])[0]
    covariance = factor @ factor.mT
    there = ~torch.isnan(y)
    found = {"nis": info.nis[0], "freedom": there.sum()}
    for name, place in parts.items():
        index = torch.arange(len(y))[place]
        seen = index[there[place]]
        own = covariance[seen][:, seen]
        found[f"nis_{name}"] = innovation[seen] @ torch.linalg.solve(own, innovation[seen])
        found[f"freedom_{name}"] = there[place].sum()
        whitened = innovation[index] / covariance.diagonal()[index].sqrt()
        found[f"whitened_{name}"] = torch.where(there[index], whitened, torch.nan)
    return found


def find_mounting(log: InertialLog, settings: LogSettings) -> Mounting:
    """Where the car's nose points, from the first part of the drive alone.

    A filter without the constraint goes through it; the velocity of the rear axle in body axes, whose direction is the
    nose's, is fitted by least squares above 3 m/s.

    Raises:
        ValueError: a log without an axle to fit.
    """
    tuning = TUNING[settings.log]
    if tuning.axle_m is None:
        raise ValueError(f"the mounting is that of a car, the log is {settings.log!r}")
    variant = Variant("es-kf", aided=False)
    result = follow(make_drive(log, settings, variant, stop_s=tuning.tuned_to_s), variant, settings)
    mean, rate = torch.from_numpy(result["mean"]), torch.from_numpy(result["rate_rad_s"])
    velocity = rotate(inverse(mean[:, :4]), mean[:, 4:7])
    right, forward, up = velocity.unbind(-1)
    right = right - rate * tuning.axle_m[1]  # of the axle: rate x arm
    used = (torch.from_numpy(result["time_s"]) > tuning.score_from_s) & (forward > _MOUNTING_SPEED_M_S)
    right, forward, up = right[used], forward[used], up[used]
    square = forward.square().sum()
    return Mounting(float((right * forward).sum() / square), float((up * forward).sum() / square))


# Numbers -------------------------------------------------------------------------------------------------------------


def summarize(result: Arrays, settings: LogSettings) -> dict[str, Any]:
    """Numbers of one run, JSON-ready; "first" is what the settings were tuned on, "rest" what comes after.

    Args:
        result: of `run_variant`. settings: of the run.

    Returns:
        gaps: by length in s, see `_gap_numbers`. nis: by part of the fixes and for all of it ("joint"), for first and
        rest: mean a degree of freedom, its 95 % band if innovations are white, whether it is inside, lag_1: correlation
        from fix to fix. attitude: by angle, estimate minus the log's reference in deg, mean and standard deviation.
        fix_rms_m: horizontal, fix minus estimate. log_likelihood, cpu_s, steps.
    """
    tuning = TUNING[settings.log]
    stamp = result["time_s"]
    spans = {
        "first": (stamp > tuning.score_from_s) & (stamp <= tuning.tuned_to_s),
        "rest": stamp > tuning.tuned_to_s,
    }
    off = result["mean"][:, 7:9] - result["position_m"][:, _HORIZONTAL]
    gaps = {}
    if len(result["gap_before"]):
        for length, last in zip(settings.gaps_s, result["gap_last"], strict=True):
            gaps[f"{length:g}"] = _gap_numbers(result, last)
    return {
        "gaps": gaps,
        "nis": {
            name: {span: _consistency(result, key, mask) for span, mask in spans.items()}
            for name, key in _parts(result).items()
        },
        "attitude": {span: _attitude(result, mask) for span, mask in spans.items()},
        "fix_rms_m": {span: float(np.sqrt((off[mask] ** 2).sum(-1).mean())) for span, mask in spans.items()},
        "log_likelihood": float(result["log_likelihood"]),
        "cpu_s": float(result["cpu_s"]),
        "steps": int(result["steps"]),
    }


def _parts(result: Arrays) -> dict[str, str]:
    """Name of a part -> ending of its keys, all of a fix last."""
    own = [key.removeprefix("nis") for key in result if key.startswith("nis_")]
    return {**{key.removeprefix("_"): key for key in own}, **({"joint": ""} if "nis" in result else {})}


def _gap_numbers(result: Arrays, last: np.ndarray) -> dict[str, Any]:
    """Errors at the ends of gaps of one length: estimate minus the withheld fix.

    Horizontal median, quartiles, rms and largest in m, rms upward; claimed_rms_m: what the covariance, with that of the
    fix, says of the horizontal rms; nis: horizontal, a degree of freedom, with the 95 % band for as many independent
    gaps as the starts have room for: gaps that overlap share their errors.
    """
    column = np.arange(len(last))
    error, covariance = result["gap_error_m"][last, column], result["gap_covariance_m2"][last, column]
    flat, own = error[:, _HORIZONTAL], covariance[:, _HORIZONTAL, _HORIZONTAL]
    size = np.sqrt((flat**2).sum(-1))
    nis = (flat * np.linalg.solve(own, flat[..., None])[..., 0]).sum(-1) / 2
    stamp, before = result["time_s"], result["gap_before"]
    length = np.median(stamp[last] - stamp[before])
    independent = 1 + (stamp[before[-1]] - stamp[before[0]]) / length
    band = chi_square_band(2, min(independent, len(last)))
    low, middle, high = np.quantile(size, [0.25, 0.5, 0.75])
    return {
        "count": len(last),
        "median_m": float(middle),
        "quartiles_m": [float(low), float(high)],
        "rms_m": float(np.sqrt((size**2).mean())),
        "max_m": float(size.max()),
        "up_rms_m": float(np.sqrt((error[:, 2] ** 2).mean())),
        "claimed_rms_m": float(np.sqrt(np.trace(own, axis1=-2, axis2=-1).mean())),
        "nis": float(nis.mean()),
        "nis_band_95": [band.low / 2, band.high / 2],
    }


def _consistency(result: Arrays, key: str, mask: np.ndarray) -> dict[str, Any]:
    nis, freedom = result[f"nis{key}"][mask], result[f"freedom{key}"][mask]
    total = float(freedom.sum())
    if total == 0:
        return {"mean": None, "band_95": None, "inside": None, "lag_1": None}
    mean = float(nis.sum()) / total
    band = chi_square_band(total, 1)
    low, high = band.low / total, band.high / total
    lag = None
    if key:
        white = result[f"whitened{key}"][mask]
        pairs = white[1:] * white[:-1]
        lag = float(np.nanmean(pairs) / np.nanmean(white**2))
    return {"mean": mean, "band_95": [low, high], "inside": low <= mean <= high, "lag_1": lag}


def _attitude(result: Arrays, mask: np.ndarray) -> dict[str, Any]:
    own = torch.stack(to_euler(torch.from_numpy(result["mean"][mask, :4])), -1)
    off = torch.rad2deg(wrap_angle(own - torch.from_numpy(result["attitude_rad"][mask]))).numpy()
    return {
        name: {"mean_deg": float(np.nanmean(column)), "sd_deg": float(np.nanstd(column))}
        for name, column in zip(("heading", "pitch", "roll"), off.T, strict=True)
    }


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of the tables: gaps, consistency, attitude; a variant a row."""
    lines = []
    variants = summary["variants"]
    for length in summary["settings"]["gaps_s"]:
        rows = {name: entry["gaps"][f"{length:g}"] for name, entry in variants.items() if entry["gaps"]}
        if not rows:
            continue
        count = next(iter(rows.values()))["count"]
        lines += ["", f"{length:g} s without fixes, {count} starts: horizontal error against the fix at the end, m"]
        lines.append(_line("variant", ("median", "quartiles", "rms", "max", "claimed rms", "up rms", "NIS/2", "95 %")))
        for name, own in rows.items():
            cells = [_number(own["median_m"]), "-".join(_number(value) for value in own["quartiles_m"])]
            cells += [_number(own[key]) for key in ("rms_m", "max_m", "claimed_rms_m", "up_rms_m", "nis")]
            lines.append(_line(name, [*cells, "-".join(_number(value) for value in own["nis_band_95"])]))
    tuned = TUNING[summary["settings"]["log"]].tuned_to_s
    lines += ["", f"NIS a degree of freedom with its 95 % band; tuned on the first part, to {tuned:g} s"]
    lines.append(_line("variant", ("part", "first", "rest", "95 %", "inside", "lag 1")))
    for name, entry in variants.items():
        for part, own in entry["nis"].items():
            first, rest = own["first"], own["rest"]
            if rest["mean"] is None:
                continue
            band = "-".join(f"{value:.2f}" for value in rest["band_95"])
            lag = "-" if rest["lag_1"] is None else f"{rest['lag_1']:.2f}"
            cells = [part, "-" if first["mean"] is None else f"{first['mean']:.2f}", f"{rest['mean']:.2f}", band]
            lines.append(_line(name, [*cells, "yes" if rest["inside"] else "no", lag]))
    lines += ["", "attitude minus the log's reference after that, deg; fix minus estimate, horizontal rms, m"]
    lines.append(_line("variant", ("heading", "pitch", "roll", "fix rms", "CPU s")))
    for name, entry in variants.items():
        cells = [f"{own['mean_deg']:+.2f}±{own['sd_deg']:.2f}" for own in entry["attitude"]["rest"].values()]
        lines.append(_line(name, [*cells, _number(entry["fix_rms_m"]["rest"]), f"{entry['cpu_s']:.1f}"]))
    return lines


def _line(name: str, cells: Sequence[str]) -> str:
    return f"{name:18s}" + "".join(f"{cell:>14s}" for cell in cells)


def _number(value: float) -> str:
    """Three digits without exponents."""
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.3g}"


# The study -----------------------------------------------------------------------------------------------------------


def run_log(
    settings: LogSettings,
    out: str | Path,
    variants: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study of one log; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `LogSettings`.
        out: run folder; receives stages/, figures/, table.txt and metrics.json.
        variants: names out of the log's `VARIANTS`; default `DEFAULT`.
        say: told what happens, a line each.
        progress: show bars on a terminal.
        figures: draw them.

    Returns:
        What metrics.json holds: log, variants (by name, see `summarize`), mounting_deg (of the car), settings and
        versions.

    Raises:
        ValueError: unknown variant, no room for the gaps. torchfilt.io.files.LogError: a file of the log is damaged or
            foreign; it is named with the row.
    """
    log, own = settings.log, VARIANTS[settings.log]
    names = DEFAULT[log] if variants is None else tuple(variants)
    check_names(names, own, "variants")
    data = read_log(settings)
    span = data.time_s[-1].item() - data.time_s[0].item()
    say(f"{log}: {LOGS[log]}; {len(data.time_s)} samples and {len(data.gnss.time_s)} fixes in {span:.0f} s")
    more: dict[str, Any] = {"log": log}
    mounting = None
    if TUNING[log].axle_m is not None and any(own[name].aided for name in names):
        stages = Stages(Path(out) / "stages", say)
        kept = stages.get("mounting", _recipe(settings, data), lambda: {"rad": np.array(find_mounting(data, settings))})
        mounting = Mounting(*kept["rad"].tolist())
        more["mounting_deg"] = {"yaw": math.degrees(mounting[0]), "pitch": math.degrees(mounting[1])}
        say("nose seen from the sensors: {yaw:.2f} deg clockwise, {pitch:.2f} deg up".format(**more["mounting_deg"]))

    def draw(results: dict[str, Arrays], folder: Path) -> list[Path]:
        from torchfilt.missions.inertial.logs_figures import log_figures

        return log_figures(results, settings, folder)

    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: _recipe(settings, data, name),
        follow=lambda name: run_variant(name, data, settings, mounting if own[name].aided else None, progress),
        summarize=lambda name, result: summarize(result, settings),
        table=table,
        draw=draw if figures else None,
        say=say,
        what="variants",
        more=more,
    )


def _recipe(settings: LogSettings, log: InertialLog, name: str | None = None) -> dict[str, Any]:
    """What the result of a stage depends on."""
    own = {"version": _VERSION, **settings.to_dict(), "tuning": asdict(TUNING[settings.log]), "data": digest(log)}
    if name is None or VARIANTS[settings.log][name].filter != "rpf":
        del own["particles"], own["seed"]
    return own
