"""What filters carry and what they report."""

from typing import Generic, NamedTuple, TypeVar

from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.particles import Particles

B = TypeVar("B", Gaussian, Particles)


class FilterState(NamedTuple, Generic[B]):
    """The belief with its place in the noise sequence: all that streaming, branching and resuming need."""

    belief: B
    step: int
    seed: int


class StepInfo(NamedTuple):
    """What one step reports; entries that a filter does not have are None.

    log_likelihood, ok, nis, ess, acceptance_rate: (*batch). innovation (*batch, e_y) and its factor
    (*batch, e_y, e_y), or (e_y, e_y) where all rows share it; ancestors (*batch, n). A history stacks them along time.
    evidence says what log_likelihood is, see `torchfilt.run.Filter`: "approximate" where the form biases it.
    """

    log_likelihood: Tensor
    ok: Tensor
    innovation: Tensor | None = None
    innovation_scale_tril: Tensor | None = None
    nis: Tensor | None = None
    ess: Tensor | None = None
    ancestors: Tensor | None = None
    acceptance_rate: Tensor | None = None
    evidence: str | None = None


class StepNoise(NamedTuple):
    """Random numbers of one step, drawn outside so that the step itself is a pure function.

    proposal (*batch, n, e) standard normals or None; resampling (*batch, k) uniforms; redraw (*batch, n, e) or None;
    move_normal (moves, *batch, n, e) and move_uniform (moves, *batch, n), or None; seed: for laws that draw by
    themselves.
    """

    proposal: Tensor | None
    resampling: Tensor
    redraw: Tensor | None = None
    move_normal: Tensor | None = None
    move_uniform: Tensor | None = None
    seed: int = 0


class FilterError(ArithmeticError):
    """A filter's arithmetic failed; the message names step, rows, rule and values."""
