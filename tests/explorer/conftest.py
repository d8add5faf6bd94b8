"""What the screen computes, asked for without a server."""

from __future__ import annotations

from queue import Queue
from typing import Any

from explorer.client.services import WorkspaceServices
from explorer.screen.result import ScreenResult
from explorer.screen.session import Screens, ScreenSession
from explorer.workspace import Workspace
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"


class RefusedError(Exception):
    """The sentence that the page shows in place of a result."""


def answered(workspace: Workspace, search: str = "", own: bytes = b"", **fields: object) -> ScreenResult:
    """Return the result of a page's address, after an own photo was sent and some fields were set.

    Raises:
        RefusedError: with the sentence that the page shows instead.
    """
    services, messages = WorkspaceServices.of(workspace), Queue[dict[str, Any]]()
    screens = Screens(lambda _: services, workspace.key, {workspace.key: workspace.data_name})
    session = ScreenSession(screens, messages.put)
    try:
        session.receive({"do": "open", "args": {"search": search}})
        if own:
            session.receive({"do": "upload", "args": {"name": "mine.png", "size": len(own)}})
            session.receive_bytes(own)
        if fields:
            session.receive({"set": fields})
        while True:
            message = messages.get(timeout=TIMEOUT)
            if "error" in message:
                raise RefusedError(message["error"])
            if "result" in message and message["result"]["state"] == session.state.values():
                assert session.result is not None
                return session.result
    finally:
        session.leave()
