"""Slow airship: a rigid prolate hull with a gondola, in six degrees of freedom.

A state is 13 numbers: quaternion body (RFU) to world (ENU) [0:4]; velocity [4:7] in m/s and position [7:10] in m of the
hull's centre, both in world axes; angular rate in rad/s, in body axes [10:13]. Its error is 12 numbers in the same
order, the quaternion's on the left: a rotation vector in world axes. Body y runs along the hull, forward.

The hull's centre is where buoyancy acts and where the axes have their origin; the gondola brings the centre of gravity
below it, so that the airship is a pendulum. The air that has to move along adds to mass and inertia (Kirchhoff's
equations); at an angle to its path the hull then feels Munk's moment, which turns it across.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.linalg import cross as _cross
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.models.attitude import inverse, multiply, rotate, skew
from torchfilt.models.ode import rk4
from torchfilt.spaces import Euclidean, Product, UnitQuaternion

AIRSHIP_SPACE = Product(UnitQuaternion("left"), Euclidean(9))
STATE_SIZE, THRUST_SIZE = 13, 3
GRAVITY_M_S2 = 9.80665
# Nearer to the sphere the closed form of Lamb's factors loses its digits.
_LEAST_SLENDER = 1.05

Step = Tensor | float | None


def lamb_factors(slenderness: float) -> tuple[float, float, float]:
    """Added mass of a prolate ellipsoid of revolution along and across its long axis, and added inertia across it.

    Args:
        slenderness: length over diameter, at least 1.05.

    Returns:
        k1, k2: shares of the displaced air's mass; k': share of the displaced air's moment of inertia.

    Raises:
        ValueError: another slenderness.

    Source: Lamb, Hydrodynamics (1932), articles 114 and 115; Munk, NACA report 184 (1924), has the factors' names.
    """
    if not _LEAST_SLENDER <= slenderness < math.inf:
        raise ValueError(f"slenderness must be finite and at least {_LEAST_SLENDER}, got {slenderness}")
    e2 = 1 - slenderness**-2
    e = math.sqrt(e2)
    log = math.atanh(e)
    alpha = 2 * (1 - e2) / e**3 * (log - e)
    beta = 1 / e2 - (1 - e2) / e**3 * log
    turn = e2**2 * (beta - alpha) / ((2 - e2) * (2 * e2 - (2 - e2) * (beta - alpha)))
    return alpha / (2 - alpha), beta / (2 - beta), turn


@dataclass(frozen=True)
class Airship:
    """Geometry, masses and air of an indoor airship; whatever else the model needs is computed from them.

    length_m, diameter_m: of the hull. The length is that of a blimp of Mueller, Paul and Burgard; the diameter assumed.
    air_density_kg_m3: dry air of 20 degC at 101325 Pa. gas_density_kg_m3: helium of the same state, by molar mass.
    gondola_mass_kg, gondola_height_m: a point below the hull's centre with battery, thrusters and 0.15 kg of payload
        (the same blimp's); assumed otherwise.
    heaviness_kg: mass beyond that of the displaced air; the skin weighs what is left for it.
    axial_drag: coefficient by the frontal area; Hoerner's 0.44 d/l + 4 f l/d + 4 f sqrt(d/l) of ellipsoids below the
        critical Reynolds number, with friction f = 1.328 / sqrt(Reynolds) at 1 m/s.
    cross_drag: by the planform; assumed, between Hoerner's values of a sphere, 0.47, and a short cylinder, 0.7.
    roll_drag_n_m_s2: quadratic moment about the long axis, of gondola and fins; assumed.
    linear_speed_m_s, linear_rate_rad_s: where linear and quadratic drag are alike; assumed. The linear part is what is
        left of the damping at small speeds.
    fin_area_m2, fin_position_m, fin_lift_slope: of the upright pair, the level pair is its like; y of the centre of
        pressure; per rad. Assumed; the slope is Jones's pi/2 times an aspect ratio of 1.6.

    Raises:
        ValueError: a number that is not finite or out of its range, a hull that is not slender, no mass for the skin.

    Source: Mueller, Paul and Burgard, Probabilistic velocity estimation for autonomous miniature airships using thermal
        air flow sensors, ICRA 2012 (length, payload, three thrusters); Hoerner, Fluid-Dynamic Drag (1965), chapters 3
        and 6. Zufferey, Guanella, Beyeler and Floreano, Flying over the reality gap, Autonomous Robots 21 (2006), is
        the pattern of the model: ellipsoid, added mass, linear and quadratic damping; none of their numbers is used.
    """

    length_m: float = 2.1
    diameter_m: float = 0.9
    air_density_kg_m3: float = 1.2041
    gas_density_kg_m3: float = 0.1664
    gondola_mass_kg: float = 0.40
    gondola_height_m: float = -0.50
    heaviness_kg: float = 0.0
    axial_drag: float = 0.23
    cross_drag: float = 0.6
    roll_drag_n_m_s2: float = 0.002
    linear_speed_m_s: float = 0.05
    linear_rate_rad_s: float = 0.05
    fin_area_m2: float = 0.15
    fin_position_m: float = -0.9
    fin_lift_slope: float = 2.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            signed = name in ("heaviness_kg", "gondola_height_m", "fin_position_m")
            if not math.isfinite(value) or (value < 0 and not signed):
                raise ValueError(f"{name} must be finite{'' if signed else ' and not negative'}, got {value}")
        for name in ("length_m", "diameter_m", "air_density_kg_m3"):
            if getattr(self, name) == 0:
                raise ValueError(f"{name} must be positive, got 0")
        for name in ("gondola_height_m", "fin_position_m"):
            if getattr(self, name) > 0:
                raise ValueError(f"{name} must not be positive, got {getattr(self, name)}")
        lamb_factors(self.length_m / self.diameter_m)
        if not self.skin_mass_kg > 0:
            raise ValueError(
                f"gas, gondola and heaviness leave no mass for the skin: {self.skin_mass_kg:.4g} kg of "
                f"{self.displaced_mass_kg:.4g} kg displaced"
            )

    @property
    def volume_m3(self) -> float:
        """Volume of the hull."""
        return math.pi / 6 * self.length_m * self.diameter_m**2

    @property
    def displaced_mass_kg(self) -> float:
        """Mass of the displaced air."""
        return self.air_density_kg_m3 * self.volume_m3

    @property
    def mass_kg(self) -> float:
        """Mass of skin, gas and gondola."""
        return self.displaced_mass_kg + self.heaviness_kg

    @property
    def skin_mass_kg(self) -> float:
        """Mass that is left for the skin."""
        return self.mass_kg - self.gondola_mass_kg - self.gas_density_kg_m3 * self.volume_m3

    @property
    def gravity_centre_height_m(self) -> float:
        """Height of the centre of gravity above the hull's, body z; its x and y are zero."""
        return self.gondola_mass_kg * self.gondola_height_m / self.mass_kg

    @property
    def added_mass_kg(self) -> tuple[float, float, float]:
        """Added masses right, forward, up, body axes."""
        along, across, _ = lamb_factors(self.length_m / self.diameter_m)
        side = across * self.displaced_mass_kg
        return side, along * self.displaced_mass_kg, side

    @property
    def inertia_kg_m2(self) -> tuple[float, float, float]:
        """Moments of inertia about the hull's centre and body axes.

        The gas turns with the hull, as a solid; the skin is the space between two similar ellipsoids; the gondola is a
        point.
        """
        a, b = self.length_m / 2, self.diameter_m / 2
        gas, skin = self.gas_density_kg_m3 * self.volume_m3, self.skin_mass_kg
        across, along = gas / 5 + skin / 3, (gas / 5 + skin / 3) * 2 * b**2
        swing = self.gondola_mass_kg * self.gondola_height_m**2
        return across * (a**2 + b**2) + swing, along + swing, across * (a**2 + b**2)

    @property
    def added_inertia_kg_m2(self) -> tuple[float, float, float]:
        """Added moments of inertia about the hull's centre and body axes; none about the long axis."""
        _, _, turn = lamb_factors(self.length_m / self.diameter_m)
        air = self.displaced_mass_kg / 20 * (self.length_m**2 + self.diameter_m**2)
        return turn * air, 0.0, turn * air

    @property
    def drag_n_s2_m2(self) -> tuple[float, float, float]:
        """Quadratic drag of each axis by the square of the speed along it."""
        side = self.cross_drag * self.length_m * self.diameter_m
        area = (side, self.axial_drag * self.diameter_m**2, side)
        right, forward, up = (self.air_density_kg_m3 / 2 * math.pi / 4 * value for value in area)
        return right, forward, up

    @property
    def turn_drag_n_m_s2(self) -> tuple[float, float, float]:
        """Quadratic drag moment of each axis by the square of the rate about it; across by strips of the hull."""
        a, b = self.length_m / 2, self.diameter_m / 2
        # Integral of |s|^3 over the width 2 b sqrt(1 - s^2 / a^2).
        strips = self.air_density_kg_m3 / 2 * self.cross_drag * 8 / 15 * b * a**4
        return strips, self.roll_drag_n_m_s2, strips

    @property
    def fin_force_n_s2_m2(self) -> float:
        """Force of a pair of fins by the product of forward and cross speed."""
        return self.air_density_kg_m3 / 2 * self.fin_area_m2 * self.fin_lift_slope


class AirshipTransition(nn.Module):
    """Motion of an airship; the control u holds thrust forward (N), thrust up (N) and yaw moment (N m).

    Both thrusts act at the gondola, so that pushing forward lifts the nose; a positive moment turns to the left. Six
    numbers (..., 6) have the air's velocity behind them, m/s in world axes; else the air is at rest. Both stay as they
    are over a step.
    Mean: classical Runge-Kutta of the whole state, the quaternion's norm restored at the end; fourth order, second
    where a speed changes its sign, at which drag has a kink.
    Noise: of the accelerations, white, all axes alike; attitude and position have none of their own.

    Args:
        airship: see `Airship`; default its defaults.
        acceleration_sd_m_s_sqrt_s, turn_sd_rad_s_sqrt_s: roots of the spectral densities of linear and angular
            acceleration, (m/s^2)/sqrt(Hz) and (rad/s^2)/sqrt(Hz).
        steps: of the integration in one call.

    Raises:
        ValueError: a density that is negative or not finite, no steps; when called, no time step, a control or state of
            another size.

    Source: Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control (2011), chapters 6 and 8; Lamb,
        Hydrodynamics (1932), articles 120 and 124.
    """

    thrust_map: Tensor
    inertia: Tensor
    inverse_inertia: Tensor
    drag: Tensor
    densities: Tensor

    def __init__(
        self,
        airship: Airship | None = None,
        acceleration_sd_m_s_sqrt_s: float = 0.01,
        turn_sd_rad_s_sqrt_s: float = 0.005,
        *,
        steps: int = 1,
    ) -> None:
        super().__init__()
        named = {"acceleration_sd_m_s_sqrt_s": acceleration_sd_m_s_sqrt_s, "turn_sd_rad_s_sqrt_s": turn_sd_rad_s_sqrt_s}
        for name, value in named.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be one finite number >= 0, got {value}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        self.airship = Airship() if airship is None else airship
        self.steps, self.space = steps, AIRSHIP_SPACE
        self.noise_in = [*range(3, 6)] * (acceleration_sd_m_s_sqrt_s > 0) + [*range(9, 12)] * (turn_sd_rad_s_sqrt_s > 0)
        each = [0.0] * 3 + [acceleration_sd_m_s_sqrt_s] * 3 + [0.0] * 3 + [turn_sd_rad_s_sqrt_s] * 3
        self.register_buffer("densities", torch.tensor(each, dtype=torch.float64))
        inertia = inertia_matrix(self.airship)
        self.register_buffer("inertia", inertia)
        self.register_buffer("inverse_inertia", torch.linalg.inv(inertia))
        squares = [*self.airship.drag_n_s2_m2, *self.airship.turn_drag_n_m_s2]
        self.register_buffer("drag", torch.tensor(squares, dtype=torch.float64))
        thrust = torch.zeros(6, THRUST_SIZE, dtype=torch.float64)
        thrust[1, 0], thrust[3, 0] = 1, -self.airship.gondola_height_m
        thrust[2, 1] = thrust[5, 2] = 1
        self.register_buffer("thrust_map", thrust)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the state (..., 13) after a step of dt (number or (..., 1)), s; without a control nothing pushes."""
        wrench, air = self._check(x, u, dt)
        assert dt is not None
        mean = self.advance(x, wrench, air, dt)
        return Gaussian(mean, self.densities.to(x.dtype) * dt**0.5, self.space, is_diagonal=True)

    def advance(self, x: Tensor, wrench: Tensor, air_velocity: Tensor, dt: Tensor | float) -> Tensor:
        """State after a step under a given outer force and moment.

        Args:
            x: (..., 13).
            wrench: force (N) and moment about the hull's centre (N m), body axes, (..., 6), beside weight, buoyancy and
                what the air does.
            air_velocity: (..., 3), m/s, world axes.
            dt: number or (..., 1), s.

        Returns:
            The state (..., 13).
        """
        end = rk4(lambda _, y: self.rates(y, wrench, air_velocity), x, dt, self.steps)
        q = end[..., :4]
        return torch.cat([q * q.square().sum(-1, keepdim=True).rsqrt(), end[..., 4:]], -1)

    def rates(self, x: Tensor, wrench: Tensor, air_velocity: Tensor) -> Tensor:
        """Derivative (..., 13) of the state by time; arguments as in `advance`."""
        # Only the direction of the quaternion turns: its norm, which the stages of a step change, has no part in the
        # motion, and turning the world commutes with every stage.
        q = x[..., :4] * x[..., :4].square().sum(-1, keepdim=True).rsqrt()
        back = inverse(q)
        motion = torch.cat(torch.broadcast_tensors(rotate(back, x[..., 4:7] - air_velocity), x[..., 10:]), -1)
        through_air, rate = motion.split(3, -1)
        linear, angular = (motion @ self.inertia.to(x.dtype)).split(3, -1)
        # Kirchhoff: p' = F - w x p, h' = T - w x h - v x p.
        carried = torch.cat([_cross(rate, linear), _cross(rate, angular) + _cross(through_air, linear)], -1)
        force = wrench + self._air_force(motion) + self._weight(back) - carried
        change = force @ self.inverse_inertia.to(x.dtype)
        # The velocity through the air is seen in turning axes.
        push = rotate(q, change[..., :3] + _cross(rate, through_air))
        spin = 0.5 * multiply(x[..., :4], pad(x[..., 10:], (0, 1)))
        parts = (spin, push, x[..., 4:7], change[..., 3:])
        return torch.cat([part.expand(*push.shape[:-1], part.shape[-1]) for part in parts], -1)

    def energy(self, x: Tensor) -> Tensor:
        """Kinetic energy of airship and air at rest, plus height's, J (...); zero at rest, level, in the origin."""
        ship = self.airship
        motion = torch.cat([rotate(inverse(x[..., :4]), x[..., 4:7]), x[..., 10:]], -1)
        kinetic = (motion @ self.inertia.to(x.dtype) * motion).sum(-1) / 2
        up = rotate(x[..., :4], x.new_tensor([0, 0, 1.0]))[..., 2]
        lift = ship.mass_kg * ship.gravity_centre_height_m * (up - 1) + ship.heaviness_kg * x[..., 9]
        return kinetic + GRAVITY_M_S2 * lift

    def _air_force(self, motion: Tensor) -> Tensor:
        """Force and moment (..., 6) of hull drag and fins at the motion through the air (..., 6)."""
        ship = self.airship
        slow = motion.new_tensor([ship.linear_speed_m_s] * 3 + [ship.linear_rate_rad_s] * 3)
        drag = -self.drag.to(motion.dtype) * (slow + motion.abs()) * motion
        right, forward, up, pitch, _, yaw = motion.unbind(-1)
        strength = -ship.fin_force_n_s2_m2 * forward.abs()
        tail = ship.fin_position_m
        side, lift = strength * (right - yaw * tail), strength * (up + pitch * tail)
        none = torch.zeros_like(side)
        return drag + torch.stack([side, none, lift, tail * lift, none, -tail * side], -1)

    def _weight(self, back: Tensor) -> Tensor:
        """Force and moment (..., 6) of weight and buoyancy; back: world to body."""
        ship = self.airship
        up = rotate(back, back.new_tensor([0, 0, GRAVITY_M_S2]))
        x, y, _ = up.unbind(-1)
        arm = ship.mass_kg * ship.gravity_centre_height_m
        moment = torch.stack([arm * y, -arm * x, torch.zeros_like(x)], -1)
        return torch.cat([-ship.heaviness_kg * up, moment], -1)

    def _check(self, x: Tensor, u: Tensor | None, dt: Step) -> tuple[Tensor, Tensor]:
        """Outer force and moment, and the air's velocity."""
        if x.shape[-1] != STATE_SIZE:
            raise ValueError(f"the state must be (..., {STATE_SIZE}), got {tuple(x.shape)}")
        if dt is None:
            raise ValueError("this law needs the time step dt")
        if u is None:
            u = x.new_zeros(THRUST_SIZE)
        if u.shape[-1] not in (THRUST_SIZE, THRUST_SIZE + 3):
            raise ValueError(
                "the control must be (..., 3) of forward thrust, upward thrust and yaw moment, or (..., 6) with the "
                f"air's velocity behind, got {tuple(u.shape)}"
            )
        air = u[..., THRUST_SIZE:] if u.shape[-1] > THRUST_SIZE else u.new_zeros(3)
        return u[..., :THRUST_SIZE] @ self.thrust_map.to(u.dtype).mT, air


def inertia_matrix(airship: Airship) -> Tensor:
    """Mass and inertia (6, 6), SI, of airship and moved air, by velocity and rate in body axes at the hull's centre."""
    arm = torch.tensor([0.0, 0.0, airship.gravity_centre_height_m], dtype=torch.float64)
    offset = airship.mass_kg * skew(arm)
    mass = airship.mass_kg + torch.tensor(airship.added_mass_kg, dtype=torch.float64)
    turn = torch.tensor(airship.inertia_kg_m2, dtype=torch.float64) + mass.new_tensor(airship.added_inertia_kg_m2)
    return torch.cat([torch.cat([mass.diag(), -offset], -1), torch.cat([offset, turn.diag()], -1)])
