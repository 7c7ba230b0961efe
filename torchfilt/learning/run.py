"""A training run from settings to a run folder: data, training, held-out tests, metrics, figures.

Files of a run folder: settings.json (may be given back as --config), versions.json, last.ckpt and gp.npz with their
manifests, training.json, metrics.json, figures/, log-N/ and tensorboard-N/ (one for each time the run was started).
"""

import csv
import hashlib
import json
import math
import platform
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchfilt.gp.frozen import FrozenGP
from torchfilt.gp.transition import GPTransition
from torchfilt.learning import figures
from torchfilt.learning.evaluate import Law, one_step_error, roll_out
from torchfilt.learning.settings import RunSettings, UsageError, check_numbers, different, resolve
from torchfilt.learning.sources import Pairs, RunData, Track, read_pairs, simulated, split_file
from torchfilt.learning.train import CHECKPOINT, FROZEN, TrainingReport, train_transition
from torchfilt.models.relative_motion import (
    CONTROL_SIZE,
    MU_M3_S2,
    ClohessyWiltshire,
    FormationSettings,
    LinearTimeVarying,
    TwoBody,
    phase,
)
from torchfilt.storage import atomic_write, manifest_path

__all__ = ["RunSettings", "UsageError", "load_transition", "run_training"]

SETTINGS, VERSIONS, METRICS = "settings.json", "versions.json", "metrics.json"
_FILES = (SETTINGS, VERSIONS, METRICS, CHECKPOINT, FROZEN, "training.json")
_PACKAGES = ("torchfilt", "torch", "gpytorch", "pytorch-lightning", "numpy", "scipy")
_ORBITAL = {"position_m": slice(0, 3), "velocity_m_s": slice(3, 6)}
_LABELS = ("x, m", "y, m", "z, m", "vx, m/s", "vy, m/s", "vz, m/s")
# A standardised error within these bounds is called honest.
_HONEST = (0.7, 1.3)

Say = Callable[[str], None]


def run_training(
    settings: RunSettings,
    *,
    stop: Callable[[], bool] | None = None,
    say: Say = print,
    progress: bool | None = None,
) -> dict[str, Any]:
    """Train, test and write a run folder.

    Args:
        settings: what to do.
        stop: asked after each epoch; True saves and ends the run, see ``interrupted`` in the result.
        say: receives the report line by line.
        progress: show a bar; None: on a terminal only.

    Returns:
        What metrics.json holds, and ``interrupted``; of an interrupted run that and the report alone.

    Raises:
        UsageError: options that do not fit each other or the data; a run that would be overwritten.
        ValueError, OSError: data that are not as they must be, files that cannot be read or written.
    """
    check_numbers(settings)
    _check_device(settings.device)
    folder = Path(settings.out)
    _check_folder(folder, settings)
    data, settings, digests = _prepare(settings, say)
    _open_folder(folder, settings)
    versions = _versions()
    _write_json(folder / SETTINGS, settings.to_dict())
    _write_json(folder / VERSIONS, versions)
    train = data.training
    size, rank = train.x.shape[1], _rank(train.x)
    say(f"{len(train.x)} pairs from {settings.source}, steps of {settings.step:g} s, nominal law: {settings.nominal}")
    if rank < size:
        say(
            f"the training states fill {rank} of {size} directions: elsewhere the law extrapolates, expect errors there"
        )
    law, report = _train(data, settings, folder, stop, progress)
    if report.interrupted:
        say(f"stopped after {report.epochs} epochs")
        return {"interrupted": True, "training": _training(report)}
    say(f"trained in {report.epochs} epochs, {report.seconds:.1f} s; loss {report.loss:.4g} a sample")
    metrics = {
        "seed": settings.seed,
        "versions": versions,
        "data": {"source": settings.source, "pairs": len(train.x), "rank": rank, "sha256": digests},
        "training": _training(report),
        "one_step": {name: _one_step(law, pairs, settings) for name, pairs in data.tests.items()},
        "roll_out": {name: _roll_out(name, law, track, settings) for name, track in data.tracks.items()},
    }
    metrics = _finite(metrics)
    _report(metrics, say)
    if settings.figures:
        _draw(folder, law, data, settings, say)
    # Written last: a folder with metrics is a finished run.
    _write_json(folder / METRICS, metrics)
    say(f"written to {folder}")
    return {"interrupted": False, **metrics}


