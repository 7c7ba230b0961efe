"""The formation study as a run: stages that are kept, numbers by revolution, a table, figures."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfilt.gp.frozen import FrozenGP
from torchfilt.metrics import chi_square_band, nees
from torchfilt.missions.formation.scene import (
    CASES,
    FILTERS,
    LEARNED,
    Scene,
    StudySettings,
    make_filter,
    make_scene,
    scene_bound,
    train_gp,
)
from torchfilt.missions.stages import Arrays, Stages, check_names, versions, write_outcome
from torchfilt.storage import IntegrityError

# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 1
# A run is lost where its position error over a revolution is above this, m: one radar sample gives 0.25 m.
LOST_M = 5.0


def run_filter(
    name: str, scene: Scene, settings: StudySettings, gp: FrozenGP | None = None, progress: bool = False
) -> Arrays:
    """Filter all runs of a scene.

    Args:
        name: one of `FILTERS`. scene, settings, gp: see `make_filter`. progress: show a bar.

    Returns:
        error (t, R, 6) estimate minus truth; deviation (t, R, 6) claimed; nees (t, R); ess (t, R), NaN without
        particles; ok (t, R); cpu_s, of all runs and steps together.
    """
    tracker = make_filter(name, scene, settings, gp)
    begin = time.process_time()
    with torch.no_grad():
        history = tracker(
            scene.measurements,
            scene.controls,
            scene.formation.step_s,
            seed=settings.seed,
            throw=False,
            progress=progress,
        )
    seconds = time.process_time() - begin
    # A latent force comes after the motion in the state.
    mean, covariance = history.mean[..., :6], history.covariance[..., :6, :6]
    truth = scene.truth.unsqueeze(1)
    error = mean - truth
    ess = history.diagnostics.ess
    return {
        "error": error.numpy(),
        "deviation": covariance.diagonal(dim1=-2, dim2=-1).sqrt().numpy(),
        "nees": nees(mean, truth, covariance).numpy(),
        "ess": np.full(error.shape[:2], np.nan) if ess is None else ess.numpy(),
        "ok": history.diagnostics.ok.numpy(),
        "cpu_s": np.array(seconds),
    }


def summarize(result: Arrays, scene: Scene) -> dict[str, dict[str, Any]]:
    """Numbers of one filter by revolution.

    Returns:
        For each revolution: position_rmse_m and velocity_rmse_m_s, the median over runs of the 3-D RMSE of a run, with
        its quartiles, its worst run and the root mean square over all runs (which a bound speaks of); nees, its mean,
        with the 95 % band of a mean over the runs and the share of epochs inside it; ess; ms_per_step, CPU time of a
        step of one run; lost, the number of runs above `LOST_M`. None where a number does not exist.
    """
    summary = {}
    runs = result["error"].shape[1]
    band = chi_square_band(6, runs)
    for name, mask in scene.revolutions().items():
        rows = mask.numpy()
        error = result["error"][rows]
        entry: dict[str, Any] = {}
        for key, unit, part in (("position", "m", slice(0, 3)), ("velocity", "m_s", slice(3, 6))):
            rmse = run_rmse(error[..., part])
            rmse = np.where(np.isfinite(rmse), rmse, np.inf)
            quartiles = np.quantile(rmse, [0.25, 0.5, 0.75], method="nearest")
            entry[f"{key}_rmse_{unit}"] = _plain(np.median(rmse))
            entry[f"{key}_rmse_quartiles_{unit}"] = [_plain(quartiles[0]), _plain(quartiles[2])]
            entry[f"{key}_rmse_worst_{unit}"] = _plain(rmse.max())
            entry[f"{key}_rms_all_runs_{unit}"] = _plain(np.sqrt(np.mean(rmse**2)))
        mean = result["nees"][rows].mean(1)
        entry["nees"] = _plain(mean.mean())
        entry["nees_band_95"] = [band.low, band.high]
        entry["nees_inside_band"] = _plain(np.mean((mean >= band.low) & (mean <= band.high)))
        entry["ess"] = _plain(result["ess"][rows].mean())
        entry["ms_per_step"] = _plain(1e3 * result["cpu_s"] / result["ok"].size)
        entry["lost"] = int(lost_runs(result, rows).sum())
        summary[name] = entry
    return summary


def run_rmse(error: np.ndarray) -> np.ndarray:
    """RMSE (R,) of each run from errors (t, R, k): the root of the mean squared length."""
    value: np.ndarray = np.sqrt(np.mean(np.sum(error**2, -1), 0))
    return value


def lost_runs(result: Arrays, rows: np.ndarray) -> np.ndarray:
    """Which runs (R,) failed or ended up far from the truth over the epochs ``rows`` (t,)."""
    rmse = run_rmse(result["error"][rows][..., :3])
    value: np.ndarray = ~(rmse < LOST_M) | ~result["ok"].all(0)
    return value


def leakage(result: Arrays, exact: Arrays, rows: np.ndarray, least: float = 0.95) -> bool:
    """Whether errors are smaller than the exact model's by more than chance: learned dynamics then hold the answers.

    Runs are paired (same measurements): log ratios of position and of velocity RMSE are averaged over the runs, and
    three standard errors of that mean (one-sided false-alarm rate 0.1 % for many runs) are the noise.

    Args:
        result, exact: of `run_filter` on the same scene. rows: epochs (t,), bool. least: smallest honest ratio.
    """
    for part in (slice(0, 3), slice(3, 6)):
        ratio = np.log(run_rmse(result["error"][rows][..., part]) / run_rmse(exact["error"][rows][..., part]))
        spread = ratio.std(ddof=1) / np.sqrt(len(ratio)) if len(ratio) > 1 else 0.0
        if ratio.mean() + 3 * spread < np.log(least):
            return True
    return False


def run_formation(
    settings: StudySettings,
    out: str | Path,
    filters: Sequence[str] = FILTERS,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
    stop: Callable[[], bool] | None = None,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `StudySettings`.
        out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`.
        say: told what happens, a line each.
        progress: show bars on a terminal.
        figures: draw them.
        stop: asked between the stages; True ends the run in good order.

    Returns:
        What metrics.json holds: paper (by filter and revolution), bound, gp, case, settings, seeds, versions,
        interrupted.

    Raises:
        ValueError: unknown filter.
    """
    check_names(filters, FILTERS, "filters")
    folder = Path(out)
    stages = Stages(folder / "stages", say)
    ended = stop or (lambda: False)
    say(f"formation, case {settings.case}: {CASES[settings.case]}; {settings.runs} runs of {settings.steps} steps")
    scene = make_scene(settings)
    summary: dict[str, Any] = {"paper": {}, "bound": _bound(scene), "case": settings.case, "interrupted": False}
    gp = None
    if any(name in LEARNED for name in filters):
        gp, summary["gp"] = _gp_stage(settings, stages, say, progress)
    results: dict[str, Arrays] = {}
    for name in filters:
        if ended():
            summary["interrupted"] = True
            break
        recipe = _recipe(name, settings)
        kept = stages.has(name, recipe)
        results[name] = stages.get(name, recipe, lambda name=name: run_filter(name, scene, settings, gp, progress))  # type: ignore[misc]
        summary["paper"][name] = summarize(results[name], scene)
        say(f"{name:18s} " + ("as before" if kept else f"{float(results[name]['cpu_s']):.1f} s of CPU"))
    summary["leakage"] = _leaks(results, scene)
    summary |= {
        "settings": settings.to_dict(),
        "seeds": [settings.seed, settings.training_seed],
        "versions": versions(),
    }
    lines = table(summary)
    for line in lines:
        say(line)
    if not summary["interrupted"]:
        write_outcome(folder, lines, summary)
        if figures:
            from torchfilt.missions.figures import formation_figures

            for path in formation_figures(results, scene, settings, scene_bound(scene), folder / "figures"):
                say(f"wrote {path}")
    return summary


