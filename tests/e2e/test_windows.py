"""Each window of the page, by what it hands over and not by its look: its answers, its JSON, its address, and its files.

Each wait is for an answer of a number beyond that of the last one, or for a value in the page; none is for a time.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import lpn
from explorer.app import App
from explorer.opening import open_model, open_source
from explorer.workspace import LazyWorkspace
from lpn import datasets, explain, retrieval
from lpn.cli.main import main
from lpn.core import images
from lpn.descriptors import cached_descriptors
from lpn.descriptors.transforms import Change
from lpn.retrieval import scoring
from lpn.sources import SourceOptions
from lpn.tasks.opening import new_calibration, scored_tasks
from lpn.tasks.task import SCORINGS
from tests.conftest import MakeOnce
from tests.e2e.conftest import PATIENCE, ExplorerPage, classic, served_folder
from tests.e2e.test_flight import PLACES, REFUSED, RunningFlight
from tests.e2e.test_flight import flight_app as flight_app
from tests.explorer.test_scorings import write_places
from tools.fixtures.processes import free_port
from tools.fixtures.published_results import save_result

TASK = "drone-to-satellite"
# Queries that the tests open, besides the first one.
ONE, OTHER = "0003", "0011"
# The answer that the page shows, if its number is beyond `after` and its values are the `expected` ones.
ANSWER = """([after, expected]) => {
  const shown = document.getElementById("lpn-status")?.dataset;
  return Number(shown?.seq) > after && Object.entries(expected).every(([name, value]) => shown[name] === value) && { ...shown };
}"""
# Note the newest data of each list that the server hands over.
NOTE_LISTS = """() => {
  const { list } = lpn;
  window.lists = {};
  lpn.list = (id, data, ...rest) => ((lists[id] = data), list(id, data, ...rest));
}"""


@dataclass(frozen=True)
class Answer:
    """An answer that a page shows: its number, the names of what it is of, and the ranked tiles with their scores."""

    number: int
    query: int
    name: str
    chosen: int
    tiles: list[int]
    scores: list[float]


def answer(page: Page, after: int = 0, **expected: object) -> Answer:
    """Wait for an answer whose number is beyond `after`, with expected values of the status line."""
    values = {name: str(value) for name, value in expected.items()}
    shown = page.wait_for_function(ANSWER, arg=[after, values], timeout=1000 * PATIENCE, polling=50).json_value()
    tiles, scores = zip(*json.loads(shown["ranked"]), strict=True)
    return Answer(
        int(shown["seq"]), int(shown["query"]), shown["name"], int(shown["chosen"]), list(tiles), list(scores)
    )


def wait(page: Page, holds: str, given: object = None) -> Any:
    """Wait until an expression of the page is true; return it."""
    return page.wait_for_function(holds, arg=given, timeout=1000 * PATIENCE, polling=50).json_value()


def send(page: Page, kind: str, value: object = None) -> None:
    """Send a message as the page's scripts do."""
    page.evaluate("([kind, value]) => lpn.send(kind, value)", [kind, value])


@dataclass(frozen=True)
class Windows:
    """A running app on 22 places, which offers an index and a published result of them, too."""

    url: str
    data: Path
    model: Path

    def address(self, **values: object) -> str:
        """The address of a state."""
        return f"{self.url}/?" + "&".join(f"{name}={value}" for name, value in values.items())

    @cached_property
    def opened(self) -> tuple[Any, Any, list[Any], list[Any]]:
        """The model, the data set, its queries, and its gallery."""
        model, dataset = lpn.load(self.model), datasets.open_dataset(self.data)
        return model, dataset, dataset.queries("drone"), dataset.gallery("satellite")

    def describe(self, name: str, angle: float = 0.0) -> retrieval.DescribedPicture:
        """A query, described without the app."""
        model, _, queries, _ = self.opened
        file = next(one for one in queries if one.name == name).path
        return retrieval.describe_picture(model, images.load_picture(file), "drone", angle)

    def ranking(self, name: str, angle: float = 0.0) -> retrieval.Ranking:
        """The ranking of a query, computed without the app."""
        model, _, _, gallery = self.opened
        tiles = cached_descriptors(model, gallery, "satellite")
        cosines = scoring.part_cosines(self.describe(name, angle).descriptor, tiles)
        return retrieval.rank(cosines, scoring.part_weights(4))


