"""Conditional laws: what a state-space model is made of.

A law is an `nn.Module`. A transition is called as ``law(x, u, dt)``, a measurement law as ``law(x)``; both return a
`Gaussian` (or any `torch.distributions.Distribution`) with the same leading dims as x. Controls and time steps arrive
broadcastable: u is (*lead, k) and dt is a number or (*lead, 1) where lead broadcasts with the leading dims of x.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import psd_factor
from torchfilt.spaces import EUCLIDEAN, Space


class LinearForm(NamedTuple):
    """``y = matrix @ x + offset + scale_tril @ noise``; shapes (..., m, d), (..., m) or None, (..., m, m)."""

    matrix: Tensor
    offset: Tensor | None
    scale_tril: Tensor


class HasLinearForm(Protocol):
    """A law that is linear in the state gives its matrices; exact filters and the shared-covariance path use them."""

    def linear_form(self, u: Tensor | None = None, dt: Tensor | float | None = None) -> LinearForm:
        """Matrices for this control and time step."""
        ...


class _Factor(nn.Module):
    """Holds the factor of a covariance that was given as a number, a vector of variances' matrix or a factor.

    A tensor that already requires grad keeps its graph and is factorised at each call, so that
    gradients reach the caller's own covariance.
    """

    scale_tril: Tensor
    covariance: Tensor

    def __init__(self, covariance: Tensor | None, scale_tril: Tensor | None, trainable: bool) -> None:
        super().__init__()
        if (covariance is None) == (scale_tril is None):
            raise ValueError("give exactly one of covariance= and scale_tril=")
        self._covariance: Tensor | None = None
        if covariance is not None and covariance.requires_grad:
            psd_factor(covariance)
            if isinstance(covariance, nn.Parameter):
                self.covariance = covariance
            else:
                self._covariance = covariance
            return
        factor = psd_factor(covariance) if covariance is not None else scale_tril
        assert factor is not None
        check_factor(factor, "scale_tril")
        hold(self, "scale_tril", factor, trainable)

    def forward(self) -> Tensor:
        if hasattr(self, "scale_tril"):
            return self.scale_tril.tril() if self.scale_tril.requires_grad else self.scale_tril
        covariance = self._covariance if self._covariance is not None else self.covariance
        return psd_factor(covariance)


def hold(module: nn.Module, name: str, tensor: Tensor, trainable: bool = False) -> None:
    """Keep a tensor on a module: a parameter stays one, a tensor with a graph keeps it, anything else is a buffer."""
    if isinstance(tensor, nn.Parameter):
        module.register_parameter(name, tensor)
    elif tensor.requires_grad:
        setattr(module, name, tensor)
    elif trainable:
        module.register_parameter(name, nn.Parameter(tensor.clone()))
    else:
        module.register_buffer(name, tensor.clone())


class LinearGaussian(nn.Module):
    """``y ~ N(matrix @ x + offset + control_matrix @ u, covariance)``.

    Args:
        matrix: (m, d) or (*batch, m, d).
        covariance: (m, m) positive semidefinite; or give ``scale_tril``, its lower factor.
        offset: (m,) or None.
        control_matrix: (m, k) or None.
        trainable: make matrix, factor and offset `nn.Parameter`s.

    Raises:
        ValueError: shapes that do not fit, a covariance that is not positive semidefinite.
    """

    matrix: Tensor
    offset: Tensor | None
    control_matrix: Tensor | None

    def __init__(
        self,
        matrix: Tensor,
        covariance: Tensor | None = None,
        offset: Tensor | None = None,
        *,
        control_matrix: Tensor | None = None,
        scale_tril: Tensor | None = None,
        trainable: bool = False,
    ) -> None:
        super().__init__()
        if matrix.dim() < 2:
            raise ValueError(f"matrix must be (*batch, m, d), got shape {tuple(matrix.shape)}")
        check_finite(matrix, "matrix")
        self.noise = _Factor(covariance, scale_tril, trainable)
        m = matrix.shape[-2]
        noise_size = self.noise().shape[-1]
        if noise_size != m:
            raise ValueError(f"covariance must be {m} x {m} to fit matrix {tuple(matrix.shape)}, got {noise_size}")
        if offset is not None and offset.shape[-1:] != (m,):
            raise ValueError(f"offset must end in {m} to fit matrix {tuple(matrix.shape)}, got {tuple(offset.shape)}")
        if control_matrix is not None and control_matrix.shape[-2] != m:
            raise ValueError(f"control_matrix must have {m} rows, got shape {tuple(control_matrix.shape)}")
        for name, tensor in (("offset", offset), ("control_matrix", control_matrix)):
            if tensor is not None:
                check_finite(tensor, name)
        hold(self, "matrix", matrix, trainable)
        for name, tensor in (("offset", offset), ("control_matrix", control_matrix)):
            if tensor is None:
                setattr(self, name, None)
            else:
                hold(self, name, tensor, trainable)

    def linear_form(self, u: Tensor | None = None, dt: Tensor | float | None = None) -> LinearForm:
        """The matrices; u (..., k) enters the offset."""
        offset = self.offset
        if self.control_matrix is not None:
            if u is None:
                raise ValueError("this law has a control_matrix but no control u was given")
            push = u @ self.control_matrix.mT
            offset = push if offset is None else offset + push
        return LinearForm(self.matrix, offset, self.noise())

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
        """Law of y given x (..., d)."""
        matrix, offset, scale_tril = self.linear_form(u, dt)
        if matrix.dim() > 2:  # a matrix a row of the batch serves all points of the row
            matrix = matrix.unflatten(-3, (-1, *[1] * max(x.dim() + 1 - matrix.dim(), 0)))
        mean = (matrix @ x.mT).mT if x.dim() > 1 and matrix.dim() == 2 else (matrix @ x.unsqueeze(-1)).squeeze(-1)
        return Gaussian(mean if offset is None else mean + offset, scale_tril)


class AdditiveGaussian(nn.Module):
    """``y ~ N(function(x, u, dt), covariance)`` with errors on ``space``.

    Args:
        function: batched over leading dims; takes x and, by name or in this order, u and dt; unused ones may be absent.
            An `nn.Module` is registered, so its parameters train.
        covariance: (e, e) positive semidefinite; or give ``scale_tril``.
        space: where y lives.
        trainable: make the noise factor an `nn.Parameter`.
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        covariance: Tensor | None = None,
        space: Space = EUCLIDEAN,
        *,
        scale_tril: Tensor | None = None,
        trainable: bool = False,
    ) -> None:
        super().__init__()
        self.function = function
        self.style = call_style(function)
        self.noise = _Factor(covariance, scale_tril, trainable)
        self.space = space
        noise_size = self.noise().shape[-1]
        if space.tangent_size is not None and space.tangent_size != noise_size:
            raise ValueError(
                f"covariance must be {space.tangent_size} x {space.tangent_size} on {space!r}, got {noise_size}"
            )

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
        """Law of y given x (..., d)."""
        return Gaussian(self.style.call(self.function, x, u, dt), self.noise(), self.space)


