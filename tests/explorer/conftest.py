"""What the screen computes, asked for without a server."""

from __future__ import annotations

from queue import Queue
from typing import Any

from explorer.screen.fields import needs_answer
from explorer.screen.result import ScreenResult
from explorer.screen.session import Screens, ScreenSession
from explorer.services import WorkspaceServices
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
            if own and not session.state.own:  # it was refused, which a message says
                continue
            result = session.result
            if "result" in message and result is not None and not needs_answer(result.state, session.state):
                return result
    finally:
        session.leave()