def expect_ranking(shown: Answer, ranking: retrieval.Ranking) -> None:
    """Check tiles and scores of an answer."""
    matches = ranking.top(len(shown.tiles))
    assert len(matches) >= 10
    assert shown.tiles == [match.index for match in matches]
    assert shown.scores == pytest.approx([match.score for match in matches], abs=2e-6)


@pytest.fixture(scope="module")
def windows(model_file: Path, make_once: MakeOnce, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Windows]:
    """The app, in this process; what is kept beside its data is kept beside a copy."""
    folder = tmp_path_factory.mktemp("windows")
    places = make_once("scored-places", lambda empty: write_places(empty / "places", 22)) / "places"
    data, saved = shutil.copytree(places, folder / "places"), folder / "pytorch_result.mat"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        tiles = data / "test" / "gallery_satellite"
        for command in (
            ("describe", "--model", model_file, "--images", tiles, "--view", "satellite", "--out", folder / "store"),
            ("index", "--descriptors", folder / "store", "--out", folder / "index"),
        ):
            assert main([str(part) for part in command]) == 0
        save_result(saved, data, model_file)
        index = SourceOptions(source=str(folder / "index"), model=model_file, data=data)
        others = {
            "index": LazyWorkspace("index", lambda: open_source(index)),
            "saved": LazyWorkspace(
                "saved", lambda: open_source(SourceOptions(source=str(saved), data=data, n_parts=4))
            ),
        }
        app = App(open_model(data, model_file, calibrate=True), "127.0.0.1", free_port(), others=others)
        yield Windows(classic(f"http://127.0.0.1:{app.server.get_port()}"), data, model_file)
        app.close()


@pytest.fixture
def page(new_page: Callable[[], Page]) -> Page:
    return new_page()


def test_the_first_screen_shows_an_answer_and_the_next_one(windows: Windows, page: Page) -> None:
    page.goto(windows.address(scoring="plain", screen="first", query=ONE))
    first = answer(page, name=ONE)
    expect_ranking(first, windows.ranking(ONE))
    shown = "(name) => document.querySelector('#lpn-first [data-query]')?.dataset.query === name"
    wait(page, shown, f"{TASK} {ONE}")
    ExplorerPage(page).key("n")
    following = answer(page, first.number, query=first.query + 1)
    expect_ranking(following, windows.ranking(following.name))
    wait(page, shown, f"{TASK} {following.name}")


def test_the_workbench_ranks_anew_for_a_turned_query_and_compares_a_tile(windows: Windows, page: Page) -> None:
    page.goto(windows.address(scoring="plain", screen="all", query=ONE))
    upright = answer(page, name=ONE, angle=0)
    expect_ranking(upright, windows.ranking(ONE))
    assert upright.chosen == upright.tiles[0]
    send(page, "stage-turn", 90)
    turned = answer(page, upright.number, angle=90)
    expect_ranking(turned, windows.ranking(ONE, 90))
    assert turned.scores != upright.scores
    page.locator(f"[data-index='{turned.tiles[2]}']").click()
    compared = answer(page, turned.number, chosen=turned.tiles[2])
    assert compared.tiles == turned.tiles
    wait(page, "(name) => new URLSearchParams(location.search).get('with')?.includes(name)", f"{turned.tiles[2]:04d}")


