"""Results of long computations kept in a run folder, so that an interrupted run goes on where it stood."""

import hashlib
import json
import platform
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchfilt.storage import IntegrityError, atomic_write, manifest_path, read_arrays, write_arrays

Arrays = dict[str, np.ndarray]
FILE_KIND = "torchfilt stage"
METRICS, TABLE = "metrics.json", "table.txt"


class Stages:
    """Named stages of a run; each is kept under a digest of its recipe, so that other settings never meet old results.

    Args:
        folder: where they lie; None keeps nothing.
        say: told in one line what is read or refused.
    """

    def __init__(self, folder: str | Path | None, say: Callable[[str], None] = lambda line: None) -> None:
        self.folder = None if folder is None else Path(folder)
        self.say = say

    def path(self, name: str, recipe: dict[str, Any], suffix: str = "npz") -> Path | None:
        """File of a stage; the recipe is JSON-ready."""
        if self.folder is None:
            return None
        digest = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:12]
        return self.folder / f"{name}-{digest}.{suffix}"

    def has(self, name: str, recipe: dict[str, Any]) -> bool:
        """Whether a file of this recipe exists."""
        path = self.path(name, recipe)
        return path is not None and path.is_file()

    def get(self, name: str, recipe: dict[str, Any], compute: Callable[[], Arrays]) -> Arrays:
        """Arrays of a stage: read where a whole file of this recipe exists, else computed and kept.

        Args:
            name: of the stage.
            recipe: everything the result depends on.
            compute: makes the arrays.
        """
        path = self.path(name, recipe)
        if path is not None and path.is_file():
            try:
                return read_arrays(path, FILE_KIND)[0]
            except IntegrityError as error:
                self.say(f"{error}; computed again")
        arrays = compute()
        if path is not None:
            write_arrays(path, arrays, recipe, FILE_KIND)
        return arrays

    def clear(self) -> None:
        """Delete the stages of all recipes; other files in the folder stay."""
        if self.folder is None or not self.folder.is_dir():
            return
        for path in self.folder.glob("*.npz"):
            manifest_path(path).unlink(missing_ok=True)
            path.unlink()


def check_names(names: Sequence[str], known: Collection[str], what: str) -> None:
    """Raise a ValueError unless there are names, all known and each given once; ``what`` they name, in the plural."""
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"{what} must be out of {', '.join(known)}, got {', '.join(unknown) or 'none'}")
    again = [name for k, name in enumerate(names) if name in names[:k]]
    if again:
        raise ValueError(f"{what} must be given once each, got {', '.join(dict.fromkeys(again))} again")


def write_outcome(folder: Path, lines: Sequence[str], numbers: dict[str, Any]) -> None:
    """Write a study's table and its numbers, atomically; the numbers last: a folder with them is a finished run."""
    atomic_write(folder / TABLE, ("\n".join(lines).strip("\n") + "\n").encode())
    atomic_write(folder / METRICS, (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode())


def versions() -> dict[str, str]:
    """Of the programs that made the numbers."""
    import scipy
    import torch

    import torchfilt

    return {
        "torchfilt": torchfilt.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }
