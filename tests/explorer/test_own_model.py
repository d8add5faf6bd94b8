"""The explorer on models whose parts are no rings: regions of each picture, gates, branches by role, and parts without cells."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lpn
from explorer.explain_window import activation, comparison, evidence, model_comparison, region, sweep_page
from explorer.failure_lab import breakdown_page, table
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.opening import open_model, open_source
from explorer.panels import first_screen, pages
from explorer.session_state import POSITIVE, SessionState
from explorer.stories import tour
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.analysis.comparison import Comparison
from lpn.core.errors import StoreError
from lpn.drawing.words import speaking
from lpn.explain import sweeps
from lpn.index import create_index
from lpn.index.base import DescriptorKind
from lpn.report import Options, build
from lpn.sources import SourceOptions
from tools.fixtures import small_worlds
from tools.fixtures.rankings import ranked_in
from tools.fixtures.small_contracts import GATES, REGIONS, GateModel, PartsModel, RegionModel, WholeModel

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("own") / "places", train=1, test=6)


@pytest.fixture(scope="module")
def regions(data: Path) -> Workspace:
    return open_model(data, RegionModel())


@pytest.fixture(scope="module")
def without_cells(data: Path) -> Workspace:
    return open_model(data, PartsModel(RegionModel()))


def analysed(workspace: Workspace, task: str = TASK, **changes: Any) -> StateAnalysis:
    state = workspace.supported_state(SessionState(task, workspace.contract.n_parts, why=True))
    return StateAnalyser(workspace).analyse(replace(state, **changes), 5)


def test_parts_are_those_of_each_picture(regions: Workspace) -> None:
    analysis = analysed(regions)
    assert regions.part_names == list(REGIONS.part_names["drone"])
    assert (regions.contract.part_noun, regions.without_cells) == ("part", "")
    for view, described in zip(analysis.task.views, (analysis.query, analysis.tile), strict=True):
        areas = regions.areas(view, described)
        assert areas is not None
        assert described.trace is not None
        np.testing.assert_array_equal(areas.inside, described.trace.cells[0] > 0)
        # Without a forward pass, a card's parts are not known.
        assert regions.areas(view) is None


def test_the_windows_name_the_level_and_the_part_without_cells(regions: Workspace) -> None:
    analysis = analysed(regions)
    page = evidence.page(analysis, regions)
    assert "Exact, with the regions of each picture held: cells and constants add up to the score." in page
    assert "No cell belongs to part 4 whole picture; it is a constant of each picture." in page
    heatmaps = activation.page(analysis, regions)
    assert "part 3 darkest" in heatmaps
    assert "part 4 whole picture" not in heatmaps
    painted = analysed(regions, region=(9, 10, 17))
    assert "(exact, with the regions of each picture held)" in region.page(painted, regions)
    assert painted.ranking.lengths is not None
    html = " ".join(step.caption for step in tour.story(regions).steps) + pages.keys(regions)
    assert not re.search(r"\brings?\b", html)


def test_the_level_is_named_wherever_numbers_are(regions: Workspace, without_cells: Workspace) -> None:
    for workspace, level in (
        (regions, "exact, with the regions of each picture held"),
        (without_cells, "parts only: the model gives no cells"),
    ):
        analysis = analysed(workspace)
        points = list(
            sweeps.sweep_points(
                RegionModel(), analysis.source, "drone", sweeps.changes_over("rotation", 180),
                ranked_in(analysis.task.gallery_descriptors, analysis.ranking.weights),
            )
        )  # fmt: skip
        swept = sweeps.SweepResult("rotation", tuple(points))
        lab = FailureLab(workspace)
        assert lab.build(TASK, None).wait(60)
        findings = lab.findings(TASK)
        assert findings is not None
        for html in (
            pages.header(workspace, workspace.tasks[TASK]),
            pages.parts_table(analysis, workspace),
            sweep_page.page(analysis, "rotation", swept, len(points), workspace.part_names),
            table.summary(findings, LabState(task=TASK), findings.table.rows()),
        ):
            text = re.sub("<[^>]+>", "", html)
            assert re.search(f"[Ll]evel(?: of evidence)?: {level}", text)


def test_an_index_of_a_gallery_by_role_is_explored(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, name = GateModel(replace(GATES, roles="role", groups=())), "satellite-to-drone"
    monkeypatch.setattr(lpn, "load", lambda *_, **__: model)
    whole = analysed(open_model(data, model), name)
    kind = DescriptorKind(model.for_task("satellite", "drone").fingerprint, model.n_parts, model.embedding)
    index = create_index(tmp_path / "index", kind)
    gallery = whole.task.gallery
    index.add(
        [gallery[i].path.relative_to(data).as_posix() for i in range(len(gallery))], whole.task.gallery_descriptors
    )
    index.close()
    opened = open_source(SourceOptions(source=str(tmp_path / "index"), model=Path("m.pth"), data=data))
    assert list(opened.tasks) == [name]
    found = analysed(opened, name)
    assert [one.distance2 for one in found.matches] == pytest.approx([one.distance2 for one in whole.matches], abs=1e-5)
    # Plain pictures are queries of the task whose gallery it is.
    pictures = open_source(
        SourceOptions(
            source=str(tmp_path / "index"),
            model=Path("m.pth"),
            data=data,
            pictures=data / "test" / "query_satellite",
        )
    )
    assert list(pictures.tasks) == [name]
    create_index(tmp_path / "other", replace(kind, fingerprint="other")).close()
    with pytest.raises(StoreError, match="holds descriptors of model other"):
        open_source(SourceOptions(source=str(tmp_path / "other"), model=Path("m.pth"), data=data))


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("cells", [True, False])
def test_a_model_of_one_vector_has_no_parts_in_words(data: Path, plain: bool, cells: bool) -> None:
    workspace = open_model(data, WholeModel() if cells else PartsModel(RegionModel(), one=True))
    wrong = next(query for query in range(6) if not analysed(workspace, query=query).matches[0].true)
    lab = FailureLab(workspace)
    assert lab.build(TASK, None).wait(60)
    findings = lab.findings(TASK)
    assert findings is not None
    assert not {"part", "margin_1"} & set(findings.table.columns)
    texts = [step.caption for step in tour.story(workspace).steps]
    with speaking(workspace.vocabulary(plain)):
        for analysis in (analysed(workspace, query=wrong), analysed(workspace, query=wrong, selected=POSITIVE)):
            ranking = analysis.ranking
            compared = Comparison.of(ranking, analysis.chosen)
            points = sweeps.sweep_points(
                workspace.model, analysis.source, "drone", sweeps.changes_over("weather"),
                ranked_in(analysis.task.gallery_descriptors, ranking.weights),
            )  # fmt: skip
            swept = sweeps.SweepResult("weather", tuple(points))
            texts += [
                pages.header(workspace, analysis.task),
                pages.keys(workspace),
                pages.verdict(analysis, workspace),
                pages.matches(analysis, workspace, ["one", "two"]),
                pages.parts_table(analysis, workspace),
                first_screen.page(analysis, workspace),
                comparison.page(analysis, workspace, compared, None, computing=False),
                evidence.page(analysis, workspace),
                activation.page(analysis, workspace),
                sweep_page.page(analysis, "weather", swept, len(swept.points), workspace.part_names),
                table.summary(findings, LabState(task=TASK), findings.table.rows()),
                breakdown_page.page(findings, LabState(task=TASK), workspace),
            ]
        texts.append(build(workspace.tasks[TASK], [wrong], Options(matches=2)).decode())
    for text in texts:
        words = re.sub("<style.*?</style>|<[^>]+>", " ", text, flags=re.DOTALL)
        assert re.findall(r".{0,60}\b[Pp]arts?\b.{0,40}|.{0,60}\b[Rr]ings?\b.{0,40}", words) == []


def test_a_report_names_the_level(regions: Workspace, without_cells: Workspace) -> None:
    made = build(regions.tasks[TASK], [0], Options(matches=2)).decode()
    assert "Exact, with the regions of each picture held: the cells and the constant add up" in made
    assert "No cell belongs to part 4 whole picture" in made
    made = build(without_cells.tasks[TASK], [0], Options(matches=2)).decode()
    assert "Parts gives 4 parts for a picture and no cells" in made
    assert "Evidence for and against" not in made


def test_without_cells_there_is_a_reason_in_place_of_a_heatmap(without_cells: Workspace, regions: Workspace) -> None:
    analysis = analysed(without_cells)
    assert not analysis.state.heat
    why = "Parts gives 4 parts for a picture and no cells (parts only: the model gives no cells)"
    for page in (evidence.page, activation.page, region.page):
        assert why in page(analysis, without_cells)
    assert "lpn explain --covering" in evidence.page(analysis, without_cells)
    assert "heatmap" not in pages.keys(without_cells)
    # The ranking needs no cells.
    np.testing.assert_allclose(analysis.ranking.cosines, analysed(regions).ranking.cosines, atol=1e-5)
    points = list(
        sweeps.sweep_points(
            PartsModel(RegionModel()), analysis.source, "drone", sweeps.changes_over("rotation", 90),
            ranked_in(analysis.task.gallery_descriptors, analysis.ranking.weights),
        )
    )  # fmt: skip
    assert len(points) == 4


def test_two_contracts_stand_side_by_side(regions: Workspace, without_cells: Workspace) -> None:
    own, other = analysed(regions), analysed(without_cells)
    column = model_comparison._column(regions, own, None, None, [], own)
    assert (column.claim, column.without_cells) == ("exact, with the regions of each picture held", "")
    assert "no cells" in model_comparison._column(without_cells, other, None, None, [], own).without_cells
    assert len(model_comparison._values(own, own.state)) == 2
    assert not model_comparison._values(other, other.state)


def test_branches_by_role_describe_each_side_of_each_task(data: Path) -> None:
    workspace = open_model(data, GateModel(replace(GATES, roles="role", groups=())))
    assert {TASK, "satellite-to-drone"} <= set(workspace.tasks)
    descriptors = []
    for name in (TASK, "satellite-to-drone"):
        analysis = analysed(workspace, name)
        task, index = analysis.task, analysis.chosen.index
        np.testing.assert_allclose(analysis.query.descriptor, task.query_descriptors[0], atol=1e-5)
        np.testing.assert_allclose(analysis.tile.descriptor, task.gallery_descriptors[index], atol=1e-5)
        descriptors.append(task.gallery_descriptors if name == TASK else task.query_descriptors)
    # The same satellite pictures are another side's.
    assert len(descriptors[0]) == len(descriptors[1])
    assert not np.allclose(np.sort(descriptors[0], axis=0), np.sort(descriptors[1], axis=0), atol=1e-3)
