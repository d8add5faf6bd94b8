"""What is sent from another thread reaches the loop without touching what the loop waits for."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from viser._messages import Message, RunJavascriptMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer

from explorer.app import App
from explorer.opening import open_model
from explorer.server.viser_compat import Buffer
from tools.fixtures import small_worlds
from tools.fixtures.websocket_client import Talker

ROUNDS = 300
WAIT = 20.0
"""Seconds in which a message arrives on any machine, unless it never does."""


def _elsewhere(act: Callable[[], None]) -> None:
    """Do it in another thread, with this one (a loop's) standing still meanwhile."""
    thread = threading.Thread(target=act)
    thread.start()
    thread.join()


async def _touched(kind: type[AsyncMessageBuffer]) -> tuple[bool, bool]:
    """Whether a message from another thread ended the loop's wait there and then, and whether it came."""
    buffer = kind(asyncio.get_running_loop(), persistent_messages=False)
    waiting = asyncio.ensure_future(anext(buffer.window_generator(0)))
    while not buffer.message_event._waiters:
        await asyncio.sleep(0)
    _elsewhere(lambda: buffer.push(RunJavascriptMessage("1")))
    touched = any(waiter.done() for waiter in buffer.message_event._waiters)
    came = await asyncio.wait_for(waiting, WAIT)
    return touched, len(came) == 1


def test_another_thread_leaves_the_loops_waiters_alone() -> None:
    assert asyncio.run(_touched(Buffer)) == (False, True)
    assert asyncio.run(_touched(AsyncMessageBuffer)) == (True, True), "viser no longer does what this mends"


async def _not_lost(kind: type[AsyncMessageBuffer], atomic: bool) -> bool:
    """Whether a message comes that another thread sends after the loop saw an unset event and before it queues its waiter."""
    buffer = kind(asyncio.get_running_loop(), persistent_messages=False)
    event = buffer.message_event

    def send() -> None:
        if atomic:
            buffer.atomic_start()
        buffer.push(RunJavascriptMessage("1"))
        if atomic:
            buffer.atomic_end()

    class Late(type(event._waiters)):  # type: ignore[misc]
        def append(self, waiter: object) -> None:
            if not sent:
                sent.append(True)
                _elsewhere(send)
            super().append(waiter)

    sent: list[bool] = []
    event._waiters = Late()
    waiting = asyncio.ensure_future(anext(buffer.window_generator(0)))
    done, _ = await asyncio.wait([waiting], timeout=WAIT if kind is Buffer else 1.0)
    waiting.cancel()
    assert sent
    return waiting in done


@pytest.mark.parametrize("atomic", [False, True])
def test_a_message_sent_as_the_loop_goes_to_sleep_is_not_lost(atomic: bool) -> None:
    assert asyncio.run(_not_lost(Buffer, atomic))
    assert not asyncio.run(_not_lost(AsyncMessageBuffer, atomic)), "viser no longer does what this mends"


def test_messages_from_many_threads_all_come() -> None:
    async def all_of(buffer: Buffer) -> list[Message]:
        came: list[Message] = []
        async for window in buffer.window_generator(0):
            came += window
            if len(came) == 4 * ROUNDS:
                buffer.done = True
        return came

    async def run() -> list[Message]:
        buffer = Buffer(asyncio.get_running_loop(), persistent_messages=False, window_duration_sec=0.0)
        threads = [threading.Thread(target=send, args=(buffer, number)) for number in range(4)]
        for thread in threads:
            thread.start()
        return await asyncio.wait_for(all_of(buffer), WAIT)

    def send(buffer: Buffer, number: int) -> None:
        for index in range(ROUNDS):
            buffer.push(RunJavascriptMessage(f"{number} {index}"))

    assert len(asyncio.run(run())) == 4 * ROUNDS


def test_every_browser_and_all_of_them_have_such_a_buffer(
    model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    places = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=2))
    app = App(open_model(places, model_file), "127.0.0.1", 0)
    try:
        with Talker(f"http://127.0.0.1:{app.server.get_port()}") as talker:
            talker.greet()
            clients = app.server.get_clients().values()
            assert {type(client._websock_connection.get_message_buffer()) for client in clients} == {Buffer}
        assert type(app.server._websock_server._broadcast_buffer) is Buffer
    finally:
        app.close()
