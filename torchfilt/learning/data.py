"""One-step pairs as a Lightning data module."""

from collections.abc import Iterator

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset


class _Rows(IterableDataset[Tensor]):
    """Index batches of one epoch; the order is a function of (seed, epoch) and of nothing else."""

    def __init__(self, count: int, batch_size: int | None, seed: int, epoch: int) -> None:
        if batch_size is None or batch_size >= count:
            self.batches: tuple[Tensor, ...] = (torch.arange(count),)
            return
        generator = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
        self.batches = torch.randperm(count, generator=generator).split(batch_size)

    def __iter__(self) -> Iterator[Tensor]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)


class TransitionData(pl.LightningDataModule):
    """Pairs (x, u) -> x_next with a held-out part.

    The loader yields row numbers: the data live on the regression module, and so in its checkpoints.

    Args:
        x: (S, d) states. u: (S, k) controls or None. x_next: (S, d) states one step later.
        batch_size: rows a minibatch, None for all at once (exact GPs).
        held_out: share of the rows kept for testing, 0 to below 1.
        seed: of the split and of the order of minibatches; global generators are not touched.

    Raises:
        ValueError: shapes that do not fit, values that are not finite; the first bad row is named.
    """

    def __init__(
        self,
        x: Tensor,
        u: Tensor | None,
        x_next: Tensor,
        *,
        batch_size: int | None = None,
        held_out: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if x.shape != x_next.shape or x.dim() != 2:
            raise ValueError(f"x and x_next must both be (S, d), got {tuple(x.shape)} and {tuple(x_next.shape)}")
        if u is not None and (u.dim() != 2 or len(u) != len(x)):
            raise ValueError(f"u must be (S, k) with S = {len(x)}, got {tuple(u.shape)}")
        for name, value in (("x", x), ("u", u), ("x_next", x_next)):
            if value is None:
                continue
            bad = (~torch.isfinite(value)).any(-1).nonzero()
            if len(bad):
                raise ValueError(f"{name} must be finite, row {int(bad[0])} is not")
        if not 0 <= held_out < 1:
            raise ValueError(f"held_out must be in [0, 1), got {held_out}")
        order = torch.arange(len(x))
        if held_out > 0:
            order = torch.randperm(len(x), generator=torch.Generator().manual_seed(seed))
        kept = len(x) - round(held_out * len(x))
        self.training_rows, self.held_out_rows = order[:kept].sort().values, order[kept:].sort().values
        self.x, self.u, self.x_next, self.batch_size, self.seed = x, u, x_next, batch_size, seed

    def _pick(self, rows: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        return self.x[rows], None if self.u is None else self.u[rows], self.x_next[rows]

    def training(self) -> tuple[Tensor, Tensor | None, Tensor]:
        """Training part (x, u, x_next)."""
        return self._pick(self.training_rows)

    def held_out(self) -> tuple[Tensor, Tensor | None, Tensor]:
        """Held-out part (x, u, x_next)."""
        return self._pick(self.held_out_rows)

    def train_dataloader(self) -> DataLoader[Tensor]:
        """Row numbers into the training part, anew for each epoch."""
        epoch = self.trainer.current_epoch if self.trainer is not None else 0
        rows = _Rows(len(self.training_rows), self.batch_size, self.seed, epoch)
        # A loader without its own generator draws from the global one at each epoch.
        return DataLoader(rows, batch_size=None, generator=torch.Generator().manual_seed(self.seed))
