"""Values as the page takes them: JSON without control characters."""

from __future__ import annotations

from collections.abc import Mapping

from lpn.core.templates import shown


def shown_json(value: object) -> object:
    """Return a value of JSON whose texts hold no control characters."""
    match value:
        case Mapping():
            return {key: shown_json(entry) for key, entry in value.items()}
        case list() | tuple():
            return [shown_json(entry) for entry in value]
    return shown(str(value) if isinstance(value, str) else value)
