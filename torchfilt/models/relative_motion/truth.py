"""Two satellites under J2, J3, J4 and drag: the truth that filters and learners are judged by.

The pair is integrated as chief and *difference*: the relative state then keeps its digits (1e-13 m over a step, where
two absolute orbits leave 1e-9 m). numpy and SciPy; SciPy is loaded at the first call.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torchfilt.models.relative_motion.chief import ChiefOrbit
from torchfilt.models.relative_motion.frames import frame_rate, from_hill, to_hill
from torchfilt.models.relative_motion.gravity import EARTH_RADIUS_M, J2_EARTH, MU_M3_S2

Array = npt.NDArray[np.float64]
Kind = Literal["trajectory", "cloud", "arcs"]


@dataclass(frozen=True)
class FormationSettings:
    """Chief's orbit, forces and the deputy's start; defaults are the formation of Wei, Song and Zhang (2012).

    Angles in rad. ``relative_start`` is the deputy's Hill state in m and m/s; None makes the study's closed ellipse:
    x = 300 m, z = -400 m, vx = -0.2 m/s, vz = 0.1 m/s, y = 2 vx / n, vy = -2 n x. The study leaves the drag open:
    C_D = 2.2, 1 m^2 each, exponential atmosphere co-rotating with the Earth. Zonal coefficients are those of EGM2008.
    """

    semi_major_axis_m: float = 7.0e6
    eccentricity: float = 0.0
    inclination_rad: float = math.radians(30.0)
    node_rad: float = math.radians(45.0)
    perigee_rad: float = math.radians(30.0)
    true_anomaly_rad: float = 0.0
    relative_start: tuple[float, float, float, float, float, float] | None = None
    mu_m3_s2: float = MU_M3_S2
    earth_radius_m: float = EARTH_RADIUS_M
    j2: float = J2_EARTH
    j3: float = -2.532410518567722e-6
    j4: float = -1.619897599916973e-6
    earth_rate_rad_s: float = 7.292115146706979e-5
    chief_mass_kg: float = 200.0
    deputy_mass_kg: float = 100.0
    chief_area_m2: float = 1.0
    deputy_area_m2: float = 1.0
    drag_coefficient: float = 2.2
    density_kg_m3: float = 1.454e-13
    density_height_m: float = 600e3
    scale_height_m: float = 71.8e3
    step_s: float = 10.0

    @property
    def mean_motion_rad_s(self) -> float:
        """Of a circular orbit with this semi-major axis, sqrt(mu / a^3)."""
        return math.sqrt(self.mu_m3_s2 / self.semi_major_axis_m**3)

    @property
    def period_s(self) -> float:
        """One revolution."""
        return 2 * math.pi / self.mean_motion_rad_s

    def chief_start(self) -> tuple[Tensor, Tensor]:
        """Inertial position (m) and velocity (m/s) of the chief at time zero, (3,) each."""
        a, e, i = self.semi_major_axis_m, self.eccentricity, self.inclination_rad
        p = a * (1 - e * e)
        anomaly, latitude = self.true_anomaly_rad, self.perigee_rad + self.true_anomaly_rad
        radius, speed = p / (1 + e * math.cos(anomaly)), math.sqrt(self.mu_m3_s2 / p)
        cos_n, sin_n, cos_i, sin_i = math.cos(self.node_rad), math.sin(self.node_rad), math.cos(i), math.sin(i)
        toward_node = np.array([cos_n, sin_n, 0.0])
        ahead = np.array([-sin_n * cos_i, cos_n * cos_i, sin_i])
        outward = math.cos(latitude) * toward_node + math.sin(latitude) * ahead
        forward = math.cos(latitude) * ahead - math.sin(latitude) * toward_node
        velocity = speed * (e * math.sin(anomaly) * outward + (1 + e * math.cos(anomaly)) * forward)
        return torch.from_numpy(radius * outward), torch.from_numpy(velocity)

    def deputy_start(self) -> Tensor:
        """Hill state (6,) of the deputy at time zero."""
        if self.relative_start is not None:
            return torch.tensor(self.relative_start, dtype=torch.float64)
        n, x, z, vx, vz = self.mean_motion_rad_s, 300.0, -400.0, -0.2, 0.1
        return torch.tensor([x, 2 * vx / n, z, vx, -2 * n * x, vz], dtype=torch.float64)


class Formation(NamedTuple):
    """True motion: chief at t epochs and the deputy's Hill states ``relative_m_m_s`` (t, 6)."""

    chief: ChiefOrbit
    relative_m_m_s: Tensor


