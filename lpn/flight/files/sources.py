"""A flight from its files: photos, or videos with subtitles, each with or without logs."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import numpy as np

from lpn.core import images
from lpn.core.errors import DataError, InputError, OtherKindError, PictureError
from lpn.core.files import first_few, printable
from lpn.core.numbers import distance
from lpn.datasets.base import files_below
from lpn.flight.files import cameras, logs, subtitles, track_files, vehicle_logs, videos
from lpn.flight.files.base import Flight, Frame, HeadingSource, local_metres
from lpn.flight.files.clock_fit import ClockFit, fit_clocks
from lpn.flight.files.folder import FRAMES, check_folder, write_flight
from lpn.flight.files.lenses import Lens, read_camera
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.photos import Photo, natural, read_photo, set_times, turned_oddity, upright_values
from lpn.flight.files.quality import flight_notes, with_courses
from lpn.flight.files.subtitles import GpsOrder, Subtitles
from lpn.flight.files.telemetry import VALUES, Telemetry, TelemetryEntry

PHOTOS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
# Pictures of other kinds, which a note names.
_OTHER_PICTURES = (*images.OTHER_SUFFIXES, ".bmp", ".gif")
# The beginning of a track that lpn locate wrote, by its suffix.
_OWN_TRACKS = {
    ".csv": re.compile(rb"(?:\xef\xbb\xbf)?frame,stage,state,"),
    ".geojson": re.compile(rb'.*"properties":\s*\{\s*"frame":.*?"stage":.*?"state":', re.DOTALL),
    ".gpx": re.compile(rb'.*creator="lpn locate"', re.DOTALL),
}
# The formats to give in place of kinds that are not read.
_INSTEAD = {
    **dict.fromkeys((".kml", ".kmz"), "GPX or CSV"),
    **dict.fromkeys((".bag", ".db3", ".mcap"), "CSV, .ulg, .tlog, or .bin"),
    **dict.fromkeys((".ass", ".vtt"), "SRT"),
}
_NAMED = 5
_ANGLES = ("heading", "pitch", "roll", "heading_source")
# Frames closer together than this in seconds are one picture.
_LEAST_EVERY = 0.04
# Latitude and longitude of a log count as swapped if the log lies more than `_SWAPPED_FAR` metres from the photos as it is, and
# less than `_SWAPPED_NEAR` metres after a swap.
_SWAPPED_NEAR, _SWAPPED_FAR = 5_000.0, 20_000.0
# Proportions of pictures that differ by less are those of one camera.
_SAME_PROPORTIONS = 0.01


@dataclass(frozen=True)
class FlightOptions:
    """How a flight is read.

    Attributes:
        every: seconds from one frame of a video to the next.
        every_metres: metres flown from one frame of a video to the next, in place of `every`.
        gps_order: order of the first two values of GPS(a, b, c) in subtitles; None detects it.
        fov: horizontal field of view in degrees, for frames whose files have none.
        pitch: in degrees, for frames whose files have none; -90 is straight down.
        camera: file of the camera's lens, for all frames, see `lpn.flight.files.lenses.read_camera`.
    """

    every: float = 1.0
    every_metres: float | None = None
    gps_order: GpsOrder | None = None
    fov: float | None = None
    pitch: float | None = None
    camera: Path | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("every", _LEAST_EVERY, 86_400.0),
            ("every_metres", 0.1, 1e6),
            ("fov", *cameras.FOV_RANGE),
            ("pitch", -180, 90),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(
                    f"--{name.replace('_', '-')} is {value:g}; expected a number from {low:g} to {high:g}."
                )


@dataclass(frozen=True)
class _Files:
    """Files of a flight by kind."""

    photos: list[Path]
    videos: list[Path]
    subtitles: list[Path]
    logs: list[Path]
    others: list[Path]


def make_flight(files: Sequence[Path], out: Path, options: FlightOptions | None = None) -> Flight:
    """Read the files of one flight, and write its folder.

    Args:
        files: photos, videos, subtitles, logs, tracks, and folders of photos, videos, and subtitles. A log alone brings the
            photos that it names from below its folder.
        out: the folder; frames of videos are written to `frames` in it.

    Raises:
        DataError: if there are no pictures, none can be read, photos are mixed with videos, or a log or the camera's file is
            damaged, or the camera's pictures have other proportions than all frames, or a file is a track of `lpn locate`.
        InputError: if an option is about videos or subtitles, and the files are photos.
        OutputError: if the folder cannot be written, or holds a flight.csv or flight.json that `lpn flight` did not write.
    """
    options = options or FlightOptions()
    check_folder(out)
    _refuse(files)
    camera = None if options.camera is None else read_camera(options.camera)
    inputs = _sorted_files(files)
    read, texts, unread = _read_logs(inputs.logs)
    inputs = replace(inputs, logs=list(read), others=[*inputs.others, *texts])
    name = out.resolve().name
    if inputs.photos and inputs.videos:
        raise DataError(
            f"Photos ({len(inputs.photos)}) and videos ({len(inputs.videos)}) have different clocks; make one flight of each."
        )
    if inputs.videos:
        flight = _flight_of_videos(inputs, list(read.values()), out / FRAMES, name, options)
    else:
        photos = inputs.photos or [photo for file, log in read.items() for photo in _named_by(log, file)]
        if not photos:
            raise DataError(_no_pictures(inputs))
        if given := _of_videos(options):
            raise InputError(
                f"Photos are all taken, and have no subtitles, so {' and '.join(given)} would not be used; leave it out."
            )
        flight = flight_of_photos(photos, name, list(read.values()))
    flight = _completed(flight, options)
    if camera is not None:
        flight = _with_lens(flight, *camera)
    flight = replace(flight, notes=(*flight.notes, *unread, *_others_note(inputs.others)))
    write_flight(flight, out)
    return flight


def read_any_log(file: Path) -> Log:
    """Read a log of any kind: a table, a track, or a log of an autopilot.

    Raises:
        DataError: if it is damaged, of no kind that is read, or a track that lpn locate wrote.
    """
    _refuse([file])
    suffix = file.suffix.lower()
    if suffix in vehicle_logs.SUFFIXES:
        return vehicle_logs.read_vehicle_log(file)
    return track_files.read_track(file) if suffix in track_files.SUFFIXES else logs.read_log(file)


def _read_logs(files: list[Path]) -> tuple[dict[Path, Log], list[Path], list[str]]:
    """Return the logs and tracks, the other files that are no logs, and a note for each of these that is nearly a log."""
    read: dict[Path, Log] = {}
    others, notes = [], []
    for file in files:
        try:
            read[file] = read_any_log(file)
        except OtherKindError:
            # Cards of DJI's cameras have .bin files of satellites beside the photos.
            if file.suffix.lower() not in (".txt", ".log", ".bin"):
                raise
            others.append(file)
        except DataError as error:
            if file.suffix.lower() not in (".txt", ".log"):
                raise
            others.append(file)
            notes.append(str(error))
    return read, others, notes


def _refuse(files: Sequence[Path]) -> None:
    """Raise DataError if a file is a track or a log of a kind that is not read, or a track that lpn locate wrote."""
    for file in files:
        suffix = file.suffix.lower()
        if suffix in _INSTEAD:
            raise DataError(
                f"{printable(str(file))} is {suffix.upper()}, which is not read; give the flight as {_INSTEAD[suffix]}."
            )
        begin = _OWN_TRACKS.get(suffix)
        if begin is None or not file.is_file():
            continue
        try:
            with file.open("rb") as opened:
                head = opened.read(4096)
        except OSError:
            continue  # its own reader tells why
        if begin.match(head):
            raise DataError(
                f"{printable(file.name)} is a track of lpn locate: it has places found on a map, and a flight needs what the "
                "drone told; give the photos, with the drone's own log if there is one, and open the track in a map program."
            )


def flight_of_folder(folder: Path) -> Flight:
    """Return the flight of the photos below a folder; a note names pictures of kinds that are not read.

    Raises:
        DataError: if there is no photo, or none can be read.
    """
    files = files_below(folder, PHOTOS)
    if not files:
        if filmed := files_below(folder, videos.SUFFIXES):
            raise DataError(
                f"{printable(str(folder))} has videos ({printable(filmed[0].name)}) and no flight.json; make a flight of them "
                f"with lpn flight {printable(str(folder))} --out FLIGHT, and give FLIGHT."
            )
        raise DataError(
            f"{folder} has neither flight.json nor photos ({', '.join(PHOTOS)}); give a folder that lpn flight wrote, or one of "
            "photos."
        )
    flight = flight_of_photos(files, folder.resolve().name)
    return replace(flight, notes=(*flight.notes, *_others_note(files_below(folder, _OTHER_PICTURES))))


def photos_of(paths: Sequence[Path], name: str) -> Flight:
    """Read photos as a flight, without writing it.

    Args:
        paths: photos, and folders of photos.

    Raises:
        DataError: if a path is not there, or none has a photo that can be read.
    """
    photos = _sorted_files(paths).photos
    if not photos:
        where = ", ".join(printable(str(path)) for path in paths) or "what was named"
        raise DataError(f"There is no photo in {where}; expected {', '.join(PHOTOS)}.")
    return flight_of_photos(photos, name)


def _others_note(files: Sequence[Path]) -> list[str]:
    """Return the note, if any, that names files which are left out."""
    if not files:
        return []
    return [
        f"Left out, because their kind is not supported: {first_few([printable(file.name) for file in files], _NAMED)}."
    ]


def flight_of_photos(files: Sequence[Path], name: str, flight_logs: Sequence[Log] = ()) -> Flight:
    """Return the flight of photos; those that cannot be read are left out, and a note names them.

    Args:
        flight_logs: their values replace those of the photos, except for a heading whose source is worse than the photo's, and
            the field of view of a photo whose lens is known.

    Raises:
        DataError: if no photo can be read, or one is given twice.
    """
    photos, broken = [], []
    for file in files:
        try:
            photos.append(read_photo(file))
        except PictureError as error:
            broken.append(str(error))
    if not photos:
        raise DataError(f"No photo of {len(files)} can be read. {broken[0] if broken else 'Give photos.'}")
    named = _with_names(photos)
    log_notes: list[str] = []
    for log in flight_logs:
        named, notes_of_log = _logged(named, log)
        log_notes += [*log.notes, *notes_of_log]
    frames, is_utc, notes = set_times(named)
    frames, course_notes = with_courses(frames, {photo.frame.name for photo in named if photo.heading_unread})
    notes += log_notes + flight_notes(frames, [photo.oddities for photo in named]) + course_notes
    if broken:
        more = f" {len(broken) - _NAMED} more are left out, too." if len(broken) > _NAMED else ""
        notes.append(f"{len(broken)} of {len(files)} photos are left out: {' '.join(broken[:_NAMED])}{more}")
    return Flight(name, tuple(frames), tuple(notes), is_utc)


def _sorted_files(paths: Sequence[Path]) -> _Files:
    """Sort files by kind, those of folders too."""
    inputs = _Files([], [], [], [], [])
    kinds = (
        (PHOTOS, inputs.photos),
        (videos.SUFFIXES, inputs.videos),
        (videos.SUBTITLES, inputs.subtitles),
        ((*logs.SUFFIXES, *track_files.SUFFIXES, *vehicle_logs.SUFFIXES), inputs.logs),
    )
    taken = (*PHOTOS, *videos.SUFFIXES, *videos.SUBTITLES, *_OTHER_PICTURES)
    for path in paths:
        if not path.exists():
            raise DataError(f"There is no {path}; give photos, videos, subtitles, logs, tracks, or folders of them.")
        inside = path.is_dir()
        for file in files_below(path, taken) if inside else [path]:
            kind = next((kept for suffixes, kept in kinds if file.suffix.lower() in suffixes), inputs.others)
            kind.append(file)
    for kind in (inputs.photos, inputs.videos):
        kind.sort(key=lambda file: natural(file.name))
    return inputs


def _no_pictures(files: _Files) -> str:
    if files.subtitles:
        return f"There is no video for {len(files.subtitles)} .SRT file{'s' * (len(files.subtitles) > 1)}; give the video, too."
    if files.logs:
        return f"No photo that {files.logs[0].name} names is below its folder; give the photos, or the video, beside the log."
    others = f" ({printable(files.others[0].name)} is neither)" if files.others else ""
    return f"There is no photo and no video{others}; expected {', '.join((*PHOTOS, *videos.SUFFIXES))}."


def _named_by(log: Log, file: Path) -> list[Path]:
    """Return the photos below a log's folder that it names."""
    rows = logs.rows_by_name(log)
    return [
        photo
        for photo in (files_below(file.parent, PHOTOS) if rows else [])
        if photo.name.casefold() in rows or photo.stem.casefold() in rows
    ]


