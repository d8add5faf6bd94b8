"""Screen, laboratory, and report count the same photos of a flight as right, as wrong, and as not graded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer.opening import OFFERED_OVERLAP, open_flight_over
from explorer.screen.rail import Rail
from explorer.workspace import Workspace
from lpn.cli.main import main
from lpn.core.demo import DEMO_ANSWERS, DEMO_MODEL, DEMO_PLACE
from lpn.flight.locate.source import FlightSource
from lpn.sources import ModelOptions
from tests.explorer.conftest import TASK, answered

PATIENCE = 120.0
# The photos of the shipped flight whose details judge them and are contradicted, and the wrong answers besides.
DOUBTFUL, WRONG = {7, 9, 11, 20}, {0, 3, 16, 28}
PHOTOS = 30


def opened(basemap: Path, flight: Path) -> Workspace:
    shipped, model = basemap.with_name(DEMO_ANSWERS), ModelOptions(model=DEMO_MODEL)
    place = open_flight_over(basemap, flight, model, overlap=OFFERED_OVERLAP, shipped=shipped)
    assert place.registration.wait(PATIENCE)
    return place


@pytest.fixture(scope="module")
def workspace() -> Iterator[Workspace]:
    place = opened(*DEMO_PLACE)
    yield place
    place.basemap.close()


def text(html: str) -> str:
    return unescape(" ".join(re.sub(r"<[^>]*>", " ", html.partition("</style>")[2] or html).split()))


def test_the_screen_counts_photos_whose_judge_is_in_doubt_neither_as_right_nor_as_wrong(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    assert set(np.flatnonzero(~workspace.graded(ranking)).tolist()) == DOUBTFUL
    right, graded = workspace.counts(ranking)
    assert (graded - right, graded) == (len(WRONG), PHOTOS - len(DOUBTFUL))
    for query in (*DOUBTFUL, *WRONG, workspace.first_query):
        expected = None if query in DOUBTFUL else query not in WRONG
        assert answered(workspace, query=query).message()["headline"]["found"] is expected, query
    rail = Rail().message(replace(answered(workspace).state, filter="missed"), workspace, ranking, workspace.feeds)
    assert (rail["total"], rail["missed"], rail["queries"]) == (len(WRONG), len(WRONG), PHOTOS)
    result, measured = ranking.result, workspace.results(ranking)
    assert measured["recall@1"] == pytest.approx(100 * 22 / 26)
    counted = np.delete(result.errors, sorted(DOUBTFUL))
    assert measured["within 50 m"] == pytest.approx(100 * np.mean(counted <= 50))
    assert measured["within 50 m"] != pytest.approx(100 * np.mean(result.errors <= 50))


def test_reports_count_as_the_screen_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locate = FlightSource.locate
    shipped: dict[str, Any] = {"overlap": OFFERED_OVERLAP, "shipped": DEMO_PLACE[0].with_name(DEMO_ANSWERS)}

    def as_in_app(source: FlightSource, _: float | None, *args: Any) -> Any:
        names, weights = args
        return locate(source, names=names, weights=weights, **shipped)

    monkeypatch.setattr(FlightSource, "locate", as_in_app)
    command = ["report", str(DEMO_PLACE[1]), "--map", str(DEMO_PLACE[0])]
    command += ["--model", str(DEMO_MODEL), "--out", str(tmp_path / "r.html")]
    assert main([*command, "--where", "seconds >= 0", "--matches", "1"]) == 0
    said = text((tmp_path / "r.html").read_text())
    assert "That is right for 22 of the 26 photos whose place is known for certain." in said
    assert "30 queries (26 of known place, for certain, which are graded)" in said
    assert said.count("It is not graded, as no tile is right for certain") == len(DOUBTFUL)
    assert "84.6 % R@1" in said
    assert main([*command, "--matches", "1"]) == 0
    said = text((tmp_path / "r.html").read_text())
    assert "the worst of 4 failures, lowest margin first" in said


def test_without_registration_no_judge_is_in_doubt(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [
        replace(one, stages={name: answer for name, answer in one.stages.items() if name != "registration"})
        for one in workspace.flight.frames
    ]
    monkeypatch.setattr(workspace, "flight", replace(workspace.flight, frames=frames))
    assert workspace.graded(workspace.rankings[TASK]).all()
