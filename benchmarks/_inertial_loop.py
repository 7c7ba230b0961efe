"""The inertial error model's particle filters without the library: one problem, one loop, plain torch.

State by components, (16, *batch, n): error quaternion x y z w (left, ENU), velocity, position, gyro drift and
accelerometer bias. Equations as in `torchfilt.models.inertial.error_model`. Attitude errors stay well below a radian.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

# WGS-84.
A, E2, RATE = 6378137.0, 0.0066943799901413165, 7.292115e-5
GRAVITY, SOMIGLIANA = 9.7803253359, 0.001931852652458
FLATTENING, CENTRIFUGAL = 1 / 298.257223563, 0.00344978650684084


class Flight(NamedTuple):
    """Data and model: controls (t, 20, *batch, 1), fixes (t, 4, *batch, 1), deviations of start, walks and fixes.

    seen: `earth` of what the system computed, for all steps (t, 8, *batch, 1).
    """

    controls: Tensor
    fixes: Tensor
    seen: Tensor
    start: Tensor
    walk: tuple[float, float]
    fix_sd: tuple[float, float, float]
    metres: tuple[float, float]
    dt: float


class Numbers(NamedTuple):
    """Random numbers of a step: one uniform a row (*batch, 1), normals (6 or more, *batch, n) and (15, *batch, n)."""

    uniform: Tensor
    process: Tensor
    kernel: Tensor | None


def prepare(scene: Any, rows: int | None, dt: float = 1.0) -> Flight:
    """A scene of `torchfilt.missions.inertial`: its first ``rows`` runs, or the first alone, without a batch dim."""
    pick = 0 if rows is None else slice(rows)
    controls = scene.controls[:, pick].movedim(-1, 1).unsqueeze(-1).contiguous()
    fixes = scene.fixes[:, pick].movedim(-1, 1).unsqueeze(-1).contiguous()
    motion, law = scene.model.transition, scene.model.observation
    metres = (motion.origin.east_m, motion.origin.north_m)
    east, north, up = controls[:, 12:15].unbind(1)
    walk = (float(motion.angle_random_walk_rad_sqrt_s), float(motion.velocity_random_walk_m_s_sqrt_s))
    heading, place, _, height = law.standard_deviation.tolist()
    return Flight(
        controls,
        fixes,
        torch.stack(earth(east, north, up, controls[:, 15], controls[:, 16], metres), 1),
        scene.model.initial().scale_tril,
        walk,
        (heading, place, height),
        metres,
        dt,
    )


def earth(
    east: Tensor, north: Tensor, up: Tensor, latitude: Tensor, height: Tensor, metres: tuple[float, float]
) -> list[Tensor]:
    """Rate of the ENU axes (3), acceleration by Coriolis and gravity (3), scales of east and north."""
    sine, cosine = latitude.sin(), latitude.cos()
    sin2 = sine * sine
    w2 = torch.add(torch.ones_like(sin2), sin2, alpha=-E2)
    root = w2.rsqrt()
    transverse = root * A
    per_east = (transverse + height).reciprocal_()
    per_north = torch.addcdiv(height, transverse, w2, value=1 - E2).reciprocal_()
    turn, tangent = east * per_east, sine / cosine
    rate_e, spin_n, spin_u = -(north * per_north), cosine * RATE, sine * RATE
    rate_n, rate_u = spin_n + turn, torch.addcmul(spin_u, turn, tangent)
    whole_n, whole_u = rate_n + spin_n, rate_u + spin_u
    ratio = height * (1 / A)
    falls = (sin2 * (-2 * FLATTENING)).add_(1 + FLATTENING + CENTRIFUGAL).mul_(-2)
    weight = (ratio * 3).add_(falls).mul_(ratio).add_(1)
    weight.mul_(root).mul_((sin2 * (GRAVITY * SOMIGLIANA)).add_(GRAVITY))
    acceleration = [
        torch.addcmul(north * whole_u, up, whole_n, value=-1),
        torch.addcmul(up * rate_e, east, whole_u, value=-1),
        torch.addcmul(east * whole_n, north, rate_e, value=-1).sub_(weight),
    ]
    return [rate_e, rate_n, rate_u, *acceleration, (per_east / cosine).mul_(metres[0]), per_north * metres[1]]


def cross(ax: Tensor, ay: Tensor, az: Tensor, bx: Tensor, by: Tensor, bz: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """a x b."""
    x = (ay * bz).addcmul_(az, by, value=-1)
    y = (az * bx).addcmul_(ax, bz, value=-1)
    z = (ax * by).addcmul_(ay, bx, value=-1)
    return x, y, z


def turned(qx: Tensor, qy: Tensor, qz: Tensor, w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Vector turned by q."""
    tx, ty, tz = cross(qx, qy, qz, x, y, z)
    ux, uy, uz = cross(qx, qy, qz, tx, ty, tz)
    return [
        torch.add(x, ux.addcmul_(w, tx), alpha=2),
        torch.add(y, uy.addcmul_(w, ty), alpha=2),
        torch.add(z, uz.addcmul_(w, tz), alpha=2),
    ]


