"""The command map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class MapCommand:
    """Make a map of a GeoTIFF, a picture with corners, tiles, or several sheets; other commands take its folder."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """GeoTIFF (any CRS), picture with a world file or corners, map.csv, folder of tiles {z}/{x}/{y}, .mbtiles, .sqlitedb; several
    are sheets of one map."""
    out: Path
    """Folder of the map; sheets that are quick to read stay where they are, and are named in it."""
    crs: str | None = None
    """Coordinate reference system, such as EPSG:32632, instead of that of the files."""
    corners: tuple[float, float, float, float] | None = None
    """Latitude and longitude of a picture's top-left corner, then of its bottom-right corner."""
    bands: tuple[int, ...] | None = None
    """Numbers of the bands to show as red, green, and blue, or of one to show in grey; by default those marked as colours."""
    keep_borders: bool = False
    """Keep white and black borders as part of the picture."""

    def run(self) -> None:
        from lpn.core.files import printable
        from lpn.maps import MapOptions
        from lpn.maps.folder import build_map

        options = MapOptions(self.crs, self.corners, self.bands, self.keep_borders)
        written = build_map(self.files, self.out, options, lambda message: print(printable(message), flush=True))
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
