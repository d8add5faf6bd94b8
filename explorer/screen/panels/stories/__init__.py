"""Stories: lists of steps, each an address with a caption; S adds a step. A story plays full screen, or becomes one page."""

from __future__ import annotations

from explorer.screen.panel import Command, Panel
from explorer.screen.panels.stories.part import STORY, StoriesPart, keep

PANEL = Panel(
    "stories",
    "Stories",
    StoriesPart,
    place="beside",
    fields=(STORY,),
    commands=(Command("keep", "Keep this as a step of a story", keep, key="s"),),
)
