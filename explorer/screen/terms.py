"""Terms of the glossary, which show their meanings on the page."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from markupsafe import Markup

GLOSSARY = Path(__file__).with_name("glossary.md")
_ROW = re.compile(r"^\| \*\*(?P<term>[^*]+)\*\* \| (?P<meaning>.+) \|$", re.MULTILINE)


@cache
def meanings() -> dict[str, str]:
    """Return each term's meaning as plain text."""
    return {row["term"]: _plain(row["meaning"]) for row in _ROW.finditer(GLOSSARY.read_text("utf-8"))}


def term(name: str, text: str | None = None) -> Markup:
    """Return a term whose meaning appears under the mouse, the focus, or a finger; KeyError if the glossary lacks it.

    Args:
        text: the words shown in its place; by default the term.
    """
    if name not in meanings():
        raise KeyError(name)
    return Markup('<span class="term" tabindex="0" data-term="{}">{}</span>').format(name, text or name)


def _plain(markdown: str) -> str:
    """Remove emphasis, code marks, and links."""
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", markdown).replace("*", "").replace("`", "")
