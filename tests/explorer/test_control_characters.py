"""Names, metadata, and notes that hold commands for a terminal or turn the writing around: the page is sent none of them."""

from __future__ import annotations

import json
import shutil
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from explorer.app import App
from explorer.feeds import json_text
from explorer.opening import open_model
from lpn.core.files import TYPED, printable
from lpn.tasks import notes
from tools.fixtures import small_worlds
from tools.fixtures.screen_tab import ScreenTab

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems allow few of these names")

EVIL = "\x1b[31m\x1b]0;title\x07\x9b31m\x7f\x08\u202egpj\u2066\u2069\u2028\u2029"


def texts(value: Any) -> Iterator[str]:
    """All texts of a message."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield from (key, *texts(entry))
    elif isinstance(value, list):
        for entry in value:
            yield from texts(entry)


def test_no_message_to_a_page_holds_any(tmp_path: Path, model_file: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "new", train=1, test=4).rename(tmp_path / f"places{EVIL}")
    lines = [f"path,weather,b{EVIL}"]
    for query in sorted((root / "test").glob("query_*/*/*.png")):
        renamed = query.rename(query.with_name(f"{query.stem}{EVIL}.png"))
        lines.append(f'"{renamed.relative_to(root).as_posix()}","rain{EVIL}",1')
    (root / "metadata.csv").write_text("\n".join(lines) + "\n")
    (root / notes.NAME).write_text(f'path,tags,note\n"{lines[1].split(chr(34))[1]}",night,"typed \u200f(1){EVIL}"\n')
    model = Path(shutil.copy(model_file, tmp_path / f"model{EVIL}.onnx"))
    with closing(App(open_model(root, model), "127.0.0.1", 0)) as app, ScreenTab(app.link) as tab:
        result = tab.open("?query=~1&panel=why")
        tab.until(lambda last: "Data: " in last.get("panel", {}).get("message", {}).get("html", ""))
        rail = tab.until(lambda last: "rail" in last)["rail"]
        with urllib.request.urlopen(f"{app.link}/{rail['address']}{rail['feed']}0", timeout=60) as response:
            listed = json.load(response)
        tab.set(compare=result["strip"][3])
        tab.until(lambda last: last["result"]["pinned"])
        messages = [dict(tab.last), listed]
        tab.upload(f"mine{EVIL}.png", next(root.rglob("*satellite*/*/*.png")).read_bytes())
        tab.until(lambda last: last["result"]["photo"]["own"])
        tab.act(f"fly{EVIL}")
        tab.until(lambda last: "error" in last)
        said = "".join(texts([*messages, dict(tab.last)]))
    assert {c for c in set(said) if c not in TYPED and printable(c) != c} == set()
    for name in ("places?[31m", "model?[31m", "mine?[31m", "fly?[31m"):
        assert name in said, name


def test_what_is_sent_as_json_keeps_what_people_type() -> None:
    given = {"names": [f"a{EVIL}", ("\u200f(1)\n\t\\r \\u0007", 1.5, None)]}
    assert json.loads(json_text(given)) == {"names": [f"a{printable(EVIL)}", ["\u200f(1)\n\t\\r \\u0007", 1.5, None]]}
