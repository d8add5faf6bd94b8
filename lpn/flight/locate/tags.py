"""The tags of a flight in metres of its map, and a person's corrections, which replace them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.datasets import geo
from lpn.flight.files import Flight
from lpn.flight.locate.camera_place import camera_place
from lpn.flight.locate.corrections import Correction
from lpn.flight.locate.located import BY_HAND, LocatedFrame, StageRecord
from lpn.flight.locate.registration import Registration
from lpn.flight.maps import Map


def tags_on_map(basemap: Map, flight: Flight) -> tuple[Float64Array, list[str], float | None]:
    """Return a flight's tags in metres of the map's frame, (N, 2), sentences about them, and their distance if off the map.

    Unusable tags are NaN. If all tags lie far off the map, none is usable, and the third value is the metres from the map's edge
    to the nearest one; otherwise it is None.
    """
    total = len(flight.frames)
    tags = basemap.frame.xy(*flight.degrees.T)
    tagged = ~np.isnan(flight.degrees).any(axis=1)
    if not np.isfinite(tags[tagged]).all():  # one position outside the projection makes all of them NaN
        tags = np.concatenate([basemap.frame.xy([latitude], [longitude]) for latitude, longitude in flight.degrees])
    known = np.isfinite(tags).all(axis=1)
    tags[~known] = np.nan
    notes: list[str] = []
    if not tagged.any():  # the flight's own note says so
        return tags, notes, None
    if missing := total - int(tagged.sum()):
        notes.append(
            f"{missing} of {total} photos {'has' if missing == 1 else 'have'} no GPS tag, so how far off "
            f"{'its place is' if missing == 1 else 'their places are'} cannot be measured."
        )
    west, south, east, north = basemap.bounds
    margin = max(east - west, north - south)
    off = np.maximum(np.maximum([west, south] - tags[known], tags[known] - [east, north]), 0).max(axis=1)
    if (off > margin).all():
        # Degrees are compared, as the plane stretches large distances; tags outside the projection are compared with one point.
        at = np.where(np.isfinite(tags), np.clip(tags, [west, south], [east, north]), 0.0)[tagged]
        nearest = float(geo.geodesic(flight.degrees[tagged], basemap.frame.degrees(at)).min())
        notes.append(
            f"The flight lies elsewhere than {basemap.name}, the map: its nearest GPS tag is {nearest / 1000:.1f} km from the "
            "map's edge. The tags were left out; give the map of this flight, unless its tags are wrong."
        )
        return np.full_like(tags, np.nan), notes, nearest
    beyond = int((off > 0).sum()) + int((tagged & ~known).sum())
    empty = int((basemap.valid_shares(tags[known], basemap.resolution)[off == 0] == 0).sum())
    for count, where in ((beyond, "beyond the map's edge"), (empty, "over an empty part of the map")):
        if count:
            notes.append(
                f"By the GPS tags of {count} of {total} photos, the drone was {where}; a photo taken there may still show ground "
                "on the map."
            )
    return tags, notes, None


def enter_corrections(basemap: Map, frames: list[LocatedFrame], corrections: Mapping[str, Correction]) -> list[str]:
    """Enter the corrections of frames, and return sentences about them."""
    left = dict(corrections)
    for located in frames:
        correction = left.get(located.frame.name)
        if correction is None or not np.isfinite(basemap.frame.xy(*correction.corners.T)).all():
            continue
        del left[located.frame.name]
        frame, size = located.frame, (located.frame.width, located.frame.height)
        matrix = correction.homography(basemap.frame, *size)
        laid = Registration(None, BY_HAND, covariance=np.zeros((2, 2))).laid(matrix, size, frame.heading)
        assert laid.centre is not None
        below = camera_place(frame, size, laid)
        x, y = (laid.centre if below is None else below[0]).tolist()
        located.by_hand = StageRecord(
            "accepted",
            f"A person laid the photo by hand. {laid.turn_sentence}".rstrip(),
            x,
            y,
            below is not None,
            heading=laid.heading,
            turn=laid.turn,
            width=laid.width,
            homography=matrix.ravel().tolist(),
        )
    notes = []
    if count := sum(located.by_hand is not None for located in frames):
        notes.append(
            f"{count} of {len(frames)} photos are corrected by hand. The corrections are their positions, and the truth of "
            "their errors; --no-corrections leaves them out."
        )
    if left:
        notes.append(
            f"Corrections of photos that this run does not have, or that lie beyond the map's frame, are left out: "
            f"{', '.join(sorted(left))}."
        )
    return notes
