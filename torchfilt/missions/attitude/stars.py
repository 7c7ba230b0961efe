"""Pose of a hand-moved camera over known beacons against motion capture, from a pose that nobody knows.

A state is 7 numbers on `POSE_SPACE`: quaternion from vehicle to inertial axes, error on the left, and position in m.
Measured rate and velocity move it, tangents of the beacons in the left camera correct it. At the start the attitude is
any rotation and the position anywhere in the room, and one beacon is in view: a Gaussian holds that badly, a bank of
Gaussians that are spread over what the first sighting leaves open holds it well.

A filter of a step knows the beacons that the step sees and no others; the belief goes from one to the next. Columns of
NaN for the rest would say the same, at a multiple of the price.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import torchfilt as tf
from torchfilt.io.starry_night import Camera, StarryNight, read_starry_night
from torchfilt.laws import hold
from torchfilt.metrics import nees
from torchfilt.missions.stages import Arrays, check_names
from torchfilt.missions.study import digest, run_study
from torchfilt.models.attitude import from_rotation_vector, inverse, mean_rotation, multiply, rotate, skew, to_matrix
from torchfilt.particles import uniform_log_weights
from torchfilt.spaces import EUCLIDEAN, Euclidean, Product, UnitQuaternion

__all__ = [
    "FILTERS",
    "POSE_SPACE",
    "PoseTransition",
    "Sightings",
    "StarsSettings",
    "follow",
    "make_filter",
    "run_stars",
    "spread_start",
    "summarize",
]

FILTERS = ("mekf", "ukf", "llpf")
POSE_SPACE = Product(UnitQuaternion("left"), Euclidean(3))
# Results of another version of the arithmetic are not reused: raise this with it.
_VERSION = 1
_ANY_ATTITUDE_RAD = math.pi / math.sqrt(3)
# Converged: errors below both for so long.
_CONVERGED_DEG, _CONVERGED_M, _HOLD_S = 10.0, 0.3, 10.0
_FREEDOM = 6

Step = Tensor | float | None


@dataclass(frozen=True)
class StarsSettings:
    """How the log is filtered.

    Args:
        data: folder of the log.
        starts: initial attitudes, uniform over rotations, of the single filters; draws of the bank.
        room_low_m, room_high_m: corners of the room, inertial; the position is anywhere in it.
        motion_scale: deviations of rate and velocity over those that the log states. sighting_scale: of the tangents.
        iterations: linearisations of a measurement in the error-state filter and in each member of the bank.
        particles, seed: of the bank. member_sd_deg, member_sd_m: each member's own deviation at the start, an axis.
        start_s, stop_s: the part of the log that is filtered; None: to its end. It begins with the first sighting.

    Raises:
        ValueError: a number that is not positive and finite, a room without a volume, a stop before the start.
    """

    data: str = "data/starry_night"
    starts: int = 8
    room_low_m: tuple[float, float, float] = (0.0, -1.0, 0.0)
    room_high_m: tuple[float, float, float] = (5.0, 4.0, 3.0)
    motion_scale: float = 1.0
    sighting_scale: float = 1.0
    iterations: int = 4
    particles: int = 200
    member_sd_deg: float = 25.0
    member_sd_m: float = 0.5
    seed: int = 0
    start_s: float = 0.0
    stop_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("starts", "motion_scale", "sighting_scale", "iterations", "particles", "member_sd_deg"):
            _check_positive(name, getattr(self, name))
        _check_positive("member_sd_m", self.member_sd_m)
        corners = list(zip(self.room_low_m, self.room_high_m, strict=False))
        sizes = {len(self.room_low_m), len(self.room_high_m)}
        if sizes != {3} or not all(-math.inf < low < high < math.inf for low, high in corners):
            got = f"{self.room_low_m} and {self.room_high_m}"
            raise ValueError(f"room_low_m must be below room_high_m, three numbers each, got {got}")
        stop = math.inf if self.stop_s is None else self.stop_s
        if not 0 <= self.start_s < stop:
            raise ValueError(f"start_s must be from 0 to below stop_s, got {self.start_s} and {self.stop_s}")


def _check_positive(name: str, value: float) -> None:
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be positive and finite, got {value}")


# Laws -----------------------------------------------------------------------------------------------------------------


class PoseTransition(nn.Module):
    """Pose after a step at constant rate (rad/s) and velocity (m/s) in vehicle axes, together the control u (..., 6).

    Mean: the vehicle turns by rate dt and moves along its turning axes, exactly. Noise: the errors of both last for the
    step, so that deviations grow with dt, not with its root; they turn with the vehicle.

    Args:
        rate_sd_rad_s, velocity_sd_m_s: (3,), of the control's axes.

    Raises:
        ValueError: deviations that are not three positive finite numbers; when called, a state without 7 numbers, no
            control of 6, no time step.
    """

    rate_sd: Tensor
    velocity_sd: Tensor

    def __init__(self, rate_sd_rad_s: Tensor, velocity_sd_m_s: Tensor) -> None:
        super().__init__()
        hold(self, "rate_sd", _deviations("rate_sd_rad_s", rate_sd_rad_s, 3))
        hold(self, "velocity_sd", _deviations("velocity_sd_m_s", velocity_sd_m_s, 3))
        self.space = POSE_SPACE

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tf.Gaussian:
        """Law of the pose (..., 7) after dt (number or (..., 1)), s."""
        return self._law(x, *self._move(x, u, dt), dt)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[tf.Gaussian, Tensor]:
        """The law at x and the derivative (..., 6, 6) of its mean's error by the error of x."""
        after, moved = self._move(x, u, dt)
        eye = torch.eye(3, dtype=x.dtype, device=x.device).expand(*moved.shape, 3)
        rows = torch.cat([eye, torch.zeros_like(eye)], -1), torch.cat([-skew(moved), eye], -1)
        return self._law(x, after, moved, dt), torch.cat(rows, -2)

    def _move(self, x: Tensor, u: Tensor | None, dt: Step) -> tuple[Tensor, Tensor]:
        """Attitude after the step, and the way in inertial axes."""
        if x.shape[-1] != 7:
            raise ValueError(f"the state must be (..., 7), got {tuple(x.shape)}")
        if u is None or u.shape[-1] != 6:
            got = "none" if u is None else f"shape {tuple(u.shape)}"
            raise ValueError(f"this law needs rate and velocity as a control u (..., 6), got {got}")
        if dt is None:
            raise ValueError("this law needs the time step dt")
        turn, way = u[..., :3] * dt, u[..., 3:] * dt
        along = (mean_rotation(turn) @ way.unsqueeze(-1)).squeeze(-1)
        attitude = multiply(*torch.broadcast_tensors(x[..., :4], from_rotation_vector(turn)))
        # Rounding would add up over the steps.
        attitude = attitude / torch.linalg.vector_norm(attitude, dim=-1, keepdim=True)
        return attitude, rotate(x[..., :4], along)

    def _law(self, x: Tensor, after: Tensor, moved: Tensor, dt: Step) -> tf.Gaussian:
        mean = torch.cat([after, x[..., 4:] + moved], -1)
        axes = to_matrix(after)
        blocks = []
        for sd in (self.rate_sd, self.velocity_sd):
            columns = axes * sd.to(x.dtype)
            block, failed = torch.linalg.cholesky_ex(columns @ columns.mT)
            blocks.append(torch.where((failed > 0)[..., None, None], torch.nan, block))
        zero = torch.zeros_like(blocks[0])
        factor = torch.cat([torch.cat([blocks[0], zero], -1), torch.cat([zero, blocks[1]], -1)], -2)
        assert dt is not None
        step = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() > 0 else dt
        return tf.Gaussian(mean, factor * step, POSE_SPACE)


