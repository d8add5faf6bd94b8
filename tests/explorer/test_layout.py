from __future__ import annotations

import pytest

from explorer.layout import CAPTION, layout_for

Box = tuple[float, float, float, float]


def box(centre: tuple[float, float], width: float, height: float) -> Box:
    return centre[0] - width / 2, centre[1] - height / 2, centre[0] + width / 2, centre[1] + height / 2


def overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


@pytest.mark.parametrize("size", [(256, 256), (256, 320), (128, 256), (112, 616), (64, 640)])
def test_nothing_on_the_stage_overlaps_or_sticks_out(size: tuple[int, int]) -> None:
    layout = layout_for(size)
    assert layout.stacked == (size[1] >= 2 * size[0])
    boxes = [
        box(layout.query, *layout.picture),
        box(layout.tile, *layout.picture),
        box(*[layout.gutter[0], *layout.gutter[1]]),
    ]
    boxes += [box(caption, *CAPTION) for caption in (layout.query_caption, layout.tile_caption)]
    boxes += [box(layout.card_centre(slot), layout.card[0], sum(layout.card[1:])) for slot in range(10)]
    for position, one in enumerate(boxes):
        assert min(one[0], -one[2]) > -4.16
        assert -3.7 < one[1] < one[3] < 4.42
        assert not any(overlap(one, other) for other in boxes[position + 1 :])
    if layout.stacked:
        assert layout.picture[0] / layout.picture[1] == pytest.approx(size[1] / size[0])
        assert layout.pixels[1] / layout.pixels[0] == pytest.approx(size[1] / size[0], rel=0.02)