def test_the_window_of_reasons_accounts_for_the_score_of_the_compared_pair(windows: Windows, page: Page) -> None:
    model, _, _, gallery = windows.opened
    query = windows.describe(ONE)
    page.goto(windows.address(scoring="plain", screen="all", query=ONE))
    shown = answer(page, name=ONE)
    ExplorerPage(page).key("y")
    for rank in range(2):
        if rank:
            send(page, "compare", shown.tiles[rank])
        shown = answer(page, shown.number, chosen=shown.tiles[rank])
        tile = retrieval.describe_picture(model, images.load_picture(gallery[shown.chosen].path), "satellite")
        assert query.trace is not None
        assert tile.trace is not None
        found = explain.evidence(query.trace, tile.trace)
        assert found.score == pytest.approx(shown.scores[rank], abs=1e-5)
        cells = [side.score_map(found.weights).ravel().tolist() for side in (found.query, found.tile)]
        wait(
            page,
            """(sides) => {
              const maps = [...document.querySelectorAll("#lpn-why [data-cells]")].map((one) => JSON.parse(one.dataset.cells));
              return maps.length === 2 && sides.every((cells, i) => cells.every((cell, j) => Math.abs(cell - maps[i][j]) < 1e-4));
            }""",
            cells,
        )


def test_the_laboratory_lists_all_queries_worst_first_and_opens_one(windows: Windows, page: Page) -> None:
    _, _, queries, gallery = windows.opened
    page.goto(windows.address(scoring="plain", screen="all", query=ONE))
    shown = answer(page, name=ONE)
    page.evaluate(NOTE_LISTS)
    ExplorerPage(page).key("b")
    data = wait(page, "lists['lpn-lab-rows']")
    entries = page.evaluate("async (feed) => (await fetch(feed + 0)).json()", data["address"] + data["feed"])
    rows = [row for row, _ in entries]
    margins = []
    for query in queries:
        scores = windows.ranking(query.name).scores
        right = np.array([tile.label == query.label for tile in gallery])
        margins.append(2 * (scores[right].max() - scores[~right].max()))
    assert data["total"] == len(queries)
    assert sorted(rows) == list(range(len(queries)))
    assert np.diff(np.array(margins)[rows]).min() > -1e-5
    best = next(row for row in reversed(rows) if row != shown.query)
    send(page, "lab-open", best)
    expect_ranking(answer(page, shown.number, query=best), windows.ranking(queries[best].name))


def test_each_scoring_ranks_as_its_task_does(windows: Windows, page: Page) -> None:
    model, dataset, queries, _ = windows.opened
    position = [one.name for one in queries].index(ONE)
    tasks = {one.scoring: one for one in scored_tasks(model, "", dataset, new_calibration(model, dataset), [TASK])}
    page.goto(windows.address(scoring="plain", screen="all", query=ONE))
    shown = answer(page, name=ONE, scoring="plain")
    expect_ranking(shown, windows.ranking(ONE))
    for name in SCORINGS[1:]:
        send(page, "scoring", name)
        shown = answer(page, shown.number, scoring=name)
        task = tasks[name]
        assert task.model is not None
        query = task.queries[position]
        zoom = Change().for_picture(query, query.zoom)
        described = retrieval.describe_picture(task.model, images.load_picture(query.path), "drone", zoom)
        expect_ranking(shown, task.start_search(position, described.descriptor)(scoring.part_weights(4)))


def test_a_story_keeps_two_steps_and_is_told(windows: Windows, page: Page) -> None:
    page.goto(windows.address(scoring="plain", screen="all", query=ONE))
    shown = answer(page, name=ONE)
    send(page, "story-record")
    send(page, "stage-turn", 40)
    shown = answer(page, shown.number, angle=40)
    send(page, "story-record")
    page.wait_for_function(
        "() => document.querySelector('#lpn-notice')?.textContent.includes('Step 2')", timeout=1000 * PATIENCE
    )
    send(page, "story-play", "Story 1")
    shown = answer(page, shown.number, name=ONE, angle=0)
    (saved,) = json.loads((windows.data / "stories.json").read_text("utf-8"))
    steps = [dict(pair.split("=") for pair in step["shows"].split("&")) for step in saved["steps"]]
    assert [(step["query"], step.get("angle")) for step in steps] == [(ONE, None), (ONE, "40")]
    page.keyboard.press("ArrowRight")
    answer(page, shown.number, angle=40)


