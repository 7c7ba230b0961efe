"""What filters carry, what a step is given and what it reports."""

from typing import Any, Generic, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.particles import Particles
from torchfilt.spaces import Space

Step = Tensor | float | None
Missing = Literal["none", "shared", "rows"]


class Guarded(NamedTuple):
    """A belief beside the one to fall back on, which never saw a certain sensor; what `Reacquire` carries.

    refused_s (*batch): for how long that sensor has been refused.
    """

    belief: Gaussian | Particles
    fallback: Gaussian
    refused_s: Tensor

    @property
    def space(self) -> Space:
        """Where the state lives."""
        return self.belief.space

    @property
    def mean(self) -> Tensor:
        """Mean (*batch, d) of the belief."""
        return self.belief.mean

    @property
    def covariance(self) -> Tensor:
        """Covariance (*batch, e, e) of the belief."""
        return self.belief.covariance


class Moded(NamedTuple):
    """A belief with the mode that navigation is in; what `NavigationModes` carries.

    mode (*batch): index of the mode. since_s (*batch): for how long.
    """

    belief: Gaussian | Particles
    mode: Tensor
    since_s: Tensor

    @property
    def space(self) -> Space:
        """Where the state lives."""
        return self.belief.space

    @property
    def mean(self) -> Tensor:
        """Mean (*batch, d) of the belief."""
        return self.belief.mean

    @property
    def covariance(self) -> Tensor:
        """Covariance (*batch, e, e) of the belief."""
        return self.belief.covariance


Belief = Gaussian | Particles | Guarded | Moded
B = TypeVar("B", Gaussian, Particles, Guarded, Moded)


def trusted(belief: Belief) -> Gaussian | Particles:
    """The belief itself, without what stands beside it."""
    return belief.belief if isinstance(belief, Guarded | Moded) else belief


def choose(rows: Tensor, yes: Any, no: Any) -> Any:
    """Beliefs of ``yes`` in the rows (*batch) that are set, of ``no`` in the others; Gaussians or particles."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(rows.reshape(rows.shape + (1,) * (b.dim() - rows.dim())), a, b)

    if isinstance(no, Gaussian):
        return Gaussian(pick(yes.mean, no.mean), pick(yes.scale_tril, no.scale_tril), no.space)
    factor = None if no.scale_tril is None else pick(yes.scale_tril, no.scale_tril)
    return Particles(pick(yes.x, no.x), pick(yes.log_weights, no.log_weights), factor, no.space)


class FilterState(NamedTuple, Generic[B]):
    """The belief with its place in the noise sequence: all that streaming, branching and resuming need."""

    belief: B
    step: int
    seed: int


class StepInfo(NamedTuple):
    """What one step reports; entries that a filter does not have are None.

    log_likelihood, ok, nis, ess, acceptance_rate, particles (how many, where that varies): (*batch). innovation
    (*batch, e_y) and its factor (*batch, e_y, e_y), or (e_y, e_y) where all rows share it; ancestors (*batch, n).
    accepted, gate_nis (*batch), with `Sensors` (*batch, sensors): what a gate took in, in a bank by the heavier half of
    its members, and the squared innovation it was told by, in a bank their weighted mean. restarted (*batch): by
    `Reacquire`. mode, switch (*batch): by `NavigationModes`, the mode that took the step in and which of the switches
    ended it, -1 for none. A history stacks them along time.
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
    accepted: Tensor | None = None
    gate_nis: Tensor | None = None
    restarted: Tensor | None = None
    mode: Tensor | None = None
    switch: Tensor | None = None
    particles: Tensor | None = None
    evidence: str | None = None


class StepNoise(NamedTuple):
    """Random numbers of one step, drawn outside so that the step itself is a pure function.

    proposal (*batch, n, e) standard normals or None; resampling (*batch, k) uniforms; redraw (*batch, n, e) or None;
    move_normal (moves, states, *batch, n, e) and move_uniform (moves, *batch, n), or None; kernel (*batch, n, k)
    normals of a regularisation, or None; seed: for laws that draw by themselves; restart (2, *batch, n, e) normals of
    particles that are drawn anew from a Gaussian, or None.
    """

    proposal: Tensor | None
    resampling: Tensor
    redraw: Tensor | None = None
    move_normal: Tensor | None = None
    move_uniform: Tensor | None = None
    kernel: Tensor | None = None
    seed: int = 0
    restart: Tensor | None = None


class StepInput(NamedTuple):
    """What one step of the particle loop is given; tensors have room for the particle axis.

    y (*batch, 1, m), NaN means not measured; u (*batch, 1, k), (k,) or None; dt number, (*batch, 1, 1) or None, s;
    missing: what is known of the NaNs in y; move: False leaves the motion out.
    """

    y: Tensor
    u: Tensor | None
    dt: Step
    noise: StepNoise
    missing: Missing = "rows"
    move: bool = True


class FilterError(ArithmeticError):
    """A filter's arithmetic failed; the message names step, rows, rule and values."""
