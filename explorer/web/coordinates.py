"""Places of a map as the page shows them: latitude and longitude with a link, or metres on a rendered map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from markupsafe import Markup

from lpn.locate.located import LocatedFlight
from lpn.maps import Map
from lpn.maps.named_window import describe_offset

_LINK = Markup(
    '<a href="{}" target="_blank" rel="noopener noreferrer" title="Opens openstreetmap.org, which then sees this coordinate">'
    "OpenStreetMap</a>"
)


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

    def html(self, linked: bool = True) -> Markup:
        """Return latitude and longitude, with a link to OpenStreetMap if it is `linked`."""
        at = Markup('<span class="num">{:.5f}, {:.5f}</span>').format(self.latitude, self.longitude)
        return Markup("{} ({})").format(at, self.link) if linked else at

    @property
    def link(self) -> Markup:
        """A link that shows the place on OpenStreetMap, as HTML."""
        latitude, longitude = f"{self.latitude:.6f}", f"{self.longitude:.6f}"
        return _LINK.format(
            f"https://www.openstreetmap.org/?mlat={latitude}&mlon={longitude}#map=18/{latitude}/{longitude}"
        )


def describe_point(flight: LocatedFlight, point: tuple[float, float]) -> str:
    """Return a point on a flight's map in words: its latitude and longitude, or its metres where the flight is rendered."""
    at = MapCoordinate.on_map(flight, point)
    return describe_offset(*point) if at is None else f"latitude {at.latitude:.6f}, longitude {at.longitude:.6f}"
