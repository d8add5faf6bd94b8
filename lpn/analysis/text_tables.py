"""Tables of text, which Markdown and a page of HTML show alike."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes:
        head: names of the columns.
        rows: cells, one for each column.
        texts: number of columns from the left that hold words; the others hold numbers.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: int = 1

    def markdown_lines(self) -> Iterator[str]:
        """Yield the lines in Markdown, and an empty one."""
        rule = ["---"] * self.texts + ["---:"] * (len(self.head) - self.texts)
        for row in (self.head, rule, *self.rows):
            yield f"| {' | '.join(map(markdown_text, row))} |"
        yield ""


@dataclass(frozen=True)
class TableSection:
    """Tables under a title.

    Attributes:
        title: of the section; empty for a page's first.
        before, after: sentences in front of the tables and behind them.
    """

    title: str
    tables: Sequence[TextTable]
    before: str = ""
    after: str = ""

    def markdown_lines(self) -> Iterator[str]:
        """Yield the lines in Markdown, the last one empty."""
        for text in (f"## {markdown_text(self.title)}" if self.title else "", self.before):
            if text:
                yield from (text, "")
        for table in self.tables:
            yield from table.markdown_lines()
        if self.after:
            yield from (self.after, "")


def markdown_text(text: str) -> str:
    """Return words for Markdown, which is HTML, too, also in a table's cell."""
    return html.escape(text, quote=False).replace("|", "\\|")
