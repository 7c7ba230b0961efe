"""Rao-Blackwellised particles: some components are drawn, the others stay a Gaussian in each particle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian, cat_columns
from torchfilt.linalg import apply_factor, for_points, triangularize
from torchfilt.model import Conditional, StateSpaceModel, as_gaussian
from torchfilt.moments import (
    Law,
    Linearization,
    Rule,
    Taylor,
    check_rule_type,
    check_transition_space,
    taylor,
    update,
)
from torchfilt.particles import Particles, uniform_log_weights
from torchfilt.proposals import Evidence, Prior, Proposed
from torchfilt.spaces import EUCLIDEAN, Space, curved_components
from torchfilt.types import StepInput


@dataclass(frozen=True)
class RaoBlackwellized:
    """Drawn components are points, the others a Gaussian in each particle, which a moment rule carries along.

    A step predicts each particle's Gaussian, draws the drawn components from their margin of it, conditions the others
    on the draw, and lets the measurement update these and weight the particle by its innovation likelihood. This is
    exact where the laws are linear in the components that are not drawn, given those that are: for models with
    ``linear_form``, and for laws that say so by ``linear_in``, a slice or the indices of such error components.

    A factor that no particle touches is carried once a row, (*batch, 1, e, e): with linear laws, and where a law's
    ``first_order(x, u, dt) -> (Gaussian, jacobian (..., m, e))`` leaves the particle axis away in noise and jacobian
    or gives it the length 1. Columns of the jacobian that belong to drawn components are not looked at. ``shared``
    makes it one factor a row for any laws: only means are then taken at each particle, derivatives and noise at the
    mean of the row. Where these hardly depend on the particle it is many times faster and hardly less exact.

    Drawn components may be singular: what the earlier ones determine is not drawn again. Particles without a
    covariance are points and go on as in `Prior`; nothing else is left where everything is drawn.

    Args:
        drawn: error components to draw, a slice or indices.
        rule: moment rule for the others; expands about each particle.
        shared: see above; with `taylor()`.

    Raises:
        TypeError: drawn holds something that is not an index; not a moment rule.
        ValueError: negative or repeated indices, a rule that expands about a point of its own, shared with another rule
            than `taylor()`; later, indices that the state does not have, a quadrature with a negative weight.

    Sources: Schon, Gustafsson, Nordlund, Marginalized particle filters for mixed linear/nonlinear state-space models,
        IEEE TSP 53 (2005); Doucet, Godsill, Andrieu, Statistics and Computing 10 (2000), section IV.
    """

    drawn: slice | Sequence[int]
    rule: Rule = field(default_factory=taylor)
    shared: bool = False
    evidence: Evidence = "linearized"
    draws_at_once: bool = True
    needs_redraw_noise: bool = False
    leaves_points: bool = False

    def __post_init__(self) -> None:
        check_rule_type(self.rule)
        if isinstance(self.rule, Taylor) and self.rule.about is not None:
            raise ValueError("each particle is expanded about itself: the rule must be taylor() without a point")
        if self.shared and not isinstance(self.rule, Taylor):
            raise ValueError("one set of derivatives for all particles of a row needs rule=taylor()")
        if isinstance(self.drawn, slice):
            return
        drawn = tuple(self.drawn)
        wrong = [index for index in drawn if not isinstance(index, int) or isinstance(index, bool)]
        if wrong:
            raise TypeError(f"drawn must be a slice or whole numbers, got {wrong[0]!r}")
        if len(set(drawn)) < len(drawn) or min(drawn, default=0) < 0:
            raise ValueError(f"drawn must be different indices from 0 on, got {list(drawn)}")
        object.__setattr__(self, "drawn", tuple(sorted(drawn)))

    def is_exact(self, model: StateSpaceModel, size: int) -> bool:
        """Whether linearisation leaves nothing out of this model, whose errors have ``size`` components.

        Raises:
            ValueError: the state does not have the drawn components.
        """
        linear = set(_parts(self.drawn, size).linear)
        if not linear:
            return True
        if not isinstance(model.initial(), Gaussian) or (self.shared and not model.is_linear()):
            return False
        return all(linear <= _linear_in(law, size) for law in (model.transition, model.observation))

    def start(self, initial: Conditional, draws: Tensor, noise: Tensor) -> Particles:
        """Drawn components of n particles and the Gaussian that is left of the others.

        Of a torch Distribution the drawn components are its own draws; the others follow them by its moments.
        """
        prior = as_gaussian(initial)
        parts = _parts(self.drawn, prior.tangent_size)
        if not parts.linear:
            return Prior().start(initial, draws, noise)
        push, rest = _draw_first(prior.factor().unsqueeze(-3), parts.drawn)
        mean, normal = prior.mean.unsqueeze(-2).expand_as(draws), noise[..., : len(parts.drawn)]
        if not isinstance(initial, Gaussian):
            own = parts.take(push, -2, False).tril()
            own = own + torch.diag_embed((own.diagonal(dim1=-2, dim2=-1) == 0).to(own.dtype))
            error = parts.take(EUCLIDEAN.local(mean, draws), -1, False)
            normal = torch.linalg.solve_triangular(own, error.unsqueeze(-1), upper=False).squeeze(-1)
        x = prior.space.retract(mean, apply_factor(push, normal))
        factor = parts.embed(triangularize(parts.take(rest, -2)))
        factor = factor.expand(*draws.shape[:-2], 1, -1, -1)
        return Particles(x, uniform_log_weights(x.shape[:-1], x), factor, prior.space)

    def refresh(self, particles: Particles, noise: Tensor | None, resampled: Tensor | None) -> Particles:
        """Every step draws by itself."""
        return particles

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Proposed:
        """Shapes as in `torchfilt.proposals.Local`; of noise.proposal the first numbers are used.

        Raises:
            ValueError: a transition law that leaves the space, a quadrature with a negative weight.
        """
        if particles.scale_tril is None:
            return Prior()(model, particles, step)
        parts = _parts(self.drawn, particles.scale_tril.shape[-1])
        factor = parts.take(parts.take(particles.scale_tril, -1), -2)
        belief = Gaussian(particles.x, factor, _Section(particles.space, parts))
        rule, space = _PartRule(self.rule, parts, None), particles.space
        if self.shared:
            rule = rule._replace(centre=particles.mean.unsqueeze(-2))
        if step.move:
            assert step.noise.proposal is not None
            line, ahead = rule.with_centre(model.moments("transition"), belief, step.u, step.dt)
            belief, space = _move(line, belief, step.noise.proposal)
            rule = rule._replace(centre=ahead)
        sensor = model.moments("observation")
        result = update(sensor, belief, step.y, rule, step.missing, u=step.u, dt=step.dt)
        posterior = result.belief
        return Proposed(posterior.mean, parts.embed(posterior.scale_tril), result.log_likelihood, space)


def _move(line: Linearization, belief: Gaussian, noise: Tensor) -> tuple[Gaussian, Space]:
    """Predicted, drawn and conditioned particles."""
    section = belief.space
    assert isinstance(section, _Section)
    parts, space = section.parts, line.space
    check_transition_space(space, section.space)
    if line.mean.shape[-1] != belief.mean.shape[-1]:
        raise ValueError(f"the transition law turns {belief.mean.shape[-1]} state numbers into {line.mean.shape[-1]}")
    if line.negative is not None:
        raise ValueError("a quadrature with a negative weight can't be conditioned on; take taylor() or unscented()")
    push, rest = _draw_first(cat_columns(line.slope, line.spread()), parts.drawn)
    x = space.retract(space.project(line.mean), apply_factor(push, noise[..., : len(parts.drawn)]))
    return Gaussian(x, triangularize(parts.take(rest, -2)), _Section(space, parts)), space


def _draw_first(columns: Tensor, drawn: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Leading columns of a triangular factor with the drawn components first, and the columns that are left.

    Modified Gram-Schmidt over the drawn rows, which loses no more than Householder's QR does (Bjorck, 1967). A row that
    earlier ones determine gets no direction of its own: QR would give it one made of rounding, and drawing along it
    would scatter the other components for nothing.

    Args:
        columns: (..., e, k), whose product is a covariance.
        drawn: rows.

    Returns:
        push (..., e, len(drawn)): what one standard normal for each drawn row does to all of them; columns (..., e, k)
        of the covariance given the drawn rows.
    """
    sizes = columns.square().sum(-1)
    rounding = (32 * torch.finfo(columns.dtype).eps) ** 2
    pushes = [columns[..., :0]]
    for j in drawn:
        row = columns[..., j, :]
        square = row.square().sum(-1, keepdim=True)
        lost = square <= rounding * sizes[..., j : j + 1]
        unit = torch.where(lost, 0, row / torch.where(lost, 1, square).sqrt())
        push = columns @ unit.unsqueeze(-1)
        columns = columns - push * unit.unsqueeze(-2)
        pushes.append(push)
    return torch.cat(pushes, -1), columns


