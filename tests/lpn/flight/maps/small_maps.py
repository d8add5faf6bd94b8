"""Small georeferenced files for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.core.arrays import AnyArray, Float64Array, UInt8Array
from lpn.core.errors import DataError, LPNError
from lpn.flight.maps import MapOptions, open_map

# UTM zone 32 at 48 degrees north, a place of no meaning.
EAST, NORTH = 500_000.0, 5_316_000.0


def smooth(height: int, width: int, seed: int = 0) -> UInt8Array:
    """A picture of slow waves, (height, width, 3), without black or white."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    waves = [rng.uniform(0.02, 0.06) * columns + rng.uniform(0.02, 0.06) * rows + rng.uniform(0, 6) for _ in range(3)]
    return np.stack([(128 + 80 * np.sin(wave)).astype(np.uint8) for wave in waves], axis=2)


def write_geotiff(
    path: Path,
    values: AnyArray,
    crs: str | None = "EPSG:32632",
    matrix: tuple[float, ...] | None = (0.5, 0, EAST, 0, -0.5, NORTH),
    **options: Any,
) -> Path:
    """Write (height, width, bands) values with a transform from columns and rows to coordinates."""
    import rasterio

    profile = {"driver": "GTiff", "height": values.shape[0], "width": values.shape[1], "count": values.shape[2]}
    if crs is not None:
        profile["crs"] = crs
    if matrix is not None:
        profile["transform"] = rasterio.Affine(*matrix)
    with rasterio.open(path, "w", dtype=values.dtype, **profile, **options) as file:
        file.write(np.moveaxis(values, 2, 0))
    return path


def refused(path: Path | list[Path], *words: str, error: type[LPNError] = DataError, **options: Any) -> None:
    """Check that files are refused as a map by one sentence with these words."""
    with pytest.raises(error, match=r"^[^\n]*\.$") as caught:
        open_map(path, MapOptions(**options))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def at(picture: AnyArray, cells: Float64Array) -> Float64Array:
    """Sample a picture bilinearly at columns and rows, (N, 2), in NumPy alone; 0, 0 is the corner of the first pixel."""
    column, row = cells[:, 0] - 0.5, cells[:, 1] - 0.5
    c, r = np.floor(column).astype(int), np.floor(row).astype(int)
    a, b = (column - c)[:, None], (row - r)[:, None]
    values = picture.astype(np.float64)
    upper = values[r, c] * (1 - a) + values[r, c + 1] * a
    lower = values[r + 1, c] * (1 - a) + values[r + 1, c + 1] * a
    return np.asarray(upper * (1 - b) + lower * b)
