"""The panel Parts: a switch and a weight for each part, and the figures of the whole task under these weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from explorer import session_state
from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.weight_figures import WeightFigures
from explorer.compute.worker import Worker
from explorer.panels import messages, pages
from explorer.panels.controls import Controls
from explorer.panels.messages import PartsMessage
from explorer.session_state import MAX_WEIGHT, SessionState, StateChange
from explorer.web.html import Html
from explorer.web.render import render
from explorer.workspace import Workspace
from lpn.analysis.part_weights import (
    WeightEffect,
    combinations_csv,
    part_combinations,
    weights_of,
    why_not,
)
from lpn.drawing.words import speaking
from lpn.tasks.task import Task, scored_key

# Seconds between two looks at a computation.
_INTERVAL = 0.25


class PartsPanel:
    """One browser's parts.

    Its worker starts and follows computations; they end when weights move on, or the browser leaves.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        figures: WeightFigures,
        controls: Controls,
        change: Callable[[StateChange], None],
    ) -> None:
        self._client, self._workspace, self._figures, self._change = client, workspace, figures, change
        gui = client.gui
        gui.add_html(pages.note(pages.PARTS_NOTE))
        for part, name in enumerate(workspace.part_names):
            _bind(controls, "enabled", part, gui.add_checkbox(f"Part {name}", True), lambda value, _: bool(value))
            slider = gui.add_slider(f"Weight {name}", 0.0, MAX_WEIGHT, 0.05, 1.0)
            _bind(controls, "weights", part, slider, lambda value, old: session_state.number(value, 0, MAX_WEIGHT, old))
        gui.add_button("All parts equal").on_click(lambda _: change(session_state.equal_parts))
        self._html = Html(gui)
        self._state: SessionState | None = None
        self._sorted_by: int | None = None
        # The clients of two jobs: the figures of the weights, and those of all combinations.
        self._of_weights, self._of_combinations = object(), object()
        self._wanted: tuple[str, tuple[float, ...]] | None = None
        self._job: BackgroundJob[WeightEffect] | None = None
        self._combinations: BackgroundJob[None] | None = None
        self._combined: tuple[str, ...] = ()
        self._worker = Worker(self._spoken, lambda _: None)

    def show(self, state: SessionState) -> None:
        """Show the figures under the weights of a state, or compute them."""
        self._state = state
        self._worker.wake()

    def receive(self, message: PartsMessage) -> None:
        """Do what a message of the panel asks for; one that means nothing in this state changes nothing."""
        match message:
            case messages.TryCombinations():
                self.try_combinations()
            case messages.StopCombinations():
                self._figures.leave(self._of_combinations)
                self._worker.wake()
            case messages.SaveCombinations():
                self._save()
            case messages.SortCombinations(column):
                self._sorted_by = column
                self._worker.wake()
            case messages.TakeParts(parts) if parts and max(parts) <= self._workspace.contract.n_parts:
                self._change(lambda state: session_state.only_parts(state, parts))

    def try_combinations(self) -> None:
        """Compute the figures of all combinations of parts, in each direction of the task that has figures."""
        state = self._state
        if state is not None and not why_not(task := self._workspace.task_of(state)):
            self._combined = self._directions(task)
            self._combinations = self._figures.join_all(self._of_combinations, self._combined)
            self._worker.wake()

    def leave(self) -> None:
        """Stop all computations of this browser."""
        self._worker.stop()
        self._figures.leave(self._of_weights)
        self._figures.leave(self._of_combinations)

    def _directions(self, task: Task) -> tuple[str, ...]:
        """Return the key of a task, and of the same views the other way round if the workspace has that with figures."""
        query, gallery = task.views
        other = self._workspace.rankings.get(scored_key(f"{gallery}-to-{query}", task.scoring))
        reverse = other is not None and other.task.key != task.key and not why_not(other.task)
        return (task.key, other.task.key) if other is not None and reverse else (task.key,)

    def _spoken(self) -> float | None:
        plain = self._state is not None and self._state.plain
        with speaking(self._workspace.vocabulary(plain)):
            return self._follow()

    def _follow(self) -> float | None:
        """Draw what is known; return the seconds until the next look while something is computed."""
        state = self._state
        if state is None:
            return None
        task = self._workspace.task_of(state)
        if reason := why_not(task):
            self._html.show(render("panels/weights", reason=reason))
            return None
        if self._combined and task.key not in self._combined:  # the table is of another task, or of another scoring
            self._figures.leave(self._of_combinations)
            self._combined, self._combinations = (), None
        values = state.part_values()
        wanted = None if len(set(values)) == 1 else (task.key, values)
        if wanted != self._wanted:
            self._figures.leave(self._of_weights)
            self._wanted, self._job = wanted, None
        effect = None if wanted is None else self._figures.known(*wanted)
        if wanted is not None and effect is None and self._job is None:
            self._job = self._figures.join(self._of_weights, *wanted)
        job, combinations = self._job, self._combinations
        running = effect is None and job is not None and not job.wait(0)
        trying = combinations is not None and not combinations.wait(0)
        if effect is None and job is not None and not running:
            effect = job.value
        rows = self._rows()
        self._html.show(
            render(
                "panels/weights",
                reason="",
                effect=effect,
                job=job if effect is None else None,
                queries=len(task.queries),
                combinations=combinations,
                trying=trying,
                tasks=self._combined,
                rows=rows,
                best=self._best(rows),
                sorted_by=self._sorted_by,
                chosen=tuple(part for part, value in enumerate(values, 1) if value)
                if len({*values} - {0.0}) == 1
                else (),
                part_names=self._workspace.part_names,
            )
        )
        return _INTERVAL if running or trying else None

    def _rows(self) -> list[tuple[tuple[int, ...], list[float | None]]]:
        """Return each combination that was asked for and its figures, R@1 and AP of each task, None until they are known."""
        if not self._combined:
            return []
        n = self._workspace.contract.n_parts
        rows = []
        for parts in part_combinations(n):
            effects = [self._figures.known(task, weights_of(parts, n)) for task in self._combined]
            figures = [value for one in effects for value in ((None, None) if one is None else (one.recall, one.ap))]
            rows.append((parts, figures))
        column = self._sorted_by
        if column is not None and column < 2 * len(self._combined):
            rows.sort(key=lambda row: row[1][column] or 0.0, reverse=True)
        return rows

    def _best(self, rows: list[tuple[tuple[int, ...], list[float | None]]]) -> list[float | None]:
        """Return the highest figure of each column; None while one is missing."""
        columns = zip(*(figures for _, figures in rows), strict=True)
        return [None if None in column else max(value for value in column if value is not None) for column in columns]

    def _save(self) -> None:
        n = self._workspace.contract.n_parts
        table = {}
        for parts in part_combinations(n):
            effects = {task: self._figures.known(task, weights_of(parts, n)) for task in self._combined}
            whole = {task: effect for task, effect in effects.items() if effect is not None}
            if len(whole) == len(effects):
                table[parts] = whole
        if table and self._combined:
            self._client.send_file_download(
                f"parts-{self._combined[0]}.csv", combinations_csv(table), save_immediately=True
            )


def _bind(controls: Controls, field: str, part: int, handle: Any, check: Callable[[Any, Any], Any]) -> None:
    """Bind an input to one part's entry of a tuple in the state."""

    def apply(state: SessionState, value: Any) -> SessionState:
        entries = list(getattr(state, field))
        entries[part] = check(value, entries[part])
        return session_state.with_field(state, field, tuple(entries))

    controls.bind(f"{field} {part}", handle, apply, lambda state: getattr(state, field)[part])