def _with_names(photos: Sequence[Photo]) -> list[Photo]:
    """Make names unique: if names repeat, use each photo's path below the folder that all of them share."""
    counts = Counter(photo.frame.name for photo in photos)
    if len(counts) == len(photos):
        return list(photos)
    files = [photo.frame.file.resolve() for photo in photos]
    common = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(common).as_posix() for file in files]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise DataError(f"{printable(twice)} is given twice; give each photo once.")
    return [replace(photo, frame=replace(photo.frame, name=name)) for photo, name in zip(photos, names, strict=True)]


def _logged(photos: Sequence[Photo], log: Log) -> tuple[list[Photo], list[str]]:
    """Return photos with a log's values, and notes.

    Rows are matched to photos by file name if the log has file names, else by time.
    """
    log, notes = _turned_as_photos(log, photos)
    rows = logs.rows_by_name(log)
    how, why_not = "by name", ""
    if rows:
        chosen = [_row_of(photo, rows) for photo in photos]
        made = [
            photo if row is None else _with_entry(photo, row[0].entry, log.utc)
            for photo, row in zip(photos, chosen, strict=True)
        ]
        notes += _twice_note(photos, chosen, log.name)
    else:
        moments, note_of_twice = logs.moments(log)
        notes += [] if note_of_twice is None else [note_of_twice]
        telemetry = Telemetry(moments)
        fit = fit_clocks(photos, telemetry, log.utc)
        how, why_not = f"by {fit.basis}", "" if fit.offset is not None else f": {fit.sentence}"
        made = [_at_moment(photo, telemetry, fit, log.utc) for photo in photos]
        how += f", {fit.sentence}" if fit.sentence and fit.offset is not None else ""
    used = sum(after is not before for after, before in zip(made, photos, strict=True))
    if not used:
        return list(photos), [
            *notes,
            f"{log.name} fits none of the {len(photos)} photos {how}, and was not used{why_not}.",
        ]
    said = f"{log.name} gives the values of {used} of {len(photos)} photos, {how}; they replace those in the files."
    return made, [*notes, said]


