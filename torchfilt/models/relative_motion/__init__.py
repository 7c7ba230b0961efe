"""Motion of one satellite relative to another: frames, dynamics, radar, and a two-satellite truth.

States are [x y z vx vy vz] in the chief's Hill frame (x radial outward, z orbit normal, y along track), SI units.
"""

from torchfilt.models.relative_motion.chief import (
    CONTROL_SIZE,
    ChiefOrbit,
    chief_controls,
    chief_orbit,
    hill_states,
    orbit_phase,
    phase,
    split_control,
)
from torchfilt.models.relative_motion.clohessy_wiltshire import (
    ClohessyWiltshire,
    cw_input,
    cw_noise_factor,
    cw_transition,
)
from torchfilt.models.relative_motion.frames import (
    frame_rate,
    from_curvilinear,
    from_hill,
    hill_axes,
    to_curvilinear,
    to_hill,
)
from torchfilt.models.relative_motion.gravity import EARTH_RADIUS_M, J2_EARTH, MU_M3_S2, Field
from torchfilt.models.relative_motion.latent_force import HarmonicForce
from torchfilt.models.relative_motion.nominal import LinearTimeVarying, TwoBody
from torchfilt.models.relative_motion.radar import RADAR_SPACE, RendezvousRadar, line_of_sight
from torchfilt.models.relative_motion.ranging import BiasedRanging, WithConstant
from torchfilt.models.relative_motion.truth import (
    Formation,
    FormationSettings,
    propagate_formation,
    propagate_relative,
    simulate_formation,
    training_pairs,
)

__all__ = [
    "CONTROL_SIZE",
    "EARTH_RADIUS_M",
    "J2_EARTH",
    "MU_M3_S2",
    "RADAR_SPACE",
    "BiasedRanging",
    "ChiefOrbit",
    "ClohessyWiltshire",
    "Field",
    "Formation",
    "FormationSettings",
    "HarmonicForce",
    "LinearTimeVarying",
    "RendezvousRadar",
    "TwoBody",
    "WithConstant",
    "chief_controls",
    "chief_orbit",
    "cw_input",
    "cw_noise_factor",
    "cw_transition",
    "frame_rate",
    "from_curvilinear",
    "from_hill",
    "hill_axes",
    "hill_states",
    "line_of_sight",
    "orbit_phase",
    "phase",
    "propagate_formation",
    "propagate_relative",
    "simulate_formation",
    "split_control",
    "to_curvilinear",
    "to_hill",
    "training_pairs",
]
