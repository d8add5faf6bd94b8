from __future__ import annotations

import re
import threading
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from explorer import session_state
from explorer.compute.worker import DelayedCall
from explorer.opening import open_model, open_source
from explorer.panels import pages
from explorer.session_state import SessionState
from explorer.stories import tour
from explorer.stories.story import Step
from explorer.web import style
from explorer.workspace import StateAnalyser, Workspace
from lpn.drawing import captions, theme
from lpn.drawing.words import speaking
from lpn.sources import SourceOptions
from tools.fixtures import small_worlds
from tools.fixtures.published_results import save_result


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


@pytest.mark.parametrize("palette", [theme.DARK, theme.LIGHT], ids=["dark", "light"])
def test_words_can_be_read_in_both_themes(palette: theme.Palette) -> None:
    colours = (*theme.PART_COLOURS, theme.TRUE_COLOUR, theme.FALSE_COLOUR, theme.UNKNOWN_COLOUR)
    inks = [palette.ink(colour) for colour in colours]
    for ink in (*inks, palette.text, palette.dim):
        assert theme.contrast(ink, palette.background) >= theme.MIN_CONTRAST
    assert len(set(inks)) == len(inks)


def test_a_colour_that_can_be_read_is_not_changed() -> None:
    assert theme.contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    assert theme.DARK.ink(theme.TRUE_COLOUR) == theme.TRUE_COLOUR
    assert theme.LIGHT.ink(theme.TRUE_COLOUR) != theme.TRUE_COLOUR


def test_the_theme_follows_the_state() -> None:
    assert SessionState("t", 2).palette is theme.DARK
    assert SessionState("t", 2, dark=False).palette is theme.LIGHT
    image, _ = captions.caption(4, 4, theme.LIGHT)
    assert image.getpixel((0, 0)) == theme.LIGHT.background


def test_every_ink_of_the_html_is_in_the_styles() -> None:
    for ink in (style.part_ink(0), style.part_ink(9), style.verdict_ink(True), style.verdict_ink(None)):
        name = re.fullmatch(r"var\((--lpn-[\w-]+)\)", ink)
        assert name is not None
        assert style.STYLE.count(f"{name[1]}:#") == 2


def tour_captions(workspace: Workspace) -> list[str]:
    told = tour.story(workspace)
    where = tour.places()
    for step in told.steps:
        assert not step.shows, "the page stays as it is"
        assert step.points_at
        assert where[step.points_at]["selectors"]
        assert msgspec.convert(msgspec.to_builtins(step), Step) == step, "as short as a person's"
    return [step.caption for step in told.steps]


def test_the_tour_has_five_steps_and_speaks_of_nothing_that_is_missing(
    workspace: Workspace, data: Path, model_file: Path, tmp_path: Path
) -> None:
    live = tour_captions(workspace)
    assert len(live) == 5
    assert not any("shows the map" in caption for caption in live)
    assert any("square rings" in caption for caption in live)
    mapped = open_model(small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "mapped")), model_file)
    assert any("shows the map" in caption for caption in tour_captions(mapped))
    save_result(tmp_path / "r.mat", data, model_file)
    saved = tour_captions(open_source(SourceOptions(source=str(tmp_path / "r.mat"), data=data, n_parts=4)))
    assert len(saved) == 5
    keys = pages.keys(open_source(SourceOptions(source=str(tmp_path / "r.mat"), data=data, n_parts=4)))
    assert "Ctrl K" in keys
    assert not any(word in keys for word in ("turn 5°", "upright", "why", "my own picture"))
    assert not any(word in caption for caption in saved for word in ("place by place", "turn it", "your own"))


def test_the_verdict_has_the_sign_of_its_answer(workspace: Workspace) -> None:
    name, ranking = next(iter(workspace.rankings.items()))
    for query, rank in enumerate(ranking.ranks):
        analysis = StateAnalyser(workspace).analyse(SessionState(name, 4, query=query), 5)
        html = pages.verdict(analysis, workspace)
        assert f"{'✓' if rank == 0 else '✗'} {analysis.verdict.headline}<" in html


