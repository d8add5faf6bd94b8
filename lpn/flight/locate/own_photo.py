"""The registration of a single photo, on the whole map, or about its most similar windows if the map is too large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lpn.core.arrays import UInt8Array
from lpn.core.progress import CountProgress
from lpn.flight.files import Frame, ground_width
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.registered_stage import PhotoSearch, register_photo, tried_widths, with_map_error
from lpn.flight.locate.retrieval import WindowRecord
from lpn.flight.maps import Map, Window


@dataclass(frozen=True, eq=False)
class OwnPhoto:
    """The registration's answer for a single photo.

    Attributes:
        located: the photo, with one stage.
        whole_map: whether all of the map was searched.
    """

    located: LocatedFrame
    whole_map: bool

    @property
    def answer(self) -> StageRecord:
        """The answer; its homography is from pixels of the undistorted photo, see `Frame.undistorted`."""
        return self.located.stages["registration"]


def register_own_photo(
    basemap: Map,
    features: Sequence[MapFeatures],
    photo: UInt8Array,
    frame: Frame | None,
    windows: Sequence[Window],
    on_progress: CountProgress | None = None,
    map_error: float | None = None,
) -> OwnPhoto:
    """Register a photo without any need of its place, heading, height, or field of view.

    The rules of a flight's photos apply, see `lpn.flight.locate.registration`, but more support is needed, see
    `lpn.flight.locate.registration.proven`. A small enough map is searched whole, so that every similar place is a rival.

    Args:
        features: of the map by each matcher, in the order of the tries.
        photo: RGB, (H, W, 3), as taken.
        frame: the data of the photo's file; None without any. They are ignored if the tag lies farther off the map than the map
            is wide: either the photo is of another place, or the data are of another photo.
        windows: the most similar windows, about which a large map is searched.
        on_progress: called before each try with the numbers of finished tries and of all; an exception in it ends the search.
        map_error: see `LocateOptions.map_error`.
    """
    height, width = photo.shape[:2]
    frame = replace(frame or Frame("photo", Path("photo"), width, height), width=width, height=height)
    tag = None
    if frame.latitude is not None and frame.longitude is not None:
        tag = basemap.frame.xy([frame.latitude], [frame.longitude])[0]
    located = LocatedFrame(frame, tag if tag is not None and np.isfinite(tag).all() else None)
    if located.tag is not None and basemap.metres_off(located.tag) > max(basemap.sides):
        located.frame = frame = Frame(frame.name, frame.file, width, height)
    smallest = min(metres for metres, _ in tried_widths(basemap, ground_width(frame), ()))
    whole_map = all(kind.holds_map(smallest) for kind in features)
    side = None
    if not whole_map and windows:
        located.windows = [WindowRecord(one.x, one.y, one.size) for one in windows]
        side = float(np.median([one.size for one in windows]))
    plain = frame.undistorted(photo)
    search = PhotoSearch(
        basemap, features, located, plain, LocateOptions(), side=side, on_progress=on_progress, anywhere=True
    )
    located.stages["registration"] = with_map_error(
        register_photo(search), basemap.total_error(map_error), basemap.place_error(map_error)
    )
    return OwnPhoto(located, whole_map)
