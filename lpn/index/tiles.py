"""Read the tiles to be indexed, with their positions if known, from a store of descriptors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.progress import report_progress
from lpn.datasets import geo, open_dataset
from lpn.flight.maps.named_window import NamedWindow
from lpn.index.base import DescriptorKind, Index, check_names

# Size of the descriptors that are added at once, in bytes; a killed run repeats at most this much.
_CHUNK_BYTES = 64 << 20


class Tiles:
    """The tiles of a store, to be added to an index. Windows of a map have the positions in their names.

    Args:
        folder: folder of the store.
        data: folder that tells positions: in its geo.csv, by `lpn.datasets.geo.Positions.match`, or as a data set.

    Attributes:
        names: names of the tiles.
        kind: kind of their descriptors.
        positions: latitude and longitude in degrees, (N, 2) float64, NaN for a tile without a position; None for no positions.

    Raises:
        StoreError: when there is no complete store.
        DataError: when `data` tells no positions, or they cannot be read.
        InputError: if an index cannot hold these tiles, or `data` has no position for any tile, or two for one.
    """

    def __init__(self, folder: Path, data: Path | None = None) -> None:
        self._store = descriptors.open_store(folder)
        manifest = self._store.manifest
        if manifest.cropped:
            raise InputError(f"{folder} holds cropped pictures, of which several can share a file; index whole ones.")
        if manifest.role == "query":
            raise InputError(
                f"{folder} is described by the model's branch for queries, and an index holds a gallery; describe the pictures "
                "again with --role gallery, into another folder."
            )
        names = [Path(row.file).as_posix() for row in manifest.rows]
        self.names = check_names(names, len(names))
        self.kind = DescriptorKind(manifest.fingerprint, manifest.n_parts, manifest.embedding)
        self.positions = window_positions(self.names) if data is None else positions_of(data, self.names)

    def add_to(self, index: Index, replace: bool = False) -> int:
        """Add those tiles that an index lacks, or all, chunk by chunk; return their number. It reports its progress."""
        added, step = 0, max(1, _CHUNK_BYTES // (4 * self.kind.numbers))
        for start in range(0, len(self.names), step):
            names = self.names[start : start + step]
            some = start + (np.arange(len(names)) if replace else np.flatnonzero(~index.holds(names)))
            if len(some):
                places = None if self.positions is None else self.positions[some]
                index.add([self.names[i] for i in some.tolist()], self._store.rows(some), places)
            added += len(some)
            report_progress("Indexing", start + len(names), len(self.names))
        return added


def window_positions(names: list[str]) -> Float64Array | None:
    """Return the centres of windows of a map, (N, 2); None if a name is not that of a window."""
    windows = [window for name in names if (window := NamedWindow.parse(name)) is not None]
    if not names or len(windows) < len(names):
        return None
    return np.array([(window.latitude, window.longitude) for window in windows])


def positions_of(root: Path, names: list[str]) -> Float64Array:
    """Return the positions of tiles that a folder tells, (N, 2), NaN for none; see `Tiles` for the errors."""
    known = geo.positions(root) or _of_dataset(root)
    places = known.match(names)
    if names and not any(places):
        raise InputError(
            f"{known.source} in {root} has no position for any of the {len(names)} tiles, the first being {printable(names[0])}; "
            "give the data set that was described."
        )
    nowhere = (np.nan, np.nan)
    return np.array([nowhere if at is None else (at.latitude, at.longitude) for at in places], np.float64).reshape(
        -1, 2
    )


def _of_dataset(root: Path) -> geo.Positions:
    """Return the positions of a data set that has no geo.csv, such as DenseUAV, UAV-VisLoc, or VIGOR."""
    reason = ""
    try:
        known = open_dataset(root).positions()
    except DataError as error:
        known, reason = None, f" ({str(error).rstrip('.')})"
    if known is None:
        raise DataError(
            f"{root} has no {geo.NAME}, and no data set's own positions{reason}; leave --data out, or write one (docs/data.md)."
        )
    return known
