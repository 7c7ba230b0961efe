"""Reader of a day of GRACE A and B: precise orbits and K-band range.

Strict: a file is either whole and plausible or refused, with its name, row and the broken rule. Units (km, decimetres
per second), time scale (GPS) and frame (ITRF) of the files end here: what comes out is SI, seconds of the day and, by
default, inertial axes.
"""

import datetime
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_digests, read_packed_text

EARTH_RATE_RAD_S = 7.2921158553e-5
FILES = ("grca_truth.csv.gz", "grcb_truth.csv.gz", "grc_kb_rng.csv.gz")


class Orbit(NamedTuple):
    """One satellite: time_s (t,) since the first day's midnight, GPS time; position_m, velocity_m_s (t, 3)."""

    time_s: Tensor
    position_m: Tensor
    velocity_m_s: Tensor


class GraceLog(NamedTuple):
    """Both satellites at the same t epochs; range_m (t,) is NaN where the K-band file has no row."""

    time_s: Tensor
    position_a_m: Tensor
    velocity_a_m_s: Tensor
    position_b_m: Tensor
    velocity_b_m_s: Tensor
    range_m: Tensor


def read_grace(
    folder: str | Path,
    *,
    inertial: bool = True,
    manifest: Mapping[str, str] | str | Path | None = None,
    velocity_tolerance_m_s: float = 0.1,
) -> GraceLog:
    """Both orbits and the range of one day.

    Args:
        folder: holds the three `FILES`.
        inertial: turn Earth-fixed axes to inertial ones (`to_inertial`).
        manifest: SHA-256 of the stored files by name, or a JSON file that holds them.
        velocity_tolerance_m_s: see `read_orbit`.

    Raises:
        LogError: a file is damaged or implausible, files disagree, or a digest differs from the manifest's.
        FileNotFoundError: a file is missing.
    """
    folder = Path(folder)
    digests = read_digests(manifest)
    first, second = (read_orbit(folder / name, digests, velocity_tolerance_m_s) for name in FILES[:2])
    if not torch.equal(first.time_s, second.time_s):
        raise LogError(f"{FILES[1]}: epochs differ from those of {FILES[0]}")
    separation = torch.linalg.vector_norm(second.position_m - first.position_m, dim=-1)
    span = _aligned_range(folder / FILES[2], digests, first.time_s, separation)
    if inertial:
        first, second = to_inertial(first), to_inertial(second)
    return GraceLog(*first, second.position_m, second.velocity_m_s, span)


def read_orbit(
    path: str | Path, digests: Mapping[str, str] | None = None, velocity_tolerance_m_s: float = 0.1
) -> Orbit:
    """Earth-fixed orbit from rows ``d/m/yyyy,hh:mm:ss,x,y,z (km),vx,vy,vz (dm/s)``.

    Args:
        path: CSV packed by gzip, no header.
        digests: SHA-256 by file name, or None.
        velocity_tolerance_m_s: largest difference between velocity and differenced position. A wrong unit is off by
            hundreds of m/s, precise orbits by millimetres per second.

    Raises:
        LogError: damaged rows, values that are not finite, times that are not equally spaced, velocity that is not the
            derivative of position, radius inside the Earth.
    """
    path = Path(path)
    time, values = _read_rows(path, 6, digests)
    position, velocity = values[:, :3] * 1e3, values[:, 3:] * 0.1
    _check_spacing(path, time)
    low = torch.linalg.vector_norm(position, dim=-1) < 6.3e6
    if low.any():
        raise LogError(f"{path.name}: row {_row(low)}: position is inside the Earth; the unit must be km")
    slope = _differentiate(position, float(time[1] - time[0]))
    wrong = (slope - velocity).abs().amax(-1) > velocity_tolerance_m_s
    if wrong.any():
        k = _row(wrong)
        gap = (slope - velocity)[k - 1].abs().max().item()
        raise LogError(
            f"{path.name}: row {k}: velocity differs from the differenced position by {gap:.4g} m/s, more than "
            f"{velocity_tolerance_m_s} m/s; the unit must be dm/s"
        )
    return Orbit(time, position, velocity)


def read_range(path: str | Path, digests: Mapping[str, str] | None = None) -> tuple[Tensor, Tensor]:
    """Times (s) and K-band ranges (m), both (t,), from rows ``d/m/yyyy,hh:mm:ss,range``.

    Raises:
        LogError: damaged rows, values that are not finite or positive, times that do not increase.
    """
    path = Path(path)
    time, values = _read_rows(path, 1, digests)
    low = values[:, 0] <= 0
    if low.any():
        raise LogError(f"{path.name}: row {_row(low)}: range must be positive, got {values[low][0].item()} m")
    return time, values[:, 0]