class _Parts(NamedTuple):
    """Drawn and other components of an error, and runs of neighbours (whether linear, length)."""

    drawn: tuple[int, ...]
    linear: tuple[int, ...]
    runs: tuple[tuple[bool, int], ...]

    def take(self, values: Tensor, dim: int, linear: bool = True) -> Tensor:
        """The linear components, or the drawn ones, along a dim: a view where they are neighbours."""
        pieces = values.split([length for _, length in self.runs], dim)
        kept = [piece for piece, (which, _) in zip(pieces, self.runs, strict=True) if which == linear]
        if not kept:
            return values.narrow(dim, 0, 0)
        return kept[0] if len(kept) == 1 else torch.cat(kept, dim)

    def spread(self, values: Tensor, dim: int) -> Tensor:
        """Linear components put back in their places along a dim, zero in those of the drawn ones."""
        pieces, start = [], 0
        for linear, length in self.runs:
            if linear:
                pieces.append(values.narrow(dim, start, length))
                start += length
            else:
                shape = list(values.shape)
                shape[dim] = length
                pieces.append(values.new_zeros(shape))
        return torch.cat(pieces, dim)

    def embed(self, factor: Tensor) -> Tensor:
        """Factor (..., e, e) of all components from that of the linear ones; still lower triangular."""
        return self.spread(self.spread(factor, -1), -2)