def _at_moment(photo: Photo, telemetry: Telemetry, fit: ClockFit, utc: bool) -> Photo:
    """Return a photo with the log's values at the time it was taken, and with its UTC time if the log's clock is UTC."""
    time = photo.utc if fit.basis == "UTC" else photo.local
    if time is None or fit.offset is None:
        return photo
    known = {name: value for name, value in telemetry.at(time + fit.offset).items() if value is not None}
    if "latitude" not in known:
        return photo
    made = _with_values(photo, known)
    return replace(made, utc=time + fit.offset) if utc and photo.utc is None else made


def _row_of(photo: Photo, rows: dict[str, list[LogRow]]) -> tuple[LogRow, list[LogRow]] | None:
    """Return the row that names a photo, and all rows that name it equally well; None without one.

    If several rows have the name, the longest match of folders wins, then the row nearest to the photo, then the first row.
    """
    file = photo.frame.file
    named = rows.get(file.name.casefold()) or rows.get(file.stem.casefold(), [])
    if not named:
        return None
    parts = logs.path_parts(str(file))
    named = [named[i] for i in logs.nearest_in_folders(parts, [logs.path_parts(row.file or "") for row in named])]
    distances = [_metres_apart(photo.frame, row.entry) for row in named]
    known = [(metres, i) for i, metres in enumerate(distances) if metres is not None]
    return named[min(known)[1] if known else 0], named


