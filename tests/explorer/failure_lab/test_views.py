from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from explorer.browse.feeds import Feeds
from explorer.failure_lab import messages, state, table
from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState
from explorer.failure_lab.window import FailureLabWindow
from explorer.lab_choices import CHOICES, LabChoices, Selection, from_view
from explorer.session_state import SessionState
from explorer.stage.viewport import Viewport
from explorer.web.messages import Receivers
from explorer.workspace import Workspace
from lpn.analysis.named_views import NAME, ChosenQueries, NamedView
from lpn.tasks.notes import read_notes
from tests.explorer.explain_window.test_window import WindowGui
from tests.explorer.failure_lab.conftest import TASK


@pytest.fixture
def viewport() -> Viewport:
    return Viewport()


@pytest.fixture
def window(
    workspace: Workspace, service: FailureLab, findings: Findings, viewport: Viewport
) -> Iterator[FailureLabWindow]:
    assert findings is service.findings(TASK)
    client = SimpleNamespace(gui=WindowGui())
    made = FailureLabWindow(
        client,  # type: ignore[arg-type]
        workspace,
        service,
        Feeds(workspace),
        lambda _: None,
        viewport,
        SimpleNamespace(),  # type: ignore[arg-type]
    )
    yield made
    made.leave()
    for name in ("notes.csv", NAME):
        (workspace.root / name).unlink(missing_ok=True)


def busy(lab: LabState) -> LabState:
    return replace(
        lab,
        outcome="failed",
        filter="altitude > 0",
        filter_typed="altitude > 0",
        name_search="00",
        selections=(Selection.of("in pca", "lasso on the PCA", np.array([1, 4, 6])),),
        sort_column="name",
        descending=True,
        tab="maps",
        map="ground",
        colour="weather",
    )


def test_a_command_before_the_first_table_says_so(window: FailureLabWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(window._service, "findings", lambda *_: None)
    window._client.add_notification = lambda title, _: said.append(title)  # type: ignore[method-assign, misc, assignment]
    window._download()
    window._report()
    assert said == ["No table yet"] * 2


def test_a_view_brings_back_what_was_chosen(findings: Findings, lab: LabState) -> None:
    before = busy(lab)
    view = state.to_view(findings, before, " roofs ")
    assert view.name == "roofs"
    again = state.from_view(findings, lab, view)
    assert state.sorted_rows(findings, again).tolist() == state.sorted_rows(findings, before).tolist()
    assert (again.tab, again.map, again.colour, again.outcome) == ("maps", "ground", "weather", "failed")
    assert state.from_view(findings, before, msgspec.structs.replace(view, tab="")).tab == "maps"
    assert state.to_view(findings, again, "roofs") == view
    assert again.text_revision > lab.text_revision


@pytest.mark.parametrize("whole", [False, True])
def test_a_former_state_brings_back_the_choices_of_a_closed_laboratory_too(
    window: FailureLabWindow, whole: bool
) -> None:
    session = SessionState(TASK, 4, laboratory=LabChoices(outcome="failed", filter="rank > 3"))
    window.restore(session, whole)
    window._draw()
    assert (window._lab.outcome, window._lab.filter) == (("failed", "rank > 3") if whole else ("all", ""))


def test_a_view_of_other_data_says_what_is_missing(findings: Findings, lab: LabState) -> None:
    paths = (findings.table.paths[2], "gone/1.jpg", "gone/2.jpg")
    view = NamedView("v", TASK, "none such", "no_column > 1", "", (ChosenQueries("k", "twins", paths),), map="moon")
    shown = state.from_view(findings, lab, view)
    assert (shown.outcome, shown.map, shown.filter) == ("all", "pca", "")
    assert "There is no column" in shown.filter_error
    assert shown.selections[0].label == "twins (2 no longer there)"
    assert shown.selections[0].rows == (2,)


def test_the_drawer_offers_what_can_be_done(findings: Findings, lab: LabState) -> None:
    opened = messages.apply(messages.ToggleDrawer("tag"), lab, findings)
    assert "Tag all 13 shown" in table.drawer(findings, opened, 13, (), None)
    assert "Tag the 2 chosen" in table.drawer(findings, opened, 13, (), None, 2)
    assert table.drawer(findings, opened, 0, (), None) == ""
    assert messages.apply(messages.ToggleDrawer("tag"), opened, findings).drawer == ""
    views = replace(lab, drawer="views", tab="maps")
    html = table.drawer(findings, views, 0, (NamedView("<b>", TASK),), ("what & why", False))
    assert "&lt;b&gt;" in html
    assert "what &amp; why" in html
    assert table.drawer(findings, replace(views, drawer="columns"), 13, (), None) == ""


def test_the_chosen_queries_are_tagged_and_kept_as_a_view(
    window: FailureLabWindow, workspace: Workspace, service: FailureLab, findings: Findings
) -> None:
    handle = Receivers({messages.LabMessage: window.receive}).hand_on
    handle("lab-find", "0009")
    handle("lab-tag", "night blur")
    tagged = read_notes(workspace.root / "notes.csv")
    assert list(tagged) == [findings.table.paths[row] for row in findings.table.search(findings.table.rows(), "0009")]
    assert {note.tags for note in tagged.values()} == {("night", "blur")}
    newest = service.findings(TASK)
    assert newest is not None
    assert len(newest.table.filter(newest.table.rows(), "tags ~ night")) == len(tagged)
    handle("lab-tag", "no/word")
    assert window._drawer_message is not None
    assert "no/word" in window._drawer_message[0]
    handle("lab-view-save", "nine")
    assert [view.name for view in service.views(TASK)] == ["nine"]
    assert service.views("satellite-to-drone") == ()
    assert "in place of" not in window._drawer_message[0]
    handle("lab-view-save", " nine")
    assert window._drawer_message[0].endswith(", in place of the view of this name.")
    handle("lab-clear", None)
    assert window._lab.name_search == ""
    handle("lab-view", "nine")
    assert window._lab.name_search == "0009"
    handle("lab-view-save", "")
    assert window._drawer_message[1] is False
    handle("lab-view-remove", "nine")
    assert service.views(TASK) == ()


def test_the_window_follows_a_resize_while_it_is_placed_and_keeps_room_for_its_table(
    window: FailureLabWindow, viewport: Viewport
) -> None:
    placed: list[dict[str, int]] = []

    def resize_once() -> None:
        if len(placed) == 1:
            viewport.resize(650, 600)

    window._worker.stop()
    window._panel.float = lambda **place: placed.append(place)  # type: ignore[method-assign]
    window._panel.expand = resize_once  # type: ignore[method-assign]
    viewport.resize(900, 1000)
    for _ in range(3):
        window._place(False)
    assert [(place["width"], place["height"]) for place in placed] == [(888, 498), (638, 368)]


def test_one_table_covers_every_choice_of_the_laboratory() -> None:
    assert [choice.field for choice in CHOICES if choice.field != "selections"] == [
        field.name for field in fields(LabChoices) if field.name != "selections"
    ]
    at_first = NamedView("v", TASK)
    kept = {choice.view: choice for choice in CHOICES if choice.view} | {"chosen": CHOICES[-1]}
    assert {"name", "task", *kept} == set(NamedView.__struct_fields__)
    odd = msgspec.structs.replace(at_first, outcome="lost", tab="attic", map="moon")
    assert from_view(LabChoices("maps", map="umap"), odd) == LabChoices("maps", map="umap")
