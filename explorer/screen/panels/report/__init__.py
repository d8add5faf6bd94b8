"""Commands that export from the page: reports as pages that need no server, and a paper's figure."""

from __future__ import annotations

from importlib.util import find_spec

from explorer.screen.panel import Command, Panel
from explorer.screen.panels.report.pages import save_answer, save_figure, save_worst
from explorer.workspace import Workspace


def _draws(workspace: Workspace) -> bool:
    return workspace.model is not None and not workspace.without_cells and find_spec("matplotlib") is not None


PANEL = Panel(
    "report",
    "Report",
    commands=(
        Command("answer", "Save this answer as a page", save_answer),
        Command("worst", "Report of the worst failures", save_worst),
        Command("figure", "Save the figure for a paper", save_figure, offered=_draws),
    ),
)
