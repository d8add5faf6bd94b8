"""One raster as RGB and alpha of 8 bits each, cut by turned rectangles from any thread.

A VRT in memory turns the bands of a file into red, green, blue, and alpha: its sources stretch numbers, look up a palette, join
masks, and cut a border without data out of the alpha. Every map is read through it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.flight.maps import _gdal, vrt
from lpn.flight.maps.borders import BorderColour, border_region, find_borders, overview_size
from lpn.flight.maps.vrt import RasterSource, source_xml

# Percentiles of a band that become 0 and 255.
_PERCENTILES = (2.0, 98.0)
# Least alpha that counts as data where JPEG changed it.
_LOSSY_OPAQUE = 128
# An alpha band is odd if more than the share _VARIED of it lies farther than _CLEAR from both clear and opaque.
_VARIED, _CLEAR = 0.5, 0.05
_RGB = ("red", "green", "blue")
# Colour spaces that are not converted; GDAL converts CMYK, YCbCr, and Lab of most files itself.
_OTHER_COLOURS = {"hue": "HSL", "cyan": "CMYK", "Y": "YCbCr"}


class Treatment(msgspec.Struct, frozen=True):
    """The conversion of a file's bands to RGB and alpha; decided once, and recorded in map.json.

    Attributes:
        bands: numbers, from 1, of the bands shown as red, green, and blue; one number for grey or a palette.
        alpha: number of the alpha band. Values above 0 are data, as in GDAL's masks; in a JPEG, values from half of 255 on.
        stretch: for each of `bands`, the values that become 0 and 255; None for bands of 8 bits.
        border: colours that mean no data where they are connected to the border.
    """

    bands: tuple[int, ...]
    alpha: int | None = None
    stretch: tuple[tuple[float, float], ...] | None = None
    border: tuple[BorderColour, ...] = ()


class Raster:
    """The pixels of a sheet.

    Args:
        source: the file, tiles, or mask, as GDAL opens it.
        treatment: a recorded treatment; None decides one from the file.
        bands: numbers, from 1, of the bands to show, one or three; None takes the bands marked as colours.
        keep_borders: do not look for white and black borders.
        name: of the file in notes; by default its own.

    Attributes:
        path: the file, or the folder of tiles.
        width, height: in pixels.
        notes: sentences about how the file is read.
        treatment: the conversion of its bands to RGB and alpha.

    Raises:
        DataError: if it cannot be read, its numbers are complex, or it has no valid pixel.
        InputError: if it has no such bands.
    """

    def __init__(
        self,
        source: RasterSource,
        treatment: Treatment | None = None,
        bands: Sequence[int] | None = None,
        keep_borders: bool = False,
        name: str | None = None,
    ) -> None:
        self.source, self.path = source, source.path
        self._called = name or printable(self.path.name)
        self.notes: list[str] = list(source.notes)
        self._handles: deque[Any] = deque()
        with self._opened() as file:
            self.width, self.height = int(file.width), int(file.height)
            _gdal.check_work(file, self.path)
            self._paletted = file.colorinterp[0].name == "palette" and file.dtypes[0] in ("uint8", "uint16")
            self.treatment = self._bands(file, bands)
            if treatment is not None:
                self.treatment, self.notes = treatment, []
            chosen = self.treatment.bands
            stretch = self.treatment.stretch
            ranges_fit = stretch is None or (len(stretch) == len(chosen) and all(low < high for low, high in stretch))
            bands_fit = all(1 <= number <= file.count for number in (*chosen, self.treatment.alpha or 1))
            if len(chosen) not in (1, 3) or not bands_fit or not ranges_fit:
                raise DataError(
                    f"{self._name} has {file.count} bands, which do not fit the map's record of them; write the map again with "
                    "lpn map."
                )
            dtype = np.result_type(*(file.dtypes[number - 1] for number in chosen))
            if dtype.kind == "c":
                raise DataError(f"{self._name} holds complex numbers; expected a picture in grey or colour.")
            bits = file.tags(chosen[0], ns="IMAGE_STRUCTURE").get("NBITS", "")
            # GDAL gives bands of 1 to 7 bits as bytes.
            few = dtype == np.uint8 and bits in set("1234567")
            self._floats = dtype.kind == "f"
            self._deep = not self._paletted and (few or dtype != np.uint8)
            # JPEG smears alpha and nodata over several pixels.
            self._lossy = is_jpeg(file)
            kinds = _gdal.rasterio().enums.MaskFlags
            flags = {kind for number in chosen for kind in file.mask_flag_enums[number - 1]}
            self._nodata = kinds.nodata in flags
            self._masked = self._nodata or kinds.per_dataset in flags
            if treatment is None:
                if len(pages := file.subdatasets) > 1:
                    self.notes.append(f"{self._called} holds {len(pages)} pictures; the first is shown.")
                self.treatment = self._decided(file, f"{bits}-bit" if few else str(dtype), keep_borders)

    def cut(self, matrix: Float64Array, size: tuple[int, int], reduction: float) -> tuple[UInt8Array, BoolArray]:
        """Cut a picture bilinearly; average pixels where the picture is coarser than the raster.

        Args:
            matrix: (2, 3), from column and row of the picture to those of the raster; 0 is the corner of the first pixel.
            size: columns and rows of the picture.
            reduction: pixels of the raster on a side of one of the picture.

        Returns:
            RGB, (rows, columns, 3), and which pixels are valid, (rows, columns).

        Raises:
            DataError: if the file is damaged.
        """
        own = np.array([self.width, self.height])
        ends = np.array([(0, 0, 1), (size[0], 0, 1), (0, size[1], 1), (*size, 1)]) @ matrix.T
        margin = 2 * max(1.0, reduction)
        low = np.maximum(np.floor(ends.min(0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(ends.max(0) + margin), own).astype(int)
        columns, rows = size
        if (low >= high).any():
            return np.zeros((rows, columns, 3), np.uint8), np.zeros((rows, columns), bool)
        # Where the raster is finer, sample twice the pixels and average, against aliasing.
        finer = 2 if reduction > 1.01 else 1
        read = np.maximum(1, np.ceil((high - low) / max(1.0, reduction / finer))).astype(int)
        library = _gdal.rasterio()
        box, method = library.windows.Window(*low.tolist(), *(high - low).tolist()), library.enums.Resampling.average
        with self._handle() as file:
            values = file.read(window=box, out_shape=(4, read[1], read[0]), resampling=method)
        picture, valid = np.ascontiguousarray(np.moveaxis(values[:3], 0, 2)), values[3] > 127
        scale = read / (high - low)
        # OpenCV counts from the middle of the first pixel.
        turn = matrix[:, :2] * scale[:, None] / finer
        shift = (matrix[:, 2] - low) * scale + turn.sum(axis=1) / 2 - 0.5
        return _resampled(picture, valid, np.column_stack([turn, shift]), (columns, rows), finer)

    def files(self) -> list[Path]:
        """Return the files that the pixels are read from, overviews and masks included."""
        return self.source.files()

    def close(self) -> None:
        """Close the file's handles."""
        while self._handles:
            self._handles.pop().close()

    @property
    def _name(self) -> str:
        return printable(str(self.path))

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        with self.source.open() as file:
            try:
                yield file
            except _gdal.failures() as error:
                raise _gdal.damaged(self.path, error) from error

    @contextmanager
    def _handle(self) -> Iterator[Any]:
        """Lend a handle of the raster as RGB and alpha to one thread at a time."""
        try:
            try:
                handle = self._handles.pop()
            except IndexError:
                handle = _gdal.open_vrt(_gdal.in_memory(self._treated()).name)
            yield handle
        except _gdal.failures() as error:
            raise _gdal.damaged(self.path, error) from error
        self._handles.append(handle)

    def _treated(self) -> bytes:
        treatment, name, own = self.treatment, self.source.name, (self.width, self.height)
        box, method = (0, 0, *own), "nearest" if self._paletted else "average"

        def source(number: int, inner: str) -> str:
            return source_xml(name, number, own, box, inner, method)

        chosen = treatment.bands
        if self._paletted:
            colours = [source(chosen[0], vrt.palette(entry)) for entry in (1, 2, 3)]
        else:
            limits = (
                [""] * len(chosen) if treatment.stretch is None else [vrt.stretched(*two) for two in treatment.stretch]
            )
            colours = [source(one, limit) for one, limit in zip(chosen, limits, strict=True)]
        if treatment.alpha is not None:
            least = self._lossy_opaque if self._lossy else 1.0
            alpha = [source(treatment.alpha, f"<LUT>{least * 0.999}:0,{least}:255</LUT>" if self._lossy else vrt.SOME)]
        elif self._paletted:
            alpha = [source(chosen[0], vrt.palette(4) + vrt.SOME)]
        else:
            nan = "<NODATA>nan</NODATA>" if self._floats else ""
            masked = "<UseMaskBand>true</UseMaskBand>" if self._masked else ""
            alpha = [
                source(number, f"{masked}{vrt.OPAQUE}{nan}") for number in (chosen if self._nodata else chosen[:1])
            ]
        if treatment.border:
            cut = overview_size(*own)
            alpha.append(source_xml(self._cut_out.name, 1, cut, box, "<NODATA>255</NODATA>", "nearest"))
        return vrt.rgba_xml(own, [*([one] for one in (colours if len(colours) == 3 else colours * 3)), alpha])

    def _bands(self, file: Any, wanted: Sequence[int] | None) -> Treatment:
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

    def _decided(self, file: Any, numbers: str, keep_borders: bool) -> Treatment:
        chosen, deep = self.treatment, self._deep
        values = self._overview(file, chosen.bands)
        with self._handle() as handle:
            valid = self._overview(handle, (4,))[0] > 0
        # Some programs write an alpha band that is opaque everywhere, or a nodata value that no pixel has, and leave unknown
        # ground white.
        unclear = bool(valid.all()) or (self._lossy and self._nodata)
        look = unclear and not (keep_borders or (deep and self._nodata) or self._paletted)
        borders = find_borders(values, deep) if look else {}
        if self._nodata and borders and np.logical_or.reduce(list(borders.values())).all():
            borders = {}  # a dark picture, whose own nodata value says that it is none
        for colour, region in borders.items():
            self.notes.append(f"The {colour} border of {self._called} ({region.mean():.0%} of it) is taken as no data.")
            valid &= ~region
        if not valid.any():
            raise DataError(f"{self._called} has no valid pixel; expected a map.")
        if chosen.alpha is not None:
            opacity = self._overview(file, (chosen.alpha,))
            between = (opacity > _CLEAR * opacity.max()) & (opacity < (1 - _CLEAR) * opacity.max())
            if between.mean() > _VARIED:
                self.notes.append(
                    f"Band {chosen.alpha} of {self._called} is marked as alpha, and most of it is between clear and opaque; data "
                    "is where it is above 0. If it is another band, such as near infrared, mark it so (gdal_edit "
                    f"-colorinterp_{chosen.alpha} undefined)."
                )
        stretch = None
        if deep:
            limits = [np.percentile(band[valid].astype(np.float64), _PERCENTILES).tolist() for band in values]
            stretch = tuple((low, high if high > low else low + 1) for low, high in limits)
            ranges = ", ".join(f"{low:g} to {high:g}" for low, high in stretch)
            self.notes.append(
                f"{self._called} holds {numbers} numbers; the percentiles {_PERCENTILES[0]:g} and {_PERCENTILES[1]:g} of "
                f"each band ({ranges}) become 0 and 255."
            )
        self.close()  # handles of another treatment
        return Treatment(chosen.bands, chosen.alpha, stretch, tuple(borders))

    def _overview(self, file: Any, bands: Sequence[int]) -> AnyArray:
        """Read bands of the open source, (n, height, width), on the overview of `overview_size`."""
        methods = _gdal.rasterio().enums.Resampling
        columns, rows = overview_size(self.width, self.height)
        method = methods.nearest if self._paletted else methods.average
        return np.stack([file.read(number, out_shape=(rows, columns), resampling=method) for number in bands])

    @cached_property
    def _lossy_opaque(self) -> float:
        """The least opacity of data in a JPEG: half of the largest one, as some programs write alpha as 0 and 1."""
        assert self.treatment.alpha is not None
        with self._opened() as file:
            return min(_LOSSY_OPAQUE, float(self._overview(file, (self.treatment.alpha,)).max()) / 2 or 1.0)

    @cached_property
    def _cut_out(self) -> RasterSource:
        """The mask of the border at the size of the overview: 0 where there is no data, else 255."""
        with self._opened() as file:
            values = self._overview(file, self.treatment.bands)
        border = np.zeros(values.shape[1:], np.uint8)
        for colour in self.treatment.border:
            border |= border_region(values, colour, self._deep)
        # Pixels at the edge are mixed with the border's colour.
        return RasterSource.of_mask(
            np.where(cv2.dilate(border, np.ones((3, 3), np.uint8)) > 0, 0, 255).astype(np.uint8)
        )