def to_inertial(orbit: Orbit, earth_rate_rad_s: float = EARTH_RATE_RAD_S) -> Orbit:
    """Earth-fixed to inertial axes, equal at time zero: a rotation about z, its rate added to the velocity.

    Precession and polar motion over a day are left out; they are below what the orbits' use in this project shows.
    """
    x, y = orbit.position_m[:, 0], orbit.position_m[:, 1]
    carried = torch.stack([-y, x, torch.zeros_like(x)], -1) * earth_rate_rad_s
    angle = earth_rate_rad_s * orbit.time_s
    return Orbit(orbit.time_s, _turn_z(orbit.position_m, angle), _turn_z(orbit.velocity_m_s + carried, angle))


def _turn_z(vectors: Tensor, angle: Tensor) -> Tensor:
    x, y, z = vectors.unbind(-1)
    s, c = angle.sin(), angle.cos()
    return torch.stack([c * x - s * y, s * x + c * y, z], -1)


def _read_rows(path: Path, columns: int, digests: Mapping[str, str] | None) -> tuple[Tensor, Tensor]:
    """Times (t,) and numbers (t, columns); every rule that one row can break."""
    text = read_packed_text(path, digests)
    if not text.endswith("\n"):
        raise LogError(f"{path.name}: row {text.count(chr(10)) + 1}: no line end; the file is cut short")
    lines = text.split("\n")[:-1]
    days: list[datetime.date] = []
    times, values = [], []
    for row, line in enumerate(lines, start=1):
        fields = line.rstrip("\r").split(",")
        if len(fields) != columns + 2:
            raise LogError(f"{path.name}: row {row}: {len(fields)} columns, expected {columns + 2}")
        try:
            day, second = _date(fields[0]), _seconds(fields[1])
            numbers = [float(field) for field in fields[2:]]
        except ValueError as error:
            raise LogError(f"{path.name}: row {row}: {error}") from error
        if not all(map(math.isfinite, numbers)):
            raise LogError(f"{path.name}: row {row}: values must be finite, got {line!r}")
        days.append(day)
        times.append((day - days[0]).days * 86400.0 + second)
        if row > 1 and times[-1] <= times[-2]:
            raise LogError(f"{path.name}: row {row}: time goes from {times[-2]} s to {times[-1]} s; it must increase")
        values.append(numbers)
    if len(values) < 5:
        raise LogError(f"{path.name}: {len(values)} rows, at least 5 are needed")
    return torch.tensor(times, dtype=torch.float64), torch.tensor(values, dtype=torch.float64)


def _date(text: str) -> datetime.date:
    parts = text.split("/")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"date must be d/m/yyyy, got {text!r}")
    day, month, year = map(int, parts)
    return datetime.date(year, month, day)


def _seconds(text: str) -> float:
    parts = text.split(":")
    if len(parts) != 3 or not all(len(part) == 2 and part.isdecimal() for part in parts):
        raise ValueError(f"time must be hh:mm:ss, got {text!r}")
    hours, minutes, seconds = map(int, parts)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ValueError(f"time must be hh:mm:ss, got {text!r}")
    return 3600.0 * hours + 60.0 * minutes + seconds


def _check_spacing(path: Path, time: Tensor) -> None:
    steps = time.diff()
    odd = steps != steps[0]
    if odd.any():
        k = int(odd.nonzero()[0]) + 2
        raise LogError(f"{path.name}: row {k}: step of {steps[k - 2].item()} s after steps of {steps[0].item()} s")


def _differentiate(values: Tensor, step_s: float) -> Tensor:
    """Fourth-order differences of (t, k), one-sided at the ends: error 1e-3 m/s or less for low orbits at 10 s."""
    inside = (values[:-4] - values[4:] + 8 * (values[3:-1] - values[1:-3])) / 12
    sides = []
    for ends in (values[:5], -values.flip(0)[:5]):
        a, b, c, d, e = ends
        sides.append((-25 * a + 48 * b - 36 * c + 16 * d - 3 * e) / 12)
        sides.append((-3 * a - 10 * b + 18 * c - 6 * d + e) / 12)
    first, second, last, before = sides
    return torch.cat([torch.stack([first, second]), inside, torch.stack([before, last])]) / step_s


def _aligned_range(path: Path, digests: Mapping[str, str] | None, time: Tensor, separation: Tensor) -> Tensor:
    """Ranges at the orbits' epochs, NaN where there is none."""
    when, distance = read_range(path, digests)
    place = torch.searchsorted(time, when).clamp(max=len(time) - 1)
    strange = time[place] != when
    if strange.any():
        raise LogError(f"{path.name}: row {_row(strange)}: no orbit has an epoch at {when[strange][0].item()} s")
    # The range is anchored at an orbit: a metre is a hundred times its bias; a wrong unit or file is far more.
    far = (distance - separation[place]).abs() > 1.0
    if far.any():
        raise LogError(f"{path.name}: row {_row(far)}: range differs from the orbits' separation by more than 1 m")
    result = torch.full_like(time, torch.nan)
    result[place] = distance
    return result


def _row(mask: Tensor) -> int:
    """Number of the first marked row, counted from 1."""
    return int(mask.nonzero()[0]) + 1
