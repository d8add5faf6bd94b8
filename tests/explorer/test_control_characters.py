"""Names, metadata, and notes that hold commands for a terminal or turn the writing around: the page is sent none of them."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zstandard
from explorer.web.render import call

from explorer.app import App
from explorer.opening import open_model
from lpn.core.files import TYPED, printable
from lpn.tasks import notes
from tools.fixtures import small_worlds
from tools.fixtures.websocket_client import WebSocketClient

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems allow few of these names")

EVIL = "\x1b[31m\x1b]0;title\x07\x9b31m\x7f\x08\u202egpj\u2066\u2069\u2028\u2029"
_ESCAPE = re.compile(r"\\+u(?!d[89a-f])([0-9a-fA-F]{4})")


def texts(value: Any) -> Iterator[str]:
    """All texts of a message, with the characters that its scripts escape."""
    if isinstance(value, str):
        yield _ESCAPE.sub(lambda escape: chr(int(escape[1], 16)), value)
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield from texts(key)
            yield from texts(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from texts(entry)


class Listener(WebSocketClient):
    """A client that keeps all texts."""

    def _take(self, data: bytes | str) -> None:
        assert isinstance(data, bytes)
        inner = zstandard.ZstdDecompressor().decompress(data[16:], int.from_bytes(data[:8], "little"))
        self.texts: list[str] = getattr(self, "texts", [])
        self.texts += texts(msgspec.msgpack.decode(inner)["messages"])
        super()._take(data)


def test_no_message_to_a_page_holds_any(tmp_path: Path, model_file: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "new", train=1, test=4).rename(tmp_path / f"places{EVIL}")
    lines = [f"path,weather,b{EVIL}"]
    for query in sorted((root / "test").glob("query_*/*/*.png")):
        renamed = query.rename(query.with_name(f"{query.stem}{EVIL}.png"))
        lines.append(f'"{renamed.relative_to(root).as_posix()}","rain{EVIL}",1')
    (root / "metadata.csv").write_text("\n".join(lines) + "\n")
    (root / notes.NAME).write_text(f'path,tags,note\n"{lines[1].split(chr(34))[1]}",night,"typed \u200f(1){EVIL}"\n')
    model = Path(shutil.copy(model_file, tmp_path / f"model{EVIL}.onnx"))
    app = App(open_model(root, model), "127.0.0.1", 0)
    try:
        with Listener(f"http://127.0.0.1:{app.server.get_port()}") as browser:
            browser.greet()
            browser.set("All pictures in a table", True)
            browser.wait(lambda: 'lab-note" data-task' in browser.html())
            browser.tell("lab-drawer", "columns")
            browser.wait(lambda: "b?[31m" in browser.html())
            browser.tell("report", None)
            browser.upload(f"mine{EVIL}.png", (next(root.rglob("*satellite*/*/*.png"))).read_bytes())
            browser.wait(lambda: "mine?[31m" in browser.html())
            said = "".join(browser.texts)
    finally:
        app.close()
    assert {c for c in set(said) if c not in TYPED and printable(c) != c} == set()
    assert "model?[31m" in said


def test_a_call_of_the_pages_script_passes_on_none() -> None:
    script = call("show", {"names": [f"a{EVIL}", ("\u200f(1)\n", 1.5, None)]}, f"b{EVIL}")
    assert script == call("show", {"names": [f"a{printable(EVIL)}", ("\u200f(1)\n", 1.5, None)]}, f"b{printable(EVIL)}")
