"""Lightning module that fits the hyperparameters of a GP regression."""

from pathlib import Path
from typing import Any, Literal

import pytorch_lightning as pl
import torch
from torch import Tensor

from torchfilt.gp.regression import GPRegression
from torchfilt.gp.sparse import SparseGPRegression
from torchfilt.learning.checkpoint import load_checkpoint

OptimizerName = Literal["lbfgs", "adam"]
# Above every loss of standardised data: tells a line search to step back where the covariance is not positive definite.
_WALL = 1e3


class GPModule(pl.LightningModule):
    """Maximises the marginal likelihood (exact GP) or its lower bound (sparse GP).

    Args:
        regression: the GP and its data.
        optimizer: "lbfgs" (all rows at once, strong-Wolfe line search, joint over the outputs) or "adam".
        learning_rate: of Adam; L-BFGS starts its line searches at 1.
        inner_iterations: L-BFGS iterations in one Lightning step.
        rows: (n,) rows that hyperparameters are fitted on (exact GP), None for all.
    """

    rows: Tensor | None

    def __init__(
        self,
        regression: GPRegression,
        *,
        optimizer: OptimizerName = "lbfgs",
        learning_rate: float = 0.02,
        inner_iterations: int = 10,
        rows: Tensor | None = None,
    ) -> None:
        super().__init__()
        if optimizer not in ("lbfgs", "adam"):
            raise ValueError(f"optimizer must be 'lbfgs' or 'adam', got {optimizer!r}")
        if optimizer == "lbfgs" and isinstance(regression, SparseGPRegression):
            raise ValueError("the sparse GP is trained on minibatches, which need optimizer='adam'")
        self.regression = regression
        self.optimizer_name, self.learning_rate, self.inner_iterations = optimizer, learning_rate, inner_iterations
        self.register_buffer("rows", rows)

    def training_step(self, batch: Tensor, batch_index: int) -> Tensor:
        """Loss on the rows of the batch; exact GPs always use their own subset."""
        sparse = isinstance(self.regression, SparseGPRegression)
        loss = self.regression.loss(batch if sparse else self.rows)
        if not torch.isfinite(loss):
            loss = _WALL + 0.0 * sum(p.sum() for p in self.regression.parameters() if p.requires_grad)  # type: ignore[assignment]
        self.log("loss", loss.detach(), on_step=False, on_epoch=True, batch_size=1, prog_bar=True)
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """L-BFGS or Adam over the hyperparameters."""
        parameters = [p for p in self.regression.parameters() if p.requires_grad]
        if self.optimizer_name == "adam":
            return torch.optim.Adam(parameters, lr=self.learning_rate)
        return torch.optim.LBFGS(
            parameters,
            max_iter=self.inner_iterations,
            history_size=20,
            tolerance_grad=1e-6,
            tolerance_change=1e-9,
            line_search_fn="strong_wolfe",
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what `restore` needs to rebuild the module."""
        regression = self.regression
        recipe: dict[str, Any] = {
            "kernel": regression.kernel_name,
            "shared": regression.shared,
            "noise_floor": regression.noise_floor,
        }
        if isinstance(regression, SparseGPRegression):
            recipe |= {"inducing": regression.inducing, "jitter": regression.jitter}
        else:
            recipe["standardize"] = regression.standardize
        training = {
            "optimizer": self.optimizer_name,
            "learning_rate": self.learning_rate,
            "inner_iterations": self.inner_iterations,
        }
        checkpoint["torchfilt"] = {"regression": recipe, "training": training}

    @classmethod
    def restore(cls, path: str | Path) -> "GPModule":
        """Module with data and hyperparameters from a verified checkpoint.

        Raises:
            IntegrityError: the file is not whole or not ours.
        """
        checkpoint = load_checkpoint(path)
        tensors, recipe = checkpoint["state_dict"], checkpoint["torchfilt"]
        kind = SparseGPRegression if "inducing" in recipe["regression"] else GPRegression
        data = [tensors.get(f"regression.{name}") for name in ("state", "targets", "context")]
        module = cls(kind(*data, **recipe["regression"]), rows=tensors.get("rows"), **recipe["training"])
        module.load_state_dict(tensors)
        return module
