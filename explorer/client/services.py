"""A workspace, and what is derived from it once for all browsers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from explorer.browse.feeds import Feeds
from explorer.failure_lab.service import FailureLab
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService
from explorer.server.picture_route import EncodedPicture
from explorer.workspace import Workspace


@dataclass(frozen=True, eq=False)
class WorkspaceServices:
    """A workspace, and what is derived from it once for all browsers.

    Attributes:
        failure_lab: computes the failure laboratory's tables.
        feeds: serves the lists that pages scroll through, and thumbnails.
        flight: derives what flight windows show.
        flight_pictures: serves their pictures.
    """

    workspace: Workspace
    failure_lab: FailureLab
    feeds: Feeds
    flight: FlightService
    flight_pictures: FlightPictures

    @classmethod
    def of(cls, workspace: Workspace) -> WorkspaceServices:
        """Derive them from a workspace."""
        return cls(
            workspace, FailureLab(workspace), Feeds(workspace), FlightService(workspace), FlightPictures(workspace)
        )

    def find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return what computes the picture of a path below `PREFIX`, see `PictureSource`."""
        return self.feeds.find(path) or self.flight_pictures.find(path)
