"""Search by a region drawn on the photo: the tiles ranked by these cells alone, and the ranks of the truth."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from explorer.parameters import UnusableError
from explorer.screen.fields import FieldKind, PanelField, ScreenState
from explorer.screen.fragments import fragment
from explorer.screen.panel import Panel, PanelPart
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace
from lpn.core.errors import InputError
from lpn.core.texts import ordinal
from lpn.library.analyser import start_search

# Maximum of cells of a feature map, and number of listed tiles.
_MOST, _TILES = 4096, 8
_RUNS = re.compile(r"\d{1,4}(-\d{1,4})?(,\d{1,4}(-\d{1,4})?)*", re.ASCII)


@dataclass(frozen=True)
class CellRuns(FieldKind):
    """Cells of a feature map, row by row: a list of numbers, in an address as runs such as "3-6,19"; empty for none."""

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> tuple[int, ...]:  # noqa: ARG002
        cells: list[Any] = []
        if isinstance(value, str) and _RUNS.fullmatch(value):
            for run in value.split(","):
                first, _, last = run.partition("-")
                cells += range(int(first), min(int(last or first), _MOST) + 1)
        elif isinstance(value, list):
            cells = value
        elif value not in ("", None):
            raise UnusableError("expected numbers of cells, such as 3-6,19.")
        if not all(isinstance(cell, int) and not isinstance(cell, bool) and 0 <= cell < _MOST for cell in cells):
            raise UnusableError(f"expected numbers of cells from 0 to {_MOST - 1:,}.")
        return tuple(sorted(set(cells)))

    def write(self, value: tuple[int, ...], state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        firsts = [cell for cell in value if cell - 1 not in value]
        lasts = [cell for cell in value if cell + 1 not in value]
        return ",".join(f"{a}-{b}" if a < b else str(a) for a, b in zip(firsts, lasts, strict=True))


CELLS: PanelField[tuple[int, ...]] = PanelField("region_cells", CellRuns(), (), "cells", of_query=True)


class _Region(PanelPart):
    def show(self) -> None:
        result = self.tab.result
        if result is not None:
            found = message(result, self.tab.state[CELLS])
            listed = {name: found.pop(name, []) for name in ("said", "tiles")}
            self.tab.send(found | {"html": fragment("region/region", **listed)})


def message(result: ScreenResult, painted: tuple[int, ...]) -> dict[str, Any]:
    """Return the tiles ranked by the painted cells alone, as JSON."""
    analysis, workspace = result.analysis, result.workspace
    trace = analysis.query.trace
    if trace is None:
        return {"why": workspace.without_cells or "This photo has no cells."}
    rows, columns = trace.size
    region = tuple(cell for cell in painted if cell < rows * columns)
    shown: dict[str, Any] = {"rows": rows, "columns": columns, "cells": list(region), "tiles": [], "said": []}
    if not region:
        return shown
    whole = analysis.ranking
    try:
        query = None if result.state.own else result.state.query
        ranking = start_search(result.task, query, analysis.query, region, whole.weights)(whole.weights)
    except InputError as error:  # the region lies outside the parts that count
        return shown | {"said": [str(error)]}
    truth, matches = ranking.positive(), ranking.top(_TILES)
    if truth is not None and truth.rank > _TILES:
        matches = [*matches[:-1], truth]
    address = result.feeds.pictures(result.task, "tile")
    tiles = [
        {
            "index": match.index,
            "name": result.task.gallery[match.index].title,
            "src": f"{address}{match.index}",
            "rank": match.rank,
            "was": whole.find(match.index).rank,
            "true": match.true,
            "distance": f"{match.distance2:.3f}",
        }
        for match in matches
    ]
    said = [f"The tiles by {len(region):,} of {rows * columns:,} cells alone."]
    if truth is not None and (before := whole.positive()) is not None:
        said.append(f"The truth is {ordinal(truth.rank)}, and by the whole photo {ordinal(before.rank)}.")
    lacks = "other cells, constants, and CSLS" if result.task.neighbours else "other cells and constants"
    said.append(f"These distances are without {lacks}, so compare them only with each other.")
    return shown | {"tiles": tiles, "said": said}


PANEL = Panel(
    "region",
    "Search by a region",
    _Region,
    "q",
    "beside",
    (CELLS,),
    lambda workspace: not workspace.without_cells,
)
