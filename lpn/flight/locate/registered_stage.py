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
from typing import Any

import msgspec
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError, PictureError
from lpn.core.files import cache_folder
from lpn.core.numbers import SIGMA, error_figure
from lpn.core.progress import CountProgress, report_progress
from lpn.flight.files import Flight, Frame, ground_width
from lpn.flight.locate import continuity
from lpn.flight.locate.agreement import map_agreement
from lpn.flight.locate.camera_place import camera_place, height_of_width, told_tilt_error
from lpn.flight.locate.camera_pose import DEFAULT_FOV, CameraPose
from lpn.flight.locate.ground import MAX_BLOCKS, MapFeatures
from lpn.flight.locate.levelled import Levelled, PhotoView, level, pixel_grid
from lpn.flight.locate.line_records import LineRecords
from lpn.flight.locate.located import LocatedFrame, StageRecord, tag_positions
from lpn.flight.locate.matched_details import MatchedDetails
from lpn.flight.locate.matchers import Matcher, open_matchers
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.photo_pose import photo_pose
from lpn.flight.locate.registration import (
    APART,
    FREE_FACTOR,
    MIN_RATIO,
    MIN_SUPPORT,
    Expectation,
    Ground,
    Registration,
    Similarity,
    contested,
    pose,
    proven,
    register,
    turn_between,
)
from lpn.flight.locate.retrieval import MapRetrieval, frame_identity, heading_is_certain
from lpn.flight.locate.tilts import COMMON, tilt_error
from lpn.flight.locate.words import Reason
from lpn.flight.maps import Map
from lpn.models.base import Model

FORMAT = "lpn-locate/7"
# Version of poses and matched details in cached answers.
_POSES = 6
# Ratio of one tried ground width to the next, where none is known.
_WIDTHS = 1.9
# Frames whose registered widths correct the next width, and frames whose widths replace it if no height is known.
_RECENT = 7
_LATEST = 3
# Reach of the search around a candidate in ground widths.
AROUND = 0.75
# Share of a photo's ground outside of the searched ground above which the search is repeated about the result.
_BEYOND = 0.05
# Shift of a picture's middle by the tilt, as a share of the ground width: 8 degrees at 70 degrees of view.
_SWAY = 0.1
# Pitches in degrees for levelling a photo of unknown pitch that is not placed unlevelled.
_TRIED_PITCHES = (-60.0, -42.0)
# Photos of a flight of fewer photos are first searched as single photos, as so few are little evidence together.
FEWEST = 5
# Multiple of the usual support for a photo levelled by a guess: each try is a chance to agree with a wrong place.
_TRIED_SUPPORT = 2.0
# The models of a registration in words, as the object of "the matches agree on".
_AGREED = {"similarity": "one place, turn, and scale", "homography": "one place, turn, scale, and tilt"}


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
    """Enter the answers of the registration, first shipped ones and records of a killed run; return sentences on them.

    Args:
        on_frame: called after each frame with the numbers of frames done and of all.
    """
    matchers = open_matchers(options.matcher)
    features = [MapFeatures(basemap, matcher) for matcher in matchers]
    # The limit of frames is not part of the key: a frame's answer depends only on earlier frames.
    names = [matcher.name for matcher in matchers]
    searched = replace(options, map_error=None)
    side = None if retrieval is None else retrieval.gallery.side
    heights = None if basemap.elevation is None else basemap.elevation.digest()
    key = [FORMAT, _POSES, basemap.digest(), heights, names, asdict(searched), model and model.fingerprint, side]
    file = cache_folder() / "locate" / "registration" / f"{_digest([*key, flight.name])}.jsonl"
    records = LineRecords(file, StageRecord)
    few = len(frames) < FEWEST and all(located.by_hand is None for located in frames)
    before = Before()
    trail = _digest(key)
    answers: list[StageRecord] = []
    map_error, place_error = basemap.total_error(options.map_error), basemap.place_error(options.map_error)
    for i, located in enumerate(frames):
        # An answer depends on earlier frames, whose widths it uses.
        places = located.searched_places(options.prior is not None)
        around = None if places is None else places.tolist()
        plain = {key: value for key, value in asdict(located.frame).items() if key != "file"}
        identity = [frame_identity(located.frame), plain, around, *["alone"] * few]
        trail = _digest([trail, *identity])
        answer = shipped.get(located.frame.name) or records.get(trail)
        if answer is None:
            answer = register_frame(basemap, features, located, options, before, side, few)
            if few and not answer.accepted and located.tag is not None:
                # With the tag, fewer details may suffice.
                answer = register_frame(basemap, features, located, options, before, side)
            records.append(trail, answer)
        answers.append(answer)
        located.stages["registration"] = with_map_error(answer, map_error, place_error)
        before.add(located.frame, answer)
        report_progress("Registering frames", i + 1, len(frames))
        on_frame(i + 1, len(frames))
    notes = refuse_contradicted(frames)
    return notes + correct_radii(frames, answers, map_error)


