"""The failure laboratory: all queries in a table, in charts, and on maps, beside the rings of the shown query.

`service` computes for all tabs; `selection` has the choices; `table`, `charts`, and `points` make JSON.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.screen.fields import ScreenState
from explorer.screen.fragments import fragment
from explorer.screen.panel import Panel, PanelPart, Tab
from explorer.screen.panels.lab import charts, points, table
from explorer.screen.panels.lab.selection import COLOUR, FIELDS, MAP, PICKED, SECOND, SHOW, TAB, LabSelection, encode
from explorer.screen.panels.lab.service import Lab, LabFindings, PlaneKind, PlanePoints, lab_of, map_kinds
from explorer.workspace import Workspace
from lpn.analysis import embedding_map
from lpn.core import images
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError
from lpn.core.numbers import signed
from lpn.core.texts import counted
from lpn.tasks import notes
from lpn.tasks.notes import Note

# Seconds between two looks at a computation, and the maximum of a lasso's corners.
_POLL = 0.3
_MOST_CORNERS = 300


class LabPart(PanelPart):
    """The laboratory of one tab."""

    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self.actions = {
            "step": self._step,
            "lasso": self._lasso,
            "pick": self._pick,
            "tip": self._tip,
            "note": self._note,
            "tag": self._tag,
            "csv": self._csv,
            "calibrate": self._calibrate,
        }
        self._base, self._feeds, self._closed = tab.base, tab.base.feeds, False
        # The laboratories whose computation this tab joined, and the filter in force.
        self._labs: set[Lab] = set()
        self._where = ""
        self._shown: LabSelection | None = None
        self._ordered: Int64Array = np.zeros(0, np.int64)
        self._points: PlanePoints | None = None
        # The findings with a second model's ranks, and their inputs.
        self._compared: tuple[tuple[object, ...], LabFindings] | None = None
        # The map that this tab has waited for.
        self._map: tuple[Lab, tuple[PlaneKind, str]] | None = None
        # The second model, and its preparation for further scorings.
        self._other: Workspace | None = None
        self._calibrating: tuple[Workspace, BackgroundJob[None]] | None = None
        self._busy: dict[str, Any] = {}
        # Published feeds by name, each with the key of its inputs.
        self._published: dict[str, tuple[object, str]] = {}

    def close(self) -> None:
        """Stop waiting, and serve nothing more."""
        self._closed = True
        self._leave()
        self._feeds.leave(self)

    def _leave(self) -> None:
        for lab in self._labs:
            lab.leave(self)
        for workspace in self._models():
            for ranking in workspace.rankings.values():
                ranking.leave(self)
        if self._calibrating is not None:
            self._calibrating[1].leave(self)

    def show(self) -> None:
        """Send the table of the newest state, and its charts or map; a second model's ranks follow."""
        state, tab = self.tab.state, self.tab
        lab, ranking = lab_of(tab.workspace), tab.ranking
        self._labs.add(lab)
        if self._map is not None and (state[TAB] != "map" or state[MAP] not in ("", self._map[1][0])):
            self._map[0].leave(self, self._map[1])  # the map is out of sight
            self._map = None
        key, queries = ranking.task.key, len(ranking.task.queries)
        findings = lab.findings(key)
        if findings is None:
            if not self._wait(lab.build(key, self), f"Ranking {counted(queries, 'query')}", state):
                return
            findings = lab.findings(key)
        if findings is not None:
            known = self._compared
            first = known[1] if known is not None and known[0][:2] == (findings, state[SECOND]) else findings
            self._draw(state, first, lab)
            try:
                other = self._second(state, findings)
            except LPNError as error:
                self._say(str(error), failed=True)
                return
            if other is not None and other is not first:
                self._draw(state, other, lab)
        if self._closed:  # drawing may have started a computation
            self._leave()

    def _draw(self, state: ScreenState, findings: LabFindings, lab: Lab) -> None:
        selection = LabSelection.of(findings, state, self._where)
        self._where, self._shown = selection.where, selection
        rows, ordered = selection.rows(), selection.ordered()
        self._ordered = ordered
        shown, task = selection.columns(), findings.task
        tiles = self._feeds.thumbnails(task, "tile")
        feed = self._publish(
            "rows",
            (findings, ordered.tobytes(), tuple(shown)),
            lambda name: self._feeds.publish_list(
                self,
                name,
                len(ordered),
                lambda start, end: table.entries(findings, shown, ordered[start:end], tiles),
            ),
        )
        head = table.message(selection, rows) | {
            "feed": feed,
            "address": self._feeds.address,
            "thumbnails": self._feeds.thumbnails(task, "query"),
            "beside": self._labels(state),
        }
        pieces = ("columns", "shown", "help", "error", "counts", "second")
        values = head | {"show": state[SHOW], "chosen": state[SECOND]}
        head["html"] = {piece: fragment("lab/head", piece=piece, **values) for piece in pieces}
        self._send("table", head)
        self._show_query(state, findings, lab)
        if state[TAB] == "charts":
            values = charts.message(selection, rows) | {"tiles": tiles}
            self._send("charts", {"html": fragment("lab/charts", **values)})
        elif state[TAB] == "map":
            self._draw_map(state, selection, rows, lab)

    def _draw_map(self, state: ScreenState, selection: LabSelection, rows: Int64Array, lab: Lab) -> None:
        findings = selection.findings
        kinds = map_kinds(findings.task)
        kind = next((one for one in kinds if one == state[MAP]), next(iter(kinds)))
        self._map = lab, (kind, findings.task.key)
        job = lab.points(kind, findings.task.key, self)
        if not self._wait(job, "Drawing the map", state) or job.value is None:
            return
        found = self._points = job.value
        coloured, picture = points.colours(findings, state[COLOUR]), found.ground
        outcomes, known = findings.outcomes, findings.graded.known[state.query]
        data = {
            "kind": kind,
            "address": self._feeds.address,
            "thumbnails": self._feeds.thumbnails(findings.task, "query"),
            "queries": len(found.queries),
            "plane": self._bytes("plane", found, lambda: points.plane(found)),
            "marks": self._bytes(
                "marks", (findings, state[COLOUR], rows.tobytes()), lambda: points.marks(findings, coloured, rows)
            ),
            "palette": coloured.palette,
            "lines": points.lines(findings, found, rows),
            "ground": points.ground(found),
            "bounds": points.bounds(found),
            "answers": [int(tiles[state.query]) for tiles in (outcomes.answer, outcomes.true) if known],
        }
        colour = state[COLOUR] if state[COLOUR] in findings.table.columns else ""
        values = {"kinds": kinds, "kind": kind, "columns": list(findings.table.columns), "colour": colour}
        legend = points.legend(coloured, rows) | {"axes": found.axes}
        data["html"] = {piece: fragment("lab/map", piece=piece, **values, **legend) for piece in ("maps", "legend")}
        if picture is not None:
            data["picture"] = self._bytes("ground", found, lambda: images.jpeg(picture[0], 85), "image/jpeg")
        self._send("map", data)

    def _show_query(self, state: ScreenState, findings: LabFindings, lab: Lab) -> None:
        """Send the shown query's row and note; an own photo has neither."""
        if state.own:
            self._send("query", {"at": -1, "query": -1, "note": None})
            return
        at, note = np.flatnonzero(self._ordered == state.query), findings.note(state.query)
        saved = {"tags": " ".join(note.tags), "text": note.text, "place": lab.notes_place}
        name = findings.task.queries[state.query].name
        task = findings.task.key
        self._send(
            "query",
            {"at": int(at[0]) if len(at) else -1, "query": state.query, "name": name, "task": task, "note": saved},
        )

    # The second model.

    def _models(self) -> list[Workspace]:
        return [one.workspace for one in self._base.models if one.workspace is not None]

    def _labels(self, state: ScreenState) -> dict[str, str]:
        """Return labels of the models that can be the second one, by their numbers."""
        models = enumerate(self._base.models)
        return {str(number): model.label for number, model in models if str(number) != state.model}

    def _second(self, state: ScreenState, findings: LabFindings) -> LabFindings | None:
        """Wait for the second model's ranks, and return the findings with them; None without them."""
        number = state[SECOND]
        if number not in self._labels(state):
            return None
        model = self._base.models[int(number)]
        opening = model.opening()
        if opening is not None and not self._wait(opening, f"rank B: opening {model.label}", state):
            return None
        other = model.workspace
        assert other is not None
        calibrated, job = self._calibrating or (None, None)
        if job is not None and calibrated is other and not self._wait(job, "rank B: calibrating", state):
            return None
        ranking = other.ranked_as(findings.task)
        if ranking is None:
            raise LPNError(f"{other.model_name} does not know the views of {findings.task.name}; choose another model.")
        if ranking.result is None and not self._wait(ranking.join(self), "rank B: ranking", state):
            return None
        key = findings, number, ranking.task.scoring
        if self._compared is None or self._compared[0] != key:
            names = self.tab.workspace.model_name, other.model_name
            self._compared = key, findings.compared(names, ranking)
            self._other = other
        return self._compared[1]

    def _calibrate(self, _: Mapping[str, Any]) -> None:
        """Prepare the second model's further scorings, so that both models are ranked alike."""
        other = self._other
        job = None if other is None else other.scorings.prepare(self)
        if other is None or job is None:
            self._say("The second model has no other rankings.", failed=True)
            return
        self._calibrating = other, job
        self.tab.set({})

    # Actions of the page.

    def _step(self, arguments: Mapping[str, Any]) -> None:
        """Show the query that is `by` rows further down the table."""
        by = arguments.get("by")
        if isinstance(by, int) and not isinstance(by, bool) and len(self._ordered):
            at = np.flatnonzero(self._ordered == self.tab.state.query)
            place = min(max(int(at[0]) + by, 0), len(self._ordered) - 1) if len(at) else 0
            self.tab.set({"query": int(self._ordered[place])})

    def _lasso(self, arguments: Mapping[str, Any]) -> None:
        """Pick the queries within a lasso on the map."""
        found, corners = self._points, arguments.get("corners")
        if found is None or not isinstance(corners, list) or not 3 <= len(corners) <= _MOST_CORNERS:
            return
        try:
            line = np.array(corners, np.float64).reshape(-1, 2)
        except ValueError:
            return
        if np.isfinite(line).all():
            origin, unit = points.scale(found)
            self._set_picked(embedding_map.inside(found.queries, line * unit + origin))

    def _pick(self, arguments: Mapping[str, Any]) -> None:
        """Pick the queries of chosen rows, given by their positions in the table."""
        rows, listed = arguments.get("rows"), self._ordered
        if isinstance(rows, list) and all(type(row) is int and 0 <= row < len(listed) for row in rows):
            self._set_picked(listed[rows] if rows else listed[:0])

    def _set_picked(self, rows: Int64Array) -> None:
        if self._shown is not None:
            self.tab.set({PICKED.name: encode(rows, self._shown.findings.task) if len(rows) else ""})

    def _tip(self, arguments: Mapping[str, Any]) -> None:
        """Describe a query of the map."""
        query, shown = arguments.get("query"), self._shown
        if shown is None or type(query) is not int or not 0 <= query < len(shown.findings.table):
            return
        findings = shown.findings
        margin = float(findings.outcomes.margin[query])
        rank = findings.table.columns["rank"].text(query)
        verdict = findings.graded.verdict(query)
        sign = "? not graded" if verdict is None else "✓ found" if verdict else f"✗ missed, truth {rank or 'not there'}"
        text = f"{sign}; margin {signed(margin, 2)}" if np.isfinite(margin) else sign
        self._send("tip", {"query": query, "name": findings.task.queries[query].name, "text": text})

    def _note(self, arguments: Mapping[str, Any]) -> None:
        """Save tags and note of a query. A conflict with another user's change is reported; saving again overwrites it."""
        match arguments:
            case {"task": str(task), "query": int(query), "tags": str(tags), "text": str(text), "before": before}:
                lab = lab_of(self.tab.workspace)
                findings = lab.findings(task)
                if findings is None or not 0 <= query < len(findings.table):
                    return
                known = None
                match before:
                    case {"tags": str(old_tags), "text": str(old_text)}:
                        known = Note(tuple(old_tags.split()), old_text)
                self._change(
                    lambda: lab.set_note(findings.table.paths[query], tags, text, known),
                    f"Saved in {lab.notes_place}.",
                    query,
                )

    def _tag(self, arguments: Mapping[str, Any]) -> None:
        """Add tags to all queries of the table."""
        tags, shown = arguments.get("tags"), self._shown
        if shown is not None and isinstance(tags, str):
            paths = [shown.findings.table.paths[row] for row in self._ordered.tolist()]
            lab = lab_of(self.tab.workspace)
            self._change(lambda: lab.add_tags(paths, tags), f"Tagged {counted(len(paths), 'query')}.", -1)

    def _change(self, change: Callable[[], None], done: str, query: int) -> None:
        """Change the notes, and report the outcome; the table follows."""
        try:
            change()
            said: dict[str, Any] = {"text": done, "good": True, "query": query}
        except LPNError as error:
            stored = error.stored if isinstance(error, notes.ChangedNoteError) else None
            newer = None if stored is None else {"tags": " ".join(stored.tags), "text": stored.text}
            said = {"text": f"Not saved. {error}", "good": False, "query": query, "stored": newer}
        self._send("saved", said)
        self.tab.set({})

    def _csv(self, _: Mapping[str, Any]) -> None:
        """Have the page save the table with all columns."""
        shown, rows = self._shown, self._ordered
        if shown is not None:
            findings = shown.findings
            data_name = self._base.data_name
            name = re.sub(r"[^\w-]+", "-", f"{data_name}-{findings.task.name}-{len(rows)}-queries")
            self.tab.download("Table", lambda _: (f"{name}.csv", findings.table.to_csv(rows)))

    # Sending.

    def _wait(self, job: BackgroundJob[Any], text: str, state: ScreenState) -> bool:
        """Wait for a job, and report its progress; False if it failed, or the state is no longer the newest."""
        while not job.wait(_POLL):
            if self._closed or self.tab.state is not state:
                return False
            self._say(text, job.done, job.total)
        failed = "" if job.error is None or job.cancelled else job.error
        self._say(failed, failed=bool(failed))
        return job.error is None

    def _say(self, text: str, done: int = 0, total: int = 0, failed: bool = False) -> None:
        busy = {"text": text, "done": done, "total": total, "failed": failed}
        if busy != self._busy:
            self._busy = busy
            self._send("busy", busy)

    def _send(self, kind: str, message: Mapping[str, Any]) -> None:
        self.tab.append(kind, {kind: message})

    def _publish(self, name: str, key: object, publish: Callable[[str], str]) -> str:
        """Return a feed, published again only if the key of its inputs has changed."""
        known = self._published.get(name)
        if known is None or known[0] != key:
            known = self._published[name] = key, publish(name)
        return known[1]

    def _bytes(self, name: str, key: object, make: Callable[[], bytes], kind: str = "application/octet-stream") -> str:
        return self._publish(name, key, lambda name: self._feeds.publish_bytes(self, name, make, kind)) + "0"


PANEL = Panel("lab", "Laboratory", LabPart, "b", "beside", FIELDS)
