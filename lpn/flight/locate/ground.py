"""Local features of a map, described block by block on demand, and stored in the user's cache."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import math
import threading
import zipfile
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import OutputError
from lpn.core.files import cache_folder, write_atomic
from lpn.flight.locate.matchers import Matcher
from lpn.flight.locate.registration import Ground, describe_ground
from lpn.flight.maps import Map, Window

log = logging.getLogger(__name__)

FORMAT = "lpn-ground/2"
# Side of a block in pixels, its margin, and the most features of a block.
_SIDE = 1024
_MARGIN = 24
_LIMIT = 7500
# Largest width of a compared photo in pixels, and largest enlargement of a map.
_PHOTO = 900
_ENLARGED = 2.0
# Most blocks that one photo is compared with.
MAX_BLOCKS = 48
# Bytes of features in memory: as many blocks as one photo needs of two matchers, 2 MB each of XFeat and 4 MB of SIFT.
_MEMORY = 300_000_000


class GroundCache:
    """A thread-safe LRU cache of features, for blocks of all maps of a process.

    Args:
        limit: most bytes of all features together; the newest block stays even if it is larger.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._lock = limit, threading.Lock()
        self._grounds: dict[Hashable, Ground] = {}  # in the order of last use

    def get(self, key: Hashable, make: Callable[[], Ground]) -> Ground:
        """Return the features of a block, made by `make` if they are not cached."""
        with self._lock:
            if (held := self._grounds.pop(key, None)) is not None:
                self._grounds[key] = held
                return held
        ground = make()
        with self._lock:
            self._grounds[key] = ground
            sizes = {key: one.points.nbytes + one.descriptors.nbytes for key, one in self._grounds.items()}
            while sum(sizes.values()) > self._limit and len(sizes) > 1:
                oldest = next(iter(sizes))
                del sizes[oldest], self._grounds[oldest]
        return ground

    def clear(self) -> None:
        with self._lock:
            self._grounds.clear()


# Shared by all maps of a process, to bound the memory.
in_memory = GroundCache(_MEMORY)


class MapFeatures:
    """Features of a map's blocks: in memory for later frames, and on disk for later runs.

    A block's file is named by the digest of the map, the matcher with its version, and the block, so a change of one of them
    makes a new file. An unreadable file is replaced; a cache that cannot be written costs only time.

    Args:
        basemap: the map.
        matcher: describes it.
    """

    def __init__(self, basemap: Map, matcher: Matcher) -> None:
        self._map, self.matcher = basemap, matcher
        identity = [FORMAT, basemap.digest(), matcher.name, matcher.version, _SIDE, _MARGIN, _LIMIT]
        self._digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
        self._folder: Path | None = cache_folder() / "locate" / "ground" / self._digest

    def resolution(self, width: float) -> float:
        """Return the metres per pixel of the comparison for a ground width in metres: half the map's pixel times a power of 2."""
        finest = self._map.resolution / _ENLARGED
        return finest * 2.0 ** max(0, math.ceil(math.log2(max(width / _PHOTO / finest, 1e-9))))

    def around(self, centres: Float64Array | None, reach: float, width: float) -> Ground | None:
        """Return the features of squares of side 2 `reach` about points (K, 2), or of the whole map for None.

        Returns:
            None if more than `MAX_BLOCKS` blocks are needed.
        """
        resolution = self.resolution(width)
        side = _SIDE * resolution
        west, north = self._map.bounds[0], self._map.bounds[3]
        columns, rows = self._grid(side)
        if centres is None:
            if columns * rows > MAX_BLOCKS:
                return None
            blocks = {(row, column) for row in range(rows) for column in range(columns)}
        else:
            blocks = set()
            for x, y in centres:
                left, right = (int((x + d - west) // side) for d in (-reach, reach))
                top, bottom = (int((north - y - d) // side) for d in (reach, -reach))
                blocks |= {
                    (row, column)
                    for row in range(max(top, 0), min(bottom, rows - 1) + 1)
                    for column in range(max(left, 0), min(right, columns - 1) + 1)
                }
            if len(blocks) > MAX_BLOCKS:
                return None
        level = round(math.log2(resolution / self._map.resolution))
        grounds = [self._block(level, row, column, resolution) for row, column in sorted(blocks)]
        points = np.concatenate([ground.points for ground in grounds]) if grounds else np.zeros((0, 2))
        values = np.concatenate([ground.descriptors for ground in grounds]) if grounds else np.zeros((0, 1), np.float32)
        if centres is None:
            return Ground(points, values, resolution)
        near = np.zeros(len(points), bool)
        for centre in centres:
            near |= (np.abs(points - centre) <= reach).all(axis=1)
        return Ground(points[near], values[near], resolution)

    def holds_map(self, width: float) -> bool:
        """Tell whether the whole map has at most `MAX_BLOCKS` blocks for a ground width in metres."""
        columns, rows = self._grid(_SIDE * self.resolution(width))
        return columns * rows <= MAX_BLOCKS

    def _grid(self, side: float) -> tuple[int, int]:
        west, south, east, north = self._map.bounds
        return max(math.ceil((east - west) / side), 1), max(math.ceil((north - south) / side), 1)

    def _block(self, level: int, row: int, column: int, resolution: float) -> Ground:
        key = (level, row, column)

        def made() -> Ground:
            if (ground := self._read(key, resolution)) is None:
                ground = self._described(row, column, resolution)
                self._write(key, ground)
            return ground

        return in_memory.get((self._digest, key), made)

    def _described(self, row: int, column: int, resolution: float) -> Ground:
        west, north = self._map.bounds[0], self._map.bounds[3]
        x, y = west + (column + 0.5) * _SIDE * resolution, north - (row + 0.5) * _SIDE * resolution
        pixels = _SIDE + 2 * _MARGIN
        size = pixels * resolution
        picture, valid = self._map.read(Window(x, y, size), pixels)
        corner = (x - size / 2, y + size / 2)
        features = describe_ground(self.matcher, picture, valid, corner, resolution, _LIMIT)
        return features.near(np.array([x, y]), _SIDE * resolution / 2)

    def _file(self, key: tuple[int, int, int]) -> Path | None:
        return None if self._folder is None else self._folder / f"{'_'.join(map(str, key))}.npz"

    def _read(self, key: tuple[int, int, int], resolution: float) -> Ground | None:
        """Read a block's file; None if it is missing or damaged."""
        if (file := self._file(key)) is None:
            return None
        try:
            with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as arrays:
                return Ground(arrays["points"], arrays["descriptors"], resolution)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def _write(self, key: tuple[int, int, int], ground: Ground) -> None:
        if (file := self._file(key)) is None:
            return
        data = io.BytesIO()
        np.savez(data, points=ground.points, descriptors=ground.descriptors)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, data.getvalue())
        except (OSError, OutputError) as error:
            self._folder = None  # so that the warning comes once
            log.warning(
                "Features of the map are not kept for the next run, as %s cannot be written (%s); set LPN_CACHE to a folder that "
                "can be.",
                file.parent,
                getattr(error, "strerror", None) or error,
            )