def _metres_apart(frame: Frame | TelemetryEntry, entry: TelemetryEntry) -> float | None:
    """Return the metres between two positions, None if one is unknown."""
    if frame.latitude is None or entry.latitude is None:
        return None
    both = np.array([(frame.latitude, frame.longitude), (entry.latitude, entry.longitude)], np.float64)
    return float(np.hypot(*local_metres(both)[1]))


def _twice_note(photos: Sequence[Photo], chosen: Sequence[tuple[LogRow, list[LogRow]] | None], name: str) -> list[str]:
    """Return a note, if any, about pictures that a log lists more than once with different values."""
    twice = [
        (photo, pair[1])
        for photo, pair in zip(photos, chosen, strict=True)
        if pair is not None
        and any(replace(row.entry, time=0.0) != replace(pair[1][0].entry, time=0.0) for row in pair[1])
    ]
    if not twice:
        return []
    photo, rows = twice[0]
    apart = [metres for row in rows[1:] if (metres := _metres_apart(rows[0].entry, row.entry)) is not None]
    lines = " and ".join(str(row.line) for row in rows[:3])
    used = (
        "the row nearest to the photo's own position was used"
        if all(photo.frame.latitude is not None for photo, _ in twice)
        else "the row nearest to the photo's own position was used, and the first row where the photo has none"
        if any(photo.frame.latitude is not None for photo, _ in twice)
        else "the first row was used, as the photo has no position of its own"
    )
    return [
        f"{len(twice)} of {len(photos)} photos are listed more than once in {name} with different values, such as "
        f"{printable(photo.frame.name)} in lines {lines}{f', up to {distance(max(apart))} apart' if apart else ''}; {used}."
    ]