def correct_radii(frames: list[LocatedFrame], answers: Sequence[StageRecord], map_error: float) -> list[str]:
    """Correct the radii of accepted cameras by the error of tilts that the flight's scatter shows; return sentences about it.

    A common error of frames, such as that of a camera mounted askew, moves a leg as a whole and does not scatter. So the squares
    of the scatter and of a share `COMMON` of the default error add up, and radii never grow.

    Args:
        answers: of the registration for each frame, without the map's error.
    """
    notes = []
    for told in sorted({told_tilt_error(located.frame) for located in frames}):
        of_cameras = [
            (located, answer, located.frame.time, height_of_width(located.frame, answer.width))
            for located, answer in zip(frames, answers, strict=True)
            if located.stages["registration"].accepted
            and answer.camera
            and not answer.by_pose
            and answer.radius is not None
            and answer.width is not None
            and located.frame.time is not None
            and told_tilt_error(located.frame) == told
        ]
        of_cameras.sort(key=lambda one: one[2])
        times, heights = (np.array([one[k] for one in of_cameras], np.float64) for k in (2, 3))
        places = np.array([(answer.x, answer.y) for _, answer, *_ in of_cameras], np.float64).reshape(-1, 2)
        radii = np.array([answer.radius for _, answer, *_ in of_cameras], np.float64)
        spreads = np.sqrt(np.maximum(radii**2 - (heights * math.tan(math.radians(told))) ** 2, 0))
        scatter = tilt_error(times, places, spreads, heights, told)
        degrees = math.hypot(scatter, COMMON * told)
        if degrees >= told:
            continue
        for (located, answer, *_), spread, height in zip(of_cameras, spreads, heights, strict=True):
            radius = math.hypot(spread, height * math.tan(math.radians(degrees)))
            changed = msgspec.structs.replace(answer, radius=radius)
            place_error = located.stages["registration"].place_error
            located.stages["registration"] = with_map_error(changed, map_error, place_error)
        notes.append(
            f"Neighbouring places of the camera scatter as an error of {scatter:.1f} degrees in the tilts would have it. With "
            f"{COMMON * told:.2g} degrees for an error that photos have in common, which scatter does not show, radii count with "
            f"{degrees:.1f} in place of {told:g} degrees."
        )
    return notes


def with_map_error(answer: StageRecord, map_error: float, place_error: float) -> StageRecord:
    """Add the map's error to an answer's radius, and name the radius in the finding of an accepted one.

    Args:
        place_error: see `Map.place_error`.
    """
    if answer.radius is None:
        return answer
    on_earth = place_error > 0
    radius = math.hypot(answer.radius, map_error)
    sentence = answer.finding
    if answer.accepted:
        place = "camera's place" if answer.camera else "picture's middle"
        where = "earth" if on_earth else "the map"
        sentence += f" The error of the {place} on {where} is ± {radius:.1f} m ({SIGMA})"
        on_map = math.sqrt(max(map_error**2 - place_error**2, 0.0))
        parts = [f"± {error_figure(on_map)} m are assumed for the map"] if on_map else []
        parts += [f"± {error_figure(place_error)} m are the error of the map's place"] if on_earth else []
        sentence += f", of which {' and '.join(parts)}." if parts else "."
    middle = None if answer.middle_radius is None else math.hypot(answer.middle_radius, map_error)
    return msgspec.structs.replace(
        answer, radius=radius, middle_radius=middle, finding=sentence, map_error=map_error, place_error=place_error
    )


