"""Terms of the glossary, which explain themselves where the page uses them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

GLOSSARY = Path(__file__).with_name("glossary.md")
_ROW = re.compile(r"^\| \*\*(?P<term>[^*]+)\*\* \| (?P<meaning>.+) \|$", re.MULTILINE)


@cache
def meanings() -> dict[str, str]:
    """Return each term's meaning as plain text."""
    return {row["term"]: _plain(row["meaning"]) for row in _ROW.finditer(GLOSSARY.read_text("utf-8"))}


def _plain(markdown: str) -> str:
    """Remove emphasis, code marks, and links."""
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", markdown).replace("*", "").replace("`", "")
