"""Numbers, angles, and times in the spellings of people and programs, and decoded text files."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from lpn.core import lists
from lpn.core.errors import DataError
from lpn.core.files import printable

# Factors to metres, degrees, and seconds.
LENGTHS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres", "amsl", "msl", "agl", "wgs84"), 1.0),
    **dict.fromkeys(("ft", "feet", "foot"), 0.3048), "mm": 0.001, "cm": 0.01, "km": 1000.0,
}  # fmt: skip
ANGLES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "decimal", "dd", "wgs84"), 1.0), "ddeg": 0.1, "cdeg": 0.01, "dege7": 1e-7,
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1)),
}  # fmt: skip
TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0), **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "microseconds"), 1e-6),
}  # fmt: skip
_UNITS = {"": 1.0} | LENGTHS | ANGLES | TIMES
# Signs and their ASCII equivalents.
_SIGNS = str.maketrans(
    {
        **dict.fromkeys("−–", "-"), **dict.fromkeys("º˚", "°"), **dict.fromkeys("′’", "'"), **dict.fromkeys("″”", '"'),
        **dict.fromkeys("\u00a0\u2009\u202f", " "),
    }
)  # fmt: skip
# The format of most numbers, which skips the full parser.
_SIMPLE = re.compile(r"[-+]?\d{1,15}(?:\.\d{1,20})?(?:[eE][-+]\d{1,3})?", re.ASCII)
_NUMBER = re.compile(
    r"([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[-+]?\d{1,3})?)(?:/(\d+(?:\.\d+)?))?\s*(?P<unit>[a-z°]*)"
    r"(?P<level> (?:above|below) (?:sea level|ground))?",
    re.ASCII | re.IGNORECASE,
)
_PART = r"\d+(?:\.\d+)?"
_ANGLE = re.compile(
    rf"(?P<before>[NSEW])?\s*:?\s*(?P<sign>[-+])?\s*(?P<degrees>{_PART})\s*(?:(?:°|degrees|deg|d|:)\s*"
    rf"(?:(?P<minutes>{_PART})\s*(?:'|:)?\s*(?:(?P<seconds>{_PART})\s*(?:\"|'')?)?)?)?\s*(?P<after>[NSEW])?",
    re.ASCII | re.IGNORECASE,
)
# XMP writes degrees and minutes as "47,18.074N" and "47,18,4.4N".
_XMP_ANGLE = re.compile(r"\d+,[\d.,]+[NSEW]", re.ASCII | re.IGNORECASE)
# The patterns of a moment: its beginning in a longer text, and the whole.
_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,](?P<fraction>\d{1,9}))?(?:,(?P<micro>\d{3}))?)?"
)
_MOMENT = re.compile(
    r"(?:(?P<year>\d{4})[-:/.](?P<month>\d{1,2})[-:/.](?P<day>\d{1,2})"
    r"|(?P<one>\d{1,2})(?P<sign>[-/.])(?P<other>\d{1,2})(?P=sign)(?P<late>\d{4}))"
    rf"[T ,]+{_CLOCK}\s*(?P<half>[AP]M)?\s*(?P<zone>Z|UTC|GMT|[-+]\d{{2}}(?::?\d{{2}})?)?",
    re.ASCII | re.IGNORECASE,
)
_LONGEST = 100


class Moment(NamedTuple):
    """Seconds since 1970-01-01, in UTC if the text has a zone (`zoned`), else on a clock of unknown zone."""

    seconds: float
    zoned: bool


def read_limited(file: Path, most_bytes: int, expected: str) -> bytes:
    """Return the contents of a file; a message about a larger file names the `expected` kind.

    Raises:
        DataError: if it cannot be read, or has more than `most_bytes`.
    """
    name = printable(file.name)
    try:
        if file.stat().st_size > most_bytes:
            raise DataError(f"{name} has more than {most_bytes // 1_000_000} MB; expected {expected}.")
        return file.read_bytes()
    except OSError as error:
        raise DataError(f"{name} cannot be read ({error.strerror or error}); check it.") from error


def decoded(data: bytes, name: str) -> str:
    """Return a text file's contents: UTF-8, UTF-16, or else Windows-1252.

    Raises:
        DataError: if it is no text.
    """
    try:
        text = lists.decoded(data, name)
    except DataError:
        text = data.decode("cp1252", "replace")
    if "\x00" in text[:4000]:
        raise DataError(f"{printable(name)} is no text; expected lines of text, not a binary file.")
    return text


def plain(text: str) -> str:
    """Replace signs by their ASCII look-alikes."""
    return text.translate(_SIGNS)


def number(text: str, comma: bool = False) -> float | None:
    """Parse a number, converted to metres, degrees, or seconds if it has a unit; None for other text.

    Args:
        text: such as "45.2 m", "148 ft", "-8759/100", or "512.3 m Below Sea Level".
        comma: whether a comma may be the decimal sign; if not, a number with a comma is None.
    """
    if _SIMPLE.fullmatch(text):
        return _finite(float(text))
    match = _NUMBER.fullmatch(plain(text).strip()) if len(text) <= _LONGEST else None
    if match is None or ("," in match[1] and not comma):
        return None
    factor, divisor = _UNITS.get(match["unit"].casefold()), float(match[2] or 1)
    if factor is None or not divisor:
        return None
    value = float(match[1].replace(",", ".")) * factor / divisor
    return _finite(-abs(value) if (match["level"] or "").casefold().startswith(" below") else value)


def angle(text: str, letters: str = "NSEW", comma: bool = False) -> float | None:
    """Parse an angle in degrees, negative for south and west; None if it is no angle, or its letter is not in `letters`.

    Args:
        text: such as "-70.5", "W: 70.5", "47° 18' 4.44\\" N", "47 deg 18.074' N", or "47,18.074N" as XMP has it.
        letters: of the accepted hemispheres.
        comma: whether a comma is the decimal sign.
    """
    if _SIMPLE.fullmatch(text):
        return _finite(float(text))
    if len(text) > _LONGEST:
        return None
    text = plain(text).strip()
    instead = "." if comma else ":" if _XMP_ANGLE.fullmatch(text) else ","
    match = _ANGLE.fullmatch(text.replace(",", instead))
    if match is None or (match["before"] and match["after"]):
        return None
    letter = (match["before"] or match["after"] or "").upper()
    degrees, minutes, seconds = (float(match[part] or 0) for part in ("degrees", "minutes", "seconds"))
    has_fraction = "." in match["degrees"] and match["minutes"]
    # East and north are never negative; a sign beside S or W repeats the letter.
    is_negative = match["sign"] == "-"
    if letter not in letters or max(minutes, seconds) >= 60 or has_fraction or (is_negative and letter in ("N", "E")):
        return None
    value = degrees + minutes / 60 + seconds / 3600
    return -value if is_negative or letter in ("S", "W") else value


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def moment(text: str, day_first: bool = False) -> Moment | None:
    """Parse a moment such as "2024:05:01 14:00:00.5+02:00" or "5/13/2024 1:00 PM"; None for other text.

    Args:
        day_first: whether the day comes before the month in a date with slashes; in a date with points it always does.
    """
    return _moment(_MOMENT.fullmatch(text.strip()), day_first) if len(text) <= _LONGEST else None


def moment_in(text: str) -> Moment | None:
    """Return the first moment within a longer text, None without one."""
    return _moment(_MOMENT.search(text), False)


def _moment(match: re.Match[str] | None, day_first: bool) -> Moment | None:
    if match is None:
        return None
    year = match["year"] or match["late"]
    month = match["month"] or match["one"]
    day = match["day"] or match["other"]
    if match["sign"] and (match["sign"] == "." or day_first or int(month) > 12):
        month, day = day, month
    hour = int(match["hour"])
    if match["half"]:
        hour = hour % 12 + 12 * (match["half"].upper() == "PM")
    minute, second = int(match["minute"]), int(match["second"] or 0)
    try:
        seconds = datetime(int(year), int(month), int(day), hour, minute, second, tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        return None
    seconds += float(f"0.{match['fraction'] or 0}{match['micro'] or ''}")
    zone = (match["zone"] or "").replace(":", "")
    if zone[:1] in ("+", "-") and zone[1:]:
        ahead = int(f"{zone[0]}1") * (int(zone[1:3]) * 3600 + int(zone[3:5] or 0) * 60)
        # Zones lie within 14 hours of UTC.
        if abs(ahead) > 14 * 3600:
            return None
        seconds -= ahead
    return Moment(seconds, bool(zone))
