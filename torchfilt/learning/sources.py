"""One-step pairs for a training run: from the simulated formation or from an NPZ file, with what to test on."""

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfilt.learning.settings import RunSettings, UsageError
from torchfilt.models.relative_motion import (
    FormationSettings,
    chief_controls,
    simulate_formation,
    training_pairs,
)

# How far the start of the test trajectories lies from the nominal one on each axis, m.
MOVED_M = 20.0


class Pairs(NamedTuple):
    """x (S, d), controls u (S, k) or None, x_next (S, d); group (S,) of neighbours along a trajectory, or None."""

    x: Tensor
    u: Tensor | None
    x_next: Tensor
    group: Tensor | None = None

    def rows(self, key: slice | Tensor) -> "Pairs":
        """Some of the pairs."""
        return Pairs(*(None if part is None else part[key] for part in self))  # type: ignore[arg-type]


class Track(NamedTuple):
    """A true trajectory for free roll-outs: states (t + 1, d), controls (t, k)."""

    states: Tensor
    controls: Tensor


class RunData(NamedTuple):
    """What a run trains and is judged on.

    tests: name -> pairs that training never saw. tracks: name -> trajectory, simulated data only.
    """

    training: Pairs
    tests: dict[str, Pairs]
    tracks: dict[str, Track]


