from __future__ import annotations

import pytest

from explorer.layout import BAR, HEIGHT, NOTE, TITLE_WIDTHS, Box, layout_for

STAGES = [(390, 388), (424, 600), (780, 820), (1070, 900), (1540, 1080), (2200, 1200)]
Edges = tuple[float, float, float, float]


def edges(box: Box) -> Edges:
    (x, y), (width, height) = box
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def overlap(one: Edges, other: Edges) -> bool:
    least = 1e-6
    return (
        one[0] < other[2] - least
        and other[0] < one[2] - least
        and one[1] < other[3] - least
        and other[1] < one[3] - least
    )


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("parts", [4, 8])
@pytest.mark.parametrize("size", [(256, 256), (256, 320), (128, 256), (112, 616), (64, 640)])
def test_nothing_on_the_stage_overlaps_or_sticks_out(size: tuple[int, int], parts: int, stage: tuple[int, int]) -> None:
    layout = layout_for(size, parts, stage)
    assert layout.stacked == (size[1] >= 2 * size[0])
    boxes = [layout.query, layout.tile, layout.query_caption, layout.tile_caption, layout.notes]
    boxes += [] if layout.bars is None else [layout.bars]
    boxes += [(layout.card_centre(slot), (layout.card[0], sum(layout.card[1:]))) for slot in range(layout.shown)]
    across = HEIGHT * stage[0] / stage[1] / 2 + 1e-6
    for position, one in enumerate(map(edges, boxes)):
        assert min(one[0], -one[2]) >= -across
        assert -HEIGHT / 2 <= one[1] < one[3] <= HEIGHT / 2
        assert not any(overlap(one, edges(other)) for other in boxes[position + 1 :])
    assert layout.picture[0] / layout.picture[1] == pytest.approx(size[1] / size[0])
    assert layout.card[0] * layout.unit >= 58


@pytest.mark.parametrize("stage", STAGES[2:])
def test_the_pair_takes_most_of_the_stage(stage: tuple[int, int]) -> None:
    layout = layout_for((256, 256), 4, stage)
    side = layout.picture[0] * layout.unit
    assert side > 0.9 * stage[0] / 2 or 3 * side > 2 * stage[1]
    assert layout.shown == 10


@pytest.mark.parametrize("stage", STAGES[1:])
@pytest.mark.parametrize("size", [(256, 256), (112, 616)])
def test_the_titles_of_narrow_bars_have_room_for_more_lines(size: tuple[int, int], stage: tuple[int, int]) -> None:
    layout = layout_for(size, 4, stage)
    assert layout.bars is not None
    width, height = (side * layout.unit for side in layout.bars[1])
    lines = sum(width < least for least in TITLE_WIDTHS)
    assert height == pytest.approx(BAR * 5 + NOTE * lines)