def load_transition(folder: str | Path) -> GPTransition:
    """The learned law of a finished run.

    Raises:
        FileNotFoundError: no finished run there.
        IntegrityError: gp.npz truncated, altered or foreign.
    """
    folder = Path(folder)
    settings = _read_settings(folder)
    return GPTransition(FrozenGP.load(folder / FROZEN), _nominal(settings), context=_context(settings))


def _prepare(settings: RunSettings, say: Say) -> tuple[RunData, RunSettings, dict[str, str]]:
    """Data, resolved settings and digests of the files read."""
    if settings.simulated:
        settings = resolve(settings, CONTROL_SIZE, 6, None)
        if settings.nominal == "cw" and settings.mean_motion is None:
            settings = replace(settings, mean_motion=FormationSettings().mean_motion_rad_s)
        return simulated(settings), settings, {}
    if not Path(settings.source).exists():
        raise UsageError(f"--source {settings.source}: neither 'cloud', 'arcs', 'trajectory' nor a file")
    pairs, dt, unused = read_pairs(settings.source)
    if unused:
        say(f"{settings.source}: not used: {', '.join(unused)}")
    settings = resolve(settings, None if pairs.u is None else pairs.u.shape[1], pairs.x.shape[1], dt)
    test = None
    if settings.test is not None:
        test, test_dt, _ = read_pairs(settings.test)
        shapes = [[None if t is None else t.shape[1] for t in (p.x, p.u)] for p in (pairs, test)]
        if shapes[0] != shapes[1] or (test_dt is not None and abs(test_dt - settings.step) > 1e-9 * settings.step):
            raise ValueError(f"{settings.test}: columns of x and u, and dt, must be those of {settings.source}")
    if settings.nominal == "cw" and settings.mean_motion is None:
        assert pairs.u is not None
        settings = replace(settings, mean_motion=_mean_motion(pairs.u))
    names = [name for name in (settings.source, settings.test) if name is not None]
    digests = {name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in names}
    return split_file(settings, pairs, test), settings, digests


def _train(
    data: RunData, s: RunSettings, folder: Path, stop: Callable[[], bool] | None, progress: bool | None
) -> tuple[GPTransition, TrainingReport]:
    train = data.training
    assert s.kernel is not None and s.noise_floor is not None
    return train_transition(
        train.x,
        train.u,
        train.x_next,
        _nominal(s),
        dt=s.step,
        context=_context(s),
        target=s.target,
        kernel=s.kernel,
        shared=s.shared,
        standardize=s.standardize,
        groups=train.group,
        noise_floor=s.noise_floor,
        hyperparameter_samples=s.hyperparameter_samples,
        inducing=s.inducing,
        batch_size=s.batch_size,
        optimizer=s.optimizer,
        learning_rate=s.learning_rate,
        epochs=s.epochs,
        seed=s.seed,
        device=s.device,
        dtype=_dtype(s),
        run_dir=folder,
        # Killed before its first checkpoint, a run starts anew, to the same bits.
        resume=s.resume and (folder / CHECKPOINT).exists(),
        progress=progress,
        tensorboard=s.tensorboard,
        stop=stop or (lambda: False),
    )


def _dtype(settings: RunSettings) -> torch.dtype:
    return torch.float32 if settings.dtype == "float32" else torch.float64