def _parts(drawn: slice | Sequence[int], size: int) -> _Parts:
    """Drawn and other components of ``size``."""
    chosen = tuple(sorted(range(size)[drawn])) if isinstance(drawn, slice) else tuple(drawn)
    if chosen and chosen[-1] >= size:
        raise ValueError(f"drawn must be error components of the state, 0 to {size - 1}, got {list(chosen)}")
    linear = [index not in chosen for index in range(size)]
    runs = tuple((which, len(list(run))) for which, run in groupby(linear))
    return _Parts(chosen, tuple(index for index in range(size) if linear[index]), runs)


def _linear_in(law: object, size: int) -> set[int]:
    """Components in which the law says it is linear, given the others."""
    if hasattr(law, "linear_form"):
        return set(range(size))
    declared = getattr(law, "linear_in", ())
    return set(range(size)[declared]) if isinstance(declared, slice) else set(declared)


class _Section(NamedTuple):
    """A space walked along the linear components only: points have all d numbers, tangent vectors those of the part."""

    space: Space
    parts: _Parts

    @property
    def size(self) -> int | None:
        """As the whole space's."""
        return self.space.size

    @property
    def tangent_size(self) -> int:
        """How many components are not drawn."""
        return len(self.parts.linear)

    def retract(self, x: Tensor, v: Tensor) -> Tensor:
        """Along the linear components; the drawn ones stay."""
        return self.space.retract(x, self.parts.spread(v, -1))

    def local(self, x: Tensor, y: Tensor) -> Tensor:
        """Linear components of the difference."""
        return self.parts.take(self.space.local(x, y), -1)

    def project(self, x: Tensor) -> Tensor:
        """As the whole space."""
        return self.space.project(x)

    def mean(self, points: Tensor, weights: Tensor) -> Tensor:
        """As the whole space."""
        return self.space.mean(points, weights)

    def carry(self, v: Tensor, columns: Tensor) -> Tensor:
        """As the whole space; where the linear components are flat nothing needs a particle axis."""
        return columns if self._is_flat() else self._of_whole(self.space.carry, v, columns)

    def carry_back(self, v: Tensor, columns: Tensor) -> Tensor:
        """As the whole space."""
        return columns if self._is_flat() else self._of_whole(self.space.carry_back, v, columns)

    def _is_flat(self) -> bool:
        curved = curved_components(self.space, len(self.parts.linear) + len(self.parts.drawn))
        return not set(curved) & set(self.parts.linear)

    def _of_whole(self, rule: Callable[[Tensor, Tensor], Tensor], v: Tensor, columns: Tensor) -> Tensor:
        return self.parts.take(rule(self.parts.spread(v, -1), self.parts.spread(columns, -2)), -2)

    def observed(self, y: Tensor) -> Tensor:
        """Linear components that are there."""
        return self.parts.take(self.space.observed(y), -1)


class _PartRule(NamedTuple):
    """A moment rule for the linear components; what a law gives without a particle axis stays without one.

    ``centre`` (*batch, 1, d): where derivatives and noise are taken for all particles of a row; None for at each.
    """

    rule: Rule
    parts: _Parts
    centre: Tensor | None

    def linearize(self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None) -> Linearization:
        """See `Linearization`; the slope is that of the linear components."""
        return self.with_centre(law, belief, u, dt)[0]

    def with_centre(
        self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None
    ) -> tuple[Linearization, Tensor | None]:
        """The same, and where the law takes the centre."""
        if self.centre is None:
            return self._at(law, belief, u, dt), None
        line = self._at(law, belief._replace(mean=self.centre), u, dt)
        return line._replace(mean=law(belief.mean, u, dt).mean), line.space.project(line.mean)

    def _at(self, law: Law, belief: Gaussian, u: Tensor | None, dt: Tensor | float | None) -> Linearization:
        form = getattr(law, "linear_form", None)
        first_order = getattr(law, "first_order", None) if isinstance(self.rule, Taylor) else None
        if form is not None:
            at = law(belief.mean, u, dt)
            matrix = for_points(form(u, dt).matrix, 2, belief.mean.dim() - 1)
        elif first_order is not None:
            at, matrix = first_order(belief.mean, u, dt)
        else:
            return self.rule.linearize(law, belief, u, dt)
        return Linearization(at.mean, self.parts.take(matrix, -1) @ belief.factor(), None, at.factor(), at.space)
