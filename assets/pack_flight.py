"""Makes `assets/demo-flight` from a rendered flight: `python -m assets.pack_flight FLIGHT OUT`.

FLIGHT is what `python -m tools.world --flight` made. OUT gets `flight-in-autumn`, `COUNT` photos in a row as WebP with their EXIF
and XMP, because neighbours in time correct each other; `map-in-spring`, the folder of the map with stronger compression;
`truth.csv` with the rows of these photos; and `flight_world.json`, which says that all of it is rendered.
"""

from __future__ import annotations

import csv
import io
import shutil
import sys
from pathlib import Path

import numpy as np
import rasterio
from PIL import Image

from lpn.core.demo import DEMO_FLIGHT
from lpn.core.files import write_atomic
from lpn.datasets.rendered import FLIGHT_PLAN, TRUTH, UNFINISHED
from lpn.flight.maps import MapOptions, MapPlace
from lpn.flight.maps.folder import build_map
from tools.world.flight import MAP
from tools.world.flight_files import geotiff

COUNT, FIRST = 40, 0.57
"""Photos that are packed, and where they begin as a share of the flight: shortly before the free path, a photo a second."""

QUALITY = {"photo": 68, "map": 70}
"""Quality of WebP and of the map's JPEG; leaves and sensor noise cost most, and matching needs them least."""

LARGEST = 3_500_000
"""Bytes of the whole folder."""


def main() -> None:
    """Choose, shrink, and check the size."""
    flight, out = (Path(argument) for argument in sys.argv[1:3])
    if out.exists():
        sys.exit(f"{out} is there already; delete it or choose another place.")
    if (flight / UNFINISHED).is_file():
        sys.exit(f"{flight} is not rendered to its end; the command that renders it goes on.")
    whole, out = out, out.with_name(out.name + ".part")
    shutil.rmtree(out, ignore_errors=True)
    pack(flight, out)
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    if size > LARGEST:
        sys.exit(f"{out} has {size:,} bytes, and it may have {LARGEST:,}; lower COUNT or QUALITY.")
    out.rename(whole)
    print(f"{whole} has {size:,} bytes.")


def pack(flight: Path, out: Path) -> None:
    """Write photos, map, and truth."""
    packed_map, photos = (path.name for path in DEMO_FLIGHT)
    with (flight / TRUTH).open(newline="") as file:
        header, *rows = csv.reader(file)
    begin = round(FIRST * len(rows))
    chosen = rows[begin : begin + COUNT]
    for row in chosen:
        name, row[0] = row[0], Path(row[0]).with_suffix(".webp").name
        write_atomic(out / photos / row[0], as_webp((flight / "photos" / name).read_bytes()))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *chosen])
    write_atomic(out / TRUTH, text.getvalue().encode())
    write_atomic(out / FLIGHT_PLAN, (flight / FLIGHT_PLAN).read_bytes())
    small = out / f"{packed_map}.tif"
    write_atomic(small, compressed_map(flight / MAP, QUALITY["map"]))
    borders = MapOptions(keep_borders=True)
    build_map([small], out / packed_map, borders, place=MapPlace(photographed="spring")).close()
    small.replace(out / packed_map / "sheets" / "01.tif")


def compressed_map(file: Path, quality: int) -> bytes:
    """Return a map's GeoTIFF with another quality of JPEG, 1 to 100."""
    with rasterio.open(file) as opened:
        return geotiff(np.moveaxis(opened.read(), 0, 2), opened.crs, opened.transform, quality)


def as_webp(data: bytes) -> bytes:
    """Encode a JPEG as WebP with its EXIF and XMP."""
    packed = io.BytesIO()
    with Image.open(io.BytesIO(data)) as picture:
        picture.save(
            packed, "WEBP", quality=QUALITY["photo"], method=6, exif=picture.info["exif"], xmp=picture.info["xmp"]
        )
    return packed.getvalue()


if __name__ == "__main__":
    main()
