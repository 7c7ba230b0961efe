"""From one-step pairs to a transition law in one call."""

import contextlib
import copy
import json
import logging
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, EarlyStopping, ModelCheckpoint, TQDMProgressBar
from pytorch_lightning.loggers import CSVLogger, Logger, TensorBoardLogger
from pytorch_lightning.utilities.exceptions import SIGTERMException
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian
from torchfilt.gp.frozen import FrozenGP
from torchfilt.gp.regression import GPRegression, KernelName
from torchfilt.gp.sparse import SparseGPRegression
from torchfilt.gp.transition import GPTransition, Target, one_step_targets
from torchfilt.learning.checkpoint import AtomicCheckpointIO, load_checkpoint
from torchfilt.learning.data import TransitionData
from torchfilt.learning.module import GPModule, OptimizerName
from torchfilt.storage import atomic_write

CHECKPOINT = "last.ckpt"
FROZEN = "gp.npz"


@dataclass(frozen=True)
class TrainingReport:
    """What a training did.

    Attributes:
        loss: final negative log marginal likelihood (or bound) per sample, summed over outputs, standardised units.
        epochs: Lightning epochs done in all, resumed ones included.
        seconds: wall time of the fit alone.
        samples: pairs the posterior is conditioned on. hyperparameter_samples: pairs the hyperparameters saw.
        noise: learned noise standard deviation of each output, its own units.
        inflation: factors on the standard deviations by calibration, or None.
        interrupted: True where ``stop`` ended the fit early.
        checkpoint: path of the last checkpoint, or None without a run folder.
    """

    loss: float
    epochs: int
    seconds: float
    samples: int
    hyperparameter_samples: int
    noise: list[float]
    inflation: list[float] | None
    interrupted: bool
    checkpoint: str | None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return asdict(self)


class _StopWhen(Callback):
    """Ends the fit after the epoch in which ``stop()`` turned true: a checkpoint in mid-epoch could not be resumed."""

    def __init__(self, stop: Callable[[], bool]) -> None:
        self.stop = stop
        self.stopped = False

    def on_train_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.stop():
            self.stopped = True
            trainer.should_stop = True