def test_what_alters_the_ranking_stands_beside_the_verdict_and_is_undone(workspace: Workspace) -> None:
    name = next(iter(workspace.tasks))
    plain = SessionState(name, 4)
    altered = replace(
        plain,
        region=(1, 2, 3),
        weights=(1.0, 1.0, 2.0, 1.0),
        enabled=(True, True, True, False),
        angle=20,
        down=5,
        zoom=2.0,
    )
    analyser = StateAnalyser(workspace)
    assert "Altered by" not in pages.verdict(analyser.analyse(plain, 5), workspace)
    html = pages.verdict(analyser.analyse(altered, 5), workspace)
    cells = workspace.map_sizes["drone"][0] * workspace.map_sizes["drone"][1]
    kinds = session_state.alterations(altered, cells)
    assert kinds == {
        "region": f"search by 3 of {cells} cells",
        "weights": "part weights 25 : 25 : 50 : 0 %",
        "rotation": "turned 20°",
        "shift": "shifted 5 px down",
        "zoom": "scaled by 2",
    }
    for kind, label in kinds.items():
        assert label in html
        assert kind not in session_state.alterations(session_state.undo(altered, kind), cells)
        altered = session_state.undo(altered, kind)
    assert altered == plain


def test_plain_words_head_the_page_with_the_place_and_fold_the_names_of_files(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def heading() -> tuple[str, str]:
        head, _, rest = pages.header(workspace, next(iter(workspace.tasks.values()))).partition("</h2>")
        return " ".join(re.sub("<[^>]*>", "", head.partition("<h2>")[2]).split()), rest

    named = f"{workspace.data_name} by the model {workspace.model_name}"
    assert heading()[0] == named
    with speaking(workspace.vocabulary(True)):
        assert heading()[0] == workspace.data_name
        monkeypatch.setattr(workspace, "choices", {workspace.key: "a real flight"})
        head, rest = heading()
    assert head == "A real flight"
    folded = rest.partition("</summary>")[2]
    assert named in " ".join(re.sub("<[^>]*>", "", folded).split())


def test_a_status_line_that_waits_still_says_what_is_shown(workspace: Workspace) -> None:
    state = SessionState(next(iter(workspace.tasks)), 4, query=2)
    shown = pages.ShownAnalysis(StateAnalyser(workspace).analyse(state, 5), 4)
    assert "computing" not in pages.status(shown)
    waiting = pages.status(shown, "computing")
    assert 'data-seq="4" data-query="2"' in waiting
    assert "computing" in waiting
    assert "describing the first picture" in pages.status(None, "computing")
    assert "Busy" in pages.status(None, "full")


def test_what_is_there_in_time_is_not_spoken_of() -> None:
    told = threading.Event()
    call = DelayedCall(600, told.set)
    call.cancel()
    call._timer.join(60)
    assert not call._timer.is_alive()
    call._call()  # its time came as it was cancelled
    assert not told.is_set()
    call = DelayedCall(0.01, told.set)
    assert told.wait(60)
    call.cancel()


def test_the_heatmap_on_the_stage_has_a_legend(workspace: Workspace) -> None:
    analyser, state = StateAnalyser(workspace), SessionState("drone-to-satellite", 4)

    def legend(**changes: object) -> str:
        return pages.heat_legend(analyser.analyse(replace(state, **changes), 10), workspace)  # type: ignore[arg-type]

    assert "Activation: weak" in legend()
    assert f"Activation of part {workspace.part_names[1]}:" in legend(heat_part=1)
    with speaking(workspace.vocabulary(True)):
        assert f"Where the model reacts, ring {workspace.part_names[1]}:" in legend(heat_part=1)
    assert "Evidence: against" in legend(heat_kind="evidence")
    for hidden in ({"heat": False}, {"map": True}, {"first_screen": True}):
        assert not legend(**hidden)