def simulate_formation(
    settings: FormationSettings, time_s: Tensor, relative_start: Tensor | None = None, thrust_m_s2: Tensor | None = None
) -> Formation:
    """Truth at given times.

    Args:
        settings: forces and start.
        time_s: (t,), increasing, time zero being the start of the settings' orbit.
        relative_start: Hill state (6,) at time zero that replaces the settings' own.
        thrust_m_s2: acceleration of the deputy in Hill axes, held from each time to the next, (t - 1, 3); None for
            free motion.

    Raises:
        ValueError: times that do not increase or are negative, thrust of another shape.
        RuntimeError: the integrator gave up.
    """
    time = time_s.detach().to(torch.float64)
    if time.dim() != 1 or bool((time.diff() <= 0).any()) or bool((time < 0).any()):
        raise ValueError("time_s must be one increasing row of times >= 0")
    if thrust_m_s2 is not None and thrust_m_s2.shape != (len(time) - 1, 3):
        raise ValueError(f"thrust_m_s2 must be ({len(time) - 1}, 3), got {tuple(thrust_m_s2.shape)}")
    position, velocity = settings.chief_start()
    relative = settings.deputy_start() if relative_start is None else relative_start.to(torch.float64)
    rate = chief_frame_rate(position, velocity, settings)
    start = torch.cat([position, velocity, *from_hill(position, velocity, rate, relative)]).numpy()
    if thrust_m_s2 is None:
        states = _integrate(start[None], time.numpy(), settings, None)[:, 0]
    else:
        states = _integrate_thrust(start[None], time.numpy(), settings, thrust_m_s2.detach().double().numpy())
    return _formation(time, torch.from_numpy(np.ascontiguousarray(states)), settings)


def propagate_formation(
    chief_position_m: Tensor,
    chief_velocity_m_s: Tensor,
    relative: Tensor,
    dt_s: float,
    settings: FormationSettings,
    frame_rate_rad_s: Tensor | None = None,
    thrust_m_s2: Tensor | None = None,
) -> Formation:
    """One true step of many pairs at once, each with its own chief.

    Args:
        chief_position_m, chief_velocity_m_s: inertial, (S, 3) or (3,).
        relative: Hill states (S, 6).
        dt_s: step.
        settings: forces.
        frame_rate_rad_s: rate that ``relative`` refers to, (S, 3) or (3,); None takes it from the forces.
        thrust_m_s2: acceleration of the deputy in Hill axes, (S, 3) or (3,).

    Returns:
        Formation at the end of the step: chief (S, ...), states (S, 6).
    """
    relative = relative.detach().to(torch.float64)
    count = len(relative)
    position, velocity = (v.detach().double().expand(count, 3) for v in (chief_position_m, chief_velocity_m_s))
    given = chief_frame_rate(position, velocity, settings) if frame_rate_rad_s is None else frame_rate_rad_s
    rate = given.detach().double().expand(count, 3)
    start = torch.cat([position, velocity, *from_hill(position, velocity, rate, relative)], -1).numpy()
    thrust = None if thrust_m_s2 is None else thrust_m_s2.detach().double().expand(count, 3).numpy()
    end = _integrate(start, np.array([0.0, dt_s]), settings, thrust)[-1]
    return _formation(torch.full((count,), dt_s, dtype=torch.float64), torch.from_numpy(end.copy()), settings)


def propagate_relative(
    chief_position_m: Tensor,
    chief_velocity_m_s: Tensor,
    relative: Tensor,
    dt_s: float,
    settings: FormationSettings,
    frame_rate_rad_s: Tensor | None = None,
) -> Tensor:
    """Hill states (S, 6) after one true step; arguments as in `propagate_formation`."""
    return propagate_formation(
        chief_position_m, chief_velocity_m_s, relative, dt_s, settings, frame_rate_rad_s
    ).relative_m_m_s