def refuse_contradicted(frames: list[LocatedFrame]) -> list[str]:
    """Refuse registrations that others of the flight contradict, by turn or by place; return sentences about it."""
    return [*_refuse_turned(frames), *_refuse_jumps(frames)]


def _refuse_turned(frames: list[LocatedFrame]) -> list[str]:
    """Refuse registrations whose turn against a certain heading differs from the others'; return a sentence about them.

    There is no limit on their share: beyond the edge of a map 5 of 21 were false.
    """
    turned = [
        (located, answer, answer.turn)
        for located in frames
        if (answer := located.stages["registration"]).accepted
        and answer.turn is not None
        and heading_is_certain(located.frame)
    ]
    found = continuity.other_turns(np.array([turn for *_, turn in turned], np.float64))
    for i, degrees in found.items():
        located, answer, _ = turned[i]
        located.stages["registration"] = answer.refused("turned", degrees=degrees)
    if not found:
        return []
    least, most = _degrees(min(found.values())), _degrees(max(found.values()))
    by = f"by {least}" if least == most else f"by {least} to {most}"
    count = f"{len(found)} of {len(turned)} registrations"
    if len(found) == 1:
        return [
            f"{count} is turned {by} against its heading, unlike the others, and is refused, as it may show an equal building. "
            "If the headings of its leg are off, it may be right."
        ]
    return [
        f"{count} are turned {by} against their headings, unlike the others, and are refused, as they may show equal buildings. "
        f"Of each leg whose headings are off, up to {continuity.NEW_HEADING - 1} right photos may be among them."
    ]


def _degrees(degrees: float) -> str:
    return f"{degrees:.1f}°" if degrees < 10 else f"{degrees:.0f}°"


def _refuse_jumps(frames: list[LocatedFrame]) -> list[str]:
    """Refuse registrations that the drone cannot have reached and left, unless they are many; return sentences about it.

    Cameras and pictures' middles are two tracks. Radii exclude the map's error, which moves neighbours alike.
    """
    notes = []
    for of_camera in (True, False):
        timed = [
            (located, answer)
            for located in frames
            if (answer := located.stages["registration"]).accepted
            and answer.camera == of_camera
            and answer.radius is not None
            and located.frame.time is not None
        ]
        times = np.array([located.frame.time for located, _ in timed], np.float64)
        places = np.array([(answer.x, answer.y) for _, answer in timed], np.float64).reshape(-1, 2)
        sway = 0.0 if of_camera else _SWAY
        radii = np.array([math.hypot(answer.own_radius, sway * (answer.width or 0.0)) for _, answer in timed])
        tags = tag_positions(located for located, _ in timed)
        if (speeds := continuity.top_speeds(times, places, tags)) is None:
            continue
        jumps = np.flatnonzero(continuity.jumps(times, places, radii, speeds))
        if len(jumps) > continuity.MOST * len(timed):
            notes.append(
                f"{len(jumps)} of {len(timed)} registrations lie where the drone would have had to be faster than it flies to "
                "get there and back. These are too many to tell which of all are wrong, so none of them was refused; check "
                "the track."
            )
            continue
        for i in jumps:
            located, answer = timed[i]
            located.stages["registration"] = answer.refused("jump", speed=float(speeds[i - 1 : i + 1].max()))
    return notes


