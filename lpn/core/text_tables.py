"""Tables of text for a terminal, Markdown, LaTeX, HTML, and CSV."""

from __future__ import annotations

import html
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from markupsafe import Markup

from lpn.core.csv_cells import csv_bytes
from lpn.core.files import printable
from lpn.core.templates import shown

if TYPE_CHECKING:
    from lpn.core.consoles import Console

_LATEX: Mapping[str, str] = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    # A line that begins with a bracket or a star would be an argument of the command that ends the line above it.
    "[": "{[}",
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
    """A table of text for a terminal, Markdown, LaTeX, HTML, and CSV.

    Attributes:
        head: names of the columns.
        rows: cells, one for each column.
        title: the text above it.
        after: sentences below it.
        align: l or r for each column, left or right; the last letter counts for all further columns.
        ruled: indices of the rows that have a line above them on a terminal.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    after: str = ""
    align: str = "lr"
    ruled: Container[int] = ()

    @property
    def sides(self) -> str:
        """A letter for each column, see `align`."""
        return "".join(self.align[min(column, len(self.align) - 1)] for column in range(len(self.head)))

    def print(self, console: Console) -> None:
        """Print the table and the sentences below it on a terminal."""
        from rich.table import Table
        from rich.text import Text

        table = Table()
        for name, side in zip(self.head, self.sides, strict=True):
            table.add_column(Text(name), justify="right" if side == "r" else "left")
        for number, row in enumerate(self.rows):
            if number in self.ruled:
                table.add_section()
            table.add_row(*(Text(printable(cell, "\n")) for cell in row))
        for text in (self.title, table, self.after):
            if text:
                console.print(text, markup=False, highlight=False, soft_wrap=text is not table)

    def markdown(self, level: int = 2) -> str:
        """Return heading, table, and sentences in Markdown, each followed by an empty line; the heading has this level."""
        rule = ["---" if side == "l" else "---:" for side in self.sides]
        rows = (f"| {' | '.join(map(markdown_text, row))} |" for row in (self.head, rule, *self.rows))
        title = f"{'#' * level} {markdown_text(self.title)}" if self.title else ""
        return "".join(f"{text}\n\n" for text in (title, "\n".join(rows), self.after) if text)

    def latex(self) -> str:
        """Return a captioned table for LaTeX's package booktabs; the sentences below it are a comment."""
        head, *rows = (f"{' & '.join(map(latex_text, row))} \\\\" for row in (self.head, *self.rows))
        lines = [
            *(r"\begin{table}", r"\centering"),
            *([f"\\caption{{{latex_text(self.title)}.}}"] if self.title else []),
            *(f"\\begin{{tabular}}{{{self.sides}}}", r"\toprule", head, r"\midrule", *rows, r"\bottomrule"),
            *(r"\end{tabular}", r"\end{table}", ""),
            *([f"% {' '.join(self.after.split())}", ""] if self.after else []),
        ]
        return "\n".join(lines)

    def html(self) -> Markup:
        """Return the table as HTML, without its title; cells of numbers have the class r."""

        def line(row: Sequence[str], heading: str) -> Markup:
            cells = Markup()
            for text, side in zip(row, self.sides, strict=True):
                scope = heading if heading == "col" or not cells else ""
                attributes = (f' scope="{scope}"' if scope else "") + (' class="r"' if side == "r" else "")
                tag = "th" if scope else "td"
                cells += Markup("<{0}{1}>{2}</{0}>").format(tag, Markup(attributes), shown(text))
            return Markup("<tr>{}</tr>").format(cells)

        rows = Markup("\n").join(line(row, "row") for row in self.rows)
        return Markup("<table><thead>{}</thead><tbody>\n{}\n</tbody></table>").format(line(self.head, "col"), rows)

    def csv(self) -> bytes:
        """Return the head and the rows as comma-separated values in UTF-8."""
        return csv_bytes([self.head, *self.rows])


def markdown_text(text: str) -> str:
    """Escape words for Markdown, which allows HTML, also in a table's cell."""
    return html.escape(printable(text), quote=False).replace("|", "\\|")


def latex_text(text: str) -> str:
    """Escape words for LaTeX's text mode, also in a table's cell; LaTeX itself reads UTF-8 beyond ASCII."""
    return re.sub("-(?=-)", "-{}", "".join(_LATEX.get(letter, letter) for letter in printable(text, "\n")))


def markdown_page(tables: Iterable[TextTable], title: str = "") -> str:
    """Return tables as a page of Markdown."""
    return (f"# {markdown_text(title)}\n\n" if title else "") + "".join(table.markdown() for table in tables)


def latex_page(tables: Iterable[TextTable]) -> str:
    """Return tables for LaTeX's \\input."""
    return "\n".join([r"% Needs \usepackage{booktabs}.", *(table.latex() for table in tables)])
