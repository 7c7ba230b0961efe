"""A trained Gaussian process as plain tensors: fast, exact, and safe under vmap, forward mode and compile.

Each query is its own test point: rows never share noise and memory grows with the queries, not with their square.
Two forms, one interface:

* *structured* (affine in the state, periodic in a phase): a Bayesian linear regression on (harmonics of u) x (1, x),
  see `fourier`. Its posterior is held as weights and a factor of their covariance; no difference of large numbers is
  left, so variances 1e-12 of the prior keep their digits, float32 included, and the cost of a query does not depend on
  the number of training pairs.
* *dense* (squared exponential with one or D length-scales, exact or with inducing points): cached Cholesky factor and
  weights; variance by a triangular solve.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gp.fourier import harmonics
from torchfilt.storage import NOT_OURS, IntegrityError, read_arrays, write_arrays

Kind = Literal["structured", "dense"]
FILE_KIND = "torchfilt frozen Gaussian process"


class Collapsed(NamedTuple):
    """The structured posterior at given phases: queries cost O(1) in the number of training pairs.

    weights (*phase, p, 1 + d): mean of output i is ``weights[i] @ (1, z)``; form (*phase, p, 1 + d, 1 + d) or None:
    variance is ``(1, z) @ form[i] @ (1, z)``; z is the standardised state.
    """

    weights: Tensor
    form: Tensor | None
    input_mean: Tensor
    input_scale: Tensor

    def basis(self, x: Tensor) -> Tensor:
        """(1, z) of states x (..., d); returns (..., 1 + d)."""
        return pad((x - self.input_mean) / self.input_scale, (1, 0), value=1.0)

    def mean(self, x: Tensor) -> Tensor:
        """Posterior mean at x (..., d), which broadcasts against the phases' leading dims; returns (..., p)."""
        return _each(self.weights, self.basis(x))

    def variance(self, x: Tensor) -> Tensor:
        """Posterior variance at x (..., d); returns (..., p).

        The form is a Gram matrix, so negative values can only be rounding of zero; they are set to zero.

        Raises:
            ValueError: collapsed without variance.
        """
        if self.form is None:
            raise ValueError("collapsed with variance=False; call collapse(phase) for variances")
        h = self.basis(x)
        size = h.shape[-1]
        if self.form.dim() == 3 or (self.form.shape[-4] == 1 and h.dim() > 1):
            form = self.form if self.form.dim() == 3 else self.form.squeeze(-4)
            rows = (h @ form.transpose(-3, -2).flatten(-2)).unflatten(-1, (-1, size))
        else:
            rows = (self.form @ h.unsqueeze(-2).unsqueeze(-1)).squeeze(-1)
        return (rows * h.unsqueeze(-2)).sum(-1).clamp_min(0)


def _each(matrix: Tensor, vectors: Tensor) -> Tensor:
    """``matrix @ v`` with matrix (*lead, p, k), vectors (*lead, k); one product where a matrix serves many vectors."""
    if matrix.dim() == 2:
        return vectors @ matrix.mT
    if matrix.shape[-3] == 1 and vectors.dim() > 1:
        return vectors @ matrix.squeeze(-3).mT
    return (matrix * vectors.unsqueeze(-2)).sum(-1)


