"""A browser without a browser: speaks viser's protocol with the running app over a websocket, and sends what no page would."""

from __future__ import annotations

import html
import json
import re
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CHUNK = 512 * 1024
_ID = re.compile(r"id='(lpn-[a-z-]+)'")
_ADDRESS = re.compile(r'onload="Function\((&quot;lpn\.address[^"]*)\)\(\)"')


class Talker:
    """One connection.

    Attributes:
        controls: each control's latest properties by its uuid.
        elements: the latest html of what has an id of the app's own, such as lpn-status, by that id.
        link: the query that the page's address was last set to, None before the first answer.
        links: all of these in the order in which they came; who reads them may empty the list.
        statuses: status lines in the order in which they came; who reads them may empty the list.
        notices: titles and texts of notifications.
        kinds: of all messages that came.
        heard: when the last messages came, by `time.monotonic`.
        closed: set when the connection ends.

    Args:
        url: of the page, http://...
        **options: of `websockets.sync.client.connect`, such as origin and additional_headers.
    """

    def __init__(self, url: str, **options: Any) -> None:
        place = url.replace("http://", "ws://", 1)
        protocol: Any = [f"viser-v{viser.__version__}"]
        self._socket = connect(place, subprotocols=protocol, max_size=None, compression=None, **options)
        self.controls: dict[str, dict[str, Any]] = {}
        self.elements: dict[str, str] = {}
        self.link: str | None = None
        self.links: list[str] = []
        self.statuses: list[str] = []
        self.notices: list[tuple[str, str]] = []
        self.kinds: list[str] = []
        self.heard = time.monotonic()
        self.closed = threading.Event()
        self._heard = threading.Condition()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def __enter__(self) -> Talker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Say goodbye as a browser does whose tab is closed."""
        self._socket.close()
        self._thread.join(5)

    def abort(self) -> None:
        """Be gone without a word, as a machine that is switched off whose system still says so."""
        own = self._socket.socket
        with suppress(OSError):  # it was the server that went first
            own.setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
            )  # a reset in place of a farewell
            own.shutdown(socket.SHUT_RDWR)
            own.close()
        self._thread.join(5)

    def greet(self, query: str = "") -> Talker:
        """Be taken for a browser: a first camera, then the page's hello; waits for the first answer."""
        self.camera()
        self.wait(lambda: self.find("page") is not None)
        self.tell("hello", {"search": query, "small": False})
        self.wait(lambda: int(self.status("seq") or 0) > 0)
        return self

    def camera(self, **changed: Any) -> None:
        """Say where the camera stands."""
        fields: dict[str, Any] = {
            "wxyz": [1.0, 0.0, 0.0, 0.0],
            "position": [0.0, 0.0, 5.0],
            "fov": 0.8,
            "near": 0.01,
            "far": 1000.0,
            "image_height": 800,
            "image_width": 1200,
            "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, 1.0, 0.0],
        }
        self.send("ViewerCameraMessage", **{**fields, **changed})

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message of viser's protocol, whatever is in it."""
        self.raw(msgspec.msgpack.encode({"type": kind, **fields}))

    def raw(self, data: bytes | str) -> None:
        """Send a frame."""
        self._socket.send(data)

    def set(self, label: str, value: Any, prop: str = "value") -> None:
        """Set a control, or another attribute of it."""
        uuid = self.find(label)
        assert uuid is not None, label
        self.send("GuiUpdateMessage", uuid=uuid, updates={prop: value})

    def tell(self, kind: str, value: Any) -> None:
        """Send a message of the page's own script."""
        self.set("page", msgspec.json.encode({"kind": kind, "value": value, "at": time.monotonic()}).decode())

    def upload(self, name: str, content: bytes, size: int | None = None, transfer: str = "transfer") -> None:
        """Send a file as the page does."""
        parts = [content[at : at + CHUNK] for at in range(0, len(content), CHUNK)]
        self._announce(name, len(content) if size is None else size, len(parts), transfer)
        for index, part in enumerate(parts):
            self.part(index, part, transfer)

    def begin_upload(self, name: str, size: int, parts: int) -> None:
        """Send the first of several parts of a file, of `size` bytes each."""
        self._announce(name, parts * size, parts, name)
        self.part(0, bytes(size), name)

    def _announce(self, name: str, size: int, parts: int, transfer: str) -> None:
        self.send(
            "FileTransferStartUpload",
            source_component_uuid=self.find("Use my own picture"),
            transfer_uuid=transfer,
            filename=name,
            mime_type="image/png",
            part_count=parts,
            size_bytes=size,
        )

    def part(self, index: int, content: bytes, transfer: str = "transfer") -> None:
        """Send one part of a file."""
        button = self.find("Use my own picture")
        self.send(
            "FileTransferPart", source_component_uuid=button, transfer_uuid=transfer, part_index=index, content=content
        )

    def find(self, label: str) -> str | None:
        """The uuid of a control."""
        return next((uuid for uuid, props in list(self.controls.items()) if props.get("label") == label), None)

    def html(self) -> str:
        """All html that is in the page."""
        return "\n".join(str(props["content"]) for props in list(self.controls.values()) if "content" in props)

    def status(self, name: str) -> str | None:
        """An attribute of the status line."""
        found = re.search(rf"id='lpn-status'[^>]*? data-{name}='([^']*)'", self.elements.get("lpn-status", ""))
        return found[1] if found else None

    def wait(self, holds: Callable[[], bool], seconds: float = 30.0) -> None:
        """Until something holds."""
        with self._heard:
            assert self._heard.wait_for(holds, seconds), f"waited {seconds} s; status: {self.html()[-2000:]}"

    def until(self, holds: Callable[[], bool], seconds: float) -> bool:
        """Whether something holds within some seconds; a connection that ends is waited for no longer."""
        with self._heard:
            return bool(self._heard.wait_for(lambda: holds() or self.closed.is_set(), seconds)) and holds()

    def gone(self, seconds: float = 10.0) -> bool:
        """Whether the server closes the connection."""
        return self.closed.wait(seconds)

    def _listen(self) -> None:
        try:
            while True:
                self._take(self._socket.recv())
        except (ConnectionClosed, OSError):
            pass
        finally:  # also when what came cannot be read: it would be waited for in vain
            with self._heard:
                self.closed.set()
                self._heard.notify_all()

    def _take(self, data: bytes | str) -> None:
        assert isinstance(data, bytes)
        length = int.from_bytes(data[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + length], int.from_bytes(data[:8], "little"))
        with self._heard:
            self.heard = time.monotonic()
            for message in msgspec.msgpack.decode(inner)["messages"]:
                self.kinds.append(message["type"])
                if message["type"] == "GuiUpdateMessage":
                    self._show(message["uuid"], message["updates"])
                elif "props" in message and "uuid" in message:
                    props = dict(message["props"])
                    if "value" in message:
                        props["value"] = message["value"]
                    self._show(message["uuid"], props)
                    if message["type"] == "NotificationShowMessage":
                        self.notices.append((str(props.get("title")), str(props.get("body"))))
            self._heard.notify_all()

    def _show(self, uuid: str, props: dict[str, Any]) -> None:
        self.controls.setdefault(uuid, {}).update(props)
        content = props.get("content")
        if not isinstance(content, str):
            return
        for name in _ID.findall(content):
            self.elements[name] = content
            if name == "lpn-status":
                self.statuses.append(content)
        if found := _ADDRESS.search(content):
            call = json.loads(html.unescape(found[1]))
            self.link = json.JSONDecoder().raw_decode(call, len("lpn.address("))[0]
            self.links.append(str(self.link))