def train_transition(
    x: Tensor,
    u: Tensor | None,
    x_next: Tensor,
    nominal: nn.Module | Callable[..., Gaussian] | None = None,
    *,
    dt: float,
    context: Callable[[Tensor], Tensor] | None = None,
    target: Target | None = None,
    kernel: KernelName = "structured",
    shared: bool = False,
    standardize: bool = True,
    calibrate: bool = True,
    groups: Tensor | None = None,
    noise_floor: float = 1e-5,
    process_noise_scale_tril: Tensor | None = None,
    hyperparameter_samples: int | None = 250,
    inducing: int | None = None,
    batch_size: int | None = None,
    optimizer: OptimizerName | None = None,
    learning_rate: float = 0.02,
    epochs: int | None = None,
    tolerance: float = 1e-3,
    seed: int = 0,
    device: str = "cpu",
    run_dir: str | Path | None = None,
    resume: bool = False,
    progress: bool | None = None,
    tensorboard: bool = False,
    stop: Callable[[], bool] | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[GPTransition, TrainingReport]:
    """Learn one-step dynamics from pairs.

    Args:
        x: (S, d) states. u: (S, k) controls or None. x_next: (S, d) states dt later. The nominal law is called in
            their dtype; the regression itself runs in double precision, which noise floors of 1e-5 need.
        nominal: law(x, u, dt) -> Gaussian whose residual is learned, or None.
        dt: time step, s.
        context: function of u giving inputs beyond the state (..., c); the structured kernel needs (cos u, sin u).
        target, process_noise_scale_tril: see `GPTransition`. kernel, shared, standardize, noise_floor: see
            `GPRegression`.
        hyperparameter_samples: rows (a random subset) the marginal likelihood is maximised on; the posterior is
            conditioned on all. None for all.
        calibrate: inflate the variances of an exact GP until left-out errors are honest, see `GPRegression.calibrate`.
        groups: (S,) integers of samples left out together in that (the arcs they come from), None for one at a time.
        inducing: number of inducing points for the sparse form (kernel "ard" or "isotropic"), None for the exact GP.
        batch_size: minibatch of the sparse form.
        optimizer: "lbfgs" for the exact GP and "adam" for the sparse one by default; learning_rate is Adam's.
        epochs: at most; default 20 (L-BFGS, 10 iterations each) or 300 (Adam).
        tolerance: improvement of the loss an epoch below which two epochs in a row end the fit (Adam: twenty).
        seed: of subset, split and minibatch order; global generators are left alone.
        run_dir: folder for checkpoint, log and the frozen GP; None writes nothing.
        resume: go on from the checkpoint in run_dir, to the same bits as an uninterrupted run.
        progress: show a bar; default only on a terminal.
        tensorboard: log for TensorBoard beside the CSV file.
        stop: asked after each epoch; True ends the fit in good order, as SIGTERM does where this is given.
        dtype: of the returned law, None for that of x. A law of less precision than the data has the rounding of its
            steps, measured on the training pairs, added to its noise.

    Returns:
        The transition law, on the CPU, and the report.

    Raises:
        ValueError: data or options that do not fit; resuming with other data.
        FileNotFoundError, IntegrityError: nothing whole to resume from.
    """
    data = TransitionData(x, u, x_next, batch_size=batch_size, seed=seed)
    goal: Target = target or ("identity" if nominal is None else "residual")
    with torch.no_grad():
        targets = one_step_targets(x, u, x_next, dt, target=goal, nominal=nominal)
        features = _context(context, u)
        features = None if features is None else features.double()
    if inducing is not None:
        if kernel == "structured":
            raise ValueError(
                "the sparse form takes kernel 'ard' or 'isotropic'; the structured kernel needs no inducing points"
            )
        regression: GPRegression = SparseGPRegression(
            x.double(),
            targets.double(),
            features,
            kernel=kernel,
            shared=shared,
            noise_floor=noise_floor,
            inducing=inducing,
            seed=seed,
        )
        rows = None
    else:
        regression = GPRegression(
            x.double(),
            targets.double(),
            features,
            kernel=kernel,
            shared=shared,
            noise_floor=noise_floor,
            standardize=standardize,
        )
        rows = _subset(len(x), hyperparameter_samples, seed)
    chosen: OptimizerName = optimizer or ("lbfgs" if inducing is None else "adam")
    module = GPModule(regression, optimizer=chosen, learning_rate=learning_rate, rows=rows)
    limit = epochs if epochs is not None else (20 if chosen == "lbfgs" else 300)
    folder = None if run_dir is None else Path(run_dir)
    outcome = _fit(module, data, limit, chosen, tolerance, device, folder, resume, progress, tensorboard, stop)
    module.to("cpu")
    with torch.no_grad():
        loss = float(regression.loss(rows))
    inflation = regression.calibrate(groups).sqrt().tolist() if calibrate and inducing is None else None
    frozen = regression.freeze({"target": goal, "dt": dt}).to(x.dtype)

    def wrap(gp: FrozenGP) -> GPTransition:
        floor = None if process_noise_scale_tril is None else process_noise_scale_tril.to(gp.noise)
        return GPTransition(gp, nominal, context=context, target=goal, process_noise_scale_tril=floor, dt=dt)

    law = wrap(frozen)
    if dtype is not None and dtype != x.dtype:
        frozen = _cast(law, dtype, x, u, dt)
        law = wrap(frozen)
    report = TrainingReport(
        loss=loss,
        epochs=outcome.epochs,
        seconds=outcome.seconds,
        samples=len(x),
        hyperparameter_samples=len(x) if rows is None else len(rows),
        noise=frozen.noise.sqrt().tolist(),
        inflation=inflation,
        interrupted=outcome.interrupted,
        checkpoint=None if folder is None else str(folder / CHECKPOINT),
    )
    if folder is not None and not report.interrupted:
        frozen.save(folder / FROZEN)
        atomic_write(folder / "training.json", (json.dumps(report.to_dict(), indent=1) + "\n").encode())
    return law, report


@torch.no_grad()
def _cast(law: GPTransition, dtype: torch.dtype, x: Tensor, u: Tensor | None, dt: float) -> FrozenGP:
    """The GP in another precision, its noise raised by the variance of what rounding does to a step."""
    exact = law(x, u, dt).mean
    gp = copy.deepcopy(law.gp).to(dtype)
    rounded = GPTransition(gp, law.nominal, context=law.context, target=law.target, noise=law.noise, dt=law.dt)
    error = rounded(x.to(dtype), u, dt).mean.to(exact) - exact
    gp.noise += error.square().mean(0).to(dtype)
    return gp


@dataclass(frozen=True)
class _Outcome:
    epochs: int
    seconds: float
    interrupted: bool


def _fit(
    module: GPModule,
    data: TransitionData,
    epochs: int,
    optimizer: OptimizerName,
    tolerance: float,
    device: str,
    folder: Path | None,
    resume: bool,
    progress: bool | None,
    tensorboard: bool,
    stop: Callable[[], bool] | None,
) -> _Outcome:
    """Run Lightning; checkpoints after every epoch where there is a folder."""
    early = EarlyStopping(
        "loss", min_delta=tolerance, patience=2 if optimizer == "lbfgs" else 20, check_on_train_epoch_end=True
    )
    stopper = _StopWhen(stop or (lambda: False))
    show = sys.stderr.isatty() if progress is None else progress
    callbacks: list[Callback] = [stopper, early]
    if show:
        callbacks.append(TQDMProgressBar())
    if folder is not None:
        callbacks.append(
            ModelCheckpoint(folder, filename=Path(CHECKPOINT).stem, save_top_k=1, enable_version_counter=False)
        )
    path = None
    if resume:
        if folder is None:
            raise ValueError("resume needs run_dir, the folder of the checkpoint")
        path = folder / CHECKPOINT
        finished = _check_same_run(module, path)
        if finished:
            return finished
    with _quiet_lightning():
        trainer = pl.Trainer(
            accelerator="gpu" if device.startswith("cuda") else "cpu",
            devices=_device_index(device),
            max_epochs=epochs,
            callbacks=callbacks,
            plugins=[AtomicCheckpointIO()],
            logger=_loggers(folder, tensorboard),
            enable_checkpointing=folder is not None,
            enable_progress_bar=show,
            enable_model_summary=False,
            log_every_n_steps=1,
            reload_dataloaders_every_n_epochs=1,
            num_sanity_val_steps=0,
        )
        begin = time.perf_counter()
        try:
            trainer.fit(module, datamodule=data, ckpt_path=path, weights_only=True)
        except SIGTERMException:
            # Lightning's own answer to SIGTERM; the checkpoint of the last whole epoch is on disk.
            if stop is None:
                raise
            stopper.stopped = True
    return _Outcome(trainer.current_epoch, time.perf_counter() - begin, stopper.stopped)


@contextlib.contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Without Lightning's advice on workers, hardware and products; its log levels are put back afterwards."""
    names = ("pytorch_lightning", "pytorch_lightning.utilities.rank_zero", "lightning_fabric")
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="pytorch_lightning.*")
            for logger in loggers:
                logger.setLevel(logging.WARNING)
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _check_same_run(module: GPModule, path: Path) -> _Outcome | None:
    """Refuse to resume on other data; load and return the outcome where early stopping had already ended the run."""
    checkpoint = load_checkpoint(path)
    stored, own = checkpoint["state_dict"], module.state_dict()
    fixed = [n for n in own if not n.startswith(("regression.kernel", "regression.likelihood", "regression.model"))]
    different = [n for n in fixed if n not in stored or not torch.equal(stored[n], own[n])]
    if different or set(stored) != set(own):
        name = (different or sorted(set(stored) ^ set(own)))[0].removeprefix("regression.")
        raise ValueError(f"{path}: cannot resume, {name} differs from the run that wrote this checkpoint")
    early: dict[str, Any] = next((v for k, v in checkpoint["callbacks"].items() if k.startswith("EarlyStopping")), {})
    if not early.get("stopped_epoch"):
        return None
    module.load_state_dict(stored)
    return _Outcome(checkpoint["epoch"] + 1, 0.0, False)


def _loggers(folder: Path | None, tensorboard: bool) -> list[Logger] | bool:
    if folder is None:
        return False
    # Lightning's CSV writer empties a folder that it finds: a resumed run logs beside the first part.
    part = next(n for n in range(1, 10_000) if not (folder / f"log-{n}").exists())
    result: list[Logger] = [CSVLogger(folder, name="", version=f"log-{part}", flush_logs_every_n_steps=1)]
    if tensorboard:
        result.append(TensorBoardLogger(folder, name="", version=f"tensorboard-{part}"))
    return result


def _device_index(device: str) -> list[int] | int:
    """Lightning's way to say "cuda:1"."""
    return [int(device.split(":")[1])] if ":" in device else 1


def _subset(count: int, wanted: int | None, seed: int) -> Tensor | None:
    if wanted is None or wanted >= count:
        return None
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:wanted].sort().values


def _context(context: Callable[[Tensor], Tensor] | None, u: Tensor | None) -> Tensor | None:
    if context is None:
        return None
    if u is None:
        raise ValueError("context is a function of the controls, and no controls u were given")
    return context(u)