def register_frame(
    basemap: Map,
    features: Sequence[MapFeatures],
    located: LocatedFrame,
    options: LocateOptions,
    before: Before,
    side: float | None,
    anywhere: bool = False,
) -> StageRecord:
    """Register one frame, and compare it with the map away from its middle; see `PhotoSearch`."""
    try:
        photo = _photo(located.frame)
    except PictureError as error:
        return StageRecord("refused", str(error), code="unread")
    search = PhotoSearch(basemap, features, located, photo, options, before, side, anywhere=anywhere)
    return compared(basemap, register_photo(search), photo)


def _photo(frame: Frame) -> UInt8Array:
    return frame.undistorted(images.load_picture(frame.file))


def compared(basemap: Map, answer: StageRecord, photo: UInt8Array) -> StageRecord:
    """Compare places of an accepted answer's registered photo, RGB (H, W, 3), with the map."""
    if not answer.accepted or answer.homography is None:
        return answer
    matrix = np.array(answer.homography).reshape(3, 3)
    with suppress(DataError):  # the map may be damaged away from the photo's middle
        agreement = map_agreement(basemap, photo, matrix, (photo.shape[1], photo.shape[0]))
        return msgspec.structs.replace(answer, agreement=agreement)
    return answer


@dataclass(eq=False)
class Before:
    """Facts from earlier registered frames for the next one.

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


@dataclass(frozen=True, eq=False)
class PhotoSearch:
    """A search of the map for one photo.

    Attributes:
        features: of the map by each matcher, in the order of the tries.
        located: the frame, with the answers of earlier stages.
        photo: RGB (H, W, 3), undistorted, see `Frame.undistorted`.
        before: facts from earlier frames.
        side: metres of the windows that the frame's places come from; None if they come from no windows.
        quick: whether to try only the width by height and field of view, if known, and only the photo's own tilt.
        on_progress: called before each try of a matcher and a width; an exception in it ends the search.
        anywhere: whether the photo may be of another place than the map's. All matchers together then need more support, and only
            the photo's own tilt is tried.
    """

    basemap: Map
    features: Sequence[MapFeatures]
    located: LocatedFrame
    photo: UInt8Array
    options: LocateOptions
    before: Before = field(default_factory=Before)
    side: float | None = None
    quick: bool = False
    on_progress: CountProgress | None = None
    anywhere: bool = False

    @property
    def size(self) -> tuple[int, int]:
        return self.photo.shape[1], self.photo.shape[0]


def register_photo(search: PhotoSearch) -> StageRecord:
    """Run a search, and describe the answer in a sentence."""
    basemap, frame, options = search.basemap, search.located.frame, search.options
    if options.prior is not None and search.located.tag is None and search.side is None:
        return StageRecord("refused", "", code="no tag")
    answer = _searched(search, frame, search.quick)
    best, solved = _posed(search, answer)
    # On flat ground most photos from straight above are placed well without a pose.
    unsolved = not best.accepted or (basemap.elevation is not None and isinstance(solved, str))
    # More tries are more chances for a false answer, so a photo that may be of another place gets none.
    if unsolved and not search.quick and not search.anywhere and answer.has_ground and frame.pitch is None:
        near = best if best.accepted else None
        tilts = (replace(frame, pitch=pitch, roll=0.0, fov=frame.fov or DEFAULT_FOV) for pitch in _TRIED_PITCHES)
        clearest = _clearest(answer, [_searched(search, tilted, True, near) for tilted in tilts])
        if clearest is not answer:
            answer = clearest
            best, solved = _posed(search, answer)
    how = ""
    if answer.has_ground and search.side is None and options.prior is not None:
        how = f" The search used the GPS tag: it saw the map in a square of {2 * answer.reach:.0f} m about it."
    if answer.has_ground and not best.accepted and answer.widths:
        least, most = min(answer.widths) / FREE_FACTOR, max(answer.widths) * FREE_FACTOR
        how += f" Nothing tells how much ground it shows, so {least:.0f} to {most:.0f} m across were tried."
    code, numbers = best.refusal or Reason("")
    if best.centre is None or best.homography is None:
        return StageRecord("refused", how.strip(), code=code, numbers=numbers)
    place, radius, heading = best.centre, best.radius, best.heading
    if (below := camera_place(frame, search.size, best)) is not None:
        place, radius = below
    camera, by_tilt = below is not None, ""
    solution = None if isinstance(solved, str) else solved
    # On flat ground the pose of a photo from nearly straight above is less exact than the picture's middle.
    placed = basemap.elevation is not None or answer.levelled is not None
    if placed and solution is not None and (below is None or radius is None or solution.radius < radius):
        place, radius, camera = np.array([solution.east, solution.north]), solution.radius, True
        heading = solution.heading
    elif solution is not None and camera:
        by_tilt = "Its place rests on the tilt in the photo's file, which is surer than that of this pose."
    sentence = ""
    if best.accepted:
        agreed = f"{best.inliers} details matched by {best.matcher} agree on {_AGREED[best.model]}."
        told = solved if isinstance(solved, str) else solved.sentence
        levelled = ""
        if frame.pitch is None and answer.pitch is not None:
            levelled = f"Its file tells no tilt; it fits after it was levelled by {90 + answer.pitch:.0f} degrees."
        sentence = " ".join(part for part in (agreed, levelled, best.turn_sentence, told, by_tilt) if part)
    return StageRecord(
        "accepted" if best.accepted else "refused",
        (sentence + how).strip(),
        float(place[0]),
        float(place[1]),
        camera,
        radius,
        heading,
        best.turn,
        best.width,
        best.inliers,
        [float(value) for value in best.homography.ravel()],
        pose=solution,
        middle_radius=best.radius if camera else None,
        details=MatchedDetails.of(best, PhotoView(search.size, answer.levelled)),
        code=code,
        numbers=numbers,
        alone=best.accepted and search.anywhere,
    )


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """The best registration of a photo at one tilt.

    Attributes:
        levelled: the registered picture; None if the photo itself was registered.
        reach: half the side of the searched squares in metres.
        pitch: of the search in degrees; None if none was known or tried.
        has_ground: whether the map could be searched.
        widths: tried ground widths in metres, if none was known.
    """

    best: Registration
    levelled: Levelled | None
    reach: float
    pitch: float | None
    has_ground: bool = True
    widths: Sequence[float] = ()


def _posed(search: PhotoSearch, answer: _SearchResult) -> tuple[Registration, CameraPose | str]:
    """Return the registration of the photo itself, and its camera's pose or the reason for none."""
    best, frame = answer.best, search.located.frame
    if answer.levelled is not None:
        best = _of_photo(best, answer.levelled, search.size, frame)
    return best, photo_pose(search.basemap, frame, search.size, best, answer.levelled) if best.accepted else ""


