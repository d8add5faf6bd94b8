"""Places of a map as the page shows them: latitude and longitude with a link, or metres on a rendered map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from lpn.locate.located import LocatedFlight
from lpn.maps import Map
from lpn.maps.named_window import describe_offset


@dataclass(frozen=True)
class MapCoordinate:
    """A place in WGS 84 degrees."""

    latitude: float
    longitude: float

    @classmethod
    def on(cls, basemap: Map, point: tuple[float, float]) -> Self:
        """Return the coordinate of a point in metres of a map's frame."""
        return cls(*basemap.frame.degrees([point])[0].tolist())

    @classmethod
    def on_map(cls, flight: LocatedFlight, point: tuple[float, float]) -> Self | None:
        """Return the coordinate of a point on a flight's map; None if the flight is rendered, as it shows no real place."""
        return None if flight.rendered else cls.on(flight.basemap, point)

    @property
    def link(self) -> str:
        """The address that shows the place on OpenStreetMap."""
        latitude, longitude = f"{self.latitude:.6f}", f"{self.longitude:.6f}"
        return f"https://www.openstreetmap.org/?mlat={latitude}&mlon={longitude}#map=18/{latitude}/{longitude}"


def describe_point(flight: LocatedFlight, point: tuple[float, float]) -> str:
    """Return a point on a flight's map in words: its latitude and longitude, or its metres where the flight is rendered."""
    at = MapCoordinate.on_map(flight, point)
    return describe_offset(*point) if at is None else f"latitude {at.latitude:.6f}, longitude {at.longitude:.6f}"
