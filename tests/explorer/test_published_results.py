"""Saved results and plain arrays in the app."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from explorer.opening import open_model, open_source, open_tasks
from explorer.workspace import Workspace
from lpn.analysis import breakdown
from lpn.core.errors import InputError
from lpn.core.views import TaskName, views_of
from lpn.datasets import open_dataset
from lpn.models.base import normalise
from lpn.retrieval.saved import PublishedResult
from lpn.sources import SourceOptions
from lpn.tasks.saved import saved_task
from tests.explorer.conftest import TASK, RefusedError, answered
from tools.fixtures import layouts
from tools.fixtures.published_results import save_result


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A saved result with the descriptors of the other tests' model."""
    file = tmp_path_factory.mktemp("saved") / "pytorch_result.mat"
    save_result(file, data, model_file)
    return open_source(SourceOptions(source=str(file), data=data, n_parts=4))


def test_a_saved_result_is_ranked_as_its_model_ranks(workspace: Workspace, data: Path, model_file: Path) -> None:
    live = open_model(data, model_file)
    assert list(workspace.tasks) == [TASK]
    rankings = [opened.rankings[TASK] for opened in (workspace, live)]
    assert rankings[0].results == pytest.approx(rankings[1].results)
    np.testing.assert_array_equal(rankings[0].ranks, rankings[1].ranks)
    saved, task = (ranking.task for ranking in rankings)
    for query in (0, 5):
        results = [answered(opened, query=query, weights=[1, 0, 1, 1]) for opened in (workspace, live)]
        one, other = (result.analysis for result in results)
        assert [saved.gallery[m.index] for m in one.matches] == [task.gallery[m.index] for m in other.matches]
        for match, expected in zip(one.matches, other.matches, strict=True):
            np.testing.assert_allclose(match.contributions, expected.contributions, atol=1e-5)
            assert match.true == expected.true
        assert one.tile.activation is None
        np.testing.assert_array_equal(one.tile.picture, other.tile.picture)
        shown, whole = (result.message() for result in results)
        assert shown["headline"] == whole["headline"]
        assert (shown["photo"]["heat"], whole["photo"]["heat"] is None) == (None, False)


def test_what_needs_a_network_is_refused(workspace: Workspace) -> None:
    with pytest.raises(RefusedError, match="cannot describe a photo"):
        answered(workspace, own=b"x")


def random_result(root: Path, task: TaskName, seed: int = 0) -> PublishedResult:
    """A result of random descriptors with the gallery in reverse order; all labels are 0, as only lists tell the truth."""
    dataset, rng = open_dataset(root), np.random.default_rng(seed)
    query_view, gallery_view = views_of(task)
    sides = dataset.queries(query_view), dataset.gallery(gallery_view)[::-1]
    vectors = [normalise(rng.standard_normal((len(side), 2, 5)).astype(np.float32)) for side in sides]
    paths = [tuple(f"/their/{picture.path.relative_to(root).as_posix()}" for picture in side) for side in sides]
    labels = [np.zeros(len(side), np.int64) for side in sides]
    return PublishedResult("r.mat", vectors[0], labels[0], vectors[1], labels[1], paths[0], paths[1])


@pytest.mark.parametrize(
    ("layout", "task"),
    [
        (layouts.gta, TASK),
        (layouts.gta, "satellite-to-drone"),
        (layouts.vigor, "street-to-satellite"),
    ],
)
def test_listed_true_tiles_grade_a_saved_result(layout: Callable[[Path], Path], task: TaskName, tmp_path: Path) -> None:
    root = layout(tmp_path / "data")
    saved, dataset = random_result(root, task), open_dataset(root)
    lists = dataset.truth(task)
    assert lists is not None
    names = [picture.name for picture in dataset.gallery(views_of(task)[1])]
    opened = open_tasks([saved_task(saved, open_dataset(root))])
    assert list(opened.tasks) == [task]
    ranking, found = opened.rankings[task], opened.tasks[task]
    assert found.truth is not None
    shown = [tile.name for tile in found.gallery]
    assert shown == names[::-1]
    for query, (expected, truth) in enumerate(zip(lists, found.truth, strict=True)):
        good, semi = ({shown[row] for row in rows} for rows in (truth.good, truth.semi))
        assert good == {names[row] for row in expected.good}
        assert semi == {names[row] for row in expected.semi}
        assert truth.trapezoid == expected.trapezoid
        for name in names:
            np.testing.assert_equal(truth.overlap(shown.index(name)), expected.overlap(names.index(name)))
        scores = (saved.gallery * saved.query[query]).sum(axis=(1, 2))
        order = np.argsort(-scores, kind="stable")
        assert ranking.ranks[query] == next(at for at, row in enumerate(order) if shown[row] in good)
        marks = {shown[match.index]: match.true for match in answered(opened, query=query).analysis.matches}
        assert marks == {name: name in good for name in marks}
    if task != "satellite-to-drone":  # labels cannot express several true tiles of a query, or half-true ones
        assert any(len(one.good) > 1 or len(one.semi) for one in lists)


def test_a_gallery_picture_with_two_rows_is_refused_where_lists_tell_the_truth(tmp_path: Path) -> None:
    root = layouts.gta(tmp_path / "data")
    saved = random_result(root, TASK)
    assert saved.gallery_paths is not None
    twice = replace(saved, gallery_paths=(saved.gallery_paths[1], *saved.gallery_paths[1:]))
    with pytest.raises(InputError, match="twice in its gallery"):
        open_tasks([saved_task(twice, open_dataset(root))])


def test_arrays_are_shown_without_a_model(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for side, count in (("query", 6), ("gallery", 9)):
        np.save(tmp_path / f"{side}.npy", rng.standard_normal((count, 2, 5)))
    lines = [f"{side}{row},{side},{row}" for side, count in (("query", 6), ("gallery", 9)) for row in range(count)]
    (tmp_path / "paths.csv").write_text("\n".join(["file,side,label", *lines]))
    source = SourceOptions(
        source=str(tmp_path / "query.npy"), gallery=tmp_path / "gallery.npy", paths=tmp_path / "paths.csv"
    )
    workspace = open_source(source, "query2")
    (task,) = workspace.tasks.values()
    assert (workspace.first_query, workspace.part_names) == (2, ["1", "2"])
    assert workspace.areas(task.query_view) is None
    pairs = breakdown.confusions(task.outcomes, task.query_labels, task.gallery_labels, task.table.rows())
    assert sum(len(pair.queries) for pair in pairs) == int(task.outcomes.failed.sum())
    result = answered(workspace, weights=[0, 1])
    assert result.first.index == int((task.gallery_descriptors[:, 1] @ task.query_descriptors[2, 1]).argmax())
    assert result.message()["headline"]["found"] in (True, False)
