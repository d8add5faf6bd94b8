"""Tests of where a lead comes from, and of what tiles show there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.datasets.ground_use import ground_uses, named_uses
from lpn.drawing.verdicts import describe_lead_place
from lpn.drawing.words import Vocabulary, speaking
from lpn.explain.lead_places import TileGround, lead_place

RINGS = np.zeros((2, 8, 8), bool)
RINGS[0, 2:6, 2:6] = True
RINGS[1] = ~RINGS[0]
NAMES = ["1 centre", "2"]
NORTH_ROAD = np.array([list("rrrr"), *(list("gggg") for _ in range(3))])
SOUTH_ROAD = np.flipud(NORTH_ROAD)


def test_a_sentence_tells_ring_side_and_what_both_tiles_show_there() -> None:
    cells = np.zeros((8, 8))
    cells[0, 2:6] = 0.05  # the top of the query's outer ring
    grounds = TileGround(NORTH_ROAD), TileGround(SOUTH_ROAD)

    def said(turn: float | None, terms: tuple[float, float] = (0.1, 0.3)) -> str:
        place = lead_place(np.array(terms), [1], cells, (RINGS, RINGS), grounds, turn)
        with speaking(Vocabulary(plain=True, part="ring")):
            return describe_lead_place(place, NAMES, "drone", ("this answer", "the other picture"), "the picture")

    head = "Ring 2, the outermost, speaks most for this answer (75 % of what speaks for it), above all at the top of the picture"
    assert said(0.0) == f"{head}: there this answer shows a road, and the other picture grass."
    # Turned by half a circle, the top of the query is the bottom of the tiles.
    assert said(180.0) == f"{head}: there this answer shows grass, and the other picture a road."
    assert said(None) == f"{head}.", "nobody knows where in the tiles that is"
    assert said(None, (-0.1, 0.3)).startswith("Only ring 2, the outermost, speaks for this answer,")


@pytest.mark.parametrize(
    ("parts", "head"),
    [
        ([0], "Ring 1, the square in the middle, speaks"),
        ([1], "Ring 2, the 2nd square ring from the middle, speaks"),
        ([1, 2], "Rings 2 and 3, the 2nd square ring from the middle and the outermost, speak"),
    ],
)
def test_plain_words_say_where_a_ring_lies(parts: list[int], head: str) -> None:
    rings = np.concatenate([RINGS, RINGS[:1]])
    place = lead_place(np.array([0.2, 0.2, 0.2]), parts, np.ones((8, 8)), (rings, rings))
    with speaking(Vocabulary(plain=True, part="ring")):
        said = describe_lead_place(
            place, ["1 centre", "2", "3 outer"], "drone", ("this answer", "the other"), "the picture"
        )
    assert said.startswith(f"{head} most")


def test_where_no_side_leads_the_whole_ring_is_named() -> None:
    place = lead_place(np.array([0.2, 0.1]), [0], np.ones((8, 8)), (RINGS, RINGS), (TileGround(NORTH_ROAD),) * 2)
    assert place.share == pytest.approx(2 / 3)
    said = describe_lead_place(place, NAMES, "drone", ("this answer", "the other picture"), "the picture")
    assert said == "Part 1 (centre) speaks most for this answer (67 % of what speaks for it), where both show grass.", (
        "the centre is around nothing"
    )
    outer = lead_place(np.array([0.1, 0.2]), [1], np.ones((8, 8)), (RINGS, RINGS))
    said = describe_lead_place(outer, NAMES, "drone", ("this answer", "the other picture"), "the picture")
    assert said.endswith(" of what speaks for it), all around the middle.")


def test_uses_are_those_of_the_picture_as_it_is_zoomed() -> None:
    top = np.zeros((8, 8), bool)
    top[0] = True
    assert named_uses(NORTH_ROAD, top) == ["a road"]
    assert named_uses(NORTH_ROAD, top, zoom=2.0) == ["grass"], "the middle alone is described"
    assert named_uses(NORTH_ROAD, top, zoom=0.5) == [], "it lies beyond the tile"
    assert named_uses(np.full((4, 4), "."), top) == []


def test_a_file_of_uses_is_read_or_its_line_is_named(tmp_path: Path) -> None:
    assert ground_uses(tmp_path) == {}
    file = tmp_path / "ground.csv"
    file.write_text("path,uses\na/1.jpg,br gt\n")
    assert ground_uses(tmp_path)["a/1.jpg"].tolist() == [["b", "r"], ["g", "t"]]
    for bad in ("a/1.jpg,br g", "a/1.jpg,bx gt", "a/1.jpg"):
        file.write_text(f"path,uses\n{bad}\n")
        with pytest.raises(DataError, match=r"Line 2 of ground.csv"):
            ground_uses(tmp_path)
    file.write_text("name\n")
    with pytest.raises(DataError, match=r"The first line of ground.csv is name; expected path,uses"):
        ground_uses(tmp_path)
