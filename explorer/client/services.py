"""A workspace, and what is derived from it once for all browsers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from explorer.browse.feeds import Feeds
from explorer.compute.request_context import RequestContext
from explorer.compute.turned_jobs import TurnedJobs
from explorer.compute.weight_figures import WeightFigures
from explorer.failure_lab.service import FailureLab
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService
from explorer.server.picture_route import EncodedPicture
from explorer.url_state import UrlState
from explorer.workspace import Workspace
from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False)
class WorkspaceServices:
    """A workspace, and what is derived from it once for all browsers.

    Attributes:
        failure_lab: computes the failure laboratory's tables.
        url_state: converts states to addresses and back.
        feeds: serves the lists that pages scroll through, and thumbnails.
        flight: derives what flight windows show.
        flight_pictures: serves their pictures.
        weight_figures: computes the figures of whole tasks under part weights.
        turned: computes those with turned queries.
    """

    workspace: Workspace
    failure_lab: FailureLab
    url_state: UrlState
    feeds: Feeds
    flight: FlightService
    flight_pictures: FlightPictures
    weight_figures: WeightFigures
    turned: TurnedJobs

    @classmethod
    def of(cls, workspace: Workspace) -> WorkspaceServices:
        """Derive them from a workspace."""
        queued = RequestContext(workspace.inference).queued(workspace.model, background=True)

        def in_background(key: str) -> Task:
            task = workspace.rankings[key].task
            return (
                task
                if queued is None
                else replace(task, model=workspace.scored_model(queued.for_task(*task.views), task))
            )

        return cls(
            workspace,
            FailureLab(workspace),
            UrlState(workspace),
            Feeds(workspace),
            FlightService(workspace),
            FlightPictures(workspace),
            WeightFigures(lambda key: workspace.rankings[key].task),
            TurnedJobs(in_background),
        )

    def find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return what computes the picture of a path below `PREFIX`, see `PictureSource`."""
        return self.feeds.find(path) or self.flight_pictures.find(path)
