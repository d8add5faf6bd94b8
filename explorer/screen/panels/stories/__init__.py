"""Stories: steps of the page, each an address with a caption; S adds one. They play full screen, or become one page."""

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
