"""The explorer on models whose parts are no rings: regions of each picture, gates, branches by role, and parts without cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from explorer.opening import open_model
from explorer.workspace import Workspace
from lpn.explain import sweeps
from tests.explorer.conftest import TASK, answered
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import GATES, REGIONS, GateModel, PartsModel, RegionModel, WholeModel
from tools.fixtures.tasks import ranked_in


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("own") / "places", train=1, test=6)


@pytest.fixture(scope="module")
def regions(data: Path) -> Workspace:
    return open_model(data, RegionModel())


@pytest.fixture(scope="module")
def without_cells(data: Path) -> Workspace:
    return open_model(data, PartsModel(RegionModel()))


def test_parts_are_those_of_each_picture(regions: Workspace) -> None:
    result = answered(regions)
    assert regions.part_names == list(REGIONS.part_names["drone"])
    assert (regions.contract.part_noun, regions.without_cells) == ("part", "")
    pictures = result.analysis.query, result.described(result.first)
    for view, described in zip(result.task.views, pictures, strict=True):
        areas = regions.areas(view, described)
        np.testing.assert_array_equal(areas.inside, described.trace.cells[0] > 0)
        # Without a forward pass, the parts of a tile are not known.
        assert regions.areas(view) is None


def test_a_part_without_cells_has_a_row_and_no_place(regions: Workspace) -> None:
    result = answered(regions, heat="evidence")
    message = result.message()
    assert len(message["rows"]) == 4
    assert message["photo"]["strongest"][3] == []
    (pair, *_) = result.evidence.values()
    assert pair.query.score_map(pair.weights).sum() + pair.query.constants @ pair.weights == pytest.approx(
        result.first.score, abs=1e-5
    )


@pytest.mark.parametrize("cells", [True, False])
def test_a_model_of_one_vector_has_one_part(data: Path, cells: bool) -> None:
    workspace = open_model(data, WholeModel() if cells else PartsModel(RegionModel(), one=True))
    message = answered(workspace).message()
    assert len(message["rows"]) == 1
    assert message["tiles"][message["answer"]]["shares"] == [message["nearest"]]
    known = workspace.outcomes(workspace.tasks[TASK])
    assert not {"part", "margin_1"} & set(known[1].columns)


def test_without_cells_there_is_a_reason_in_place_of_a_heatmap(without_cells: Workspace, regions: Workspace) -> None:
    result = answered(without_cells, heat="evidence")
    photo = result.message()["photo"]
    assert (photo["parts"], photo["heat"], result.evidence) == (None, None, {})
    assert "Parts gives 4 parts for a picture and no cells" in without_cells.without_cells
    # The ranking needs no cells.
    ranking = result.analysis.ranking
    np.testing.assert_allclose(ranking.cosines, answered(regions).analysis.ranking.cosines, atol=1e-5)
    points = sweeps.sweep_points(
        PartsModel(RegionModel()), result.analysis.source, "drone", sweeps.changes_over("rotation", 90),
        ranked_in(result.task.gallery_descriptors, ranking.weights),
    )  # fmt: skip
    assert len(list(points)) == 4


def test_branches_by_role_describe_each_side_of_each_task(data: Path) -> None:
    workspace = open_model(data, GateModel(replace(GATES, roles="role", groups=())))
    assert {TASK, "satellite-to-drone"} <= set(workspace.tasks)
    descriptors = []
    for name in (TASK, "satellite-to-drone"):
        result = answered(workspace, task=name)
        task, first = result.task, result.first
        np.testing.assert_allclose(result.analysis.query.descriptor, task.query_descriptors[0], atol=1e-5)
        np.testing.assert_allclose(result.described(first).descriptor, task.gallery_descriptors[first.index], atol=1e-5)
        descriptors.append(task.gallery_descriptors if name == TASK else task.query_descriptors)
    # The same satellite pictures are another side's.
    assert len(descriptors[0]) == len(descriptors[1])
    assert not np.allclose(np.sort(descriptors[0], axis=0), np.sort(descriptors[1], axis=0), atol=1e-3)
