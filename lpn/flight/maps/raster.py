"""One raster file as RGB with a mask, read by rectangles at any reduction from any thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import msgspec
import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.flight.maps import _gdal
from lpn.flight.maps.borders import BorderColour, Borders, PixelBox, border_note, find_borders, overview_size

# Percentiles of a band that become 0 and 255.
_PERCENTILES = (2.0, 98.0)
# Least alpha that is data where JPEG changed it.
_LOSSY_OPAQUE = 128
# An alpha band is odd where more than this share of it is further than that from clear and from opaque.
_VARIED, _CLEAR = 0.5, 0.05
# Entries of a palette by the type of its band.
_PALETTES = {"uint8": 1 << 8, "uint16": 1 << 16}
_RGB = ("red", "green", "blue")
# Colour spaces that are not converted; GDAL converts CMYK, YCbCr, and Lab of most files itself.
_OTHER_COLOURS = {"hue": "HSL", "cyan": "CMYK", "Y": "YCbCr"}


class Raster(Protocol):
    """A source of pixels of a sheet: RGB and a mask of a rectangle.

    Attributes:
        path: the file or folder.
        width, height: in pixels.
        notes: sentences about how the file is read.
    """

    path: Path
    width: int
    height: int
    notes: list[str]

    @property
    def treatment(self) -> Treatment | None:
        """How bands become RGB and a mask; None for tiles without a border."""
        ...

    def files(self) -> list[Path]:
        """Return the files that the pixels are read from."""
        ...

    def read(self, box: PixelBox, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """Read a rectangle, reduced by area averages.

        Args:
            box: first column and row, columns and rows; it lies within the raster.
            size: width and height of the result, at most those of the box.

        Returns:
            RGB, (height, width, 3), and which pixels are valid, (height, width).

        Raises:
            DataError: if the file is damaged.
        """
        ...

    def close(self) -> None:
        """Close the file's handles."""
        ...


class Treatment(msgspec.Struct, frozen=True):
    """How the bands of a file become RGB and a mask; decided once, and recorded in map.json.

    Attributes:
        bands: numbers, from 1, of the bands shown as red, green, and blue; one number for grey or a palette.
        alpha: number of the alpha band; 0 is no data, and any value above it is data, as in GDAL's own masks (half of 255 in
            a JPEG).
        stretch: for each of `bands`, the values that become 0 and 255; None for bands of 8 bits.
        border: colours that mean no data where they are connected to the border.
    """

    bands: tuple[int, ...]
    alpha: int | None = None
    stretch: tuple[tuple[float, float], ...] | None = None
    border: tuple[BorderColour, ...] = ()


