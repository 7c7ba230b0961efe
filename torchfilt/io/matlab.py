"""MATLAB 5 files whose structure is checked before SciPy decodes them: SciPy itself follows nested or vast arrays of a
hostile file until the process dies.
"""

import io
import math
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from torchfilt.io import files
from torchfilt.io.files import LogError, read_stored

# Elements of a type, a length and content, padded to 8 bytes; content of up to 4 bytes may stand in the second half of
# the head. A matrix holds flags with its class, sizes, a name and its values.
_MATRIX, _PACKED = 14, 15
_STRUCTURE = 2
_NUMBERS = range(6, 16)
_COMPLEX = 0x0800


def read_structure(path: Path, digests: Mapping[str, str] | None, name: str) -> Any:
    """A flat structure of real arrays, as SciPy's record (axes of length one gone).

    Args:
        path: of the file. digests: see `torchfilt.io.files.read_stored`. name: of the variable.

    Raises:
        LogError: as in `read_stored`; cut short, of another structure, or with arrays larger than their values.
        FileNotFoundError: the file is missing.
    """
    return _read(path, digests, {name: _check_structure}, f"the structure {name}", squeeze=True)[name]


def read_arrays(
    path: Path, digests: Mapping[str, str] | None, names: Sequence[str]
) -> dict[str, npt.NDArray[np.float64]]:
    """Variables that are real arrays, with the axes that they have in the file; others are passed over.

    Args:
        path: of the file. digests: see `torchfilt.io.files.read_stored`. names: of the variables.

    Raises:
        LogError: as in `read_stored`; cut short, a variable missing, no real array, or larger than its values.
        FileNotFoundError: the file is missing.
    """
    content = _read(path, digests, dict.fromkeys(names, _check_numbers), f"the arrays {', '.join(names)}")
    return {name: np.array(content[name], dtype=np.float64) for name in names}


class _Element(NamedTuple):
    kind: int
    content: memoryview
    whole: memoryview


_Check = Callable[[list[_Element], str], None]


def _read(
    path: Path, digests: Mapping[str, str] | None, checks: Mapping[str, _Check], told: str, squeeze: bool = False
) -> dict[str, Any]:
    from scipy.io import loadmat

    stored = read_stored(path, digests)
    try:
        # SciPy's stubs know no streams.
        safe: Any = io.BytesIO(_checked(stored, checks))
        found: dict[str, Any] = loadmat(safe, struct_as_record=False, squeeze_me=squeeze)
        return {name: found[name] for name in checks}
    except (ValueError, TypeError, LookupError, OSError, OverflowError, struct.error, zlib.error) as error:
        raise LogError(f"{path.name}: not a whole MATLAB 5 file with {told}: {error}") from error


def _checked(stored: bytes, checks: Mapping[str, _Check]) -> bytes:
    """A file of the named variables only, each of which has passed its check."""
    if len(stored) < 128 or stored[124:128] != b"\x00\x01IM":
        raise ValueError("no head of a little-endian MATLAB 5 file")
    found: dict[str, list[bytes]] = {name: [] for name in checks}
    for whole in _unpacked(stored):
        for variable in _elements(whole):
            if variable.kind != _MATRIX:
                raise ValueError(f"an element of type {variable.kind}, expected a matrix")
            parts = list(_elements(variable.content))
            if len(parts) < 3:
                raise ValueError(f"a matrix of {len(parts)} parts, expected flags, sizes and a name at least")
            name = bytes(parts[2].content).decode("latin-1")
            if name in checks:
                checks[name](parts, f"variable {name}")
                found[name].append(bytes(variable.whole))
    for name, copies in found.items():
        if len(copies) != 1:
            raise ValueError(f"{len(copies)} variables {name}")
    return stored[:128] + b"".join(copies[0] for copies in found.values())


def _unpacked(stored: bytes) -> Iterator[memoryview]:
    """The variables' elements, out of their packing."""
    room = files.MAX_BYTES
    for element in _elements(memoryview(stored)[128:]):
        if element.kind != _PACKED:
            yield element.whole
            continue
        unpacker = zlib.decompressobj()
        unpacked = unpacker.decompress(element.content, room)
        if not unpacker.eof:
            raise ValueError(f"cut short, or more than the limit of {files.MAX_BYTES} bytes when unpacked")
        room -= len(unpacked)
        yield memoryview(unpacked)


def _elements(data: memoryview) -> Iterator[_Element]:
    start = 0
    while start < len(data):
        kind, size = struct.unpack_from("<II", data, start)
        if kind >> 16:
            kind, size, first, end = kind & 0xFFFF, kind >> 16, start + 4, start + 8
        else:
            first = start + 8
            # Packed elements are not padded.
            end = first + size + (-size % 8 if kind != _PACKED else 0)
        if first + size > len(data):
            raise ValueError("an element ends behind the file")
        yield _Element(kind, data[first : first + size], data[start:end])
        start = end


def _check_structure(parts: list[_Element], what: str) -> None:
    flags, sizes, _, *rest = parts
    if flags.content[0] != _STRUCTURE or _count(sizes) != 1:
        raise ValueError(f"{what} of class {flags.content[0]} with {_count(sizes)} entries, expected one structure")
    for entry in rest[2:]:  # behind the length and the text of the names
        _check_numbers(list(_elements(entry.content)) if entry.kind == _MATRIX else [], "a field")


def _check_numbers(parts: list[_Element], what: str) -> None:
    if len(parts) != 4:
        raise ValueError(f"{what} that is no plain array")
    flags, sizes, _, values = parts
    (bits,) = struct.unpack_from("<I", flags.content)
    if bits & 0xFF not in _NUMBERS or bits & _COMPLEX:
        raise ValueError(f"{what} of class {bits & 0xFF}, expected real numbers")
    if _count(sizes) > len(values.content):
        raise ValueError(f"{what} that is larger than its values")


def _count(sizes: _Element) -> int:
    entries = struct.unpack(f"<{len(sizes.content) // 4}i", sizes.content)
    if len(entries) < 2 or min(entries) < 0:
        raise ValueError(f"sizes {entries}")
    return math.prod(entries)
