"""What filters carry and what they report."""

from typing import Generic, NamedTuple, TypeVar

from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.particles import Particles

B = TypeVar("B", Gaussian, Particles)


class FilterState(NamedTuple, Generic[B]):
    """The belief with the position in the noise sequence: all that streaming, branching and resuming need."""

    belief: B
    step: int
    seed: int


class StepInfo(NamedTuple):
    """What one step reports; entries a filter does not have are None.

    log_likelihood, ok, nis, ess, acceptance_rate: (*batch). innovation (*batch, e_y), its factor
    (*batch, e_y, e_y); ancestors (*batch, n).
    """

    log_likelihood: Tensor
    ok: Tensor
    innovation: Tensor | None = None
    innovation_scale_tril: Tensor | None = None
    nis: Tensor | None = None
    ess: Tensor | None = None
    ancestors: Tensor | None = None
    acceptance_rate: Tensor | None = None


class FilterError(ArithmeticError):
    """A filter's arithmetic failed; the message names step, rows, rule and values."""
