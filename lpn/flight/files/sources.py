"""A flight from its files: photos, or videos with subtitles, each with or without logs."""

from __future__ import annotations

import contextlib
import os
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image

from lpn.core import images
from lpn.core.errors import DataError, InputError, OtherKindError, PictureError
from lpn.core.files import first_few, printable
from lpn.core.progress import tracked
from lpn.core.texts import counted
from lpn.datasets.base import files_below
from lpn.flight.files import cameras, logs, subtitles, vehicle_logs, videos
from lpn.flight.files.base import Flight, Frame
from lpn.flight.files.folder import FRAMES, check_folder, write_flight
from lpn.flight.files.lenses import Lens, read_camera
from lpn.flight.files.photo_logs import with_log
from lpn.flight.files.photos import DAMAGED, Photo, read_photo
from lpn.flight.files.quality import flight_notes, natural, set_times, with_courses
from lpn.flight.files.subtitles import GpsOrder
from lpn.flight.files.telemetry import Log

T = TypeVar("T")
PHOTOS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
# Pictures of unsupported kinds, which a note names.
_OTHER_PICTURES = (*images.OTHER_SUFFIXES, ".bmp", ".gif")
# The kind of a file by its suffix. Maps, georeferenced pictures of survey programs, and all others are left out.
_KINDS = {
    **dict.fromkeys(PHOTOS, "photos"), **dict.fromkeys(videos.SUFFIXES, "videos"), **dict.fromkeys(videos.SUBTITLES, "subtitles"),
    **dict.fromkeys((*logs.SUFFIXES, *vehicle_logs.SUFFIXES), "logs"),
}  # fmt: skip
_Files = dict[str, list[Path]]
# The georeferencing tags of GeoTIFF.
_GEOTIFF = (33550, 34264)
# The beginning of a track by lpn locate: CSV, GeoJSON, or GPX.
_OWN_TRACK = re.compile(
    rb'(?:\xef\xbb\xbf)?frame,stage,state,|.*creator="lpn locate"|.*"properties":\s*\{\s*"frame":.*?"stage":.*?"state":',
    re.DOTALL,
)
# Supported formats that replace unsupported kinds.
_INSTEAD = {
    **dict.fromkeys((".kml", ".kmz"), "GPX or CSV"), **dict.fromkeys((".ass", ".vtt"), "SRT"),
    **dict.fromkeys((".bag", ".db3", ".mcap"), "CSV, .ulg, .tlog, or .bin"),
}  # fmt: skip
_NAMED = 5
_OPTIONS = {
    "every": (0.04, 86_400.0), "every_metres": (0.1, 1e6), "fov": cameras.FOV_RANGE, "pitch": (-180.0, 90.0),
    "clock_offset": (-1e10, 1e10),
}  # fmt: skip
# Proportions of one camera's pictures differ by less than this share.
_SAME_PROPORTIONS = 0.01


@dataclass(frozen=True)
class FlightOptions:
    """Options of reading a flight.

    Attributes:
        every: seconds from one frame of a video to the next.
        every_metres: metres flown from one frame of a video to the next, in place of `every`.
        gps_order: order of the first two values of GPS(a, b, c) in subtitles; None detects it.
        fov: horizontal field of view in degrees, for frames whose files have none.
        pitch: in degrees, for frames whose files have none; -90 is straight down.
        camera: file of the camera's lens, for all frames, see `lpn.flight.files.lenses.read_camera`.
        clock_offset: seconds to add to the photos' times to get a log's time; None estimates it.
    """

    every: float = 1.0
    every_metres: float | None = None
    gps_order: GpsOrder | None = None
    fov: float | None = None
    pitch: float | None = None
    camera: Path | None = None
    clock_offset: float | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in _OPTIONS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(
                    f"--{name.replace('_', '-')} is {value:g}; expected a number from {low:g} to {high:g}."
                )


