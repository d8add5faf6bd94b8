"""Folders behind addresses such as s3://bucket/prefix, which fsspec opens with the package of the scheme (extra `cluster`)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lpn.core import images
from lpn.core.errors import DataError, InputError, StoreError
from lpn.core.files import printable
from lpn.descriptors.store import MANIFEST, ROWS, VECTORS, Row, row_of
from lpn.descriptors.writer import pictures_below


class Storage:
    """A folder, or a prefix in object storage such as s3://bucket/prefix; InputError if no package opens it."""

    def __init__(self, where: str | Path) -> None:
        from fsspec.core import url_to_fs

        self.where = str(where)
        try:
            self._files, self._root = url_to_fs(self.where if "://" in self.where else str(Path(where).absolute()))
        except (OSError, ValueError, ImportError) as error:
            raise InputError(
                f"{self.where} cannot be opened ({first_line(error)}); give a folder, or an address such as s3://bucket/prefix."
            ) from error

    def rows(self) -> list[Row]:
        """List all pictures below, sorted by path, without hidden ones; DataError if that fails, or there are none."""
        if "://" not in self.where:
            folder = Path(self.where)
            return [row_of(file, folder, None) for file in pictures_below(folder)]
        try:
            found = self._files.find(self._root, detail=True)
        except OSError as error:
            raise DataError(f"{self.where} cannot be listed ({first_line(error)}); check the address.") from error
        rows = []
        for path, info in found.items():
            name = path.removeprefix(self._root).lstrip("/")
            changed = next(
                (info[key] for key in ("mtime", "LastModified", "last_modified", "updated") if key in info), 0
            )
            seconds = changed.timestamp() if hasattr(changed, "timestamp") else float(changed or 0)
            if name.lower().endswith(images.SUFFIXES) and not any(part.startswith(".") for part in name.split("/")):
                rows.append(Row(name, int(info.get("size") or 0), round(seconds * 1e9)))
        if not rows:
            raise DataError(f"{self.where} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
        return sorted(rows, key=lambda row: row.file.split("/"))

    def read(self, name: str) -> bytes:
        """Read a file; OSError if that fails."""
        return bytes(self._files.cat_file(f"{self._root}/{name}"))

    def write(self, name: str, data: bytes) -> None:
        """Write a file; StoreError if that fails."""
        try:
            self._files.makedirs(f"{self._root}/{name}".rpartition("/")[0], exist_ok=True)
            self._files.pipe_file(f"{self._root}/{name}", data)
        except OSError as error:
            raise StoreError(
                f"{name} cannot be written to {self.where} ({first_line(error)}); check its space and your rights there."
            ) from error

    def copy(self, folder: Path, *, vectors: bool = True) -> dict[str, int]:
        """Copy this store to a folder of this machine; without `vectors`, only the rows.json of each part.

        Returns:
            The size of each file of this store in bytes, by its path.
        """
        names = (MANIFEST, ROWS, VECTORS) if vectors else (ROWS,)
        there = self._files.find(self._root, detail=True) if self._files.exists(self._root) else {}
        sizes = {path.removeprefix(self._root).lstrip("/"): int(info["size"] or 0) for path, info in there.items()}
        paths = [path for path in there if path.rpartition("/")[2] in names]
        here = [folder / path.removeprefix(self._root).lstrip("/") for path in paths]
        for file in here:
            file.parent.mkdir(parents=True, exist_ok=True)
        self._files.get(paths, list(map(str, here)))  # many at once, as storage is slow to answer
        return sizes


@contextmanager
def local_store(where: str) -> Iterator[Path]:
    """Yield the folder of a store, which is copied to this machine first if it is an address."""
    if "://" not in where:
        yield Path(where)
        return
    with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
        Storage(where).copy(Path(folder))
        yield Path(folder)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return printable((str(error).splitlines() or [type(error).__name__])[0])
