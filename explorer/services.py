"""A workspace with its feeds and pictures, made once for all browsers."""

from __future__ import annotations

from dataclasses import dataclass

from explorer.feeds import Feeds
from explorer.workspace import Workspace


@dataclass(frozen=True, eq=False)
class WorkspaceServices:
    """A workspace, and everything that is derived from it once for all browsers.

    Attributes:
        feeds: serves the lists that pages scroll through, and pictures.
    """

    workspace: Workspace
    feeds: Feeds

    @classmethod
    def of(cls, workspace: Workspace) -> WorkspaceServices:
        """Derive the services of a workspace."""
        return cls(workspace, Feeds(workspace))
