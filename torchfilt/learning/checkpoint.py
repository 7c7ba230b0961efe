"""Checkpoints that are whole, verified and never unpickled: Lightning's door to `torchfilt.storage`."""

import io
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pytorch_lightning.plugins import CheckpointIO

from torchfilt.storage import IntegrityError, read_verified, remove_verified, write_verified

FILE_KIND = "torchfilt checkpoint"


def save_checkpoint(checkpoint: dict[str, Any], path: str | Path) -> None:
    """Write a checkpoint atomically with its SHA-256 manifest.

    Values that a safe loader refuses (paths, numpy scalars and arrays) are turned into plain ones.

    Raises:
        TypeError: a value that cannot be stored as plain data; it is named.
        ValueError: the path is a URL.
    """
    stream = io.BytesIO()
    torch.save(_plain(checkpoint, "checkpoint"), stream)
    write_verified(_local(path), stream.getvalue(), FILE_KIND)


def load_checkpoint(path: str | Path, map_location: Any = None) -> dict[str, Any]:
    """Read a checkpoint: digest first, then the restricted loader, whatever the environment says.

    Raises:
        FileNotFoundError: no such file.
        IntegrityError: truncated, altered, without manifest, or holding anything but plain data.
        ValueError: the path is a URL.
    """
    data = read_verified(_local(path), FILE_KIND)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # advice on foreign pickles; the error below says enough
            # Explicit: TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD only rules where the argument is left out.
            loaded = torch.load(io.BytesIO(data), map_location=map_location or "cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        reason = str(error).split(". ")[0][:200]
        raise IntegrityError(
            f"{path}: refused, a checkpoint may hold tensors and plain values only ({reason})"
        ) from None
    if not isinstance(loaded, dict):
        raise IntegrityError(f"{path}: a checkpoint is a dictionary, this file holds a {type(loaded).__name__}")
    return loaded


class AtomicCheckpointIO(CheckpointIO):
    """Plugin for `pytorch_lightning.Trainer(plugins=[AtomicCheckpointIO()])`: every save whole, every load verified."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:
        """See `save_checkpoint`."""
        if storage_options is not None:
            raise TypeError("AtomicCheckpointIO writes local files and takes no storage_options")
        save_checkpoint(checkpoint, path)

    def load_checkpoint(
        self, path: str | Path, map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """See `load_checkpoint`; asking for weights_only=False is refused."""
        if weights_only is False:
            raise ValueError(f"{path}: weights_only=False would run code from the file and is refused")
        return load_checkpoint(path, None if callable(map_location) else map_location)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete file and manifest."""
        remove_verified(_local(path))


def _local(path: str | Path) -> Path:
    if "://" in str(path) or str(path).startswith(("http:", "https:")):
        raise ValueError(f"{path}: checkpoints are read from and written to local files only, not URLs")
    return Path(path)


def _plain(value: Any, where: str) -> Any:
    """The same value made of what the restricted loader accepts."""
    # Exact types: numpy's float64 is a float too, and the restricted loader refuses it.
    if value is None or type(value) in (bool, int, float, complex, str, bytes):
        return value
    if isinstance(value, (torch.Tensor, torch.dtype, torch.device)):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str):  # string enumerations
        return str.__str__(value)
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, dict):
        return {_plain(k, where): _plain(v, f"{where}[{k!r}]") for k, v in value.items()}
    if isinstance(value, (list, tuple, set)):
        kind = type(value) if type(value) in (list, tuple, set) else list
        return kind(_plain(v, f"{where}[{i}]") for i, v in enumerate(value))
    raise TypeError(f"{where} is a {type(value).__name__}, which a checkpoint cannot hold as plain data")
