"""Tables of text, which Markdown, LaTeX, and a page of HTML show alike."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from lpn.core.files import printable

_LATEX: Mapping[str, str] = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    # A line that begins with a bracket would be an argument of the command that ends the line above it.
    "[": "{[}",
    # So would a star.
    "*": "{*}",
    "\n": " ",
    "`": r"\textasciigrave{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "→": r"$\rightarrow$",
    "±": r"$\pm$",
    "−": "$-$",
    "×": r"$\times$",
    "°": r"$^{\circ}$",
    "²": "$^{2}$",
}


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes:
        head: names of the columns.
        rows: cells, one for each column.
        texts: number of columns from the left that hold words; the others hold numbers.
        title: tells it apart from the other tables of its section, in a caption.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: int = 1
    title: str = ""

    def markdown_lines(self) -> Iterator[str]:
        """Yield the lines in Markdown, and an empty one."""
        rule = ["---"] * self.texts + ["---:"] * (len(self.head) - self.texts)
        for row in (self.head, rule, *self.rows):
            yield f"| {' | '.join(map(markdown_text, row))} |"
        yield ""

    def latex_lines(self) -> Iterator[str]:
        """Yield the lines of a tabular of LaTeX's package booktabs, which has as many columns in each row."""
        yield f"\\begin{{tabular}}{{{'l' * self.texts}{'r' * (len(self.head) - self.texts)}}}"
        yield r"\toprule"
        for row in (self.head, *self.rows):
            yield f"{' & '.join(map(latex_text, row))} \\\\"
            if row is self.head:
                yield r"\midrule"
        yield from (r"\bottomrule", r"\end{tabular}")


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

    def latex_lines(self) -> Iterator[str]:
        """Yield a captioned table of LaTeX for each table; the sentences behind them are a comment."""
        for table in self.tables:
            titles = [f"{title}." for title in (self.title, table.title) if title]
            caption = latex_text(" ".join(filter(None, (*titles, self.before))))
            yield from (r"\begin{table}", r"\centering")
            if caption:
                yield f"\\caption{{{caption}}}"
            yield from (*table.latex_lines(), r"\end{table}", "")
        if self.after:
            yield from (f"% {' '.join(self.after.split())}", "")


def markdown_text(text: str) -> str:
    """Return words for Markdown, which is HTML, too, also in a table's cell."""
    return html.escape(printable(text), quote=False).replace("|", "\\|")


def latex_text(text: str) -> str:
    """Return words for LaTeX's text mode, also in a table's cell; letters beyond ASCII are left to its UTF-8."""
    return re.sub("-(?=-)", "-{}", "".join(_LATEX.get(letter, letter) for letter in printable(text, "\n")))


def latex_page(sections: Iterable[TableSection]) -> str:
    """Return tables for a document of LaTeX, to be read by its \\input."""
    lines = [r"% Needs \usepackage{booktabs}.", *(line for section in sections for line in section.latex_lines())]
    return "\n".join(lines)
