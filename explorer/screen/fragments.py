"""HTML of panels, from the templates of their folders; `page/fragment.js` inserts it, and handles its elements."""

from __future__ import annotations

from explorer.screen.terms import term
from lpn.core.templates import environment
from lpn.core.texts import ordinal

_TEMPLATES = environment("explorer.screen", "panels")


def part_colour(part: int, count: int) -> str:
    """Return the CSS variable of a part's colour; a neutral one for a single part."""
    return "--soft" if count == 1 else f"--part{part % 4}"


_TEMPLATES.globals |= {"part_colour": part_colour, "term": term}
_TEMPLATES.filters["ordinal"] = ordinal


def fragment(template: str, **values: object) -> str:
    """Return the HTML of a panel's template, such as "why/why"."""
    return _TEMPLATES.get_template(f"{template}.html.j2").render(values)
