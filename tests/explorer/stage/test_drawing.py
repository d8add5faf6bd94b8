from __future__ import annotations

from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from explorer.opening import open_model
from explorer.panels import answer_text, pages
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.errors import DataError, InputError
from lpn.core.texts import ordinal
from lpn.drawing import captions, overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.library.analyser import OwnPicture
from lpn.models.partition import Partition
from tools.fixtures import small_worlds


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    folder = tmp_path_factory.mktemp("workspace")
    return open_model(small_worlds.make_dataset(folder / "<i>places", train=1, test=13), model_file)


def test_masks_are_the_model_s_own_cells() -> None:
    areas = PartAreas.of_partition(Partition("rings", 4), (16, 16))
    labels = Partition("rings", 4).labels(16, 16)
    for part in range(4):
        np.testing.assert_array_equal(areas.mask(part, (384, 384))[12::24, 12::24], labels == part)


def test_drawn_rings_lie_on_the_boundaries() -> None:
    grey = np.full((384, 384, 3), 100, np.uint8)
    drawn = overlays.with_parts(grey, PartAreas.of_partition(Partition("rings", 4), (16, 16)), 3)
    changed = (drawn != grey).any(axis=2)
    assert changed[192, 144:150].any()
    assert not changed[192, 150:234].any()


@pytest.mark.parametrize("straight", [True, False])
def test_a_ring_that_does_not_count_is_grey(straight: bool) -> None:
    grey = np.full((64, 64, 3), 100, np.uint8)
    areas = replace(PartAreas.of_partition(Partition("rings", 4), (16, 16)), straight=straight)
    for off in range(4):
        colours = {tuple(one) for one in overlays.with_parts(grey, areas, 1, {off}).reshape(-1, 3).tolist()}
        parts = {theme.part_colour(part) for part in range(4)}
        assert colours & parts == parts - {theme.part_colour(off)}
        assert theme.UNKNOWN_COLOUR in colours


def test_heat_of_one_part_leaves_the_others_without_colour() -> None:
    grey = np.full((64, 64, 3), 100, np.uint8)
    inside = PartAreas.of_partition(Partition("rings", 4), (16, 16)).mask(1, (64, 64))
    activation = np.random.default_rng(0).random((16, 16)).astype(np.float32)
    drawn = overlays.with_heat(grey, activation, inside, 0.8)
    assert (np.ptp(drawn[~inside].astype(int), axis=1) == 0).all()
    assert np.ptp(drawn[inside].astype(int), axis=1).max() > 30
    np.testing.assert_array_equal(overlays.with_heat(grey, activation, None, 0.0), grey)


def test_answers_reuse_what_did_not_change_and_are_exact(workspace: Workspace) -> None:
    analyser = StateAnalyser(workspace)
    state = SessionState("drone-to-satellite", 4)
    first = analyser.analyse(state, 10)
    reweighted = analyser.analyse(replace(state, enabled=(True, True, False, True)), 10)
    assert reweighted.query is first.query
    assert reweighted.ranking is not first.ranking
    assert (
        analyser.analyse(replace(state, enabled=(True, True, False, True), rings=False), 10).ranking
        is reweighted.ranking
    )
    turned = analyser.analyse(replace(state, angle=40), 10)
    assert turned.query is not first.query
    again = analyser.analyse(state, 10)
    np.testing.assert_array_equal(again.ranking.scores, first.ranking.scores)
    for match in first.matches:
        assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-6)
    task = workspace.tasks["drone-to-satellite"]
    found = [analyser.analyse(replace(state, query=q), 10).positive for q in range(len(task.queries))]
    assert [truth.rank - 1 for truth in found if truth] == workspace.rankings[task.name].ranks.tolist()