def _clearest(plain: _SearchResult, tilted: Sequence[_SearchResult]) -> _SearchResult:
    """Return the tilted search with clearly more support than `plain` and than other tilts elsewhere, else `plain`."""
    clearest = max(tilted, key=lambda search: search.best.support)
    best = clearest.best
    if not best.accepted or best.support < _TRIED_SUPPORT * MIN_SUPPORT:
        return plain
    assert best.centre is not None
    assert best.width is not None
    for other in (plain.best, *(search.best for search in tilted)):
        elsewhere = other.centre is not None and np.linalg.norm(other.centre - best.centre) > APART * best.width
        counts = elsewhere or (other is plain.best and other.accepted)
        if counts and best.support < MIN_RATIO * other.support:
            return plain
    return clearest


def _searched(search: PhotoSearch, frame: Frame, quick: bool, near: Registration | None = None) -> _SearchResult:
    """Search the map for a photo at the tilt of `frame`; `near` limits the search to an answer's place, heading, and width."""
    basemap, features, photo = search.basemap, search.features, search.photo
    centres = search.located.searched_places(search.options.prior is not None)
    levelled = level(photo, frame, assumed=frame is not search.located.frame)
    shown, valid, wider = (photo, None, 1.0) if levelled is None else (levelled.picture, levelled.valid, levelled.wider)
    grid = pixel_grid((shown.shape[1], shown.shape[0]), 9) if levelled is None else levelled.grid(25)
    known_width = ground_width(frame)
    if known_width is not None and search.before.ratios:
        known_width *= float(np.median(search.before.ratios))
    if near is not None and near.centre is not None and near.width is not None:
        centres, known_width = near.centre[None], near.width
    best: Registration | None = None
    searched = 0.0
    for again in (False, True):
        best = None
        searches: dict[float, dict[str, tuple[Matcher, Ground]]] = {}
        rivals: list[Similarity] = []
        tried = list(tried_widths(basemap, known_width, search.before.widths))
        tries = list(product(features, tried[:1] if quick and known_width is not None else tried))
        for done, (kind, (width, known)) in enumerate(tries):
            if search.on_progress is not None:
                search.on_progress(done, len(tries))
            width *= wider
            reach = AROUND * width + (search.options.prior or 0.0 if search.side is None else 0.5 * search.side)
            ground = kind.around(centres, reach, width)
            if ground is None:
                refused = Registration(Reason("too large", {"blocks": MAX_BLOCKS}), kind.matcher.name)
                return _SearchResult(refused, levelled, reach, frame.pitch, has_ground=False)
            if near is None:
                expected = Expectation(
                    width if known else None,
                    frame.heading,
                    heading_is_certain(frame),
                    _guess(search.located, search.before.heading),
                )
            else:
                expected = Expectation(width, near.heading)
            answer = register(kind.matcher, shown, ground, expected, [width], basemap.bounds, valid)
            alike = searches.setdefault(width, {})
            alike[answer.matcher] = kind.matcher, ground
            # An earlier search may have found equal places that this one has missed.
            if answer.accepted and rivals:
                answer = contested(answer, shown, list(alike.values()), rivals, valid)
            rivals += answer.places
            if answer.accepted and search.anywhere:
                others = [(one.matcher, one.around(centres, reach, width)) for one in features if one is not kind]
                answer = proven(answer, shown, [(one, seen) for one, seen in others if seen is not None], valid)
            if best is None or (answer.accepted, answer.support) > (best.accepted, best.support):
                best, searched = answer, reach
            if answer.accepted:
                break
        assert best is not None
        if again or search.side is None or centres is None or not _reaches_out(best, grid, centres, searched):
            break
        # A wrong place at the border of the searched ground has no rival, as the true one beyond was not searched.
        assert best.centre is not None
        centres = best.centre[None]
    assert best is not None
    free = [] if known_width is not None else [width for width, _ in tried]
    return _SearchResult(best, levelled, searched, frame.pitch, widths=free)