def product(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    """Hamilton product."""
    x, y, z = cross(*a[:3], *b[:3])
    x.addcmul_(a[3], b[0]).addcmul_(a[0], b[3])
    y.addcmul_(a[3], b[1]).addcmul_(a[1], b[3])
    z.addcmul_(a[3], b[2]).addcmul_(a[2], b[3])
    w = (a[3] * b[3]).addcmul_(a[0], b[0], value=-1).addcmul_(a[1], b[1], value=-1).addcmul_(a[2], b[2], value=-1)
    return [x, y, z, w]


def small_turn(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Quaternion of a rotation vector, by series: to rounding up to half a radian."""
    square = (x * x).addcmul_(y, y).addcmul_(z, z).mul_(0.25)
    half = (square / -42).add_(1).mul_(square).mul_(1 / 20).sub_(1).mul_(square).mul_(1 / 6).add_(1).mul_(0.5)
    cosine = (square / -30).add_(1).mul_(square).mul_(1 / 12).sub_(1).mul_(square).mul_(0.5).add_(1)
    return [x * half, y * half, z * half, cosine]


def move(x: Tensor, u: Tensor, seen: Tensor, flight: Flight) -> list[Tensor]:
    """All components after a step, without noise."""
    dt, metres = flight.dt, flight.metres
    error = list(x[:4].unbind(0))
    ve, vn, vu, pe, pn, pu = x[4:10].unbind(0)
    matrix = u[:9].squeeze(-1).movedim(0, -1).unflatten(-1, (3, 3))
    pulled, drifted = (matrix @ x[a : a + 3].movedim(0, -2) for a in (13, 10))
    force, computed = u[9:12], u[12:15].unbind(0)
    fe, fn, fu = (force.movedim(0, -2) - pulled).unbind(-2)
    back = [*error[:3], -error[3]]
    ge, gn, gu = turned(*back, fe, fn, fu)
    # True velocity half-way: computed less error, less half of what the error gains.
    te, tn, tu = (
        torch.add(c - v, f - g, alpha=-0.5)
        for c, v, f, g in zip(computed, (ve, vn, vu), force.unbind(0), (ge, gn, gu), strict=True)
    )
    latitude = u[15] - torch.add(pn, vn, alpha=0.5 * dt) / metres[1]
    height = u[16] - torch.add(pu, vu, alpha=0.5 * dt)
    real = earth(te, tn, tu, latitude, height, metres)
    seen_parts = seen.unbind(0)
    re, rn, ru = turned(*error, *real[:3])
    turn = [
        torch.sub(d, s - r, alpha=dt) for d, s, r in zip(drifted.unbind(-2), seen_parts[:3], (re, rn, ru), strict=True)
    ]
    half = small_turn(turn[0] * 0.5, turn[1] * 0.5, turn[2] * 0.5)
    middle = product(half, error)
    ge, gn, gu = turned(*middle[:3], -middle[3], fe, fn, fu)
    after = [
        torch.add(v, s - r, alpha=dt).add_(f - g)
        for v, f, g, s, r in zip((ve, vn, vu), force.unbind(0), (ge, gn, gu), seen_parts[3:6], real[3:6], strict=True)
    ]
    mean_e, mean_n, mean_u = ((v + a).mul_(0.5) for v, a in zip((ve, vn, vu), after, strict=True))
    east = ((seen_parts[6] - real[6]) * computed[0]).addcmul_(real[6], mean_e)
    north = ((seen_parts[7] - real[7]) * computed[1]).addcmul_(real[7], mean_n)
    position = [torch.add(pe, east, alpha=dt), torch.add(pn, north, alpha=dt), torch.add(pu, mean_u, alpha=dt)]
    return [*product(half, middle), *after, *position]


def log_weight(parts: list[Tensor], u: Tensor, fix: Tensor, sd: tuple[float, float, float]) -> Tensor:
    """Log-density of a fix, without the constant."""
    ax, ay, _ = ahead = u[17:20].unbind(0)
    true_x, true_y, _ = turned(*parts[:3], -parts[3], *ahead)
    heading = torch.atan2((true_y * ax).addcmul_(true_x, ay, value=-1), (true_y * ay).addcmul_(true_x, ax))
    off = fix[0] - heading
    off = torch.sub(off, (off * (0.5 / math.pi)).round_(), alpha=2 * math.pi).mul_(1 / sd[0])
    east, north, up = (fix[1] - parts[7]).mul_(1 / sd[1]), (fix[2] - parts[8]).mul_(1 / sd[1]), fix[3] - parts[9]
    up.mul_(1 / sd[2])
    return (off * off).addcmul_(east, east).addcmul_(north, north).addcmul_(up, up).mul_(-0.5)


def errors(x: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (16, *batch) and errors (15, *batch, n) from it, in tangent coordinates."""
    mean = (x * weights).sum(-1)
    middle = mean[:4] / (mean[:4] * mean[:4]).sum(0).sqrt()
    # Turn from the mean, log of q times its conjugate; one round of Newton's method: errors are far below a radian.
    turn = log_of(product(list(x[:4].unbind(0)), [*(-middle[:3, ..., None]).unbind(0), middle[3, ..., None]]))
    step = (turn * weights).sum(-1)
    middle = torch.stack(product(small_turn(*step.unbind(0)), list(middle.unbind(0))))
    apart = torch.cat([turn - step.unsqueeze(-1), x[4:] - mean[4:].unsqueeze(-1)])
    return torch.cat([middle, mean[4:]]), apart


def log_of(q: list[Tensor]) -> Tensor:
    """Rotation vectors (3, ...) of quaternions; not for half turns."""
    vector = torch.stack(q[:3])
    length = (vector * vector).sum(0).add_(1e-40).sqrt_()
    sign = torch.copysign(torch.full_like(length, 2), q[3])
    return vector * (torch.atan2(length, q[3].abs()) / length).mul_(sign)


def regularized(apart: Tensor, weights: Tensor, ancestors: Tensor, noise: Tensor, mean: Tensor) -> Tensor:
    """Resampled particles, shrunk, widened by a Gaussian kernel and matched to the cloud's moments."""
    size, n = len(apart), apart.shape[-1]
    h = (4 / (size + 2) / n) ** (1 / (size + 4))
    rows = apart.movedim(0, -2)
    whole = torch.linalg.cholesky((rows * weights.unsqueeze(-2)) @ rows.mT)
    copies = apart.gather(-1, ancestors.expand(apart.shape)).movedim(0, -2)
    drawn = copies * (1 - h * h) ** 0.5 + (h * whole) @ noise.movedim(0, -2)
    drawn = drawn - drawn.mean(-1, keepdim=True)
    found = torch.linalg.cholesky(drawn @ drawn.mT / n)
    matched = torch.linalg.solve_triangular(found, whole, upper=False, left=False) @ drawn
    vx, vy, vz = matched[..., :3, :].unbind(-2)
    q = product(small_turn(vx, vy, vz), list(mean[:4, ..., None].unbind(0)))
    return torch.cat([torch.stack(q), mean[4:, ..., None] + matched[..., 3:, :].movedim(-2, 0)])


def ancestors_of(weights: Tensor, uniform: Tensor) -> Tensor:
    """Systematic resampling by a histogram."""
    n = weights.shape[-1]
    ends = weights.cumsum(-1)
    ends = (ends * (n / ends[..., -1:])).sub_(uniform).ceil_().long().clamp_(0, n)
    flat = ends[..., :-1].reshape(-1, n - 1)
    rows = len(flat)
    flat = flat + torch.arange(rows).unsqueeze(-1) * (n + 1)
    histogram = torch.bincount(flat.view(-1), minlength=rows * (n + 1)).view(rows, n + 1)
    return histogram[:, :n].cumsum(-1).view(weights.shape)


def run(
    flight: Flight, n: int, regularize: bool, numbers: Callable[[int], Numbers], start: Tensor
) -> tuple[Tensor, Tensor]:
    """Bootstrap filter, or the regularised one with kept moments; systematic resampling at every step.

    Args:
        flight: of `prepare`. n: particles. numbers: of a step. start: normals (15, *batch, n).

    Returns:
        Log-likelihood (*batch) and means (t, *batch, 16).
    """
    scale = torch.tensor([flight.walk[0]] * 3 + [flight.walk[1]] * 3, dtype=start.dtype) * flight.dt**0.5
    first = start * flight.start.view(15, *[1] * (start.dim() - 1))
    x = torch.cat([torch.stack(small_turn(*first[:3].unbind(0))), first[3:]])
    weights = torch.full(x.shape[1:], 1 / n, dtype=x.dtype)
    constant = -2 * math.log(2 * math.pi) - math.log(n)
    constant -= math.log(flight.fix_sd[0]) + 2 * math.log(flight.fix_sd[1]) + math.log(flight.fix_sd[2])
    mean, apart = errors(x, weights)
    means, log_likelihood = [], torch.zeros(x.shape[1:-1], dtype=x.dtype)
    for k, (u, fix, seen) in enumerate(zip(flight.controls, flight.fixes, flight.seen, strict=True)):
        drawn = numbers(k)
        ancestors = ancestors_of(weights, drawn.uniform)
        if regularize:
            assert drawn.kernel is not None
            x = regularized(apart, weights, ancestors, drawn.kernel, mean)
        else:
            x = x.gather(-1, ancestors.expand(x.shape))
        parts = move(x, u, seen, flight)
        white = drawn.process[:6] * scale.view(6, *[1] * (x.dim() - 1))
        parts[:4] = product(small_turn(*white[:3].unbind(0)), parts[:4])
        for i in range(3):
            parts[4 + i].add_(white[3 + i])
        logs = log_weight(parts, u, fix, flight.fix_sd)
        top = logs.amax(-1, keepdim=True)
        weights = logs.sub_(top).exp_()
        total = weights.sum(-1, keepdim=True)
        weights.div_(total)
        log_likelihood = log_likelihood + (top + total.log_()).squeeze(-1) + constant
        x = torch.cat([torch.stack(parts), x[10:]])
        mean, apart = errors(x, weights)
        means.append(mean)
    return log_likelihood, torch.stack(means).movedim(1, -1)


def drawn_by_torch(
    n: int, batch: tuple[int, ...], regularize: bool, seed: int
) -> tuple[Callable[[int], Numbers], Tensor]:
    """Random numbers by torch's generator, no more than the filter needs; and those of the start."""
    generator = torch.Generator().manual_seed(seed)

    def normals(count: int) -> Tensor:
        return torch.empty(count, *batch, n, dtype=torch.float64).normal_(generator=generator)

    def numbers(_: int) -> Numbers:
        uniform = torch.empty(*batch, 1, dtype=torch.float64).uniform_(generator=generator)
        return Numbers(uniform, normals(6), normals(15) if regularize else None)

    return numbers, normals(15)
