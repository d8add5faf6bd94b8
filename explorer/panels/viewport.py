"""How much room a browser's stage has for windows over it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from explorer import session_state

EDGE = 6
_LEAST, _MOST = 320, 10_000


class Viewport:
    """The stage's width and height in the page's own pixels, as the page tells them.

    The camera's would not do: where drawing is slow, viser renders fewer pixels than the page has.
    """

    def __init__(self) -> None:
        self.width, self.height = 780, 820
        self._watching: list[Callable[[], None]] = []

    def watch(self, told: Callable[[], None]) -> None:
        """Have a function called whenever the size is another."""
        self._watching.append(told)

    def take(self, value: Any) -> None:
        """Note what the page says, [width, height], if it is that."""
        if isinstance(value, list) and len(value) == 2:
            sides = [session_state.whole(side, 1, _MOST) for side in value]
            if None not in sides and (self.width, self.height) != tuple(sides):
                self.width, self.height = cast("tuple[int, int]", tuple(sides))
                for told in self._watching:
                    told()

    def window(self, most: tuple[int, int] = (_MOST, _MOST), share: float = 1.0) -> tuple[int, int]:
        """Width and height of a window over the stage, or over a share of its height, up to a largest one."""
        width = min(self.width, most[0]) - 2 * EDGE
        height = round(share * min(self.height, most[1])) - 2 * EDGE
        return max(width, _LEAST), max(height, _LEAST)
