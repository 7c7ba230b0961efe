"""GRACE A and B on 27 July 2010: dynamics learned from the first hours of the log, the pair tracked through the next.

Names load what they need when first used.
"""

from torchfilt.lazy import lazy_names

_HOMES = {
    "GraceData": "data",
    "GraceSettings": "settings",
    "build_data": "data",
    "Dynamics": "learning",
    "learn": "learning",
    "learn_phase": "learning",
    "learn_potential": "learning",
    "nominal_dynamics": "learning",
    "PotentialFit": "potential_gp",
    "PotentialGP": "potential_gp",
    "PotentialTransition": "potential_gp",
    "fit_potential": "potential_gp",
    "predict_from": "prediction",
    "prediction_errors": "prediction",
    "Case": "tracking",
    "Tracked": "tracking",
    "score": "tracking",
    "simulate_case": "tracking",
    "track": "tracking",
    "run": "campaign",
    "table": "campaign",
}

__all__ = sorted(_HOMES)

__getattr__, __dir__ = lazy_names(__name__, _HOMES, globals())
