"""The glossary of docs/glossary.md, shown in a window over the page."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import viser

from explorer.web.terms import GLOSSARY


class Glossary:
    """A window that one browser opens and closes.

    Args:
        plain: returns True while the page speaks plain words.
    """

    def __init__(self, gui: viser.GuiApi, plain: Callable[[], bool]) -> None:
        self._gui, self._plain = gui, plain
        self._modal: Any = None

    def show(self) -> None:
        """Open the window, unless it is open."""
        if self._modal is not None:
            return
        self._modal = self._gui.add_modal("Glossary")
        with self._modal:
            self._gui.add_button("Close").on_click(lambda _: self._close())
            self._gui.add_markdown(text(self._plain()))

    def _close(self) -> None:
        modal, self._modal = self._modal, None
        if modal is not None:
            modal.close()


def text(plain: bool) -> str:
    """Return the tables of the glossary as Markdown, without links, which lead to files of the project.

    Args:
        plain: begin with the words of the plain screens, below which the page folds all others; they come last otherwise.
    """
    _, first, *others = re.split(r"^(?=## )", GLOSSARY.read_text("utf-8"), flags=re.MULTILINE)
    tables = [first, *others] if plain else [*others, "\n", first]
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", "".join(tables))
