"""Small files of a user's own work beside a data set or a flight: notes, named views, stories, corrected places.

Users and several programs may edit them at once, because each change is made under a lock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import check_writable, exclusive_lock, printable, write_atomic
from lpn.core.shutdown import uninterrupted

_Contents = TypeVar("_Contents")


@dataclass(frozen=True)
class OwnFileFormat(Generic[_Contents]):
    """The format of one kind of these files.

    Attributes:
        holds: the noun for its contents, in the plural, such as "notes".
        decode: returns the contents of bytes of a file; raises DataError if they are damaged.
        encode: the inverse of `decode`.
        empty: returns the contents of a file that does not exist.
        smaller: the remedy for too large contents, such as "shorten other notes first".
        max_bytes: maximum number of bytes of the file.
    """

    holds: str
    decode: Callable[[bytes, Path], _Contents]
    encode: Callable[[_Contents], bytes]
    empty: Callable[[], _Contents]
    smaller: str
    max_bytes: int = 50_000_000

    def read(self, file: Path) -> _Contents:
        """Return the file's contents; DataError when it is damaged, too large, or unreadable."""
        try:
            if not file.exists():
                return self.empty()
            if file.stat().st_size > self.max_bytes:
                raise DataError(f"{file} has more than {self._limit}, too much for {self.holds}; move it away.")
            content = file.read_bytes()
        except OSError as error:
            raise DataError(f"{file} cannot be read ({error.strerror or error}); check that it is readable.") from error
        return self.decode(content, file)

    def change(self, file: Path, change: Callable[[_Contents], _Contents]) -> _Contents:
        """Replace the contents by a function's result, and return them; an exception in the function changes nothing.

        Raises:
            InputError: when the contents would be too large.
            DataError: as `read`; the file is not changed.
            OutputError: when the file cannot be written.
        """
        check_writable(file)
        try:
            with exclusive_lock(file.parent, wait=True), uninterrupted():
                contents = change(self.read(file))
                try:
                    content = self.encode(contents)
                except UnicodeEncodeError as error:
                    text = printable(str(error.object))[:100]
                    raise InputError(
                        f"{file.name} cannot hold {text!r}, which is not UTF-8; rename the file, or leave the text out."
                    ) from error
                if len(content) > self.max_bytes:  # it could not be read again
                    raise InputError(f"{file.name} would have more than {self._limit}; {self.smaller}.")
                write_atomic(file, content)
        except OSError as error:
            raise OutputError(
                f"{file} cannot be written ({error.strerror or error}); choose another place for {self.holds}."
            ) from error
        return contents

    @property
    def _limit(self) -> str:
        return f"{self.max_bytes // 1_000_000} MB"
