"""Checksums of a segment's files, in a file beside them: a CRC-32 of every block, as for `lpn.core.checksums.Checksums`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lpn.core.checksums import BLOCK, crc_of_blocks, crc_of_values
from lpn.core.errors import StoreError
from lpn.core.files import unreadable_error, write_atomic

NAME = "checksums.json"


def write_sums(segment: Path) -> None:
    """Write those of all files that are in a new segment."""
    blocks = {path.name: crc_of_blocks(path, BLOCK) for path in sorted(segment.iterdir())}
    values = {"block": BLOCK, "files": blocks}
    write_atomic(segment / NAME, json.dumps({**values, "checksum": crc_of_values(values)}).encode())


def changed(segment: Path) -> list[str] | None:
    """The files that differ from what their checksums were made of, all read in full; None where there are no checksums.

    Raises:
        StoreError: when the checksums cannot be read, or a file is missing.
    """
    try:
        told: Any = json.loads((segment / NAME).read_bytes())
        if told.pop("checksum") != crc_of_values(told):
            raise ValueError("another checksum")
        return [
            name
            for name, blocks in told["files"].items()
            if list(crc_of_blocks(segment / name, told["block"])) != blocks
        ]
    except FileNotFoundError as error:
        if error.filename == str(segment / NAME):
            return None
        raise StoreError(f"{error.filename} is missing; delete the index and make it again.") from error
    except OSError as error:
        raise unreadable_error(Path(error.filename or segment), error) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise StoreError(f"{NAME} in {segment} is damaged; delete the index and make it again.") from error
