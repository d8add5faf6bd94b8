"""The boxes for the tags and the note of the query that the explorer shows."""

from __future__ import annotations

import viser

from explorer.failure_lab import table
from explorer.failure_lab.messages import SaveNote
from explorer.failure_lab.service import FailureLab, Findings
from explorer.web.html import Html
from lpn.analysis.notes import Note
from lpn.core.errors import LPNError


class NoteForm:
    """One browser's boxes; they keep what the user is typing."""

    def __init__(self, gui: viser.GuiApi, service: FailureLab) -> None:
        self._service = service
        self._boxes, self._message = Html(gui), Html(gui)
        # The query's path and the note that the boxes were filled with.
        self._shown: tuple[str, Note] | None = None
        self._revision = 0

    def show(self, findings: Findings | None, query: int | None) -> None:
        """Fill the boxes if the query or its stored note changed; None removes them."""
        if findings is None or query is None:
            self._shown = None
            self._boxes.show("")
            self._message.show("")
            return
        stored = findings.table.paths[query], findings.note(query)
        if stored == self._shown:
            return
        if self._shown is None or self._shown[0] != stored[0]:
            self._message.show("")
        self._shown = stored
        self._revision += 1
        self._boxes.show(table.note(findings, query, stored[1], self._revision))

    def save(self, message: SaveNote) -> bool:
        """Save the tags and the note of a query; return whether that succeeded."""
        findings = self._service.findings(message.task)
        if findings is None or message.row >= len(findings.table):
            return False
        path = findings.table.paths[message.row]
        try:
            self._service.set_note(path, message.tags, message.note)
        except LPNError as error:
            self._message.show(table.message(f"Not saved. {error}", False))
            return False
        newest = self._service.findings(message.task)
        if newest is not None and self._shown is not None and self._shown[0] == path:
            self._shown = path, newest.note(message.row)
        self._message.show(table.message(f"Saved in {self._service.notes_place}.", True))
        return True
