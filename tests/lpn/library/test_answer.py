"""The one answer that app, report, notebook, and JSON render."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lpn import load, open_dataset, report
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile
from lpn.library.answer import Answer
from lpn.tasks.opening import describe_task
from lpn.tasks.task import Task
from lpn.tasks.verdict import judge
from tools.fixtures import small_worlds


@pytest.fixture(scope="module")
def task(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Task:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("cache")))
        return describe_task(load(model_file), "model.onnx", open_dataset(data))


def answer(task: Task, query: int | OwnPicture, **changes: object) -> Answer:
    analyser = QueryAnalyser(task.model, lambda of, index: describe_tile(of, index, of.model))
    return analyser.analyse(task, QueryRequest(query, **changes), 5)  # type: ignore[arg-type]


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

    shown = QueryAnalyser(task.model, describe).analyse(task, QueryRequest(3, compare=5), 5)  # type: ignore[arg-type]
    rank = shown.chosen.rank
    assert shown.evidence(rank).score == pytest.approx(shown.chosen.score, abs=1e-5)
    assert described == [5]
    other = 1 if rank > 1 else 2
    assert shown.evidence(other).score == pytest.approx(shown.ranking.match(other - 1).score, abs=1e-5)
    assert described == [5, shown.ranking.match(other - 1).index]


def test_an_own_picture_and_an_ungraded_query_have_no_sign(task: Task) -> None:
    own = answer(task, OwnPicture("mine", small_worlds.place(50)))
    assert (own.index, own.verdict.sign, own.verdict.headline) == (None, None, "No truth is known")
    assert own.verdict.lead == own.matches[0].shown_gap
    graded = answer(task, 2)
    assert (graded.index, graded.ungraded().verdict.sign) == (2, None)
    assert graded.verdict.sign is not None