def _turned_as_photos(log: Log, photos: Sequence[Photo]) -> tuple[Log, list[str]]:
    """Swap latitude and longitude of a log if the photos' positions prove that they are swapped; also return a note if so."""
    ours = np.array([(p.frame.latitude, p.frame.longitude) for p in photos if p.frame.latitude is not None], np.float64)
    theirs = np.array(
        [(r.entry.latitude, r.entry.longitude) for r in log.rows if r.entry.latitude is not None], np.float64
    )
    if not len(ours) or not len(theirs) or np.abs(theirs[:, 1]).max() > 90:
        return log, []
    here, there = np.median(ours, axis=0), np.median(theirs, axis=0)
    far, near = (float(np.hypot(*local_metres(np.stack([here, place]))[1])) for place in (there, there[::-1]))
    if near > _SWAPPED_NEAR or far < _SWAPPED_FAR:
        return log, []
    rows = tuple(
        replace(row, entry=replace(row.entry, latitude=row.entry.longitude, longitude=row.entry.latitude))
        for row in log.rows
    )
    return replace(log, rows=rows), [
        f"Latitude and longitude of {log.name} are swapped, as the photos' own positions say."
    ]


def _with_entry(photo: Photo, entry: TelemetryEntry, utc: bool) -> Photo:
    values = {name: value for name in VALUES if (value := getattr(entry, name)) is not None}
    made = _with_values(photo, values)
    if entry.clock is None:
        return made
    return replace(made, utc=entry.clock) if utc else replace(made, local=made.local or entry.clock)


