"""Airship: added mass, equations of motion, balances, closed forms, an independent integration, the law in filters."""

import itertools
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from oracles import airship_oracle as oracle
from scipy.spatial.transform import Rotation

from torchfilt.filters import BootstrapFilter, UnscentedKalmanFilter
from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearGaussian
from torchfilt.model import StateSpaceModel
from torchfilt.models.airship import (
    AIRSHIP_SPACE,
    GRAVITY_M_S2,
    Airship,
    AirshipTransition,
    inertia_matrix,
    lamb_factors,
)
from torchfilt.models.attitude import from_euler, from_rotation_vector, multiply, rotate
from torchfilt.models.sensors import atmosphere
from torchfilt.testing import check_law

DOUBLE = torch.float64
SHIP = Airship()
OTHER = Airship(2.6, 1.0, 1.15, 0.2, 0.5, -0.6, 0.05, 0.3, 0.7, 0.01, 0.1, 0.02, 0.2, -1.1, 2.0)
"""No number is the default's."""
STILL = replace(SHIP, axial_drag=0.0, cross_drag=0.0, roll_drag_n_m_s2=0.0, fin_area_m2=0.0)
"""Neutral and without friction."""


def states(count=4, seed=0, speed=0.6, rate=0.3):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda n: torch.randn(count, n, generator=generator, dtype=DOUBLE)  # noqa: E731
    return torch.cat([from_rotation_vector(0.5 * draw(3)), speed * draw(3), 3 * draw(3), rate * draw(3)], -1)


def level(speed=0.0, **rates):
    x = torch.zeros(13, dtype=DOUBLE)
    x[3], x[5] = 1, speed
    return x


def away(x, y):
    return AIRSHIP_SPACE.local(x, y).abs().max()


# Geometry -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slenderness", [1.05, 1.3, 2.0, 7 / 3, 4.0, 10.0])
def test_lamb_factors_are_those_of_the_integrals(slenderness):
    """Quadrature is good to 1e-12; towards the sphere the closed form loses as e^-5 of rounding, 3e-13 at most here."""
    found = lamb_factors(slenderness)
    np.testing.assert_allclose(found, oracle.lamb(slenderness, 1.0), rtol=1e-9 if slenderness < 1.2 else 1e-11)


def test_lamb_factors_of_the_tables():
    """Lamb's article 115: k1, k2, k' by slenderness, rounded there to 0.005 or 0.002 in k'; needle and sphere."""
    table = {1.5: (0.305, 0.621, 0.094), 2.99: (0.122, 0.803, 0.465), 9.97: (0.021, 0.960, 0.883)}
    for slenderness, row in table.items():
        np.testing.assert_allclose(lamb_factors(slenderness), row, atol=2e-3)
    np.testing.assert_allclose(lamb_factors(1e5), (0, 1, 1), atol=1e-8)
    np.testing.assert_allclose(lamb_factors(1.05)[:2], (0.5, 0.5), atol=0.03)


@pytest.mark.parametrize("ship", [SHIP, OTHER], ids=["default", "other"])
def test_masses_and_inertia(ship):
    found = oracle.bodies(asdict(ship))
    for name, value in (
        ("air", ship.displaced_mass_kg),
        ("mass", ship.mass_kg),
        ("low", ship.gravity_centre_height_m),
        ("inertia", ship.inertia_kg_m2),
        ("added", ship.added_mass_kg),
        ("turning", ship.added_inertia_kg_m2),
    ):
        np.testing.assert_allclose(value, found[name], rtol=1e-11)
    matrix = inertia_matrix(ship)
    assert torch.equal(matrix, matrix.mT) and torch.linalg.eigvalsh(matrix).min() > 0


