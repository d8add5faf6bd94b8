"""A photo and the map about it with the same details numbered in both, for the reason of an answer by details."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError, PictureError
from lpn.core.numbers import upper_bound, wrap_degrees
from lpn.drawing import overlays, theme, words
from lpn.locate.belief import belief
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.matched_details import MatchedDetails
from lpn.locate.matched_pictures import MatchedPictures, matched_pictures
from lpn.maps import Map
from lpn.report import DetailPin, DetailsPair

# The longer side of the pictures in pixels, and the quality of their JPEG.
_SIDE, _QUALITY = 800, 82
# A scale's metres begin with one of these digits, and it takes at most this share of the map's width.
_DIGITS, _SCALE = (1, 2, 5), 0.3


_Drawn = tuple[MatchedPictures, tuple[str, str, str]]


@dataclass(frozen=True)
class _Source:
    """A photo and its answer, from which the pictures are drawn.

    Attributes:
        file: path and time of the last change of the photo's file.
        figures: of the answer, by which it is told from another one.
        picture: the photo; None for the one in the file.
    """

    file: tuple[object, ...]
    figures: tuple[object, ...]
    answer: StageRecord = field(compare=False)
    located: LocatedFrame = field(compare=False)
    picture: UInt8Array | None = field(default=None, compare=False)


def details_pair(analysis: StateAnalysis, workspace: Workspace) -> DetailsPair | None:
    """Return the photo that is shown beside the map about it; None without an accepted registration, or if it cannot be read."""
    located, basemap = workspace.located(analysis), workspace.basemap
    answer = None if located is None else located.stages.get("registration")
    if located is None or basemap is None or answer is None or answer.details is None:
        return None
    with suppress(DataError, PictureError):  # a file that has gone, or is damaged: the numbers are told without it
        drawn = _drawn(analysis, located, answer, basemap)
        if drawn is None:
            return None
        shown, (photo, ground, laid) = drawn
        height, width = shown.photo.shape[:2]
        places = zip(_per_cent(shown.in_photo), _per_cent(shown.on_map), answer.details.metres.tolist(), strict=True)
        return DetailsPair(
            sentence(answer, answer.details, "your picture" if analysis.state.upload else "the photo"),
            photo,
            ground,
            laid,
            (width, height),
            _per_cent(shown.frame),
            theme.css(theme.placed_colour(belief(located).sign)),
            [DetailPin(i, here, there, f"{metres:.2f}") for i, (here, there, metres) in enumerate(places, 1)],
            _bound(answer.details.limit),
            wrap_degrees(shown.heading),
            _scale(shown.width),
        )
    return None


def sentence(answer: StageRecord, details: MatchedDetails, photo: str) -> str:
    """Say how many details of a photo, which is called `photo`, agree with the map, and how well."""
    median, limit = _bound(details.median), _bound(details.limit)
    numbered = f" {len(details.rows)} of them have a number." if len(details.rows) < (answer.inliers or 0) else ""
    if words.plain():
        return (
            f"{answer.inliers} details of {photo} lie on the map where they should: half of them within {median} m, and all "
            f"within {limit} m, beyond which none counts.{numbered}"
        )
    return (
        f"{answer.inliers} matches agree with the registration: the median of their residuals is {median} m, and a residual "
        f"of {limit} m is the limit.{numbered}"
    )


def _drawn(analysis: StateAnalysis, located: LocatedFrame, answer: StageRecord, basemap: Map) -> _Drawn | None:
    upload, file = analysis.state.upload, located.frame.file
    if upload is not None:  # nothing but the page that sent it holds an own picture
        return _draw(basemap, _Source((), (), answer, located, upload.picture))
    try:
        stamp = file.stat().st_mtime_ns
    except OSError as error:
        raise PictureError(f"{file.name} cannot be read.") from error
    assert answer.details is not None
    return _draw_once(
        basemap,
        _Source((str(file), stamp), (answer.state, *(answer.homography or ()), *answer.details.rows), answer, located),
    )


def _draw(basemap: Map, source: _Source) -> _Drawn | None:
    frame = source.located.frame
    picture = images.load_picture(frame.file) if source.picture is None else source.picture
    size = frame.width, frame.height
    shown = matched_pictures(basemap, source.answer, frame.undistorted(picture), size, _SIDE)
    if shown is None:
        return None
    photo, ground, laid = (overlays.data_uri(one, _QUALITY) for one in (shown.photo, shown.ground, shown.laid))
    return shown, (photo, ground, laid)


# A page draws its reason anew with every change, in which photo and map stay.
_draw_once = lru_cache(maxsize=16)(_draw)


def _bound(metres: float) -> str:
    return upper_bound(metres, 1 if metres >= 0.5 else 2)


def _per_cent(shares: Float64Array) -> list[tuple[float, float]]:
    return [(across, down) for across, down in (100 * shares).round(2).tolist()]


def _scale(width: float) -> tuple[float, float]:
    """Return the metres of a scale for a map of a width in metres, and the per cent of the width that it takes."""
    power = 10.0 ** np.floor(np.log10(_SCALE * width))
    metres = max(digit * power for digit in _DIGITS if digit * power <= _SCALE * width)
    return float(metres), round(100 * float(metres) / width, 2)
