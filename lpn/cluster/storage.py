"""Pictures in a folder or under a prefix in object storage. Needs the extra `cluster`.

pyarrow opens the schemes that it knows (s3://, gs://, abfss://, hdfs://, file://); fsspec opens all others, where it is
installed with the package of the scheme.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow
from pyarrow import fs

from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.descriptors import Row

_TRIES = 3
# Seconds before the first retry of a read.
_PAUSE = 0.5


class Storage:
    """A place of files.

    Args:
        where: a path, or a URI such as s3://bucket/prefix.

    Attributes:
        where: the same as text.

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

    def files(self, suffixes: tuple[str, ...]) -> list[Row]:
        """List all files below with one of these suffixes, in order of their path; hidden ones are skipped.

        Raises:
            DataError: when there is no such place, or it cannot be listed.
        """
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
                with self._files.open_input_stream(f"{self._root.rstrip('/')}/{name}") as stream:
                    return bytes(stream.read())
            except FileNotFoundError:
                raise
            except OSError:
                if attempt == _TRIES:
                    raise
                time.sleep(_PAUSE * attempt)
        raise AssertionError

    def _listed(self, suffixes: tuple[str, ...]) -> Iterator[Row]:
        for info in self._files.get_file_info(fs.FileSelector(self._root, recursive=True)):
            name = info.path.removeprefix(self._root).lstrip("/")
            hidden = any(part.startswith(".") for part in name.split("/"))
            if info.type == fs.FileType.File and name.lower().endswith(suffixes) and not hidden:
                yield Row(name, int(info.size or 0), int(info.mtime_ns or 0))


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
