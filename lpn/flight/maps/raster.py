"""One raster as RGB and alpha of 8 bits each, cut by turned rectangles from any thread.

A VRT in memory turns the bands of a file into red, green, blue, and alpha. Its sources stretch numbers, look up a palette, join
masks, and cut a border without data out of the alpha. Every map is read through it. It names its file by
`vrt://FILE?if=DRIVER`, so that GDAL opens it by the driver that `_gdal.opened` chose.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.flight.maps import _gdal

# Percentiles of a band that become 0 and 255.
_PERCENTILES = (2.0, 98.0)
# Least alpha that counts as data where JPEG changed it.
_LOSSY_OPAQUE = 128
# An alpha band is odd if more than the share _VARIED of it lies farther than _CLEAR from both clear and opaque.
_VARIED, _CLEAR = 0.5, 0.05
# JPEG changes black and white by up to _NOISE; at least _CORE_SHARE of a border's pixels change by at most _CORE_NOISE.
_NOISE, _CORE_NOISE, _CORE_SHARE = 16, 2, 0.8
# Longest side of the overview on which borders and stretches are decided.
_OVERVIEW = 1024
# Smaller regions at the border, as a share of the overview, belong to the picture.
_MIN_SHARE = 1e-3
_RGB = ("red", "green", "blue")
# Colour spaces that are not converted; GDAL converts CMYK, YCbCr, and Lab of most files itself.
_OTHER_COLOURS = {"hue": "HSL", "cyan": "CMYK", "Y": "YCbCr"}
# Inner parts of a band's source: 255 wherever it has data, and 255 for every number above 0.
_OPAQUE = "<ScaleOffset>255</ScaleOffset><ScaleRatio>0</ScaleRatio>"
_SOME = "<LUT>0:0,1e-6:255</LUT>"
# Side above which a copy gets overviews; without them, GDAL averages the pixels, which is sharper.
_LARGE = 2048
# Creation options of the copy in a map's folder.
_COPY = {
    "COMPRESS": "ZSTD", "LEVEL": "3", "PREDICTOR": "YES", "BIGTIFF": "IF_SAFER", "OVERVIEW_RESAMPLING": "AVERAGE",
    "SPARSE_OK": "YES", "NUM_THREADS": "ALL_CPUS",
}  # fmt: skip


class Raster:
    """The pixels of a sheet.

    Values above 0 of an alpha band are data, as in GDAL's masks; in a JPEG, values from half of 255 on.

    Args:
        path: the file.
        bands: numbers, from 1, of the bands to show, one or three; None takes the bands marked as colours.
        keep_borders: do not look for white and black borders.
        name: of the file in notes; by default its own.
        decided: True for a file of RGB and alpha in a map's folder, which needs no decisions.

    Attributes:
        path: the file.
        width, height: in pixels.
        notes: sentences about how the file is read.
        shown: text of the decisions on its colours, for a digest.

    Raises:
        DataError: if it cannot be read, its numbers are complex, or it has no valid pixel.
        InputError: if it has no such bands.
    """

    def __init__(
        self,
        path: Path,
        bands: Sequence[int] | None = None,
        keep_borders: bool = False,
        name: str | None = None,
        decided: bool = False,
    ) -> None:
        self.path, self._called = path, name or printable(path.name)
        self.notes: list[str] = []
        self._handles: deque[Any] = deque()
        with _gdal.opened(path) as file:
            self.width, self.height = int(file.width), int(file.height)
            _gdal.check_work(file, path if name is None else Path(name))
            self._source = _gdal.vrt_name(path, file.driver)
            self._paletted = file.colorinterp[0].name == "palette" and file.dtypes[0] in ("uint8", "uint16")
            if len(pages := file.subdatasets) > 1:
                self.notes.append(f"{self._called} holds {len(pages)} pictures; the first is shown.")
            self._bands, self._alpha = self._chosen(file, bands)
            self._decide(file, keep_borders, decided)

    def cut(self, matrix: Float64Array, size: tuple[int, int], reduction: float) -> tuple[UInt8Array, BoolArray]:
        """Cut a picture bilinearly; average pixels where the picture is coarser than the raster.

        Args:
            matrix: (2, 3), from column and row of the picture to those of the raster; 0 is the corner of the first pixel.
            size: columns and rows of the picture.
            reduction: pixels of the raster along a side of one pixel of the picture.

        Returns:
            RGB, (rows, columns, 3), and the valid pixels, (rows, columns).

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

    def copy(self, out: Path, crs: Any, matrix: Float64Array) -> None:
        """Write the RGB and alpha as a tiled GeoTIFF, with overviews if it is large; `crs` and `matrix` are those of `Sheet`."""
        (a, b, c), (d, e, f) = matrix.tolist()
        place = f"<SRS>{escape(crs.to_wkt())}</SRS><GeoTransform>{c!r},{a!r},{b!r},{f!r},{d!r},{e!r}</GeoTransform>"
        library = _gdal.rasterio()
        with library.Env(), _gdal.open_vrt(self._vrt.replace(">", f">{place}", 1)) as file:
            overviews = "AUTO" if max(self.width, self.height) > _LARGE else "NONE"
            library.shutil.copy(file, str(out), driver="COG", OVERVIEWS=overviews, **_COPY)

    def files(self) -> list[Path]:
        """Return the files that the pixels are read from, overviews and masks included."""
        with _gdal.opened(self.path) as file:
            return sorted({Path(name) for name in file.files if not name.endswith(".aux.xml")})

    def close(self) -> None:
        """Close the file's handles."""
        while self._handles:
            self._handles.pop().close()

    @contextmanager
    def _handle(self) -> Iterator[Any]:
        """Lend a handle of the raster as RGB and alpha to one thread at a time."""
        try:
            try:
                handle = self._handles.pop()
            except IndexError:
                handle = _gdal.open_vrt(self._vrt)
            yield handle
        except _gdal.failures() as error:
            raise _gdal.damaged(self.path, error) from error
        self._handles.append(handle)

    def _chosen(self, file: Any, wanted: Sequence[int] | None) -> tuple[tuple[int, ...], int | None]:
        """Return the numbers, from 1, of the bands to show, one or three, and of the alpha band."""
        names = [meaning.name for meaning in file.colorinterp]
        marked = {name: number for number, name in enumerate(names, 1)}
        alpha = marked.get("alpha")
        if wanted is not None:
            if len(wanted) not in (1, 3) or not all(1 <= number <= file.count for number in wanted):
                raise InputError(
                    f"{printable(str(self.path))} has the bands 1 to {file.count}, and {', '.join(map(str, wanted))} cannot be "
                    "shown; give one of them, or three for red, green, and blue."
                )
            return tuple(wanted), alpha
        if other := next((space for name, space in _OTHER_COLOURS.items() if name in marked), None):
            raise DataError(f"{printable(str(self.path))} has the colours of {other}; convert it to RGB.")
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
        return chosen, alpha

    def _decide(self, file: Any, keep_borders: bool, decided: bool) -> None:
        """Decide how numbers become colours, and which of them are data."""
        kinds = _gdal.rasterio().enums.MaskFlags
        chosen, alpha = self._bands, self._alpha
        dtype = np.result_type(*(file.dtypes[number - 1] for number in chosen))
        if dtype.kind == "c":
            raise DataError(f"{printable(str(self.path))} holds complex numbers; expected a picture in grey or colour.")
        bits = file.tags(chosen[0], ns="IMAGE_STRUCTURE").get("NBITS", "")
        # GDAL gives bands of 1 to 7 bits as bytes.
        few = dtype == np.uint8 and bits in set("1234567")
        deep = not self._paletted and (few or dtype != np.uint8)
        # JPEG smears alpha and nodata over several pixels.
        lossy = "JPEG" in file.tags(ns="IMAGE_STRUCTURE").get("COMPRESSION", "")
        flags = {kind for number in chosen for kind in file.mask_flag_enums[number - 1]}
        nodata = kinds.nodata in flags
        if alpha is not None:
            data = [(alpha, _SOME)]
            if lossy:
                # Some programs write alpha as 0 and 1.
                least = min(_LOSSY_OPAQUE, float(self._overview(file, (alpha,)).max()) / 2 or 1.0)
                data = [(alpha, f"<LUT>{least * 0.999}:0,{least}:255</LUT>")]
        elif self._paletted:
            data = [(chosen[0], _component(4) + _SOME)]
        else:
            masked = "<UseMaskBand>true</UseMaskBand>" if nodata or kinds.per_dataset in flags else ""
            nan = "<NODATA>nan</NODATA>" if dtype.kind == "f" else ""
            data = [(number, f"{masked}{_OPAQUE}{nan}") for number in (chosen if nodata else chosen[:1])]
        self._vrt, self.shown = self._rgba(data, None), repr([chosen, alpha])
        if decided:
            return
        with _gdal.open_vrt(self._vrt) as handle:
            valid = self._overview(handle, (4,))[0] > 0
        # Some programs write an alpha band that is opaque everywhere, or a nodata value that no pixel has, and leave unknown
        # ground white.
        unclear = bool(valid.all()) or (lossy and nodata)
        look = unclear and not (keep_borders or (deep and nodata) or self._paletted)
        values: AnyArray = self._overview(file, chosen) if look or deep else np.zeros((0, 1, 1))
        borders = find_borders(values, deep) if look else {}
        if nodata and borders and np.logical_or.reduce(list(borders.values())).all():
            borders = {}  # the picture is dark all over, and has another nodata value
        for colour, region in borders.items():
            self.notes.append(f"The {colour} border of {self._called} ({region.mean():.0%} of it) is taken as no data.")
            valid &= ~region
        if not valid.any():
            raise DataError(f"{self._called} has no valid pixel; expected a map.")
        if alpha is not None:
            opacity = self._overview(file, (alpha,))
            between = (opacity > _CLEAR * opacity.max()) & (opacity < (1 - _CLEAR) * opacity.max())
            if between.mean() > _VARIED:
                self.notes.append(
                    f"Band {alpha} of {self._called} is marked as alpha, and most of it is between clear and opaque; data is "
                    "where it is above 0. If it is another band, such as near infrared, mark it so (gdal_edit "
                    f"-colorinterp_{alpha} undefined)."
                )
        limits = None
        if deep:
            ends = np.array([np.percentile(band[valid].astype(np.float64), _PERCENTILES) for band in values]).tolist()
            limits = [(low, high if high > low else low + 1) for low, high in ends]
            ranges = ", ".join(f"{low:g} to {high:g}" for low, high in limits)
            self.notes.append(
                f"{self._called} holds {f'{bits}-bit' if few else dtype} numbers; the percentiles {_PERCENTILES[0]:g} and "
                f"{_PERCENTILES[1]:g} of each band ({ranges}) become 0 and 255."
            )
        self._vrt = self._rgba(data, limits)
        self.shown = repr([chosen, alpha, limits, sorted(borders)])
        if borders:
            self._mask = _mask(np.logical_or.reduce(list(borders.values())))
            size = _overview_size(self.width, self.height)
            cut = _source(self._mask.name, 1, size, (self.width, self.height), "<NODATA>255</NODATA>", "nearest")
            self._vrt = self._vrt.replace("</VRTRasterBand></VRTDataset>", f"{cut}</VRTRasterBand></VRTDataset>")

    def _rgba(self, data: Sequence[tuple[int, str]], limits: Sequence[tuple[float, float]] | None) -> str:
        """Return the VRT of red, green, blue, and alpha.

        Args:
            data: number and inner part of the sources of alpha.
            limits: the values of each band that become 0 and 255; None for bands of 8 bits.
        """
        if self._paletted:
            colours = [(self._bands[0], _component(entry)) for entry in (1, 2, 3)]
        else:
            inner = [""] * len(self._bands) if limits is None else [_stretched(*two) for two in limits]
            colours = list(zip(self._bands, inner, strict=True))
        own, method = (self.width, self.height), "nearest" if self._paletted else "average"
        bands = [*([one] for one in (colours if len(colours) == 3 else colours * 3)), data]
        made = "".join(
            f'<VRTRasterBand dataType="Byte" band="{number}"><ColorInterp>{colour}</ColorInterp>'
            + "".join(_source(self._source, band, own, own, inner, method) for band, inner in sources)
            + "</VRTRasterBand>"
            for number, (colour, sources) in enumerate(zip((*_RGB, "alpha"), bands, strict=True), 1)
        )
        return f'<VRTDataset rasterXSize="{self.width}" rasterYSize="{self.height}">{made}</VRTDataset>'

    def _overview(self, file: Any, bands: Sequence[int]) -> AnyArray:
        """Read bands of the open file, (n, height, width), on the overview of `_overview_size`."""
        methods = _gdal.rasterio().enums.Resampling
        columns, rows = _overview_size(self.width, self.height)
        method = methods.nearest if self._paletted else methods.average
        return np.stack([file.read(number, out_shape=(rows, columns), resampling=method) for number in bands])


