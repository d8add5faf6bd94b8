"""Saved results and plain arrays in the app."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from explorer.opening import open_model, open_source
from explorer.workspace import Workspace
from lpn.analysis import breakdown
from lpn.sources import SourceOptions
from tests.explorer.conftest import TASK, RefusedError, answered
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