def training_pairs(
    settings: FormationSettings,
    kind: Kind = "cloud",
    samples: int = 500,
    *,
    seed: int = 0,
    spread_m: float = 20.0,
    spread_m_s: float = 0.02,
    span_s: tuple[float, float] | None = None,
    arcs: int = 10,
) -> tuple[Tensor, Tensor, Tensor]:
    """Accurate one-step pairs for learning the dynamics.

    Args:
        settings: forces, start and step.
        kind: "trajectory": states of the nominal trajectory (a curve: rank 2 of 6, learners memorise it); "cloud": the
            same epochs with normal deviations of the state; "arcs": consecutive states of several trajectories that
            start off the nominal one.
        samples: number of pairs, S.
        seed: of the deviations.
        spread_m, spread_m_s: standard deviations on each axis ("cloud", "arcs").
        span_s: first and last epoch; None for the first revolution. Another revolution makes a test set.
        arcs: how many trajectories for "arcs"; samples must be a multiple.

    Returns:
        x (S, 6), controls u (S, 21), x_next (S, 6).

    Raises:
        ValueError: unknown kind, numbers that do not fit.
    """
    if kind not in ("trajectory", "cloud", "arcs"):
        raise ValueError(f"kind must be 'trajectory', 'cloud' or 'arcs', got {kind!r}")
    if samples < 1 or (kind == "arcs" and samples % arcs):
        raise ValueError(f"samples must be positive and, for arcs, a multiple of {arcs}, got {samples}")
    dt = settings.step_s
    first, last = span_s if span_s is not None else (0.0, settings.period_s)
    length = samples // arcs if kind == "arcs" else 1
    starts = arcs if kind == "arcs" else samples
    if last - first < length * dt:
        raise ValueError(f"span_s must be longer than {length * dt} s, got {last - first}")
    time = torch.linspace(first, last - length * dt, starts, dtype=torch.float64)
    nominal = simulate_formation(settings, time)
    chief, x = nominal.chief, nominal.relative_m_m_s
    if kind != "trajectory":
        deviation = np.random.default_rng(seed).standard_normal((starts, 6))
        x = x + torch.from_numpy(deviation * np.repeat([spread_m, spread_m_s], 3))
    return _chain(chief, x, length, settings)


