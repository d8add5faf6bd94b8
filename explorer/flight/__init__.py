"""The flight's screen: photos over their map, with the answers of all stages; and live flights.

The rest of the page finds it by the entry point `lpn.panels`, and imports nothing of it.
"""

from explorer.flight.lines import mark, scene_lines
from explorer.flight.part import FIELDS, FlightPart
from explorer.screen.panel import Panel

PANEL = Panel(
    "flight",
    "Flight over its map",
    FlightPart,
    key="w",
    place="full",
    fields=FIELDS,
    offered=lambda workspace: workspace.flight is not None,
    mark=mark,
    lines=scene_lines,
)
