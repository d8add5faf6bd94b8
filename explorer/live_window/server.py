"""The server of the page of a flight that goes on."""

from __future__ import annotations

import viser

from explorer.live_window.record import LiveRecord
from explorer.live_window.window import LiveWindow
from explorer.server.auth import Authenticator
from explorer.server.page_server import close_server, open_server
from explorer.server.picture_route import PictureRoute


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
        self._authenticator, self._record = authenticator, record
        self._pictures = PictureRoute(record.find_picture)
        self.server, _ = open_server(host, port, authenticator, self._pictures)
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
        close_server(self.server)

    def _connected(self, client: viser.ClientHandle) -> None:
        self._windows[client.client_id] = LiveWindow(client, self._record)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        if (window := self._windows.pop(client.client_id, None)) is not None:
            window.leave()