def _with_values(photo: Photo, values: dict[str, Any]) -> Photo:
    """Return a photo with a log's values, turned as the picture is; angles whose source is worse are left out."""
    frame, oddities = photo.frame, photo.oddities
    if "heading" in values:
        sources = get_args(HeadingSource)  # best first
        ours, theirs = frame.heading_source, values["heading_source"]
        if ours is not None and sources.index(ours) < sources.index(theirs):
            values = {name: value for name, value in values.items() if name not in _ANGLES}
            oddities = (
                *oddities,
                f"keeps the heading of its {ours}, which is better than that of the {theirs} in the log",
            )
        elif photo.turns:
            oddities = tuple(dict.fromkeys((*oddities, turned_oddity(photo.turns))))
    if "fov" in values and frame.lens is not None:
        oddities = (*oddities, "keeps the field of view of its lens, and not that in the log")
    return replace(photo, frame=replace(frame, **upright_values(values, photo.turns, frame)), oddities=oddities)


def _flight_of_videos(
    files: _Files, flight_logs: Sequence[Log], folder: Path, name: str, options: FlightOptions
) -> Flight:
    """Return the flight of videos; one that cannot be read is left out, and a note names it."""
    parts: list[tuple[videos.VideoFrames, float | None]] = []
    notes = [note for log in flight_logs for note in log.notes]
    broken: list[str] = []
    stems = Counter(video.stem.casefold() for video in files.videos)
    if twice := [stem for stem, count in stems.items() if count > 1]:
        raise DataError(
            f"Two videos are named {printable(twice[0])}; their frames would replace each other, so rename one."
        )
    for number, video in enumerate(files.videos):
        try:
            telemetry, known_subtitles, subtitle_notes = _telemetry(video, files, flight_logs, number, options)
            part = videos.read_frames(
                video, folder, options.every, options.every_metres, telemetry, known_subtitles is not None
            )
        except DataError as error:
            broken.append(str(error))
            continue
        notes += subtitle_notes
        if known_subtitles is not None:
            subtitle, where = known_subtitles
            note = videos.mismatch(subtitle, where, video, part.duration)
            notes += [] if note is None else [note]
        notes += _turned_note(part, video)
        first = next((entry for entry in telemetry.entries if entry.clock is not None), None) if telemetry else None
        parts.append((part, None if first is None or first.clock is None else first.clock - first.time))
    if not parts:
        raise DataError(f"No video of {len(files.videos)} can be read. {broken[0]}")
    frames, clock_notes = _on_one_clock(parts)
    frames, course_notes = with_courses(frames)
    notes += clock_notes + flight_notes(frames) + course_notes
    if broken:
        notes.append(f"{len(broken)} of {len(files.videos)} videos are left out: {' '.join(broken[:_NAMED])}")
    return Flight(name, tuple(frames), tuple(notes))


def _turned_note(part: videos.VideoFrames, video: Path) -> list[str]:
    """Return a note, if any, about a video that its file has shown turned."""
    if not part.turns:
        return []
    sources = {frame.heading_source for frame in part.frames if frame.heading is not None}
    turned = f"{printable(video.name)} is turned by {90 * part.turns}° by its file"
    if not sources:
        return [f"{turned}."]
    # A gimbal that rolls the camera leaves the aircraft's heading to the top of the picture.
    doubt = " If the gimbal itself turned the camera, the heading, which is that of the aircraft, is off by as much."
    return [f"{turned}, and its heading with it.{doubt if 'aircraft' in sources else ''}"]


