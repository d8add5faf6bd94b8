"""Files in a folder or under a prefix in object storage, behind one interface. Needs the extra `cluster`.

pyarrow opens the schemes that it knows (s3://, gs://, abfss://, hdfs://, file://). fsspec opens all others if it and the
package of the scheme are installed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow
from pyarrow import fs

from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import printable, write_atomic
from lpn.descriptors import Row

_TRIES = 3
# Seconds before the first retry of a read.
_PAUSE = 0.5


class Storage:
    """A place of files.

    Args:
        where: a path, or a URI such as s3://bucket/prefix.

    Attributes:
        where: the address as text.
        folder: the path if it is on this machine, else None.

    Raises:
        InputError: when no package knows the scheme, or it rejects the address.
    """

    def __init__(self, where: str | Path) -> None:
        self.where = str(where)
        try:
            self._files, root = _opened(self.where)
        except (pyarrow.ArrowException, OSError, ValueError, ImportError) as error:
            raise InputError(
                f"{self.where} cannot be opened ({_first_line(error)}); give a folder, or an address such as s3://bucket/prefix."
            ) from error
        self._root = root.rstrip("/") or "/"
        self.folder = Path(root) if isinstance(self._files, fs.LocalFileSystem) else None

    def files(self, suffixes: tuple[str, ...]) -> list[Row]:
        """List all files below with one of these suffixes, sorted by path, without hidden ones; DataError if that fails."""
        try:
            return sorted(self._listed(suffixes), key=lambda row: row.file.split("/"))
        except UnicodeDecodeError as error:
            raise DataError(f"{self.where} holds file names that are not UTF-8; rename those files.") from error
        except OSError as error:
            raise DataError(f"{self.where} cannot be listed ({_first_line(error)}); check the address.") from error

    def read(self, name: str) -> bytes:
        """Read a whole file; FileNotFoundError at once, other OSErrors after three tries."""
        for attempt in range(1, _TRIES + 1):
            try:
                with self._files.open_input_stream(self._path(name)) as stream:
                    return bytes(stream.read())
            except FileNotFoundError:
                raise
            except OSError:
                if attempt == _TRIES:
                    raise
                time.sleep(_PAUSE * attempt)
        raise AssertionError

    def open(self, name: str) -> Any:
        """Open a file for random access by pyarrow; FileNotFoundError if there is none."""
        return self._files.open_input_file(self._path(name))

    def write(self, name: str, data: bytes) -> None:
        """Write a file atomically; OutputError if that fails."""
        if self.folder is not None:
            write_atomic(self.folder / name, data)
            return
        try:
            # Object storage shows a file only after it is closed.
            with self._files.open_output_stream(self._path(name)) as stream:
                stream.write(data)
        except OSError as error:
            raise OutputError(
                f"{name} cannot be written to {self.where} ({_first_line(error)}); check its space and your rights there."
            ) from error

    def delete(self, name: str) -> None:
        """Delete a file, if it is there."""
        with suppress(FileNotFoundError):
            self._files.delete_file(self._path(name))

    def _listed(self, suffixes: tuple[str, ...]) -> Iterator[Row]:
        for info in self._files.get_file_info(fs.FileSelector(self._root, recursive=True)):
            name = info.path.removeprefix(self._root).lstrip("/")
            hidden = any(part.startswith(".") for part in name.split("/"))
            if info.type == fs.FileType.File and name.lower().endswith(suffixes) and not hidden:
                yield Row(name, int(info.size or 0), int(info.mtime_ns or 0))

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"


def _opened(where: str) -> tuple[fs.FileSystem, str]:
    if "://" not in where:
        return fs.LocalFileSystem(), str(Path(where).absolute())
    try:
        return fs.FileSystem.from_uri(where)  # type: ignore[no-any-return]
    except pyarrow.ArrowInvalid:
        from fsspec.core import url_to_fs

        filesystem, root = url_to_fs(where)
        return fs.PyFileSystem(fs.FSSpecHandler(filesystem)), str(root)


def _first_line(error: BaseException) -> str:
    return printable((str(error).splitlines() or [type(error).__name__])[0])