def _nominal(s: RunSettings) -> nn.Module | None:
    """Known dynamics of resolved settings."""
    if s.nominal == "none":
        return None
    assert s.psd is not None
    if s.nominal == "cw":
        assert s.mean_motion is not None
        return ClohessyWiltshire(s.mean_motion, s.psd, s.dt)
    return TwoBody(s.psd) if s.nominal == "two-body" else LinearTimeVarying(s.psd)


def _context(s: RunSettings) -> Callable[[Tensor], Tensor] | None:
    """Inputs of the GP beyond the state as a function of the control: phase, then columns of the control."""
    columns = list(s.control_columns)
    if not s.phase and not columns:
        return None

    def context(u: Tensor) -> Tensor:
        parts = []
        if s.phase and s.phase_column is None:
            parts.append(phase(u))
        elif s.phase:
            angle = u[..., s.phase_column]
            parts.append(torch.stack([angle.cos(), angle.sin()], -1))
        if columns:
            parts.append(u[..., columns])
        return torch.cat(parts, -1)

    return context


def _mean_motion(u: Tensor) -> float:
    """Mean motion (rad/s) of the chief's orbit in controls (S, 21), by its mean energy."""
    radius, speed = (torch.linalg.vector_norm(part, dim=-1) for part in (u[:, 3:6], u[:, 6:9]))
    axis = float(1 / (2 / radius - speed.square() / MU_M3_S2).mean())
    if not 0 < axis < math.inf:
        raise ValueError(f"the controls u hold no closed chief orbit (semi-major axis {axis:g} m): give --mean-motion")
    return math.sqrt(MU_M3_S2 / axis**3)


def _groups(size: int, s: RunSettings) -> dict[str, slice]:
    """Coordinates that are reported together."""
    orbital = size == 6 and (s.nominal != "none" or s.simulated)
    return _ORBITAL if orbital else {"state": slice(0, size)}


def _one_step(law: GPTransition, pairs: Pairs, s: RunSettings) -> dict[str, Any]:
    """Errors over a test set; ``z_model`` against the GP's own deviation, ``z`` against that and the noise floor."""
    groups = _groups(pairs.x.shape[1], s)
    error = one_step_error(law, pairs.x.to(_dtype(s)), pairs.u, pairs.x_next, s.step)
    result: dict[str, Any] = {"pairs": len(pairs.x), **error.summary(groups)}
    result["coordinates"] = {name: value.tolist() for name, value in error._asdict().items()}
    result["novelty"] = float(law.novelty(pairs.x.to(_dtype(s)), pairs.u).distance.max())
    if law.nominal is not None:
        alone = one_step_error(law.nominal, pairs.x, pairs.u, pairs.x_next, s.step)
        result["nominal"] = {name: float(alone.rms[part].square().sum().sqrt()) for name, part in groups.items()}
    return result


def _distances(law: Law, track: Track, s: RunSettings, dtype: torch.dtype, part: slice) -> Tensor:
    """Distance (t + 1,) of a free roll-out from the truth."""
    states = roll_out(law, track.states[0].to(dtype), track.controls, s.step)
    return torch.linalg.vector_norm((states.to(track.states) - track.states)[:, part], dim=-1)


def _roll_out(name: str, law: GPTransition, track: Track, s: RunSettings) -> dict[str, Any]:
    """Largest distance of free roll-outs from the truth."""
    # Trained on one trajectory, the GP only repeats it when it starts there.
    seen = s.source == "trajectory" and name == "nominal_start"
    result: dict[str, Any] = {"steps": len(track.controls), "in_sample": seen}
    for quantity, part in _ORBITAL.items():
        result[quantity] = float(_distances(law, track, s, _dtype(s), part).max())
        if law.nominal is not None:
            alone = float(_distances(law.nominal, track, s, torch.float64, part).max())
            result.setdefault("nominal", {})[quantity] = alone
    return result


