"""The command map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpn.flight.maps import Map


@dataclass
class MapCommand:
    """Make a map of a GeoTIFF, a picture with corners, tiles, sheets, or your own photos; other commands take its folder."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """GeoTIFF (any CRS), picture with a world file or corners, map.csv, folder of tiles {z}/{x}/{y}, .mbtiles; several are
    sheets of one map."""
    out: Path
    """Folder of the map, new or empty; it holds a copy of the pixels, without loss."""
    crs: str | None = None
    """Coordinate reference system, such as EPSG:32632, instead of that of the files."""
    corners: tuple[float, float, float, float] | None = None
    """Latitude and longitude of a picture's top-left corner, then of its bottom-right corner."""
    bands: tuple[int, ...] | None = None
    """Numbers of the bands to show as red, green, and blue, or of one to show in grey; by default those marked as colours."""
    keep_borders: bool = False
    """Keep white and black borders as part of the picture."""

    elevation: Path | None = None
    """GeoTIFF of heights of the map's ground, any CRS: a surface model (with roofs and trees) rather than one of the bare ground.
    lpn locate solves the camera's pose with it."""
    elevation_unit: Literal["metre", "foot", "us-foot"] | None = None
    """Unit of these heights, instead of the one that the file states."""

    from_flight: tuple[Path, ...] | None = None
    """Photos that look straight down and have GPS tags, or folders of them, in place of files. An orthophoto is made of them,
    as if the ground were flat. Place and scale are those of the tags."""

    error: float | None = None
    """Error of the map's places on earth in metres, 1 sigma along each axis, as measured at check points. It is kept in the map,
    and replaces the default: 3 pixels, at least 1 m. --map-error of lpn locate and lpn explore replaces it for one run."""

    place: str = ""
    """Name of the place, such as "Dripping Springs, Texas"; lpn explore displays it."""
    photographed: str = ""
    """Day of the map's pictures, such as 2014-10-19, or their season; by default that of the photos of --from-flight."""

    def run(self) -> None:
        import numpy as np

        from lpn.core.files import printable
        from lpn.core.numbers import SIGMA
        from lpn.flight.maps.elevation import probes

        written = self._written(lambda message: print(printable(message), flush=True))
        for note in written.notes:
            print(printable(note))
        west, south, east, north = written.bounds
        latitude, longitude = written.frame.latitude, written.frame.longitude
        sheets = f"{len(written.sheets)} sheets" if len(written.sheets) > 1 else "one sheet"
        print(
            f"{printable(str(self.out))} shows {east - west:.0f} m by {north - south:.0f} m about {latitude:.6f}, "
            f"{longitude:.6f}, {written.coverage().mean():.0%} of it with data, from {sheets}; the finest has "
            f"{written.resolution:.3g} m per pixel."
        )
        if written.surveyed_error is not None:
            print(f"The surveyed error of its places is {written.surveyed_error:g} m ({SIGMA}).")
        if written.elevation is not None:
            known = written.heights(probes(written.bounds))
            known = known[np.isfinite(known)]
            print(
                f"Its heights go from {known.min():.1f} to {known.max():.1f} m, by {printable(written.elevation.name)}."
            )

    def _written(self, on_progress: Callable[[str], None]) -> Map:
        from lpn.core.errors import InputError
        from lpn.flight.maps import MapOptions, MapPlace
        from lpn.flight.maps.elevation import ElevationFile
        from lpn.flight.maps.folder import build_map

        if self.elevation is None and self.elevation_unit is not None:
            raise InputError("--elevation-unit needs --elevation; give both, or leave it out.")
        options = MapOptions(self.crs, self.corners, self.bands, self.keep_borders)
        place = MapPlace(self.place, self.photographed)
        elevation = None if self.elevation is None else ElevationFile(self.elevation, self.elevation_unit)
        if self.from_flight is None:
            return build_map(self.files, self.out, options, on_progress, elevation, place, surveyed_error=self.error)
        if self.files or options != MapOptions():
            raise InputError(
                "--from-flight makes the map of photos alone; leave the other files and options, except --elevation, out."
            )
        from lpn.flight.files import photos_of
        from lpn.flight.maps.orthophoto import build_from_photos

        flight = photos_of(self.from_flight, self.out.resolve().name)
        if not self.photographed and flight.day is not None:
            place = MapPlace(self.place, flight.day.isoformat())
        files = [frame.file for frame in flight.frames]
        return build_from_photos(files, flight.degrees, self.out, on_progress, elevation, place, self.error)
