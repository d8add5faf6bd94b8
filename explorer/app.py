"""The server, and the functions that run it."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future

import viser

from explorer.browse.own_pictures import HandedOver
from explorer.client.services import WorkspaceServices
from explorer.client.session import ClientSession
from explorer.parameters import DATA
from explorer.screen import route
from explorer.screen.channel import Channel
from explorer.screen.session import Screens
from explorer.server.auth import Authenticator, make_authenticator
from explorer.server.gateway import SCENE_TAB, Screen
from explorer.server.page_server import CLOSE_TIMEOUT, check_free, close_server, no_cell_output, open_server
from explorer.server.picture_route import EncodedPicture, PictureRoute
from explorer.server.viser_compat import thread_pool
from explorer.web.bridge import clear_stage
from explorer.workspace import LazyWorkspace, StateAnalysis, Workspace
from lpn.core import images
from lpn.core.errors import InputError
from lpn.core.resources import is_loopback, limit_malloc_arenas, return_memory
from lpn.core.served_page import ServedPage
from lpn.core.shutdown import writes_finished

log = logging.getLogger(__name__)

# Seconds that a workspace may take to open before a page says so.
_UNNOTICED = 0.4
# Pages that may show a page of a notebook: those of this machine, and editors.
_NOTEBOOKS = (
    "http://localhost:*",
    "http://127.0.0.1:*",
    "https://localhost:*",
    "https://127.0.0.1:*",
    "vscode-webview:",
)


class App:
    """A running server with one `ScreenSession` per tab at `/`, and one `ClientSession` per browser at `/classic/`.

    Args:
        workspace: what a page shows first.
        authenticator: the access rules; by default a random token, and none on a loopback address.
        label: display name of the workspace beside `others`.
        others: further workspaces that a page can show, by their keys in its address.
        embedders: see `Gateway`.
        key: that of `workspace`. An address that names a picture and no workspace is one of the workspace `DATA`.

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
        key: str = DATA,
    ) -> None:
        self.authenticator = authenticator or make_authenticator(host, None, False, ())
        self._others, self._lock = others or {}, threading.Lock()
        self._changing: set[int] = set()
        self._opens_quick = False
        self._services: dict[str, WorkspaceServices] = {}
        self._choices = {key: label} | {key: other.label for key, other in self._others.items()} if others else {}
        self._first = self._add(key, workspace)
        self._pictures = PictureRoute(self._find_picture)
        places = {one: name or one for one, name in (self._choices or {key: label}).items()}
        home = DATA if DATA in places else key
        if home in self._others:  # it shall be open when the first page comes
            self._others[home].open()
        self._channel = Channel(Screens(self._services_of, home, places))
        screen = Screen(route.respond, route.scene_of, self._channel.serve)
        self.server, self.gateway = open_server(host, port, self.authenticator, self._pictures, embedders, screen)
        self._sessions: dict[int, ClientSession] = {}
        # The tabs whose scenes viser's clients are.
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
        for session in list(self._sessions.values()):
            session.leave()
        self._channel.close()
        self._pictures.close()
        close_server(self.server)
        if not writes_finished(max(until - time.monotonic(), 0)):
            log.warning("A file is still being written")

    async def _connect(self, client: viser.ClientHandle) -> None:
        """Begin the session of a browser; viser runs a coroutine where the tab of a scene is known."""
        tab = SCENE_TAB.get()
        if tab is None:
            begun = thread_pool(client.gui).submit(self._connected, client)
            begun.add_done_callback(_log_error)
        else:
            self._scenes[client.client_id] = tab
            self._channel.attach(tab, client)

    def _connected(self, client: viser.ClientHandle) -> None:
        log.info("Browser %d connected", client.client_id)
        # viser never forgets a camera's callback, so it belongs to the browser and not to a session.
        client.camera.on_update(lambda _: self._fit_camera(client.client_id))
        self._begin(client, self._first)

    def _begin(
        self,
        client: viser.ClientHandle,
        services: WorkspaceServices,
        search: str | None = None,
        replaced: ClientSession | None = None,
        ready: StateAnalysis | None = None,
        own: HandedOver | None = None,
    ) -> ClientSession:
        left, before = (None, None) if replaced is None else (replaced.left, replaced.kept)
        session = ClientSession(client, services, self._show_other, search, self._open_quick, ready, own, left, before)
        with self._lock:
            if self._sessions.get(client.client_id) is replaced:  # else its page has changed its workspace already
                self._sessions[client.client_id] = session
        session.fit_camera()  # the window may have been resized before the session was listed
        if client.client_id not in self.server.get_clients():  # it left while its session was being built
            self._disconnected(client)
            session.leave()  # it may not have been listed
        return session

    def _open_quick(self) -> None:
        """Open the workspaces that take about a second, one after the other, so that they are there when somebody asks."""
        quick = [other for other in self._others.values() if other.quick and not other.asked]

        def open_each() -> None:
            for other in quick:
                other.open().wait(threading.TIMEOUT_MAX)

        if quick and not self._opens_quick:
            self._opens_quick = True
            threading.Thread(target=open_each, name="explorer-open", daemon=True).start()

    def _fit_camera(self, client_id: int) -> None:
        session = self._sessions.get(client_id)
        if session is not None:
            session.fit_camera()

    def _add(self, key: str, workspace: Workspace) -> WorkspaceServices:
        """Return the services of a workspace, made once."""
        if key not in self._services:
            workspace.key, workspace.choices, workspace.opened = key, self._choices, self._open_workspaces
            self._services[key] = WorkspaceServices.of(workspace)
        return self._services[key]

    def _services_of(self, key: str) -> WorkspaceServices:
        """Return the services of a workspace, once it is open; InputError if it cannot be opened."""
        if key not in self._services:
            other = self._others[key]
            other.open().wait(threading.TIMEOUT_MAX)
            if other.workspace is None:
                raise InputError(f"{other.label} cannot be opened: {other.error}")
            with self._lock:
                self._add(key, other.workspace)
        return self._services[key]

    def _open_workspaces(self) -> dict[str, Workspace]:
        shown = {key: services.workspace for key, services in list(self._services.items())}
        return {key: one.workspace for key, one in self._others.items() if one.workspace is not None} | shown

    def _find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        computes = (services.find_picture(path) for services in list(self._services.values()))
        return next((compute for compute in computes if compute is not None), None)

    def _show_other(self, session: ClientSession, key: str, search: str) -> None:
        threading.Thread(target=self._replace, args=(session, key, search), name="explorer-show", daemon=True).start()

    def _replace(self, session: ClientSession, key: str, search: str) -> None:
        """Show a workspace in the page of a session, unless another change of that page goes on."""
        client_id = session.client.client_id
        with self._lock:
            # The page may ask before its session is listed.
            if client_id in self._changing or self._sessions.setdefault(client_id, session) is not session:
                return
            self._changing.add(client_id)
        try:
            if self._opened(session, key):
                self._exchange(session, key, search)
        finally:
            self._changing.discard(client_id)

    def _opened(self, session: ClientSession, key: str) -> bool:
        """Wait until a workspace is open; False if it cannot be opened, which the page says, or the browser has left."""
        if key in self._services:
            return True
        other = self._others[key]
        job = other.open()
        if not job.wait(_UNNOTICED):
            notice = session.wait_for(other.label)
            while not job.wait(0.5):
                if job.total:
                    session.views.bridge.work(job.done, job.total)
                    notice.body = f"{job.done:,} of {job.total:,} pictures are described; this page goes on until then."
                if session.client.client_id not in self.server.get_clients():
                    return False
            notice.remove()
            session.views.bridge.work(0, 0)
        if other.workspace is None:
            session.stay(other.label, other.error)
            return False
        with self._lock:
            self._add(key, other.workspace)
        return True

    def _exchange(self, session: ClientSession, key: str, search: str) -> None:
        """Replace a session by one of another workspace, as if the page had been loaded again; own pictures stay."""
        client = session.client
        if self._sessions.get(client.client_id) is not session:
            return
        own = session.hand_over()
        session.end()
        try:
            ready = session.preview(self._services[key], search)
            _clear(client)
            self._begin(client, self._services[key], search, session, ready, own)
        except Exception:
            log.exception("A page could not change its workspace")
            _clear(client)
            again = self._begin(client, self._first, "", session, own=own)
            again.stay(self._choices[key], "The server's log has the details.")

    def _disconnected(self, client: viser.ClientHandle) -> None:
        tab = self._scenes.pop(client.client_id, None)
        if tab is not None:
            self._channel.detach(tab, client)
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            log.info("Browser %d left", client.client_id)
            session.leave()
            del session
            # Collect the session's reference cycles, pictures included, now; it would take Python minutes.
            gc.collect()
            return_memory()


