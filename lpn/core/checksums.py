"""Checksums of written files, to detect flipped bytes.

A model file has a seal in its metadata: the SHA-256 of the whole file, computed with zeros in place of the seal. The seal is
checked whenever the file is opened, before anything else is read. A store's arrays are too large for that; `lpn doctor PATH`
compares them with the sums in its files.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lpn.core.errors import ModelFileError

# The entry of a model file's metadata that holds the seal, and its value before the file is sealed.
SEAL = "seal"
_PREFIX = b"lpn-sha256:"
_DIGITS = 64
UNSEALED = _PREFIX.decode() + "0" * _DIGITS
# The seal lies within this many bytes of either end: .safetensors begin with their metadata, our .onnx end with it.
_SEARCHED = 4_000_000
# A model file may claim this many times its size (shared weights count up to three times), plus this many bytes.
_MAX_RATIO, _ALLOWANCE = 8, 1_000_000


def with_seal(data: bytes) -> bytes:
    """Replace `UNSEALED` in a file's metadata by the seal of the file."""
    start = _find_seal(data)
    assert start is not None
    assert data[start : start + _DIGITS] == b"0" * _DIGITS
    return data[:start] + hashlib.sha256(data).hexdigest().encode() + data[start + _DIGITS :]


def check_seal(path: Path, remedy: str) -> bool:
    """Compare a model file with its seal.

    Args:
        remedy: what to do if the file is damaged, as the end of a sentence.

    Returns:
        True if the file has a seal; files of other programs have none.

    Raises:
        ModelFileError: if the file differs from its seal.
    """
    if not path.stat().st_size:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = _find_seal(data)
        if start is None:
            return False
        digest = hashlib.sha256()
        # The map cannot be closed while views of it exist.
        with memoryview(data) as view, view[:start] as before, view[start + _DIGITS :] as after:
            for part in (before, b"0" * _DIGITS, after):
                digest.update(part)
        if digest.hexdigest().encode() != data[start : start + _DIGITS]:
            raise ModelFileError(f"{path.name} is damaged: it does not match its checksum; {remedy}.")
    return True


def check_entries(path: Path, remedy: str) -> bool:
    """Compare the entries of a PyTorch file with their CRC-32, because PyTorch itself does not.

    Returns:
        True if the file has entries; a truncated one and PyTorch's older format have none.

    Raises:
        ModelFileError: if an entry is damaged, or the entries are far larger than the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            check_claimed_size(path, sum(entry.file_size for entry in archive.infolist()), remedy)
            damaged = archive.testzip()
    except zipfile.BadZipFile:  # PyTorch itself will refuse it
        return False
    except (NotImplementedError, RuntimeError, EOFError, zlib.error, ValueError, OverflowError, OSError):
        damaged = "an entry"
    if damaged is not None:
        raise ModelFileError(f"{path.name} is damaged: an entry does not match its checksum; {remedy}.")
    return True


def check_claimed_size(path: Path, claimed: int, remedy: str) -> None:
    """Raise ModelFileError if a file claims far more bytes than it has, as with compressed or repeated entries."""
    size = path.stat().st_size
    if claimed > _MAX_RATIO * size + _ALLOWANCE:
        raise ModelFileError(
            f"{path.name} has {size:,} bytes and claims to hold {claimed:,}, which no saved model does; {remedy}."
        )


def crc_of_values(values: Mapping[str, Any]) -> int:
    """Return the CRC-32 of JSON values, independent of order and spacing."""
    return zlib.crc32(json.dumps(values, sort_keys=True).encode())


def _find_seal(data: bytes | mmap.mmap) -> int | None:
    position = data.find(_PREFIX, max(len(data) - _SEARCHED, 0))
    if position < 0:
        position = data.find(_PREFIX, 0, _SEARCHED)
    start = position + len(_PREFIX)
    return None if position < 0 or start + _DIGITS > len(data) else start
