"""The glossary of docs/glossary.md, shown in a window over the page."""

from __future__ import annotations

import re
from typing import Any

import viser

from explorer.web.terms import GLOSSARY


class Glossary:
    """A window that one browser opens and closes."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._modal: Any = None

    def show(self) -> None:
        """Open the window, unless it is open."""
        if self._modal is not None:
            return
        self._modal = self._gui.add_modal("Glossary")
        with self._modal:
            self._gui.add_button("Close").on_click(lambda _: self._close())
            self._gui.add_markdown(text())

    def _close(self) -> None:
        modal, self._modal = self._modal, None
        if modal is not None:
            modal.close()


def text() -> str:
    """Return the tables of the glossary as Markdown, without links, which lead to files of the project."""
    _, heading, tables = GLOSSARY.read_text("utf-8").partition("## ")
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading + tables)
