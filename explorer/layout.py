"""Positions on the stage: the pair as large as the page allows, the bars of its parts, and the ranked tiles in a strip."""

from __future__ import annotations

from dataclasses import dataclass

Point = tuple[float, float]
# Centre, then width and height.
Box = tuple[Point, Point]

# Height of the stage in its own units, whatever its size on the screen.
HEIGHT = 8.4
# Heights in CSS pixels: of the row of controls, a caption, a card's label, the bars' heading and rows, and a line of notes.
TOOLS, CAPTION, LABEL, BAR, NOTE = 36, 30, 30, 22, 16
# A stage at least this high has controls and bars; a lower one, as on a phone, leaves its room to the pictures.
ROOMY = 560
# Width and height of a stage before the page has reported its own.
DEFAULT_STAGE = (780, 820)
# A stage at least this wide has room for all notes in one line.
WIDE = 600
# Widths of the bars from which on their titles take one line, and two; less wide, they take three.
TITLE_WIDTHS = 840, 500
_GAP, _CARD_GAP = 12, 8
_MOST_CARDS = 10
_SMALLEST_CARD, _LARGEST_CARD = 58, 140
# From this ratio of width to height on, pictures are panoramas, and are stacked.
_PANORAMA = 2.0


@dataclass(frozen=True)
class ScreenLayout:
    """Positions and sizes in stage units, around (0, 0); the stage is `HEIGHT` high.

    Attributes:
        stacked: True if the compared tile is below the query, False if it is to the right.
        stage: width and height of the stage in CSS pixels.
        query, tile: the two pictures.
        pixels: rows and columns of their images.
        query_caption, tile_caption: the captions above them.
        notes: the room of the notes below the pair: one line, and two on a narrow stage.
        bars: the room of the part bars; None on a low stage.
        card: width of a ranked tile's card, height of its picture, height of its label.
        card_pixels: rows and columns of a card's image.
        columns, rows: of the cards.
        cards_top: upper border of the first row of cards.
        step: offset from one card to the next, across and down.
    """

    stacked: bool
    stage: tuple[int, int]
    query: Box
    tile: Box
    pixels: tuple[int, int]
    query_caption: Box
    tile_caption: Box
    notes: Box
    bars: Box | None
    card: tuple[float, float, float]
    card_pixels: tuple[int, int]
    columns: int
    rows: int
    cards_top: float
    step: Point

    @property
    def picture(self) -> Point:
        """Width and height of the query and of the compared tile."""
        return self.query[1]

    @property
    def unit(self) -> float:
        """CSS pixels of a stage unit."""
        return self.stage[1] / HEIGHT

    @property
    def shown(self) -> int:
        """The number of cards."""
        return self.columns * self.rows

    @property
    def cards(self) -> Box:
        """The room of all cards."""
        width, height = self.columns * self.step[0], self.rows * self.step[1]
        return (0.0, self.cards_top - height / 2), (width, height)

    def card_centre(self, slot: int) -> Point:
        """Return the centre of a card with its label."""
        row, column = divmod(slot, self.columns)
        x = (column - (self.columns - 1) / 2) * self.step[0]
        return x, self.cards_top - sum(self.card[1:]) / 2 - row * self.step[1]


@dataclass(frozen=True)
class _Choice:
    """One arrangement in CSS pixels: widths of a picture and of a card, columns and rows of cards."""

    picture: float
    card: float
    columns: int
    rows: int

    @property
    def worth(self) -> float:
        """Large pictures come first, then all cards, then large cards."""
        return self.picture + 6 * self.columns * self.rows + 0.2 * self.card