def _bound(scene: Scene) -> dict[str, dict[str, float]]:
    variance = scene_bound(scene).diagonal(dim1=-2, dim2=-1)
    return {
        name: {
            "position_rmse_m": float(variance[mask][:, :3].sum(-1).mean().sqrt()),
            "velocity_rmse_m_s": float(variance[mask][:, 3:].sum(-1).mean().sqrt()),
        }
        for name, mask in scene.revolutions().items()
    }


def _recipe(name: str, settings: StudySettings) -> dict[str, Any]:
    """What the result of a stage depends on."""
    own = {"version": _VERSION, **settings.to_dict()}
    if name == "gp":
        return {key: own[key] for key in ("version", "samples", "training_seed")} | {"leak": settings.case == "leak"}
    if name not in LEARNED:
        own = {key: value for key, value in own.items() if key not in ("samples", "training_seed", "gp_psd_m2_s3")}
    if not name.startswith("mf-upf"):
        del own["particles"]
    if not name.startswith("cw-pf"):
        del own["bootstrap_particles"]
    if name != "cw-pf-paper-noise":
        del own["step_noise_m"], own["step_noise_m_s"]
    if name not in ("cw-pf", "cw-ukf"):
        del own["cw_psd_m2_s3"]
    return own


def _gp_stage(
    settings: StudySettings, stages: Stages, say: Callable[[str], None], progress: bool
) -> tuple[FrozenGP, dict[str, Any]]:
    """Trained GP and its report, read where they are kept."""
    path = stages.path("gp", _recipe("gp", settings))
    if path is not None and path.is_file():
        try:
            gp = FrozenGP.load(path)
            say(f"{'training':18s} as before")
            return gp, gp.settings["report"]
        except IntegrityError as error:
            say(f"{error}; trained again")
    gp, report = train_gp(settings, progress=None if progress else False)  # None: on a terminal only
    gp.settings["report"] = report
    if path is not None:
        gp.save(path)
    say(f"{'training':18s} {report['seconds']:.1f} s")
    return gp, report


