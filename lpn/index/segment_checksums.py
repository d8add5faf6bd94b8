"""The checksums of a segment: checksums.json holds a CRC-32 of every block of its other files."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

from lpn.core.checksums import BLOCK, crc_of_blocks, crc_of_values
from lpn.core.errors import StoreError
from lpn.core.files import unreadable_error, write_atomic

NAME = "checksums.json"


class _ChecksumsFile(msgspec.Struct):
    block: int
    files: dict[str, list[int]]
    checksum: int | None = None


def write_checksums(segment: Path) -> None:
    """Write the checksums of all files of a new segment."""
    blocks = {path.name: crc_of_blocks(path, BLOCK) for path in sorted(segment.iterdir())}
    values = {"block": BLOCK, "files": blocks}
    write_atomic(segment / NAME, json.dumps({**values, "checksum": crc_of_values(values)}).encode())


def changed_files(segment: Path) -> list[str]:
    """Read all files of a segment and return those that do not match their checksums.

    Raises:
        StoreError: when a file is missing, or the checksums cannot be read.
    """
    try:
        file = msgspec.json.decode((segment / NAME).read_bytes(), type=_ChecksumsFile)
        if file.block < 1 or file.checksum != crc_of_values({"block": file.block, "files": file.files}):
            raise ValueError("another checksum")
        return [name for name, crcs in file.files.items() if list(crc_of_blocks(segment / name, file.block)) != crcs]
    except FileNotFoundError as error:
        raise StoreError(f"{error.filename} is missing; delete the index and make it again.") from error
    except OSError as error:
        raise unreadable_error(Path(error.filename or segment), error) from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{NAME} in {segment} is damaged; delete the index and make it again.") from error