def make_flight(files: Sequence[Path], out: Path, options: FlightOptions | None = None) -> Flight:
    """Read the files of one flight, and write its folder.

    Args:
        files: photos, videos, subtitles, logs, tracks, and folders of photos, videos, and subtitles. A log alone adds
            the photos that it names, if they lie below its folder.
        out: the folder; frames of videos are written to `frames` in it.

    Raises:
        DataError: if no picture can be read, photos are mixed with videos, a log or the camera's file is damaged, no frame has
            the proportions of the camera's pictures, or a file is a track of `lpn locate`.
        InputError: if an option for videos or subtitles is set for photos.
        OutputError: if the folder cannot be written, or holds a flight.csv or flight.json that `lpn flight` did not write.
    """
    options = options or FlightOptions()
    check_folder(out)
    for file in files:
        _refuse(file)
    camera = None if options.camera is None else read_camera(options.camera)
    inputs = _sorted_files(files)
    read, unread = _read_logs(inputs)
    name = out.resolve().name
    photos, filmed = inputs["photos"], inputs["videos"]
    if photos and filmed:
        raise DataError(
            f"Photos ({len(photos)}) and videos ({len(filmed)}) have different clocks; make one flight of each."
        )
    if filmed:
        flight = _flight_of_videos(inputs, list(read.values()), out / FRAMES, name, options)
    else:
        photos = photos or [photo for file, log in read.items() for photo in _named_by(log, file)]
        if not photos:
            raise DataError(_no_pictures(inputs))
        usual = FlightOptions()
        of_videos = ("every", "every_metres", "gps_order")
        if given := [f"--{n.replace('_', '-')}" for n in of_videos if getattr(options, n) != getattr(usual, n)]:
            raise InputError(f"Every photo is used, and photos have no subtitles; leave {' and '.join(given)} out.")
        flight = _flight_of_photos(photos, name, list(read.values()), options.clock_offset)
    frames, notes = list(flight.frames), list(flight.notes)
    _complete(frames, notes, options)
    if camera is not None:
        _set_lens(frames, notes, *camera)
    flight = replace(flight, frames=tuple(frames), notes=(*notes, *unread, *_left_out_notes(inputs)))
    write_flight(flight, out)
    return flight


def read_any_log(file: Path) -> Log:
    """Read a log of any kind: a table, a track, a log of an autopilot, or subtitles.

    Raises:
        DataError: if it is damaged, of an unsupported kind, or a track by lpn locate.
    """
    _refuse(file)
    if file.suffix.lower() in videos.SUBTITLES:
        return subtitles.read_subtitles(file)
    return vehicle_logs.read_vehicle_log(file) if vehicle_logs.is_vehicle_log(file) else logs.read_log(file)


def _read_logs(inputs: _Files) -> tuple[dict[Path, Log], list[str]]:
    """Return the logs and tracks, and a note for each damaged .txt or .log; move unused files to "others"."""
    read: dict[Path, Log] = {}
    notes = []
    for file in list(inputs["logs"]):
        suffix = file.suffix.lower()
        try:
            read[file] = read_any_log(file)
        except DataError as error:
            is_other = isinstance(error, OtherKindError)
            # Cards of DJI's cameras have .bin files of satellites beside the photos.
            if suffix not in (".txt", ".log") and not (is_other and suffix == ".bin"):
                raise
            inputs["logs"].remove(file)
            inputs["others"].append(file)
            notes += [] if is_other else [str(error)]
    return read, notes


def _refuse(file: Path) -> None:
    """Raise DataError for a track or log of an unsupported kind, and for a track by lpn locate."""
    suffix = file.suffix.lower()
    if suffix in _INSTEAD:
        raise DataError(
            f"{printable(str(file))} is {suffix.upper()}, which is not read; give the flight as {_INSTEAD[suffix]}."
        )
    if suffix not in (".csv", ".geojson", ".gpx"):
        return
    head = b""
    with contextlib.suppress(OSError), file.open("rb") as opened:  # the reader of its kind reports the error
        head = opened.read(4096)
    if _OWN_TRACK.match(head):
        raise DataError(
            f"{printable(file.name)} is a track of lpn locate: its places are results, and a flight needs the drone's own "
            "data; give the photos, with the drone's log if there is one, and open the track in a map program."
        )


def photos_of(paths: Sequence[Path], name: str) -> Flight:
    """Read photos as a flight without writing it; a note names pictures of unsupported kinds.

    Args:
        paths: photos, and folders of photos.

    Raises:
        DataError: if a path is missing, or no photo can be read.
    """
    inputs = _sorted_files(paths)
    if not inputs["photos"]:
        where = ", ".join(printable(str(path)) for path in paths) or "the named paths"
        instead = f"expected {', '.join(PHOTOS)}, or a folder that lpn flight wrote"
        if inputs["videos"]:
            filmed = printable(inputs["videos"][0].name)
            instead = f"make a flight of its videos ({filmed}) with lpn flight {where} --out FLIGHT, and give FLIGHT"
        raise DataError(f"There is no photo in {where}; {instead}.")
    flight = _flight_of_photos(inputs["photos"], name)
    return replace(flight, notes=(*flight.notes, *_left_out_notes(inputs)))


