"""The stage that registers each photo of a flight on the map; resumable."""

from __future__ import annotations

import hashlib
import json
import math
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError, OutputError, PictureError
from lpn.core.files import cache_folder, space_remedy
from lpn.core.numbers import SIGMA, error_figure
from lpn.core.progress import CountProgress, report_progress
from lpn.flight.files import Flight, Frame, ground_width
from lpn.flight.locate.agreement import MatchedDetails, map_agreement
from lpn.flight.locate.camera_place import camera_place, scattered_radii
from lpn.flight.locate.camera_pose import photo_pose
from lpn.flight.locate.ground import MAX_BLOCKS, MapFeatures
from lpn.flight.locate.levelled import PhotoView, level
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.matchers import Ground, Matcher, open_matchers
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.registration import (
    FREE_FACTOR,
    Expectation,
    PhotoPlace,
    Registration,
    contested,
    proven,
    register,
)
from lpn.flight.locate.retrieval import MapRetrieval, frame_identity, heading_is_certain
from lpn.flight.locate.turns import refuse_turned
from lpn.flight.locate.words import Reason
from lpn.flight.maps import Map
from lpn.models.base import Model

FORMAT = "lpn-locate/7"
# Version of poses and matched details in cached answers.
_POSES = 7
# Ratio of one tried ground width to the next, if the width is unknown.
_WIDTHS = 1.9
# Frames whose registered widths correct the next width, and frames whose widths replace it if no height is known.
_RECENT = 7
_LATEST = 3
# Reach of the search around a candidate in ground widths.
AROUND = 0.75
# Share of a photo's ground outside of the searched ground above which the search is repeated about the result.
_BEYOND = 0.05
# A flight of fewer photos gives little evidence, so each photo is first searched as a single photo.
FEWEST = 5
# The models of a registration in words, as the object of "the matches agree on".
_AGREED = {"similarity": "one place, turn, and scale", "homography": "one place, turn, scale, and tilt"}


@dataclass(eq=False)
class FlightPrior:
    """Facts from earlier registered frames for the next frame.

    Attributes:
        widths: metres of ground across the last pictures.
        ratios: of these widths to the widths by height and field of view.
        heading: of the last frame, in degrees.
    """

    widths: deque[float] = field(default_factory=lambda: deque(maxlen=_LATEST))
    ratios: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    heading: float | None = None

    def add(self, frame: Frame, answer: StageRecord) -> None:
        """Add an answer if it is accepted."""
        if not answer.accepted or answer.width is None:
            return
        self.heading = answer.heading
        self.widths.append(answer.width)
        if (expected := ground_width(frame)) is not None:
            self.ratios.append(answer.width / expected)


def register_frames(
    basemap: Map,
    flight: Flight,
    frames: list[LocatedFrame],
    options: LocateOptions,
    model: Model | None,
    retrieval: MapRetrieval | None,
    on_frame: CountProgress,
    shipped: Mapping[str, StageRecord],
) -> list[str]:
    """Add a registration to each frame, computed, shipped, or recorded by a killed run; return sentences on them.

    Args:
        on_frame: called after each frame with the numbers of frames done and of all.
    """
    features = [MapFeatures(basemap, matcher) for matcher in open_matchers(options.matcher)]
    # The limit of frames is not part of the key: a frame's answer depends only on earlier frames.
    names = [one.matcher.name for one in features]
    searched = asdict(replace(options, map_error=None))
    side = None if retrieval is None else retrieval.gallery.side
    heights = None if basemap.elevation is None else basemap.elevation.digest()
    key = [FORMAT, _POSES, basemap.digest(), heights, names, searched, model and model.fingerprint, side]
    file = cache_folder() / "locate" / "registration" / f"{_digest([*key, flight.name])}.jsonl"
    records = read_records(file)
    few = len(frames) < FEWEST and all(located.by_hand is None for located in frames)
    prior = FlightPrior()
    trail = _digest(key)
    answers: list[StageRecord] = []
    map_error, place_error = basemap.total_error(options.map_error), basemap.place_error(options.map_error)
    for i, located in enumerate(frames):
        # An answer depends on earlier frames, whose widths it uses.
        places = located.searched_places(options.prior is not None)
        plain = {key: value for key, value in asdict(located.frame).items() if key != "file"}
        around = None if places is None else places.tolist()
        trail = _digest([trail, frame_identity(located.frame), plain, around, *["alone"] * few])
        answer = shipped.get(located.frame.name) or records.get(trail)
        if answer is None:
            answer = register_frame(basemap, features, located, options, prior, side, few)
            if few and not answer.accepted and located.tag is not None:
                # With the tag, fewer details may suffice.
                answer = register_frame(basemap, features, located, options, prior, side)
            append_record(file, trail, answer)
        answers.append(answer)
        located.stages["registration"] = with_map_error(answer, map_error, place_error)
        prior.add(located.frame, answer)
        report_progress("Registering frames", i + 1, len(frames))
        on_frame(i + 1, len(frames))
    notes = refuse_turned(frames)
    radii, told = scattered_radii(frames, answers)
    for i, radius in radii.items():
        smaller = msgspec.structs.replace(answers[i], radius=radius)
        frames[i].stages["registration"] = with_map_error(smaller, map_error, place_error)
    return notes + told


