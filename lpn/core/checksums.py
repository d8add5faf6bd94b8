"""Checksums of what we write, by which a flipped byte is found.

A model file carries a seal in its metadata: the SHA-256 of the whole file, counted with the seal's own digits as zeros. It is
checked whenever the file is opened, before anything reads it. A store's array is too large for that: its manifest has a CRC-32
of every block, which `lpn verify` compares, and which is compared before rows are taken over into another store.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lpn.core.errors import ModelFileError

SEAL = "seal"
"""The entry of a model file's metadata that holds the seal."""
_MARK = b"lpn-sha256:"
_DIGITS = 64
UNSEALED = _MARK.decode() + "0" * _DIGITS
"""What stands there before the file is sealed."""
_NEAR = 4_000_000
"""Bytes at either end of a file among which the seal is: .safetensors begin with their metadata, ours in .onnx end with it."""
BLOCK = 1 << 22
"""Bytes of a block of an array."""
_PACKED, _SMALL = 8, 1_000_000
"""How many times its own bytes a file may hold (branches that share weights are told up to three times), and what is too
little to matter."""


def seal(data: bytes) -> bytes:
    """A file whose metadata hold `BLANK`, with the seal in its place."""
    start = _found(data)
    assert start is not None
    assert data[start : start + _DIGITS] == b"0" * _DIGITS
    return data[:start] + hashlib.sha256(data).hexdigest().encode() + data[start + _DIGITS :]


def check_seal(path: Path, remedy: str) -> bool:
    """Whether a model file has a seal, which those of earlier versions have not.

    Args:
        remedy: what to do when the file is damaged, as the end of a sentence.

    Raises:
        ModelFileError: when it has one and is not what was sealed.
    """
    if not path.stat().st_size:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = _found(data)
        if start is None:
            return False
        digest = hashlib.sha256()
        # Views must be gone before the map can be closed.
        with memoryview(data) as view, view[:start] as before, view[start + _DIGITS :] as after:
            for part in (before, b"0" * _DIGITS, after):
                digest.update(part)
        if digest.hexdigest().encode() != data[start : start + _DIGITS]:
            raise ModelFileError(f"{path.name} is damaged: it is not what its checksum was made of; {remedy}.")
    return True


def check_entries(path: Path, remedy: str) -> bool:
    """Compare a PyTorch file with the CRC-32 of each of its entries, which PyTorch writes and does not read.

    Returns:
        Whether it has any: a file of another kind, such as PyTorch's older one, or one that is cut short, has none.

    Raises:
        ModelFileError: when one differs, or when they would take far more memory than the file's size.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            check_claimed_size(path, sum(entry.file_size for entry in archive.infolist()), remedy)
            damaged = archive.testzip()
    except zipfile.BadZipFile:  # no archive, or one that PyTorch will refuse
        return False
    except (NotImplementedError, RuntimeError, EOFError, zlib.error, ValueError, OverflowError, OSError):
        damaged = "an entry"
    if damaged is not None:
        raise ModelFileError(f"{path.name} is damaged: an entry of it is not what its checksum was made of; {remedy}.")
    return True


def check_claimed_size(path: Path, claimed: int, remedy: str) -> None:
    """Refuse a file whose contents claim far more bytes than it has itself: packed ones, or one entry told many times.

    Raises:
        ModelFileError: when they do.
    """
    size = path.stat().st_size
    if claimed > _PACKED * size + _SMALL:
        raise ModelFileError(
            f"{path.name} has {size:,} bytes and claims to hold {claimed:,}, which no saved model does; {remedy}."
        )


@dataclass(frozen=True)
class Checksums:
    """Of a store.

    Attributes:
        block: bytes of a block of its array's file, the last one being shorter.
        blocks: CRC-32 of each.
        manifest: CRC-32 of everything else in the manifest.
    """

    block: int
    blocks: tuple[int, ...]
    manifest: int

    @classmethod
    def compute(cls, array: Path, manifest: Mapping[str, Any]) -> Checksums:
        """Of a file, and of what the manifest says without its checksums."""
        return cls(BLOCK, crc_of_blocks(array, BLOCK), crc_of_values(manifest))

    @classmethod
    def from_json(cls, values: Any) -> Checksums:
        """Read what `vars` of one gives; ValueError or TypeError when it is something else."""
        numbers = [values["block"], values["manifest"], *values["blocks"]]
        if not all(isinstance(number, int) and 0 <= number < 2**32 for number in numbers) or not numbers[0]:
            raise ValueError("no checksums")
        return cls(numbers[0], tuple(numbers[2:]), numbers[1])


def crc_of_blocks(path: Path, block: int) -> tuple[int, ...]:
    """CRC-32 of each block of a file."""
    found = []
    with path.open("rb") as file:
        while data := file.read(block):
            found.append(zlib.crc32(data))
    return tuple(found)


def crc_of_values(values: Mapping[str, Any]) -> int:
    """CRC-32 of values as JSON has them, however they are laid out."""
    return zlib.crc32(json.dumps(values, sort_keys=True).encode())


def _found(data: bytes | mmap.mmap) -> int | None:
    """Where a seal's digits begin."""
    position = data.find(_MARK, max(len(data) - _NEAR, 0))
    if position < 0:
        position = data.find(_MARK, 0, _NEAR)
    start = position + len(_MARK)
    return None if position < 0 or start + _DIGITS > len(data) else start