def _leaks(results: dict[str, Arrays], scene: Scene) -> dict[str, bool]:
    """By learned filter: whether any revolution is better than the exact model allows."""
    exact = results.get("exact-ukf")
    if exact is None:
        return {}
    masks = [mask.numpy() for mask in scene.revolutions().values()]
    return {
        name: any(leakage(result, exact, mask) for mask in masks) for name, result in results.items() if name in LEARNED
    }


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a table: a filter a row, both revolutions."""
    lines = []
    for revolution, bound in summary["bound"].items():
        lines += [
            "",
            f"{revolution}: 3-D RMSE, median of the runs [quartiles]; NEES of a consistent filter is 6",
            f"{'filter':18s} {'position, m':>25s} {'velocity, m/s':>31s} "
            f"{'NEES':>9s} {'ESS':>7s} {'ms/step':>8s} {'lost':>5s}",
        ]
        for name, entries in summary["paper"].items():
            e = entries[revolution]
            position = _spread(e["position_rmse_m"], e["position_rmse_quartiles_m"], ".4f")
            velocity = _spread(e["velocity_rmse_m_s"], e["velocity_rmse_quartiles_m_s"], ".2e")
            numbers = (
                f"{_number(e['nees'], '.3g'):>9s} {_number(e['ess'], '.1f'):>7s} {_number(e['ms_per_step'], '.2f'):>8s}"
            )
            lines.append(f"{name:18s} {position:>25s} {velocity:>31s} {numbers} {e['lost']:5d}")
        lines.append(f"{'Cramér-Rao bound':18s} {bound['position_rmse_m']:25.4f} {bound['velocity_rmse_m_s']:31.2e}")
    leaks = [name for name, leaks in summary["leakage"].items() if leaks]
    if leaks:
        lines += ["", f"better than the exact model, so the training data hold the answers: {', '.join(leaks)}"]
    return lines


def _spread(value: float | None, quartiles: list[float | None], form: str) -> str:
    return f"{_number(value, form)} [{_number(quartiles[0], form)}, {_number(quartiles[1], form)}]"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _plain(value: Any) -> float | None:
    """JSON-ready: None where there is no finite number."""
    number = float(value)
    return number if np.isfinite(number) else None
