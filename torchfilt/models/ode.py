"""Fixed-step integrators for use inside filters.

Adaptive solvers share one step size between the rows of a batch, so that a row's result depends on its neighbours, and
their data-dependent loops break vmap and compile. Time enters as the elapsed fraction of the interval, a plain
number: what depends on time alone can be prepared once, before the loop.
"""

from collections.abc import Callable

from torch import Tensor

Step = Tensor | float


def rk4(derivative: Callable[[float, Tensor], Tensor], x: Tensor, dt: Step, steps: int = 1) -> Tensor:
    """Classical fourth-order Runge-Kutta over ``dt`` in equal steps.

    Args:
        derivative: f(s, x) in units of x per unit of dt; s in [0, 1] is the elapsed fraction of dt.
        x: (..., d) at the start.
        dt: number or (..., 1).
        steps: how many equal steps dt is cut into.

    Returns:
        (..., d) at the end.
    """
    h = dt / steps
    for k in range(steps):
        start, middle, stop = k / steps, (k + 0.5) / steps, (k + 1) / steps
        k1 = derivative(start, x)
        k2 = derivative(middle, x + 0.5 * h * k1)
        k3 = derivative(middle, x + 0.5 * h * k2)
        k4 = derivative(stop, x + h * k3)
        x = x + (h / 6) * (k1 + 2 * (k2 + k3) + k4)
    return x


def nystrom4(
    acceleration: Callable[[float, Tensor], Tensor], position: Tensor, velocity: Tensor, dt: Step, steps: int = 1
) -> tuple[Tensor, Tensor]:
    """Fourth-order Runge-Kutta-Nystrom for forces that do not depend on velocity: three evaluations a step, not four.

    Args:
        acceleration: a(s, position); s in [0, 1] is the elapsed fraction of dt.
        position, velocity: (..., k) at the start.
        dt: number or a tensor that broadcasts with them.
        steps: how many equal steps dt is cut into.

    Returns:
        Position and velocity at the end.

    Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section II.14, table 14.1 (Nystrom).
    """
    h = dt / steps
    square = h * h
    for k in range(steps):
        a1 = acceleration(k / steps, position)
        drift = position + (0.5 * h) * velocity
        a2 = acceleration((k + 0.5) / steps, drift + (square / 8) * a1)
        ahead = position + h * velocity
        a3 = acceleration((k + 1) / steps, ahead + (square / 2) * a2)
        position = ahead + (square / 6) * (a1 + 2 * a2)
        velocity = velocity + (h / 6) * (a1 + 4 * a2 + a3)
    return position, velocity
