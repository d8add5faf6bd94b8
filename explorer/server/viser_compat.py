"""Lets viser's event loop be woken in its own thread alone.

viser 1.1.1 sets a browser's `asyncio.Event` from whatever thread sends something, and once more from its loop. An event is not
made for that: set at the very moment at which the loop begins to wait for it, it fails ("deque mutated during iteration"), or
leaves the loop waiting with a message unsent, as the second call then finds it set and wakes nobody. The second call alone is
right, and enough.
"""

from __future__ import annotations

import asyncio
import dataclasses
from typing import Any

import viser.infra._infra as viser_infra
from viser.infra._async_message_buffer import AsyncMessageBuffer


class _Event(asyncio.Event):
    """An event that only `loop` sets; a call from elsewhere does nothing."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._owner = loop

    def set(self) -> None:
        """Wake who waits, when called in the loop's own thread."""
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:  # another thread; its message is sent when the loop gets to it
            return
        if running is self._owner:
            super().set()


@dataclasses.dataclass
class Buffer(AsyncMessageBuffer):
    """What waits to be sent to a browser, from any thread."""

    def __post_init__(self) -> None:
        self.message_event = _Event(self.event_loop)


def install() -> None:
    """Have every viser server of this process keep what it sends in a `Buffer`, from its next browser on."""
    infra: Any = viser_infra
    infra.AsyncMessageBuffer = Buffer