def find_borders(values: AnyArray, deep: bool) -> dict[str, BoolArray]:
    """Find white and black that is connected to the border.

    Args:
        values: an overview, (bands, height, width).
        deep: True if the numbers are not bytes; black is then 0 and below, and there is no white.

    Returns:
        The regions of the colours that have one, (height, width).
    """
    noises = (0, 0) if deep else (_NOISE, _CORE_NOISE)
    regions = {}
    for colour in ("black",) if deep else ("white", "black"):
        like, core = (values.max(0) <= n if colour == "black" else values.min(0) >= 255 - n for n in noises)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(like.astype(np.uint8), connectivity=4)
        edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        chosen = np.zeros(count, bool)
        chosen[edge] = True
        chosen[0] = False
        area = stats[:, cv2.CC_STAT_AREA]
        # Dark water is not uniform as a border is.
        uniform = np.bincount(labels.ravel(), core.ravel(), count) >= _CORE_SHARE * area
        region: BoolArray = (chosen & (area >= _MIN_SHARE * labels.size) & uniform)[labels]
        if region.any():
            regions[colour] = region
    return regions


def _overview_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height of the overview on which borders and stretches are decided."""
    factor = max(1.0, max(width, height) / _OVERVIEW)
    return max(1, round(width / factor)), max(1, round(height / factor))


def _mask(border: BoolArray) -> Any:
    """Return a file in memory that is 0 in a border and at its edge, whose pixels are mixed with its colour, else 255."""
    memory = _gdal.rasterio().MemoryFile(ext=".tif")
    shape = {"width": border.shape[1], "height": border.shape[0], "count": 1, "dtype": "uint8"}
    with _gdal.quietly(), memory.open(driver="GTiff", **shape) as file:
        file.write(np.where(cv2.dilate(border.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0, 0, 255), 1)
    return memory


def _source(
    name: str, band: int, size: tuple[int, int], whole: tuple[int, int], inner: str = "", resampling: str = "average"
) -> str:
    """Return the XML of a band's source, `size` in pixels, that fills a band of `whole` pixels.

    Args:
        inner: further elements, see `_OPAQUE`, `_stretched`, `_component`.
        resampling: GDAL's method of reduction.
    """
    return (
        f'<ComplexSource resampling="{resampling}"><SourceFilename relativeToVRT="0" shared="0">{escape(name)}</SourceFilename>'
        f'<SourceBand>{band}</SourceBand><SrcRect xOff="0" yOff="0" xSize="{size[0]}" ySize="{size[1]}"/>'
        f'<DstRect xOff="0" yOff="0" xSize="{whole[0]}" ySize="{whole[1]}"/>{inner}</ComplexSource>'
    )


def _stretched(low: float, high: float) -> str:
    """Return the inner part of a source whose values from `low` to `high` become 0 to 255."""
    ratio = 255 / (high - low)
    return f"<ScaleOffset>{-low * ratio!r}</ScaleOffset><ScaleRatio>{ratio!r}</ScaleRatio>"


def _component(entry: int) -> str:
    """Return the inner part of a source that shows an entry of its palette: 1 to 4 for red, green, blue, and alpha."""
    return f"<ColorTableComponent>{entry}</ColorTableComponent>"


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
