"""Rotations and angles by other means: SciPy's rotations, a least-squares search and an enumeration. No torch."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def retract(quaternion, vector, side):
    """Quaternion (x y z w) turned by a rotation vector on the given side."""
    base, turn = Rotation.from_quat(quaternion), Rotation.from_rotvec(vector)
    return (base * turn if side == "right" else turn * base).as_quat()


def local(start, end, side):
    """Rotation vector that leads from one quaternion to another."""
    a, b = Rotation.from_quat(start), Rotation.from_quat(end)
    return (a.inv() * b if side == "right" else b * a.inv()).as_rotvec()


def rotate(quaternion, vector):
    """Components of a vector turned by a rotation."""
    return Rotation.from_quat(quaternion).apply(vector)


def distance(a, b):
    """Angle in rad between two rotations."""
    return (Rotation.from_quat(a).inv() * Rotation.from_quat(b)).magnitude()


def mean_by_search(points, weights):
    """Minimiser of the weighted squared angles to the points (n, 4): least squares from SciPy's chordal mean."""
    rotations = Rotation.from_quat(points)
    start = rotations.mean(weights)
    root = np.sqrt(weights)[:, None]

    def residuals(v):
        return (root * ((start * Rotation.from_rotvec(v)).inv() * rotations).as_rotvec()).ravel()

    found = least_squares(residuals, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return (start * Rotation.from_rotvec(found.x)).as_quat()


def circular_mean(angles, weights):
    """Global minimiser of the weighted squared arcs: the means of all ways to cut the circle, the cheapest of them."""
    order = np.argsort(angles)
    angles, weights = np.asarray(angles)[order], np.asarray(weights)[order]
    candidates = []
    for cut in range(len(angles)):
        shifted = angles + np.where(np.arange(len(angles)) < cut, 2 * np.pi, 0.0)
        candidates.append(weights @ shifted / weights.sum())
    arcs = [np.angle(np.exp(1j * (angles - m))) for m in candidates]
    best = min(range(len(candidates)), key=lambda k: weights @ arcs[k] ** 2)
    return np.angle(np.exp(1j * candidates[best]))
