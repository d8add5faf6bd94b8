"""A folder as a gallery: matches, figures, and tables of its answers, and refusals."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import lpn
from lpn import report
from lpn.core.errors import LPNError
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile, start_search
from lpn.library.answer import Answer
from lpn.retrieval import scoring
from lpn.tasks.task import Task
from lpn.tasks.verdict import judge
from tools.fixtures import small_worlds


@pytest.fixture
def gallery(data: Path, model_file: Path) -> lpn.Gallery:
    """The 14 satellite tiles of the small data set."""
    return lpn.Gallery.of_folder(data / "test" / "gallery_satellite", model_file)


def test_matches_are_ranked_named_and_split_exactly(gallery: lpn.Gallery) -> None:
    answer = gallery.search(small_worlds.place(9), view="satellite")
    matches = answer.top(100)
    assert [match.rank for match in matches] == list(range(1, len(gallery) + 1))
    assert (matches[0].name, matches[0].index) == ("0009/0009.png", 2)
    assert matches[0].distance2 == pytest.approx(0, abs=1e-5)
    assert all(one.distance2 <= other.distance2 for one, other in itertools.pairwise(matches))
    for match in matches:
        assert match.contributions.shape == (4,)
        assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-5)


def test_shares_and_heat_are_arrays_that_add_up(gallery: lpn.Gallery) -> None:
    answer = gallery.search(small_worlds.place(9), weights=[1, 1, 0, 2])
    assert (answer.shares.shape, answer.shares.dtype) == ((14, 4), np.float32)
    np.testing.assert_allclose(answer.shares.sum(axis=1), [match.distance2 for match in answer.top(14)], atol=1e-5)
    evidence = answer.evidence(rank=2)
    for name, side in (("query", evidence.query), ("tile", evidence.tile)):
        heat = answer.heat(2, name)
        assert (heat.shape, heat.dtype) == (side.cells.shape, np.float32)
        parts = heat.sum(axis=(1, 2)) + side.constants * evidence.weights
        np.testing.assert_allclose(parts, evidence.weighted_cosines, atol=1e-5)
        assert parts.sum() == pytest.approx(answer.top(2)[1].score, abs=1e-5)


def test_a_second_gallery_of_the_folder_describes_nothing(
    gallery: lpn.Gallery, data: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = lpn.load(model_file)
    monkeypatch.setattr(model, "run", None)
    again = lpn.Gallery.of_folder(data / "test" / "gallery_satellite", model)
    np.testing.assert_array_equal(again.descriptors, gallery.descriptors)


def test_a_figure_is_saved_as_it_is_shown(gallery: lpn.Gallery, tmp_path: Path) -> None:
    figure = gallery.search(small_worlds.place(9)).figure(rank=2)
    figure.save(tmp_path / "deep" / "why.png")
    saved = cv2.imread(str(tmp_path / "deep" / "why.png"))
    np.testing.assert_array_equal(saved[..., ::-1], figure.pixels)
    assert figure._repr_png_() == (tmp_path / "deep" / "why.png").read_bytes()
    other = gallery.search(small_worlds.place(9)).figure(rank=3)
    assert (other.pixels != figure.pixels).any()


def test_tables_of_a_notebook_hold_everything_and_escape_names(data: Path, model_file: Path, tmp_path: Path) -> None:
    small_worlds.write(tmp_path / "tiles" / "<b>&.png", small_worlds.place(1))
    small_worlds.write(tmp_path / "tiles" / "plain.png", small_worlds.place(2))
    answer = lpn.Gallery.of_folder(tmp_path / "tiles", model_file).search(small_worlds.place(1), view="satellite")
    html = answer._repr_html_()
    assert "&lt;b&gt;&amp;.png" in html
    assert "<b>&" not in html
    assert html.count('src="data:image/jpeg;base64,') == 3  # the query, and two tiles
    assert not re.search(r"https?:|<script|<link|url\(", html)
    result = lpn.evaluate(lpn.load(model_file), lpn.open_dataset(data), "drone-to-satellite")
    assert f"{result.ap:.2f} %" in result._repr_html_()
    assert "full gallery, 14" in result._repr_html_()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"picture": "query.jpg"}, "lpn.load_picture"),
        ({"picture": np.zeros((8, 8), np.uint8)}, "expected uint8"),
        ({"picture": np.zeros((8, 8, 3), np.float32)}, "expected uint8"),
    ],
)
def test_a_search_refuses_in_one_sentence(gallery: lpn.Gallery, given: dict[str, object], expected: str) -> None:
    with pytest.raises(LPNError, match=re.escape(expected)):
        gallery.search(**({"picture": small_worlds.place(1)} | given))


def test_ranks_names_and_models_without_cells_are_refused(gallery: lpn.Gallery, tmp_path: Path) -> None:
    answer = gallery.search(small_worlds.place(1))
    for rank in (0, 15):
        with pytest.raises(LPNError, match="ranks 1 to 14"):
            answer.figure(rank)
    with pytest.raises(LPNError, match=r"ends in \.png"):
        answer.figure().save(tmp_path / "why.jpg")
    object.__setattr__(answer.query, "trace", None)
    with pytest.raises(LPNError, match="no figure"):
        answer.figure()


def answer(task: Task, query: int | OwnPicture, **changes: object) -> Answer:
    analyser = QueryAnalyser(task.model, lambda of, index: describe_tile(of, index, of.model))
    return analyser.analyse(task, QueryRequest(query, **changes), 5)


def test_the_json_is_what_the_report_and_the_notebook_say(task: Task) -> None:
    signs = set()
    for query in range(len(task.queries)):
        shown = answer(task, query, evidence=True)
        said = json.loads(json.dumps(shown.to_dict(5), allow_nan=False))
        verdict = said["verdict"]
        assert (verdict["sign"], verdict["headline"]) == (shown.matches[0].true, shown.verdict.headline)
        assert verdict["headline"] == judge(shown.ranking, task.part_names, "ring").headline
        assert verdict["rival"]["distance2"] - said["nearest"][0]["distance2"] == pytest.approx(
            sum(verdict["gains"]), abs=1e-5
        )
        for match, listed in zip(shown.matches, said["nearest"], strict=True):
            assert listed["name"] == task.gallery[match.index].name
            assert (listed["rank"], listed["true"], listed["metres"]) == (match.rank, match.true, None)
            assert sum(listed["shares"]) == pytest.approx(listed["distance2"], abs=1e-5)
        assert said["compared"] == said["nearest"][0]
        assert said["score"] == pytest.approx(said["compared"]["score"], abs=1e-5)
        assert [part["name"] for part in said["parts"]] == task.part_names
        assert f"{verdict['headline']}. {verdict['sentence']}" in shown._repr_html_()
        assert f"<b>{verdict['headline']}</b><p>{verdict['sentence']}</p>" in report.build(task, [shown]).decode()
        signs.add(verdict["sign"])
    assert signs == {True, False}


def test_an_answer_explains_any_rank_and_describes_the_compared_tile_once(task: Task) -> None:
    described: list[int] = []

    def describe(of: Task, index: int) -> object:
        described.append(index)
        return describe_tile(of, index, of.model)

    shown = QueryAnalyser(task.model, describe).analyse(task, QueryRequest(3, compare=5), 5)
    rank = shown.chosen.rank
    assert shown.evidence(rank).score == pytest.approx(shown.chosen.score, abs=1e-5)
    assert described == [5]
    other = 1 if rank > 1 else 2
    assert shown.evidence(other).score == pytest.approx(shown.ranking.match(other - 1).score, abs=1e-5)
    assert described == [5, shown.ranking.match(other - 1).index]


def test_a_region_is_described_under_the_part_weights_of_the_request(task: Task) -> None:
    analyser = QueryAnalyser(task.model, lambda of, index: describe_tile(of, index, of.model))
    height, width = task.map_sizes["drone"]
    region = tuple(range(height * width // 2 + width))
    for part in (0, -1, 0):
        given = np.zeros(task.contract.n_parts)
        given[part] = 1
        found = analyser.analyse(task, QueryRequest(3, region=region, weights=tuple(given.tolist())), 5)
        weights = scoring.part_weights(task.contract.n_parts, given)
        expected = start_search(task, 3, found.query, region, weights)(weights)
        np.testing.assert_array_equal(found.ranking.scores, expected.scores)


def test_an_own_picture_and_an_ungraded_query_have_no_sign(task: Task) -> None:
    own = answer(task, OwnPicture("mine", small_worlds.place(50)))
    assert (own.index, own.verdict.sign, own.verdict.headline) == (None, None, "No truth is known")
    assert own.verdict.lead == own.matches[0].shown_gap
    graded = answer(task, 2)
    assert (graded.index, graded.ungraded().verdict.sign) == (2, None)
    assert graded.verdict.sign is not None
