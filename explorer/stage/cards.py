"""The ranked tiles on the stage.

Each row is two pictures, one with all photos and one with all labels: few large pictures render faster than many small ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import RLock
from typing import Any

import numpy as np
import viser

from explorer.compute.request_context import QueuedModel
from explorer.compute.worker import Worker
from explorer.layout import LABEL, ScreenLayout
from explorer.session_state import SessionState
from explorer.stage.image_planes import UPRIGHT, Plane
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import LPNError
from lpn.drawing import captions, overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import Colour, Palette
from lpn.retrieval import Match

# Number of ranked tiles on the stage.
SHOWN = 10
# Rows of cards in any layout.
_ROWS = 2
# Height of a label in pixels, and its text's size: it is drawn twice as fine as the screen.
_LABEL_PIXELS, _LABEL_TEXT = 2 * LABEL, 26
# Width of the marker's line, in stage units.
_MARGIN = 0.03


class Cards:
    """One browser's ranked tiles.

    Where parts differ from picture to picture, a worker describes the shown tiles in the background, one at a time, and draws
    the parts of a row when it has all of them.

    Args:
        on_select: called with the shown state and the gallery position of a clicked tile.
        model: describes tiles in the background; None if there are only stored descriptors.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        workspace: Workspace,
        on_select: Callable[[SessionState, int], None],
        model: QueuedModel | None,
    ) -> None:
        self._workspace, self._on_select, self._model = workspace, on_select, model
        self._layout = workspace.layout
        self._analysis: StateAnalysis | None = None
        self._rows = [
            tuple(Plane(scene, f"/cards{row}/{kind}", 1.0, 1.0, (0.0, 0.0, 0.0)) for kind in ("photos", "labels"))
            for row in range(_ROWS)
        ]
        self._drawn: list[object] = [None] * len(self._rows)
        # Lines, not a picture: the transparent inside of one would hide the card from a side.
        self._marker = scene.add_line_segments(
            "/marker", np.zeros((4, 2, 3), np.float32), np.zeros((4, 2, 3), np.uint8), thickness=_MARGIN
        )
        self._targets = [self._target(scene, slot) for slot in range(SHOWN)]
        self._lock = RLock()
        # An error is in the log; the tile has no borders then.
        self._worker = Worker(self._find_areas, lambda _: None)

    def leave(self) -> None:
        """Stop describing tiles: the browser has left."""
        self._worker.stop()

    def _target(self, scene: viser.SceneApi, slot: int) -> viser.ImageHandle:
        """Add an invisible plane behind a card to receive clicks; in front, it would hide the card from a side."""
        handle = scene.add_image(
            f"/card{slot}",
            np.zeros((2, 2, 4), np.uint8),
            1.0,
            1.0,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=UPRIGHT,
            position=(0.0, 0.0, -0.01),
        )
        handle.on_click(self._clicked(slot))
        return handle

    def place(self, layout: ScreenLayout) -> None:
        """Move the cards to where a layout has them."""
        self._layout, self._drawn = layout, [None] * _ROWS
        width, height, above = layout.card
        across = (layout.columns - 1) * layout.step[0] + width
        for row, (photos, labels) in enumerate(self._rows):
            y = layout.card_centre(row * layout.columns)[1]
            photos.place(((0.0, y - above / 2), (across, height)))
            labels.place(((0.0, y + height / 2), (across, above)))
        for slot, target in enumerate(self._targets):
            target.position = (*layout.card_centre(slot), -0.01)
            target.render_width, target.render_height = width, height + above
        self._marker.points = _frame(width, height + above)

    def show(self, analysis: StateAnalysis) -> None:
        """Draw the matches of an analysis."""
        with self._lock:
            self._analysis = analysis
            self._draw(analysis)
        if self._model is not None and analysis.state.rings and self._unknown(analysis):
            self._worker.wake()

    def _draw(self, analysis: StateAnalysis) -> None:
        state, layout, matches = analysis.state, self._layout, analysis.matches
        ground = state.palette.background
        full = max(match.distance2 for match in matches)
        self._mark(analysis)
        for slot, target in enumerate(self._targets):
            target.visible = slot < min(len(matches), layout.shown)
        for row, (photos, labels) in enumerate(self._rows):
            some = self._row(analysis, row)
            photos.handle.visible = labels.handle.visible = bool(some)
            if some:
                self._draw_photos(analysis, row)
                labels.show(
                    _join_row(
                        [_card_label(layout, match, full, state.palette) for match in some],
                        layout.columns,
                        self._gap,
                        ground,
                    )
                )

    @property
    def _gap(self) -> float:
        """The room between two cards relative to a card's width."""
        return self._layout.step[0] / self._layout.card[0] - 1

    def _row(self, analysis: StateAnalysis, row: int) -> Sequence[Match]:
        columns = self._layout.columns
        return analysis.matches[row * columns : (row + 1) * columns] if row < self._layout.rows else ()

    def _draw_photos(self, analysis: StateAnalysis, row: int) -> None:
        """Draw a row's photos, unless the same ones are drawn."""
        state, some, ground = analysis.state, self._row(analysis, row), analysis.state.palette.background
        areas = [
            self._workspace.known_tile_areas(analysis.task, match.index) if state.rings else None for match in some
        ]
        cards = [(match.index, match.true, known is not None) for match, known in zip(some, areas, strict=True)]
        drawn = (analysis.task.key, ground, cards)
        if self._drawn[row] != drawn:
            photos = [self._photo(analysis, match, known) for match, known in zip(some, areas, strict=True)]
            self._rows[row][0].show(_join_row(photos, self._layout.columns, self._gap, ground))
            self._drawn[row] = drawn

    def _unknown(self, analysis: StateAnalysis) -> list[Match]:
        """Return the shown tiles whose parts are not known, though the model gives their cells."""
        if not self._workspace.contract.has_cells:
            return []
        return [
            match for match in analysis.matches if self._workspace.known_tile_areas(analysis.task, match.index) is None
        ]

    def _find_areas(self) -> None:
        analysis = self._analysis
        if analysis is None:
            return
        for row in range(len(self._rows)):
            for match in self._row(analysis, row):
                if self._analysis is not analysis:  # `show` has asked for a newer one
                    return
                with suppress(LPNError):  # a damaged picture
                    self._workspace.find_tile_areas(analysis.task, match.index, self._model)
            with self._lock:
                if self._analysis is analysis and self._row(analysis, row):
                    self._draw_photos(analysis, row)

    def _mark(self, analysis: StateAnalysis) -> None:
        """Frame the compared card if it is shown."""
        shown = analysis.matches[: self._layout.shown]
        slots = [slot for slot, match in enumerate(shown) if match.index == analysis.chosen.index]
        self._marker.visible = bool(slots)
        if slots:
            x, y = self._layout.card_centre(slots[0])
            self._marker.position = (x, y, 0.02)
            self._marker.colors = np.full((4, 2, 3), analysis.state.palette.text, np.uint8)

    def _photo(self, analysis: StateAnalysis, match: Match, areas: PartAreas | None) -> UInt8Array:
        picture = overlays.with_parts(self._workspace.card(analysis.task, match.index), areas, 1)
        # The frame is two CSS pixels wide.
        width = round(2 * picture.shape[1] / (self._layout.card[0] * self._layout.unit))
        return overlays.framed(picture, theme.verdict_colour(match.true), max(width, 2))

    def _clicked(self, slot: int) -> Callable[[Any], None]:
        def clicked(_: Any) -> None:
            analysis = self._analysis
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


