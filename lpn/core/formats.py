"""Versions of the formats that we write, "kind/number", and the sentence about a file that a later version wrote."""

from __future__ import annotations

from typing import Any

WORLD = "lpn-world/1"
"""Of world.json, which those read who know nothing of how a world is made."""
UPGRADE = "install the newer version of lpn-explorer"


def is_newer(found: Any, ours: str) -> bool:
    """Whether a file says that it is of a later version of a format than ours."""
    if not isinstance(found, str):
        return False
    kind, _, number = found.partition("/")
    ours_kind, _, ours_number = ours.partition("/")
    # int() knows other digits too, and refuses thousands of them.
    return (
        kind == ours_kind
        and number.isascii()
        and number.isdecimal()
        and len(number) < 10
        and int(number) > int(ours_number)
    )


def newer_version(what: object, found: str, ours: str) -> str:
    """One sentence about it.

    Args:
        what: the file, as the subject of the sentence.
    """
    return f"{what} was written by a later version of lpn ({found}, and this one knows {ours}); {UPGRADE}."