def _guess(located: LocatedFrame, before: float | None) -> float | None:
    """Return the heading to try first: of the sequence, else the last accepted frame, else the retrieval."""
    sequence, retrieval = (located.stages.get(stage) for stage in ("sequence", "retrieval"))
    if sequence is not None and sequence.accepted and sequence.heading is not None:
        return sequence.heading
    return before if before is not None or retrieval is None else retrieval.heading


def _of_photo(answer: Registration, levelled: Levelled, size: tuple[int, int], frame: Frame) -> Registration:
    if answer.homography is None:
        return answer
    full = answer.homography @ levelled.matrix
    full /= full[2, 2]
    centre, heading, width = pose(full, *size)
    turn = turn_between(frame.heading, heading)
    return replace(answer, homography=full, centre=centre, heading=heading, width=width, turn=turn)


def _reaches_out(answer: Registration, pixels: Float64Array, centres: Float64Array, reach: float) -> bool:
    """Tell whether an accepted photo leaves squares of side 2 `reach` about points (K, 2); `pixels` (N, 2) are a grid."""
    if not answer.accepted:
        return False
    off = np.abs(answer.to_metres(pixels)[:, None] - centres).max(axis=2).min(axis=1)
    return bool((off > reach).mean() > _BEYOND)


def tried_widths(basemap: Map, known_width: float | None, widths: Collection[float]) -> Iterator[tuple[float, bool]]:
    """Yield ground widths to try, each with whether it is known: by the height, by earlier frames, or a range."""
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
