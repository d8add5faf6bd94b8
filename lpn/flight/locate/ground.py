"""Local features of a map, described block by block on demand, and stored in the user's cache."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import math
import threading
import zipfile
from itertools import product
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import OutputError
from lpn.core.files import cache_folder, write_atomic
from lpn.flight.locate.matchers import Ground, Matcher
from lpn.flight.maps import Map, Window

log = logging.getLogger(__name__)

FORMAT = "lpn-ground/2"
# Side of a block in pixels, its margin, and the maximum of its features.
_SIDE = 1024
_MARGIN = 24
_LIMIT = 7500
# Largest width of a compared photo in pixels, and largest enlargement of a map.
_PHOTO = 900
_ENLARGED = 2.0
# Maximum of blocks that one photo is compared with.
MAX_BLOCKS = 48

# Blocks of all maps of a process in the order of their last use, enough for one photo and two matchers. A block of XFeat takes
# 2 MB, and a block of SIFT 4 MB.
in_memory: dict[tuple[str, int, int, int], Ground] = {}
_lock = threading.Lock()


class MapFeatures:
    """Features of a map's blocks: in memory for later frames, and on disk for later runs.

    A block's file is named by the digest of the map, the matcher with its version, and the block. A change of one of them
    makes a new file. An unreadable file is replaced; a cache that cannot be written costs only time.

    Args:
        basemap: the map.
        matcher: describes the map.
    """

    def __init__(self, basemap: Map, matcher: Matcher) -> None:
        self._map, self.matcher = basemap, matcher
        identity = [FORMAT, basemap.digest(), matcher.name, matcher.version, _SIDE, _MARGIN, _LIMIT]
        self._digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
        self._folder = cache_folder() / "locate" / "ground" / self._digest
        self._is_writable = True

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
        columns, rows = self._grid(resolution)
        if centres is None:
            if not self.holds_map(width):
                return None
            blocks = set(product(range(rows), range(columns)))
        else:
            side, west, north = _SIDE * resolution, self._map.bounds[0], self._map.bounds[3]
            blocks = set()
            for x, y in centres:
                left, right = (int((x + d - west) // side) for d in (-reach, reach))
                top, bottom = (int((north - y - d) // side) for d in (reach, -reach))
                across = range(max(left, 0), min(right, columns - 1) + 1)
                blocks |= set(product(range(max(top, 0), min(bottom, rows - 1) + 1), across))
            if len(blocks) > MAX_BLOCKS:
                return None
        grounds = [self._block(row, column, resolution) for row, column in sorted(blocks)]
        points = np.concatenate([ground.points for ground in grounds]) if grounds else np.zeros((0, 2))
        values = np.concatenate([ground.descriptors for ground in grounds]) if grounds else np.zeros((0, 1), np.float32)
        ground = Ground(points, values, resolution)
        return ground if centres is None else ground.near(centres, reach)

    def holds_map(self, width: float) -> bool:
        """Return whether the whole map has at most `MAX_BLOCKS` blocks for a ground width in metres."""
        return math.prod(self._grid(self.resolution(width))) <= MAX_BLOCKS

    def _grid(self, resolution: float) -> tuple[int, int]:
        """Return the columns and rows of the map's blocks."""
        side, (west, south, east, north) = _SIDE * resolution, self._map.bounds
        return max(math.ceil((east - west) / side), 1), max(math.ceil((north - south) / side), 1)

    def _block(self, row: int, column: int, resolution: float) -> Ground:
        level = round(math.log2(resolution / self._map.resolution))
        key = (self._digest, level, row, column)
        with _lock:
            if (held := in_memory.pop(key, None)) is not None:
                in_memory[key] = held
                return held
        file = self._folder / f"{level}_{row}_{column}.npz"
        try:
            with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as arrays:
                ground = Ground(arrays["points"], arrays["descriptors"], resolution)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # missing, or damaged
            ground = self._described(row, column, resolution)
            self._write(file, ground)
        with _lock:
            in_memory[key] = ground
            for oldest in list(in_memory)[: -2 * MAX_BLOCKS]:
                del in_memory[oldest]
        return ground

    def _described(self, row: int, column: int, resolution: float) -> Ground:
        west, north = self._map.bounds[0], self._map.bounds[3]
        x, y = west + (column + 0.5) * _SIDE * resolution, north - (row + 0.5) * _SIDE * resolution
        pixels = _SIDE + 2 * _MARGIN
        size = pixels * resolution
        picture, valid = self._map.read(Window(x, y, size), pixels)
        features = self.matcher.features(picture, valid, _LIMIT)
        easting = x - size / 2 + (features.points[:, 0] + 0.5) * resolution
        northing = y + size / 2 - (features.points[:, 1] + 0.5) * resolution
        ground = Ground(np.stack([easting, northing], axis=1).astype(np.float64), features.descriptors, resolution)
        return ground.near(np.array([[x, y]]), _SIDE * resolution / 2)

    def _write(self, file: Path, ground: Ground) -> None:
        if not self._is_writable:
            return
        data = io.BytesIO()
        np.savez(data, points=ground.points, descriptors=ground.descriptors)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, data.getvalue())
        except (OSError, OutputError) as error:
            self._is_writable = False  # so that the warning comes once
            log.warning(
                "Features of the map are not kept for the next run, as %s cannot be written (%s); set LPN_CACHE to a "
                "writable folder.",
                file.parent,
                getattr(error, "strerror", None) or error,
            )