def _log_error(begun: Future[None]) -> None:
    if begun.exception() is not None:
        log.error("A browser's session could not begin", exc_info=begun.exception())


def _clear(client: viser.ClientHandle) -> None:
    """Remove all that a session shows in its page, which keeps its theme, and the places of the stage's pictures."""
    client.gui.reset()
    clear_stage(client.gui)
    client.scene.reset()


def serve(
    open_workspace: Callable[[], Workspace],
    host: str = "127.0.0.1",
    port: int = 8080,
    authenticator: Authenticator | None = None,
    others: Mapping[str, LazyWorkspace] | None = None,
    label: str = "",
    key: str = DATA,
) -> None:
    """Open a workspace, print the address of the explorer, and serve it until KeyboardInterrupt.

    Args:
        open_workspace: one of the functions of `opening`; called once the port is known to be free.
        authenticator: the access rules; by default those of `App`.
        others: workspaces that a page offers beside it, by the keys that an address gives them.
        label, key: of the workspace beside them, see `App`.

    Raises:
        LPNError: when the workspace cannot be opened, or the address cannot be used.
    """
    host = host or "0.0.0.0"
    app = _start(open_workspace, host, port, authenticator, others, label, key)
    gc.collect()
    gc.freeze()  # keeps the collection after each disconnect short
    if not is_loopback(host):
        print(
            f"Listening on {host}: anyone who reaches port {port} and has the token can use this. The connection is not "
            "encrypted; docs/serving.md says how to change that.",
            flush=True,
        )
    print(f"LPN Explorer is ready: {app.link}  (stop with Ctrl-C)", flush=True)
    try:
        while True:
            time.sleep(
                0.5
            )  # a thread at work may take the signal that stops this one, which then sees it when it wakes
    finally:
        app.close()


def serve_in_background(
    open_workspace: Callable[[], Workspace],
    host: str = "127.0.0.1",
    port: int = 0,
    authenticator: Authenticator | None = None,
    others: Mapping[str, LazyWorkspace] | None = None,
    label: str = "",
    key: str = DATA,
) -> ServedPage:
    """Open a workspace, and serve it until the page is closed or the process ends; see `serve`.

    Args:
        port: 0 for any that is free.

    Raises:
        LPNError: when the workspace cannot be opened, or the address cannot be used.
    """
    with no_cell_output():
        app = _start(open_workspace, host or "0.0.0.0", port, authenticator, others, label, key, _NOTEBOOKS)
    # A browser sends no cookie, so no proof of a token, from a frame in another site's page.
    return ServedPage(app.link, app.close, framed=app.authenticator.token is None)


def _start(
    open_workspace: Callable[[], Workspace],
    host: str,
    port: int,
    authenticator: Authenticator | None,
    others: Mapping[str, LazyWorkspace] | None,
    label: str,
    key: str,
    embedders: Sequence[str] = (),
) -> App:
    check_free(host, port)
    limit_malloc_arenas()
    images.use_all_cores()
    return App(open_workspace(), host, port, authenticator, label, others, embedders, key)
