"""Landing of a multirotor by other means: rotation matrices of SciPy, integration of the motion, plain trigonometry.

No torch. States are arrays (..., 16 or 17) in the library's order; an error turns the attitude from the left.
"""

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.80665])


def fly(x, rate, force, time):
    """State after ``time``: rate(t) and force(t) in body axes are the true ones; biases stay. Adaptive, 1e-12."""

    def slope(t, y):
        attitude = y[:9].reshape(3, 3)
        w = rate(t)
        spin = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(attitude @ spin).ravel(), attitude @ force(t) + GRAVITY, y[9:12]])

    start = np.concatenate([Rotation.from_quat(x[:4]).as_matrix().ravel(), x[4:10]])
    end = solve_ivp(slope, (0, time), start, rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]
    return np.concatenate([Rotation.from_matrix(end[:9].reshape(3, 3)).as_quat(), end[9:], x[10:]])


def retract(x, error):
    """State moved by an error."""
    q = (Rotation.from_rotvec(error[:3]) * Rotation.from_quat(x[:4])).as_quat()
    return np.concatenate([q, x[4:] + error[3:]])


def local(x, y):
    """Error that leads from x to y."""
    turn = Rotation.from_quat(y[:4]) * Rotation.from_quat(x[:4]).inv()
    return np.concatenate([turn.as_rotvec(), y[4:] - x[4:]])


def differences(function, x, steps):
    """Derivative of function(x), given as an error or a vector, by the error of x: central differences."""
    columns = []
    for k, step in enumerate(steps):
        error = np.zeros(len(steps))
        error[k] = step
        columns.append((function(retract(x, error)) - function(retract(x, -error))) / (2 * step))
    return np.stack(columns, -1)


def angles_to_pad(x):
    """Angles (2,) of the pad's direction off the camera's axis, along body x and y, and the distance."""
    ray = Rotation.from_quat(x[:4]).inv().apply(-x[7:10])
    return np.array([math.atan2(ray[0], -ray[2]), math.atan2(ray[1], -ray[2])]), float(np.linalg.norm(ray))


def heading(x):
    """Clockwise from y, of the forward axis."""
    ahead = Rotation.from_quat(x[:4]).apply([0.0, 1.0, 0.0])
    return math.atan2(ahead[0], ahead[1])


def turned(x, angle):
    """State turned counter-clockwise about the vertical through the pad."""
    turn = Rotation.from_rotvec([0.0, 0.0, angle])
    q = (turn * Rotation.from_quat(x[:4])).as_quat()
    return np.concatenate([q, turn.apply(x[4:7]), turn.apply(x[7:10]), x[10:]])