def test_inertia_of_gas_and_skin_by_sampling():
    """Points in the hull, and in the layer to a hull a little larger: five standard errors of 400,000 points."""
    ship = replace(SHIP, gondola_mass_kg=0.0)
    a, b = ship.length_m / 2, ship.diameter_m / 2
    rng = np.random.default_rng(0)
    ball = rng.standard_normal((400_000, 3))
    ball *= (rng.random((400_000, 1)) ** (1 / 3)) / np.linalg.norm(ball, axis=1, keepdims=True)
    layer = ball / np.linalg.norm(ball, axis=1, keepdims=True)
    gas = ship.gas_density_kg_m3 * ship.volume_m3
    total, error = np.zeros(3), np.zeros(3)
    for points, mass in ((ball, gas), (layer, ship.skin_mass_kg)):
        square = (points * [b, a, b]) ** 2
        arms = square.sum(1, keepdims=True) - square
        total += mass * arms.mean(0)
        error += mass * arms.std(0) / math.sqrt(len(points))
    assert (np.abs(total - ship.inertia_kg_m2) < 5 * error).all()


def test_air_is_that_of_the_standard_atmosphere():
    """At 20 degC and the pressure of sea level; helium by its molar mass."""
    air = atmosphere.SEA_LEVEL_PRESSURE_PA / (atmosphere.GAS_CONSTANT_J_KG_K * 293.15)
    assert abs(SHIP.air_density_kg_m3 - air) < 1e-4 and abs(SHIP.gas_density_kg_m3 - air * 4.0026 / 28.9644) < 1e-4


def test_axial_drag_is_hoerners():
    """0.44 d/l + 4 f (l/d + sqrt(d/l)), laminar friction at 1 m/s, air of 20 degC: rounded to two figures."""
    friction = 1.328 / math.sqrt(1.0 * SHIP.length_m / 1.516e-5)
    thick = SHIP.diameter_m / SHIP.length_m
    assert abs(0.44 * thick + 4 * friction * (1 / thick + math.sqrt(thick)) - SHIP.axial_drag) < 0.005


# Balances -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_static_equilibrium(yaw):
    x = level()
    x[:4] = from_euler(torch.tensor(yaw, dtype=DOUBLE), *torch.zeros(2, dtype=DOUBLE))
    x[7:10] = torch.tensor([3.0, -1.0, 2.0])
    assert away(x, AirshipTransition()(x, None, 1.0).mean) < 1e-14


def test_energy_and_momentum_without_friction():
    """Neutral: energy and vertical angular momentum stay, and all of the linear momentum. RK4 at 1/200 s: 2e-9."""
    law = AirshipTransition(STILL, steps=200)
    x = states()
    matrix = inertia_matrix(STILL)

    def momenta(x):
        q = x[:, :4]
        motion = torch.cat([rotate(q * torch.tensor([-1.0, -1, -1, 1]), x[:, 4:7]), x[:, 10:]], -1)
        linear, angular = (rotate(q, part) for part in (motion @ matrix).split(3, -1))
        return linear, (angular + torch.linalg.cross(x[:, 7:10], linear))[:, 2]

    energy, (linear, vertical) = law.energy(x), momenta(x)
    for _ in range(5):
        x = law(x, None, 1.0).mean
    torch.testing.assert_close(law.energy(x), energy, rtol=2e-9, atol=0)
    after = momenta(x)
    torch.testing.assert_close(after[0], linear, rtol=0, atol=2e-9)
    torch.testing.assert_close(after[1], vertical, rtol=0, atol=2e-9)
    assert (x[:, 4:7] - states()[:, 4:7]).abs().max() > 0.05  # momentum stays, velocity does not


def test_energy_by_hand():
    """Half a rotation, a metre up, no motion; then forward motion with its added mass."""
    law = AirshipTransition(OTHER)
    x = level()
    x[:4] = torch.tensor([1.0, 0, 0, 0])
    x[9] = 1.0
    hand = GRAVITY_M_S2 * (-2 * OTHER.mass_kg * OTHER.gravity_centre_height_m + OTHER.heaviness_kg)
    torch.testing.assert_close(float(law.energy(x)), hand, rtol=1e-12, atol=0)
    moving = 0.5 * (OTHER.mass_kg + OTHER.added_mass_kg[1]) * 0.8**2
    torch.testing.assert_close(float(law.energy(level(0.8))), moving, rtol=1e-12, atol=0)