class GdalRaster:
    """A raster file that GDAL reads.

    Args:
        path: the file.
        treatment: a recorded treatment; None decides one from the file.
        bands: numbers, from 1, of the bands to show, one or three; None takes those marked as colours.
        keep_borders: do not look for white and black borders.
        name: of the file in notes; by default its own.
        overviews: a TIFF of the file's overviews that lies elsewhere.

    Raises:
        DataError: if it cannot be read, its numbers are complex, or it has no valid pixel.
        InputError: if it has no such bands.
    """

    def __init__(
        self,
        path: Path,
        treatment: Treatment | None = None,
        bands: Sequence[int] | None = None,
        keep_borders: bool = False,
        name: str | None = None,
        overviews: Path | None = None,
    ) -> None:
        self.path, self.overviews = path, overviews
        self._called = name or path.name
        self.notes: list[str] = []
        self._handles: deque[Any] = deque()
        self._lock = Lock()
        with self._handle() as file:
            self.width, self.height = int(file.width), int(file.height)
            _gdal.check_work(file, self.path)
            self._palette = _palette(file)
            self.treatment = self._bands(file, bands)
            if treatment is not None:
                self.treatment, self.notes = treatment, []
            chosen = self.treatment.bands
            if not chosen or not all(1 <= number <= file.count for number in (*chosen, self.treatment.alpha or 1)):
                raise DataError(
                    f"{self._name} has {file.count} bands, fewer than before; write the map again with lpn map."
                )
            self._dtype = np.result_type(*(file.dtypes[number - 1] for number in chosen))
            self._same_types = len({file.dtypes[number - 1] for number in chosen}) == 1
            bits = file.tags(chosen[0], ns="IMAGE_STRUCTURE").get("NBITS", "")
            # GDAL gives bands of 1 to 7 bits as bytes.
            few = self._dtype == np.uint8 and bits in set("1234567")
            self._numbers = f"{bits}-bit" if few else str(self._dtype)
            self._deep = self._palette is None and (few or self._dtype != np.uint8)
            if treatment is None and len(pages := file.subdatasets) > 1:
                self.notes.append(f"{self._called} holds {len(pages)} pictures; the first is shown.")
            # JPEG smears alpha and nodata over several pixels.
            self._lossy = is_jpeg(file)
            kinds = _gdal.rasterio().enums.MaskFlags
            of_bands = file.mask_flag_enums
            flags = {kind for number in chosen for kind in of_bands[number - 1]}
            self._has_nodata = kinds.nodata in flags
            # Where there is an alpha band, GDAL's mask of the whole file is that band, and nodata only fills what it hides.
            masks = {kinds.per_dataset} if self.treatment.alpha else {kinds.per_dataset, kinds.nodata}
            self._masked = bool(flags & masks) and kinds.alpha not in flags
        if self._dtype.kind == "c":
            raise DataError(f"{self._name} holds complex numbers; expected a picture in grey or colour.")
        if treatment is None:
            self.treatment = self._decided(self.treatment, keep_borders)

    def read(self, box: PixelBox, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """See `Raster.read`."""
        values, valid = self._values(box, size)
        if self.treatment.border:
            valid = valid & ~self._borders.within(values, box, size)
        return self._rgb(values), valid

    def files(self) -> list[Path]:
        """See `Raster.files`: the file, overviews, and masks."""
        with _gdal.opened(self.path) as file:
            files = {Path(name) for name in file.files if not name.endswith(".aux.xml")}
        return sorted(files if self.overviews is None else files | {self.overviews})

    def close(self) -> None:
        """Close the file's handles."""
        while self._handles:
            self._handles.pop().close()

    @property
    def _name(self) -> str:
        return printable(str(self.path))

    @contextmanager
    def _handle(self) -> Iterator[Any]:
        """Lend a handle of the file, which only one thread may use at a time."""
        try:
            handle = self._handles.pop()
        except IndexError:
            handle = _gdal.open_raster(self.path, self.overviews)
        try:
            yield handle
        except _gdal.failures() as error:
            raise _gdal.damaged(self.path, error) from error
        finally:
            self._handles.append(handle)

    def _bands(self, file: Any, wanted: Sequence[int] | None) -> Treatment:
        """Choose the bands to show."""
        names = [meaning.name for meaning in file.colorinterp]
        marked = {name: number for number, name in enumerate(names, 1)}
        alpha = marked.get("alpha")
        if wanted is not None:
            if len(wanted) not in (1, 3) or not all(1 <= number <= file.count for number in wanted):
                raise InputError(
                    f"{self._name} has the bands 1 to {file.count}, and {', '.join(map(str, wanted))} cannot be shown; give "
                    "one of them, or three for red, green, and blue."
                )
            return Treatment(tuple(wanted), alpha)
        if other := next((space for name, space in _OTHER_COLOURS.items() if name in marked), None):
            raise DataError(f"{self._name} has the colours of {other}; convert it to RGB.")
        described = {(text or "").strip().lower(): number for number, text in enumerate(file.descriptions, 1)}
        colours = next((bands for names in (marked, described) if all(bands := [names.get(c) for c in _RGB])), None)
        if colours:
            chosen = tuple(number for number in colours if number)
        else:
            others = [number for number in range(1, file.count + 1) if number != alpha]
            chosen = tuple(others[:3] if len(others) >= 3 else others[:1])
        if len(chosen) + (alpha is not None) < file.count:
            self.notes.append(
                f"{self._called} has {file.count} bands; {', '.join(map(str, chosen))} "
                f"{'are shown as red, green, and blue' if len(chosen) == 3 else 'is shown as grey'}."
            )
        return Treatment(chosen, alpha)

    def _decided(self, chosen: Treatment, keep_borders: bool) -> Treatment:
        """Decide stretch and borders on an overview."""
        self.treatment = chosen
        deep = self._deep
        values, valid = self._overview()
        # Some programs write an alpha band that is opaque everywhere, or a nodata value that no pixel has, and white where
        # nothing is known.
        unclear = bool(valid.all()) or (self._lossy and self._has_nodata)
        look = unclear and not (keep_borders or (deep and self._has_nodata) or self._palette is not None)
        borders = find_borders(values, deep) if look else {}
        if self._has_nodata and borders and np.logical_or.reduce(list(borders.values())).all():
            borders = {}  # a dark picture, whose own nodata value says that it is none
        for colour, region in borders.items():
            self.notes.append(border_note(colour, self._called, region))
            valid = valid & ~region
        if not valid.any():
            raise DataError(f"{self._called} has no valid pixel; expected a map.")
        if chosen.alpha is not None and self._varied(chosen.alpha):
            self.notes.append(
                f"Band {chosen.alpha} of {self._called} is marked as alpha, and most of it is between clear and opaque; data is "
                "where it is above 0. If it is another band, such as near infrared, mark it so (gdal_edit "
                f"-colorinterp_{chosen.alpha} undefined)."
            )
        stretch = None
        if deep:
            limits = [np.percentile(band[valid].astype(np.float64), _PERCENTILES).tolist() for band in values]
            stretch = tuple((low, high if high > low else low + 1) for low, high in limits)
            ranges = ", ".join(f"{low:g} to {high:g}" for low, high in stretch)
            self.notes.append(
                f"{self._called} holds {self._numbers} numbers; the percentiles {_PERCENTILES[0]:g} and {_PERCENTILES[1]:g} of "
                f"each band ({ranges}) become 0 and 255."
            )
        return Treatment(chosen.bands, chosen.alpha, stretch, tuple(borders))

    @cached_property
    def _lossy_opaque(self) -> float:
        """The least opacity of data in a JPEG: half of the largest one, which is 1 where programs write 0 and 1."""
        columns, rows = overview_size(self.width, self.height)
        with self._handle() as file:
            return min(
                _LOSSY_OPAQUE, float(file.read(self.treatment.alpha, out_shape=(rows, columns)).max()) / 2 or 1.0
            )

    def _varied(self, band: int) -> bool:
        """Return whether most values of a band lie well between 0 and its largest one."""
        columns, rows = overview_size(self.width, self.height)
        with self._handle() as file:
            values = file.read(band, out_shape=(rows, columns))
        between = (values > _CLEAR * values.max()) & (values < (1 - _CLEAR) * values.max())
        return bool(between.mean() > _VARIED)

    def _overview(self) -> tuple[AnyArray, BoolArray]:
        return self._values((0, 0, self.width, self.height), overview_size(self.width, self.height))

    def _values(self, box: PixelBox, size: tuple[int, int]) -> tuple[AnyArray, BoolArray]:
        """Read the chosen bands, (n, height, width), and which pixels the file itself says are valid, (height, width)."""
        library = _gdal.rasterio()
        methods = library.enums.Resampling
        reduced = size != box[2:] and self._palette is None  # the mean of two palette entries is another colour
        options = {
            "window": library.windows.Window(*box),
            "resampling": methods.average if reduced else methods.nearest,
        }
        chosen, alpha = list(self.treatment.bands), self.treatment.alpha
        shape = size[1], size[0]
        valid = np.ones(shape, bool)
        with self._handle() as file:
            if self._same_types:
                values = file.read(chosen, out_shape=(len(chosen), *shape), **options)
            else:
                values = np.stack([file.read(number, out_shape=shape, **options) for number in chosen])
            if alpha is not None:
                opacity = file.read(alpha, out_shape=shape, **options)
                valid &= opacity >= self._lossy_opaque if self._lossy else opacity > 0
            if self._masked:
                valid &= (file.read_masks(chosen, out_shape=(len(chosen), *shape), **options) > 0).any(axis=0)
        if self._palette is not None:
            valid &= self._palette[values[0], 3] > 0
        if values.dtype.kind == "f":
            valid &= np.isfinite(values).all(axis=0)
        return values, valid

    def _rgb(self, values: AnyArray) -> UInt8Array:
        """Return the chosen bands as RGB, (height, width, 3)."""
        if self._palette is not None:
            colours: UInt8Array = self._palette[values[0], :3]
            return colours
        if self.treatment.stretch is not None:
            low, high = np.array(self.treatment.stretch).T[:, :, None, None]
            with np.errstate(invalid="ignore"):
                scaled = (values.astype(np.float32) - low) * (255 / (high - low))
            values = np.clip(np.nan_to_num(scaled), 0, 255).round().astype(np.uint8)
        if len(values) == 1:
            values = np.broadcast_to(values, (3, *values.shape[1:]))
        return np.ascontiguousarray(np.moveaxis(values, 0, 2))

    @cached_property
    def _borders(self) -> Borders:
        with self._lock:
            return Borders(self._overview()[0], self.treatment.border, (self.width, self.height), self._deep)


def is_jpeg(file: Any) -> bool:
    """Return whether an open raster's pixels are compressed as JPEG."""
    return "JPEG" in file.tags(ns="IMAGE_STRUCTURE").get("COMPRESSION", "")


def _palette(file: Any) -> UInt8Array | None:
    """Return the colours of a paletted file with their alpha, (256 or 65536, 4); None if it has none."""
    if file.colorinterp[0].name != "palette" or file.dtypes[0] not in _PALETTES:
        return None
    colours = np.zeros((_PALETTES[file.dtypes[0]], 4), np.uint8)
    colours[:, 3] = 255
    for number, colour in file.colormap(1).items():
        colours[number] = colour
    return colours
