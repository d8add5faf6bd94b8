"""Maps: georeferenced rasters of any size, read by windows in true metres.

    basemap = open_map("ortho.tif")                        # or a folder of lpn map, a tile folder, an .mbtiles, several sheets
    picture, valid = basemap.read(Window(120.0, -35.0, 100.0), 224)
    windows = basemap.pyramid([70.0, 100.0, 140.0], overlap=0.5)

It imports `core` and `datasets`, and needs the extra `maps`; `training`, `locate`, and the packages above them import it.
"""

from lpn.flight.maps.folder import open_map
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map, MapPlace
from lpn.flight.maps.named_window import NamedWindow
from lpn.flight.maps.sources import MapOptions
from lpn.flight.maps.window import Window

__all__ = ["LocalFrame", "Map", "MapOptions", "MapPlace", "NamedWindow", "Window", "open_map"]
