"""Sparse variational GP for large training sets: inducing points, minibatches, one batched model over the outputs."""

from typing import Literal

import gpytorch
import torch
from gpytorch.variational import CholeskyVariationalDistribution, VariationalStrategy
from torch import Tensor

from torchfilt.gp.frozen import FrozenGP
from torchfilt.gp.regression import GPRegression, _detached, se_parameters


class _VariationalModel(gpytorch.models.ApproximateGP):
    """Independent outputs over shared inducing locations, whitened."""

    def __init__(self, inducing: Tensor, outputs: int, kernel: gpytorch.kernels.Kernel, jitter: float) -> None:
        distribution = CholeskyVariationalDistribution(len(inducing), batch_shape=torch.Size([outputs]))
        strategy = VariationalStrategy(self, inducing, distribution, learn_inducing_locations=True, jitter_val=jitter)
        # GPyTorch would draw the start from the global generator at the first call; the prior is a start without noise.
        strategy.variational_params_initialized.fill_(1)
        super().__init__(strategy)
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = kernel

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class SparseGPRegression(GPRegression):
    """Stochastic variational GP (Hensman, Fusi and Lawrence, 2013) with ``inducing`` points.

    The structured kernel is refused: its frozen form already costs the same for any number of pairs.

    Args:
        state, targets, context, kernel, shared, noise_floor: as in `GPRegression`; kernel "ard" or "isotropic".
        inducing: number of inducing points, a random subset of the inputs at the start.
        seed: of that choice.
        jitter: added to the inducing covariance, relative to the standardised output's variance; float32 needs 1e-4.

    Raises:
        ValueError: the structured kernel, or more inducing points than samples.
    """

    def __init__(
        self,
        state: Tensor,
        targets: Tensor,
        context: Tensor | None = None,
        *,
        kernel: Literal["ard", "isotropic"] = "ard",
        shared: bool = False,
        noise_floor: float = 1e-4,
        inducing: int = 64,
        seed: int = 0,
        jitter: float = 1e-8,
    ) -> None:
        if kernel not in ("ard", "isotropic"):
            raise ValueError(f"the sparse form takes kernel 'ard' or 'isotropic', got {kernel!r}; use GPRegression")
        if not 0 < inducing <= len(state):
            raise ValueError(f"inducing must be between 1 and the {len(state)} samples, got {inducing}")
        super().__init__(state, targets, context, kernel=kernel, shared=shared, noise_floor=noise_floor)
        self.jitter, self.inducing = jitter, inducing
        rows = torch.randperm(len(state), generator=torch.Generator().manual_seed(seed))[:inducing].to(state.device)
        z, _ = self.standardized(rows)
        self.model = _VariationalModel(z, targets.shape[-1], self.kernel, jitter).to(state)

    def loss(self, rows: Tensor | None = None) -> Tensor:
        """Negative evidence lower bound per sample, summed over the outputs; an unbiased estimate on a subset."""
        z, y = self.standardized(rows)
        latent = self.model(z)
        fit = self.likelihood.expected_log_prob(y.mT, latent)
        divergence = self.model.variational_strategy.kl_divergence()
        return -fit.mean(-1).sum() + divergence.sum() / len(self.state)

    @torch.no_grad()
    def posterior(self, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """GPyTorch's eval-mode posterior: mean (n, p) and latent variance (n, p), output units."""
        self.eval()
        prediction = self.model(self.inputs(state, context))
        variance = prediction.lazy_covariance_matrix.to_dense().diagonal(dim1=-2, dim2=-1) - self.jitter
        self.train()
        return prediction.mean.mT * self.output_scale + self.output_mean, variance.mT * self.output_scale.square()

    @torch.no_grad()
    def freeze(self, settings: dict[str, object] | None = None) -> FrozenGP:
        """Posterior through the inducing points as plain tensors."""
        strategy = self.model.variational_strategy
        z = strategy.inducing_points
        identity = torch.eye(len(z), dtype=z.dtype, device=z.device)
        factor, info = torch.linalg.cholesky_ex(self.kernel(z).to_dense() + self.jitter * identity)
        if info.any():
            raise ValueError(
                f"inducing covariance is not positive definite in {z.dtype}; raise jitter ({self.jitter:g})"
            )
        values = strategy.variational_distribution
        alpha = torch.linalg.solve_triangular(factor.mT, values.mean.unsqueeze(-1), upper=True).squeeze(-1)
        tensors = {"inputs": z, "factor": factor, "alpha": alpha, "spread": values.scale_tril}
        tensors |= se_parameters(self.kernel, z.shape[-1])
        for name in ("input_mean", "input_scale", "output_mean", "output_scale"):
            tensors[name] = getattr(self, name)
        noise = self.likelihood.noise.flatten().expand(len(alpha)) * self.output_scale.square()
        kept = {"kernel": self.kernel_name, "samples": len(self.state), "inducing": len(z), **(settings or {})}
        return FrozenGP("dense", _detached(tensors), noise, self.state.shape[-1], kept)
