"""What readers of logs share: size and digest are checked before anything is unpacked, faults are told by file."""

import gzip
import hashlib
import json
import zlib
from collections.abc import Mapping
from pathlib import Path

# A day of GRACE at 10 s is 0.35 MB packed and 0.8 MB unpacked, the largest log here 4 MB packed.
MAX_PACKED_BYTES = 16 * 2**20
MAX_BYTES = 64 * 2**20


class LogError(ValueError):
    """A log file breaks a rule; the message names file, row and rule."""


def read_digests(manifest: Mapping[str, str] | str | Path | None) -> Mapping[str, str] | None:
    """SHA-256 digests by file name: as they are given, or out of a JSON file.

    Raises:
        LogError: no JSON, or something else than digests in it.
    """
    if manifest is None or isinstance(manifest, Mapping):
        return manifest
    try:
        content = json.loads(Path(manifest).read_text())
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise LogError(f"{Path(manifest).name}: not a JSON manifest: {error}") from error
    if not isinstance(content, dict) or not all(isinstance(value, str) for value in content.values()):
        raise LogError(f"{Path(manifest).name}: a manifest maps file names to SHA-256 digests")
    return content


def read_stored(path: Path, digests: Mapping[str, str] | None) -> bytes:
    """A file as it is stored.

    Raises:
        LogError: larger than `MAX_PACKED_BYTES`, or of another digest.
    """
    size = path.stat().st_size
    if size > MAX_PACKED_BYTES:
        raise LogError(f"{path.name}: {size} bytes, more than the limit of {MAX_PACKED_BYTES}")
    stored = path.read_bytes()
    if digests is not None:
        found = hashlib.sha256(stored).hexdigest()
        if digests.get(path.name) != found:
            raise LogError(f"{path.name}: SHA-256 is {found}, the manifest says {digests.get(path.name, 'nothing')}")
    return stored


def read_packed_text(path: Path, digests: Mapping[str, str] | None) -> str:
    """Text of a gzip file.

    Raises:
        LogError: as in `read_stored`; truncated or no gzip file; more than `MAX_BYTES` unpacked; not plain text.
    """
    read_stored(path, digests)
    try:
        with gzip.open(path, "rb") as stream:
            text = stream.read(MAX_BYTES + 1)
    except (EOFError, OSError, zlib.error) as error:
        raise LogError(f"{path.name}: not a whole gzip file: {error}") from error
    if len(text) > MAX_BYTES:
        raise LogError(f"{path.name}: more than the limit of {MAX_BYTES} bytes when unpacked")
    try:
        return text.decode("ascii")
    except UnicodeDecodeError as error:
        raise LogError(f"{path.name}: not plain text at byte {error.start}") from error