def read_records(file: Path) -> dict[str, StageRecord]:
    """Return the answers of an earlier run by their keys, from a file of JSON lines; a line that a kill cut short is ignored."""
    records: dict[str, StageRecord] = {}
    decoder = msgspec.json.Decoder(tuple[str, StageRecord])
    try:
        lines = file.read_bytes().splitlines()
    except OSError:
        return records
    for line in lines:
        with suppress(msgspec.MsgspecError, ValueError):
            key, records[key] = decoder.decode(line)
    return records


def append_record(file: Path, key: str, record: StageRecord) -> None:
    """Append an answer to a file of `read_records`; OutputError if it cannot be written."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("ab") as lines:
            # The first line break ends a line that was cut short.
            lines.write(b"\n" + msgspec.json.encode((key, record)) + b"\n")
    except OSError as error:
        raise OutputError(
            f"{file} cannot be written ({error.strerror or error}); {space_remedy(error)}set LPN_CACHE to a folder that can be "
            "written."
        ) from error


def with_map_error(answer: StageRecord, map_error: float, place_error: float) -> StageRecord:
    """Add the map's error to an answer's radius, and name the radius in the finding of an accepted one.

    Args:
        place_error: see `Map.place_error`.
    """
    if answer.radius is None:
        return answer
    radius = math.hypot(answer.radius, map_error)
    sentence = answer.finding
    if answer.accepted:
        place = "camera's place" if answer.camera else "picture's middle"
        where = "earth" if place_error > 0 else "the map"
        on_map = math.sqrt(max(map_error**2 - place_error**2, 0.0))
        parts = [f"± {error_figure(on_map)} m are assumed for the map"] if on_map else []
        parts += [f"± {error_figure(place_error)} m are the error of the map's place"] if place_error > 0 else []
        of_these = f", of which {' and '.join(parts)}" if parts else ""
        sentence += f" The error of the {place} on {where} is ± {radius:.1f} m ({SIGMA}){of_these}."
    middle = None if answer.middle_radius is None else math.hypot(answer.middle_radius, map_error)
    return msgspec.structs.replace(
        answer, radius=radius, middle_radius=middle, finding=sentence, map_error=map_error, place_error=place_error
    )


def register_frame(
    basemap: Map,
    features: Sequence[MapFeatures],
    located: LocatedFrame,
    options: LocateOptions,
    prior: FlightPrior,
    side: float | None,
    anywhere: bool = False,
) -> StageRecord:
    """Register one frame; see `PhotoSearch`."""
    try:
        photo = located.frame.undistorted(images.load_picture(located.frame.file))
    except PictureError as error:
        return StageRecord("refused", str(error), code="unread")
    return register_photo(PhotoSearch(basemap, features, located, photo, options, prior, side, anywhere=anywhere))


@dataclass(frozen=True, eq=False)
class PhotoSearch:
    """A search of the map for one photo.

    Attributes:
        features: of the map by each matcher, in the order of the tries.
        located: the frame, with the answers of earlier stages.
        photo: RGB (H, W, 3), undistorted, see `Frame.undistorted`.
        prior: facts from earlier frames.
        side: metres of the windows that the frame's places come from; None if they come from no windows.
        quick: whether to try only the width by height and field of view, if known.
        on_progress: called before each try of a matcher and a width; an exception in it ends the search.
        anywhere: whether the photo may be of a place off the map. All matchers together then need more support.
    """

    basemap: Map
    features: Sequence[MapFeatures]
    located: LocatedFrame
    photo: UInt8Array
    options: LocateOptions
    prior: FlightPrior = field(default_factory=FlightPrior)
    side: float | None = None
    quick: bool = False
    on_progress: CountProgress | None = None
    anywhere: bool = False


def register_photo(search: PhotoSearch) -> StageRecord:
    """Run a search, describe the answer in a sentence, and compare an accepted one with the map away from its middle."""
    basemap, frame, options = search.basemap, search.located.frame, search.options
    if options.prior is not None and search.located.tag is None and search.side is None:
        return StageRecord("refused", "", code="no tag")
    view = level(search.photo, frame)
    best, reach, widths = _searched(search, view)
    code, numbers = best.refusal or Reason("")
    if code == "too large":
        return StageRecord("refused", "", code=code, numbers=numbers)
    if best.homography is not None and view.is_levelled:
        best = best.laid(best.homography @ view.matrix, view.size, frame.heading)
    solved = photo_pose(basemap, frame, view, best) if best.accepted else ""
    parts = [""]
    below = None if best.homography is None else camera_place(frame, view.size, best)
    place, radius = below or (best.centre, best.radius)
    camera, heading = below is not None, best.heading
    pose = None if isinstance(solved, str) else solved
    # On flat ground the pose of a photo from nearly straight above is less exact than the picture's middle.
    placed = pose is not None and (basemap.elevation is not None or view.is_levelled)
    if pose is not None and placed and (not camera or radius is None or pose.radius < radius):
        place, radius, camera, heading = np.array([pose.east, pose.north]), pose.radius, True, pose.heading
    elif pose is not None and camera:
        parts = ["Its place rests on the tilt in the photo's file, which is surer than that of this pose."]
    agreement = None
    if best.accepted and best.homography is not None:
        told = f"{best.inliers} details matched by {best.matcher} agree on {_AGREED[best.model]}."
        parts = [told, best.turn_sentence, solved if isinstance(solved, str) else solved.sentence, *parts]
        with suppress(DataError):  # the map may be damaged away from the photo's middle
            agreement = map_agreement(basemap, search.photo, best.homography, view.size)
    if search.side is None and search.options.prior is not None:
        parts.append(f"The search used the GPS tag: it saw the map in a square {2 * reach:.0f} m wide about it.")
    if not best.accepted and widths:
        least, most = min(widths) / FREE_FACTOR, max(widths) * FREE_FACTOR
        parts.append(f"The width of its ground is unknown, so {least:.0f} to {most:.0f} m were tried.")
    finding = " ".join(filter(None, parts))
    if place is None or best.homography is None:
        return StageRecord("refused", finding, code=code, numbers=numbers)
    return StageRecord(
        "accepted" if best.accepted else "refused",
        finding,
        float(place[0]),
        float(place[1]),
        camera,
        radius,
        heading,
        best.turn,
        best.width,
        best.inliers,
        best.homography.ravel().tolist(),
        pose,
        agreement=agreement,
        middle_radius=best.radius if camera else None,
        details=MatchedDetails.of(best, view),
        code=code,
        numbers=numbers,
        alone=best.accepted and search.anywhere,
    )


def _searched(search: PhotoSearch, view: PhotoView) -> tuple[Registration, float, list[float]]:
    """Search the map for a picture.

    Returns:
        Its best registration, half the side of the searched squares in metres, and the tried ground widths in metres if none was
        known.
    """
    frame = search.located.frame
    centres = search.located.searched_places(search.options.prior is not None)
    known_width = ground_width(frame)
    if known_width is not None and search.prior.ratios:
        known_width *= float(np.median(search.prior.ratios))
    expected = Expectation(0.0, frame.heading, heading_is_certain(frame), _guess(search.located, search.prior.heading))
    tried = list(tried_widths(search.basemap, known_width, search.prior.widths))
    free = [] if known_width is not None else [width for width, _ in tried]
    if search.quick and known_width is not None:
        tried = tried[:1]
    widths = [replace(expected, width=width * view.wider, tried=not known) for width, known in tried]
    best, reach = _tried(search, view, widths, centres)
    if search.side is not None and centres is not None and _reaches_out(best, view, centres, reach):
        # A wrong place at the border of the searched ground has no rival if the true place lies beyond.
        assert best.centre is not None
        best, reach = _tried(search, view, widths, best.centre[None])
    return best, reach, free


def _tried(
    search: PhotoSearch, view: PhotoView, widths: Sequence[Expectation], centres: Float64Array | None
) -> tuple[Registration, float]:
    """Register a picture by each matcher at each width, until one is accepted; return the best answer, and its reach."""
    found: list[tuple[Registration, float]] = []
    searches: dict[tuple[float, str], tuple[Matcher, Ground]] = {}
    rivals: list[PhotoPlace] = []
    tries = list(product(search.features, widths))
    for done, (kind, expected) in enumerate(tries):
        if search.on_progress is not None:
            search.on_progress(done, len(tries))
        reach = AROUND * expected.width
        reach += (search.options.prior or 0.0) if search.side is None else 0.5 * search.side
        ground = kind.around(centres, reach, expected.width)
        if ground is None:
            return Registration(Reason("too large", {"blocks": MAX_BLOCKS}), kind.matcher.name), reach
        answer = register(kind.matcher, view, ground, expected, search.basemap.bounds)
        searches[expected.width, answer.matcher] = kind.matcher, ground
        # An earlier search may have found equal places that this one has missed.
        if answer.accepted and rivals:
            alike = [one for (width, _), one in searches.items() if width == expected.width]
            answer = contested(answer, view, alike, rivals)
        rivals += answer.places
        if answer.accepted and search.anywhere:
            others = [
                (one.matcher, one.around(centres, reach, expected.width)) for one in search.features if one is not kind
            ]
            answer = proven(answer, view, [(one, seen) for one, seen in others if seen is not None])
        found.append((answer, reach))
        if answer.accepted:
            return found[-1]
    return max(found, key=lambda one: one[0].support)


def _guess(located: LocatedFrame, before: float | None) -> float | None:
    """Return the heading to try first: of the sequence, else the last accepted frame, else the retrieval."""
    sequence, retrieval = (located.stages.get(stage) for stage in ("sequence", "retrieval"))
    if sequence is not None and sequence.accepted and sequence.heading is not None:
        return sequence.heading
    return before if before is not None or retrieval is None else retrieval.heading


def _reaches_out(answer: Registration, view: PhotoView, centres: Float64Array, reach: float) -> bool:
    """Return whether an accepted picture extends beyond the squares of side 2 `reach` about points (K, 2)."""
    if not answer.accepted:
        return False
    off = np.abs(answer.to_metres(view.grid())[:, None] - centres).max(axis=2).min(axis=1)
    return bool((off > reach).mean() > _BEYOND)


def tried_widths(basemap: Map, known_width: float | None, widths: Collection[float]) -> Iterator[tuple[float, bool]]:
    """Yield ground widths to try, by the height, by earlier frames, or over a range, each with True if it is known."""
    if known_width is not None:
        yield known_width, True
        # The height may be above take-off, and the correction by earlier frames may be wrong.
        yield known_width, False
        return
    if widths:  # only a start, because the flight may climb or sink
        yield float(np.median(list(widths))), False
    largest = 0.8 * min(basemap.bounds[2] - basemap.bounds[0], basemap.bounds[3] - basemap.bounds[1])
    width = min(largest, 400.0)
    for _ in range(4):
        yield width / 1.3, False
        width /= _WIDTHS


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]
