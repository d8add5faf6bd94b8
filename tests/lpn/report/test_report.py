"""Tests of reports: content, numbers, escaping, and the command."""

from __future__ import annotations

import base64
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from jinja2 import DictLoader, Environment
from markupsafe import Markup

import lpn
from lpn import report, retrieval
from lpn.cli import main
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.numbers import rounded_to_sum, shown_difference, signed
from lpn.core.texts import ordinal
from lpn.datasets import Picture, open_dataset
from lpn.descriptors.transforms import Change
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from lpn.report import Options, OwnPicture, _rendering
from lpn.retrieval import Ranking
from lpn.tasks.notes import NAME as NOTES
from lpn.tasks.notes import read_notes
from lpn.tasks.opening import describe_task
from lpn.tasks.task import Task
from lpn.tasks.verdict import judge
from tests.conftest import Refused
from tools.fixtures import small_worlds
from tools.fixtures.html_page import Page


def page_of(*arguments: Any, **options: Any) -> Page:
    return Page(report.build(*arguments, **options).decode())


def rank(task: Task, descriptor: Float32Array, query: int) -> Ranking:
    return task.ranks_under(query)(descriptor)


def worst(task: Task) -> int:
    """Return the query with the lowest margin."""
    return int(np.argmin(task.outcomes.margin))


def test_a_report_is_one_file_that_loads_nothing_else(task: Task) -> None:
    page = page_of(task, [worst(task), 3], made=datetime(2031, 5, 6, tzinfo=UTC))
    assert not page.tags & {"script", "link", "iframe", "object", "base", "form"}
    assert not page.handlers
    for _, attributes in page.elements:
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/jpeg;base64,", "data:image/png;base64,"))
    assert "url(" not in page.text
    assert "@import" not in page.text
    # Of two queries: photo and two tiles once each, their heat, and the evidence of each pair; thumbnails beside them.
    assert len(page.all("image")) == 2 * (3 + 3 + 4)
    assert len(page.all("img")) >= 2 * (5 + 2 + 2)
    for source in [*(one["src"] for one in page.all("img")), *(one["href"] for one in page.all("image"))]:
        data = base64.b64decode((source or "").partition(",")[2])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    # Four rings of the three pictures are cropped from them.
    assert len(page.all("clippath")) == 2 * 3 * 4
    named = {attributes["id"] for _, attributes in page.elements if attributes.get("id")}
    assert {(use["href"] or "")[1:] for use in page.all("use")} <= named
    clips = [attributes["clip-path"] or "" for _, attributes in page.elements if "clip-path" in attributes]
    assert len(clips) == 2 * 3 * 4
    assert {clip.removeprefix("url(#").removesuffix(")") for clip in clips} <= named
    assert [section["id"] for section in page.all("section")] == ["q1", "q2"]
    links = {link["href"] for link in page.all("a")}
    assert {"#q1", "#q2", "#top"} == links
    for text in ("2031-05-06", task.model.fingerprint, "drone-to-satellite", "14 queries", "R@1", "Protocol"):
        assert text in page.text


def test_it_begins_with_what_was_found_and_figures_of_the_field_follow(task: Task) -> None:
    queries = range(len(task.queries))
    several, _, measured = page_of(task, queries).text.partition("How it was measured")
    right = round(task.metrics["recall@1"] / 100 * len(queries))
    assert "Report on 14 photos" in several
    assert f"{len(task.gallery)} satellite pictures, ring by ring. The nearest is the answer." in several
    assert f"That is right for {right} of the 14 photos whose place is known." in several
    for term in ("R@1", "d²", "squared"):
        assert term not in several
        assert term in measured
    few, _, _ = page_of(task, [1, 2], Options(selection="the worst of 3")).text.partition("measured")
    assert "That is right for" not in few, "the share of chosen pictures is no accuracy"
    assert "The photos of this report are chosen: the worst of 3." in few