def test_a_report_of_the_pair_is_a_file_that_asks_for_nothing_else(
    windows: Windows, page: Page, new_page: Callable[[], Page], tmp_path: Path
) -> None:
    page.goto(windows.address(scoring="plain", screen="all", query=OTHER, why=1))
    shown = answer(page, name=OTHER)
    with page.expect_download(timeout=1000 * PATIENCE) as download:
        send(page, "report")
    download.value.save_as(tmp_path / "report.html")
    asked: list[str] = []
    report = new_page()
    report.on("request", lambda request: asked.append(request.url))
    report.goto((tmp_path / "report.html").as_uri())
    text = report.locator("body").text_content() or ""  # with what is folded
    assert OTHER in text
    assert windows.opened[3][shown.chosen].name in text
    assert f"{2 - 2 * shown.scores[0]:.3f}" in text
    assert report.evaluate("[...document.images].every((image) => image.complete && image.naturalWidth > 0)")
    assert [url for url in asked if not url.startswith("data:")] == [(tmp_path / "report.html").as_uri()]


def test_an_index_and_a_published_result_rank_as_the_model_does(windows: Windows, page: Page) -> None:
    expected = windows.ranking(ONE).top(10)
    for key in ("index", "saved"):
        page.goto(windows.address(show=key, screen="all", query=ONE))
        shown = answer(page, name=ONE)
        assert shown.scores[:10] == pytest.approx([match.score for match in expected], abs=2e-5)
        assert wait(page, "new URLSearchParams(location.search).get('show')") == key
        send(page, "compare", shown.tiles[3])  # the galleries have other orders
        answer(page, shown.number, chosen=shown.tiles[3])
        named = "(name) => new URLSearchParams(location.search).get('with')?.includes(name)"
        wait(page, named, windows.opened[3][expected[3].index].name)


def test_the_flight_window_shows_the_frame_of_the_answer(flight_app: RunningFlight, page: Page) -> None:
    page.goto(f"{flight_app.url}/?screen=all&flight=1&query=photo2.png")
    shown = answer(page, name="photo2.png")
    wait(page, "lpn.flight.data && lpn.flight.whole() && lpn.flight.chosen === 2")
    data = page.evaluate("lpn.flight.data")
    assert data["names"] == [f"photo{i}.png" for i in range(len(PLACES))]
    assert [stage == "registration" for stage in data["stages"]] == [i != REFUSED for i in range(len(PLACES))]
    track = data["tracks"]["registration"]
    placed = [place for i, place in enumerate(zip(track["x"], track["y"], strict=True)) if i != REFUSED]
    assert placed == [place for i, place in enumerate(PLACES) if i != REFUSED]
    ExplorerPage(page).key("n")
    shown = answer(page, shown.number, name="photo3.png")
    wait(page, "lpn.flight.chosen === 3")
    send(page, "flight-frame", REFUSED)
    answer(page, shown.number, query=REFUSED)
    wait(page, f"lpn.flight.chosen === {REFUSED}")


def test_a_notebook_shows_the_page_in_a_cell(windows: Windows, page: Page, tmp_path: Path) -> None:
    with lpn.explore(windows.model, windows.data) as served, served_folder(tmp_path) as address:
        (tmp_path / "cell.html").write_text(served._repr_mimebundle_()["text/html"])
        page.goto(f"{address}/cell.html")
        screen = page.frame_locator("iframe").first
        name = screen.locator("#list [aria-current=true]").get_attribute("title") or ""
        tiles = screen.locator("#strip .tile")
        for place, match in enumerate(windows.ranking(name).top(5)):
            expect(tiles.nth(place)).to_have_attribute("aria-label", re.compile(f"distance {match.distance2:.3f}$"))
            expect(tiles.nth(place)).to_have_attribute("data-tile", str(match.index))
        page.close()
    assert served.closed
