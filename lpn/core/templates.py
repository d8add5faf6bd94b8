"""Jinja2 templates with autoescaping: all HTML and SVG of the app and of reports comes from them."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined


def environment(package: str) -> Environment:
    """Return the templates in the folder `templates` of a package; a name that a template lacks is an error."""
    return Environment(
        loader=PackageLoader(package), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
