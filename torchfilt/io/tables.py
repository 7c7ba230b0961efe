"""Packed tables of numbers with a head: each fault is told by file, row and rule."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfilt.io.files import LogError, read_packed_text
from torchfilt.io.inertial import check_finite


class Table(NamedTuple):
    """name of the file; time_s (t,), its first column; values (t, k), the others that are numbers, float64."""

    name: str
    time_s: Tensor
    values: Tensor


def read_table(
    path: Path, header: str, digests: Mapping[str, str] | None, *, label: str | None = None, open_end: bool = False
) -> Table:
    """A gzip file of lines with commas. Messages count rows from 1 below the header.

    Args:
        path: of the file. digests: see `torchfilt.io.files.read_stored`.
        header: what the first line must be; the first column is the time.
        label: a word that must stand in the second column of each row; that column is left out.
        open_end: take a last row without a line end, as some writers leave it; a cut within it is then not found.

    Raises:
        LogError: as in `read_packed_text`; another header, rows that are cut short, are not numbers or not finite.
        FileNotFoundError: the file is missing.
    """
    text = read_packed_text(path, digests)
    if open_end and not text.endswith("\n"):
        text += "\n"
    if not text.endswith("\n"):
        raise LogError(f"{path.name}: row {text.count(chr(10))}: no line end; the file is cut short")
    first, *lines = text.replace("\r\n", "\n").split("\n")[:-1]
    if first != header:
        absent = [name for name in header.split(",") if name not in first.split(",")]
        told = f"without the columns {', '.join(absent)}" if absent else "with columns in another order or beside them"
        raise LogError(f"{path.name}: header is {first[:80]!r}, {told}; expected {header!r}")
    columns = header.count(",") + 1
    if label is not None:
        lines, columns = _without(path.name, lines, label), columns - 1
    table = read_rows(path.name, lines, columns, ",")
    return Table(path.name, table[:, 0].contiguous(), table[:, 1:])


def read_rows(name: str, lines: list[str], columns: int, separator: str | None = None) -> Tensor:
    """Numbers (t, columns), float64, of lines of text.

    Args:
        name: of the file, for messages. separator: between numbers; None: white space.

    Raises:
        LogError: no lines, one that is not as many numbers, a number that is not finite.
    """
    try:
        # Empty lines would be passed over in silence, no lines with a warning.
        if not all(line.strip() for line in lines) or not lines:
            raise ValueError("no row or an empty one")
        values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
        if values.shape != (len(lines), columns):
            raise ValueError(f"shape {values.shape}")
    except ValueError as error:
        raise LogError(f"{name}: {_first_fault(lines, columns, separator) or error}") from error
    table = torch.from_numpy(values)
    check_finite(name, "this row", table)
    return table


def _without(name: str, lines: list[str], label: str) -> list[str]:
    """Lines without their second column."""
    plain = []
    for k, line in enumerate(lines, start=1):
        time, found, rest = (*line.split(",", 2), "", "")[:3]
        if found != label:
            raise LogError(f"{name}: row {k}: second column is {found[:20]!r}, expected {label!r}")
        plain.append(f"{time},{rest}")
    return plain


def _first_fault(lines: list[str], columns: int, separator: str | None) -> str:
    """Row and rule of the first line that is no row of numbers."""
    if not lines:
        return "no rows"
    for k, line in enumerate(lines, start=1):
        fields = line.split(separator)
        if len(fields) != columns:
            return f"row {k}: {len(fields)} columns, expected {columns}"
        for field in fields:
            try:
                math.isfinite(float(field))
            except ValueError as error:
                return f"row {k}: {error}"
    return ""