def _report(metrics: dict[str, Any], say: Say) -> None:
    """The numbers that matter, as a table in words."""
    say("")
    say(f"{'one-step error':<18}{'quantity':<14}{'nominal':>10}{'learned':>10}{'z':>8}  {'z + floor':>9}")
    for name, entry in metrics["one_step"].items():
        for group in (g for g in ("position_m", "velocity_m_s", "state") if g in entry):
            nominal = entry.get("nominal", {}).get(group)
            before = "-" if nominal is None else f"{nominal:.2e}"
            values = entry[group]
            z, z_floor = (_number(values[key], ".3g") for key in ("z_model", "z"))
            rms, verdict = _number(values["rms"], ".2e"), _verdict(values["z_model"])
            say(f"{name:<18}{group:<14}{before:>10}{rms:>10}{z:>8}  {z_floor:>9}  {verdict}")
    if metrics["roll_out"]:
        say("")
        say(f"{'free roll-out':<18}{'steps':<14}{'nominal':>10}{'learned':>10}  largest position error, m")
        for name, entry in metrics["roll_out"].items():
            nominal = entry.get("nominal", {}).get("position_m")
            before = "-" if nominal is None else f"{nominal:.2e}"
            seen = "  in sample: no test" if entry["in_sample"] else ""
            say(f"{name:<18}{entry['steps']:<14}{before:>10}{_number(entry['position_m'], '.2e'):>10}{seen}")
    say("")
    say("z is error / the GP's own standard deviation (1: honest); z + floor counts the nominal law's noise as well.")


def _number(value: float | None, style: str) -> str:
    return "not finite" if value is None else format(value, style)


def _verdict(z: float | None) -> str:
    if z is None:
        return "not finite"
    return "overconfident" if z > _HONEST[1] else "cautious" if z < _HONEST[0] else "honest"


def _draw(folder: Path, law: GPTransition, data: RunData, s: RunSettings, say: Say) -> None:
    """Figures of the held-out errors, the roll-outs and the loss."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        say("no figures: matplotlib is not installed (pip install 'torchfilt[plot]')")
        return
    target = folder / "figures"
    for name, pairs in data.tests.items():
        size = pairs.x.shape[1]
        figure, axes = figures.new_axes(size, f"one-step errors, {name.replace('_', ' ')}")
        with torch.no_grad():
            predicted = law(pairs.x.to(_dtype(s)), pairs.u, s.step)
            error = (pairs.x_next - predicted.mean).numpy()
            deviation = law.model_variance(pairs.x.to(_dtype(s)), pairs.u).sqrt().numpy()
        angle = _angle(s, pairs.u)
        labels = _LABELS if "position_m" in _groups(size, s) else [f"coordinate {i + 1}" for i in range(size)]
        for i, ax in enumerate(axes):
            figures.plot_one_step(error[:, i], deviation[:, i], angle, labels[i], ax)
        axes[0].legend()
        figures.save_figure(figure, target / f"one_step_{name}.png")
    for name, track in data.tracks.items():
        figure, axes = figures.new_axes(1, f"free roll-out, {name.replace('_', ' ')}")
        lines = {"learned": _distances(law, track, s, _dtype(s), _ORBITAL["position_m"]).numpy()}
        if law.nominal is not None:
            lines["nominal"] = _distances(law.nominal, track, s, torch.float64, _ORBITAL["position_m"]).numpy()
        figures.plot_roll_out(s.step * np.arange(len(track.states)), lines, axes[0])
        figures.save_figure(figure, target / f"roll_out_{name}.png")
    losses = _losses(folder)
    if len(losses):
        figure, axes = figures.new_axes()
        figures.plot_loss(losses, axes[0])
        figures.save_figure(figure, target / "loss.png")


def _angle(s: RunSettings, u: Tensor | None) -> np.ndarray | None:
    """Phase (S,) of the pairs, rad."""
    if not s.phase or u is None:
        return None
    if s.phase_column is not None:
        return u[:, s.phase_column].numpy()
    f = phase(u)
    return torch.atan2(f[:, 1], f[:, 0]).numpy()


def _losses(folder: Path) -> np.ndarray:
    """Loss by epoch from the CSV logs; where a resumed run repeated an epoch, its last line counts."""
    found: dict[int, float] = {}
    parts = sorted(folder.glob("log-*/metrics.csv"), key=lambda p: int(p.parent.name.split("-")[1]))
    for part in parts:
        with part.open(newline="") as stream:
            for row in csv.DictReader(stream):
                if row.get("epoch") and row.get("loss"):
                    found[int(row["epoch"])] = float(row["loss"])
    return np.array([found[epoch] for epoch in sorted(found)])


def _check_device(device: str) -> None:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise UsageError(f"--device must be cpu, cuda or cuda:N, got {device}")
    if device.startswith("cuda"):
        count = torch.cuda.device_count()
        if int(device.partition(":")[2] or 0) >= count:
            raise UsageError(f"--device {device}: torch sees {count} CUDA devices")


def _check_folder(folder: Path, s: RunSettings) -> None:
    """Refuse to overwrite a run, to write into a file, or to resume where nothing is."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder}: not a folder")
    old = [name for name in _FILES if (folder / name).exists()]
    if s.resume and SETTINGS not in old:
        raise UsageError(f"--resume: {folder} holds no run ({SETTINGS} is missing)")
    if old and not (s.resume or s.force):
        raise UsageError(f"{folder} holds a run already ({old[0]}): give --resume, --force or another --out")


