"""Positions on the stage: the pair side by side, or stacked where the network's input is a panorama."""

from __future__ import annotations

from dataclasses import dataclass

Point = tuple[float, float]


@dataclass(frozen=True)
class ScreenLayout:
    """Positions and sizes in stage units: x from -4.15 to 4.15, y from -3.69 to 4.41, below the heatmaps' legend.

    Attributes:
        stacked: True if the compared tile is below the query, False if it is to the right.
        picture: width and height of the query and of the compared tile.
        pixels: rows and columns of their images.
        query, tile: centres of the two pictures.
        query_caption, tile_caption: centres of the captions.
        gutter: centre, then width and height, of the part bars between the pictures.
        card: width of a ranked tile's card, height of its picture, height of its label.
        card_pixels: rows and columns of a card's image.
        columns: cards in a row.
        cards_top: upper border of the first row of cards.
        step: offset from one card to the next, across and down.
    """

    stacked: bool
    picture: Point
    pixels: tuple[int, int]
    query: Point
    tile: Point
    query_caption: Point
    tile_caption: Point
    gutter: tuple[Point, Point]
    card: tuple[float, float, float]
    card_pixels: tuple[int, int]
    columns: int
    cards_top: float
    step: Point

    def card_centre(self, slot: int) -> Point:
        """Return the centre of a card with its label."""
        row, column = divmod(slot, self.columns)
        x = (column - (self.columns - 1) / 2) * self.step[0]
        return x, self.cards_top - sum(self.card[1:]) / 2 - row * self.step[1]


# Width and height of a caption.
CAPTION: Point = (3.3, 0.36)

_SQUARE = ScreenLayout(
    stacked=False,
    picture=(3.3, 3.3),
    pixels=(384, 384),
    query=(-2.4, 2.2),
    tile=(2.4, 2.2),
    query_caption=(-2.4, 4.09),
    tile_caption=(2.4, 4.09),
    gutter=((0.0, 2.2), (1.3, 3.3)),
    card=(1.5, 1.5, 0.36),
    card_pixels=(224, 224),
    columns=5,
    cards_top=0.28,
    step=(1.62, 2.02),
)


def layout_for(input_size: tuple[int, int]) -> ScreenLayout:
    """Return the layout for a network's input of (height, width) pixels."""
    height, width = input_size
    aspect = width / height
    if aspect < 2:
        return _SQUARE
    across, down = min(8.1, 1.47 * aspect), min(8.1 / aspect, 1.47)
    left = -across / 2 + CAPTION[0] / 2
    card = min(2.62, 0.5 * aspect)
    return ScreenLayout(
        stacked=True,
        picture=(across, down),
        pixels=(round(960 / aspect), 960),
        query=(0.0, 3.98 - down / 2),
        tile=(0.0, 1.92 - down / 2),
        query_caption=(left, 4.2),
        tile_caption=(left, 0.23),
        gutter=((0.0, 2.215), (across, 0.56)),
        card=(card, card / aspect, 0.27),
        card_pixels=(round(416 / aspect), 416),
        columns=3,
        cards_top=-0.04,
        step=(2.74, card / aspect + 0.38),
    )
