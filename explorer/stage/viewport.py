"""The size of one browser's stage, and of windows over it."""

from __future__ import annotations

from collections.abc import Callable

# Pixels between a window and the stage's border.
EDGE = 6
_MIN_WINDOW = 320
# Longest side of a stage, and of a window.
MAX_SIDE = 10_000


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

    def resize(self, width: int, height: int) -> None:
        """Take the size from the page."""
        if (self.width, self.height) != (width, height):
            self.width, self.height = width, height
            for on_resize in self._watchers:
                on_resize()

    def window(self, limit: tuple[int, int] = (MAX_SIDE, MAX_SIDE), share: float = 1.0) -> tuple[int, int]:
        """Return the size of a window that covers a share of the stage's height, within a limit."""
        width = min(self.width, limit[0]) - 2 * EDGE
        height = round(share * min(self.height, limit[1])) - 2 * EDGE
        return max(width, _MIN_WINDOW), max(height, _MIN_WINDOW)
