"""The server, and the functions that run it."""

from __future__ import annotations

import gc
import io
import logging
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import viser

from explorer.client_session import ClientSession
from explorer.failure_lab.service import FailureLab
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService
from explorer.opening import open_flight_over, open_model, open_saved
from explorer.server import viser_compat
from explorer.server.auth import Authenticator, is_loopback, make_authenticator
from explorer.server.gateway import Gateway
from explorer.server.picture_route import PictureRoute
from explorer.url_state import UrlState
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.errors import InputError
from lpn.core.log import conceal
from lpn.core.resources import ProviderName, limit_malloc_arenas, port_error, return_memory
from lpn.core.shutdown import writes_finished
from lpn.retrieval.published_results import load_saved

log = logging.getLogger(__name__)

# Seconds that closing the app may take.
_CLOSE_TIMEOUT = 1.5


class App:
    """A running server with one `ClientSession` per browser.

    Args:
        authenticator: the access rules; by default a random token, and none on a loopback address.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """

    def __init__(self, workspace: Workspace, host: str, port: int, authenticator: Authenticator | None = None) -> None:
        _check_free(host, port)
        self.authenticator = authenticator or make_authenticator(host, None, False, ())
        conceal(self.authenticator.token)
        conceal(self.authenticator.cookie_value)
        flight_pictures = FlightPictures(workspace)
        self._pictures = PictureRoute(flight_pictures.find)
        self.gateway = Gateway(self.authenticator, self._pictures)
        viser_compat.use_thread_safe_buffers()
        make = partial(viser.ViserServer, host=host, port=port, label="LPN Explorer", verbose=False)
        with redirect_stdout(io.StringIO()):  # viser prints an address without the token
            self.server = self.gateway.protect(make)
        # Otherwise any page could open a public tunnel to this machine.
        self.server.request_share_url = _refuse_share  # type: ignore[method-assign]
        self.server.scene.world_axes.visible = False
        self._sessions: dict[int, ClientSession] = {}
        failure_lab, url_state, flight = FailureLab(workspace), UrlState(workspace), FlightService(workspace)
        self.server.on_client_connect(
            lambda client: self._connected(client, workspace, failure_lab, url_state, flight, flight_pictures)
        )
        self.server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        """Stop all sessions and the server, and wait for files that are being written, 1.5 seconds at most."""
        until = time.monotonic() + _CLOSE_TIMEOUT
        for session in list(self._sessions.values()):
            session.leave()
        self._pictures.close()
        # viser waits for its connections, up to six seconds.
        stopping = threading.Thread(target=self.server.stop, name="explorer-stop", daemon=True)
        with redirect_stdout(io.StringIO()):
            stopping.start()
            stopping.join(_CLOSE_TIMEOUT)
        if not writes_finished(max(until - time.monotonic(), 0)):
            log.warning("A file is still being written")

    def _connected(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        failure_lab: FailureLab,
        url_state: UrlState,
        flight: FlightService,
        flight_pictures: FlightPictures,
    ) -> None:
        log.info("Browser %d connected", client.client_id)
        self._sessions[client.client_id] = ClientSession(
            client, workspace, failure_lab, url_state, flight, flight_pictures
        )
        if client.client_id not in self.server.get_clients():  # it left while its session was being built
            self._disconnected(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            log.info("Browser %d left", client.client_id)
            session.leave()
            del session
            # Collect the session's reference cycles, pictures included, now; it would take Python minutes.
            gc.collect()
            return_memory()


def run(
    data: Path,
    model: Path,
    query: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    second_model: Path | None = None,
    baseline: Path | None = None,
    authenticator: Authenticator | None = None,
    provider: ProviderName = "auto",
) -> None:
    """Open a model and a data set, print the address of the explorer, and serve it until KeyboardInterrupt.

    Args:
        second_model: a second model for comparisons.
        baseline: a model of one part to offer for comparisons.
        authenticator: the access rules; by default those of `App`.
        provider: what computes the networks, see `lpn.load`.

    Raises:
        LPNError: when model, data set, or address cannot be used.
    """
    _serve(lambda: open_model(data, model, query, second_model, baseline, provider), host, port, authenticator)


def run_flight(
    map_path: Path,
    flight_path: Path,
    model: Path,
    query: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    second_model: Path | None = None,
    register: bool = True,
    authenticator: Authenticator | None = None,
    provider: ProviderName = "auto",
) -> None:
    """Serve a flight over a map like `run`; see `opening.open_flight_over`."""
    _serve(
        lambda: open_flight_over(map_path, flight_path, model, query, second_model, register, provider),
        host,
        port,
        authenticator,
    )


def run_saved(
    data: Path,
    saved: Path,
    n_parts: int = 1,
    query: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    authenticator: Authenticator | None = None,
) -> None:
    """Serve the pictures and descriptors of a `pytorch_result.mat`, whose descriptors have `n_parts` parts, like `run`."""
    _serve(lambda: open_saved(data, load_saved(saved, n_parts), query), host, port, authenticator)


def _serve(open_workspace: Callable[[], Workspace], host: str, port: int, authenticator: Authenticator | None) -> None:
    host = host or "0.0.0.0"
    _check_free(host, port)
    limit_malloc_arenas()
    images.use_all_cores()
    app = App(open_workspace(), host, port, authenticator)
    gc.collect()
    gc.freeze()  # keeps the collection after each disconnect short
    port = app.server.get_port()
    if not is_loopback(host):
        print(
            f"Listening on {host}: anyone who reaches port {port} and has the token can use this. The connection is not "
            "encrypted; docs/serving.md says how to change that.",
            flush=True,
        )
    print(f"LPN Explorer is ready: {app.authenticator.link(port)}  (stop with Ctrl-C)", flush=True)
    try:
        while True:
            time.sleep(3600)
    finally:
        app.close()


def _check_free(host: str, port: int) -> None:
    """Raise InputError if the port is taken; viser would silently use the next one."""
    if problem := port_error(host, port):
        raise InputError(f"{problem}; give another with --port or --host.")


def _refuse_share(*_: Any, **__: Any) -> None:
    return None