def _open_folder(folder: Path, s: RunSettings) -> None:
    """Make the folder; clear an overwritten run's own files; hold a resumed run to its settings."""
    if s.resume:
        conflict = different(_read_settings(folder).to_dict(), s.to_dict())
        if conflict:
            raise UsageError(f"--resume: another run lies in {folder}: {conflict}")
        return
    folder.mkdir(parents=True, exist_ok=True)
    for name in _FILES:
        (folder / name).unlink(missing_ok=True)
        manifest_path(folder / name).unlink(missing_ok=True)
    for pattern in ("log-[0-9]*", "tensorboard-[0-9]*", "figures"):
        for path in folder.glob(pattern):
            shutil.rmtree(path)


def _read_settings(folder: Path) -> RunSettings:
    path = folder / SETTINGS
    try:
        stored = json.loads(path.read_text())
        return RunSettings(**{**stored, "control_columns": tuple(stored["control_columns"])})
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: not the settings of a run ({str(error).splitlines()[0]})") from None


def _training(report: TrainingReport) -> dict[str, Any]:
    """Report without the checkpoint's path, which depends on where the folder lies."""
    return {name: value for name, value in report.to_dict().items() if name != "checkpoint"}


def _versions() -> dict[str, Any]:
    """Versions of Python and packages, git revision of the library where it is a checkout, threads."""
    found: dict[str, Any] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name.replace("pytorch-lightning", "lightning")] = version(name)
        except PackageNotFoundError:  # run from a folder that was never installed
            found[name] = None
    return {**found, "platform": platform.platform(), "threads": torch.get_num_threads(), "revision": _revision()}


def _revision() -> str | None:
    """Commit of the library's own source, with "-dirty" where it was changed; None outside git."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # an installed copy may lie in someone else's checkout
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _rank(x: Tensor) -> int:
    """Directions that standardised states (S, d) fill to more than 0.005 of the widest one."""
    scale = x.std(0)
    values = torch.linalg.svdvals((x - x.mean(0)) / torch.where(scale > 0, scale, torch.ones_like(scale)))
    return int((values > 0.005 * values[0]).sum())


def _finite(value: Any) -> Any:
    """The same with None for numbers that are not finite, which JSON cannot hold."""
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_json(path: Path, content: dict[str, Any]) -> None:
    atomic_write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
