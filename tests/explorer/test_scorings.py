"""Plain, calibrated, and CSLS: rankings, explanations, and links of the explorer, and figures of `lpn evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import lpn
from explorer.opening import open_model
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.progress import listening, report_progress
from lpn.datasets import Picture, labels_of, open_dataset
from lpn.retrieval.csls import NEIGHBOURS
from lpn.tasks import opening
from lpn.tasks.opening import new_calibration
from lpn.tasks.task import SCORINGS, Scoring, scored_key
from tests.conftest import MakeOnce
from tests.explorer.conftest import TASK, RefusedError, answered
from tools.fixtures import small_worlds

PATIENCE = 120.0


@pytest.fixture(scope="module")
def wide(make_once: MakeOnce) -> Path:
    """Places whose drone pictures show more ground than their tiles."""

    return make_once("scored-places", lambda folder: write_places(folder / "places", 22)) / "places"


def write_places(root: Path, count: int) -> None:
    """Write a test split whose queries and gallery hold different pictures of the same places."""
    for i in range(count):
        ground = images.resize(small_worlds.place(300 + i), 192, 192)
        pictures = {
            "query_drone": images.zoom(ground, 1.3 if i % 3 else 1.1),
            "gallery_satellite": images.zoom(ground, 2),
        }
        for folder, picture in pictures.items():
            small_worlds.write(root / "test" / folder / f"{i:04d}/{i:04d}.png", images.resize(picture, 96, 96))


@pytest.fixture(scope="module")
def workspace(wide: Path, model_file: Path) -> Workspace:
    return open_model(wide, model_file, calibrate=True)


@pytest.mark.parametrize("scoring", SCORINGS)
def test_figures_are_those_of_evaluate(workspace: Workspace, wide: Path, model_file: Path, scoring: Scoring) -> None:
    csls = NEIGHBOURS if scoring == "csls" else 0
    measured = lpn.evaluate(model_file, wide, TASK, calibrate=scoring != "plain", csls=csls)
    ranking = workspace.rankings[scored_key(TASK, scoring)]
    assert {f"recall@{k}": value for k, value in measured.recall.items()}.items() <= ranking.results.items()
    assert ranking.results["ap"] == pytest.approx(measured.ap)
    assert ranking.task.evaluate().recall == measured.recall


def test_an_own_picture_is_described_as_the_task_is_calibrated(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    own = task.queries[3].path.read_bytes()
    for scoring in SCORINGS:
        listed = answered(workspace, query=3, scoring=scoring).analysis
        mine = answered(workspace, f"?scoring={scoring}", own).analysis
        assert mine.zoom == pytest.approx(listed.zoom)
        assert mine.ranking.scores == pytest.approx(listed.ranking.scores, abs=1e-5)


@pytest.mark.parametrize(
    ("calibrate", "csls", "expected"),
    [(None, 0, "plain"), (False, 0, "plain"), (True, 0, "calibrated"), (True, 5, "csls"), (None, 5, "csls")],
)
def test_labels_never_choose_the_scoring_that_opens(
    calibrate: bool | None, csls: int, expected: str, wide: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recalls = []
    for order in (slice(None), slice(None, None, -1)):

        def reordered(of: Sequence[Picture], order: slice = order) -> Any:
            """The labels of queries in another order, by which other scorings are the best."""
            return labels_of(of)[order if "query_drone" in of[0].path.parts else slice(None)]

        with monkeypatch.context() as patch:
            patch.setattr(opening, "labels_of", reordered)
            opened = open_model(wide, model_file, calibrate=calibrate, csls=csls)
        assert opened.default_scoring(TASK) == expected
        shown = opened.rankings[scored_key(TASK, opened.default_scoring(TASK))]
        assert (shown.task.neighbours, shown.task.calibration is not None) == (csls, calibrate is True)
        recalls.append(shown.results["recall@1"])
    assert len(set(recalls)) > 1, "other labels, other figures"


@pytest.mark.parametrize(("calibrate", "expected"), [(None, "calibrated"), (False, "plain")])
def test_the_demo_opens_by_the_calibration_that_ships_and_offers_each_scoring(
    calibrate: bool | None, expected: str
) -> None:
    opened = open_model(DEMO, DEMO_MODEL, calibrate=calibrate)
    assert opened.default_scoring(TASK) == expected
    assert {scored_key(TASK, one) for one in SCORINGS} <= opened.rankings.keys()


def test_a_preparation_counts_its_pictures_and_ends_when_nobody_waits(
    tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_places(tmp_path / "places", 22)
    counts: list[tuple[int, int]] = []
    with listening(lambda _, *count: counts.append(count)):
        new_calibration(lpn.load(model_file), open_dataset(tmp_path / "places"))
    assert counts[-1] == (22, 22)

    def endless(*_: object) -> None:
        while True:
            report_progress("Describing", 3, 22)

    monkeypatch.setattr("explorer.opening.new_calibration", endless)
    opened, client = open_model(tmp_path / "places", model_file), object()
    job = opened.scorings.prepare(client)
    while not job.total:
        job.wait(0.01)
    assert (job.done, job.total) == (3, 22)
    job.leave(client)
    assert job.wait(PATIENCE)
    assert job.cancelled


def test_few_pictures_are_ranked_plainly(tmp_path: Path, model_file: Path) -> None:
    write_places(tmp_path / "few", 5)
    opened = open_model(tmp_path / "few", model_file)
    assert opened.default_scoring(TASK) == "plain"
    assert opened.scorings.why_not.startswith(
        "A calibration takes 20 pictures of each view or more, and there are 5 drone"
    )
    assert opened.scorings.prepare(opened) is None
    with pytest.raises(RefusedError, match="Scoring: expected plain"):
        answered(opened, scoring="csls")
