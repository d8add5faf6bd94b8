"""Numbers and angles as people and programs write them: units, decimal commas, degrees and minutes, letters of hemispheres."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable

FOOT = 0.3048
# Signs that mean the same as an ASCII one.
_SIGNS = str.maketrans(
    {
        **dict.fromkeys("−–‒﹣－", "-"), **dict.fromkeys("º˚", "°"), **dict.fromkeys("′’‘´ʹ", "'"), **dict.fromkeys("″”“ʺ", '"'),
        **dict.fromkeys("\u00a0\u2007\u2009\u202f\u3000", " "), "：": ":", "，": ",", "（": "(", "）": ")", "；": ";", "＋": "+",
    }
)  # fmt: skip
_TAG = re.compile(r"<[^<>\n]{0,200}>")
# Some firmware writes a second sign behind the point: -117.-9605.
_SECOND_SIGN = re.compile(r"(\d\.)-(?=\d)")
# Most numbers are so, and are read at once.
_SIMPLE = re.compile(r"[-+]?\d{1,15}(?:\.\d{1,20})?", re.ASCII)
_PART = r"\d+(?:\.\d+)?"
_ANGLE = re.compile(
    rf"(?P<before>[NSEW]|north|south|east|west)?\s*:?\s*(?P<sign>[-+])?\s*(?P<degrees>{_PART})\s*"
    rf"(?:(?:°|\^|\*|degrees|degree|deg|d|:|(?<=\s))\s*(?:(?P<minutes>{_PART})\s*(?:'|min|m|:|(?<=\s))?\s*"
    rf"(?:(?P<seconds>{_PART})\s*(?:\"|''|sec|s)?)?)?)?\s*(?P<after>[NSEW]|north|south|east|west)?",
    re.IGNORECASE,
)
# XMP writes degrees and minutes as "47,18.074N" and "47,18,4.4N".
_XMP_ANGLE = re.compile(rf"(\d+),({_PART})(?:,({_PART}))?([NSEW])", re.IGNORECASE)
_NUMBER = re.compile(
    r"([-+]?(?:\d[\d., ']*\d|\d|\.\d+)(?:[eE][-+]?\d{1,3})?)\s*(?P<unit>[a-zA-Z°%/]*)"
    r"(?P<level> (?:above|below) (?:sea level|ground))?",
    re.ASCII | re.IGNORECASE,
)
_FACTORS = {"ft": FOOT, "feet": FOOT, "foot": FOOT, "mm": 0.001, "cm": 0.01, "km": 1000.0}
_PLAIN_UNITS = ("", "m", "meter", "meters", "metre", "metres", "°", "deg", "degree", "degrees", "s", "sec")
_GROUPED = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?")
_GROUPED_BY_POINTS = re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+,\d+")
# Positions in radians are within these limits (in degrees a stretch of sea), and spread over no more than this span.
_RADIANS, _RADIANS_SPAN = (1.5708, 3.1416), 0.001
_LONGEST = 100


def read_limited(file: Path, most_bytes: int, expected: str) -> bytes:
    """Return the contents of a file of telemetry.

    Args:
        most_bytes: the largest size that is read.
        expected: such a file, for the message about a larger one.

    Raises:
        DataError: if it cannot be read, or is larger.
    """
    name = printable(file.name)
    try:
        if file.stat().st_size > most_bytes:
            raise DataError(f"{name} has more than {most_bytes // 1_000_000} MB; expected {expected}.")
        return file.read_bytes()
    except OSError as error:
        raise DataError(f"{name} cannot be read ({error.strerror or error}); check it.") from error


def decoded(data: bytes, name: str) -> str:
    """Return a text file's contents: UTF-8 or UTF-16, with or without a mark, else Windows-1252.

    Raises:
        DataError: if it is no text.
    """
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if data.startswith(mark):
            return data.decode(encoding, "replace")
    # Text in UTF-16 without a mark has a NUL in every second byte.
    head = data[:4000]
    for start, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(head) >= 4 and head[start::2].count(0) > 0.7 * len(head[start::2]) and not head[1 - start :: 2].count(0):
            return data.decode(encoding, "replace")
    if head.count(0):
        raise DataError(f"{printable(name)} is no text; expected lines of text, not a binary file.")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def plain(text: str) -> str:
    """Return text without tags of HTML, with ASCII in place of look-alike signs, and with one sign a number."""
    return _SECOND_SIGN.sub(r"\1", _TAG.sub(" ", text).replace("&deg;", "°").replace("Â°", "°").translate(_SIGNS))


def number(text: str, comma: bool = False) -> float | None:
    """Return a number in metres or degrees, or as it stands; None if it is none, or can be read in two ways.

    Args:
        text: such as "45.2 m", "148 ft", "1,234.5", or "512.3 m Below Sea Level".
        comma: a comma is the decimal sign; otherwise one before three digits groups thousands.
    """
    if _SIMPLE.fullmatch(text):
        return float(text)
    match = _NUMBER.fullmatch(text.strip()) if len(text) <= _LONGEST else None
    if match is None:
        return None
    digits, unit = match[1], match["unit"].casefold()
    if unit not in _FACTORS and unit not in _PLAIN_UNITS:
        return None
    digits = re.sub(r"(?<=\d)[ '](?=\d{3}(?!\d))", "", digits)
    if _GROUPED_BY_POINTS.fullmatch(digits):
        digits = digits.replace(".", "").replace(",", ".")
    elif _GROUPED.fullmatch(digits) and (not comma or "." in digits or digits.count(",") > 1):
        digits = digits.replace(",", "")
    elif comma or re.fullmatch(r"[-+]?\d+,\d{1,2}|[-+]?\d+,\d{4,}", digits):
        # A group of thousands has three digits, so that other commas are decimal ones in any case.
        digits = digits.replace(",", ".")
    try:
        value = float(digits) * _FACTORS.get(unit, 1.0)
    except ValueError:
        return None
    return -abs(value) if (match["level"] or "").casefold().startswith(" below") else value


def angle(text: str, letters: str = "NSEW", comma: bool = False) -> float | None:
    """Return degrees, negative for south and west; None if the text is no angle, or its letter is none of `letters`.

    Args:
        text: such as "-70.5", "W: 70.5", "47° 18' 4.44\\" N", "47 deg 18.074' N", or "4718.074 N" (degrees and minutes).
        letters: of the hemispheres that fit.
        comma: a comma is the decimal sign.
    """
    if _SIMPLE.fullmatch(text):
        return float(text)
    if len(text) > _LONGEST:
        return None
    text = plain(text).strip()
    if packed := _XMP_ANGLE.fullmatch(text):
        parts, letter, sign = list(packed.groups()[:3]), packed[4].upper(), ""
    else:
        # Within degrees, minutes, and seconds a comma is a decimal one in any case.
        match = _ANGLE.fullmatch(text.replace(",", ".") if comma or re.search(r"[°'\"]", text) else text)
        if match is None or (match["before"] and match["after"]):
            return None
        parts, sign = [match["degrees"], match["minutes"], match["seconds"]], match["sign"] or ""
        letter = (match["before"] or match["after"] or "")[:1].upper()
    if letter and letter not in letters:
        return None
    degrees, minutes, seconds = (float(part) if part else 0.0 for part in parts)
    if minutes >= 60 or seconds >= 60 or (parts[1] and "." in parts[0]):
        return None
    if letter and parts[1] is None and degrees > 180:
        degrees, minutes = divmod(degrees, 100.0)
        if minutes >= 60:
            return None
    value = degrees + minutes / 60 + seconds / 3600
    # A sign beside a letter repeats what the letter says; east and north are never negative.
    if sign == "-" and letter in ("N", "E"):
        return None
    return -value if sign == "-" or letter in ("S", "W") else value


def letter_of(text: str) -> str:
    """Return the letter N, S, E, or W of an angle, "" without one."""
    match = _ANGLE.fullmatch(plain(text).strip()) if len(text) <= _LONGEST and not _SIMPLE.fullmatch(text) else None
    return "" if match is None else (match["before"] or match["after"] or "")[:1].upper()


def seem_radians(latitudes: Float64Array, longitudes: Float64Array, texts: Sequence[str]) -> bool:
    """Return whether positions are likely radians: all near 0, 0 at sea, close together, and with five decimals or more.

    Args:
        latitudes, longitudes: (N,), without unknown ones.
        texts: the same latitudes as they are written.
    """
    if not len(latitudes) or any(len(text.rpartition(".")[2].strip()) < 5 or "." not in text for text in texts):
        return False
    near = np.abs(latitudes).max() <= _RADIANS[0] and np.abs(longitudes).max() <= _RADIANS[1]
    return bool(near and np.ptp(latitudes) <= _RADIANS_SPAN and np.ptp(longitudes) <= _RADIANS_SPAN)