class Sightings(nn.Module):
    """Where a camera sees n beacons: tangents (..., 2 n) off its optical axis, x/z and y/z of each.

    The tangents are finite for every pose: a beacon more than ``edge_rad`` off the axis, or behind the camera, is
    brought back to that edge, straight towards the axis. Inside, the law is exact.

    Args:
        beacons_m: (n, 3), inertial. camera: where the camera is. sd: (2,), of the tangents. edge_rad: see above.

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite, a deviation that is not positive, an edge
            outside (0, pi/2); when called, a state without 7 numbers.
    """

    beacons_m: Tensor
    deviation: Tensor
    to_camera: Tensor
    camera_m: Tensor

    def __init__(self, beacons_m: Tensor, camera: Camera, sd: Tensor, *, edge_rad: float = math.radians(80)) -> None:
        super().__init__()
        if beacons_m.dim() != 2 or beacons_m.shape[-1] != 3 or not len(beacons_m):
            raise ValueError(f"beacons_m must be (n, 3) with n >= 1, got {tuple(beacons_m.shape)}")
        if not bool(torch.isfinite(beacons_m).all()):
            raise ValueError(f"beacons_m must be finite, got {beacons_m.tolist()}")
        if not 0 < edge_rad < math.pi / 2:
            raise ValueError(f"edge_rad must be in (0, pi/2), got {edge_rad}")
        self.size = 2 * len(beacons_m)
        hold(self, "beacons_m", beacons_m)
        hold(self, "deviation", _deviations("sd", sd, 2).repeat(len(beacons_m)))
        hold(self, "to_camera", to_matrix(camera.quaternion).mT.contiguous())
        hold(self, "camera_m", camera.position_m)
        self.edge = math.tan(edge_rad)

    def forward(self, x: Tensor) -> tf.Gaussian:
        """Law of the tangents (..., 2 n) at poses (..., 7)."""
        seen, _ = self._seen(x)
        across, depth = seen[..., :2], self._depth(seen)[0]
        return self._law((across / depth).flatten(-2))

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[tf.Gaussian, Tensor]:
        """The law at x and its derivative (..., 2 n, 6) by the error of x."""
        seen, away = self._seen(x)
        depth, by_depth = self._depth(seen)
        tangents = seen[..., :2] / depth
        eye = torch.eye(2, 3, dtype=x.dtype, device=x.device)
        slope = (eye - tangents.unsqueeze(-1) * by_depth.unsqueeze(-2)) / depth.unsqueeze(-1)
        turned = slope @ (self.to_camera.to(x.dtype) @ to_matrix(x[..., :4]).mT).unsqueeze(-3)
        jacobian = torch.cat([turned @ skew(away), -turned], -1)
        return self._law(tangents.flatten(-2)), jacobian.flatten(-3, -2)

    def _law(self, tangents: Tensor) -> tf.Gaussian:
        return tf.Gaussian(tangents, self.deviation.to(tangents.dtype), EUCLIDEAN, is_diagonal=True)

    def _seen(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Beacons (..., n, 3) in camera axes, and from the vehicle in inertial ones."""
        if x.shape[-1] != 7:
            raise ValueError(f"the state must be (..., 7), got {tuple(x.shape)}")
        away = self.beacons_m.to(x.dtype) - x[..., None, 4:]
        body = rotate(inverse(x[..., None, :4]), away) - self.camera_m.to(x.dtype)
        return body @ self.to_camera.to(x.dtype).mT, away

    def _depth(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Depth (..., n, 1), not below that of the edge, and its derivative (..., n, 3)."""
        across = seen[..., :2]
        tiny = torch.finfo(seen.dtype).tiny ** 0.5
        least = (across.square().sum(-1, keepdim=True) + tiny).sqrt() / self.edge
        inside = seen[..., 2:] >= least
        at_edge = torch.cat([across / (least * self.edge**2), torch.zeros_like(least)], -1)
        ahead = torch.cat([torch.zeros_like(across), torch.ones_like(least)], -1)
        return torch.maximum(seen[..., 2:], least), torch.where(inside, ahead, at_edge)


def _deviations(name: str, value: Tensor, size: int) -> Tensor:
    if value.shape != (size,) or not bool((torch.isfinite(value.detach()) & (value.detach() > 0)).all()):
        raise ValueError(f"{name} must be ({size},) positive finite numbers, got {value.tolist()}")
    return value


# Filters --------------------------------------------------------------------------------------------------------------


def read_part(settings: StarsSettings) -> StarryNight:
    """The log from the first sighting after the start on, up to the stop.

    Raises:
        ValueError: no beacon seen in the part. torchfilt.io.files.LogError: a damaged or foreign log.
    """
    log = read_starry_night(settings.data)
    stamp = log.times_s - log.times_s[0]
    inside = (stamp >= settings.start_s) & (stamp <= (math.inf if settings.stop_s is None else settings.stop_s))
    sighted = (inside & log.tangents[..., 0].isfinite().any(-1)).nonzero()[:, 0]
    if not len(sighted):
        raise ValueError(f"no beacon is seen from {settings.start_s} s to {settings.stop_s} s")
    rows = slice(int(sighted[0]), int(inside.nonzero()[-1]) + 1)
    names = ("times_s", "rate_rad_s", "velocity_m_s", "tangents", "quaternion", "position_m")
    return log._replace(**{name: getattr(log, name)[rows] for name in names})


def make_filter(name: str, log: StarryNight, beacons: Sequence[int], settings: StarsSettings) -> Any:
    """A filter that sees these beacons; its prior is the room and any attitude.

    Raises:
        ValueError: unknown name.
    """
    check_names([name], FILTERS, "filters")
    attitudes = _any_attitude(settings.starts, settings.seed)
    low, high = (log.times_s.new_tensor(corner) for corner in (settings.room_low_m, settings.room_high_m))
    mean = torch.cat([attitudes, ((low + high) / 2).expand(settings.starts, 3)], -1)
    deviation = torch.cat([torch.full_like(low, _ANY_ATTITUDE_RAD), (high - low) / math.sqrt(12)])
    prior = tf.Gaussian(mean, deviation, POSE_SPACE, is_diagonal=True)
    motion = [settings.motion_scale * variance.sqrt() for variance in (log.rate_variance, log.velocity_variance)]
    sd = settings.sighting_scale * log.tangent_variance[:2].sqrt()
    sightings = Sightings(log.beacons_m[list(beacons)], log.camera, sd)
    model = tf.StateSpaceModel(prior, PoseTransition(*motion), sightings)
    if name == "mekf":
        return tf.ErrorStateKalmanFilter(model, iterations=settings.iterations)
    if name == "ukf":
        return tf.UnscentedKalmanFilter(model)
    rule = tf.moments.taylor()
    return tf.LocallyLinearizedParticleFilter(model, settings.particles, rule, iterations=settings.iterations)


def spread_start(log: StarryNight, settings: StarsSettings) -> tf.Particles:
    """Banks (starts, n) that agree with the first sighting of the log, and with nothing else that is not known.

    The camera is anywhere in the room. The attitude turns the line of sight to the beacon; the turn about that line,
    which the sighting leaves open, is uniform.
    """
    shape = (settings.starts, settings.particles)
    generator = torch.Generator().manual_seed(settings.seed)
    uniforms = torch.rand((*shape, 4), generator=generator, dtype=log.times_s.dtype)
    low, high = (log.times_s.new_tensor(corner) for corner in (settings.room_low_m, settings.room_high_m))
    camera = low + (high - low) * uniforms[..., :3]
    beacon = int(log.tangents[0, :, 0].isfinite().nonzero()[0])
    tangents = log.tangents[0, beacon, :2]
    sight = rotate(log.camera.quaternion, torch.cat([tangents, torch.ones_like(tangents[:1])]))
    sight = (sight / sight.norm()).expand(*shape, 3)
    away = log.beacons_m[beacon] - camera
    away = away / away.norm(dim=-1, keepdim=True)
    # The shortest turn from one to the other, then one about the line.
    turn = torch.cat([torch.linalg.cross(sight, away), 1 + (sight * away).sum(-1, keepdim=True)], -1)
    turn = turn / turn.norm(dim=-1, keepdim=True)
    attitude = multiply(from_rotation_vector(away * (2 * math.pi * uniforms[..., 3:])), turn)
    position = camera - rotate(attitude, log.camera.position_m)
    own = log.times_s.new_tensor([math.radians(settings.member_sd_deg)] * 3 + [settings.member_sd_m] * 3)
    factor = torch.diag(own).expand(*shape, _FREEDOM, _FREEDOM)
    x = torch.cat([attitude, position], -1)
    return tf.Particles(x, uniform_log_weights(shape, x), factor, POSE_SPACE)


def _any_attitude(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn((count, 4), generator=generator, dtype=torch.float64)
    return normals / normals.norm(dim=-1, keepdim=True)


# Study ----------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def follow(name: str, log: StarryNight, settings: StarsSettings, progress: bool = False) -> Arrays:
    """Run a filter from all starts as one batch.

    Returns:
        time_s (k,), truth (k, 7), seen (k,) beacons; mean (k, R, 7), deviation (k, R, 6), error_m, error_deg, nees
        (k, R); nis (k, R), by measured number, NaN for the bank and where nothing is seen; cpu_s.

    Raises:
        ValueError: unknown name. torchfilt.types.FilterError: the filter failed.
    """
    from tqdm import tqdm

    make = cache(lambda beacons: make_filter(name, log, beacons, settings))
    rows, begin = settings.starts, time.process_time()
    tangents, controls = log.tangents[..., :2], torch.cat([log.rate_rad_s, log.velocity_m_s], -1)
    visible, steps = tangents[..., 0].isfinite(), log.times_s.diff(prepend=log.times_s[:1]).tolist()
    state, kept = make((0,)).init((rows,), settings.seed), []
    if name == "llpf":
        state = state._replace(belief=spread_start(log, settings))
    for k in tqdm(range(len(steps)), unit="step", disable=None if progress else True):
        beacons = tuple(visible[k].nonzero()[:, 0].tolist()) or (0,)
        y = tangents[k, list(beacons)].flatten().expand(rows, -1)
        state, info = make(beacons).step(state, y, controls[k], steps[k], predict_first=k > 0)
        mean, covariance = state.belief.moments() if name == "llpf" else (state.belief.mean, state.belief.covariance)
        nis = torch.full((rows,), torch.nan) if info.nis is None or not visible[k].any() else info.nis / y.shape[-1]
        kept.append((mean, covariance.expand(rows, _FREEDOM, _FREEDOM), nis.expand(rows)))
    mean, covariance, nis = (torch.stack(values) for values in zip(*kept, strict=True))
    truth = torch.cat([log.quaternion, log.position_m], -1)
    error = POSE_SPACE.local(mean, truth.unsqueeze(1).expand_as(mean))
    found = {
        "time_s": log.times_s - log.times_s[0],
        "truth": truth,
        "seen": visible.sum(-1),
        "mean": mean,
        "deviation": covariance.diagonal(dim1=-2, dim2=-1).sqrt(),
        "error_m": error[..., 3:].norm(dim=-1),
        "error_deg": error[..., :3].norm(dim=-1).rad2deg(),
        "nees": nees(mean, truth.unsqueeze(1).expand_as(mean), covariance, POSE_SPACE) / _FREEDOM,
        "nis": nis,
    }
    return {key: value.numpy() for key, value in found.items()} | {"cpu_s": np.array(time.process_time() - begin)}


def summarize(result: Arrays) -> dict[str, Any]:
    """Numbers of one filter, JSON-ready.

    A start has converged when its errors stay below 10 deg and 0.3 m for 10 s. What comes later counts whatever it is.

    Returns:
        converged: share of the starts; converged_s: of each start, None where it has not. Over the steps of converged
        starts after that time, None without any: position_m and attitude_deg (median and rms), nees and nis (means, by
        degree of freedom). cpu_s.
    """
    stamp = result["time_s"]
    near = (result["error_m"] < _CONVERGED_M) & (result["error_deg"] < _CONVERGED_DEG)
    settled = [_settled(stamp, row) for row in near.T]
    scored = np.stack([stamp >= (np.inf if s is None else s) for s in settled], -1)
    found: dict[str, Any] = {"converged": float(scored.any(0).mean()), "converged_s": settled}
    found |= dict.fromkeys(("position_m", "attitude_deg", "nees", "nis"))
    if scored.any():
        for key, name in (("position_m", "error_m"), ("attitude_deg", "error_deg")):
            error = result[name][scored]
            found[key] = {"median": float(np.median(error)), "rms": float(np.sqrt((error**2).mean()))}
        nis = result["nis"][scored]
        found["nees"] = float(result["nees"][scored].mean())
        found["nis"] = None if np.isnan(nis).all() else float(np.nanmean(nis))
    return found | {"cpu_s": float(result["cpu_s"])}


def _settled(stamp: np.ndarray, near: np.ndarray) -> float | None:
    """First time from which all steps of the next 10 s are near; None: there is none."""
    off = np.append(stamp[~near], np.inf)
    whole = stamp <= stamp[-1] - _HOLD_S
    held = near & whole & (off[np.searchsorted(off, stamp)] > stamp + _HOLD_S)
    return float(stamp[np.argmax(held)]) if held.any() else None


def table(summary: dict[str, Any]) -> list[str]:
    """Lines of a text table, a row a filter."""
    lines = ["filter  converged   after s (median)   position m: median, rms   attitude deg: median, rms   NEES   NIS"]
    for name, found in summary["filters"].items():
        line = f"{name:8s}{found['converged']:9.2f}"
        if found["position_m"] is not None:
            after = np.median([s for s in found["converged_s"] if s is not None])
            position, attitude = (found[key] for key in ("position_m", "attitude_deg"))
            line += f"{after:19.1f}{position['median']:18.3f}{position['rms']:8.3f}"
            line += f"{attitude['median']:20.2f}{attitude['rms']:7.2f}{found['nees']:7.1f}"
            line += "" if found["nis"] is None else f"{found['nis']:6.2f}"
        lines.append(line)
    return lines


def run_stars(
    settings: StarsSettings,
    out: str | Path,
    filters: Sequence[str] | None = None,
    *,
    say: Callable[[str], None] = print,
    progress: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Run the study; stages that the folder already holds for these settings are not computed again.

    Args:
        settings: see `StarsSettings`. out: run folder; receives stages/, figures/, table.txt and metrics.json.
        filters: names out of `FILTERS`; default all.
        say: told what happens, a line each. progress: show bars on a terminal. figures: draw them.

    Returns:
        What metrics.json holds: filters (by name, see `summarize`), settings, versions.

    Raises:
        ValueError: unknown filter, no sighting in the part. torchfilt.io.files.LogError: a damaged or foreign log.
    """
    names = FILTERS if filters is None else tuple(filters)
    check_names(names, FILTERS, "filters")
    log = read_part(settings)
    return run_study(
        names,
        settings,
        out,
        recipe=lambda name: {"version": _VERSION, **asdict(settings), "log": digest(log)},
        follow=lambda name: follow(name, log, settings, progress),
        summarize=lambda name, result: summarize(result),
        table=table,
        draw=_figures if figures else None,
        say=say,
    )


def _figures(results: dict[str, Arrays], folder: Path) -> list[Path]:
    """Paths from the first start; lengths of the errors from all starts; errors of the first start with 3 sigma."""
    from torchfilt.learning.figures import save_figure
    from torchfilt.missions.figures import COLOURS, new_figure, plot_error_band, plot_path

    folder.mkdir(parents=True, exist_ok=True)
    paths, axes = new_figure(1, 2, (10, 5), "Path from the first start")
    estimates = {name: result["mean"][:, 0, 4:] for name, result in results.items()}
    truth = next(iter(results.values()))["truth"]
    for ax, shown in zip(axes[0], ((0, 1), (1, 2)), strict=True):
        plot_path(truth[:, 4:], estimates, shown, ax)
    axes[0, 0].legend(fontsize=7)
    save_figure(paths, folder / "path.png")
    lengths, axes = new_figure(2, 1, (9, 6), "Errors from all starts", sharex=True)
    for k, (name, result) in enumerate(results.items()):
        for ax, key in zip(axes[:, 0], ("error_m", "error_deg"), strict=True):
            for r, error in enumerate(result[key].T):
                ax.semilogy(result["time_s"], error, lw=0.6, color=COLOURS[k], label=name if r == 0 else None)
    for ax, label in zip(axes[:, 0], ("position, m", "attitude, deg"), strict=True):
        ax.set_ylabel(label)
        ax.grid(alpha=0.25, lw=0.5)
    axes[0, 0].legend(fontsize=7)
    axes[1, 0].set_xlabel("time, s")
    save_figure(lengths, folder / "errors.png")
    written = [folder / "path.png", folder / "errors.png"]
    for name, result in results.items():
        bands, axes = new_figure(3, 2, (10, 7), f"{name}: error from the first start, ±3 sigma claimed", sharex=True)
        mean = torch.from_numpy(result["mean"][:, 0])
        error = POSE_SPACE.local(mean, torch.from_numpy(result["truth"])).numpy()
        for k in range(_FREEDOM):
            scale, unit, limit = (180 / math.pi, "deg", 15.0) if k < 3 else (1.0, "m", 0.3)
            deviation = result["deviation"][:, 0, k] * scale
            label = f"{'xyz'[k % 3]}, {unit}"
            plot_error_band(result["time_s"], error[:, k] * scale, deviation, label, axes[k % 3, k // 3], limit=limit)
        for ax in axes[-1]:
            ax.set_xlabel("time, s")
        save_figure(bands, folder / f"bands_{name}.png")
        written.append(folder / f"bands_{name}.png")
    return written
