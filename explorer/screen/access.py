"""One tab's access to the objects that its state names: workspaces of place and model, the network, and the ranking."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.screen.fields import ScreenState
from explorer.screen.rail import ranks_of
from explorer.workspace import Workspace, WorkspaceAnalyser


@dataclass(frozen=True, eq=False)
class Opened:
    """A model's workspace with this tab's access to its network.

    Attributes:
        requests: the context of the awaited answer.
        background: the context of all background work.
    """

    workspace: Workspace
    requests: RequestContext
    background: RequestContext
    analyser: WorkspaceAnalyser


class Access:
    """Finds the objects that states name.

    Args:
        workspaces: returns the workspace of an open place by its key.
    """

    def __init__(self, workspaces: Callable[[str], Workspace]) -> None:
        self._workspaces, self._lock = workspaces, threading.Lock()
        self._opened: dict[Workspace, Opened] = {}

    def base(self, state: ScreenState) -> Workspace:
        """Return the workspace of a state's place, which must be open."""
        return self._workspaces(state.place)

    def workspace(self, state: ScreenState) -> Workspace:
        """Return the workspace of the state's model, or the place's workspace until the model is open."""
        base = self.base(state)
        return base.models[int(state.model)].workspace or base

    def ranking(self, state: ScreenState) -> RankingJob:
        """Return the ranking of the state's task, model, and scoring, or a replacement for a missing task or scoring."""
        workspace = self.workspace(state)
        name = state.task if state.task in workspace.tasks else next(iter(workspace.tasks))
        return workspace.ranking(name, state.scoring)

    def opened(self, state: ScreenState) -> Opened:
        """Return the workspace of the state's model with access to its network."""
        workspace = self.workspace(state)
        with self._lock:
            if workspace not in self._opened:
                requests, background = RequestContext(workspace.inference), RequestContext(workspace.inference)
                analyser = WorkspaceAnalyser(workspace, requests.queued(workspace.model))
                self._opened[workspace] = Opened(workspace, requests, background, analyser)
            return self._opened[workspace]

    def ranks_beside(self, state: ScreenState) -> list[tuple[str, int]]:
        """Return the label of each further model that has ranked the query, with the rank of the unturned query."""
        ranks = []
        for number, model in enumerate(self.base(state).models):
            workspace = model.workspace
            if workspace is not None and str(number) != state.model and state.task in workspace.tasks:
                ranking = self.ranking(replace(state, model=str(number)))
                rank = int(ranks_of(workspace, ranking)[state.query])
                ranks += [(model.label, rank)] if rank else []
        return ranks

    def opening(self, state: ScreenState) -> BackgroundJob[Workspace] | None:
        """Return the job that opens the state's model; None if it is open."""
        return self.base(state).models[int(state.model)].opening()

    def close(self) -> None:
        """Cancel the tab's requests."""
        with self._lock:
            for opened in self._opened.values():
                opened.requests.close()
                opened.background.close()
