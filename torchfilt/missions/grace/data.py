"""The log as relative motion: chief, Hill states, controls and ranges at the filter's steps."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.io.grace import read_grace
from torchfilt.missions.grace.settings import GraceSettings
from torchfilt.models.relative_motion import (
    J2_EARTH,
    ChiefOrbit,
    Field,
    TwoBody,
    chief_controls,
    chief_orbit,
    hill_states,
)

# Of EGM2008; the radius of `torchfilt.models.relative_motion` is its own too.
MU_M3_S2 = 3.986004415e14
_MANIFEST = "manifest.json"


class GraceData(NamedTuple):
    """A day of the pair, GRACE A being the chief.

    chief: at the log's t epochs, 10 s apart. relative (t, 6): Hill states of GRACE B there. states (s + 1, 6), controls
    (s, 21), range_m (s + 1,): the same at the ends of the steps, the controls between them, and the K-band range (NaN
    where there is none).
    """

    chief: ChiefOrbit
    relative: Tensor
    states: Tensor
    controls: Tensor
    range_m: Tensor


def build_data(settings: GraceSettings) -> GraceData:
    """Read the log and describe B relative to A.

    Raises:
        LogError, FileNotFoundError: of `torchfilt.io.grace.read_grace`.
    """
    manifest = Path(settings.folder) / _MANIFEST
    log = read_grace(settings.folder, manifest=manifest if manifest.exists() else None)
    chief = chief_orbit(log.time_s, log.position_a_m, log.velocity_a_m_s, Field(MU_M3_S2, J2_EARTH))
    relative = hill_states(chief, log.position_b_m, log.velocity_b_m_s)
    stride = settings.stride
    return GraceData(chief, relative, relative[::stride], chief_controls(chief, stride=stride), log.range_m[::stride])


def nominal_law(psd_m2_s3: float, *, j2: bool, step_s: float) -> TwoBody:
    """Motion about the known chief, point mass or flattened Earth, both integrated as a difference.

    At 225 km linear laws are useless, and structured inputs must not carry the orbit's curvature: here the curvature is
    in the nominal law, and nothing that is learned sees it.
    """
    steps = max(1, round(step_s / 20))
    return TwoBody(psd_m2_s3, MU_M3_S2, j2=J2_EARTH if j2 else None, steps=steps)


def residual(data: GraceData, law: TwoBody, step_s: float) -> Tensor:
    """What a nominal law misses at the end of each step, (s, 6)."""
    with torch.no_grad():
        return data.states[1:] - law(data.states[:-1], data.controls, step_s).mean