@pytest.mark.parametrize("ship", [SHIP, OTHER], ids=["default", "other"])
def test_energy_falls_without_thrust(ship):
    law = AirshipTransition(ship, steps=4)
    x = states(50, seed=1)
    energy = law.energy(x)
    first = energy
    for _ in range(100):
        x = law(x, None, 0.1).mean
        assert (law.energy(x) < energy).all()
        energy = law.energy(x)
    assert (first - energy).min() > 0.01


@pytest.mark.parametrize("thrust", [0.02, 0.1, -0.1])
def test_terminal_speed(thrust):
    """c v (s + |v|) = thrust where the nose is held level by a gondola at the hull's centre and thrust through it."""
    ship = replace(SHIP, gondola_height_m=0.0)
    law, x, u = AirshipTransition(ship), level(), torch.tensor([thrust, 0, 0], dtype=DOUBLE)
    for _ in range(200):
        x = law(x, u, 2.0).mean
    square, slow = ship.drag_n_s2_m2[1], ship.linear_speed_m_s
    speed = math.copysign(-slow / 2 + math.sqrt(slow**2 / 4 + abs(thrust) / square), thrust)
    np.testing.assert_allclose(x[5], speed, rtol=1e-8)
    assert away(x[..., :4].new_tensor([0, 0, 0, 1.0, 0, speed, 0, 0, x[8], 0, 0, 0, 0]), x) < 1e-8


def test_terminal_climb_and_yaw_rate():
    law, x = AirshipTransition(), level()
    u = torch.tensor([0.0, 0.05, 0.03], dtype=DOUBLE)
    for _ in range(500):
        x = law(x, u, 0.8).mean
    for value, push, square, slow in (
        (x[6], 0.05, SHIP.drag_n_s2_m2[2], SHIP.linear_speed_m_s),
        (x[12], 0.03, SHIP.turn_drag_n_m_s2[2], SHIP.linear_rate_rad_s),
    ):
        np.testing.assert_allclose(value, -slow / 2 + math.sqrt(slow**2 / 4 + push / square), rtol=1e-6)


@pytest.mark.parametrize(("axis", "side"), [(0, 1), (1, 0)], ids=["pitch", "roll"])
def test_pendulum_period(axis, side):
    """Small swings of the frictionless ship; the momentum across stays zero, so the axis of rest is not the hull's.

    I' = I + J - (m h)^2 / (m + A), period 2 pi sqrt(I' / (m g h)); 1e-3 rad shifts it by 6e-8 of itself.
    """
    law = AirshipTransition(STILL, steps=20)
    arm = STILL.mass_kg * -STILL.gravity_centre_height_m
    inertia = STILL.inertia_kg_m2[axis] + STILL.added_inertia_kg_m2[axis]
    free = inertia - arm**2 / (STILL.mass_kg + STILL.added_mass_kg[side])
    period = 2 * math.pi * math.sqrt(free / (arm * GRAVITY_M_S2))
    turn = torch.zeros(3, dtype=DOUBLE)
    turn[axis] = 1e-3
    x = torch.cat([from_rotation_vector(turn), torch.zeros(9, dtype=DOUBLE)])
    quarter = law(x, None, period / 4).mean
    assert quarter[axis].abs() < 1e-9
    whole = quarter
    for _ in range(3):
        whole = law(whole, None, period / 4).mean
    assert (AIRSHIP_SPACE.local(x, whole)[:3]).abs().max() < 2e-9
    assert 1.5 < period < 4


