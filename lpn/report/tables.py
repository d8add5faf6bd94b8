"""A page of tables as a self-contained HTML file, in a report's style."""

from __future__ import annotations

from collections.abc import Sequence

from lpn.core.text_tables import TextTable
from lpn.report._rendering import render, style_sheet


def table_page(title: str, tables: Sequence[TextTable]) -> bytes:
    """Return tables as UTF-8 HTML, without a script or anything from the network."""
    return render("table_page.html.j2", title=title, tables=tables, style=style_sheet()).encode()