def test_a_verdict_tells_the_sign_and_the_rank(workspace: Workspace) -> None:
    task = workspace.tasks["drone-to-satellite"]
    analyser = StateAnalyser(workspace)
    seen = set()
    for query in range(len(task.queries)):
        analysis = analyser.analyse(SessionState(task.name, 4, query=query), 10)
        true, headline, reason = answer_text.verdict(analysis, workspace)
        assert true == (workspace.rankings[task.name].ranks[query] == 0)
        assert headline.startswith(("Ring ", "Rings ", "All four rings ", "Nearly a tie"))
        seen.add(true)
        if not true:
            rank = ordinal(int(workspace.rankings[task.name].ranks[query]) + 1)
            assert reason.startswith(f"The nearest true tile is {rank}, ")
    assert seen == {True, False}
    own = analyser.analyse(SessionState(task.name, 4, upload=OwnPicture("own", small_worlds.place(50))), 10)
    assert answer_text.verdict(own, workspace)[0] is None
    assert [ordinal(i) for i in (1, 2, 3, 4, 11, 12, 13, 21, 102, 111)] == [
        *("1st", "2nd", "3rd", "4th", "11th", "12th", "13th", "21st", "102nd", "111th")
    ]


def test_names_from_files_never_become_html(workspace: Workspace) -> None:
    task = workspace.tasks["drone-to-satellite"]
    own = OwnPicture("<img src=x onerror=alert(1)>.png", small_worlds.place(51))
    analysis = StateAnalyser(workspace).analyse(SessionState(task.name, 4, upload=own), 10)
    assert "<i>places" not in pages.header(workspace, task)
    assert "&lt;i&gt;places" in pages.header(workspace, task)
    assert "<img src=x" not in pages.status(pages.ShownAnalysis(analysis, 1))


def test_a_true_tile_below_the_list_is_offered(workspace: Workspace) -> None:
    task = workspace.tasks["drone-to-satellite"]
    analyser = StateAnalyser(workspace)
    late = int(np.argmax(workspace.rankings[task.name].ranks))
    analysis = analyser.analyse(SessionState(task.name, 4, query=late), 1)
    html = unescape(pages.matches(analysis, workspace, ["first", "truth"]))
    assert ("lpn-truth" in html) == (workspace.rankings[task.name].ranks[late] > 0)
    assert ('getElementById("truth")' in html) == (workspace.rankings[task.name].ranks[late] > 0)


def test_a_model_without_the_views_of_the_data_is_refused(tmp_path: Path, model_file: Path) -> None:
    small_worlds.write(tmp_path / "street" / "test" / "query_street" / "0001" / "a.png", small_worlds.place(1))
    small_worlds.write(tmp_path / "street" / "test" / "gallery_satellite" / "0001" / "a.png", small_worlds.place(1))
    with pytest.raises(DataError, match="street-to-satellite"):
        open_model(tmp_path / "street", model_file)


def test_the_query_to_open_with_goes_by_its_name(tmp_path: Path, model_file: Path) -> None:
    data = small_worlds.make_dataset(tmp_path / "places", train=1, test=4)
    assert open_model(data, model_file).first_query == 0
    names = [entry.name for entry in next(iter(open_model(data, model_file).tasks.values())).queries]
    assert open_model(data, model_file, names[2]).first_query == 2
    with pytest.raises(InputError, match=f"places has no query <b>x; names look like {names[0]}"):
        open_model(data, model_file, "<b>x")


def test_a_city_that_cannot_be_used_is_said_and_left_out(
    tmp_path: Path, model_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=2))
    assert open_model(data, model_file).city is None
    assert not caplog.messages
    (data / "city.glb").write_bytes(small_worlds.city())
    city = open_model(data, model_file).city
    assert city is not None
    assert city.data == small_worlds.city()
    (data / "city.glb").write_bytes(small_worlds.city()[:-9])
    assert open_model(data, model_file).city is None
    assert len(caplog.messages) == 1
    assert "city.glb has" in caplog.messages[0]


def test_a_frame_over_the_city_shows_what_is_below_it() -> None:
    drawn = overlays.outlined(40, theme.TRUE_COLOUR, 3, 0.1)
    assert drawn.shape == (40, 40, 4)
    assert (drawn[..., 3] == 255).sum() == 40**2 - 34**2
    assert drawn[20, 20, 3] == 26
    assert tuple(drawn[0, 0, :3]) == theme.TRUE_COLOUR
    assert (captions.numbered(drawn, 7)[8, 8] == (*theme.BACKGROUND, 255)).all()
