"""Airship by other means: momentum in world axes, rotation matrices, adaptive integration, Lamb's integrals. No torch.

A ship is a dictionary of the numbers that `Airship` has. States are arrays (13) in the library's order.
"""

import numpy as np
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

G = 9.80665


def lamb_integrals(a, b):
    """alpha and beta of the long and the cross axis, by quadrature of their definition."""
    along = quad(lambda s: (a * a + s) ** -1.5 / (b * b + s), 0, np.inf, epsabs=0, epsrel=1e-13)[0]
    across = quad(lambda s: (a * a + s) ** -0.5 / (b * b + s) ** 2, 0, np.inf, epsabs=0, epsrel=1e-13)[0]
    return a * b * b * along, a * b * b * across


def lamb(a, b):
    """k1, k2 and k' from the integrals, Lamb's articles 114 and 115 in semi-axes."""
    alpha, beta = lamb_integrals(a, b)
    difference, total = a * a - b * b, a * a + b * b
    turn = difference**2 * (beta - alpha) / (2 * difference + total * (alpha - beta)) / total
    return alpha / (2 - alpha), beta / (2 - beta), turn


def bodies(ship):
    """Displaced mass, mass, height of the gravity centre, inertia and added parts of the ship."""
    a, b = ship["length_m"] / 2, ship["diameter_m"] / 2
    volume = 4 / 3 * np.pi * a * b * b
    air = ship["air_density_kg_m3"] * volume
    gas = ship["gas_density_kg_m3"] * volume
    mass = air + ship["heaviness_kg"]
    gondola, low = ship["gondola_mass_kg"], ship["gondola_height_m"]
    solid = np.array([a * a + b * b, 2 * b * b, a * a + b * b]) / 5
    # Inertia of the solid grows as the fifth power of its size, its mass as the third: a layer has 5/3 of it by mass.
    inertia = gas * solid + (mass - gas - gondola) * solid * 5 / 3 + gondola * low**2 * np.array([1, 1, 0])
    k1, k2, turn = lamb(a, b)
    return {
        "air": air,
        "mass": mass,
        "low": gondola * low / mass,
        "inertia": inertia,
        "added": air * np.array([k2, k1, k2]),
        "turning": turn * air * solid * np.array([1, 0, 1]),
    }


def _air(ship, v, w):
    """Force and moment of drag and fins, body axes."""
    a, b, rho = ship["length_m"] / 2, ship["diameter_m"] / 2, ship["air_density_kg_m3"]
    side = rho / 2 * ship["cross_drag"] * np.pi * a * b
    hull = np.array([side, rho / 2 * ship["axial_drag"] * np.pi * b * b, side])
    strip = 2 * rho / 2 * ship["cross_drag"] * quad(lambda s: 2 * b * np.sqrt(1 - s * s / a / a) * s**3, 0, a)[0]
    turn = np.array([strip, ship["roll_drag_n_m_s2"], strip])
    force = -hull * v * (ship["linear_speed_m_s"] + abs(v))
    moment = -turn * w * (ship["linear_rate_rad_s"] + abs(w))
    tail = np.array([0, ship["fin_position_m"], 0])
    there = v + np.cross(w, tail)
    fins = -rho / 2 * ship["fin_area_m2"] * ship["fin_lift_slope"] * abs(v[1]) * there * [1, 0, 1]
    return force + fins, moment + np.cross(tail, fins)


def fly(ship, x, time, thrust=(0, 0, 0), wind=(0, 0, 0)):
    """State after ``time``; DOP853."""
    found = bodies(ship)
    centre, wind = np.array([0, 0, found["low"]]), np.asarray(wind, float)
    mass = found["mass"]
    lever = np.array([[0, -centre[2], 0], [centre[2], 0, 0], [0, 0, 0]]) * mass
    block = np.block(
        [
            [mass * np.eye(3) + np.diag(found["added"]), -lever],
            [lever, np.diag(found["inertia"] + found["turning"])],
        ]
    )
    gondola = np.array([0, 0, ship["gondola_height_m"]])

    def motion(turn, linear, angular):
        both = np.linalg.solve(block, np.concatenate([turn.T @ linear, turn.T @ angular]))
        return both[:3], both[3:]

    def slope(_, y):
        turn, linear, angular = y[:9].reshape(3, 3), y[9:12], y[12:15]
        v, w = motion(turn, linear, angular)
        drag, moment = _air(ship, v, w)
        forward, up, yaw = thrust
        push = np.array([0, forward, up])
        weight = np.array([0, 0, -mass * G])
        outer = turn @ (drag + push) + weight + [0, 0, found["air"] * G]
        couple = turn @ (moment + np.cross(gondola, push) + [0, 0, yaw]) + np.cross(turn @ centre, weight)
        spin = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        through = turn @ v
        return np.concatenate([(turn @ spin).ravel(), outer, couple - np.cross(through, linear), through + wind])

    turn = Rotation.from_quat(x[:4]).as_matrix()
    both = block @ np.concatenate([turn.T @ (x[4:7] - wind), x[10:]])
    start = np.concatenate([turn.ravel(), turn @ both[:3], turn @ both[3:], x[7:10]])
    end = solve_ivp(slope, (0, time), start, rtol=1e-11, atol=1e-12, method="DOP853").y[:, -1]
    turn = end[:9].reshape(3, 3)
    v, w = motion(turn, end[9:12], end[12:15])
    return np.concatenate([Rotation.from_matrix(turn).as_quat(), turn @ v + wind, end[15:], w])


def local(x, y):
    """Error that leads from x to y."""
    turn = Rotation.from_quat(y[:4]) * Rotation.from_quat(x[:4]).inv()
    return np.concatenate([turn.as_rotvec(), y[4:] - x[4:]])
