"""The map of an exported step: the ground around the query, the ranked tiles as frames, and a line to the compared tile."""

from __future__ import annotations

import numpy as np

from explorer.stories.map_picture import TEXT, WHITE, MapPicture
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import UInt8Array
from lpn.drawing import captions, theme
from lpn.tasks.gallery_geometry import GalleryGeometry

# The smallest width of what is shown, in metres, and the space around it as a share.
_LEAST, _BORDER = 260.0, 0.16


def draw(workspace: Workspace, analysis: StateAnalysis) -> UInt8Array | None:
    """Draw the map, (H, W, 3) uint8, north up; None where no position is known."""
    places = analysis.task.geometry
    if places is None:
        return None
    seen = np.full(2, np.nan) if analysis.state.upload else places.query_ground[analysis.state.query]
    frames = [analysis.chosen, *([analysis.positive] if analysis.positive is not None else [])]
    corners = [
        places.ground[match.index] + sign * _side(places, match.index) / 2 for match in frames for sign in (-1.0, 1.0)
    ]
    points = np.array([seen, *corners])
    if not np.isfinite(points).all(axis=1).any():
        return None
    drawn = MapPicture(points, _BORDER, _LEAST)
    drawn.lay(workspace.mosaic(analysis.task), places.bounds())
    pen = drawn.pen
    by_index = {match.index: match for match in (*analysis.matches, *frames)}
    for match in sorted(by_index.values(), key=lambda match: -match.rank):
        if not np.isfinite(places.ground[match.index]).all():
            continue
        half, (x, y) = _side(places, match.index) / 2 / drawn.unit, drawn.pixels(places.ground[match.index])
        thick = 7 if match.index == analysis.chosen.index else 4
        pen.rectangle((x - half, y - half, x + half, y + half), None, theme.verdict_colour(match.true), thick)
        width = pen.textlength(match.rank_text, captions.font(TEXT))
        pen.rectangle((x - half, y - half, x - half + 16 + width, y - half + TEXT + 8), theme.BACKGROUND)
        pen.text((x - half + 8, y - half + TEXT / 2 + 4), match.rank_text, theme.TEXT, captions.font(TEXT), anchor="lm")
    if np.isfinite(seen).all():
        chosen = places.ground[analysis.chosen.index]
        if np.isfinite(chosen).all():
            drawn.line((seen, chosen), theme.verdict_colour(analysis.chosen.true))
        drawn.dot(seen, WHITE, 11)
    drawn.mark_ground()
    return drawn.picture()


def _side(places: GalleryGeometry, index: int) -> float:
    """Return the side of a tile in metres."""
    return float(places.tiles[index].width or places.width)
