"""Parse a page's HTML: the status line, the ranked tiles, and the table of the compared pair."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html import unescape
from html.parser import HTMLParser

_DISTANCE = re.compile(r"-?\d+\.\d{3}")
_GAP = re.compile(r"gap \+(-?\d+\.\d{3})")
_SHARE = re.compile(r": (-?\d+\.\d+)$")
_ATTRIBUTE = re.compile(r"data-([a-z]+)=(['\"])(.*?)\2")


@dataclass
class MatchRow:
    """A tile in the list of matches.

    Attributes:
        index: position in the gallery.
        chosen: True for the compared tile.
        below: True for a positive listed below the top matches.
        texts: rank, sign, name, distance, and the gap to the next tile.
        shares: share of each part in the squared distance.
    """

    index: int
    chosen: bool
    below: bool
    texts: list[str] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)

    @property
    def rank(self) -> int:
        """Rank from 1."""
        return int(self.texts[0])

    @property
    def sign(self) -> str:
        """A tick for a positive, a cross for a negative, a question mark for unknown."""
        return self.texts[1]

    @property
    def distance(self) -> float:
        """Squared distance, as printed."""
        return float(next(text for text in self.texts[3:] if _DISTANCE.fullmatch(text)))

    @property
    def gap(self) -> float | None:
        """Difference to the next tile's squared distance; None for the last."""
        gaps = (_GAP.fullmatch(text) for text in self.texts[3:])
        return next((float(gap[1]) for gap in gaps if gap), None)


@dataclass(frozen=True)
class PageContent:
    """The content of a page.

    Attributes:
        status: attributes of the status line.
        rows: the ranked tiles, and a positive below them.
        parts: cells of the compared pair's table, with its head and sum.
    """

    status: dict[str, str]
    rows: list[MatchRow]
    parts: list[list[str]]


def status(html: str) -> dict[str, str]:
    """Parse the attributes of a status line."""
    start = html.partition('id="lpn-status"')[2]
    return {name: unescape(value) for name, _, value in _ATTRIBUTE.findall(start.partition(">")[0])}


def shown(status_html: str, matches: str, parts: str) -> PageContent:
    """Parse the three elements that show an answer."""
    reader = _MatchParser()
    reader.feed(matches)
    reader.close()
    table = _MatchParser()
    table.feed(parts)
    table.close()
    return PageContent(status(status_html), reader.rows, table.table)


class _MatchParser(HTMLParser):
    """Collect rows of matches and of tables."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[MatchRow] = []
        self.table: list[list[str]] = []
        self._below = self._in_chart = self._in_table = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        classes = (given.get("class") or "").split()
        self._below |= given.get("id") == "lpn-truth"
        if "row" in classes:
            self.rows.append(MatchRow(int(given.get("data-index") or -1), "chosen" in classes, self._below))
        elif tag == "svg":
            self._in_chart = True
        elif tag == "tr":
            self._in_table = True
            self.table.append([])

    def handle_endtag(self, tag: str) -> None:
        if tag == "svg":
            self._in_chart = False
        elif tag == "table":
            self._in_table = False

    def handle_data(self, data: str) -> None:
        if not data.strip():
            return
        if self._in_chart:  # a bar's tooltip, such as "part 1 centre: 0.1234", or its label
            if self.rows and (share := _SHARE.search(data.strip())):
                self.rows[-1].shares.append(float(share[1]))
        elif self._in_table:
            self.table[-1].append(data.strip())
        elif self.rows and not self._begins_truth(data):
            self.rows[-1].texts.append(data.strip())

    def _begins_truth(self, data: str) -> bool:
        """Return True for the line above the positive, which belongs to no row."""
        return self._below and not self.rows[-1].below and data.lstrip().startswith("…")