class _Structured(nn.Module):
    """Posterior over the weights of (harmonics of the phase) x (1, z)."""

    weights: Tensor  # (H, p, 1 + d), output units
    factor: Tensor  # (H, p, 1 + d, K), output units: covariance of the weights is factor factor^T over (H, 1 + d)
    prior: Tensor  # (p, 1 + d), prior standard deviations, output units
    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, tensors: dict[str, Tensor]) -> None:
        super().__init__()
        for name in ("weights", "factor", "prior", "input_mean", "input_scale"):
            self.register_buffer(name, tensors[name])
        self.count = (self.weights.shape[0] - 1) // 2
        self.state_size = self.input_mean.shape[0]
        self.context_size = 2

    def collapse(self, phase: Tensor, variance: bool) -> Collapsed:
        f = harmonics(phase, self.count)
        weights = (f @ self.weights.flatten(1)).unflatten(-1, self.weights.shape[1:])
        form = None
        if variance:
            columns = (f @ self.factor.flatten(1)).unflatten(-1, self.factor.shape[1:])
            form = columns @ columns.mT
        return Collapsed(weights, form, self.input_mean, self.input_scale)

    def mean(self, x: Tensor, phase: Tensor) -> Tensor:
        return self.collapse(phase, variance=False).mean(x)

    def forward(self, x: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        if phase.dim() == 1 or phase.shape[-2] == 1:
            collapsed = self.collapse(phase, variance=True)
            return collapsed.mean(x), collapsed.variance(x)
        # One phase a row: contracting with the state first keeps the intermediate at (rows, K) an output.
        f = harmonics(phase, self.count)
        h = self.collapse(phase, variance=False).basis(x)
        products = (f.unsqueeze(-1) * h.unsqueeze(-2)).flatten(-2)
        outputs = self.weights.shape[1]
        weights = self.weights.transpose(1, 2).reshape(-1, outputs)
        factor = self.factor.transpose(1, 2).flatten(0, 1).flatten(1)
        rows = (products @ factor).unflatten(-1, (outputs, -1))
        return products @ weights, rows.square().sum(-1)

    def prior_variance(self, x: Tensor) -> Tensor:
        z = pad((x - self.input_mean) / self.input_scale, (1, 0), value=1.0)
        return z.square() @ self.prior.square().mT


class _Dense(nn.Module):
    """Squared exponential with cached factor; ``spread`` is the extra covariance of inducing values, or absent."""

    inputs: Tensor  # (S, D), standardised
    lengthscale: Tensor  # (q, D), q = 1 (shared by the outputs) or p
    amplitude: Tensor  # (q,), prior variance in standardised units
    factor: Tensor  # (q, S, S)
    alpha: Tensor  # (p, S)
    output_mean: Tensor  # (p,)
    output_scale: Tensor  # (p,)
    input_mean: Tensor
    input_scale: Tensor
    spread: Tensor | None  # (p, S, S)

    def __init__(self, tensors: dict[str, Tensor], state_size: int) -> None:
        super().__init__()
        names = ("inputs", "lengthscale", "amplitude", "factor", "alpha")
        for name in (*names, "output_mean", "output_scale", "input_mean", "input_scale"):
            self.register_buffer(name, tensors[name])
        self.register_buffer("spread", tensors.get("spread"))
        self.state_size = state_size
        self.context_size = self.input_mean.shape[0] - state_size

    def _cross(self, features: Tensor) -> Tensor:
        """Prior covariance (q, S, M) between cached inputs and M queries."""
        z = (features - self.input_mean) / self.input_scale
        a = self.inputs / self.lengthscale.unsqueeze(-2)
        b = z / self.lengthscale.unsqueeze(-2)
        square = a.square().sum(-1).unsqueeze(-1) + b.square().sum(-1).unsqueeze(-2) - 2 * (a @ b.mT)
        # The expansion is exact to rounding; a squared distance of a few 1e-16 may come out below zero.
        return self.amplitude[:, None, None] * torch.exp(-0.5 * square.clamp_min(0))

    def _mean(self, cross: Tensor) -> Tensor:
        m = self.alpha @ cross[0] if cross.shape[0] == 1 else (self.alpha.unsqueeze(-2) @ cross).squeeze(-2)
        return m.mT * self.output_scale + self.output_mean

    def mean(self, x: Tensor, context: Tensor | None) -> Tensor:
        features = _join(x, context)
        flat = self._mean(self._cross(features.reshape(-1, features.shape[-1])))
        return flat.reshape(*features.shape[:-1], -1)

    def forward(self, x: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        features = _join(x, context)
        cross = self._cross(features.reshape(-1, features.shape[-1]))
        white = torch.linalg.solve_triangular(self.factor, cross, upper=False)
        prior = self.amplitude.unsqueeze(-1)
        variance = prior - white.square().sum(-2)
        if self.spread is not None:
            variance = variance + (self.spread.mT @ white).square().sum(-2)
        # The difference is known to a rounding of the prior and no better: report that much rather than less, or
        # nothing.
        variance = torch.maximum(variance, torch.finfo(variance.dtype).eps * prior)
        lead = features.shape[:-1]
        scaled = variance.mT * self.output_scale.square()
        return self._mean(cross).reshape(*lead, -1), scaled.reshape(*lead, -1)

    def prior_variance(self, x: Tensor) -> Tensor:
        value = self.amplitude * self.output_scale.square()
        return value.expand(*x.shape[:-1], -1)


def _join(x: Tensor, context: Tensor | None) -> Tensor:
    """State and context side by side, broadcast over leading dims."""
    if context is None:
        return x
    lead = torch.broadcast_shapes(x.shape[:-1], context.shape[:-1])
    return torch.cat([x.expand(*lead, -1), context.expand(*lead, -1)], -1)


class FrozenGP(nn.Module):
    """Posterior of a trained batched GP; buffers only, no GPyTorch.

    Built by ``GPRegression.freeze()`` or ``FrozenGP.load(path)``; the constructor takes what `save` wrote.

    Attributes:
        noise: (p,) learned noise variance, output units squared: what the kernel could not explain.
        settings: plain values that travel with the file (kernel, target, dt, sample count).

    Args:
        kind: "structured" or "dense".
        tensors: the buffers by name.
        noise: (p,).
        state_size: d, the first d features are the state and the rest the context.
        settings: JSON-ready values.
    """

    noise: Tensor

    def __init__(
        self,
        kind: Kind,
        tensors: dict[str, Tensor],
        noise: Tensor,
        state_size: int,
        settings: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if kind not in ("structured", "dense"):
            raise ValueError(f"kind must be 'structured' or 'dense', got {kind!r}")
        self.kind = kind
        self.posterior: _Structured | _Dense
        self.posterior = _Structured(tensors) if kind == "structured" else _Dense(tensors, state_size)
        self.register_buffer("noise", noise)
        self.state_size = state_size
        self.settings = dict(settings or {})

    @property
    def context_size(self) -> int:
        """Number of features after the state."""
        return self.posterior.context_size

    @property
    def output_size(self) -> int:
        """Number of outputs, p."""
        return self.noise.shape[0]

    def _split(self, features: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor | None]:
        if context is None and self.context_size:
            features, context = features[..., : self.state_size], features[..., self.state_size :]
        got = context.shape[-1] if context is not None else 0
        if features.shape[-1] != self.state_size or got != self.context_size:
            raise ValueError(
                f"this GP takes a state of {self.state_size} and a context of {self.context_size} numbers, "
                f"got {features.shape[-1]} and {got}"
            )
        return features, context

    def forward(self, features: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and latent variance, each query its own test point.

        Args:
            features: (..., D); or the state (..., d) with the context apart.
            context: (..., c) whose leading dims broadcast; few distinct phases (size-1 or absent dims) take the O(1)
                path.

        Returns:
            mean (..., p) and variance (..., p), in output units and units squared.
        """
        x, context = self._split(features, context)
        return self.posterior(x, context)

    def mean(self, features: Tensor, context: Tensor | None = None) -> Tensor:
        """Mean alone (..., p): no triangular solve."""
        x, context = self._split(features, context)
        return self.posterior.mean(x, context)  # type: ignore[arg-type]

    def variance(self, features: Tensor, context: Tensor | None = None) -> Tensor:
        """Latent variance alone (..., p)."""
        return self(features, context)[1]

    def prior_variance(self, features: Tensor) -> Tensor:
        """Variance before any data, (..., p), at states (..., d) or features (..., D)."""
        x = features[..., : self.state_size] if self.kind == "structured" else features
        return self.posterior.prior_variance(x)

    def collapse(self, phase: Tensor, variance: bool = True) -> Collapsed:
        """Posterior at phases (..., 2) as mean matrices and variance forms; queries then cost O(1).

        Raises:
            TypeError: the kernel is not the structured one.
        """
        if not isinstance(self.posterior, _Structured):
            raise TypeError("only a GP with the structured kernel collapses; this one is dense")
        return self.posterior.collapse(phase, variance)

    def distance(self, x: Tensor) -> Tensor:
        """Largest standardised distance of a state coordinate from the training mean, (...): about 1-2 inside the
        data.
        """
        d = self.state_size
        z = (x - self.posterior.input_mean[:d]) / self.posterior.input_scale[:d]
        return z.abs().amax(-1)

    def save(self, path: str | Path) -> None:
        """Write an NPZ (no pickle) and its SHA-256 manifest, atomically."""
        head = {"kind": self.kind, "state_size": self.state_size, "settings": self.settings}
        write_arrays(path, self.state_dict(), head, FILE_KIND)

    @classmethod
    def load(cls, path: str | Path) -> "FrozenGP":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: no such file.
            IntegrityError: truncated, altered or foreign; names the file and the rule.
        """
        arrays, head = read_arrays(path, FILE_KIND)
        try:
            tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
            noise = tensors.pop("noise")
            inner = {name.removeprefix("posterior."): tensor for name, tensor in tensors.items()}
            return cls(head["kind"], inner, noise, head["state_size"], head["settings"])
        except NOT_OURS as error:
            raise IntegrityError(f"{path}: not a frozen Gaussian process of this version ({error})") from None
