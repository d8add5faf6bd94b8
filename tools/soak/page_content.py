"""What a page shows, read from its html as a person reads it: the status line, the ranked tiles, the compared pair."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html import unescape
from html.parser import HTMLParser

_DISTANCE = re.compile(r"-?\d+\.\d{3}")
_GAP = re.compile(r"\+-?\d+\.\d{3}")
_SHARE = re.compile(r": (-?\d+\.\d+)$")
_ATTRIBUTE = re.compile(r"data-([a-z]+)=(['\"])(.*?)\2")


@dataclass
class MatchRow:
    """A tile in the list of matches.

    Attributes:
        index: in the gallery.
        texts: all its texts: rank, sign, name, distance, and how much further the next tile is.
        shares: of each part in the squared distance.
        chosen: whether it is the one that is compared.
        below: whether it stands below the others, as the true tile.
    """

    index: int
    chosen: bool
    below: bool
    texts: list[str] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)

    @property
    def rank(self) -> int:
        """1 for the nearest."""
        return int(self.texts[0])

    @property
    def sign(self) -> str:
        """A tick where it is a true match, a cross where it is none, a question mark where that is not known."""
        return self.texts[1]

    @property
    def distance(self) -> float:
        """Squared distance, as printed."""
        return float(next(text for text in self.texts[3:] if _DISTANCE.fullmatch(text)))

    @property
    def gap(self) -> float | None:
        """How much further the next tile is; None for the last."""
        return next((float(text[1:]) for text in self.texts[3:] if _GAP.fullmatch(text)), None)


@dataclass(frozen=True)
class PageContent:
    """One answer as a page shows it.

    Attributes:
        status: the attributes of the status line.
        rows: the ranked tiles, the true one below them included.
        parts: texts of the rows of the compared pair's table, its head and its sum included.
    """

    status: dict[str, str]
    rows: list[MatchRow]
    parts: list[list[str]]


def status(html: str) -> dict[str, str]:
    """The attributes of a status line."""
    start = html.partition('id="lpn-status"')[2]
    return {name: unescape(value) for name, _, value in _ATTRIBUTE.findall(start.partition(">")[0])}


def shown(status_html: str, matches: str, parts: str) -> PageContent:
    """Read the three pieces of html that say an answer."""
    reader = _MatchParser()
    reader.feed(matches)
    reader.close()
    table = _MatchParser()
    table.feed(parts)
    table.close()
    return PageContent(status(status_html), reader.rows, table.table)


class _MatchParser(HTMLParser):
    """Collects the rows of matches, and those of tables."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[MatchRow] = []
        self.table: list[list[str]] = []
        self._below = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        classes = (given.get("class") or "").split()
        self._below |= given.get("id") == "lpn-truth"
        if "row" in classes:
            self.rows.append(MatchRow(int(given.get("data-index") or -1), "chosen" in classes, self._below))
        elif tag == "i" and self.rows and (found := _SHARE.search(given.get("title") or "")):
            self.rows[-1].shares.append(float(found[1]))
        elif tag == "tr":
            self.table.append([])

    def handle_data(self, data: str) -> None:
        if not data.strip():
            return
        if self.table:
            self.table[-1].append(data.strip())
        elif self.rows and not self._begins_truth(data):
            self.rows[-1].texts.append(data.strip())

    def _begins_truth(self, data: str) -> bool:
        """The line above the true tile is no text of the tile before it."""
        return self._below and not self.rows[-1].below and data.lstrip().startswith("…")
