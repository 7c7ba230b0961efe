"""Files that are either whole or refused: atomic writes and a SHA-256 manifest beside the data."""

import hashlib
import io
import json
import os
import secrets
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MANIFEST_SUFFIX = ".manifest.json"
_HEAD = "head"
# What archives, arrays and heads that are not ours make the readers raise.
NOT_OURS = (KeyError, ValueError, TypeError, AttributeError, OSError, EOFError, zipfile.BadZipFile)


class IntegrityError(ValueError):
    """A file is not what its manifest says; the message names the file and the broken rule."""


def manifest_path(path: str | Path) -> Path:
    """Where the manifest of a data file lies: the same folder, the same name plus a suffix."""
    path = Path(path)
    return path.with_name(path.name + MANIFEST_SUFFIX)


def atomic_write(path: str | Path, data: bytes) -> None:
    """Write bytes so that a reader sees the old file or the new one, never a part.

    The temporary file lies in the same folder: a move across file systems would be a copy, which can be cut short.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    name = path.parent / f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp"
    # Unlike a temporary file of the tempfile module, this one is as readable as the user's settings say.
    handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(name, path)
    except BaseException:
        name.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def write_verified(path: str | Path, data: bytes, kind: str) -> None:
    """Write a data file and its manifest; a crash at any moment leaves a pair that loads.

    Two files cannot be replaced at once. The new manifest goes first and also accepts the digest of the file that is
    still in place, so between the two moves the old data is valid, and after the second the new.
    """
    path = Path(path)
    previous = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
    digest = hashlib.sha256(data).hexdigest()
    atomic_write(manifest_path(path), _manifest(kind, digest, previous))
    atomic_write(path, data)


def read_verified(path: str | Path, kind: str) -> bytes:
    """Bytes of a file written by `write_verified`, checked before anything interprets them.

    Raises:
        FileNotFoundError: no such file.
        IntegrityError: manifest absent, altered or of another kind; data truncated or altered.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    accepted = _read_manifest(path, kind)
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest not in accepted:
        raise IntegrityError(
            f"{path}: SHA-256 of its {len(data)} bytes is {digest[:12]}..., the manifest says {accepted[0][:12]}...; "
            "the file is truncated or altered"
        )
    return data


def remove_verified(path: str | Path) -> None:
    """Delete a data file and its manifest; absent files are no error."""
    Path(path).unlink(missing_ok=True)
    manifest_path(path).unlink(missing_ok=True)


def _manifest(kind: str, digest: str, previous: str | None) -> bytes:
    entries = {"kind": kind, "previous_sha256": previous, "sha256": digest, "version": 1}
    check = hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()
    return (json.dumps({**entries, "check": check}, sort_keys=True, indent=1) + "\n").encode()


def _read_manifest(path: Path, kind: str) -> list[str]:
    """Digests that the manifest accepts, the current one first."""
    where = manifest_path(path)
    if not where.is_file():
        raise IntegrityError(f"{path}: its manifest {where.name} is missing, so the file cannot be trusted")
    raw = where.read_bytes()
    try:
        entries = json.loads(raw)
        expected = _manifest(entries["kind"], entries["sha256"], entries["previous_sha256"])
    except (ValueError, KeyError, TypeError):
        raise IntegrityError(f"{where}: not a manifest of this library") from None
    if raw != expected:
        raise IntegrityError(f"{where}: the manifest was altered, its own check does not fit")
    if entries["kind"] != kind:
        raise IntegrityError(f"{path}: holds a {entries['kind']!r}, expected a {kind!r}")
    return [d for d in (entries["sha256"], entries["previous_sha256"]) if d is not None]


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable where the system allows it."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # not possible on every system; the file is still whole
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_arrays(path: str | Path, arrays: Mapping[str, Any], head: Mapping[str, Any], kind: str) -> None:
    """Write tensors or arrays by name and a JSON-ready head as a verified NPZ without pickle."""
    import numpy as np

    plain: dict[str, Any] = {name: np.asarray(_detached(value)) for name, value in arrays.items()}
    plain[_HEAD] = np.frombuffer(json.dumps(head, sort_keys=True).encode(), dtype=np.uint8)
    stream = io.BytesIO()
    np.savez(stream, **plain)
    write_verified(path, stream.getvalue(), kind)


def read_arrays(path: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays by name and head of a file that `write_arrays` made.

    Raises:
        FileNotFoundError: no such file.
        IntegrityError: truncated, altered or of another kind.
    """
    import numpy as np

    data = read_verified(path, kind)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        head = json.loads(arrays.pop(_HEAD).tobytes())
    except NOT_OURS as error:
        raise IntegrityError(f"{path}: not a {kind.removeprefix('torchfilt ')} of this version ({error})") from None
    if not isinstance(head, dict):
        found = f"its head is a {type(head).__name__}"
        raise IntegrityError(f"{path}: not a {kind.removeprefix('torchfilt ')} of this version ({found})")
    return arrays, head


def _detached(value: Any) -> Any:
    """A tensor without its graph, on the CPU; anything else as it is."""
    return value.detach().cpu() if hasattr(value, "detach") else value
