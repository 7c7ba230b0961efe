"""Symmetries: states that no measurement can tell apart are filtered by one representative of their orbit.

A gauge is a map of states (..., d) to the representative of their orbit, such as "turned about the vertical until the
heading is zero". Motion and measurements must not notice the turn (`torchfilt.testing.check_symmetry`). A
`StateSpaceModel` with a gauge applies it to its prior and to each state that sets out on a motion, so that every filter
and every moment rule sees it: the unobservable direction takes no particles, and no uncertainty is claimed or denied
along it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.laws import call_style
from torchfilt.linalg import triangularize
from torchfilt.spaces import Space

Gauge = Callable[[Tensor], Tensor]


def into_gauge(gauge: Gauge, belief: Gaussian) -> Gaussian:
    """A Gaussian carried to the representatives: mean by the map, covariance by its derivative at the mean.

    The derivative counts how the turn itself hangs on the state, so directions along the orbit lose their variance:
    the factor is singular there.

    Args:
        gauge: map of states (..., d); may give ``first_order(x) -> (representative, jacobian (..., e, e))``.
        belief: mean (..., d).
    """
    mean, jacobian = gauge_first_order(gauge, belief.mean, belief.space)
    return Gaussian(mean, triangularize(jacobian @ belief.factor()), belief.space)


def gauge_first_order(gauge: Gauge, x: Tensor, space: Space) -> tuple[Tensor, Tensor]:
    """Representative of x (..., d) and its error by that of x, (..., e, e); by forward differentiation if need be."""
    own = getattr(gauge, "first_order", None)
    if own is not None:
        there, jacobian = own(x)
        return there, jacobian
    there = gauge(x)

    def response(error: Tensor) -> Tensor:
        return space.local(there.unsqueeze(-2), gauge(space.retract(x.unsqueeze(-2), error)))

    size = space.local(there, there).shape[-1]
    directions = torch.eye(size, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], size, size).contiguous()
    slope: Tensor = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1]
    return there, slope.mT


class GaugedTransition(nn.Module):
    """A transition law that sets out from representatives; what the law offers beside its call goes on working.

    Args:
        law: transition law.
        gauge: see `into_gauge`.
    """

    def __init__(self, law: Callable[..., Any], gauge: Gauge) -> None:
        super().__init__()
        self.law, self.gauge = law, gauge
        self.style = call_style(law)
        # A linear form is one no longer: the turn depends on the state.
        if hasattr(law, "noise_in"):
            self.noise_in = law.noise_in
        if hasattr(law, "first_order"):
            self.first_order = self._first_order
        if hasattr(law, "pooled"):
            self.pooled = self._pooled

    @property
    def takes_controls(self) -> bool:
        """As the law itself."""
        return bool(getattr(self.law, "takes_controls", self.style.takes_u))

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Any:
        """The law at the representative of x (..., d)."""
        return self.style.call(self.law, self.gauge(x), u, dt)

    def _first_order(
        self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None
    ) -> tuple[Gaussian, Tensor]:
        space = self.law.space if hasattr(self.law, "space") else self(x, u, dt).space
        there, turn = gauge_first_order(self.gauge, x, space)
        ahead, jacobian = self.law.first_order(there, u, dt)  # type: ignore[attr-defined]
        return ahead, jacobian @ turn

    def _pooled(self, x: Tensor, weights: Tensor, u: Tensor | None, dt: Tensor | float | None) -> Gaussian:
        result: Gaussian = self.law.pooled(self.gauge(x), weights, u, dt)  # type: ignore[attr-defined]
        return result


class GaugedInitial(nn.Module):
    """An initial law whose Gaussian is stated by representatives; draws of other laws are turned as they first move."""

    def __init__(self, law: nn.Module, gauge: Gauge) -> None:
        super().__init__()
        self.law, self.gauge = law, gauge

    def forward(self) -> Any:
        """The law."""
        law = self.law()
        return into_gauge(self.gauge, law) if isinstance(law, Gaussian) else law