def _flight_of_photos(
    files: Sequence[Path], name: str, flight_logs: Sequence[Log] = (), clock_offset: float | None = None
) -> Flight:
    """Return the flight of photos; a note names unreadable ones.

    Args:
        flight_logs, clock_offset: see `lpn.flight.files.photo_logs.with_log`.
    """
    photos, unread = _each(files, read_photo, "photo")
    photos = _with_names(photos)
    log_notes: list[str] = []
    for log in flight_logs:
        photos, notes_of_log = with_log(photos, log, clock_offset)
        log_notes += [*log.notes, *notes_of_log]
    frames, is_utc, notes = set_times(photos)
    oddities = [photo.oddities for photo in photos]
    return _flight(name, frames, is_utc, [*notes, *log_notes], unread, oddities)


def _each(files: Sequence[Path], read: Callable[[Path], T], noun: str) -> tuple[list[T], list[str]]:
    """Read each file; a note names those that cannot be read."""
    made, broken = [], []
    for file in tracked(f"Reading {noun}s", files, len(files)):
        try:
            made.append(read(file))
        except (DataError, PictureError) as error:
            broken.append(str(error))
    if not made:
        raise DataError(f"No {noun} of {len(files)} can be read. {broken[0]}")
    if not broken:
        return made, []
    more = f" {len(broken) - _NAMED} more are left out, too." if len(broken) > _NAMED else ""
    return made, [f"{len(broken)} of {len(files)} {noun}s are left out: {' '.join(broken[:_NAMED])}{more}"]


def _flight(
    name: str,
    frames: Sequence[Frame],
    is_utc: bool,
    notes: Sequence[str],
    unread: Sequence[str],
    oddities: Sequence[Sequence[str]] = (),
) -> Flight:
    """Return a flight with notes about its frames; frames without a heading get that of the course."""
    known, course_notes = with_courses(frames)
    notes = (*notes, *flight_notes(known, oddities), *course_notes, *unread)
    return Flight(name, tuple(known), notes, is_utc)


def _sorted_files(paths: Sequence[Path]) -> _Files:
    inputs: _Files = defaultdict(list)
    in_folders = (*PHOTOS, *videos.SUFFIXES, *videos.SUBTITLES, *_OTHER_PICTURES)
    for path in paths:
        if not path.exists():
            raise DataError(f"There is no {path}; give photos, videos, subtitles, logs, tracks, or folders of them.")
        for file in files_below(path, in_folders) if path.is_dir() else [path]:
            inputs[_KINDS.get(file.suffix.lower(), "others")].append(file)
    # Survey programs write other formats of a map beside it.
    maps = {file.with_suffix("") for file in inputs["photos"] if _is_map(file)}
    pictures = inputs["photos"]
    inputs["maps"] = [file for file in pictures if file.with_suffix("") in maps]
    inputs["photos"] = [file for file in pictures if file.with_suffix("") not in maps]
    for kind in ("photos", "videos"):
        inputs[kind].sort(key=lambda file: natural(file.name))
    return inputs


def _left_out_notes(inputs: _Files) -> list[str]:
    """Return notes that name the files that are left out."""
    kinds = (("their kind is not supported", inputs["others"]), ("they are maps, not photos", inputs["maps"]))
    return [
        f"Left out, because {why}: {first_few([printable(file.name) for file in files], _NAMED)}."
        for why, files in kinds
        if files
    ]


def _is_map(file: Path) -> bool:
    """Return whether a picture is a GeoTIFF or has a world file: survey programs write such files below the photos' folder."""
    world = f".{file.suffix[1:2]}{file.suffix[-1:]}w".lower()
    if any(file.with_suffix(suffix).is_file() for suffix in (world, world.upper(), ".wld")):
        return True
    if file.suffix.lower() not in (".tif", ".tiff"):
        return False
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(file) as picture:
            tags = picture.getexif()
            return any(tag in tags for tag in _GEOTIFF)
    except (*DAMAGED, Image.DecompressionBombError):
        return False  # the reader of photos reports the error


def _no_pictures(files: _Files) -> str:
    if count := len(files["subtitles"]):
        return f"There is no video for {counted(count, '.SRT file')}; give the video, too."
    if files["logs"]:
        return f"No photo that {files['logs'][0].name} names is below its folder; give the photos, or the video, beside the log."
    others = [(file, "is neither") for file in files["others"]]
    others = [(file, "is a map, which lpn map takes") for file in files["maps"]] + others
    named = f" ({printable(others[0][0].name)} {others[0][1]})" if others else ""
    return f"There is no photo and no video{named}; expected {', '.join((*PHOTOS, *videos.SUFFIXES))}."


def _named_by(log: Log, file: Path) -> list[Path]:
    named = logs.entries_by_name(log)
    photos = files_below(file.parent, PHOTOS) if named else []
    return [photo for photo in photos if photo.name.casefold() in named or photo.stem.casefold() in named]


