"""Jinja2 templates of the page, and the attributes by which its elements send messages and press buttons."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Mapping

from markupsafe import Markup, escape

from explorer.web.style import part_ink, verdict_ink
from explorer.web.terms import term
from lpn.core.numbers import SIGMA, distance
from lpn.core.templates import environment, shown
from lpn.drawing import charts, theme, words

SIGNS: dict[bool | None, str] = {True: "✓", False: "✗", None: "?"}
# A keyboard reaches an element with these attributes; `viewport.js` makes Enter and Space click it.
_CLICKABLE = Markup('role="button" tabindex="0" onclick="{}"')


def send(kind: str, value: object = None) -> Markup:
    """Return the attributes of an element that sends a message when it is clicked."""
    return _CLICKABLE.format(call("send", kind, value))


def press(button: str) -> Markup:
    """Return the attributes of an element that presses a viser button, given by its uuid, when it is clicked."""
    return _CLICKABLE.format(f"document.getElementById({json.dumps(button)}).click()")


def call(function: str, *arguments: object) -> str:
    """Return JavaScript that calls a function of the page's script."""
    return f"lpn.{function}({','.join(json.dumps(shown_json(argument)) for argument in arguments)})"


def shown_json(value: object) -> object:
    """Return a value of JSON whose texts hold no control characters: JSON escapes them, and `Html` passes these escapes on."""
    match value:
        case Mapping():
            return {key: shown_json(entry) for key, entry in value.items()}
        case list() | tuple():
            return [shown_json(entry) for entry in value]
    return shown(str(value) if isinstance(value, str) else value)


def run(script: str) -> str:
    """Return HTML that runs a script when the page shows it."""
    return render("run_script", body=json.dumps(script))


def run_once(script: str) -> str:
    """Return HTML that runs a script when the page shows it, but not when viser draws the panel that it is in anew."""
    return run(f"if({call('once', uuid.uuid4().hex)}){{{script}}}")


def render(template: str, **context: object) -> str:
    """Render a template of `explorer/web/templates`; values are escaped."""
    return _ENVIRONMENT.get_template(f"{template}.html.j2").render(context)


def progress_bar(done: int, total: int, text: str = "", name: str = "progress") -> Markup:
    """Return a text with a bar that is filled by a share; without the bar while the total, 0, is not known.

    Args:
        name: of the bar, for screen readers.
    """
    bar = Markup('<progress class="lpn-progress" value="{}" max="{}" aria-label="{}"></progress>')
    return escape(text) + (bar.format(done, total, name) if total else "")


_ENVIRONMENT = environment("explorer.web")
_ENVIRONMENT.filters["format"] = format
_ENVIRONMENT.filters["capitalised"] = words.capitalised
# A figure and its unit stay on one line.
_ENVIRONMENT.filters["tied"] = lambda text: type(text)(re.sub(r"(?<=\d) (?=%|k?m\b)", "\N{NO-BREAK SPACE}", text))
_ENVIRONMENT.globals.update(
    send=send,
    press=press,
    progress_bar=progress_bar,
    term=term,
    say=words.say,
    plain=words.plain,
    part_ink=part_ink,
    verdict_ink=verdict_ink,
    part_colour=charts.part_colour,
    share_bar=charts.share_bar,
    verdict_colour=lambda true, doubted=False: theme.css(
        theme.placed_colour(None) if doubted else theme.verdict_colour(true)
    ),
    signs=SIGNS,
    distance=distance,
    sigma=SIGMA,
)
