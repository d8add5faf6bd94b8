"""Jinja2 templates with autoescaping, the source of all HTML and SVG of the app and of reports."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from lpn.core.files import TYPED, printable
from lpn.core.numbers import rounded_to_sum, signed


def environment(package: str, folder: str = "templates") -> Environment:
    """Return the templates in a folder of a package; an unknown name is an error.

    They have the filters `signed` and `rounded_to_sum`, and write values by `shown`.
    """
    templates = Environment(
        loader=PackageLoader(package, folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=shown,
    )
    templates.filters |= {"signed": signed, "rounded_to_sum": rounded_to_sum}
    return templates


def shown(value: object) -> object:
    """Make a text `printable` for a page, unless it is `Markup`."""
    return printable(value, TYPED) if isinstance(value, str) and not isinstance(value, Markup) else value
