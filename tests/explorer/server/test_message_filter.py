"""The messages that a browser may send: kinds, shapes, bounds, and rate."""

from __future__ import annotations

import os

import msgspec
import pytest

from explorer.server.message_filter import (
    BURST,
    MAX_TEXT,
    MAX_UPLOAD,
    MAX_UPLOADS,
    RATE,
    MessageFilter,
    RejectedMessageError,
)


def packed(kind: str, **fields: object) -> bytes:
    return msgspec.msgpack.encode({"type": kind, **fields})


def update(value: object) -> bytes:
    return packed("GuiUpdateMessage", uuid="u", updates={"value": value})


def camera(**changed: object) -> bytes:
    fields: dict[str, object] = {
        "wxyz": [1, 0, 0, 0.0],
        "position": [0, 1.5, 2],
        "fov": 1.2,
        "near": 0.1,
        "far": 1000,
        "image_height": 600,
        "image_width": 800,
        "look_at": [0, 0, 0],
        "up_direction": [0, 0, 1],
    }
    return packed("ViewerCameraMessage", **(fields | changed))


def click(**changed: object) -> bytes:
    fields: dict[str, object] = {
        "name": "/tile",
        "instance_index": None,
        "ray_origin": [0, 0, 0],
        "ray_direction": [0, 0, 1],
        "screen_pos": [0.5, 0.5],
        "modifier": None,
        "owner": "client",
    }
    return packed("SceneNodeClickMessage", **(fields | changed))


def start(transfer: str, size: int, parts: int, name: str = "a.png", control: str = "button") -> bytes:
    fields = {
        "source_component_uuid": control,
        "transfer_uuid": transfer,
        "filename": name,
        "mime_type": "",
        "part_count": parts,
    }
    return packed("FileTransferStartUpload", **fields, size_bytes=size)


def part(transfer: str, index: int, content: bytes, control: str = "button") -> bytes:
    return packed(
        "FileTransferPart", source_component_uuid=control, transfer_uuid=transfer, part_index=index, content=content
    )


@pytest.fixture
def messages() -> MessageFilter:
    """The filter of a page whose only upload button has the id "button"."""
    return MessageFilter(lambda uuid: uuid == "button")


@pytest.mark.parametrize(
    "message",
    [*map(update, (True, 3, 0.5, "text", -180)), camera(), click(), click(instance_index=3, modifier="shift")],
)
def test_a_message_of_the_page_passes_unchanged(messages: MessageFilter, message: bytes) -> None:
    passed = messages.read(message)
    assert passed is not None
    assert msgspec.msgpack.decode(passed) == msgspec.msgpack.decode(message)


@pytest.mark.parametrize(
    "message",
    [
        packed("GuiUpdateMessage", uuid="u", updates={"value": 1, "removed": True}),
        packed("GuiUpdateMessage", uuid="u", updates={"visible": False}),
        update(float("nan")),
        update(float("inf")),
        update(1e300),
        update(10**15),
        update([1]),
        update(b"x"),
        update(None),
        update("x" * (MAX_TEXT + 1)),
        packed("GuiUpdateMessage", uuid="u" * 300, updates={"value": 1}),
        packed("GuiUpdateMessage", uuid="u", updates=[]),
        packed("GuiUpdateMessage", uuid="u"),
        packed("CommandTriggerMessage", uuid="u", more=1),
        camera(position=[0, 0]),
        camera(wxyz=["a", None, 1, 2]),
        camera(fov=float("nan")),
        camera(image_height=True),
        click(instance_index=-1),
        click(screen_pos=[0.5]),
        packed("ShareUrlRequest"),
        packed("GuiFormDirtyMessage", uuid="u"),
        packed("RunJavascriptMessage", source="alert(1)"),
        packed("SetCameraFovMessage", fov=1),
        packed("NoMessage"),
        part("unknown", 0, b"x"),
    ],
)
def test_a_message_that_the_page_never_sends_is_dropped(messages: MessageFilter, message: bytes) -> None:
    assert messages.read(message) is None


def test_a_message_of_two_types_is_dropped(messages: MessageFilter) -> None:
    """viser's decoder would take the last type."""
    first, last = packed("CommandTriggerMessage", uuid="u"), packed("GuiFormDirtyMessage")
    assert messages.read(b"\x83" + first[1:] + last[1:]) is None


@pytest.mark.parametrize(
    "message",
    ["text", b"", b"\xc1", os.urandom(999), b"\x91" * 100_000, msgspec.msgpack.encode([1]), msgspec.msgpack.encode({})],
)
def test_bytes_that_are_not_a_message_are_rejected(messages: MessageFilter, message: bytes | str) -> None:
    with pytest.raises(RejectedMessageError):
        messages.read(message)


def test_uploads_are_bounded_in_bytes_parts_and_number(messages: MessageFilter) -> None:
    assert messages.read(start("a", 10, 2)) == start("a", 10, 2)
    assert messages.read(start("a", 10, 2)) is None, "in progress already"
    assert messages.read(part("a", 0, b"x" * 6)) is not None
    assert messages.read(part("a", 1, b"x" * 6)) is None, "more bytes than announced"
    assert MAX_UPLOADS == 2
    assert messages.read(start("b", 10, 1)) is not None
    assert messages.read(start("c", 10, 1)) is None, "a third upload"
    assert messages.read(part("a", 1, b"x" * 4)) is not None
    assert messages.read(part("a", 2, b"")) is None, "complete already"
    for size, parts in ((MAX_UPLOAD + 1, 60), (10**12, 1), (1000, 999), (0, 0), (5, 9)):
        emptied = msgspec.msgpack.decode(messages.read(start("d", size, parts)) or b"")
        assert (emptied["size_bytes"], emptied["part_count"]) == (0, 0)
    named = msgspec.msgpack.decode(messages.read(start("e", 1, 1, "x" * 100_000)) or b"")
    assert len(named["filename"]) == 200


def test_a_part_that_viser_ignores_does_not_complete_an_upload(messages: MessageFilter) -> None:
    assert messages.read(start("a", 10, 2)) is not None
    assert messages.read(part("a", 0, b"x" * 9)) is not None
    for index in (0, 2, 1 << 30):
        assert messages.read(part("a", index, b"")) is None, index
    assert messages.read(part("a", 1, b"x")) is not None
    assert messages.read(start("b", 10, 2)) is not None
    assert messages.read(part("b", 0, b"x")) is not None
    with pytest.raises(RejectedMessageError, match="smaller"):
        messages.read(part("b", 1, b"x"))


def test_only_an_upload_button_accepts_a_file(messages: MessageFilter) -> None:
    assert messages.read(start("a", 1, 1, control="a slider")) is None
    assert messages.read(start("a", 1, 1)) is not None
    assert messages.read(part("a", 0, b"x", "a slider")) is None
    assert messages.read(part("a", 0, b"x")) is not None


def test_messages_beyond_the_rate_wait() -> None:
    now = [0.0]
    messages = MessageFilter(lambda _: False, lambda: now[0])
    assert [messages.delay() for _ in range(int(BURST))] == [0] * int(BURST)
    assert messages.delay() == pytest.approx(1 / RATE)
    now[0] = 10.0
    assert messages.delay() == 0
