"""The room of a map in the laboratory's window, which follows the map's proportions."""

from __future__ import annotations

from dataclasses import dataclass

# Pixels of the window that its tab, edges, and scroll bar take: across, and down.
_EDGES = 36, 64
# A window at least this wide may have its controls beside the map, in a column at least this wide.
WIDE, _COLUMN = 700, 250
# Height of the controls and the key above and below a map.
_CONTROLS = 192
_LEAST_HEIGHT, _MOST_HEIGHT_NARROW = 180, 460
# Room at both sides of what is drawn, for the buttons over the map.
_MARGIN = 46
# Proportions of a map beyond these are drawn in a room of these.
_NARROWEST, _WIDEST = 0.3, 4.0


@dataclass(frozen=True)
class MapRoom:
    """The room of the maps.

    Attributes:
        width, height: of one map, in pixels.
        beside: the controls stand beside the maps, not above them.
    """

    width: int
    height: int
    beside: bool = False


def map_room(window: tuple[int, int], proportion: float, maps: int = 1) -> MapRoom:
    """Return the room in which a map is drawn largest: below its controls, or beside them.

    Args:
        window: width and height of the laboratory's window in pixels.
        proportion: width of what is drawn divided by its height.
        maps: the number of maps that stand side by side.
    """
    proportion = min(max(proportion, _NARROWEST), _WIDEST)
    across, down = window[0] - _EDGES[0], window[1] - _EDGES[1]
    if window[0] < WIDE:
        height = max(min(round(across / maps / proportion), _MOST_HEIGHT_NARROW), down + _EDGES[1] - 276, _LEAST_HEIGHT)
        return MapRoom(across // maps, height)
    below = max(down - _CONTROLS, _LEAST_HEIGHT)
    beside = across - _COLUMN
    # Heights of what would be drawn.
    if min(beside / maps / proportion, down) > min(across / maps / proportion, below):
        width = min(round(down * proportion) + 2 * _MARGIN, beside // maps)
        return MapRoom(width, max(min(down, round(width / proportion) + _MARGIN), _LEAST_HEIGHT), True)
    return MapRoom(across // maps, max(min(below, round(across / maps / proportion)), _LEAST_HEIGHT))
