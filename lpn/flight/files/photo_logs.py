"""Photos with the values of a log or track, matched by file name, else by time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from lpn.core.files import first_few, printable
from lpn.core.numbers import distance
from lpn.flight.files import logs
from lpn.flight.files.base import Frame, HeadingSource, local_metres
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.clock_fit import fit_clocks
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.photos import Photo, turned_oddity
from lpn.flight.files.telemetry import VALUES, Telemetry, TelemetryEntry

# A row belongs to one of several photos of its name if that photo is this many times nearer to it than the others.
_CLEARLY = 3.0
# Median distance in metres of a log's positions from the photos' own above which a note doubts them.
_ELSEWHERE = 1000.0
_ANGLES = ("heading", "pitch", "roll", "heading_source")


def with_log(photos: Sequence[Photo], log: Log, clock_offset: float | None = None) -> tuple[list[Photo], list[str]]:
    """Return photos with a log's values, and notes.

    Rows are matched by file name if the log has file names, else by time. The log's values replace those of the photos, except
    for a heading whose source is worse than the photo's, and the field of view of a photo whose lens is known.

    Args:
        clock_offset: seconds to add to the photos' clock for the log's; None estimates it.
    """
    rows = logs.rows_by_name(log)
    made, how, why_not, notes = _by_name(photos, log, rows) if rows else _by_time(photos, log, clock_offset)
    used = sum(after is not before for after, before in zip(made, photos, strict=True))
    if used:
        said = f"{log.name} gives the values of {used} of {len(photos)} photos, {how}; they replace those in the files."
    else:
        said = f"{log.name} fits none of the {len(photos)} photos {how}, and was not used{why_not}."
    return made, [*notes, said]


_Matched = tuple[list[Photo], str, str, list[str]]


def _by_name(photos: Sequence[Photo], log: Log, rows: dict[str, list[LogRow]]) -> _Matched:
    """Return photos with the rows that name them, the kind of match, "", and notes about ambiguous names."""
    paths = [logs.path_parts(str(photo.frame.file)) for photo in photos]
    claims: dict[LogRow, list[int]] = defaultdict(list)
    twice = []
    for i, photo in enumerate(photos):
        file = photo.frame.file
        named = rows.get(file.name.casefold()) or rows.get(file.stem.casefold(), [])
        nearest = logs.nearest_in_folders(paths[i], [logs.path_parts(row.file or "") for row in named]) if named else []
        if found := [named[j] for j in nearest]:
            claims[min(found, key=lambda row: _metres_apart(photo.frame, row.entry))].append(i)
            if any(replace(row.entry, time=0.0) != replace(found[0].entry, time=0.0) for row in found):
                twice.append(
                    f"{printable(photo.frame.name)} in lines {' and '.join(str(row.line) for row in found[:3])}"
                )
    made, notes = list(photos), []
    for row, claiming in claims.items():
        of = [
            claiming[j] for j in logs.nearest_in_folders(logs.path_parts(row.file or ""), [paths[i] for i in claiming])
        ]
        apart = sorted((_metres_apart(photos[i].frame, row.entry), i) for i in of)
        if len(of) == 1 or _CLEARLY * apart[0][0] < apart[1][0] <= apart[-1][0] < math.inf:
            i = apart[0][1]
            made[i] = _with_entry(photos[i], row.entry, log.utc)
            continue
        names = first_few([printable(photos[i].frame.name) for i in of], 3)
        notes.append(
            f"{log.name} names {printable(row.file or '')}, which {len(of)} photos are called ({names}), so none of them has its "
            "values; write their folders in it."
        )
    if twice:
        notes.append(
            f"{len(twice)} of {len(photos)} photos are listed more than once in {log.name} with different values, such as "
            f"{twice[0]}; the row nearest to the photo's own position was used, or the first one without such a position."
        )
    changes = [(photo.frame, after.frame) for photo, after in zip(photos, made, strict=True) if after is not photo]
    moved = [metres for own, told in changes if (metres := _metres_apart(own, told)) < math.inf]
    if moved and (middle := float(np.median(moved))) > _ELSEWHERE:
        notes.append(
            f"The positions of {log.name} are {distance(middle)} from the photos' own in the median; check that it is of this "
            "flight, and that its latitude and longitude are not exchanged."
        )
    return made, "by name", "", notes


def _metres_apart(frame: Frame, entry: Frame | TelemetryEntry) -> float:
    """Return the metres between two positions, infinite if one is unknown."""
    if frame.latitude is None or entry.latitude is None:
        return math.inf
    both = np.array([(frame.latitude, frame.longitude), (entry.latitude, entry.longitude)], np.float64)
    return float(np.hypot(*local_metres(both)[1]))


def _by_time(photos: Sequence[Photo], log: Log, clock_offset: float | None) -> _Matched:
    """Return photos with the log's values at their times, the clocks' fit, the reason for none, and notes."""
    telemetry = Telemetry(logs.moments(log))
    fit = fit_clocks(photos, telemetry, log.utc, clock_offset)
    if fit.offset is None:
        return list(photos), f"by {fit.basis}", f": {fit.sentence}", []
    made = []
    for photo in photos:
        time = photo.utc if fit.basis == "UTC" else photo.local
        known = {} if time is None else {k: v for k, v in telemetry.at(time + fit.offset).items() if v is not None}
        if time is not None and "latitude" in known:
            utc = time + fit.offset if log.utc and photo.utc is None else photo.utc
            made.append(replace(_with_values(photo, known), utc=utc))
        else:
            made.append(photo)
    return made, f"by {fit.basis}" + (f", {fit.sentence}" if fit.sentence else ""), "", []


def _with_entry(photo: Photo, entry: TelemetryEntry, utc: bool) -> Photo:
    made = _with_values(photo, {name: value for name in VALUES if (value := getattr(entry, name)) is not None})
    if entry.clock is None:
        return made
    return replace(made, utc=entry.clock) if utc else replace(made, local=made.local or entry.clock)


def _with_values(photo: Photo, values: dict[str, Any]) -> Photo:
    """Return a photo with a log's values, made upright; angles of a worse source are left out."""
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
