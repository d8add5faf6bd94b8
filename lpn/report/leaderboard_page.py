"""The page about several models as a self-contained HTML file, in a report's style."""

from __future__ import annotations

from lpn.analysis.leaderboard import Leaderboard
from lpn.report._rendering import render, style_sheet


def build_leaderboard(leaderboard: Leaderboard) -> bytes:
    """Return the page as UTF-8 HTML, without a script or anything from the network."""
    return render(
        "leaderboard.html.j2",
        title=leaderboard.title,
        sections=list(leaderboard.sections()),
        style=style_sheet(),
    ).encode()
