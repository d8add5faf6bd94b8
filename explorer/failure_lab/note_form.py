"""The boxes for the tags and the note of the query that the explorer shows."""

from __future__ import annotations

import viser

from explorer.failure_lab import table
from explorer.failure_lab.messages import SaveNote
from explorer.failure_lab.service import FailureLab, Findings
from explorer.web.html import Html
from explorer.web.render import call, run_once
from lpn.core.errors import LPNError
from lpn.tasks import notes
from lpn.tasks.notes import Note


class NoteForm:
    """One browser's boxes; they keep what the user is typing."""

    def __init__(self, gui: viser.GuiApi, service: FailureLab) -> None:
        self._service = service
        self._boxes, self._message = Html(gui), Html(gui)
        # The query's path and the note that the boxes were filled with.
        self._drawn_note: tuple[str, Note] | None = None
        # Path and name of a query whose note could not be saved, and why.
        self._unsaved: tuple[str, str, str] | None = None
        # The path and the note that this browser saved last.
        self._saved: tuple[str, Note] | None = None
        self._revision = 0

    def show(self, findings: Findings | None, query: int | None) -> None:
        """Fill the boxes if the query or its stored note changed; None removes them."""
        if findings is None or query is None:
            self._drawn_note = None
            self._boxes.show("")
            self._message.show("")
            return
        stored = findings.table.paths[query], findings.note(query)
        if stored == self._drawn_note:
            return
        if self._drawn_note is None or self._drawn_note[0] != stored[0]:
            self._message.show(self._reminder(stored[0]))
        self._drawn_note = stored
        self._revision += 1
        self._boxes.show(table.note(findings, query, stored[1], self._revision))

    def save(self, message: SaveNote) -> bool:
        """Save the tags and the note of a query; return whether the table has changed."""
        findings = self._service.findings(message.task)
        if findings is None or message.row >= len(findings.table):
            return False
        path = findings.table.paths[message.row]
        try:
            before = None if message.before is None else Note(notes.parse_tags(message.before[0]), message.before[1])
            self._set_note(path, message, before)
        except LPNError as error:
            stored = error.stored if isinstance(error, notes.ChangedNoteError) else None
            self._unsaved = path, findings.task.queries[message.row].name, str(error)
            newer = None if stored is None else (" ".join(stored.tags), stored.text)
            if stored is not None:
                self._now_stored(path, stored)
            self._say(f"Not saved. {error}", False, path, newer)
            return stored is not None
        if self._unsaved is not None and self._unsaved[0] == path:
            self._unsaved = None
        newest = self._service.findings(message.task)
        self._saved = None if newest is None else (path, newest.note(message.row))
        if newest is not None:
            self._now_stored(path, newest.note(message.row))
        self._say(f"Saved in {self._service.notes_place}.", True, path, (message.tags, message.note))
        return True

    def _set_note(self, path: str, message: SaveNote, before: Note | None) -> None:
        """Store a note, also over what this browser saved while it was sending this one."""
        try:
            self._service.set_note(path, message.tags, message.note, before)
        except notes.ChangedNoteError as error:
            if self._saved != (path, error.stored):
                raise
            self._service.set_note(path, message.tags, message.note, error.stored)

    def _now_stored(self, path: str, note: Note) -> None:
        """Leave the boxes in the page, which `_say` tells what is stored: new ones would take the focus from who types on."""
        if self._drawn_note is not None and self._drawn_note[0] == path:
            self._drawn_note = path, note

    def _say(self, text: str, good: bool, path: str, stored: tuple[str, str] | None) -> None:
        """Show a message, and tell the page which tags and note are stored if that is new to it."""
        script = "" if stored is None else run_once(call("noteStored", path, stored))
        self._message.show(table.message(text, good) + script)

    def _reminder(self, path: str) -> str:
        """Return a line about a note that could not be saved; empty without one."""
        if self._unsaved is None:
            return ""
        unsaved, name, reason = self._unsaved
        what = "This note" if unsaved == path else f"The note of {name}"
        return table.message(f"{what} is not saved, and waits in this browser for Save. {reason}", False)