@pytest.mark.parametrize("angle_deg", [20.0, -35.0])
def test_munk_moment(angle_deg):
    """Flying forward with the flow from the side: (k2 - k1) / 2 * air U^2 sin 2a, across, away from the path."""
    law, angle, speed = AirshipTransition(STILL), math.radians(angle_deg), 1.3
    k1, k2, _ = lamb_factors(STILL.length_m / STILL.diameter_m)
    munk = (k2 - k1) / 2 * STILL.displaced_mass_kg * speed**2 * math.sin(2 * angle)
    none, air = torch.zeros(6, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE)
    x = level()
    # Velocity to the right of the nose: the nose goes left, positive about z.
    x[4], x[5] = speed * math.sin(angle), speed * math.cos(angle)
    moment = inertia_matrix(STILL)[5, 5] * law.rates(x, none, air)[12]
    np.testing.assert_allclose(moment, munk, rtol=1e-12)
    # Velocity below the nose: the nose goes up. With the ballast the pull on the centre of gravity has its share, so
    # the whole momentum is asked for.
    x = level()
    x[6], x[5] = -speed * math.sin(angle), speed * math.cos(angle)
    change = inertia_matrix(STILL) @ law.rates(x, none, air)[[4, 5, 6, 10, 11, 12]]
    np.testing.assert_allclose(change[3], munk, rtol=1e-12)


def test_fins_turn_into_the_wind():
    """The moment of the fins alone, against Munk's: right velocity turns the nose right."""
    none, air, x = torch.zeros(6, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE), level(1.0)
    x[4] = 0.1
    with_fins = AirshipTransition(replace(STILL, fin_area_m2=0.15))
    extra = (with_fins.rates(x, none, air) - AirshipTransition(STILL).rates(x, none, air))[12]
    hand = STILL.fin_position_m * 0.5 * 1.2041 * 0.15 * 2.5 * 1.0 * 0.1
    np.testing.assert_allclose(extra * inertia_matrix(STILL)[5, 5], hand, rtol=1e-12)


def test_thrust_acts_at_the_gondola():
    law, air, x = AirshipTransition(), torch.zeros(3, dtype=DOUBLE), level()
    wrench = law.thrust_map @ torch.tensor([0.2, 0.3, 0.1], dtype=DOUBLE)
    assert torch.equal(wrench, torch.tensor([0, 0.2, 0.3, 0.5 * 0.2, 0, 0.1], dtype=DOUBLE))
    push = inertia_matrix(SHIP) @ law.rates(x, wrench, air)[[4, 5, 6, 10, 11, 12]]
    torch.testing.assert_close(push, wrench, rtol=0, atol=1e-14)


def test_wind_carries_the_ship():
    """In steady air everything is the same seen from the air; at rest in it, the ship goes with it."""
    law, x, wind = AirshipTransition(OTHER, steps=5), states(), torch.tensor([0.3, -0.2, 0.1], dtype=DOUBLE)
    thrust = torch.tensor([0.1, 0.05, 0.02], dtype=DOUBLE)
    seen = x.clone()
    seen[:, 4:7] += wind
    there = law(seen, torch.cat([thrust, wind]), 0.7).mean
    here = law(x, thrust, 0.7).mean
    here[:, 4:7] += wind
    here[:, 7:10] += 0.7 * wind
    torch.testing.assert_close(there, here, rtol=0, atol=1e-13)


@pytest.mark.parametrize("yaw", [0.7, -2.0])
def test_turning_about_the_vertical(yaw):
    """Commutes with the motion, air included, as does any shift of the position."""
    turn = torch.tensor([0, 0, math.sin(yaw / 2), math.cos(yaw / 2)], dtype=DOUBLE)
    shift = torch.tensor([1.0, 2.0, -3.0], dtype=DOUBLE)

    def moved(x):
        q = multiply(turn.expand(len(x), 4), x[:, :4])
        return torch.cat([q, rotate(turn, x[:, 4:7]), rotate(turn, x[:, 7:10]) + shift, x[:, 10:]], -1)

    x, wind = states(), torch.tensor([0.3, -0.2, 0.1], dtype=DOUBLE)
    thrust = torch.tensor([0.1, 0.05, 0.02], dtype=DOUBLE)
    law = AirshipTransition()
    first = law(moved(x), torch.cat([thrust, rotate(turn, wind)]), 0.1).mean
    torch.testing.assert_close(first, moved(law(x, torch.cat([thrust, wind]), 0.1).mean), rtol=0, atol=1e-13)