class CallStyle(NamedTuple):
    """Which of u and dt a function takes, and whether it takes them by name."""

    takes_u: bool
    takes_dt: bool
    by_name: bool

    def call(self, function: Callable[..., Any], x: Tensor, u: Tensor | None, dt: Tensor | float | None) -> Any:
        """``function(x, u, dt)`` without the arguments it does not take."""
        if self.by_name:
            named = {name: value for name, value, takes in (("u", u, self.takes_u), ("dt", dt, self.takes_dt)) if takes}
            return function(x, **named)
        if self.takes_dt:
            return function(x, u, dt)
        return function(x, u) if self.takes_u else function(x)


def call_style(function: Callable[..., Any]) -> CallStyle:
    """Read from the signature: u and dt by their names, else by position in this order; unused ones may be absent."""
    target = function.forward if isinstance(function, nn.Module) else function
    try:
        parameters = list(inspect.signature(target).parameters.values())
    except (TypeError, ValueError):  # a builtin such as torch.sin: takes the state alone
        return CallStyle(False, False, False)
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return CallStyle(True, True, False)
    named = {p.name for p in parameters[1:] if p.kind is not p.POSITIONAL_ONLY}
    if named & {"u", "dt"}:
        return CallStyle("u" in named, "dt" in named, True)
    required = [p for p in parameters[1:] if p.default is p.empty and p.kind is not p.KEYWORD_ONLY]
    return CallStyle(len(required) > 0, len(required) > 1, False)


def takes_in_order(law: Callable[..., Any]) -> bool:
    """Whether a law can be called as ``law(x, u, dt)``."""
    target = law.forward if isinstance(law, nn.Module) else law
    return list(inspect.signature(target).parameters)[1:] == ["u", "dt"]


def check_factor(factor: Tensor, name: str) -> None:
    """Raise a ValueError unless this is a finite lower-triangular matrix (*batch, e, e)."""
    if factor.dim() < 2 or factor.shape[-1] != factor.shape[-2]:
        raise ValueError(f"{name} must be a square matrix (*batch, e, e), got shape {tuple(factor.shape)}")
    check_finite(factor, name)
    upper = factor.detach().triu(1)
    if upper.any():
        where = tuple(upper.nonzero()[0].tolist())
        raise ValueError(f"{name} must be lower triangular, entry {where} is {upper[where].item()}")


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise a ValueError that names the first entry that is not finite."""
    bad = ~torch.isfinite(tensor.detach())
    if bad.any():
        where = tuple(bad.nonzero()[0].tolist())
        raise ValueError(f"{name} must be finite, entry {where} is {tensor.detach()[where].item()}")
