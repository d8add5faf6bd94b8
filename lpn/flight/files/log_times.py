"""Dates and times of flight logs in every spelling; the order of day and month is told from the file as a whole."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from lpn.flight.files.log_tables import LogTable, cell_at

_DATE = re.compile(
    r"(?:(?P<year>\d{4})[-:/.](?P<month>\d{1,2})[-:/.](?P<day>\d{1,2})|(?P<first>\d{1,2})(?P<sign>[-/.])(?P<second>\d{1,2})[-/.]"
    r"(?P<late>\d{4}|\d{2})|(?P<packed>\d{8}))?"
    r"(?:(?:^|[T ,]+)(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<seconds>\d{2})(?:[.,:](?P<fraction>\d{1,9}))?)?)?"
    r"\s*(?P<half>[AP]\.?M\.?)?\s*(?P<zone>Z|UTC|GMT|[-+]\d{2}(?::?\d{2})?)?",
    re.IGNORECASE | re.ASCII,
)
# GPS time is ahead of UTC by so many seconds since 2017.
_GPS_AHEAD = 18.0
# Epochs in seconds; larger ones are in milli-, micro-, or nanoseconds. Smaller numbers count from a start.
_EPOCHS = (1e9, 1e11)
# Rows that are farther apart than so many seconds in the median count milliseconds, or microseconds.
_MILLISECONDS, _MICROSECONDS = 1e3, 2e4


def clocks_of(table: LogTable, name: str) -> tuple[list[float | None], bool, list[str]]:
    """Return seconds since 1970-01-01 of the rows' dates, whether they have a zone, and notes."""
    texts = []
    for _, cells in table.rows:
        date, clock = table.text(cells, "date"), table.text(cells, "clock")
        if date and clock and clock != date and ":" not in date:
            date = f"{date} {clock}"
        texts.append(date or clock)
    numbers = [number_or_nan(text) for text in texts]
    if all(math.isnan(number) for number in numbers):
        parsed = [_DATE.fullmatch(text) for text in texts]
        day_first, note = _day_first(parsed, name)
        stamps = [None if match is None else _date(match, day_first) for match in parsed]
        late = (
            _GPS_AHEAD
            if "date" in table.columns.places and "gpst" in table.header[table.columns.places["date"]].casefold()
            else 0.0
        )
        zoned = any(match is not None and match["zone"] for match in parsed)
        notes = [note] if note else []
        if late:
            notes.append(f"The times of {name} are GPS time; {late:g} s were taken off for UTC.")
        return [None if clock is None else clock - late for clock in stamps], zoned, notes
    least, most = _EPOCHS
    scale = 1.0
    largest = np.nanmax(numbers)
    while largest * scale > most:
        scale /= 1000.0
    clocks = [number * scale if least < number * scale < most else None for number in numbers]
    if _step(numbers) >= _MILLISECONDS and scale == 1.0:
        return [None] * len(numbers), False, []
    return clocks, any(clock is not None for clock in clocks), []


def number_or_nan(text: str) -> float:
    """Return a text as a finite number, else NaN."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def _step(numbers: Sequence[float]) -> float:
    """Return the median difference of neighbouring numbers that differ, 0 if there is none."""
    known = np.array(numbers, np.float64)
    steps = np.diff(known[~np.isnan(known)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def elapsed_of(table: LogTable) -> list[float]:
    """Return the seconds of the column of time, NaN where unknown."""
    if "time" not in table.columns.places:
        return [math.nan] * len(table.rows)
    at, factor = table.columns.places["time"], table.columns.factors["time"]
    times = [
        number_or_nan(cell_at(cells, at).replace(",", ".") if table.commas else cell_at(cells, at)) * factor
        for _, cells in table.rows
    ]
    step = _step(times)
    if factor == 1.0 and step >= _MILLISECONDS:
        scale = 1e-6 if step >= _MICROSECONDS else 1e-3
        times = [time * scale for time in times]
    return times


def _day_first(parsed: Sequence[re.Match[str] | None], name: str) -> tuple[bool, str]:
    """Return whether dates such as 5/1/2024 have the day first, and a note if that is a guess."""
    short = [match for match in parsed if match is not None and match["first"]]
    if not short:
        return False, ""
    if any(int(match["first"]) > 12 for match in short):
        return True, ""
    if any(int(match["second"]) > 12 for match in short):
        return False, ""
    day_first = short[0]["sign"] == "."
    first = "day" if day_first else "month"
    return (
        day_first,
        f"The dates of {name}, such as {short[0][0].split()[0]}, count as {first} first; nothing in it rules that out.",
    )


def _date(match: re.Match[str], day_first: bool) -> float | None:
    """Return seconds since 1970-01-01 of a date, None if it is none."""
    if match["packed"]:
        year, month, day = match["packed"][:4], match["packed"][4:6], match["packed"][6:]
    elif match["first"]:
        month, day = (match["second"], match["first"]) if day_first else (match["first"], match["second"])
        year = match["late"] if len(match["late"]) == 4 else f"20{match['late']}"
    else:
        year, month, day = match["year"], match["month"], match["day"]
    if year is None:
        return None
    hour = int(match["hour"] or 0)
    if half := (match["half"] or "").upper()[:1]:
        hour = hour % 12 + (12 if half == "P" else 0)
    try:
        date = datetime(
            int(year), int(month), int(day), hour, int(match["minute"] or 0), int(match["seconds"] or 0), tzinfo=UTC
        )
        clock = date.timestamp() + float(f"0.{match['fraction'] or 0}")
    except (ValueError, OverflowError):
        return None
    zone = (match["zone"] or "").replace(":", "")
    if zone[:1] in ("+", "-") and zone[1:]:
        clock -= (int(zone[1:3]) * 3600 + int(zone[3:5] or 0) * 60) * (1 if zone[0] == "+" else -1)
    return clock