def _with_names(photos: Sequence[Photo]) -> list[Photo]:
    """Make names unique: if names repeat, use paths below the common folder."""
    if len({photo.frame.name for photo in photos}) == len(photos):
        return list(photos)
    files = [photo.frame.file.resolve() for photo in photos]
    common = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(common).as_posix() for file in files]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DataError(f"{printable(twice[0])} is given twice; give each photo once.")
    return [replace(photo, frame=replace(photo.frame, name=name)) for photo, name in zip(photos, names, strict=True)]


def _flight_of_videos(
    files: _Files, flight_logs: Sequence[Log], folder: Path, name: str, options: FlightOptions
) -> Flight:
    filmed = files["videos"]
    stems = Counter(video.stem.casefold() for video in filmed)
    if twice := [stem for stem, count in stems.items() if count > 1]:
        raise DataError(
            f"Two videos are named {printable(twice[0])}; their frames would replace each other, so rename one."
        )

    def read(video: Path) -> videos.VideoFrames:
        notes: list[str] = []
        log = _telemetry(video, files, flight_logs, options, notes)
        film = videos.read_frames(video, folder, log, options.every, options.every_metres)
        return film._replace(notes=notes + film.notes)

    films, unread = _each(filmed, read, "video")
    notes = [note for log in flight_logs for note in log.notes]
    notes += [note for film in films for note in film.notes]
    starts = [film.start for film in films if film.start is not None]
    if len(starts) == len(films):
        offsets = [start - min(starts) for start in starts]
    else:
        offsets = [sum(film.duration for film in films[:i]) for i in range(len(films))]
        if len(films) > 1:
            notes.append(f"Not all of the {len(films)} videos have a start time; their times follow one another.")
    frames = [
        replace(frame, time=(frame.time or 0.0) + offset)
        for film, offset in zip(films, offsets, strict=True)
        for frame in film.frames
    ]
    frames.sort(key=lambda frame: (frame.time, natural(frame.name)))
    return _flight(name, frames, False, notes, unread)


def _telemetry(video: Path, files: _Files, flight_logs: Sequence[Log], options: FlightOptions, notes: list[str]) -> Log:
    """Return a video's telemetry from a log, else its `.SRT` file, else the video itself, else without entries; add notes."""
    for log in flight_logs:
        try:
            entries, notes_of_log = logs.for_video(log, files["videos"].index(video), videos.began(video))
        except DataError as error:
            notes.append(str(error))
            continue
        notes += notes_of_log
        return replace(log, entries=tuple(entries))
    given = files["subtitles"]
    file = given[0] if len(files["videos"]) == len(given) == 1 else videos.beside(video, given)
    can_look_inside = find_spec("av") is not None
    found = None
    try:
        if file is not None:
            found = subtitles.read_subtitles(file, options.gps_order)
        elif can_look_inside:
            found = videos.embedded_subtitles(video, options.gps_order)
    except DataError as error:
        notes.append(str(error))
    if found is not None:
        notes += found.notes
        return found
    install = "; those inside of it need the package av: pip install 'lpn-explorer[maps]'"
    inside = "" if can_look_inside or file is not None else install
    notes.append(f"{printable(video.name)} has no subtitles with telemetry{inside}.")
    return Log(video.name, (), False, ())


def _set_lens(frames: list[Frame], notes: list[str], lens: Lens, proportions: float) -> None:
    """Set the lens of frames with these proportions (height over width), and add a note with their number."""
    fits = [i for i, f in enumerate(frames) if abs(f.height / f.width / proportions - 1) <= _SAME_PROPORTIONS]
    if not fits:
        frame = frames[0]
        raise DataError(
            f"The camera's pictures are {proportions:.3f} times as high as wide, and those of the flight, such as "
            f"{printable(frame.name)}, {frame.height / frame.width:.3f} times; give the file of the flight's camera."
        )
    for i in fits:
        frames[i] = replace(frames[i], lens=lens, fov=lens.fov)
    notes.append(
        f"The lens of {len(fits)} of {len(frames)} photos is the one given with --camera, as is their field of view."
    )


def _complete(frames: list[Frame], notes: list[str], options: FlightOptions) -> None:
    """Fill unknown fields of view and pitches by the options, and add notes."""
    for name, value, noun in (("fov", options.fov, "field of view"), ("pitch", options.pitch, "pitch")):
        if value is None:
            continue
        changed: dict[str, Any] = {name: value}
        missing = [i for i, frame in enumerate(frames) if getattr(frame, name) is None]
        for i in missing:
            frames[i] = replace(frames[i], **changed)
        given = f"The {noun} of {len(missing)} of {len(frames)} photos is the {value:g}° given with --{name}."
        notes.append(given if missing else f"No file lacks the {noun}, so --{name} is not used.")
