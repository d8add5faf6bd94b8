"""A map from a flight's own photos: an orthophoto by pyOrthomosaic (the extra `maps`), in the folder of a map.

Photos are laid side by side as if the ground were a plane. Place, turn, and scale are fitted to the GPS tags, so an error that
all tags share is an error of the map. `place_error` estimates the error that they do not share.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.core.numbers import SIGMA, upper_bound
from lpn.core.requirements import missing_package
from lpn.flight.maps import _gdal
from lpn.flight.maps.elevation import ElevationFile
from lpn.flight.maps.folder import build_map, check_new
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map, MapPlace
from lpn.flight.maps.sheet import bounds_of
from lpn.flight.maps.sources import MapOptions

# Minimum of photos of a map, and maximum of names in a sentence.
_LEAST, _NAMED = 3, 5
# Groups of consecutive photos that are left out in turn, and the largest residual of a tag that counts, in metres or multiples
# of the median; the library has the same limits.
_BLOCKS, _FAR, _OUTLIER = 5, 9.0, 4.45
# The angle in radians that ends a leg; the error in metres that tags of one leg may share unseen; and the share of the photos
# above which one leg is nearly all of the flight.
_TURN, _SHARED, _MOST_OF_ONE_LEG = np.pi / 4, 5.0, 2 / 3
# The beginning of the note that GPS tags place a map.
_PLACING = "Place and scale are those of the GPS tags"
# Sentences of progress, by the beginnings of the library's log lines.
_STEPS = {
    "Extracting features": "Step 1 of 3: looking for points to match in {photos} photos.",
    "Matching": "Step 2 of 3: {line}.",
    "Aligned": "Step 3 of 3: laying {photos} photos over one another.",
    "rendered": "Step 3 of 3: {line} of the map.",
}


def build_from_photos(
    photos: Sequence[Path],
    tags: Float64Array,
    out: Path,
    on_progress: Callable[[str], None] = lambda _: None,
    elevation: ElevationFile | None = None,
    place: MapPlace | None = None,
    surveyed_error: float | None = None,
) -> Map:
    """Make an orthophoto of photos that look straight down, write it as the folder of a map, and return the map.

    Args:
        photos: files with GPS tags in their EXIF, in the order of the flight.
        tags: latitude and longitude of each in degrees, (N, 2); NaN without one.
        out: the folder, which must not exist; it appears when all is written.
        on_progress: called with a numbered sentence at each step.
        elevation: heights of the ground, copied into the folder in metres. The photos are still laid on a plane.
        place, surveyed_error: see `Map`.

    Raises:
        DataError: if fewer than three photos have GPS tags, or overlap, or the elevation is unusable or of another place.
        InputError: if the elevation's unit is unknown, or the place is malformed.
        OutputError: if `out` exists, or cannot be written.
        MissingPackageError: without the library.
    """
    check_new(out, surveyed_error)
    _library()
    _gdal.rasterio()
    _check_photos(photos, tags)
    if elevation is not None:
        # Heights of another place are refused before the long work.
        known = tags[~np.isnan(tags).any(axis=1)]
        frame = LocalFrame(*known.mean(axis=0).tolist())
        elevation.box(frame, bounds_of(frame.xy(*known.T)))
    with TemporaryDirectory(prefix=".", dir=out.parent) as folder:
        file = Path(folder) / f"{out.resolve().name}.tif"
        with _steps(len(photos), on_progress):
            report = lay_photos(photos, file)
        middles, known = middles_and_tags(report, photos, tags)
        error = place_error(middles, known)
        notes = [_limits(report["images_used"], middles, known, error)]
        if names := [printable(name) for name in report["images_dropped"]]:
            notes.insert(
                0,
                f"{len(names)} of {report['images_total']} photos overlap too little with the others, and are not in the map: "
                f"{first_few(names, _NAMED)}.",
            )
        options = MapOptions(keep_borders=True)
        return build_map([file], out, options, on_progress, elevation, place, error, surveyed_error, notes)


def _check_photos(photos: Sequence[Path], tags: Float64Array) -> None:
    if len(photos) < _LEAST:
        raise DataError(f"A map needs {_LEAST} photos at least, which overlap; found {len(photos)}.")
    twice = [name for name, count in Counter(photo.name for photo in photos).items() if count > 1]
    if twice:
        raise DataError(f"{printable(twice[0])} is the name of several photos; give each its own name.")
    without = [photo.name for photo, tag in zip(photos, tags, strict=True) if np.isnan(tag).any()]
    if len(photos) - len(without) < _LEAST:
        raise DataError(
            f"{len(without)} of {len(photos)} photos have no GPS tag, such as {printable(without[0])}; a map needs {_LEAST} with "
            "one, as place and scale come from the tags."
        )


def _library() -> Any:
    try:
        import orthomosaic
    except ModuleNotFoundError as error:
        raise missing_package(error) from error
    return orthomosaic


def lay_photos(photos: Sequence[Path], file: Path) -> dict[str, Any]:
    """Write an orthophoto, and return the library's report on it.

    Raises:
        DataError: if too few of the photos overlap, or have GPS tags that fit them.
        MissingPackageError: without the library.
    """
    library = _library()
    few = (
        f"Too few of the {len(photos)} photos overlap for a map; expected {_LEAST} or more that look straight down, each sharing "
        "half of its ground with the next."
    )
    try:
        report: dict[str, Any] = library.build_orthomosaic(
            [str(photo) for photo in photos],
            str(file),
            library.Options(preview=False, thermal="off", exposure_compensation=False),
        )
    except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
        raise DataError(f"{few} The library says: {printable(str(error))[:200]}.") from error
    except (OSError, Image.DecompressionBombError) as error:
        raise DataError(f"The photos cannot be made into a map ({printable(str(error))[:200]}); check them.") from error
    if report["images_used"] < _LEAST:
        raise DataError(few)
    if not report["georeferenced"]:
        raise DataError(
            "The GPS tags do not fit the photos, so the map has no place; expected photos of one flight, with their own tags."
        )
    return report


@contextmanager
def _steps(photos: int, on_progress: Callable[[str], None]) -> Iterator[None]:
    """Turn the library's log into sentences of progress while it works."""

    class Teller(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            line = record.getMessage().strip()
            for begin, sentence in _STEPS.items():
                if line.startswith(begin):
                    plain = line.partition(" (")[0].replace("/", " of ")
                    on_progress(sentence.format(photos=photos, line=plain[:1].lower() + plain[1:]))

    log, teller = logging.getLogger("orthomosaic"), Teller()
    level, log.propagate = log.level, False
    log.setLevel(logging.INFO)
    log.addHandler(teller)
    try:
        yield
    finally:
        log.removeHandler(teller)
        log.setLevel(level)
        log.propagate = True


def middles_and_tags(
    report: dict[str, Any], photos: Sequence[Path], tags: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the middles of the map's photos and their tags, (N, 2) each, in metres of its coordinate reference system."""
    middles, places = [], []
    for photo, tag in zip(photos, tags, strict=True):
        camera = report["cameras"].get(photo.name)
        if camera is None or np.isnan(tag).any():
            continue
        with Image.open(photo) as picture:
            width, height = picture.size
            if picture.getexif().get(274, 1) in (5, 6, 7, 8):
                width, height = height, width
        middles.append(np.array(camera["affine"]) @ [(width - 1) / 2, (height - 1) / 2, 1.0])
        places.append(tag)
    longitudes_first = np.array(places)[:, ::-1]
    return np.array(middles), _gdal.transform(_gdal.epsg(4326), _gdal.epsg(report["epsg"]), longitudes_first)


def place_error(middles: Float64Array, tags: Float64Array) -> float | None:
    """Return the 1-sigma error in metres along each axis of a map's places, from the scatter of the tags.

    A similarity from the middles to the tags is fitted again without each of five groups of consecutive photos. The error is
    the scatter of its places (block jackknife; Kuensch, 1989). Blocks keep together the errors that neighbouring tags share,
    as with a receiver that lags along a leg.

    The map may also bend. Residuals of neighbouring photos of two groups are then alike, and the mean of their products is the
    square of the error by bending. An error that all tags share stays unseen. So an error under 5 m, which the tags of one leg
    may share, is not returned where one leg has more than two thirds of the photos.

    Args:
        middles: of the photos on the map in the order of the flight, metres, (N, 2).
        tags: of the same photos, metres, (N, 2). Outliers do not count.

    Returns:
        The root mean square over the middles; None with fewer than five tags, for tags of one place, and for one leg as above.
    """
    residuals = np.hypot(*(tags - middles).T)
    kept = residuals <= max(_FAR, _OUTLIER * float(np.median(residuals)))
    z, w = ((places[kept] @ (1, 1j)) for places in (middles, tags))
    if len(z) < _BLOCKS:
        return None
    placed, blocks = [], np.array_split(np.arange(len(z)), _BLOCKS)
    for block in blocks:
        p, q = np.delete(z, block), np.delete(w, block)
        spread = (np.abs(p - p.mean()) ** 2).sum()
        if spread == 0:
            return None
        turn = (np.conj(p - p.mean()) * (q - q.mean())).sum() / spread
        placed.append(q.mean() + turn * (z - p.mean()))
    off = np.array(placed) - np.mean(placed, axis=0)
    moved = (_BLOCKS - 1) / _BLOCKS * (np.abs(off) ** 2).sum(axis=0).mean() / 2
    apart = np.abs(z[:, None] - z)
    for block in blocks:
        apart[np.ix_(block, block)] = np.inf
    residual = w - z
    bent = (residual * residual[apart.argmin(axis=1)].conj()).real.mean() / 2
    error = float(np.sqrt(moved + max(bent, 0.0)))
    steps = np.diff(w)
    turns = np.cumsum(np.abs(np.angle(steps[1:] * steps[:-1].conj())) > _TURN)
    of_one_leg = np.bincount(np.concatenate([[0], turns, turns[-1:]])).max() / len(w)
    return None if of_one_leg > _MOST_OF_ONE_LEG and error < _SHARED else error


def _limits(used: int, middles: Float64Array, tags: Float64Array, error: float | None) -> str:
    """State the metres from each photo's tag to its middle on the map, and the map's error."""
    off = np.hypot(*(middles - tags).T)
    open_places = (
        "The map's error is unknown, because the tags are too few, or nearly all of one leg."
        if error is None
        else f"By their scatter its places have an error of ± {error:.1f} m ({SIGMA})."
    )
    return (
        f"The map is made of {used} photos as if the ground were flat, so buildings and trees lean. {_PLACING}, which lie "
        f"{np.median(off):.1f} m from the photos' middles on it in the median, {upper_bound(float(off.max()))} m at most. "
        f"{open_places}"
    )


def placing_sentence(notes: Iterable[str]) -> str:
    """Return the sentence of a map's notes on the tags that place it; "" without one."""
    note = next((note for note in notes if _PLACING in note), "")
    return note[note.find(_PLACING) :]
