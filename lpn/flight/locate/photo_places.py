"""Places of a registered photo, and how far from them the map has what they show."""

from __future__ import annotations

from typing import cast

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array


class PhotoPlaces(msgspec.Struct, frozen=True):
    """Places of a photo with their offsets on the map.

    Attributes:
        rows: for each place its shares of the photo's width and height, then from where the registration lays it to where the
            map has it, metres east and north.
    """

    rows: list[tuple[float, float, float, float]]

    @property
    def places(self) -> Float64Array:
        """The places as shares of the photo's width and height, (N, 2)."""
        return np.array(self.rows, np.float64).reshape(-1, 4)[:, :2]

    @property
    def offsets(self) -> Float64Array:
        """From where the registration lays them to where the map has them, metres east and north, (N, 2)."""
        return np.array(self.rows, np.float64).reshape(-1, 4)[:, 2:]

    @property
    def metres(self) -> Float64Array:
        """The lengths of `offsets`, (N,)."""
        return cast(Float64Array, np.hypot(*self.offsets.T))


def offset_rows(places: Float64Array, offsets: Float64Array, digits: int) -> list[tuple[float, float, float, float]]:
    """Return the rows of `PhotoPlaces` of places (N, 2) and offsets (N, 2), metres rounded to so many digits."""
    rounded = np.hstack([places.round(4), offsets.round(digits)]).tolist()
    return [(across, down, east, north) for across, down, east, north in rounded]
