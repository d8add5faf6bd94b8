"""The state that a client's page must reach, from the controls' documented effect, and the content of a page's HTML."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from html import unescape
from typing import Any, Literal, NamedTuple

# Controls of the query's transform: in degrees, pixels of the network's input, and as a factor. Their values without a transform.
UPRIGHT = {"Rotate": 0.0, "Shift right": 0.0, "Shift down": 0.0, "Zoom": 1.0}
Cell = str | float
_ATTRIBUTE = re.compile(r"data-([a-z]+)=(['\"])(.*?)\2")
_NUMBER = re.compile(r"(?:gap )?([+−-]?[\d,]+(?:\.\d+)?)(?: %)?")
_METRES = re.compile(r"[\d.,]+ k?m")


class UploadedPicture(NamedTuple):
    """An uploaded picture: a unique file name and the file's bytes."""

    name: str
    content: bytes


@dataclass(frozen=True)
class ClientState:
    """The choices of one client that its ranking depends on, and its open windows.

    Attributes:
        task: a task's name, such as "drone-to-satellite".
        query: position among the task's queries; it stays while an uploaded picture is shown.
        controls: values of `UPRIGHT`, of each part's weight (0 .. 2), and of each part's switch, by label.
        own_picture: an uploaded picture, shown in place of the query.
        tile: gallery position of the compared tile, "truth" for the positive, or None for the top match.
        why, lab: True while the explain window, or the failure laboratory, is open.
    """

    task: str
    query: int
    controls: dict[str, float]
    own_picture: UploadedPicture | None = None
    tile: int | Literal["truth"] | None = None
    why: bool = False
    lab: bool = False

    def with_control(self, label: str, value: float) -> ClientState:
        """Set a control."""
        return replace(self, controls={**self.controls, label: value})

    def showing(self, **choice: Any) -> ClientState:
        """Show another query, own picture, or task, without any transform."""
        plain: dict[str, Any] = {"own_picture": None, "tile": None, "controls": {**self.controls, **UPRIGHT}}
        return replace(self, **(plain | choice))


@dataclass(frozen=True)
class PageContent:
    """The content of a page, with texts that are numbers as numbers.

    Attributes:
        status: attributes of the status line.
        tiles: of each ranked tile its position in the gallery, rank, sign, name, squared distance, gap to the next one unless
            it is the last, and each part's share.
        below: number of positives listed below the top matches, at the end of `tiles`.
        pair: the table of the compared pair without its head: name, weight in percent, cosine, and share; the sum is last.
    """

    status: dict[str, str]
    tiles: list[list[Cell]]
    below: int
    pair: list[list[Cell]]


def read_status(html: str) -> dict[str, str]:
    """Parse the attributes of a status line; empty before the first answer."""
    start = html.partition('id="lpn-status"')[2].partition(">")[0]
    found = {name: unescape(value) for name, _, value in _ATTRIBUTE.findall(start)}
    return found if found.get("seq", "0") != "0" else {}


def read_page(status: str, matches: str, parts: str) -> PageContent:
    """Parse the three elements that show an answer."""
    tiles: list[list[Cell]] = []
    for row in matches.split('data-index="')[1:]:
        line, _, bar = row.partition("<svg")
        rank, sign, name, *numbers = _texts(line)
        shares = re.findall(r": (-?[\d.]+)</title>", bar)
        cells = [_cell(text) for text in [*numbers, *shares] if not _METRES.fullmatch(text)]
        tiles.append([int(line.partition('"')[0]), _cell(rank), sign, name, *cells])
    lines = [_texts(row)[:4] for row in parts.split("<tr")[2:]]
    pair: list[list[Cell]] = [[name, *map(_cell, cells)] for name, *cells in lines]
    return PageContent(read_status(status), tiles, matches.partition('id="lpn-truth"')[2].count("data-index="), pair)


def _texts(html: str) -> list[str]:
    return [unescape(text).strip() for text in re.findall(r">([^<>]*\S[^<>]*)<", html)]


def _cell(text: str) -> Cell:
    found = _NUMBER.fullmatch(text)
    return float(found[1].replace("−", "-").replace(",", "")) if found else text
