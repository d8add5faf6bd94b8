"""The matches of a photo that agree with its registration: their distances, and a sample of them."""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.homography import apply_homography
from lpn.flight.locate.agreement import PhotoPlaces, offset_rows
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.registration import Registration

# Most details in a sample: a person cannot distinguish more in a picture.
_SAMPLE = 24
# Rows of a photo in which the details of a sample are numbered from left to right.
_ROWS = 4


class MatchedDetails(PhotoPlaces, frozen=True):
    """The matches of a photo that agree with its registration, and a sample spread over the photo.

    Attributes:
        rows: of the sample.
        median: of all these matches' distances in metres.
        limit: metres within which a match agrees.
    """

    median: float
    limit: float

    @classmethod
    def of(cls, registration: Registration, view: PhotoView) -> MatchedDetails | None:
        """Return the matches of an accepted registration; None for a refused one.

        Args:
            view: of the photo and its registered picture.
        """
        matched, homography = registration.matched, registration.homography
        if not registration.accepted or matched is None or homography is None:
            return None
        pixels = view.pixels(matched.u)
        offsets = np.stack([matched.m.real, matched.m.imag], axis=1) - apply_homography(homography, pixels)
        metres = np.hypot(*offsets.T)
        agree = np.flatnonzero(metres < matched.limit)
        places = (pixels[agree] + 0.5) / view.size
        chosen = _spread(places * view.size)
        order = np.lexsort((places[chosen, 0], np.floor(places[chosen, 1] * _ROWS)))
        chosen = chosen[order]
        rows = offset_rows(places[chosen], offsets[agree][chosen], 3)
        return cls(rows, round(float(np.median(metres[agree])), 3), round(matched.limit, 3))

    def on_map(self, homography: Float64Array, width: int, height: int) -> Float64Array:
        """Return the sample's places on the map, metres east and north, (N, 2).

        Args:
            homography: of the registration, from pixels of the photo to metres, (3, 3).
            width, height: of the photo in pixels.
        """
        return apply_homography(homography, self.places * (width, height) - 0.5) + self.offsets


def _spread(points: Float64Array) -> Int64Array:
    """Return the indices of at most `_SAMPLE` points, (N, 2), each as far as possible from earlier ones."""
    count = min(_SAMPLE, len(points))
    chosen = np.zeros(count, np.int64)
    nearest = np.full(len(points), np.inf)
    for i in range(count):
        # The first is nearest to the mean of all.
        chosen[i] = nearest.argmax() if i else np.hypot(*(points - points.mean(axis=0)).T).argmin()
        nearest = np.minimum(nearest, np.hypot(*(points - points[chosen[i]]).T))
    return chosen