def test_each_picture_is_described_and_each_tile_is_read_once(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    described, read, run, load = [], [], type(task.model).run, Picture.load
    monkeypatch.setattr(
        type(task.model), "run", lambda model, images, view: described.append(len(images)) or run(model, images, view)
    )
    monkeypatch.setattr(Picture, "load", lambda picture: read.append(picture.path) or load(picture))
    queries = range(4)
    report.build(task, queries)
    found = [rank(task, task.query_descriptors[query], query) for query in queries]
    tiles = {
        match.index for one in found for match in (one.match(0), one.match(0).true and one.hardest_negative()) if match
    }
    tiles |= {one.positive().index for one in found if not one.match(0).true}
    assert sum(described) == 2 * (len(queries) + len(tiles)), "picture and mirror"
    assert len(described) == 2, "all queries together, and all tiles"
    assert len(read) == len(set(read))


def test_pictures_that_are_described_together_are_described_as_alone(task: Task) -> None:
    pictures, changes = [picture.load() for picture in task.queries[:3]], [Change(rotate=turn) for turn in (0, 30, 90)]
    together = retrieval.describe_pictures(task.model, pictures, "drone", changes)
    for picture, change, one in zip(pictures, changes, together, strict=True):
        alone = retrieval.describe_picture(task.model, picture, "drone", change)
        np.testing.assert_array_equal(one.picture, alone.picture)
        np.testing.assert_allclose(one.descriptor, alone.descriptor, atol=1e-6)
        np.testing.assert_allclose(one.trace.features, alone.trace.features, atol=1e-4)


def test_shares_and_margins_equal_the_outcomes_and_add_up(task: Task) -> None:
    query = worst(task)
    outcomes = task.outcomes
    text = page_of(task, [query]).text
    assert outcomes.rank[query] > 0
    shares = [float(value) for value in re.findall(r"part [^:\n]*: ([\d.]{6})", text)]
    listed = min(5, len(task.gallery)) + (outcomes.rank[query] >= 5)
    sums = np.array(shares).reshape(listed, 4).sum(axis=1)
    ranking = rank(task, task.query_descriptors[query], query)
    expected = [match.distance2 for match in ranking.top(5)]
    np.testing.assert_allclose(sums[:5], expected, atol=5e-4)
    positive = next(match for match in ranking.top(len(task.gallery)) if match.true)
    total = shown_difference(ranking.top(1)[0].distance2, positive.distance2)
    # The row of a ring has by how much the answer is nearer.
    for gain in (*rounded_to_sum((-outcomes.parts[query]).tolist(), total=-total), -total):
        assert signed(gain) in text
    assert f"The nearest true tile is {ordinal(positive.rank)}, {-total:.3f} behind the answer" in text
    assert f"{task.metrics['recall@1']:.1f} %" in text
    assert judge(ranking, task.part_names, "ring").headline in text


def test_evidence_bars_add_up_to_the_score(task: Task) -> None:
    text = page_of(task, [worst(task)]).text
    cells = [[float(v) for v in re.findall(rf"{name}: ([+-][\d.]+)", text)] for name in ("cells for", "cells against")]
    constants = [float(value) for value in re.findall(r"constant: ([+-][\d.]+)", text)]
    scores = [float(value) for value in re.findall(r": score (-?[\d.]+)", text)]
    sums = (np.array(cells).sum(axis=0) + constants).reshape(2, 4)
    np.testing.assert_allclose(sums.sum(axis=1), scores, atol=2e-3)


def test_markup_in_names_notes_and_metadata_is_escaped(data: Path, model_file: Path, tmp_path: Path) -> None:
    evil = "<script>alert('x')</script>"
    root = shutil.copytree(data, tmp_path / "a<img src=x onerror=alert(1)>")
    path = next((root / "test" / "query_drone").rglob("*.png")).relative_to(root).as_posix()
    (root / "metadata.csv").write_text(f'path,<b>mood</b>\n{path},"{evil}"\n'.replace("<b>mood</b>", "mood & tone"))
    (root / NOTES).write_text(f'path,tags,note\n{path},odd,"{evil} & more"\n')
    plain = describe_task(lpn.load(model_file), "<i>m</i>.onnx", open_dataset(root))
    made = replace(plain, notes=read_notes(root / NOTES))
    found = report.build(made, [made.table.paths.index(path)], Options(selection="<u>mine</u>"))
    page = Page(found.decode())
    assert b"<script" not in found
    assert not any(attributes.get("src") == "x" for attributes in page.all("img"))
    assert not page.all("i") or "<i>m</i>.onnx" in page.text
    for text in (evil, f"{evil} & more", "mood & tone", "odd", "<u>mine</u>", root.name):
        assert text in page.text


def test_a_page_is_utf_8_whatever_its_markup_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    templates = Environment(loader=DictLoader({"page": "{{ name }}\n,"}))
    monkeypatch.setattr(_rendering, "_environment", lambda: templates)
    assert _rendering.render("page", name=Markup("caf\udce9\x1b\u202e")).encode() == b"caf???\n,"


def test_errors_in_metres_are_shown_where_positions_are_known(data: Path, model_file: Path, tmp_path: Path) -> None:
    root = small_worlds.map_dataset(shutil.copytree(data, tmp_path / "places"))
    made = describe_task(lpn.load(model_file), "model.onnx", open_dataset(root))
    text = page_of(made, [worst(made)]).text
    metres = made.table.column("distance").values[worst(made)]
    assert f"The answer lies {metres:,.0f} m from the place photographed." in text
    assert "off by" in text


def test_an_own_picture_has_no_verdict_and_a_chosen_tile_is_compared(task: Task) -> None:
    picture = images.load_picture(task.queries[2].path)
    text = page_of(task, [OwnPicture("mine.jpg", picture)]).text
    assert "Its true place is not known here" in text
    assert "Truth" not in text
    assert "Next tile" in text
    analyser = QueryAnalyser(task.model, lambda of, index: describe_tile(of, index, of.model))
    own = analyser.analyse(task, QueryRequest(OwnPicture("mine.jpg", picture), compare=5), 5)
    text = page_of(task, [own]).text
    assert "Chosen tile" in text or own.chosen.rank <= 2
    assert task.gallery[5].name in text
    answer = analyser.analyse(task, QueryRequest(2, compare=5), 5)
    again = page_of(task, [answer], Options(title="A story", captions=[["What it <shows>", "Turned"]])).text
    assert f"{task.gallery[5].name}, rank {answer.chosen.rank}" in again
    assert "A story" in again
    assert "What it <shows>" in again
    assert "R@1" not in again, "a story has no figures of all queries"


def test_saved_descriptors_are_reported_without_evidence(task: Task) -> None:
    saved = replace(task, model=None, model_name="result.mat")
    page = page_of(saved, [worst(task)])
    assert "Evidence for and against" not in page.text
    assert "Truth" in page.text
    with pytest.raises(InputError, match="no network"):
        report.build(saved, [0], Options(change=Change(rotate=30)))
    with pytest.raises(InputError, match="choose a query of the data set"):
        report.build(saved, [OwnPicture("mine.jpg", images.load_picture(task.queries[2].path))])


def test_progress_counts_the_queries(task: Task) -> None:
    seen: list[tuple[int, int]] = []
    report.build(task, [4, 1], progress=lambda *done: seen.append(done))
    assert seen == [(1, 2), (2, 2)]
    with pytest.raises(KeyboardInterrupt):
        report.build(task, [4, 1], progress=Mock(side_effect=KeyboardInterrupt))


def test_changes_of_queries_and_part_weights_are_stated(task: Task) -> None:
    weighted = replace(task, weights=[0, 1, 1, 2])
    text = page_of(weighted, [1], Options(change=Change(rotate=30))).text
    assert "queries turned 30° first" in text
    assert "part weights 0 : 25 : 25 : 50 %" in text
    picture = images.load_picture(task.queries[1].path)
    seen = retrieval.describe_picture(task.model, picture, "drone", Change(rotate=30))
    assert f"distance {rank(weighted, seen.descriptor, 1).match(0).distance2:.3f}" in text


@pytest.mark.parametrize("queries", [[], [99], [-1], [0] * 201])
def test_an_invalid_selection_of_queries_is_an_error(task: Task, queries: list[int]) -> None:
    with pytest.raises(InputError):
        report.build(task, queries)


def run(data: Path, model_file: Path, *more: object) -> int:
    return main.main(["report", str(data), "--model", str(model_file), *map(str, more)])


def test_the_worst_failures_come_first(
    data: Path, model_file: Path, tmp_path: Path, task: Task, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "report.html"
    assert run(data, model_file, "--failures", 2, "--out", out) == 0
    page = Page(out.read_text("utf-8"))
    order = [task.queries[i].name for i in np.argsort(task.outcomes.margin, kind="stable")[:2]]
    assert re.findall(r" (?:Found|Missed): (\S+)", page.text) == order
    assert f"the worst of {int(task.outcomes.failed.sum())} failures" in page.text
    assert "2 queries" in capsys.readouterr().out
    assert list(out.parent.iterdir()) == [out]
    assert run(data, model_file, "--where", f"name = {order[1]}", "--out", out) == 0
    assert re.findall(r" (?:Found|Missed): (\S+)", Page(out.read_text("utf-8")).text) == [order[1]]
    assert run(data, model_file, "--query", order[1], order[0], order[1], "--matches", 2, "--out", out) == 0
    assert re.findall(r" (?:Found|Missed): (\S+)", Page(out.read_text("utf-8")).text) == [order[1], order[0]]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["--query", "0008", "--failures", "3"], "leave one of them out"),
        (["--failures", "0"], "expected 1 or more"),
        (["--matches", "0"], "expected 1 or more"),
        (["--weights", "1,2"], "expected 4 numbers"),
        (["--where", "rank < 1"], "No query fits rank < 1"),
        (["--where", "rank = 1", "--failures", "3"], "No query failed of those with rank = 1"),
    ],
)
def test_invalid_arguments_give_one_sentence_and_no_file(
    given: list[str], expected: str, data: Path, model_file: Path, tmp_path: Path, refused: Refused
) -> None:
    out = tmp_path / "report.html"
    assert expected in refused("report", data, "--model", model_file, *given, "--out", out)
    assert not out.exists()
    if "--where" not in given:
        assert not (tmp_path / "cache").exists()
