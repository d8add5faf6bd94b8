"""Jinja2 templates with autoescaping: all HTML and SVG of the app and of reports comes from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from lpn.core.numbers import rounded_to_sum, signed


def environment(package: str, finalize: Callable[[Any], Any] | None = None) -> Environment:
    """Return the templates in the folder `templates` of a package; an unknown name is an error.

    They have the filters `signed` and `rounded_to_sum`.

    Args:
        finalize: applied to the value of each expression before it is escaped and written.
    """
    templates = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=finalize,
    )
    templates.filters |= {"signed": signed, "rounded_to_sum": rounded_to_sum}
    return templates
