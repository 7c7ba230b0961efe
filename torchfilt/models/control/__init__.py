"""Linear systems and their design: state space, discretisation, observers, Riccati equations."""

from torchfilt.models.control.continuous import ContinuousLinear, ContinuousTransition, linear_model
from torchfilt.models.control.design import (
    KalmanDesign,
    LqgDesign,
    Regulator,
    kalman,
    lqgr,
    lqr,
    place,
)
from torchfilt.models.control.empirical import Empirical, empirical_gramian
from torchfilt.models.control.ins import INS_ERROR_NAMES, INS_ERROR_SCALE, ins_error_pair
from torchfilt.models.control.manoeuvres import stripped_observability, stripping_defect, total_observability
from torchfilt.models.control.observability import (
    Modes,
    Rank,
    controllability_gramian,
    ctrb,
    observability_gramian,
    obsv,
    pbh,
    rank,
)
from torchfilt.models.control.reports import ObservabilityReport, heat_map, observability_report
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
    "ContinuousLinear",
    "ContinuousTransition",
    "linear_model",
    "Empirical",
    "empirical_gramian",
    "INS_ERROR_NAMES",
    "INS_ERROR_SCALE",
    "ins_error_pair",
    "stripped_observability",
    "stripping_defect",
    "total_observability",
    "Modes",
    "Rank",
    "controllability_gramian",
    "ctrb",
    "observability_gramian",
    "obsv",
    "pbh",
    "rank",
    "ObservabilityReport",
    "heat_map",
    "observability_report",
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
