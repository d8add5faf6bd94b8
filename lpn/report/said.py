"""The words and pictures by which a screen shows the answer that a report is about."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SaidPicture:
    """A picture by which a screen shows an answer.

    Attributes:
        caption: what it is.
        name: its name or place.
        source: a data URI.
        sign: True if it is right, False if wrong; None if that is unknown.
        turn: degrees clockwise by which it is turned to lie like the query.
        doubted: it shows the place by a photo's details, which something contradicts.
    """

    caption: str
    name: str
    source: str
    sign: bool | None = None
    turn: float = 0.0
    doubted: bool = False


@dataclass(frozen=True)
class DetailPin:
    """A detail that photo and map show, by its number in both.

    Attributes:
        in_photo, on_map: per cent of the width and height of the pictures.
        metres: from where the photo's place has it to where the map has it, two digits.
    """

    number: int
    in_photo: tuple[float, float]
    on_map: tuple[float, float]
    metres: str


@dataclass(frozen=True)
class DetailsPair:
    """A photo beside the map about it, with the same details numbered in both.

    Attributes:
        sentence: how many details agree, and how well.
        photo, ground, laid: the photo, the map, and the photo laid over it, as data URIs.
        size: their width and height in pixels.
        frame: the photo's corners on the map, per cent of its width and height.
        colour: of the frame, in CSS.
        pins: the numbered details.
        limit: metres within which a detail counts, as a number.
        heading: what points up on the map, degrees clockwise from north, -180 up to 180.
        scale: metres of the scale, and per cent of the map's width that it takes.
    """

    sentence: str
    photo: str
    ground: str
    laid: str
    size: tuple[int, int]
    frame: list[tuple[float, float]]
    colour: str
    pins: list[DetailPin]
    limit: str
    heading: float
    scale: tuple[float, float]


@dataclass(frozen=True)
class Said:
    """The words and pictures by which a screen shows the answer that a report is about.

    Attributes:
        question: to which it is the answer.
        headline: the verdict in some words.
        sentences: paragraphs of text.
        pictures: the photo, the answer, and the map with the ground that the photo shows.
        photo: what the photo's file says of it, as names and values.
        map: the files of the map and their digests, as names and values.
        reasons: why this is the answer: each method, "" where it is the only one, and its sentences.
        judged: sentences on how right and wrong are told apart and checked.
        details: the numbered details by which the photo is placed; None without them.
    """

    question: str
    headline: str
    sentences: tuple[str, ...]
    pictures: tuple[SaidPicture, ...] = ()
    photo: tuple[tuple[str, str], ...] = ()
    map: tuple[tuple[str, str], ...] = ()
    reasons: tuple[tuple[str, tuple[str, ...]], ...] = ()
    judged: tuple[str, ...] = ()
    details: DetailsPair | None = None