def simulated(settings: RunSettings) -> RunData:
    """Pairs of the formation, tested on other draws, on the next revolution and on another start.

    Raises:
        UsageError: numbers that the simulator refuses.
    """
    assert settings.dt is not None and settings.samples is not None
    formation = FormationSettings(step_s=settings.dt)
    period, count = formation.period_s, max(200, min(settings.samples, 500))
    # Draws of other seeds: those of the training data are 'seed' itself.
    near, later, elsewhere = (int(s.generate_state(1)[0]) for s in np.random.SeedSequence(settings.seed).spawn(3))
    moved = replace(formation, relative_start=_moved(formation))
    kind: Any = settings.source
    try:
        training = Pairs(*training_pairs(formation, kind, settings.samples, seed=settings.seed, arcs=settings.groups))
    except ValueError as error:
        raise UsageError(
            f"--source {settings.source} --samples {settings.samples} --dt {settings.dt:g}: {error}"
        ) from None
    if settings.source == "arcs":
        training = training._replace(group=torch.arange(settings.samples) // (settings.samples // settings.groups))
    tests = {
        "held_out": Pairs(*training_pairs(formation, "cloud", count, seed=near)),
        "near_orbit": Pairs(*training_pairs(formation, "cloud", count, seed=near, spread_m=0.3, spread_m_s=3e-4)),
        "next_revolution": Pairs(*training_pairs(formation, "cloud", count, seed=later, span_s=(period, 2 * period))),
        "moved_start": Pairs(*training_pairs(moved, "cloud", count, seed=elsewhere, spread_m=1.0, spread_m_s=1e-3)),
    }
    tracks = {"nominal_start": _track(formation), "moved_start": _track(moved)}
    return RunData(training, tests, tracks)


def _moved(formation: FormationSettings) -> tuple[float, float, float, float, float, float]:
    """The start moved on each axis to another closed ellipse (no drift along the track)."""
    n = formation.mean_motion_rad_s
    shift = torch.tensor([MOVED_M, MOVED_M, MOVED_M, 0.0, -2 * n * MOVED_M, 0.0], dtype=torch.float64)
    x, y, z, vx, vy, vz = (formation.deputy_start() + shift).tolist()
    return x, y, z, vx, vy, vz


def _track(formation: FormationSettings) -> Track:
    """One revolution."""
    time = torch.arange(0.0, formation.period_s, formation.step_s, dtype=torch.float64)
    truth = simulate_formation(formation, time)
    return Track(truth.relative_m_m_s, chief_controls(truth.chief))


def split_file(settings: RunSettings, pairs: Pairs, test: Pairs | None) -> RunData:
    """Training part of a file and its tests: the last rows, and another file where one is given.

    A random part would be no test: rows of a log have neighbours that tell them.
    """
    kept = len(pairs.x) - round(settings.held_out * len(pairs.x))
    if not 2 <= kept <= len(pairs.x) - (settings.held_out > 0):
        raise UsageError(f"--held-out {settings.held_out:g} leaves {kept} of {len(pairs.x)} rows to train on")
    tests = {} if kept == len(pairs.x) else {"held_out": pairs.rows(slice(kept, None))}
    if test is not None:
        tests["test_file"] = test
    rows = torch.arange(kept)
    if settings.samples is not None:
        if settings.samples > kept:
            raise UsageError(f"--samples {settings.samples}: {settings.source} has {kept} rows to train on")
        generator = torch.Generator().manual_seed(settings.seed)
        rows = torch.randperm(kept, generator=generator)[: settings.samples].sort().values
    return RunData(pairs.rows(rows), tests, {})


def read_pairs(path: str | Path) -> tuple[Pairs, float | None, list[str]]:
    """Read and check an NPZ file of one-step pairs.

    Arrays, all finite floating-point numbers of one precision: x (S, d), x_next (S, d); optional u (S, k), dt (a
    number, s) and group (S,) integers. Nothing is unpickled.

    Returns:
        Pairs in float64, the step or None, and the names of arrays that are not used.

    Raises:
        FileNotFoundError: no such file.
        ValueError: one line that names file, array and rule.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    arrays = _arrays(path)
    missing = [name for name in ("x", "x_next") if name not in arrays]
    if missing:
        raise ValueError(f"{path}: array {missing[0]!r} is missing; the file holds {sorted(arrays) or 'nothing'}")
    x, x_next = (_numbers(path, name, arrays[name], 2) for name in ("x", "x_next"))
    if x.shape != x_next.shape or len(x) < 2 or x.shape[1] < 1:
        raise ValueError(f"{path}: x and x_next must be (S, d) alike, S >= 2, got {x.shape} and {x_next.shape}")
    u = _numbers(path, "u", arrays["u"], 2) if "u" in arrays else None
    if u is not None and (len(u) != len(x) or u.shape[1] < 1):
        raise ValueError(f"{path}: u must be (S, k) with S = {len(x)} rows, got {u.shape}")
    if x.dtype != x_next.dtype:
        raise ValueError(f"{path}: x and x_next must have one precision, got {x.dtype} and {x_next.dtype}")
    dt = None
    if "dt" in arrays:
        dt = float(_numbers(path, "dt", arrays["dt"], 0))
        if dt <= 0:
            raise ValueError(f"{path}: dt must be positive, got {dt}")
    group = None
    if "group" in arrays:
        raw = arrays["group"]
        if raw.shape != (len(x),) or raw.dtype.kind not in "iu":
            raise ValueError(f"{path}: group must be ({len(x)},) integers, got {raw.shape} of {raw.dtype}")
        group = torch.from_numpy(raw.astype(np.int64))
    wide = [None if a is None else torch.from_numpy(a.astype(np.float64)) for a in (x, u, x_next)]
    assert wide[0] is not None and wide[2] is not None
    return Pairs(wide[0], wide[1], wide[2], group), dt, sorted(set(arrays) - {"x", "x_next", "u", "dt", "group"})


def _arrays(path: Path) -> dict[str, Any]:
    """Arrays of an NPZ file by name, with every way of being broken told in one line."""
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("not an NPZ archive, or a truncated one")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # a damaged archive raises anything: RuntimeError, zlib.error, SyntaxError, MemoryError
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{path}: cannot be read ({reason}); an NPZ file of plain arrays is expected") from None


def _numbers(path: Path, name: str, array: Any, dims: int) -> Any:
    """Array checked for dtype, number of dims and finite values."""
    if array.dtype.kind != "f" or array.dtype.itemsize not in (4, 8):
        raise ValueError(f"{path}: {name} must be float32 or float64, got {array.dtype}")
    if array.ndim != dims:
        raise ValueError(f"{path}: {name} must have {dims} axes, got shape {array.shape}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = f" at {tuple(int(i) for i in bad[0])}" if dims else ""
        raise ValueError(f"{path}: {name} must be finite, {array[tuple(bad[0])]}{where} is not")
    return array
