"""The files of the page at `/`: one template, style sheets, and ES modules from `page`, `vendor`, and the panels.

`screen/page/bundle.js` joins all modules of the first page, as each file takes a connection. No two modules define the same name.
Panels import these modules at their addresses; each exports the whole bundle. `screen/terms.json` has the meanings of terms.
"""

from __future__ import annotations

import gzip
import json
import re
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Final

from websockets.datastructures import Headers
from websockets.http11 import Response

from explorer.screen import terms
from explorer.screen.panels import folder
from explorer.server.auth import HttpRequest

_SCREEN = Path(__file__).parent
_PAGE = _SCREEN / "page"
_BUNDLE = _PAGE / "bundle.js"
_IMPORT = re.compile(r"""^import (?:\{[^}]*\} from )?"\./([a-z_-]+\.js)";\n""", re.MULTILINE)
_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".md": "application/json"}
_FILE = re.compile(r".*/screen/(page|vendor|panels/([a-z_]{1,40}))/([a-z_-]{1,40}\.(?:css|js|html))", re.ASCII)
# The folder of viser's own page: the scene of a tab.
_SCENE: Final = re.compile(r".*/scene/([a-z0-9]{8,32})/?", re.ASCII)


def scene_of(path: str) -> str | None:
    """Return the tab of a scene's path without query; None for another path."""
    match = _SCENE.fullmatch(path)
    return None if match is None else match[1]


def respond(request: HttpRequest, zipped: bool) -> Response | None:
    """Return the page at a folder's address, or one of its files; None for a scene's address, and for other files.

    Args:
        zipped: whether the browser reads gzip.
    """
    place = request.path.partition("?")[0]
    if place.endswith("/screen/terms.json"):
        file: Path | None = terms.GLOSSARY
    elif match := _FILE.fullmatch(place):
        of_panel = folder(match[2]) if match[2] else _SCREEN / match[1]
        file = _BUNDLE if match[0].endswith("/page/bundle.js") else None if of_panel is None else of_panel / match[3]
    elif place.endswith("/") and scene_of(place) is None:
        file = _PAGE / "index.html"
    else:
        return None
    if file is None or not (file == _BUNDLE or file.is_file()):
        return Response(404, "Not Found", Headers({"Content-Length": "0", "Connection": "close"}), b"")
    changed = (one.stat().st_mtime_ns for one in (_PAGE.glob("*.js") if file == _BUNDLE else [file]))
    content, tag = _read(file, max(changed), zipped)
    headers = Headers({"ETag": tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding", "Connection": "close"})
    if request.only("if-none-match") == tag:
        return Response(304, "Not Modified", headers, b"")
    headers["Content-Type"] = f"{_KINDS[file.suffix]}; charset=utf-8"
    if zipped:
        headers["Content-Encoding"] = "gzip"
    headers["Content-Length"] = str(len(content))
    return Response(200, "OK", headers, content)


@lru_cache(maxsize=64)
def _read(file: Path, _: int, zipped: bool) -> tuple[bytes, str]:
    """Return a file, perhaps compressed, and the tag of its state."""
    if file == _BUNDLE:
        content = bundle()[0].encode()
    elif file == terms.GLOSSARY:
        content = json.dumps(terms.meanings()).encode()
    elif file.parent == _PAGE and file.name in bundle()[1]:
        content = b'export * from "./bundle.js";'
    else:
        content = file.read_bytes()
    return gzip.compress(content, mtime=0) if zipped else content, f'"{sha256(content).hexdigest()[:16]}"'


def bundle() -> tuple[str, set[str]]:
    """Return the modules of the first page as one text, and their names; each module follows its imports."""
    texts: list[str] = []
    added: set[str] = set()

    def add(name: str) -> None:
        if name not in added:
            added.add(name)
            text = (_PAGE / name).read_text("utf-8")
            for imported in _IMPORT.findall(text):
                add(imported)
            texts.append(_IMPORT.sub("", text))

    add("app.js")
    return "\n".join(texts), added
