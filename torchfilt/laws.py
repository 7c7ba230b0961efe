"""Conditional laws: what a state-space model is made of.

A law is an `nn.Module`. A transition is called as ``law(x, u, dt)``, a measurement law as ``law(x)``; both return a
`Gaussian` (or any `torch.distributions.Distribution`) with the same leading dims as x. Controls and time steps arrive
broadcastable: u is (*lead, k) and dt is a number or (*lead, 1) where lead broadcasts with the leading dims of x.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.linalg import apply_factor, for_points, psd_factor
from torchfilt.spaces import EUCLIDEAN, Space


class LinearForm(NamedTuple):
    """``y = matrix @ x + offset + scale_tril @ noise``; shapes (..., m, d), (..., m) or None, (..., m, m)."""

    matrix: Tensor
    offset: Tensor | None
    scale_tril: Tensor


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
        for name, given in (("covariance", covariance), ("scale_tril", scale_tril)):
            if given is not None and not isinstance(given, Tensor):
                raise TypeError(f"{name} must be a matrix (e, e) as a tensor, got {type(given).__name__}")
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
        covariance: (m, m) or (*batch, m, m), positive semidefinite; or give ``scale_tril``, its lower factor.
        offset: (m,), (*batch, m) or None.
        control_matrix: (m, k), (*batch, m, k) or None.
        trainable: make matrix, factor and offset `nn.Parameter`s.

    Raises:
        TypeError: dtypes that differ.
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
        if control_matrix is not None and (control_matrix.dim() < 2 or control_matrix.shape[-2] != m):
            raise ValueError(f"control_matrix must be (*batch, {m}, k), got shape {tuple(control_matrix.shape)}")
        for name, tensor in (("offset", offset), ("control_matrix", control_matrix), ("covariance", self.noise())):
            if tensor is not None:
                check_finite(tensor, name)
                if tensor.dtype != matrix.dtype:
                    raise TypeError(f"{name} must have the matrix's dtype {matrix.dtype}, got {tensor.dtype}")
        hold(self, "matrix", matrix, trainable)
        for name, tensor in (("offset", offset), ("control_matrix", control_matrix)):
            if tensor is None:
                setattr(self, name, None)
            else:
                hold(self, name, tensor, trainable)

    @property
    def takes_controls(self) -> bool:
        """Whether u is looked at."""
        return self.control_matrix is not None

    def linear_form(self, u: Tensor | None = None, dt: Tensor | float | None = None) -> LinearForm:
        """The matrices; u (..., k) enters the offset."""
        offset = self.offset
        if self.control_matrix is not None:
            if u is None:
                raise ValueError("this law has a control_matrix but no control u was given")
            check_control(u, self.control_matrix)
            push = _pushed(self.control_matrix, u)
            offset = push if offset is None else for_points(offset, 1, push.dim() - 1) + push
        return LinearForm(self.matrix, offset, self.noise())

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
        """Law of y given x (..., d)."""
        matrix, offset, scale_tril = self.linear_form(u, dt)
        lead = x.dim() - 1
        matrix, scale_tril = for_points(matrix, 2, lead), for_points(scale_tril, 2, lead)
        mean = (matrix @ x.mT).mT if x.dim() > 1 and matrix.dim() == 2 else (matrix @ x.unsqueeze(-1)).squeeze(-1)
        return Gaussian(mean if offset is None else mean + for_points(offset, 1, lead), scale_tril)


class AdditiveGaussian(nn.Module):
    """``y ~ N(function(x, u, dt), covariance)`` with errors on ``space``.

    Args:
        function: batched over leading dims; takes x and, by name or in this order, u and dt; unused ones may be absent.
            An `nn.Module` is registered, so its parameters train.
        covariance: (e, e) or (*batch, e, e), positive semidefinite; or give ``scale_tril``.
        space: where y lives.
        trainable: make the noise factor an `nn.Parameter`.

    Raises:
        ValueError: a covariance that does not fit the space; when called, a function that gives another shape.
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
        self.size = noise_size if space.size is None else space.size

    @property
    def takes_controls(self) -> bool:
        """Whether the function looks at u."""
        return self.style.takes_u

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
        """Law of y given x (..., d)."""
        mean = self.style.call(self.function, x, u, dt)
        if mean.dim() < x.dim() or mean.shape[-1] != self.size:
            raise ValueError(
                f"function must turn x {tuple(x.shape)} into (*lead, {self.size}), as the covariance says, "
                f"got {tuple(mean.shape)}"
            )
        return Gaussian(mean, for_points(self.noise(), 2, x.dim() - 1), self.space)


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
    required = [p for p in parameters[1:] if p.default is p.empty and p.kind not in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]
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


def row_steps(dt: Tensor | float, like: Tensor) -> Tensor:
    """Time steps (*lead) of a number or (*lead, 1), in the dtype and on the device of ``like``."""
    if isinstance(dt, Tensor) and dt.dim() > 0:
        return dt.squeeze(-1).to(like)
    return torch.as_tensor(dt, dtype=like.dtype, device=like.device)


def one_number(value: Tensor | float, name: str, *, zero: bool = False, dtype: torch.dtype = torch.float64) -> Tensor:
    """A scalar tensor of one finite number above zero, or of one that may be zero; a tensor stays what it is.

    Returns:
        The scalar tensor; of a number one of ``dtype``.

    Raises:
        ValueError: another number, or several; under its name.
    """
    number = value if isinstance(value, Tensor) else torch.tensor(value, dtype=dtype)
    known = number.detach()
    if number.dim() != 0 or not bool(torch.isfinite(known) & (known >= 0 if zero else known > 0)):
        rule = "finite number >= 0" if zero else "positive finite number"
        raise ValueError(f"{name} must be one {rule}, got {value}")
    return number


def _pushed(matrix: Tensor, u: Tensor) -> Tensor:
    """``matrix @ u`` for controls (..., k); one matrix a row meets several points a row."""
    return u @ matrix.mT if matrix.dim() == 2 else apply_factor(for_points(matrix, 2, u.dim() - 1), u)


def check_control(u: Tensor, matrix: Tensor) -> None:
    """Refuse a control (..., k) that does not fit its input matrix (..., d, k).

    Raises:
        ValueError: another length; names it.
    """
    if u.shape[-1:] != matrix.shape[-1:]:
        raise ValueError(f"the control must be (*batch, {matrix.shape[-1]}), got shape {tuple(u.shape)}")


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise a ValueError that names the first entry that is not finite."""
    bad = ~torch.isfinite(tensor.detach())
    if bad.any():
        where = tuple(bad.nonzero()[0].tolist())
        raise ValueError(f"{name} must be finite, entry {where} is {tensor.detach()[where].item()}")
