"""viser's server for a page of this app: protected, and closed in a known time."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from typing import Any

import rich
import viser

from explorer.server import viser_compat
from explorer.server.auth import Authenticator
from explorer.server.gateway import Gateway, Screen
from explorer.server.picture_route import PictureRoute
from lpn.core.errors import InputError
from lpn.core.log import conceal
from lpn.core.resources import is_loopback, port_error

# Seconds that closing the server may take; viser waits for its connections, up to six seconds.
CLOSE_TIMEOUT = 1.5


def check_free(host: str, port: int) -> None:
    """Raise InputError if the port is taken; viser would silently use the next one."""
    if problem := port_error(host, port):
        raise InputError(f"{problem}; give another with --port or --host.")


def warn_of_listening(host: str, port: int) -> None:
    """Print the consequences of listening on an address beyond this machine; nothing for a loopback address."""
    if not is_loopback(host):
        print(
            f"Listening on {host}: anyone who reaches port {port} and has the token can use this. The connection is not "
            "encrypted; docs/serving.md says how to change that.",
            flush=True,
        )


def open_server(
    host: str,
    port: int,
    authenticator: Authenticator,
    pictures: PictureRoute,
    screen: Screen,
    embedders: Sequence[str] = (),
) -> tuple[viser.ViserServer, Gateway]:
    """Start viser's server behind the access rules, and return both.

    Args:
        screen, embedders: see `Gateway`.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """
    check_free(host, port)
    conceal(authenticator.token)
    conceal(authenticator.cookie_value)
    gateway = Gateway(authenticator, screen, pictures, embedders)
    viser_compat.use_thread_safe_buffers()
    viser_compat.keep_property_types()
    make = partial(viser.ViserServer, host=host, port=port, label="LPN Explorer", verbose=False)
    with redirect_stdout(io.StringIO()), no_cell_output():  # viser prints an address without the token
        server = gateway.protect(make)
    # Otherwise any page could open a public tunnel to this machine.
    server.request_share_url = _refuse_share  # type: ignore[method-assign]
    server.scene.world_axes.visible = False
    # Pictures and lines need no light. A page with an environment map hides its scene until the map is decoded.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)
    return server, gateway


def close_server(server: viser.ViserServer) -> None:
    """Stop viser's server, and wait for its end, at most `CLOSE_TIMEOUT` seconds."""
    stopping = threading.Thread(target=server.stop, name="explorer-stop", daemon=True)
    with redirect_stdout(io.StringIO()), no_cell_output():
        stopping.start()
        stopping.join(CLOSE_TIMEOUT)


@contextmanager
def no_cell_output() -> Iterator[None]:
    """Let rich write to the standard streams, not into a notebook's cell."""
    console = rich.get_console()
    before, console.is_jupyter = console.is_jupyter, False
    try:
        yield
    finally:
        console.is_jupyter = before


def _refuse_share(*_: Any, **__: Any) -> None:
    return None
