"""The server, and the functions that run it."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import viser

from explorer.compute.background_jobs import BackgroundJob
from explorer.parameters import DATA
from explorer.screen import route
from explorer.screen.channel import Channel
from explorer.screen.session import Screens
from explorer.server.auth import Authenticator, make_authenticator
from explorer.server.gateway import SCENE_TAB, Screen
from explorer.server.page_server import (
    CLOSE_TIMEOUT,
    check_free,
    close_server,
    no_cell_output,
    open_server,
    warn_of_listening,
)
from explorer.server.picture_route import EncodedPicture, PictureRoute
from explorer.workspace import LazyWorkspace, Workspace, Workspaces
from lpn.core import images
from lpn.core.resources import limit_malloc_arenas
from lpn.core.served_page import ServedPage
from lpn.core.shutdown import writes_finished

log = logging.getLogger(__name__)

# Pages that may show a page of a notebook: those of this machine, and editors.
_NOTEBOOKS = (
    "http://localhost:*",
    "http://127.0.0.1:*",
    "https://localhost:*",
    "https://127.0.0.1:*",
    "vscode-webview:",
)


class App:
    """A running server with one `ScreenSession` per tab.

    Args:
        workspace: the first workspace of a page; its key in an address is `DATA`.
        authenticator: the access rules; by default a random token, and none on a loopback address.
        label: display name of the workspace beside `others`.
        others: further workspaces that a page can show, by their keys in its address.
        embedders: see `Gateway`.
        stories: the file that keeps stories of all workspaces; by default one beside each data set.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """

    def __init__(
        self,
        workspace: Workspace,
        host: str,
        port: int,
        authenticator: Authenticator | None = None,
        label: str = "",
        others: Mapping[str, LazyWorkspace] | None = None,
        embedders: Sequence[str] = (),
        stories: Path | None = None,
    ) -> None:
        self.authenticator = authenticator or make_authenticator(host, None, False, ())
        self._others, self._lock = others or {}, threading.Lock()
        self._stories = stories
        self._workspaces: dict[str, Workspace] = {}
        self._places = {DATA: label or DATA} | {key: other.label for key, other in self._others.items()}
        self._add(DATA, workspace)
        self._pictures = PictureRoute(self._find_picture)
        self._channel = Channel(Screens(self._workspace, DATA, self._places, self._opening))
        screen = Screen(route.respond, route.scene_of, self._channel.serve)
        self.server, self.gateway = open_server(host, port, self.authenticator, self._pictures, screen, embedders)
        # The tab of each scene, by the id of viser's client.
        self._scenes: dict[int, str] = {}
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnected)

    @property
    def link(self) -> str:
        """The address that the user opens."""
        return self.authenticator.link(self.server.get_port())

    def close(self) -> None:
        """Stop all sessions and the server, and wait for files that are being written, 1.5 seconds at most."""
        until = time.monotonic() + CLOSE_TIMEOUT
        self._channel.close()
        self._pictures.close()
        close_server(self.server)
        if not writes_finished(max(until - time.monotonic(), 0)):
            log.warning("A file is still being written")

    async def _connect(self, client: viser.ClientHandle) -> None:
        """Attach the client of a scene. This is a coroutine, as viser awaits coroutines in the task that has `SCENE_TAB`."""
        tab = SCENE_TAB.get()
        self._scenes[client.client_id] = tab
        self._channel.attach(tab, client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        tab = self._scenes.pop(client.client_id, None)
        if tab is not None:
            self._channel.detach(tab, client)

    def _add(self, key: str, workspace: Workspace) -> None:
        workspace.key, workspace.choices, workspace.opened = key, self._places, self._workspaces.copy
        workspace.stories = self._stories
        self._workspaces[key] = workspace

    def _opening(self, key: str) -> BackgroundJob[Workspace] | None:
        other = self._others.get(key)
        return None if other is None else other.opening()

    def _workspace(self, key: str) -> Workspace:
        """Return an open workspace."""
        with self._lock:
            if key not in self._workspaces:
                workspace = self._others[key].workspace
                assert workspace is not None, key
                self._add(key, workspace)
            return self._workspaces[key]

    def _find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        computes = (workspace.feeds.find(path) for workspace in list(self._workspaces.values()))
        return next((compute for compute in computes if compute is not None), None)


def serve(
    opening: Workspaces,
    host: str = "127.0.0.1",
    port: int = 8080,
    authenticator: Authenticator | None = None,
    stories: Path | None = None,
) -> None:
    """Open a workspace, print the address of the explorer, and serve it until KeyboardInterrupt.

    Args:
        opening: the workspaces of the page; the first is opened once the port is known to be free.
        authenticator: the access rules; by default those of `App`.
        stories: the file that keeps stories, see `App`.

    Raises:
        LPNError: when the workspace cannot be opened, or the address cannot be used.
    """
    host = host or "0.0.0.0"
    app = _start(opening, host, port, authenticator, stories=stories)
    gc.collect()
    gc.freeze()  # keeps the collection after each disconnect short
    warn_of_listening(host, port)
    print(f"LPN Explorer is ready: {app.link}  (stop with Ctrl-C)", flush=True)
    try:
        while True:
            time.sleep(0.5)  # the signal may reach another thread; this one sees it when it wakes
    finally:
        app.close()


def serve_in_background(
    opening: Workspaces,
    host: str = "127.0.0.1",
    port: int = 0,
    authenticator: Authenticator | None = None,
) -> ServedPage:
    """Open a workspace, and serve it until the page is closed or the process ends; see `serve`.

    Args:
        port: 0 for any that is free.

    Raises:
        LPNError: when the workspace cannot be opened, or the address cannot be used.
    """
    with no_cell_output():
        app = _start(opening, host or "0.0.0.0", port, authenticator, _NOTEBOOKS)
    # In a frame of another site's page, a browser sends no cookie, and so no proof of a token.
    return ServedPage(app.link, app.close, framed=app.authenticator.token is None)


def _start(
    opening: Workspaces,
    host: str,
    port: int,
    authenticator: Authenticator | None,
    embedders: Sequence[str] = (),
    stories: Path | None = None,
) -> App:
    check_free(host, port)
    limit_malloc_arenas()
    images.use_all_cores()
    first = opening.open_workspace()
    return App(first, host, port, authenticator, opening.label, opening.others, embedders, stories)
