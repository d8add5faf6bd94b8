"""Photos with the values of a log or track, matched by file name, else by time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from lpn.core.files import first_few, printable
from lpn.core.numbers import distance
from lpn.flight.files import logs
from lpn.flight.files.base import Frame, HeadingSource, local_metres
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.clock_fit import fit_clocks
from lpn.flight.files.photos import Photo, turned_oddity
from lpn.flight.files.telemetry import Log, Telemetry, TelemetryEntry

# A row belongs to one of several photos of its name if that photo is this many times nearer to it than the others.
_CLEARLY = 3.0
# A note doubts a log's positions if their median distance in metres from the photos' positions is larger.
_ELSEWHERE = 1000.0
_ANGLES = ("heading", "pitch", "roll", "heading_source")


def with_log(photos: Sequence[Photo], log: Log, clock_offset: float | None = None) -> tuple[list[Photo], list[str]]:
    """Return photos with a log's values, and notes.

    Rows are matched by file name if the log has file names, else by time. The log's values replace the photos' values. Two
    stay: a heading of a better source, and the field of view of a photo of known lens.

    Args:
        clock_offset: seconds to add to the photos' times to get the log's time; None estimates it.
    """
    named = logs.entries_by_name(log)
    how, why_not, notes = "by name", "", list[str]()
    if named:
        made = _by_name(photos, log, named, notes)
    else:
        entries, notes = logs.moments(log)
        telemetry = Telemetry(entries)
        fit = fit_clocks(photos, telemetry, log.utc, clock_offset)
        how = f"by {fit.basis}"
        if fit.offset is None:
            made, why_not = list(photos), f": {fit.sentence}"
        else:
            made = [_at_its_time(photo, telemetry, log.utc, fit.basis == "UTC", fit.offset) for photo in photos]
            how += f", {fit.sentence}" if fit.sentence else ""
    used = sum(after is not before for after, before in zip(made, photos, strict=True))
    if used:
        said = f"{log.name} gives the values of {used} of {len(photos)} photos, {how}; they replace those in the files."
    else:
        said = f"{log.name} fits no photo {how}, and was not used{why_not}."
    return made, [*notes, said]


def _by_name(
    photos: Sequence[Photo], log: Log, by_name: Mapping[str, Sequence[TelemetryEntry]], notes: list[str]
) -> list[Photo]:
    """Return photos with the entries that name them; add notes about ambiguous names."""
    paths = [logs.path_parts(str(photo.frame.file)) for photo in photos]
    claims: dict[TelemetryEntry, list[int]] = defaultdict(list)
    twice = []
    for i, photo in enumerate(photos):
        frame = photo.frame
        named = by_name.get(frame.file.name.casefold()) or by_name.get(frame.file.stem.casefold(), [])
        folders = [logs.path_parts(entry.file or "") for entry in named]
        found = [named[j] for j in logs.nearest_in_folders(paths[i], folders)]
        if not found:
            continue
        claims[min(found, key=lambda entry: _metres_apart(frame, entry))].append(i)
        if any((entry.clock, entry.values()) != (found[0].clock, found[0].values()) for entry in found):
            twice.append(f"{printable(frame.name)} in lines {' and '.join(str(entry.line) for entry in found[:3])}")
    made, moved = list(photos), []
    for entry, claiming in claims.items():
        nearest = logs.nearest_in_folders(logs.path_parts(entry.file or ""), [paths[i] for i in claiming])
        apart = sorted((_metres_apart(photos[claiming[j]].frame, entry), claiming[j]) for j in nearest)
        if len(apart) == 1 or _CLEARLY * apart[0][0] < apart[1][0] <= apart[-1][0] < math.inf:
            metres, i = apart[0]
            made[i] = _with_entry(photos[i], entry, log.utc)
            if metres < math.inf:
                moved.append(metres)
            continue
        names = first_few([printable(photos[i].frame.name) for i in sorted(i for _, i in apart)], 3)
        notes.append(
            f"{log.name} names {printable(entry.file or '')}, which {len(apart)} photos are called ({names}), so none of them "
            "has its values; write the photos' folders into the log."
        )
    if twice:
        notes.append(
            f"{len(twice)} of {len(photos)} photos are listed more than once in {log.name} with different values, such as "
            f"{twice[0]}; the row nearest to the photo's position was used, or the first row if that is unknown."
        )
    if moved and (middle := float(np.median(moved))) > _ELSEWHERE:
        notes.append(
            f"The positions of {log.name} are {distance(middle)} from those of the photos in the median; check that the log is "
            "of this flight, and that its latitude and longitude are not exchanged."
        )
    return made


def _metres_apart(frame: Frame, entry: TelemetryEntry) -> float:
    """Return the metres between two positions, infinite if one is unknown."""
    if frame.latitude is None or entry.latitude is None:
        return math.inf
    both = np.array([(frame.latitude, frame.longitude), (entry.latitude, entry.longitude)], np.float64)
    return float(np.hypot(*local_metres(both)[1]))


def _at_its_time(photo: Photo, telemetry: Telemetry, utc: bool, by_utc: bool, offset: float) -> Photo:
    """Return a photo with the telemetry at its time; unchanged where the telemetry has no position."""
    time = photo.utc if by_utc else photo.local
    known = {} if time is None else telemetry.at(time + offset)
    if time is None or "latitude" not in known:
        return photo
    return replace(_with_values(photo, known), utc=time + offset if utc and photo.utc is None else photo.utc)


def _with_entry(photo: Photo, entry: TelemetryEntry, utc: bool) -> Photo:
    made = _with_values(photo, entry.values())
    if entry.clock is None:
        return made
    return replace(made, utc=entry.clock) if utc else replace(made, local=made.local or entry.clock)


def _with_values(photo: Photo, values: dict[str, Any]) -> Photo:
    """Return a photo with a log's values, turned like the upright picture; angles of a worse source are left out."""
    frame, oddities = photo.frame, list(photo.oddities)
    if "heading" in values:
        sources = get_args(HeadingSource)  # best first
        ours, theirs = frame.heading_source, values["heading_source"]
        if ours is not None and sources.index(ours) < sources.index(theirs):
            values = {name: value for name, value in values.items() if name not in _ANGLES}
            oddities.append(f"keeps the heading of its {ours}, which is better than that of the {theirs} in the log")
        elif photo.turns and turned_oddity(photo.turns) not in oddities:
            oddities.append(turned_oddity(photo.turns))
    if "fov" in values and frame.lens is not None:
        oddities.append("keeps the field of view of its lens, and not that in the log")
    upright = upright_values(values, photo.turns, frame)
    return replace(photo, frame=replace(frame, **upright), oddities=tuple(oddities))