def is_jpeg(file: Any) -> bool:
    """Return whether an open raster's pixels are compressed as JPEG."""
    return "JPEG" in file.tags(ns="IMAGE_STRUCTURE").get("COMPRESSION", "")


def _resampled(
    picture: UInt8Array, valid: BoolArray, matrix: Float64Array, size: tuple[int, int], finer: int
) -> tuple[UInt8Array, BoolArray]:
    """Sample a picture bilinearly by a matrix, (2, 3), and average `finer` by `finer` samples, invalid ones left out."""
    columns, rows = size

    def sampled(source: Any, border: int) -> Any:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        turned = cv2.warpAffine(source, matrix, (columns * finer, rows * finer), flags=flags, borderMode=border)
        return turned if finer == 1 else cv2.resize(turned, size, interpolation=cv2.INTER_AREA)

    shares = sampled(valid.astype(np.float32), cv2.BORDER_CONSTANT)
    if valid.all():
        return sampled(picture, cv2.BORDER_REPLICATE), shares >= 0.5
    weighted = sampled(picture.astype(np.float32) * valid[:, :, None], cv2.BORDER_REPLICATE)
    inside = sampled(valid.astype(np.float32), cv2.BORDER_REPLICATE)
    resampled = weighted / np.maximum(inside, 1e-6)[:, :, None]
    return np.clip(resampled.round(), 0, 255).astype(np.uint8), shares >= 0.5
