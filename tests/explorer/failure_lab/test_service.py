from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer.failure_lab import table
from explorer.failure_lab.messages import LabMessage, SaveNote
from explorer.failure_lab.note_form import NoteForm
from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState
from explorer.web.html import Html
from explorer.web.messages import decode
from explorer.workspace import Workspace
from lpn.core.demo import own_file_place
from lpn.core.errors import InputError, OutputError
from lpn.core.tables import Table
from lpn.tasks import notes
from tests.explorer.failure_lab.conftest import TASK


def test_browsers_share_one_computation_of_the_table(service: FailureLab) -> None:
    first, second = service.build(TASK, "one"), service.build(TASK, "other")
    assert first is second
    assert first.wait(120)
    assert (first.done, first.total) == (13, 13)
    assert service.findings(TASK) is service.findings(TASK)


def test_ranks_agree_with_the_explorer(workspace: Workspace, findings: Findings) -> None:
    np.testing.assert_array_equal(findings.outcomes.rank, workspace.rankings[TASK].ranks)
    assert findings.table.columns["part"].values[0] in workspace.part_names
    assert {"distance", "altitude", "weather", "tags"} <= set(findings.table.columns)


def test_notes_on_the_demo_are_the_user_s_own(
    workspace: Workspace, findings: Findings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("lpn.core.demo.DEMO", workspace.root)
    service = FailureLab(workspace)
    service.set_note(findings.table.paths[2], "night", "")
    assert not (workspace.root / "notes.csv").exists()
    assert notes.read_notes(tmp_path / "home" / "lpn-explorer" / "places" / "notes.csv") == service._read_notes()[0]
    assert (
        service.notes_place
        == "lpn-explorer/places/notes.csv, in the user's data folder, on the computer that runs this page"
    )
    assert (
        own_file_place(tmp_path, "notes.csv", "data")
        == "notes.csv, beside the data, on the computer that runs this page"
    )
    for name in ("XDG_DATA_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError))
    assert service._read_notes() == (
        {},
        "This user has no home folder for notes; set XDG_DATA_HOME to a folder that can be written.",
    )


def test_notes_reach_every_table_and_the_disk(workspace: Workspace, service: FailureLab, findings: Findings) -> None:
    path = findings.table.paths[2]
    service.set_note(path, "night, blur", "Looks like\nthe twin.")
    try:
        newest = service.findings(TASK)
        assert newest is not None
        assert newest.note(2) == notes.Note(("night", "blur"), "Looks like\nthe twin.")
        assert newest.table.filter(newest.table.rows(), "tags ~ night").tolist() == [2]
        assert notes.read_notes(workspace.root / "notes.csv")[path].tags == ("night", "blur")
        other = FailureLab(workspace)
        other.build(TASK, None).wait(120)
        again = other.findings(TASK)
        assert again is not None
        assert again.note(2) == newest.note(2)
        with pytest.raises(InputError, match="no/word"):
            service.set_note(path, "no/word", "")
        (workspace.root / "notes.csv").write_text("what,is\n")
        damaged = FailureLab(workspace)
        damaged.build(TASK, None).wait(120)
        without = damaged.findings(TASK)
        assert without is not None
        assert "expected path,tags,note" in without.notes_error
        assert "left out" in table.summary(without, LabState(task=TASK), without.table.rows())
    finally:
        (workspace.root / "notes.csv").unlink()


class Gui:
    """Refuses text that UTF-8 cannot encode, as the connection to a browser does."""

    content: str

    def __init__(self) -> None:
        self.elements: list[Gui] = []

    def add_html(self, content: str) -> Gui:
        self.elements.append(Gui())
        self.elements[-1].content = content
        return self.elements[-1]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "content":
            value.encode()
        super().__setattr__(name, value)


def test_a_name_that_is_not_utf8_is_shown_and_its_note_is_refused(
    workspace: Workspace, service: FailureLab, findings: Findings, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = list(findings.table.paths)
    named[2] = "test/query_drone/0002/caf\udce9.webp"
    odd = replace(findings, table=Table(named, list(findings.table.columns.values())))
    monkeypatch.setitem(service._findings, TASK, odd)
    gui = Gui()
    Html(gui, "caf\udce9").show("<b>caf\udce9.webp</b>")  # type: ignore[arg-type]
    assert gui.elements[0].content == "<b>caf?.webp</b>"
    view = NoteForm(gui, service)  # type: ignore[arg-type]
    view.show(odd, 2)
    boxes, message = gui.elements[1:]
    assert f'data-task="{TASK}" data-row="2"' in boxes.content
    assert not view.save(SaveNote(TASK, 2, "night", "text"))
    assert "Not saved. The query&#39;s path is" in message.content
    assert "rename the file" in message.content
    for wrong in (None, [TASK, True, "", ""], [TASK, 2, "", 3], [[], 2, "", ""], [TASK, -1, "", ""], [TASK, 2, ""]):
        assert decode(LabMessage, "lab-note", wrong) is None
    assert not view.save(SaveNote(TASK, 13, "", ""))
    assert not view.save(SaveNote("moon", 2, "", ""))
    assert not (workspace.root / "notes.csv").exists()
    assert view.save(SaveNote(TASK, 3, "night", "text"))
    assert notes.read_notes(workspace.root / "notes.csv") == {named[3]: notes.Note(("night",), "text")}
    (workspace.root / "notes.csv").unlink()


def test_boxes_stay_in_the_page_when_somebody_else_has_changed_their_note(
    workspace: Workspace, service: FailureLab, findings: Findings
) -> None:
    gui = Gui()
    view = NoteForm(gui, service)  # type: ignore[arg-type]
    view.show(findings, 2)
    boxes, message = gui.elements
    drawn = boxes.content
    try:
        service.set_note(findings.table.paths[2], "", "theirs")
        assert view.save(SaveNote(TASK, 2, "", "mine", ("", "")))
        assert "it is now &#39;theirs&#39;" in message.content
        view.show(service.findings(TASK), 2)
        assert boxes.content == drawn, "who types on would lose the focus, and what is typed would not be saved"
        service.set_note(findings.table.paths[2], "", "another's")
        view.show(service.findings(TASK), 2)
        assert "another&#39;s" in boxes.content
    finally:
        (workspace.root / "notes.csv").unlink()


def test_notes_that_cannot_be_written_are_reported_and_change_nothing(workspace: Workspace) -> None:
    file = workspace.root / "notes.csv"
    file.mkdir()
    try:
        service = FailureLab(workspace)
        service.build(TASK, None).wait(120)
        findings = service.findings(TASK)
        assert findings is not None
        assert "cannot be read" in findings.notes_error
        with pytest.raises(OutputError, match=r"notes\.csv cannot be written"):
            service.set_note(findings.table.paths[0], "night", "")
        assert service.findings(TASK) is findings
    finally:
        file.rmdir()
