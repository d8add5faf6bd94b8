"""HTML tables that show results in a notebook, with styles of their own."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from markupsafe import Markup

from lpn.core.templates import shown

_CELL = Markup('<{0} style="text-align: {1}; padding: .2em .8em; vertical-align: middle">{2}</{0}>')
_TABLE = Markup(
    '<table style="border-collapse: collapse; font-variant-numeric: tabular-nums">'
    '<caption style="caption-side: top; text-align: left; padding: .2em .8em; color: inherit">{}</caption>'
    "<thead><tr>{}</tr></thead><tbody>{}</tbody></table>"
)


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table with numbers at the right; texts are escaped unless they are `Markup`."""
    lines = [Markup("<tr>{}</tr>").format(_joined("td", row)) for row in rows]
    # A plain string: text that is added to a Markup would be escaped.
    return str(_TABLE.format(caption, _joined("th", headings), Markup().join(lines)))


def percentages(caption: str, heading: str, rows: Mapping[str, Mapping[str, float]]) -> str:
    """Return a table of percentages, NaN if unknown; all rows have the same columns, and `heading` names the first column."""
    names = next(iter(rows.values()))
    return table(
        caption,
        (heading, *names),
        ((row, *(_percent(value) for value in values.values())) for row, values in rows.items()),
    )


def _percent(value: float) -> Markup:
    return Markup("-") if math.isnan(value) else Markup("{:.2f} %").format(value)


def _joined(tag: str, cells: Iterable[object]) -> Markup:
    return Markup().join(
        _CELL.format(
            tag,
            "left" if isinstance(cell, str) and (tag == "th" or not isinstance(cell, Markup)) else "right",
            shown(cell),
        )
        for cell in cells
    )
