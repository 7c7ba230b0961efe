"""Exact GP regression of a one-step map: one batched GPyTorch model over the outputs.

Inputs are (state, context); inputs and outputs are standardised by constants held as buffers. Hyperparameters belong
to each output, or to all of them with ``shared=True``.
"""

from typing import Literal

import gpytorch
import torch
from gpytorch.constraints import GreaterThan, Positive
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import LOG_2PI
from torchfilt.gp.fourier import WeightPosterior, weight_posterior
from torchfilt.gp.frozen import FrozenGP

KernelName = Literal["structured", "ard", "isotropic"]
# A phase length-scale below this chord (about 11 degrees) would need more harmonics than training sets can feed.
_SHORTEST_PHASE = 0.2


def _log_positive(lower: float = 0.0) -> Positive | GreaterThan:
    """Positive values optimised in their logarithm: softplus is flat at 1e-10, where noise variances live."""
    if lower == 0.0:
        return Positive(transform=torch.exp, inv_transform=torch.log)
    return GreaterThan(lower, transform=torch.exp, inv_transform=torch.log)


class StructuredKernel(Kernel):
    """(affine in the state) x (squared exponential in the phase features).

    k = (s_0^2 + sum_j s_j^2 x_j x'_j) exp(-|f - f'|^2 / 2 l^2), x the first d input columns, f = (cos u, sin u) the
    last two:
    functions linear in the state with coefficients that vary smoothly around the orbit.

    Args:
        state_size: d.
        batch_shape: one set of hyperparameters for each output.
    """

    has_lengthscale = True

    def __init__(self, state_size: int, batch_shape: torch.Size | None = None) -> None:
        batch_shape = torch.Size([]) if batch_shape is None else batch_shape
        super().__init__(batch_shape=batch_shape, lengthscale_constraint=_log_positive(_SHORTEST_PHASE))
        self.state_size = state_size
        start = torch.full((*batch_shape, 1, 1 + state_size), -0.5)
        self.register_parameter("raw_deviation", nn.Parameter(start))
        self.register_constraint("raw_deviation", _log_positive())
        self.lengthscale = 1.0

    @property
    def phase_lengthscale(self) -> Tensor:
        """Length-scale of the phase features, (*batch,), flattened."""
        return self.raw_lengthscale_constraint.transform(self.raw_lengthscale).flatten()

    @property
    def deviation(self) -> Tensor:
        """Prior standard deviations (s_0, s_1, ..., s_d), (*batch, 1, 1 + d)."""
        return self.raw_deviation_constraint.transform(self.raw_deviation)

    @deviation.setter
    def deviation(self, value: Tensor) -> None:
        self.initialize(raw_deviation=self.raw_deviation_constraint.inverse_transform(value))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Covariance (*batch, n1, n2), or its diagonal."""
        d = self.state_size
        a = pad(x1[..., :d], (1, 0), value=1.0) * self.deviation
        b = pad(x2[..., :d], (1, 0), value=1.0) * self.deviation
        f, g = x1[..., d:] / self.lengthscale, x2[..., d:] / self.lengthscale
        if diag:
            return (a * b).sum(-1) * torch.exp(-0.5 * (f - g).square().sum(-1))
        square = f.square().sum(-1).unsqueeze(-1) + g.square().sum(-1).unsqueeze(-2) - 2 * (f @ g.mT)
        return (a @ b.mT) * torch.exp(-0.5 * square.clamp_min(0))


def make_kernel(name: KernelName, state_size: int, context_size: int, batch: int) -> Kernel:
    """Kernel by name with one set of hyperparameters for each of ``batch`` outputs."""
    shape = torch.Size([batch])
    if name == "structured":
        if context_size != 2:
            raise ValueError(f"the structured kernel needs a context of 2 numbers (cos u, sin u), got {context_size}")
        return StructuredKernel(state_size, shape)
    if name not in ("ard", "isotropic"):
        raise ValueError(f"kernel must be 'structured', 'ard' or 'isotropic', got {name!r}")
    dims = state_size + context_size if name == "ard" else None
    base = RBFKernel(ard_num_dims=dims, batch_shape=shape, lengthscale_constraint=_log_positive())
    kernel = ScaleKernel(base, batch_shape=shape, outputscale_constraint=_log_positive())
    base.lengthscale = (state_size + context_size) ** 0.5
    kernel.outputscale = 1.0
    return kernel


class _ExactModel(gpytorch.models.ExactGP):
    """GPyTorch's own view of the regression, used as the reference posterior."""

    def __init__(self, inputs: Tensor, targets: Tensor, likelihood: GaussianLikelihood, kernel: Kernel) -> None:
        super().__init__(inputs, targets, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = kernel

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class GPRegression(nn.Module):
    """Exact GP over p outputs with one batched kernel.

    Args:
        state: (S, d) training states.
        targets: (S, p) what to learn, see `torchfilt.gp.one_step_targets`.
        context: (S, c) further inputs such as (cos u, sin u), or None.
        kernel: "structured" (context must be a phase), "ard" or "isotropic" squared exponential.
        shared: one set of hyperparameters for all outputs.
        noise_floor: lower bound of the noise standard deviation, relative to the output's standard deviation.
        standardize: scale inputs and outputs to zero mean and unit deviation. False keeps raw units, as in the
            literature.

    Raises:
        ValueError: shapes that do not fit, values that are not finite.
    """

    state: Tensor
    targets: Tensor
    context: Tensor | None
    input_mean: Tensor
    input_scale: Tensor
    output_mean: Tensor
    output_scale: Tensor

    def __init__(
        self,
        state: Tensor,
        targets: Tensor,
        context: Tensor | None = None,
        *,
        kernel: KernelName = "structured",
        shared: bool = False,
        noise_floor: float = 1e-5,
        standardize: bool = True,
    ) -> None:
        super().__init__()
        _check(state, targets, context)
        self.kernel_name, self.shared, self.noise_floor, self.standardize = kernel, shared, noise_floor, standardize
        for name, value in (("state", state), ("targets", targets), ("context", context)):
            self.register_buffer(name, None if value is None else value.detach().clone())
        self._set_scales()
        batch = 1 if shared else targets.shape[-1]
        context_size = 0 if context is None else context.shape[-1]
        self.kernel = make_kernel(kernel, state.shape[-1], context_size, batch)
        self.likelihood = GaussianLikelihood(
            noise_constraint=_log_positive(noise_floor**2), batch_shape=torch.Size([batch])
        )
        self.likelihood.noise = max(1e-4, 10 * noise_floor**2)
        self.to(state)

    def _set_scales(self) -> None:
        """Standardising constants; a constant column is centred and keeps its units; a phase is left as it is."""
        own = self.state if self.kernel_name == "structured" else self.features(self.state, self.context)
        for name, values in (("input", own), ("output", self.targets)):
            mean, scale = values.mean(0), values.std(0)
            scale = torch.where(scale > 0, scale, torch.ones_like(scale))
            if not self.standardize:
                mean, scale = torch.zeros_like(mean), torch.ones_like(scale)
            self.register_buffer(f"{name}_mean", mean)
            self.register_buffer(f"{name}_scale", scale)

    @staticmethod
    def features(state: Tensor, context: Tensor | None) -> Tensor:
        """State and context side by side, (..., d + c)."""
        return state if context is None else torch.cat([state, context], -1)

    def inputs(self, state: Tensor, context: Tensor | None) -> Tensor:
        """Standardised features (..., d + c)."""
        if self.kernel_name == "structured":
            return self.features((state - self.input_mean) / self.input_scale, context)
        return (self.features(state, context) - self.input_mean) / self.input_scale

    def standardized(self, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Training inputs (n, D) and outputs (n, p) in standardised units; ``rows`` picks a subset."""
        z = self.inputs(self.state, self.context)
        y = (self.targets - self.output_mean) / self.output_scale
        return (z, y) if rows is None else (z[rows], y[rows])

    def _factor(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Cholesky factor (q, n, n) of kernel + noise and its status (q,)."""
        covariance = self.kernel(z).to_dense()
        covariance = covariance + self.likelihood.noise.unsqueeze(-1) * torch.eye(
            len(z), dtype=z.dtype, device=z.device
        )
        factor, info = torch.linalg.cholesky_ex(covariance)
        return factor, info

    def loss(self, rows: Tensor | None = None) -> Tensor:
        """Negative log marginal likelihood per sample, summed over the outputs; standardised units.

        One batched Cholesky; no jitter is added. NaN where the covariance is not positive definite in this precision.
        """
        z, y = self.standardized(rows)
        factor, info = self._factor(z)
        white = torch.linalg.solve_triangular(factor, self._columns(y), upper=False)
        outputs = y.shape[-1]
        repeat = outputs if self.shared else 1
        half_log = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        total = 0.5 * white.square().sum() + repeat * half_log.sum() + 0.5 * y.numel() * LOG_2PI
        return torch.where((info == 0).all(), total / len(z), torch.full_like(total, torch.nan))

    def _columns(self, y: Tensor) -> Tensor:
        """Outputs as right-hand sides: (1, n, p) under a shared kernel, (p, n, 1) otherwise."""
        return y.unsqueeze(0) if self.shared else y.mT.unsqueeze(-1)

    def exact_model(self) -> _ExactModel:
        """The GPyTorch model on all training data (standardised units, batch of outputs), sharing these parameters."""
        z, y = self.standardized()
        outputs = y.shape[-1]
        batch = z.expand(outputs, *z.shape)
        return _ExactModel(batch, y.mT.contiguous(), self.likelihood, self.kernel)

    @torch.no_grad()
    def posterior(self, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """GPyTorch's eval-mode posterior at (n, d) states: mean (n, p) and latent variance (n, p), output units.

        The reference for `freeze`; slow, and not for filters.
        """
        model = self.exact_model().eval()
        z = self.inputs(state, context)
        # Without these, GPyTorch solves by conjugate gradients beyond 800 points and lifts variances below 1e-10.
        with gpytorch.settings.fast_computations(False, False, False):
            prediction = model(z.expand(self.targets.shape[-1], *z.shape))
            mean = prediction.mean
            variance = prediction.lazy_covariance_matrix.to_dense().diagonal(dim1=-2, dim2=-1)
        self.train()
        return mean.mT * self.output_scale + self.output_mean, variance.mT * self.output_scale.square()

    @torch.no_grad()
    def left_out(self, groups: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Errors (S, p) and predictive variances (S, p) of training outputs given the others, standardised units.

        Args:
            groups: (S,) integers; samples of one group are left out together, as neighbours along a trajectory must be:
                given each other they are all but known. None leaves out one at a time.

        Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2, for blocks.
        """
        z, y = self.standardized()
        noise = self.likelihood.noise.flatten()
        if isinstance(self.kernel, StructuredKernel):
            weights = self._weights()
            # (K + noise)^-1 = (1 - B B^T) / noise, and applied to y the residual / noise: no kernel matrix is formed.
            basis, white, scale = weights.basis, weights.residual, noise.expand(y.shape[-1])

            def precision(rows: Tensor) -> Tensor:
                part = basis[:, rows]
                return torch.eye(len(rows), dtype=z.dtype, device=z.device) - part @ part.mT
        else:
            factor = self._checked_factor(z)
            inverse = torch.cholesky_inverse(factor)
            white, scale = self._solve(y, factor), torch.ones_like(noise)

            def precision(rows: Tensor) -> Tensor:
                return inverse[:, rows][..., rows]

        names = torch.arange(len(y), device=z.device) if groups is None else groups
        error, variance = torch.empty_like(y), torch.empty_like(y)
        for name in names.unique():
            rows = (names == name).nonzero().squeeze(-1)
            covariance = torch.linalg.inv(precision(rows))
            error[rows] = (covariance @ white[:, rows].unsqueeze(-1)).squeeze(-1).mT
            variance[rows] = (scale[:, None] * covariance.diagonal(dim1=-2, dim2=-1)).mT
        return error, variance

    @torch.no_grad()
    def calibrate(self, groups: Tensor | None = None) -> Tensor:
        """Inflate kernel and noise until left-out errors are no larger than predicted; returns the factors (q,) >= 1.

        A marginal likelihood maximised on a misfit that is not Gaussian, or on a subset, claims too much by 10 to 50 %.
        The posterior mean does not change. Variances are never made smaller.

        Args:
            groups: (S,) integers of samples that are left out together, see `left_out`.
        """
        error, variance = self.left_out(groups)
        ratio = (error.square() / variance).mean(0)
        factors = (ratio.mean().unsqueeze(0) if self.shared else ratio).clamp_min(1.0)
        self.likelihood.noise = self.likelihood.noise * factors.unsqueeze(-1)
        if isinstance(self.kernel, StructuredKernel):
            self.kernel.deviation = self.kernel.deviation * factors.sqrt()[:, None, None]
        else:
            self.kernel.outputscale = self.kernel.outputscale * factors
        return factors

    def _weights(self) -> WeightPosterior:
        """Weight-space posterior of the structured kernel on all training data.

        In double precision whatever the dtype: done once, and it decides the variances' digits.
        """
        assert isinstance(self.kernel, StructuredKernel)
        z, y = self.standardized()
        outputs, d = y.shape[-1], self.state.shape[-1]
        prior = self.kernel.deviation.squeeze(-2).expand(outputs, -1)
        lengthscale = self.kernel.phase_lengthscale.expand(outputs)
        noise = self.likelihood.noise.flatten().expand(outputs)
        return weight_posterior(*(t.double() for t in (z[:, :d], z[:, d:], y, prior, lengthscale, noise)))

    def _solve(self, y: Tensor, factor: Tensor) -> Tensor:
        """(kernel + noise)^-1 y for outputs y (S, p); returns (p, S)."""
        solution = torch.cholesky_solve(self._columns(y), factor)
        return solution[0].mT if self.shared else solution.squeeze(-1)

    def _checked_factor(self, z: Tensor) -> Tensor:
        factor, info = self._factor(z)
        if info.any():
            raise ValueError(
                f"kernel + noise is not positive definite in {z.dtype} for output {int(info.nonzero()[0])}; "
                f"raise noise_floor (now {self.noise_floor:g}) or use float64"
            )
        return factor

    @torch.no_grad()
    def condition(self, state: Tensor, targets: Tensor, context: Tensor | None = None) -> None:
        """Replace the training set; hyperparameters and standardising constants stay."""
        _check(state, targets, context)
        self.state, self.targets, self.context = (
            state.clone(),
            targets.clone(),
            None if context is None else context.clone(),
        )

    @torch.no_grad()
    def freeze(self, settings: dict[str, object] | None = None) -> FrozenGP:
        """Posterior on all training data as plain tensors.

        Args:
            settings: JSON-ready values to keep with it, such as ``target`` and ``dt``.

        Raises:
            ValueError: the covariance is not positive definite in this precision.
        """
        z, y = self.standardized()
        outputs, d = y.shape[-1], self.state.shape[-1]
        kept = {"kernel": self.kernel_name, "samples": len(z), **(settings or {})}
        noise = self.likelihood.noise.flatten().expand(outputs)
        common = {"input_mean": self.input_mean, "input_scale": self.input_scale}
        if isinstance(self.kernel, StructuredKernel):
            posterior = self._weights()
            prior = self.kernel.deviation.squeeze(-2).expand(outputs, -1)
            scale = self.output_scale.double()[:, None]
            weights, factor = posterior.weights * scale, posterior.factor * scale.unsqueeze(-1)
            weights[0, :, 0] += self.output_mean  # the zeroth harmonic of the constant
            tensors = {
                "weights": weights.to(z),
                "factor": factor.to(z),
                "prior": prior * self.output_scale[:, None],
                **common,
            }
            return FrozenGP("structured", _detached(tensors), noise * self.output_scale.square(), d, kept)
        factor = self._checked_factor(z)
        alpha = self._solve(y, factor)
        tensors = {"inputs": z, "factor": factor, "alpha": alpha, **se_parameters(self.kernel, z.shape[-1]), **common}
        tensors |= {"output_mean": self.output_mean, "output_scale": self.output_scale}
        return FrozenGP("dense", _detached(tensors), noise * self.output_scale.square(), d, kept)


def se_parameters(kernel: Kernel, dims: int) -> dict[str, Tensor]:
    """Length-scales (q, D) and amplitudes (q,) of a scaled squared exponential."""
    return {"lengthscale": kernel.base_kernel.lengthscale.squeeze(-2).expand(-1, dims), "amplitude": kernel.outputscale}


def _detached(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Own copies without history, so that later training does not move a frozen posterior."""
    return {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}


def _check(state: Tensor, targets: Tensor, context: Tensor | None) -> None:
    """Shapes and finite values of a training set."""
    for name, value in (("state", state), ("targets", targets), ("context", context)):
        if value is None:
            continue
        if value.dim() != 2 or len(value) != len(state):
            raise ValueError(f"{name} must be (S, .) with S = {len(state)} rows, got shape {tuple(value.shape)}")
        bad = (~torch.isfinite(value)).any(-1).nonzero()
        if len(bad):
            raise ValueError(f"{name} must be finite, row {int(bad[0])} is {value[int(bad[0])].tolist()}")
    if len(state) < 2:
        raise ValueError(f"at least 2 samples are needed, got {len(state)}")
