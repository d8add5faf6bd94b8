"""The private attributes of viser that `viser_compat` relies on, each by name, and the behaviour that it adds."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import viser
import viser._assignable_props_api as viser_properties
import viser.infra._infra as viser_infra
from viser._messages import Message, RunJavascriptMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer

from explorer.server import viser_compat
from explorer.server.message_filter import FIELDS
from explorer.server.viser_compat import SendBuffer
from tools.fixtures.screen_tab import scene_socket

MESSAGES_PER_THREAD = 300
TIMEOUT = 60.0  # seconds for a message that must arrive


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    """A bare viser server."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viser_infra, "AsyncMessageBuffer", AsyncMessageBuffer)
        viser_compat.use_thread_safe_buffers()
        made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        yield made
        made.stop()


@pytest.fixture(scope="module")
def client(server: viser.ViserServer) -> Iterator[viser.ClientHandle]:
    """A connected browser."""
    connected: list[viser.ClientHandle] = []
    arrived = threading.Event()

    def greet(client: viser.ClientHandle) -> None:
        connected.append(client)
        arrived.set()

    server.on_client_connect(greet)
    with scene_socket(f"http://127.0.0.1:{server.get_port()}", ""):
        assert arrived.wait(TIMEOUT)
        yield connected[0]


# Each private attribute, and a condition that it must fulfil.
CONTRACT: dict[str, Callable[[viser.ViserServer, viser.ClientHandle], bool]] = {
    **{
        f"viser._messages.{kind}": lambda *_, kind=kind: viser_compat.message_fields(kind) == FIELDS[kind]
        for kind in FIELDS
    },
    "viser.infra._infra.websockets.asyncio.server.serve": lambda *_: callable(
        viser_infra.websockets.asyncio.server.serve
    ),
    "viser.infra._infra.AsyncMessageBuffer (browser)": lambda _, client: (
        type(client._websock_connection.get_message_buffer()) is SendBuffer
    ),
    "viser.infra._infra.AsyncMessageBuffer (all browsers)": lambda server, _: (
        type(server._websock_server._broadcast_buffer) is SendBuffer
    ),
    "AsyncMessageBuffer.event_loop": lambda *_: "event_loop" in AsyncMessageBuffer.__dataclass_fields__,
    "AsyncMessageBuffer.message_event": lambda *_: "message_event" in AsyncMessageBuffer.__dataclass_fields__,
    "AsyncMessageBuffer._warned_push_after_done": lambda *_: hasattr(AsyncMessageBuffer, "_warned_push_after_done"),
    "AssignablePropsBase._prop_hints": lambda _, client: _keeps_property_types(client),
}


@pytest.mark.parametrize("name", CONTRACT)
def test_viser_has_the_private_attribute(name: str, server: viser.ViserServer, client: viser.ClientHandle) -> None:
    assert CONTRACT[name](server, client), f"viser {viser.__version__} changed {name}"


def _keeps_property_types(client: viser.ClientHandle) -> bool:
    """Tell if elements of one kind share the types of their properties, which are those that viser reads, and take values."""
    with pytest.MonkeyPatch.context() as patch:
        elements = viser_properties.AssignablePropsBase
        patch.setattr(elements, "_prop_hints", elements._prop_hints)  # it is put back
        viser_own = client.gui.add_html("")._prop_hints
        viser_compat.keep_property_types()
        one, other = client.gui.add_html("one"), client.gui.add_html("other")
        shared = one._prop_hints is other._prop_hints and one._prop_hints == viser_own
        one.content = "changed"
    return shared and one.content == "changed"


def test_the_hook_is_called_and_then_removed() -> None:
    infra: Any = viser_infra
    before = infra.websockets
    called: list[object] = []
    with viser_compat.websocket_server_hook(lambda *given: called.append(given)):
        infra.websockets.asyncio.server.serve("handler")
        assert infra.websockets.http11 is before.http11
    assert called == [("handler",)]
    assert infra.websockets is before


def _in_another_thread(action: Callable[[], None]) -> None:
    """Run in another thread while this one, an event loop's, waits."""
    thread = threading.Thread(target=action)
    thread.start()
    thread.join()


async def _arrives(atomic: bool) -> bool:
    """Return whether a message arrives that is sent after the loop saw an unset event and before it adds its waiter."""
    buffer = SendBuffer(asyncio.get_running_loop(), persistent_messages=False)
    event = buffer.message_event
    sent: list[bool] = []

    def send() -> None:
        if atomic:
            buffer.atomic_start()
        buffer.push(RunJavascriptMessage("1"))
        if atomic:
            buffer.atomic_end()

    class SendBeforeAppend(type(event._waiters)):
        def append(self, waiter: object) -> None:
            if not sent:
                sent.append(True)
                _in_another_thread(send)
            super().append(waiter)

    event._waiters = SendBeforeAppend()
    waiting = asyncio.ensure_future(anext(buffer.window_generator(0)))
    done, _ = await asyncio.wait([waiting], timeout=TIMEOUT)
    waiting.cancel()
    assert sent
    return waiting in done


@pytest.mark.parametrize("atomic", [False, True])
def test_a_message_sent_as_the_loop_goes_to_sleep_arrives(atomic: bool) -> None:
    assert asyncio.run(_arrives(atomic))


def test_all_messages_from_many_threads_arrive() -> None:
    async def receive(buffer: SendBuffer) -> list[Message]:
        received: list[Message] = []
        async for window in buffer.window_generator(0):
            received += window
            if len(received) == 4 * MESSAGES_PER_THREAD:
                buffer.done = True
        return received

    async def run() -> list[Message]:
        buffer = SendBuffer(asyncio.get_running_loop(), persistent_messages=False, window_duration_sec=0.0)
        threads = [threading.Thread(target=send, args=(buffer, number)) for number in range(4)]
        for thread in threads:
            thread.start()
        return await asyncio.wait_for(receive(buffer), TIMEOUT)

    def send(buffer: SendBuffer, number: int) -> None:
        for index in range(MESSAGES_PER_THREAD):
            buffer.push(RunJavascriptMessage(f"{number} {index}"))

    assert len(asyncio.run(run())) == 4 * MESSAGES_PER_THREAD