# Integration ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ship", [SHIP, OTHER], ids=["default", "other"])
def test_against_scipy(ship):
    """One second by an adaptive integration of momentum in world axes; 1e-8 with kinks of the drag met on the way.

    The ship flies forward in the air throughout: where that speed changes its sign the fins have a sharper kink.
    """
    law, thrust, wind = AirshipTransition(ship, steps=500), [0.1, -0.05, 0.03], [0.2, 0.1, -0.05]
    x = states(3, seed=3)
    x[:, 4:7] = x[:, 4:7] / 4 + rotate(x[:, :4], torch.tensor([0, 1.0, 0], dtype=DOUBLE))
    end = law(x, torch.tensor(thrust + wind, dtype=DOUBLE), 1.0).mean.numpy()
    for row, found in zip(x.numpy(), end, strict=True):
        assert np.abs(oracle.local(oracle.fly(asdict(ship), row, 1.0, thrust, wind), found)).max() < 1e-8
        assert np.abs(oracle.local(row, found)).max() > 0.5


def test_fourth_order():
    """No speed changes its sign on the way, where the drag has a kink."""
    x = level(0.8)
    x[4], x[6], x[10:] = 0.3, 0.4, torch.tensor([0.5, 0.4, 0.3])
    u = torch.tensor([0.5, 0.2, 0.1], dtype=DOUBLE)
    exact = AirshipTransition(steps=640)(x, u, 0.4).mean
    errors = [float(away(exact, AirshipTransition(steps=n)(x, u, 0.4).mean)) for n in (2, 4, 8, 16)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert all(3.7 < order < 4.4 for order in orders), orders


def test_steps_are_steps():
    x, u = states(), torch.tensor([0.1, 0.0, 0.02], dtype=DOUBLE)
    law, one = AirshipTransition(steps=3), AirshipTransition()
    whole = law(x, u, 0.3).mean
    for _ in range(3):
        x = one(x, u, 0.1).mean
    assert away(x, whole) < 1e-14  # how often the norm is restored does not matter


def test_float32_and_batches():
    law, x = AirshipTransition(OTHER), states(6).unflatten(0, (2, 3))
    u = torch.tensor([[0.1, 0.0, 0.02], [0.0, 0.1, -0.02]], dtype=DOUBLE).unsqueeze(1)
    dt = torch.tensor([[0.05], [0.1], [0.0]], dtype=DOUBLE)
    whole = law(x, u, dt)
    assert whole.mean.shape == (2, 3, 13) and away(x[:, 2], whole.mean[:, 2]) < 1e-15
    for i, j in itertools.product(range(2), range(3)):
        row = law(x[i, j], u[i, 0], float(dt[j]))
        torch.testing.assert_close(row.mean, whole.mean[i, j], rtol=0, atol=1e-14)
        torch.testing.assert_close(row.scale_tril, whole.scale_tril.expand(3, 12)[j], rtol=0, atol=1e-15)
    single = law(x.float(), u.float(), dt.float())
    assert single.mean.dtype == single.scale_tril.dtype == torch.float32
    torch.testing.assert_close(single.mean.double(), whole.mean, rtol=0, atol=5e-6)
    # A state without batch, air that has one.
    air = torch.cat([torch.zeros(5, 3, dtype=DOUBLE), 0.1 * torch.randn(5, 3, dtype=DOUBLE)], -1)
    assert law(x[0, 0], air, 0.1).mean.shape == (5, 13)


# The law --------------------------------------------------------------------------------------------------------------


def test_noise():
    law = AirshipTransition(acceleration_sd_m_s_sqrt_s=0.02, turn_sd_rad_s_sqrt_s=0.03)
    expected = torch.tensor([0.0] * 3 + [0.02] * 3 + [0.0] * 3 + [0.03] * 3, dtype=DOUBLE) * math.sqrt(0.25)
    found = law(states(), None, 0.25)
    torch.testing.assert_close(found.scale_tril, expected, rtol=1e-15, atol=0)
    assert found.is_diagonal and found.space is AIRSHIP_SPACE and law.noise_in == [3, 4, 5, 9, 10, 11]
    assert AirshipTransition(turn_sd_rad_s_sqrt_s=0.0).noise_in == [3, 4, 5]
    assert AirshipTransition(acceleration_sd_m_s_sqrt_s=0.0).noise_in == [9, 10, 11]


def test_conformance():
    check_law(AirshipTransition(), states(5), torch.tensor([0.1, 0.0, 0.02], dtype=DOUBLE), 0.1)


def test_compiles():
    law, x, u = AirshipTransition(), states(5), torch.tensor([0.1, 0.0, 0.02], dtype=DOUBLE)
    compiled = torch.compile(lambda x: law(x, u, 0.1).mean, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x), law(x, u, 0.1).mean, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", ["unscented", "particle"])
def test_in_filters(kind):
    """Position and attitude fixes of a drifting ship: the errors stay within five deviations of what is claimed."""
    law = AirshipTransition(steps=2)
    truth, u = [level(0.3)], torch.tensor([0.08, 0.0, 0.02], dtype=DOUBLE)
    for _ in range(40):
        truth.append(law(truth[-1], u, 0.1).mean)
    spread = torch.tensor([0.02] * 3 + [0.05] * 3 + [0.2] * 3 + [0.02] * 3, dtype=DOUBLE)
    pick = torch.zeros(6, 13, dtype=DOUBLE)
    pick[:3, 7:10] = pick[3:, 10:] = torch.eye(3)
    model = StateSpaceModel(
        Gaussian(level(0.3), spread, AIRSHIP_SPACE, is_diagonal=True),
        law,
        LinearGaussian(pick, 0.01 * torch.eye(6, dtype=DOUBLE)),
    )
    noise = torch.randn(40, 6, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    seen = torch.stack(truth[1:]) @ pick.mT + 0.1 * noise
    chosen = UnscentedKalmanFilter(model) if kind == "unscented" else BootstrapFilter(model, particles=4000)
    history = chosen(seen, u.expand(40, 3), dt=0.1)
    error = AIRSHIP_SPACE.local(history.mean[-1], truth[-1])
    deviation = history.covariance[-1].diagonal().sqrt()
    assert (error.abs() < 5 * deviation).all()
    assert (deviation[6:9] < 0.1).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length_m": math.nan}, "length_m must be finite and not negative, got nan"),
        ({"cross_drag": -1.0}, "cross_drag must be finite and not negative, got -1.0"),
        ({"heaviness_kg": math.inf}, "heaviness_kg must be finite, got inf"),
        ({"diameter_m": 0.0}, "diameter_m must be positive, got 0"),
        ({"gondola_height_m": 0.1}, "gondola_height_m must not be positive, got 0.1"),
        ({"fin_position_m": 0.1}, "fin_position_m must not be positive, got 0.1"),
        ({"length_m": 0.91}, "slenderness must be finite and at least 1.05, got 1.01"),
        ({"gondola_mass_kg": 1.0}, "leave no mass for the skin: -0.07"),
    ],
)
def test_ships_that_can_not_be(change, message):
    with pytest.raises(ValueError, match=message):
        Airship(**change)


def test_errors():
    for name in ("acceleration_sd_m_s_sqrt_s", "turn_sd_rad_s_sqrt_s"):
        with pytest.raises(ValueError, match=f"{name} must be one finite number >= 0, got -1"):
            AirshipTransition(**{name: -1.0})
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        AirshipTransition(steps=0)
    law, x = AirshipTransition(), level()
    with pytest.raises(ValueError, match=r"the state must be \(..., 13\), got \(12,\)"):
        law(x[1:], None, 0.1)
    with pytest.raises(ValueError, match="needs the time step dt"):
        law(x)
    with pytest.raises(ValueError, match=r"with the air's velocity behind, got \(4,\)"):
        law(x, torch.zeros(4, dtype=DOUBLE), 0.1)


def test_quaternion_order_is_scipys():
    """A ship with its nose to the east, pushed forward, goes east."""
    x = level()
    x[:4] = torch.from_numpy(Rotation.from_euler("z", -90, degrees=True).as_quat())
    end = AirshipTransition()(x, torch.tensor([0.2, 0, 0], dtype=DOUBLE), 0.5).mean
    assert end[7] > 0.005 and end[8].abs() < 1e-12 and end[4] > 0.02
