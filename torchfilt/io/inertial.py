"""What a log of inertial sensors with satellite fixes holds, and the rules that every such log must keep.

Readers of single logs (`uav_thor`, `car_loop`) turn units and axes and end here. Everything is float64; body axes are
right, forward, up (RFU), navigation axes east, north, up (ENU), heading runs clockwise from north.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchfilt.io.files import LogError
from torchfilt.models.inertial.imu import check_imu

_EARTH_RADIUS_M = 6.371e6

Gaps = Literal["refuse", "mark"]


class GnssFixes(NamedTuple):
    """Fixes of a satellite receiver at its own g epochs, one row a fix (held values are gone).

    time_s, latitude_rad, longitude_rad, height_m (g,): WGS-84 and the log's clock. velocity_m_s (g, 3): ENU.
    position_sd_m, velocity_sd_m_s (g, 3): ENU, as the receiver states them, None where the log has none.
    heading_rad (g,): from the receiver, NaN where it has none; None where the log has none.
    """

    time_s: Tensor
    latitude_rad: Tensor
    longitude_rad: Tensor
    height_m: Tensor
    velocity_m_s: Tensor
    position_sd_m: Tensor | None = None
    velocity_sd_m_s: Tensor | None = None
    heading_rad: Tensor | None = None


class Reference(NamedTuple):
    """Another navigation filter's answer at its r epochs, for scoring only; it has seen the same fixes.

    time_s, heading_rad, pitch_rad (nose up), roll_rad (right side down), latitude_rad, longitude_rad, height_m (r,);
    velocity_m_s (r, 3): ENU. NaN where the other filter had no answer.
    """

    time_s: Tensor
    heading_rad: Tensor
    pitch_rad: Tensor
    roll_rad: Tensor
    latitude_rad: Tensor
    longitude_rad: Tensor
    height_m: Tensor
    velocity_m_s: Tensor


class InertialLog(NamedTuple):
    """t inertial samples, g fixes, r references.

    time_s (t,); gyro_rad_s, accel_m_s2 (t, 3): rate and specific force, body RFU. The sample at ``time_s[i]`` stands
    for the interval since ``time_s[i - 1]``.
    gaps (k,): indices i of samples that follow a gap (int64); empty unless the reader was told to mark gaps.
    pressure_height_m (t,): barometric, from an arbitrary zero; None without a barometer.
    magnetic_field_tesla (t, 3): calibrated, body RFU; None without a magnetometer.
    """

    time_s: Tensor
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    gnss: GnssFixes
    reference: Reference
    gaps: Tensor
    pressure_height_m: Tensor | None = None
    magnetic_field_tesla: Tensor | None = None


class GroupedIncrements(NamedTuple):
    """Inertial samples between k + 1 successive filter times.

    time_s (k,): ends of the steps; dt_s (k,): their lengths.
    dtheta_rad, dv_m_s (k, 3): plain sums of rate and specific force over each step (no coning, no sculling).
    whole (k,): False where a marked gap of the log lies in the step.
    gyro_rad_s, accel_m_s2 (k, s, 3), sample_dt_s (k, s): the samples behind the sums, for who compensates; steps with
    fewer than s samples end in rows of zero length.
    """

    time_s: Tensor
    dt_s: Tensor
    dtheta_rad: Tensor
    dv_m_s: Tensor
    whole: Tensor
    gyro_rad_s: Tensor
    accel_m_s2: Tensor
    sample_dt_s: Tensor


def group_increments(
    log: InertialLog, rate_hz: float | None = None, *, times_s: Tensor | None = None
) -> GroupedIncrements:
    """Increments of angle and velocity between filter times.

    A filter time within a sample's interval splits the sample in proportion, so steps end exactly where asked.

    Args:
        rate_hz: equal steps from the first sample on; the rest behind the last whole step is left out.
        times_s: (k + 1,) start of the first step and ends of all steps, instead of a rate; within the samples' span.

    Raises:
        ValueError: neither or both of rate and times, a rate that is not positive, times that do not increase or that
            lie outside the samples' span.
    """
    edges = _edges(log.time_s, rate_hz, times_s)
    inside = log.time_s[(log.time_s > edges[0]) & (log.time_s < edges[-1])]
    ends = torch.cat([inside, edges]).unique()  # sorted
    length, ends = ends.diff(), ends[1:]
    sample = torch.searchsorted(log.time_s, ends)
    step = torch.searchsorted(edges, ends) - 1
    steps = len(edges) - 1
    count = torch.bincount(step, minlength=steps)
    place = torch.arange(len(step)) - (count.cumsum(0) - count)[step]

    def spread(values: Tensor) -> Tensor:
        padded = values.new_zeros(steps, int(count.max()), *values.shape[1:])
        padded[step, place] = values
        return padded

    gyro, accel, dt = spread(log.gyro_rad_s[sample]), spread(log.accel_m_s2[sample]), spread(length)
    whole = torch.ones(steps, dtype=torch.bool)
    whole[step[torch.isin(sample, log.gaps)]] = False
    dtheta, dv = (gyro * dt.unsqueeze(-1)).sum(1), (accel * dt.unsqueeze(-1)).sum(1)
    return GroupedIncrements(edges[1:], edges.diff(), dtheta, dv, whole, gyro, accel, dt)


def _edges(time: Tensor, rate_hz: float | None, times_s: Tensor | None) -> Tensor:
    if (rate_hz is None) == (times_s is None):
        raise ValueError("give either a rate or times")
    first, last = time[0].item(), time[-1].item()
    if times_s is None:
        assert rate_hz is not None
        if not 0 < rate_hz < torch.inf:
            raise ValueError(f"rate must be positive and finite, got {rate_hz} Hz")
        # A part in 1e9 of a step is rounding: a log of 1 s holds 10 steps at 10 Hz.
        steps = int((last - first) * rate_hz + 1e-9)
        if steps < 1:
            raise ValueError(f"no step of {1 / rate_hz:.6g} s fits into the {last - first:.6g} s of the log")
        return (first + torch.arange(steps + 1, dtype=time.dtype) / rate_hz).clamp(max=last)
    times = torch.as_tensor(times_s, dtype=time.dtype)
    if times.ndim != 1 or len(times) < 2 or not (times.diff() > 0).all():
        raise ValueError(f"times must be one row of at least two numbers that increase, got shape {tuple(times.shape)}")
    if times[0] < first or times[-1] > last:
        raise ValueError(
            f"times go from {times[0].item():.6g} to {times[-1].item():.6g} s, the samples from {first:.6g} to "
            f"{last:.6g} s"
        )
    return times


def check_samples(
    name: str, time_s: Tensor, gyro_rad_s: Tensor, accel_m_s2: Tensor, max_gap_s: float, gaps: Gaps
) -> Tensor:
    """Refuse inertial samples that cannot be true.

    Args:
        name: of the file, for messages.
        time_s: (t,); gyro_rad_s, accel_m_s2: (t, 3).
        max_gap_s: longest step between samples.
        gaps: "refuse" a longer step, or "mark" it.

    Returns:
        Indices (k,) of the samples that follow a longer step.

    Raises:
        ValueError: `gaps` or `max_gap_s` is none of the above.
        LogError: a rule of `torchfilt.models.inertial.imu.check_imu` is broken; samples count from 0 there.
    """
    if gaps not in ("refuse", "mark"):
        raise ValueError(f'gaps must be "refuse" or "mark", got {gaps!r}')
    if not max_gap_s > 0:
        raise ValueError(f"max_gap_s must be positive, got {max_gap_s}")
    try:
        check_imu(time_s, gyro_rad_s, accel_m_s2, max_gap_s if gaps == "refuse" else float("inf"))
    except ValueError as error:
        raise LogError(f"{name}: {error}") from error
    return (time_s.diff() > max_gap_s).nonzero().squeeze(-1) + 1


def check_fixes(name: str, fixes: GnssFixes, tolerance_m_s: float = 3.0) -> None:
    """Refuse satellite fixes whose numbers, units or axes cannot be true; rows are counted from 1.

    Position must move as velocity says: in the median over the log, the difference is below the tolerance (receivers
    keep it below 1 m/s; a wrong unit or exchanged axes are off by the vehicle's speed).

    Raises:
        LogError: values that are not finite, times that do not increase, latitude or longitude that are no radians, a
            standard deviation that is not positive, or position and velocity that disagree.
    """
    check_times(name, fixes.time_s)
    for what, values in zip(fixes._fields[1:7], fixes[1:7], strict=True):
        if values is not None:
            check_finite(name, what, values)
            if what.endswith(("_sd_m", "_sd_m_s")):
                refuse(name, (values <= 0).any(-1), values.amin(-1), f"of {what}; it must be positive")
    refuse(name, fixes.latitude_rad.abs() > torch.pi / 2, fixes.latitude_rad, "rad of latitude; is it in degrees?")
    refuse(name, fixes.longitude_rad.abs() > torch.pi, fixes.longitude_rad, "rad of longitude; is it in degrees?")
    east = fixes.longitude_rad.diff() * fixes.latitude_rad[:-1].cos() * _EARTH_RADIUS_M
    moved = torch.stack([east, fixes.latitude_rad.diff() * _EARTH_RADIUS_M, fixes.height_m.diff()], -1)
    mean = (fixes.velocity_m_s[1:] + fixes.velocity_m_s[:-1]) / 2
    off = (moved / fixes.time_s.diff().unsqueeze(-1) - mean).norm(dim=-1).median().item()
    if off > tolerance_m_s:
        raise LogError(
            f"{name}: velocity differs from the differenced position by {off:.3g} m/s in the median, more than "
            f"{tolerance_m_s} m/s; check units and axes"
        )


def check_times(name: str, time_s: Tensor) -> None:
    """Refuse fewer than two times, and times that are not finite or do not increase, by file and row.

    Raises:
        LogError: as said.
    """
    if len(time_s) < 2:
        raise LogError(f"{name}: {len(time_s)} rows, at least 2 are needed")
    check_finite(name, "time", time_s)
    back = time_s.diff() <= 0
    if back.any():
        k = row(back)
        raise LogError(
            f"{name}: row {k + 1}: time goes from {time_s[k - 1].item()} s to {time_s[k].item()} s; it must increase"
        )


def check_finite(name: str, what: str, values: Tensor) -> None:
    """Refuse values that are not finite, by file and row.

    Raises:
        LogError: as said.
    """
    bad = ~values.isfinite()
    refuse(name, bad.reshape(len(values), -1).any(-1), values, f"of {what}; values must be finite")


def refuse(name: str, mask: Tensor, values: Tensor, rule: str) -> None:
    """Refuse the first marked row.

    Raises:
        LogError: with file, row, value and rule.
    """
    if mask.any():
        k = row(mask)
        raise LogError(f"{name}: row {k}: got {values[k - 1].tolist()} {rule}")


def row(mask: Tensor) -> int:
    """Number of the first marked row, counted from 1."""
    return int(mask.nonzero()[0]) + 1
