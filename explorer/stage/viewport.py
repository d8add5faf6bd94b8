"""The size of one browser's stage, and of windows over it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from explorer import session_state

# Pixels between a window and the stage's border.
EDGE = 6
_MIN_WINDOW = 320
_MAX_SIDE = 10_000


class Viewport:
    """The stage's width and height in CSS pixels, as the page reports them.

    viser's camera reports another size: on slow machines, viser renders at a lower resolution.
    """

    def __init__(self) -> None:
        self.width, self.height = 780, 820
        self._watchers: list[Callable[[], None]] = []

    def watch(self, on_resize: Callable[[], None]) -> None:
        """Call a function whenever the size changes."""
        self._watchers.append(on_resize)

    def update(self, value: Any) -> None:
        """Take the size from the page, [width, height]; anything else is ignored."""
        if isinstance(value, list) and len(value) == 2:
            size = tuple(session_state.integer(side, 1, _MAX_SIDE) for side in value)
            if None not in size and (self.width, self.height) != size:
                self.width, self.height = cast("tuple[int, int]", size)
                for on_resize in self._watchers:
                    on_resize()

    def window(self, limit: tuple[int, int] = (_MAX_SIDE, _MAX_SIDE), share: float = 1.0) -> tuple[int, int]:
        """Return the size of a window that covers a share of the stage's height, within a limit."""
        width = min(self.width, limit[0]) - 2 * EDGE
        height = round(share * min(self.height, limit[1])) - 2 * EDGE
        return max(width, _MIN_WINDOW), max(height, _MIN_WINDOW)