def _telemetry(
    video: Path, files: _Files, flight_logs: Sequence[Log], number: int, options: FlightOptions
) -> tuple[Telemetry | None, tuple[Subtitles, str] | None, list[str]]:
    """Return a video's telemetry from a log, else from its `.SRT` file, else from inside; its subtitles; and notes."""
    notes: list[str] = []
    for log in flight_logs:
        try:
            entries, notes_of_log = logs.for_video(log, number, videos.began(video))
        except DataError as error:
            notes.append(str(error))
            continue
        return Telemetry(entries), None, [*notes, *notes_of_log]
    only = files.subtitles if len(files.videos) == len(files.subtitles) == 1 else []
    file = only[0] if only else videos.beside(video, files.subtitles)
    known_subtitles = None
    try:
        if file is not None:
            known_subtitles = subtitles.read_subtitles(file, options.gps_order)
        elif find_spec("av") is not None:
            known_subtitles = videos.embedded_subtitles(video, options.gps_order)
    except DataError as error:
        notes.append(str(error))
    if known_subtitles is None:
        inside = "" if find_spec("av") is not None or file is not None else (
            "; those inside of it need the package av: pip install 'lpn-explorer[maps]'"
        )  # fmt: skip
        return None, None, [*notes, f"{printable(video.name)} has no subtitles with telemetry{inside}."]
    where = file.name if file is not None else "the subtitle stream"
    return Telemetry(known_subtitles.entries), (known_subtitles, where), [*notes, *known_subtitles.notes]


def _on_one_clock(parts: Sequence[tuple[videos.VideoFrames, float | None]]) -> tuple[list[Frame], list[str]]:
    """Put the frames of several videos on one clock that starts with the first; `parts` have each video's start, if known."""
    starts = [start for _, start in parts if start is not None]
    notes = []
    if len(starts) == len(parts):
        offsets = [start - min(starts) for start in starts]
    else:
        offsets = [sum(part.duration for part, _ in parts[:i]) for i in range(len(parts))]
        if len(parts) > 1:
            notes.append(f"Not all of the {len(parts)} videos have a start time; their times follow one another.")
    frames = [
        replace(frame, time=(frame.time or 0.0) + offset)
        for (part, _), offset in zip(parts, offsets, strict=True)
        for frame in part.frames
    ]
    return sorted(frames, key=lambda frame: (frame.time, natural(frame.name))), notes


def _of_videos(options: FlightOptions) -> list[str]:
    """Return the options on the command line that say something about videos or subtitles."""
    usual = FlightOptions()
    names = ("every", "every_metres", "gps_order")
    return [f"--{name.replace('_', '-')}" for name in names if getattr(options, name) != getattr(usual, name)]


def _with_lens(flight: Flight, lens: Lens, proportions: float) -> Flight:
    """Give a lens to the frames whose pictures have these proportions (height over width), and say how many they are."""
    fits = [abs(frame.height / frame.width / proportions - 1) <= _SAME_PROPORTIONS for frame in flight.frames]
    if not any(fits):
        frame = flight.frames[0]
        raise DataError(
            f"The camera's pictures are {proportions:.3f} times as high as wide, and those of the flight, such as "
            f"{printable(frame.name)}, {frame.height / frame.width:.3f} times; give the file of the flight's camera."
        )
    frames = tuple(
        replace(frame, lens=lens, fov=lens.fov) if fit else frame
        for frame, fit in zip(flight.frames, fits, strict=True)
    )
    note = f"The lens of {sum(fits)} of {len(frames)} photos is the one given with --camera, as is their field of view."
    return replace(flight, frames=frames, notes=(*flight.notes, note))


def _completed(flight: Flight, options: FlightOptions) -> Flight:
    """Fill unknown fields of view and pitches with those given, and say so."""
    frames, notes = list(flight.frames), list(flight.notes)
    for name, value, noun in (("fov", options.fov, "field of view"), ("pitch", options.pitch, "pitch")):
        missing = [i for i, frame in enumerate(frames) if getattr(frame, name) is None]
        if value is not None and missing:
            for i in missing:
                changed: dict[str, Any] = {name: value}
                frames[i] = replace(frames[i], **changed)
            notes.append(f"The {noun} of {len(missing)} of {len(frames)} photos is the {value:g}° given with --{name}.")
        elif value is not None:
            notes.append(f"No file lacks the {noun}, so --{name} is not used.")
    return replace(flight, frames=tuple(frames), notes=tuple(notes))
