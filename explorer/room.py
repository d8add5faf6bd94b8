"""How much room a browser's stage has for windows over it."""

from __future__ import annotations

from typing import Any

from explorer import session

EDGE = 6
_LEAST, _MOST = 320, 10_000


class Room:
    """The stage's width and height in the page's own pixels, as the page tells them.

    The camera's would not do: where drawing is slow, viser renders fewer pixels than the page has.
    """

    def __init__(self) -> None:
        self.width, self.height = 780, 820

    def take(self, value: Any) -> None:
        """Note what the page says, [width, height], if it is that."""
        if isinstance(value, list) and len(value) == 2:
            sides = [session.whole(side, 1, _MOST) for side in value]
            if sides[0] is not None and sides[1] is not None:
                self.width, self.height = sides[0], sides[1]

    def window(self, most: tuple[int, int] = (_MOST, _MOST), share: float = 1.0) -> tuple[int, int]:
        """Width and height of a window over the stage, or over a share of its height, up to a largest one."""
        width = min(self.width, most[0]) - 2 * EDGE
        height = round(share * min(self.height, most[1])) - 2 * EDGE
        return max(width, _LEAST), max(height, _LEAST)
