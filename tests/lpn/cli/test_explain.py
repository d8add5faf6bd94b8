"""`lpn explain` as a person runs it."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import lpn
from lpn.cli import main
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from tests.conftest import Refused
from tests.lpn.cli.test_main import without_torch


def _rounded(value: Any) -> Any:
    """Return JSON values with numbers to four places."""
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return pytest.approx(value, abs=1e-4) if isinstance(value, float) else value


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
    (nearest,) = found["nearest"]
    assert nearest == found["compared"]
    assert sum(nearest["shares"]) == pytest.approx(found["distance2"], abs=1e-6)
    assert found["weights"] == [part["weight"] for part in found["parts"]]
    assert (found["verdict"]["sign"], found["verdict"]["sentence"]) == (None, "There is no other tile.")
    assert "adds most to the score" in run.stdout
    drawn = cv2.imread(str(picture))
    assert drawn.shape[1] == 1200
    # Both colours are there, and the pictures beneath them.
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 1000


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
        (["--weights", "a,b"], "expected a number for each part"),
    ],
)
def test_mistakes_get_one_sentence(
    changed: list[str], expected: str, model_file: Path, pair: list[str], refused: Refused
) -> None:
    assert expected in refused("explain", "--model", model_file, *pair, *changed)


def test_a_query_of_a_source_is_explained_by_its_name_beside_its_top_match(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    file = tmp_path / "why.json"
    given = ["explain", str(data), "--model", str(model_file), "--json", str(file)]
    task = lpn.open_task(data, model=model_file)
    (query,) = (one for one in task.queries if one.name == "0009")
    top = task.search(task.queries.index(query)).order
    assert main.main([*given, "--query", "0009"]) == 0
    first = json.loads(file.read_text())
    assert first["match"] == str(task.gallery[int(top[0])].path)
    assert "the top match." in capsys.readouterr().out
    assert main.main([*given, "--query", str(query.path), "--match", task.gallery[int(top[1])].name]) == 0
    second = json.loads(file.read_text())
    assert second["match"] == str(task.gallery[int(top[1])].path)
    place = task.queries.index(query)
    scores = task.search(place).scores
    assert [first["score"], second["score"]] == pytest.approx(scores[top[:2]].tolist(), abs=1e-4)
    # The answer is the library's: the source knows the ranks and the truth.
    answer = QueryAnalyser(task.model, partial(describe_tile, model=task.model)).analyse(task, QueryRequest(place), 5)
    named, expected = first | {"query": "0009"}, answer.to_dict()
    for key in ("query", "task", "verdict", "compared", "nearest"):
        assert _rounded(named[key]) == _rounded(expected[key]), key
    assert named["verdict"]["sign"] is not None
    assert main.main([*given, "--query", "0009", "--match", task.gallery[int(top[1])].name]) == 0
    compared = json.loads(file.read_text())["compared"]
    assert (compared["rank"], compared["true"]) == (2, bool(task.search(place).match(1).true))
    # The tile that nobody names is the first under the same weights and turn.
    for options, ranking in (
        (["--weights", "0,0,0,1"], task.search(place, weights=[0, 0, 0, 1])),
        (["--rotate", "90"], task.search(place, change=lpn.Change(rotate=90))),
    ):
        assert main.main([*given, "--query", "0009", *options]) == 0
        assert json.loads(file.read_text())["match"] == str(task.gallery[int(ranking.order[0])].path)
    # A picture that is no query of the source is searched for as the user's own.
    own = shutil.copy(query.path, tmp_path / "own.png")
    assert main.main([*given, "--query", str(own)]) == 0
    found = json.loads(file.read_text())
    assert (found["match"], found["score"]) == (first["match"], pytest.approx(first["score"], abs=1e-4))
    for wrong, said in (
        (["--query", "nowhere"], "has no query nowhere; did you mean 0007?"),
        (["--query", "0009", "--match", str(own)], "own.png is no tile of places; give the name of one"),
    ):
        assert said in refused(*given, *wrong)
    assert "Nothing says which tile to compare with; give it as --match." in refused("explain", "--query", own)
    unnamed = refused("explain", "--query", query.path, "--match", query.path, "--csls", "3")
    assert "--csls needs a source; name it: lpn explain SOURCE." in unnamed