def _chain(chief: ChiefOrbit, x: Tensor, length: int, settings: FormationSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of ``length`` consecutive steps from each start."""
    states, controls, nexts = [], [], []
    for _ in range(length):
        end = propagate_formation(*chief[1:3], x, settings.step_s, settings, chief[3])
        states.append(x)
        controls.append(torch.cat([torch.zeros(len(x), 3, dtype=torch.float64), *chief[1:], *end.chief[1:]], -1))
        nexts.append(end.relative_m_m_s)
        chief, x = end.chief, end.relative_m_m_s
    # Arc by arc, in time order within each.
    return tuple(torch.stack(part, 1).flatten(0, 1) for part in (states, controls, nexts))  # type: ignore[return-value]


def chief_frame_rate(position_m: Tensor, velocity_m_s: Tensor, settings: FormationSettings) -> Tensor:
    """Rate (..., 3) of the chief's Hill frame under the full forces, Hill axes, rad/s."""
    r, v = position_m.double().numpy(), velocity_m_s.double().numpy()
    drag = settings.chief_area_m2 * settings.drag_coefficient / settings.chief_mass_kg
    return frame_rate(position_m, velocity_m_s, torch.from_numpy(perturbation(r, v, drag, settings)))


def perturbation(position_m: Array, velocity_m_s: Array, ballistic_m2_kg: float, settings: FormationSettings) -> Array:
    """Acceleration (..., 3) by J2, J3, J4 and drag, inertial axes with z along the pole.

    For each zonal term, a_n = mu J_n R^n / r^(n+2) (P'_{n+1}(s) r/|r| - P'_n(s) pole) with s = z / r.

    Args:
        position_m, velocity_m_s: (..., 3).
        ballistic_m2_kg: C_D A / m.
        settings: forces.
    """
    radius = np.sqrt((position_m * position_m).sum(-1, keepdims=True))
    outward = position_m / radius
    s = outward[..., 2:]
    square = s * s
    ratio = settings.earth_radius_m / radius
    gravity = settings.mu_m3_s2 / radius**2
    slope = (3 * s, (15 * square - 3) / 2, s * (35 * square - 15) / 2, (315 * square**2 - 210 * square + 15) / 8)
    strength = (settings.j2 * ratio**2, settings.j3 * ratio**3, settings.j4 * ratio**4)
    radial = sum(j * slope[k + 1] for k, j in enumerate(strength)) * gravity
    result: Array = radial * outward
    result[..., 2:] -= sum(j * slope[k] for k, j in enumerate(strength)) * gravity
    if ballistic_m2_kg:
        result += _drag(position_m, velocity_m_s, radius, ballistic_m2_kg, settings)
    return result


def _drag(position: Array, velocity: Array, radius: Array, ballistic: float, settings: FormationSettings) -> Array:
    wind = velocity.copy()
    wind[..., 0] += settings.earth_rate_rad_s * position[..., 1]
    wind[..., 1] -= settings.earth_rate_rad_s * position[..., 0]
    height = radius - settings.earth_radius_m
    density = settings.density_kg_m3 * np.exp((settings.density_height_m - height) / settings.scale_height_m)
    speed = np.sqrt((wind * wind).sum(-1, keepdims=True))
    force: Array = (-0.5 * ballistic) * density * speed * wind
    return force


def _rates(states: Array, settings: FormationSettings, thrust: Array | None) -> Array:
    """Time derivative of (chief position, velocity, separation, its inertial derivative), (S, 12)."""
    mu = settings.mu_m3_s2
    chief, velocity = states[:, :3], states[:, 3:6]
    separation, relative_velocity = states[:, 6:9], states[:, 9:]
    chief_drag = settings.drag_coefficient * settings.chief_area_m2 / settings.chief_mass_kg
    deputy_drag = settings.drag_coefficient * settings.deputy_area_m2 / settings.deputy_mass_kg
    square = (chief * chief).sum(-1, keepdims=True)
    pull = mu / (square * np.sqrt(square))
    q = (separation * (separation + 2 * chief)).sum(-1, keepdims=True) / square
    cubed = (1 + q) * np.sqrt(1 + q)
    f = q * (3 + q * (3 + q)) / (1 + cubed)
    near = perturbation(chief, velocity, chief_drag, settings)
    far = perturbation(chief + separation, velocity + relative_velocity, deputy_drag, settings)
    out = np.empty_like(states)
    out[:, :3] = velocity
    out[:, 3:6] = near - pull * chief
    out[:, 6:9] = relative_velocity
    out[:, 9:] = (f * chief - separation) * (pull / cubed) + (far - near)
    if thrust is not None:
        out[:, 9:] += _to_inertial(chief, velocity, thrust)
    return out


def _to_inertial(position: Array, velocity: Array, vector: Array) -> Array:
    """Hill components to inertial axes, (S, 3)."""
    x = position / np.linalg.norm(position, axis=-1, keepdims=True)
    z = np.cross(position, velocity)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    result: Array = vector[:, :1] * x + vector[:, 1:2] * np.cross(z, x) + vector[:, 2:] * z
    return result


def _integrate(start: Array, times: Array, settings: FormationSettings, thrust: Array | None) -> Array:
    """States (t, S, 12) at times that begin at or after zero, from states (S, 12) at time zero."""
    from scipy.integrate import solve_ivp

    shape = start.shape
    # Errors are held to 1e-12 of the size of each kind of number, not of each number: components cross zero.
    scale = np.repeat([settings.semi_major_axis_m, 7.5e3, 100.0, 0.1], 3)
    stop = float(times[-1])
    if stop == 0.0:
        return start[None]
    # Short steps keep the interpolation between them (order 7) as good as the steps (order 8).
    limit = min(stop, 60.0)
    solution = solve_ivp(
        lambda _, y: _rates(y.reshape(shape), settings, thrust).ravel(),
        (0.0, stop),
        start.ravel(),
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=np.broadcast_to(1e-12 * scale, shape).ravel(),
        first_step=min(limit, 10.0),
        max_step=limit,
    )
    if not solution.success:
        raise RuntimeError(f"the orbit integration stopped: {solution.message}")
    states: Array = np.ascontiguousarray(solution.y.T).reshape(-1, *shape)
    return states


def _integrate_thrust(start: Array, times: Array, settings: FormationSettings, thrust: Array) -> Array:
    """States (t, 12): one integration an interval, because the thrust jumps between them."""
    state = _integrate(start, np.array([0.0, times[0]]), settings, None)[-1]
    states = [state[0]]
    for k, length in enumerate(np.diff(times)):
        state = _integrate(state, np.array([0.0, length]), settings, thrust[k : k + 1])[-1]
        states.append(state[0])
    return np.stack(states)


def _formation(time: Tensor, states: Tensor, settings: FormationSettings) -> Formation:
    """Hill description of integrated states (t, 12)."""
    position, velocity, separation, relative_velocity = (part.contiguous() for part in states.split(3, -1))
    rate = chief_frame_rate(position, velocity, settings)
    chief = ChiefOrbit(time, position, velocity, rate)
    return Formation(chief, to_hill(position, velocity, rate, separation, relative_velocity))
