"""Options of locating a flight."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lpn.core.errors import InputError
from lpn.flight.locate.matchers import MatcherName

# Windows kept for each frame, at distinct places.
TOP = 5


@dataclass(frozen=True)
class LocateOptions:
    """Options of locating a flight.

    Attributes:
        sequence, register: whether these stages run; retrieval runs with a model. The sequence needs retrieval.
        matcher: of the registration; "auto" is XFeat if installed, then SIFT for photos that XFeat does not place.
        prior: metres around each frame's tag that registration searches; None uses no tag.
        map_error: 1-sigma error of the map's places in metres, along each axis; None takes `Map.default_error`.
        sizes: sides of windows in metres; None chooses them from the flight.
        overlap: of neighbouring windows, 0 to below 1.
        speed: standard deviation of a live flight's steps in metres a second; a whole flight takes the most probable speed.
    """

    sequence: bool = True
    register: bool = True
    matcher: MatcherName = "auto"
    prior: float | None = None
    map_error: float | None = None
    sizes: tuple[float, ...] | None = None
    overlap: float = 0.75
    speed: float = 10.0

    def __post_init__(self) -> None:
        if self.prior is not None and not 0 < self.prior < math.inf:
            raise InputError(f"The prior is {self.prior:g} m; expected metres above 0.")
        if self.map_error is not None and not 0 <= self.map_error < math.inf:
            raise InputError(f"The map's error is {self.map_error:g} m; expected 0 or more metres.")
        if not 0 < self.speed < math.inf:
            raise InputError(f"The speed is {self.speed:g} m/s; expected metres a second above 0.")
        if not all(0 < size < math.inf for size in self.sizes or ()):
            raise InputError("Sides of windows must be metres above 0.")
