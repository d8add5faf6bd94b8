"""Virtual rasters (VRT) in memory: a file, a folder of tiles, or a mask as a source of RGB and alpha.

A VRT names its sources by `vrt://FILE?if=DRIVER`, so that GDAL opens each by the driver that the checks of `_gdal` chose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from lpn.core.arrays import UInt8Array
from lpn.flight.maps import _gdal

# Inner parts of a band's source: 255 wherever it has data, and 255 for every number above 0.
OPAQUE = "<ScaleOffset>255</ScaleOffset><ScaleRatio>0</ScaleRatio>"
SOME = "<LUT>0:0,1e-6:255</LUT>"


@dataclass(frozen=True, eq=False)
class RasterSource:
    """A raster as GDAL opens it.

    Attributes:
        path: the file, or the folder of tiles.
        name: its name in a VRT.
        open: opens it alone.
        files: returns the files that it is read from.
        notes: sentences about how it is read.
        overviews: a separate file of its overviews, if there is one.
        memory: keeps the in-memory file that `name` refers to alive, if there is one.
    """

    path: Path
    name: str
    open: Callable[[], Any]
    files: Callable[[], list[Path]]
    notes: Sequence[str] = ()
    overviews: Path | None = None
    memory: Any = None

    @classmethod
    def of_file(cls, path: Path, overviews: Path | None = None) -> RasterSource:
        """Return the source of a user's raster file.

        Raises:
            DataError: see `_gdal.open_raster`.
        """

        def files() -> list[Path]:
            with _gdal.opened(path) as file:
                named = {Path(name) for name in file.files if not name.endswith(".aux.xml")}
            return sorted(named if overviews is None else named | {overviews})

        with _gdal.open_raster(path) as file:
            if overviews is None:
                return cls(path, _gdal.vrt_name(file.name, file.driver), lambda: _gdal.open_raster(path), files)
            memory = _gdal.in_memory(_gdal.with_overviews(_gdal.vrt_of(file), overviews))
        return cls(path, memory.name, lambda: _gdal.open_vrt(memory.name), files, overviews=overviews, memory=memory)

    @classmethod
    def of_mask(cls, mask: UInt8Array) -> RasterSource:
        """Return the source of a mask, (height, width), of one band."""
        library = _gdal.rasterio()
        memory = library.MemoryFile(ext=".tif")
        shape = {"width": mask.shape[1], "height": mask.shape[0], "count": 1, "dtype": "uint8"}
        with _gdal.quietly(), memory.open(driver="GTiff", **shape) as file:
            file.write(mask, 1)
        return cls(Path(memory.name), memory.name, lambda: memory.open(driver="GTiff"), list, memory=memory)


def source_xml(
    name: str,
    band: int,
    size: tuple[int, int],
    box: tuple[float, float, float, float],
    inner: str = "",
    resampling: str = "average",
) -> str:
    """Return the XML of a band's source.

    Args:
        name: of the source, see `RasterSource`.
        band: its number, from 1.
        size: columns and rows of the source.
        box: its rectangle in the band: first column and row, columns and rows.
        inner: further elements, see `OPAQUE`, `stretched`, `palette`.
        resampling: GDAL's method of reduction.
    """
    return (
        f'<ComplexSource resampling="{resampling}"><SourceFilename relativeToVRT="0" shared="0">{escape(name)}</SourceFilename>'
        f'<SourceBand>{band}</SourceBand><SrcRect xOff="0" yOff="0" xSize="{size[0]}" ySize="{size[1]}"/>'
        f'<DstRect xOff="{box[0]!r}" yOff="{box[1]!r}" xSize="{box[2]!r}" ySize="{box[3]!r}"/>{inner}</ComplexSource>'
    )


def stretched(low: float, high: float) -> str:
    """Return the inner part of a source whose values from `low` to `high` become 0 to 255."""
    ratio = 255 / (high - low)
    return f"<ScaleOffset>{-low * ratio!r}</ScaleOffset><ScaleRatio>{ratio!r}</ScaleRatio>"


def palette(entry: int) -> str:
    """Return the inner part of a source that shows an entry of its palette: 1 to 4 for red, green, blue, and alpha."""
    return f"<ColorTableComponent>{entry}</ColorTableComponent>"


def rgba_xml(size: tuple[int, int], bands: Sequence[Sequence[str]]) -> bytes:
    """Return a VRT of the sources of red, green, blue, and alpha."""
    made = "".join(
        f'<VRTRasterBand dataType="Byte" band="{number}"><ColorInterp>{colour}</ColorInterp>{"".join(sources)}</VRTRasterBand>'
        for number, (colour, sources) in enumerate(zip(("Red", "Green", "Blue", "Alpha"), bands, strict=True), 1)
    )
    return f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{made}</VRTDataset>'.encode()