def _frame(width: float, height: float) -> Float32Array:
    """Return the four lines around a card, (4, 2, 3), from its centre in stage units; they meet at their outer edges."""
    x, y, half = (width + _MARGIN) / 2, (height + _MARGIN) / 2, _MARGIN / 2
    lines = [
        ((-x - half, y), (x + half, y)),
        ((-x - half, -y), (x + half, -y)),
        ((-x, -y), (-x, y)),
        ((x, -y), (x, y)),
    ]
    return np.array([[(*point, 0.0) for point in line] for line in lines], np.float32)


def _card_label(layout: ScreenLayout, match: Match, full: float, palette: Palette) -> UInt8Array:
    width, size = round(2 * layout.card[0] * layout.unit), _LABEL_TEXT
    image, draw = captions.caption(width, _LABEL_PIXELS, palette)
    font, middle, edge, sign = captions.font(size), 0.36 * _LABEL_PIXELS, size / 8, 0.66 * size
    # All labels have the digits for which the tenth rank has room.
    digits = 3 if draw.textlength(f"{SHOWN}0.000", font=font) + sign + 4 * edge <= width else 2
    draw.text((edge, middle), str(match.rank), palette.text, font, anchor="lm")
    x = 2 * edge + draw.textlength(str(match.rank), font=font)
    if match.true is not None:
        captions.draw_sign(draw, x, middle - size / 3, sign, match.true, palette)
    draw.text((width - edge, middle), f"{match.distance2:.{digits}f}", palette.dim, font, anchor="rm")
    captions.draw_shares(
        draw, (0, 0.73 * _LABEL_PIXELS, width - 1, 0.87 * _LABEL_PIXELS), match.contributions, full, palette
    )
    return np.asarray(image)
