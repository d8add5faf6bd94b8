"""Maps with heights of AnyVisLoc's scenes and OrthoLoC's samples."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lpn.core import posed_samples
from lpn.core.arrays import AnyArray, Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import first_few, printable
from lpn.maps import _gdal
from lpn.maps.elevation import ElevationFile, ElevationSource
from lpn.maps.folder import build_map, write_own_map
from lpn.maps.map import Map
from lpn.maps.place import MapPlace, checked_place
from lpn.maps.sources import MapOptions

# A height may lie so many pixels off the grid that all heights of a sample tell.
_OFF_GRID = 0.05
_ROWS = 1024


def build_scene(
    path: Path,
    out: Path,
    options: MapOptions,
    on_progress: Callable[[str], None] = lambda _: None,
    place: MapPlace | None = None,
    elevation: ElevationFile | None = None,
) -> Map | None:
    """Write the folder of a map with heights of a scene of AnyVisLoc, one of its two maps, or a sample of OrthoLoC.

    A scene's folder stands for its aerial map. One of its maps with a place or heights beside it is a picture like others.

    Args:
        elevation: heights from elsewhere.

    Returns:
        The map; None if the path is none of these.

    Raises:
        DataError: if a file is missing or damaged.
        InputError: if the path is a sample of AnyVisLoc, which has no map, or one of OrthoLoC and options are given, or the place
            is malformed.
        OutputError: as `build_map`.
    """
    if place is not None:
        checked_place(place)  # before heights or pictures are written
    layout = posed_samples.layout_of(path)
    placed = elevation is not None or options.crs is not None or options.corners is not None
    if placed and (layout == "OrthoLoC" or (path.is_dir() and posed_samples.references(path))):
        raise InputError(
            f"{printable(str(path))} has its own place and heights; leave --crs, --corners, and --elevation out."
        )
    if layout == "OrthoLoC":
        if options != MapOptions():
            raise InputError(
                f"{printable(str(path))} has one orthophoto in colours, which says where it has no data; leave --bands and "
                "--keep-borders out."
            )
        return _of_sample(path, out, on_progress, place)
    if layout == "AnyVisLoc":
        raise InputError(
            f"{printable(str(path))} is a photo of AnyVisLoc; give its scene {printable(str(path.parent))} for the aerial map, "
            "or satellite_map.png there."
        )
    if placed:
        return None
    scene = path if path.is_dir() else path.parent
    known = posed_samples.references(scene) if scene.is_dir() else {}
    if path.is_dir():
        one = known.get("aerial", next(iter(known.values()), None))
    else:
        one = posed_samples.reference_of_map(path) if known else None
    if one is None:
        return None
    notes = [posed_samples.PLACE_NOTE.format("AnyVisLoc")]
    dsm = scene / one.dsm_path
    heights = posed_samples.read_heights(dsm)
    first = [a + b for a, b in zip(one.map_origin_local, one.dsm_origin_local, strict=True)]
    with TemporaryDirectory(prefix="lpn-heights-") as folder:
        file = Path(folder) / f"{dsm.stem}.tif"
        _write(file, heights[None], posed_samples.grid_matrix(one.dsm_resolution, first), "float32")
        own = ElevationFile(file, "metre")
        return build_map([scene / one.map_path], out, options, on_progress, own, notes, place)


def _of_sample(path: Path, out: Path, on_progress: Callable[[str], None], place: MapPlace | None) -> Map:
    """Write the map of a sample of OrthoLoC."""
    arrays = posed_samples.read_arrays(path, ("image_dop", "dsm", "scale"))
    picture, dsm = arrays["image_dop"], arrays["dsm"]
    if picture.dtype != np.uint8 or picture.shape != (*dsm.shape[:2], 3) or dsm.shape[2:] != (3,):
        raise DataError(
            f"{printable(str(path))} has an orthophoto of {picture.shape} {picture.dtype} and heights of {dsm.shape}; expected "
            "(H, W, 3) 8-bit numbers and (H, W, 3) places."
        )
    matrix = _grid(dsm.astype(np.float64), arrays["scale"], path)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(f"{printable(str(out))} is not empty; choose a new folder for the map of a sample.")
    out.mkdir(parents=True, exist_ok=True)
    heights = np.where(np.isfinite(dsm).all(axis=2), dsm[:, :, 2], np.nan).astype(np.float32)
    shown = picture.any(axis=2) | np.isfinite(heights)
    alpha = np.where(shown, 255, 0).astype(np.uint8)
    try:
        _write(out / "orthophoto.tif", np.moveaxis(np.dstack([picture, alpha]), 2, 0), matrix, "uint8")
        with TemporaryDirectory(prefix="lpn-heights-") as folder:
            file = Path(folder) / f"{path.stem}-dsm.tif"
            _write(file, heights[None], matrix, "float32")
            notes = [posed_samples.PLACE_NOTE.format("OrthoLoC")]
            return write_own_map(
                out / "orthophoto.tif", out, notes, on_progress, ElevationSource(ElevationFile(file, "metre")), place
            )
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise


def _grid(dsm: Float64Array, scale: AnyArray, path: Path) -> Float64Array:
    """Return the matrix of a grid of places (H, W, 3): x to the east along columns, y to the south along rows.

    Raises:
        DataError: if the places are on no such grid, or on one of another scale than the sample tells.
    """
    rows, columns = np.nonzero(np.isfinite(dsm[:, :, :2]).all(axis=2))
    steps, firsts = [], []
    for axis, cells in ((0, columns), (1, rows)):
        values = dsm[rows, columns, axis]
        if len(cells) < 2 or np.ptp(cells) == 0:
            raise DataError(f"{printable(str(path))} has too few places in dsm; download the sample again.")
        middle = cells.mean()
        centred = cells - middle
        step = float(centred @ values / (centred @ centred))
        first = float(values.mean() - step * middle)
        if step == 0 or np.abs(values - first - step * cells).max() > _OFF_GRID * abs(step) + 1e-3:
            raise DataError(
                f"The places of dsm in {printable(str(path))} are on no regular grid; expected those of an orthophoto's pixels."
            )
        steps.append(step)
        firsts.append(first)
    told = np.abs(np.asarray(scale, np.float64).ravel())
    if steps[0] < 0 or steps[1] > 0 or not np.allclose(told, np.abs(steps), rtol=0.01):
        raise DataError(
            f"{printable(str(path))} has steps of {steps[0]:g} and {steps[1]:g} m in dsm and a scale of "
            f"{first_few([f'{value:g}' for value in told], 2)}; expected x to grow along columns, y to fall along rows, and the "
            "same scale."
        )
    return posed_samples.grid_matrix((steps[0], -steps[1]), (firsts[0], -firsts[1]))


def _write(file: Path, bands: AnyArray, matrix: Float64Array, kind: str) -> None:
    """Write bands (B, H, W) as a tiled GeoTIFF of degrees."""
    library = _gdal.rasterio()
    count, height, width = bands.shape
    extra = {"photometric": "rgb", "alpha": "yes"} if count == 4 else {"nodata": np.nan}
    with library.open(
        file, "w", driver="GTiff", width=width, height=height, count=count, dtype=kind, crs="EPSG:4326",
        transform=library.Affine(*matrix.ravel()), tiled=True, compress="deflate", BIGTIFF="IF_SAFER", **extra,
    ) as written:  # fmt: skip
        for top in range(0, height, _ROWS):
            part = np.asarray(bands[:, top : top + _ROWS]).astype(kind)
            written.write(part, window=library.windows.Window(0, top, width, part.shape[1]))
