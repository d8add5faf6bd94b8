"""The expected state of a client's page, and the content of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

_LABEL = re.compile(r"(\d+): (.*), distance (\d\.\d+)", re.DOTALL)


class UploadedPicture(NamedTuple):
    """An uploaded picture: a unique file name and the file's bytes."""

    name: str
    content: bytes


@dataclass(frozen=True)
class ClientState:
    """The choices of one client that its ranking depends on.

    Attributes:
        task: a task's name, such as "drone-to-satellite".
        query: position among the task's queries; it stays while an uploaded picture is shown.
        angle: degrees counter-clockwise by which the photo is turned.
        weights: of the parts; empty for equal ones.
        compare: gallery position of the compared tile; None for the headline's.
        own: an uploaded picture, shown in place of the query.
    """

    task: str
    query: int
    angle: float = 0.0
    weights: tuple[float, ...] = ()
    compare: int | None = None
    own: UploadedPicture | None = None

    def showing(self, **choice: Any) -> ClientState:
        """Show another query, own picture, or task, upright."""
        return replace(self, **({"own": None, "compare": None, "angle": 0.0} | choice))


class ShownTile(NamedTuple):
    """A tile of the strip as it is printed."""

    rank: int
    name: str
    distance: float


class PageContent(NamedTuple):
    """The content of a page: the photo's name, the tiles of the strip, and each part's share of the first distance."""

    photo: str
    tiles: list[ShownTile]
    shares: list[float]


def of_result(result: dict[str, Any]) -> PageContent:
    """Return the content of a result of the channel."""
    tiles = [result["tiles"][str(index)] for index in result["strip"]]
    shown = [ShownTile(int(tile["rank"]), tile["name"], float(tile["distance"])) for tile in tiles]
    return PageContent(result["photo"]["name"], shown, result["tiles"][str(result["answer"])]["shares"])


def of_elements(photo: str, labels: list[str], shares: list[str]) -> PageContent:
    """Return the content of a page's elements: the labels of photo and tiles, and the numbers at the rows' heads."""
    found = [match for match in map(_LABEL.fullmatch, labels) if match]
    shown = [ShownTile(int(match[1]), match[2], float(match[3])) for match in found]
    return PageContent(photo, shown, [float(text) for text in shares])
