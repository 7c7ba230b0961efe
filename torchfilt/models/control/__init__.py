"""Linear systems and their design: state space, discretisation, observers, Riccati equations."""

from torchfilt.models.control.design import (
    KalmanDesign,
    LqgDesign,
    Regulator,
    kalman,
    lqgr,
    lqr,
    place,
)
from torchfilt.models.control.systems import (
    Discretized,
    StateSpace,
    as_system,
    c2d,
    eig,
    hold_input,
    integrate_noise,
    pinv,
    poles,
    pzmap,
    ss,
    zeros,
)

__all__ = [
    "KalmanDesign",
    "LqgDesign",
    "Regulator",
    "kalman",
    "lqgr",
    "lqr",
    "place",
    "Discretized",
    "StateSpace",
    "as_system",
    "c2d",
    "eig",
    "hold_input",
    "integrate_noise",
    "pinv",
    "poles",
    "pzmap",
    "ss",
    "zeros",
]
