"""The report's templates, and the pictures in them as data URIs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jinja2 import Environment
from markupsafe import Markup

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.files import TYPED, printable
from lpn.core.templates import environment
from lpn.core.text_tables import TextTable
from lpn.core.texts import counted
from lpn.drawing import charts, overlays, theme

_THUMBNAIL = 60


def render(template: str, **context: object) -> Markup:
    """Fill a template of the report; values are escaped unless they are markup, and control characters removed."""
    return Markup(printable(_environment().get_template(template).render(context), TYPED))


def style_sheet() -> str:
    """Return the CSS of a report."""
    dark, light = theme.variables(theme.DARK), theme.variables(theme.LIGHT)
    colours = f":root{{{light}}}@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}"
    return colours + (Path(__file__).parent / "css" / "report.css").read_text("utf-8") + charts.STYLE


def thumbnail(picture: UInt8Array) -> str:
    """Encode a small square version of a picture, (H, W, 3) uint8."""
    return overlays.data_uri(images.resize(picture, _THUMBNAIL, _THUMBNAIL), 72)


@cache
def _environment() -> Environment:
    templates = environment("lpn.report")
    templates.globals["part_colour"] = charts.part_colour
    key = np.linspace(0, 1, 64)[None], np.linspace(-1, 1, 64)[None]
    heats = [overlays.heat_colours(values, bool(signed)) for signed, values in enumerate(key)]
    templates.globals["heat_keys"] = [overlays.png_data_uri(heat) for heat in heats]
    templates.globals["evidence_colours"] = charts.EVIDENCE_COLOURS
    templates.filters |= {"thousands": "{:,.0f}".format, "counted": counted}
    return templates


def table_page(title: str, tables: Sequence[TextTable]) -> bytes:
    """Return tables as UTF-8 HTML, without scripts and external resources."""
    return render("table_page.html.j2", title=title, tables=tables, style=style_sheet()).encode()