def layout_for(input_size: tuple[int, int], n_parts: int = 4, stage: tuple[int, int] = DEFAULT_STAGE) -> ScreenLayout:
    """Return the layout for a network's input of (height, width) pixels on a stage of (width, height) CSS pixels."""
    aspect = input_size[1] / input_size[0]
    stacked = aspect >= _PANORAMA
    width, height = stage
    tools, rows = (TOOLS, BAR * (n_parts + 1)) if height >= ROOMY else (0, 0)
    notes = NOTE if width >= WIDE else 2 * NOTE
    inside = width - 2 * _GAP
    for lines in range(len(TITLE_WIDTHS) + 1):  # narrower pictures have narrower titles, which take more lines
        bars = rows + NOTE * lines if rows else 0
        fixed = tools + bars + notes + (_GAP if bars else 0) + (2 if stacked else 1) * CAPTION + 2 * _GAP
        chosen = max(_choices(aspect, inside, height - fixed, stacked), key=lambda one: one.worth)
        picture = chosen.picture, chosen.picture / aspect
        wide = inside if stacked else 2 * picture[0] + _GAP
        if lines == sum(wide < one for one in TITLE_WIDTHS):
            break
    card_height = chosen.card / aspect
    strip = chosen.rows * (card_height + LABEL) + (chosen.rows - 1) * _CARD_GAP
    used = fixed + (2 if stacked else 1) * picture[1] + strip
    spare = max(height - used, 0.0) / 3  # above the pair, below it, and below the bars
    unit = height / HEIGHT

    def box(left: float, top: float, size: Point) -> Box:
        """Return a box in stage units, given in pixels from the top of the stage's middle."""
        return ((left + size[0] / 2) / unit, HEIGHT / 2 - (top + size[1] / 2) / unit), (size[0] / unit, size[1] / unit)

    top = tools + spare
    if stacked:
        left = lefts = -picture[0] / 2
        tops = top, top + CAPTION + picture[1]
        left_of_tile = lefts
    else:
        left = -picture[0] - _GAP / 2
        tops, left_of_tile = (top, top), _GAP / 2
    below = max(tops) + CAPTION + picture[1] + _GAP
    caption = picture[0], float(CAPTION)
    cards_top = height - _GAP - strip
    return ScreenLayout(
        stacked=stacked,
        stage=stage,
        query=box(left, tops[0] + CAPTION, picture),
        tile=box(left_of_tile, tops[1] + CAPTION, picture),
        pixels=(round(960 / aspect), 960) if stacked else (512, 512),
        query_caption=box(left, tops[0], caption),
        tile_caption=box(left_of_tile, tops[1], caption),
        notes=box(-inside / 2, below, (inside, notes)),
        bars=box(-wide / 2, below + notes + spare, (wide, bars)) if bars else None,
        card=(chosen.card / unit, card_height / unit, LABEL / unit),
        card_pixels=(round(416 / aspect), 416) if stacked else (224, 224),
        columns=chosen.columns,
        rows=chosen.rows,
        cards_top=HEIGHT / 2 - cards_top / unit,
        step=((chosen.card + _CARD_GAP) / unit, (card_height + LABEL + _CARD_GAP) / unit),
    )


def _choices(aspect: float, width: float, height: float, stacked: bool) -> list[_Choice]:
    """Return the arrangements that fit a width, and a height for pictures and cards, in CSS pixels; never none."""
    pictures, choices = 2 if stacked else 1, []
    across = width if stacked else (width - _GAP) / 2
    for rows in (1, 2):
        gaps = rows * LABEL + (rows - 1) * _CARD_GAP
        for columns in range(2, _MOST_CARDS // rows + 1):
            widest = min((width - (columns - 1) * _CARD_GAP) / columns, pictures * _LARGEST_CARD)
            # Cards may be smaller, so that the pictures are as wide as the stage.
            beside = aspect * (height - gaps - pictures * across / aspect) / rows
            for card in (widest, min(widest, beside)):
                if card >= _SMALLEST_CARD:
                    down = (height - gaps - rows * card / aspect) / pictures
                    choices.append(_Choice(max(min(across, down * aspect), 40.0), card, columns, rows))
    return choices or [_Choice(40.0, float(_SMALLEST_CARD), 2, 1)]
