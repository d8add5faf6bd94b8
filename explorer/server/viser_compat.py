"""All uses of viser's private attributes, each behind a named function.

They fit viser 1.1.1. `tests/explorer/server/test_viser_compat.py` names each and fails when viser changes it.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, get_type_hints

import viser._assignable_props_api as viser_properties
import viser._messages as viser_messages
import viser.infra._infra as viser_infra
from viser.infra._async_message_buffer import AsyncMessageBuffer


class _LoopEvent(asyncio.Event):
    """An event that only code running in its own event loop sets; other calls of `set` do nothing."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._owner = loop

    def set(self) -> None:
        """Wake the waiters if the calling thread runs this event's loop."""
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:  # another thread: viser also schedules a call in the loop, which sends its message
            return
        if running is self._owner:
            super().set()


@dataclasses.dataclass
class SendBuffer(AsyncMessageBuffer):
    """A thread-safe queue of messages to one browser.

    viser sets the buffer's `asyncio.Event` from the sending thread, then again from the event loop. The first call is a race: it
    raises "deque mutated during iteration", or sets the event without waking the loop. Then the second call has no effect, and
    the message stays unsent. `_LoopEvent` ignores the first call. A closed connection drops messages without viser's warning.
    """

    def __post_init__(self) -> None:
        self.message_event = _LoopEvent(self.event_loop)
        self._warned_push_after_done = True


def use_thread_safe_buffers() -> None:
    """Make every viser server of this process use `SendBuffer` for browsers that connect from now on."""
    infra: Any = viser_infra
    infra.AsyncMessageBuffer = SendBuffer


@cache
def _property_types(properties: type) -> dict[str, Any]:
    return get_type_hints(properties)


def keep_property_types() -> None:
    """Read the property types of each kind of element once; viser reads them for each element, a millisecond each time."""
    elements: Any = viser_properties.AssignablePropsBase
    elements._prop_hints = property(lambda element: _property_types(element._impl.props.__class__))


def message_fields(kind: str) -> set[str] | None:
    """Return the field names of one of viser's message classes, None if viser has no such class."""
    message = getattr(viser_messages, kind, None)
    return {field.name for field in dataclasses.fields(message)} if dataclasses.is_dataclass(message) else None


def has_websocket_server_hook() -> bool:
    """Return whether `websocket_server_hook` works with this viser."""
    return hasattr(viser_infra, "websockets")


@contextmanager
def websocket_server_hook(serve: Callable[..., Any]) -> Iterator[None]:
    """Have viser call `serve` in place of `websockets.asyncio.server.serve` while the context is open."""
    infra: Any = viser_infra
    websockets = infra.websockets
    server = _Override(websockets.asyncio.server, serve=serve)
    infra.websockets = _Override(websockets, asyncio=_Override(websockets.asyncio, server=server))
    try:
        yield
    finally:
        infra.websockets = websockets


class _Override:
    """A module with some of its attributes replaced."""

    def __init__(self, module: Any, **attributes: Any) -> None:
        self.__dict__.update(attributes)
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)
