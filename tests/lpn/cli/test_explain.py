"""`lpn explain` as a person runs it, and the sentences it says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import lpn
from lpn.cli import main
from lpn.drawing import ranking_figure, verdicts
from lpn.drawing.theme import verdict_colour
from lpn.explain import Evidence, SideEvidence
from lpn.retrieval.scoring import part_weights
from tests.lpn.cli.test_main import without_torch


@pytest.fixture
def pair(data: Path) -> list[str]:
    """A drone picture and a tile of other names, as options."""
    query, match = (next((data / "test" / name / "0008").iterdir()) for name in ("query_drone", "gallery_satellite"))
    return ["--query", str(query), "--match", str(match)]


def test_what_is_written_adds_up_and_needs_no_torch(model_file: Path, pair: list[str], tmp_path: Path) -> None:
    file, picture = tmp_path / "deep" / "why.json", tmp_path / "why.png"
    run = without_torch(
        "explain", "--model", model_file, *pair, "--weights", "1,1,0,2", "--json", file, "--png", picture
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(file.read_text())
    assert found["level"] == "exact"
    assert [part["weight"] for part in found["parts"]] == pytest.approx([0.25, 0.25, 0, 0.5])
    for part in found["parts"]:
        assert part["weighted_cosine"] == pytest.approx(part["weight"] * part["cosine"], abs=1e-7)
        for side in (part, part["match"]):
            assert np.shape(side["cells"]) == (4, 4)
            assert np.sum(side["cells"]) + side["constant"] == pytest.approx(part["cosine"], abs=1e-5)
    assert sum(part["weighted_cosine"] for part in found["parts"]) == pytest.approx(found["score"], abs=1e-6)
    assert found["distance2"] == pytest.approx(2 - 2 * found["score"])
    assert "adds most to the score" in run.stdout
    drawn = cv2.imread(str(picture))
    assert drawn is not None
    assert drawn.shape[1] == 1200
    # Both colours are there, and the pictures beneath them.
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 1000


def test_a_light_figure_is_dark_on_white_and_has_the_same_pictures(
    model_file: Path, pair: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("dark.png", "light.png")]
    given = ["explain", "--model", str(model_file), *pair]
    assert main.main([*given, "--png", str(files[0])]) == 0
    assert main.main([*given, "--png", str(files[1]), "--light"]) == 0
    dark, light = (cv2.imread(str(file)) for file in files)
    assert dark is not None
    assert light is not None
    assert dark.shape == light.shape
    assert (dark[0, 0].tolist(), light[0, 0].tolist()) == ([20, 20, 20], [255, 255, 255])
    row = light.shape[0] - 18  # the note's, which is text alone
    assert light[row - 8 : row + 8].min() < 128
    middle = 96 + 200
    assert np.array_equal(dark[middle, 30:500], light[middle, 30:500])
    capsys.readouterr()
    assert main.main([*given, "--light"]) == 2
    assert "give its file with --png" in capsys.readouterr().err


def test_a_figure_of_a_ranking_has_the_nearest_tiles_and_marks_the_true_one(
    data: Path, model_file: Path, pair: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[str, int, float, bool]] = []
    draw = ranking_figure.draw

    def keep(*arguments: Any) -> Any:
        shown[:] = [(tile.name, tile.rank, tile.distance2, tile.true) for tile in arguments[3]]
        return draw(*arguments)

    monkeypatch.setattr(ranking_figure, "draw", keep)
    folder, file = data / "test" / "gallery_satellite", tmp_path / "ranked.png"
    answer = lpn.Gallery.of_folder(folder, model_file).search(lpn.load_picture(pair[1]))
    true = Path(pair[3]).relative_to(folder).as_posix()
    ranks = {match.name: match.rank for match in answer.top(100)}
    given = ["explain", "--model", str(model_file), *pair, "--among", str(folder), "--png", str(file), "--light"]
    for top in (1, ranks[true]):
        assert main.main([*given, "--top", str(top)]) == 0
        expected = [one for one in answer.top(100) if one.rank <= top or one.name == true]
        assert [one[:2] for one in shown] == [(one.name, one.rank) for one in expected]
        assert [one[2] for one in shown] == pytest.approx([one.distance2 for one in expected], abs=1e-5)
        assert [one[0] for one in shown if one[3]] == [true]
        drawn = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        assert drawn.shape[1] == 1200
        columns = min(len(shown), 5)
        width = (1200 - 48 - 12 * columns) // (columns + 1)
        rows = (drawn.shape[0] - 48) // -(-len(shown) // columns)
        lefts = [24 + (place % columns + 1) * (width + 12) + 2 for place in range(len(shown))]
        frames = [drawn[74 + place // columns * rows, left].tolist() for place, left in enumerate(lefts)]
        assert frames == [list(verdict_colour(one[3])) for one in shown]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--among", "FOLDER"], "give its file with --png"),
        (["--top", "3", "--png", "f.png"], "give the folder of its tiles with --among"),
        (["--among", "FOLDER", "--top", "0", "--png", "f.png"], "expected 1 to 10"),
        (["--among", "FOLDER", "--covering", "--png", "f.png"], "leave one of them out"),
        (["--among", "elsewhere", "--png", "f.png"], "does not lie in elsewhere"),
    ],
)
def test_options_of_a_figure_that_do_not_fit_are_refused(
    options: list[str],
    said: str,
    data: Path,
    model_file: Path,
    pair: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    filled = [option.replace("FOLDER", str(data / "test" / "gallery_satellite")) for option in options]
    assert main.main(["explain", "--model", str(model_file), *pair, *filled]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.glob("*.png"))


def test_covering_is_said_to_be_approximate(model_file: Path, pair: list[str], tmp_path: Path) -> None:
    file, picture = tmp_path / "why.json", tmp_path / "why.png"
    given = ["explain", "--model", str(model_file), *pair, "--covering", "--json", str(file), "--png", str(picture)]
    assert main.main(given) == 0
    found = json.loads(file.read_text())
    assert found["level"] == "measured by occlusion"
    assert np.shape(found["parts"][0]["losses"]) == (8, 8)
    assert "cells" not in found["parts"][0]
    assert cv2.imread(str(picture)) is not None


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["--query", "nowhere.jpg"], "nowhere.jpg"),
        (["--view-query", "street"], "no 'street' view"),
        (["--weights", "1,2"], "expected 4 numbers"),
        (["--weights", "a,b"], "expected a number for each part"),
        (["--model", "nowhere.onnx"], "no model file"),
    ],
)
def test_mistakes_get_one_sentence(
    changed: list[str], expected: str, model_file: Path, pair: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main.main(["explain", "--model", str(model_file), *pair, *changed]) == 2
    said = capsys.readouterr().err
    assert expected in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("row", "column", "picture", "tile"),
    [(0, 3, "upper right", "north-east"), (3, 0, "lower left", "south-west"), (1, 3, "right", "east")],
)
def test_sides_of_a_tile_are_told_by_the_compass(row: int, column: int, picture: str, tile: str) -> None:
    cells = np.zeros((4, 4))
    cells[row, column] = 1
    if picture == "right":
        cells[2, column] = 1
    assert (verdicts.describe_position(cells, "drone"), verdicts.describe_position(cells, "satellite")) == (
        picture,
        tile,
    )
    assert verdicts.describe_position(np.ones((4, 4)), "drone") == "all around"
    unrolled = np.zeros((4, 16))
    unrolled[:, 14] = 1
    assert verdicts.describe_position(unrolled, "satellite") == "right"
    assert verdicts.describe_position(-np.ones((4, 4)), "drone") == "all around"


def test_a_score_of_constants_is_not_said_to_be_of_places() -> None:
    cells = np.zeros((2, 4, 4))
    cells[:, 0, 3] = -0.1
    found = Evidence(np.array([0.5, 0.6]), part_weights(2), *(SideEvidence(cells, np.array([0.6, 0.7])),) * 2)
    said = verdicts.describe_evidence(found, ["1 centre", "2 outer"], "drone", "satellite")
    assert "most of it by a constant that comes from no cell" in said
    assert "Of the whole score, +0.650 is constants" in said
    assert "north-east" not in said


def test_the_sentence_names_the_part_that_adds_most_and_one_that_speaks_against() -> None:
    cells = np.zeros((2, 4, 4))
    cells[1, 0, 3] = 0.8
    side = SideEvidence(cells, np.zeros(2))
    found = Evidence(np.array([-0.2, 0.8]), part_weights(2), side, side)
    said = verdicts.describe_evidence(found, ["1 centre", "2 outer"], "drone", "satellite")
    assert said == (
        "Part 2 outer adds most to the score (+0.400 of +0.300), where the query's upper right agrees with the tile's "
        "north-east. Part 1 centre speaks against the pair (−0.100)."
    )


def test_cells_on_no_side_are_told_as_places_all_over_the_pictures() -> None:
    east = np.zeros((1, 4, 4))
    east[0, 1:3, 3] = 1.0
    sides = [SideEvidence(cells, np.zeros(1)) for cells in (np.full((1, 4, 4), 1.0), east)]
    said = [
        verdicts.describe_evidence(
            Evidence(np.array([0.8]), part_weights(1), sides[query], sides[tile]), ["whole"], "drone", "satellite"
        )
        for query, tile in ((0, 0), (0, 1), (1, 0))
    ]
    assert said == [
        "The score is +0.800, mainly from places all over both pictures.",
        "The score is +0.800, mainly from where places all over the query agree with the tile's east.",
        "The score is +0.800, mainly from where the query's right agrees with places all over the tile.",
    ]
