"""The server of the page of a flight that goes on."""

from __future__ import annotations

import io
import threading
from contextlib import redirect_stdout
from functools import partial

import viser

from explorer.live_window.record import LiveRecord
from explorer.live_window.window import LiveWindow
from explorer.server import viser_compat
from explorer.server.auth import Authenticator
from explorer.server.gateway import Gateway
from explorer.server.picture_route import PictureRoute
from lpn.core.errors import InputError
from lpn.core.log import conceal
from lpn.core.resources import port_error

# Seconds that closing the server may take.
_CLOSE_TIMEOUT = 1.5


class LiveApp:
    """A running server with one `LiveWindow` per browser.

    Args:
        record: of the flight.
        authenticator: the access rules.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """

    def __init__(self, record: LiveRecord, host: str, port: int, authenticator: Authenticator) -> None:
        if problem := port_error(host, port):
            raise InputError(f"{problem}; give another with --port or --host.")
        self._authenticator, self._record = authenticator, record
        conceal(authenticator.token)
        conceal(authenticator.cookie_value)
        self._pictures = PictureRoute(record.find_picture)
        viser_compat.use_thread_safe_buffers()
        make = partial(viser.ViserServer, host=host, port=port, label="LPN Explorer", verbose=False)
        with redirect_stdout(io.StringIO()):  # viser prints an address without the token
            self.server = Gateway(authenticator, self._pictures).protect(make)
        # Otherwise any page could open a public tunnel to this machine.
        self.server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
        self.server.scene.world_axes.visible = False
        self._windows: dict[int, LiveWindow] = {}
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    @property
    def link(self) -> str:
        """The address that the user opens."""
        return self._authenticator.link(self.server.get_port())

    def close(self) -> None:
        """Stop the server."""
        for window in list(self._windows.values()):
            window.leave()
        self._pictures.close()
        stopping = threading.Thread(target=self.server.stop, name="live-stop", daemon=True)
        with redirect_stdout(io.StringIO()):
            stopping.start()
            stopping.join(_CLOSE_TIMEOUT)

    def _connected(self, client: viser.ClientHandle) -> None:
        self._windows[client.client_id] = LiveWindow(client, self._record)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        if (window := self._windows.pop(client.client_id, None)) is not None:
            window.leave()
