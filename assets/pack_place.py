"""Makes `assets/demo-place` from a real flight: `python assets/pack_place.py PHOTOS LICENCE OUT`.

PHOTOS is the folder of the flight's photos, LICENCE the file of their licence. OUT gets `caliterra-odd`, the folder that
`lpn map --from-flight` makes of the odd photos (the first, third, ...), at `PIXEL` metres; `caliterra-even`, the others as WebP
with the EXIF that places them; and the licence.
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rasterio
from msgspec.structs import replace
from PIL import ExifTags, Image
from rasterio.enums import Resampling
from rasterio.io import MemoryFile

from lpn.core.demo import DEMO_PLACE
from lpn.core.files import write_atomic
from lpn.flight.commands.map import MapCommand
from lpn.flight.maps import MapOptions, MapPlace, _gdal, open_map
from lpn.flight.maps.folder import build_map

PIXEL, WIDTH = 0.105, 800
"""Metres of the map's pixels, and pixels across a photo."""

PLACE = MapPlace(
    name="Caliterra in Dripping Springs, Texas",
    credit="Dennis Baldwin, CC0 1.0",
    source="https://github.com/OpenDroneMap/odm_data_caliterra",
)
"""The place, by the title that its photos are published under."""

SHEET = "sheets/01.tif"
"""The pixels of a map of one sheet in its folder."""
QUALITY = {"photo": 66, "map": 70}
"""Quality of WebP."""

LARGEST = 1_000_000
"""Bytes of the whole folder, without the model's answers."""


def main() -> None:
    """Make the map, shrink, and check the size."""
    photos, licence, out = (Path(argument) for argument in sys.argv[1:4])
    if out.exists():
        sys.exit(f"{out} is there already; delete it or choose another place.")
    files = sorted(file for file in photos.iterdir() if file.suffix.lower() == ".jpg")
    with TemporaryDirectory(dir=out.parent) as folder:
        part = Path(folder) / "part"
        MapCommand((), Path(folder) / "map", from_flight=tuple(files[::2])).run()
        map_name, photos_name = (path.name for path in DEMO_PLACE)
        large = open_map(Path(folder) / "map")
        file = part / f"{map_name}.tif"
        write_atomic(file, small_map(Path(folder) / "map" / SHEET))
        place = replace(PLACE, photographed=large.place.photographed)
        borders = MapOptions(keep_borders=True)
        build_map([file], part / map_name, borders, place=place, error=large.error, notes=large.notes).close()
        file.replace(part / map_name / SHEET)
        for file in files[1::2]:
            write_atomic(part / photos_name / f"{file.stem}.webp", small_photo(file))
        shutil.copyfile(licence, part / licence.name)
        size = sum(file.stat().st_size for file in part.rglob("*") if file.is_file())
        if size > LARGEST:
            sys.exit(f"{out} has {size:,} bytes, and it may have {LARGEST:,}; lower WIDTH or QUALITY.")
        part.rename(out)
    print(f"{out} has {size:,} bytes.")


def small_photo(file: Path) -> bytes:
    """Encode a photo as WebP with its EXIF, without the camera's own note and thumbnail."""
    packed = io.BytesIO()
    with Image.open(file) as picture:
        exif = picture.getexif()
        camera = exif.get_ifd(ExifTags.IFD.Exif)
        for tag in (ExifTags.Base.MakerNote, ExifTags.Base.UserComment):
            camera.pop(tag, None)
        exif.get_ifd(ExifTags.IFD.GPSInfo)
        small = picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS)
        small.save(packed, "WEBP", quality=QUALITY["photo"], method=6, exif=exif.tobytes())
    return packed.getvalue()


def small_map(file: Path) -> bytes:
    """Encode a map with transparency as a tiled GeoTIFF of WebP with overviews."""
    with _gdal.opened(file) as opened:
        across, down = round(opened.width * opened.res[0] / PIXEL), round(opened.height * opened.res[0] / PIXEL)
        pixels = opened.read(out_shape=(4, down, across), resampling=Resampling.average)
        transform = opened.transform * opened.transform.scale(opened.width / across, opened.height / down)
        crs = opened.crs
    # A pixel that is partly without data is dark at its border.
    pixels[3] = np.where(pixels[3] > 250, 255, 0)
    with rasterio.Env(WEBP_LEVEL_OVERVIEW=QUALITY["map"]), MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=across, height=down, count=4, dtype="uint8", crs=crs, transform=transform,
            tiled=True, blockxsize=256, blockysize=256, compress="webp", webp_level=QUALITY["map"],
        ) as written:  # fmt: skip
            written.write(pixels)
            written.build_overviews([2, 4], Resampling.average)
        return bytes(memory.read())


if __name__ == "__main__":
    main()
