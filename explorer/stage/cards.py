"""The ranked tiles on the stage.

Each row is two pictures, one with all photos and one with all labels: few large pictures render faster than many small ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from explorer.layout import Layout
from explorer.session_state import SessionState
from explorer.stage.image_planes import UPRIGHT, Plane
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import UInt8Array
from lpn.drawing import captions, overlays, theme
from lpn.drawing.theme import Colour, Palette
from lpn.retrieval import Match

# Number of ranked tiles on the stage.
SHOWN = 10
# Height of a label in pixels.
_LABEL = 58
# Width of the marker's line, in stage units.
_MARGIN = 0.04


class Cards:
    """One browser's ranked tiles.

    Args:
        on_select: called with the shown state and the gallery position of a clicked tile.
    """

    def __init__(
        self, scene: viser.SceneApi, workspace: Workspace, on_select: Callable[[SessionState, int], None]
    ) -> None:
        self._workspace, self._on_select = workspace, on_select
        self._layout = layout = workspace.layout
        self._shown: StateAnalysis | None = None
        width, height, above = layout.card
        across = (layout.columns - 1) * layout.step[0] + width
        self._rows: list[tuple[Plane, Plane]] = []
        for first in range(0, SHOWN, layout.columns):
            y = layout.card_centre(first)[1]
            photos = Plane(scene, f"/cards{first}/photos", across, height, (0.0, y - above / 2, 0.0))
            labels = Plane(scene, f"/cards{first}/labels", across, above, (0.0, y + height / 2, 0.0))
            self._rows.append((photos, labels))
        self._drawn: list[object] = [None] * len(self._rows)
        self._marker = Plane(scene, "/marker", width + 2 * _MARGIN, height + above + 2 * _MARGIN, (0, 0, 0.02), "png")
        self._targets = [self._target(scene, slot) for slot in range(SHOWN)]

    def _target(self, scene: viser.SceneApi, slot: int) -> viser.ImageHandle:
        """Add an invisible plane in front of a card to receive clicks."""
        x, y = self._layout.card_centre(slot)
        handle = scene.add_image(
            f"/card{slot}",
            np.zeros((2, 2, 4), np.uint8),
            self._layout.card[0],
            sum(self._layout.card[1:]),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=UPRIGHT,
            position=(x, y, 0.01),
        )
        handle.on_click(self._clicked(slot))
        return handle

    def show(self, analysis: StateAnalysis) -> None:
        """Draw the matches of an analysis."""
        self._shown = analysis
        state, layout, matches = analysis.state, self._layout, analysis.matches
        ground = state.palette.background
        full = max(match.distance2 for match in matches)
        self._mark(analysis)
        for slot, target in enumerate(self._targets):
            target.visible = slot < len(matches)
        gap = (layout.step[0] - layout.card[0]) / layout.card[0]
        for row, (photos, labels) in enumerate(self._rows):
            some = matches[row * layout.columns : (row + 1) * layout.columns]
            photos.handle.visible = labels.handle.visible = bool(some)
            drawn = (analysis.task.name, state.rings, ground, tuple((match.index, match.true) for match in some))
            if some and self._drawn[row] != drawn:
                photos.show(_join_row([self._photo(analysis, match) for match in some], layout.columns, gap, ground))
                self._drawn[row] = drawn
            if some:
                labels.show(
                    _join_row([self._label(analysis, match, full) for match in some], layout.columns, gap, ground)
                )

    def _mark(self, analysis: StateAnalysis) -> None:
        """Frame the compared card if it is shown."""
        slots = [slot for slot, match in enumerate(analysis.matches) if match.index == analysis.chosen.index]
        self._marker.handle.visible = bool(slots)
        if slots:
            x, y = self._layout.card_centre(slots[0])
            self._marker.handle.position = (x, y, 0.02)
            self._marker.show(_frame(self._layout, analysis.state.palette.text))

    def _photo(self, analysis: StateAnalysis, match: Match) -> UInt8Array:
        task, workspace = analysis.task, self._workspace
        picture = workspace.card(task, match.index)
        if analysis.state.rings:
            # Areas that differ from picture to picture would need a forward pass for each card.
            picture = overlays.with_parts(picture, workspace.areas(task.gallery_view), 1)
        return overlays.framed(picture, theme.verdict_colour(match.true), 7)

    def _label(self, analysis: StateAnalysis, match: Match, full: float) -> UInt8Array:
        return _card_label(self._layout, match, analysis.task.gallery[match.index].name, full, analysis.state.palette)

    def _clicked(self, slot: int) -> Callable[[Any], None]:
        def clicked(_: Any) -> None:
            analysis = self._shown
            if analysis is not None and slot < len(analysis.matches):
                self._on_select(analysis.state, analysis.matches[slot].index)

        return clicked


def _join_row(pictures: Sequence[UInt8Array], columns: int, gap: float, ground: Colour) -> UInt8Array:
    """Join pictures of one size in a row of `columns` places; `gap` is relative to a picture's width."""
    height, width = pictures[0].shape[:2]
    step = width * (1 + gap)
    row = np.full((height, round((columns - 1) * step) + width, 3), ground, np.uint8)
    for column, picture in enumerate(pictures):
        left = round(column * step)
        row[:, left : left + width] = picture
    return row


def _frame(layout: Layout, colour: Colour) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Draw a frame around a card, transparent inside."""
    width, height = layout.card[0] + 2 * _MARGIN, sum(layout.card[1:]) + 2 * _MARGIN
    drawn = np.zeros((round(100 * height), round(100 * width), 4), np.uint8)
    drawn[..., :3], line = colour, round(100 * _MARGIN)
    drawn[:line, :, 3] = drawn[-line:, :, 3] = drawn[:, :line, 3] = drawn[:, -line:, 3] = 255
    return drawn


def _card_label(layout: Layout, match: Match, name: str, full: float, palette: Palette) -> UInt8Array:
    width = round(_LABEL * layout.card[0] / layout.card[2])
    image, draw = captions.caption(width, _LABEL, palette)
    draw.text((2, 20), str(match.rank), palette.text, captions.font(26), anchor="lm")
    x = 8 + draw.textlength(str(match.rank), font=captions.font(26))
    if match.true is not None:
        captions.draw_sign(draw, x + 2, 11, 17, match.true, palette)
        x += 28
    value = f"{match.distance2:.3f}"
    draw.text((width - 2, 20), value, palette.text, captions.font(22), anchor="rm")
    room = width - 2 - draw.textlength(value, font=captions.font(22)) - x - 8
    draw.text((x, 21), captions.fitted(draw, name, 20, room), palette.dim, captions.font(20), anchor="lm")
    captions.draw_shares(draw, (0, 40, width - 1, 52), match.shares, full, palette)
    return np.asarray(image)
