"""Answers in a file of lines, appended one by one, so that a killed run can resume."""

from __future__ import annotations

from pathlib import Path

import msgspec

from lpn.core.errors import OutputError
from lpn.core.files import space_remedy
from lpn.flight.locate.located import StageRecord


class LineRecords:
    """Answers by a key; a line that a kill cut short is ignored.

    Args:
        file: of JSON lines, created by the first record.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._records: dict[str, StageRecord] = {}
        try:
            lines = file.read_bytes().splitlines()
        except OSError:
            return
        decoder = msgspec.json.Decoder(tuple[str, StageRecord])
        for line in lines:
            try:
                key, self._records[key] = decoder.decode(line)
            except (msgspec.MsgspecError, ValueError):
                continue

    def get(self, key: str) -> StageRecord | None:
        """Return the record of a key; None if there is none."""
        return self._records.get(key)

    def append(self, key: str, record: StageRecord) -> None:
        """Write a record; raises OutputError if the file cannot be written."""
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            with self._file.open("ab") as file:
                # The first line break ends a line that was cut short.
                file.write(b"\n" + msgspec.json.encode((key, record)) + b"\n")
        except OSError as error:
            raise OutputError(
                f"{self._file} cannot be written ({error.strerror or error}); {space_remedy(error)}set LPN_CACHE to a folder "
                "that can be written."
            ) from error
