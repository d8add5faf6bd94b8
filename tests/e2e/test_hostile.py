"""Names and texts that are scripts, other web sites, and the token, in a real browser."""

from __future__ import annotations

import csv
import functools
import http.server
import json
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import onnx
import pytest
from PIL import ExifTags, Image, PngImagePlugin
from playwright.sync_api import expect

from lpn.flight.maps import MapPlace
from lpn.flight.maps.folder import build_map
from lpn.models.contract import Contract
from lpn.models.contract_metadata import to_metadata
from tests.e2e.conftest import Contexts, RunningApp, Screen, started
from tests.lpn.flight.locate.scenery import land, write_map
from tools.fixtures import small_models, small_worlds
from tools.fixtures.photos import dji_xmp, exif, write_photo

# Elements that only a foreign text could have put into the page.
INJECTED = ", ".join(
    (
        "img[src='x']",
        "iframe[src^='javascript' i]",
        "[href^='javascript' i]",
        *(f"[on{on}^='window.hurt']" for on in ("error", "load", "click")),
    )
)
# Without slashes, so that a folder can have such a name.
NAMES = [
    "<img src=x onerror=window.hurt=1>",
    '"><img src=x onerror=window.hurt=2>',
    "'><svg onload=window.hurt=3>",
    "');window.hurt=4;('",
    "[x](javascript:window.hurt=5)",
    "&lt;img src=x onerror=window.hurt=6&gt;",
    "`+(window.hurt=7)+`${window.hurt=7}",
    "{{7*7}}{%raw%}<i onclick=window.hurt=16>",
]
TEXT = (
    "</textarea></style><script>window.hurt=8</script><img src=x onerror=window.hurt=9>\"'>"
    "<iframe src='javascript:parent.hurt=10'>"
)
PANELS = ("lab", "why", "compare", "sweep", "region", "stories", "report", "flight")


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pairs of drawn places whose names, notes, and data are scripts."""
    root = tmp_path_factory.mktemp("hostile") / "<b onclick=window.hurt=11>"
    told = PngImagePlugin.PngInfo()
    for key in ("Title", "Comment", "Software"):
        told.add_text(key, TEXT)
    pairs, positions, weather, notes = [], [], [], []
    for number, name in enumerate(NAMES):
        tile, photo = f"tiles/{name}/tile.png", f"photos/{name}/<img src=x onerror=window.hurt=12>.png"
        for path, picture in (
            (tile, small_worlds.place(number)),
            (photo, small_worlds.from_drone(small_worlds.place(number), number)),
        ):
            small_worlds.write(root / path, picture)
            Image.open(root / path).save(root / path, pnginfo=told)
            positions.append([path, f"{46 + 0.001 * number:.4f}", "7"])
            weather.append([path, TEXT, NAMES[1]])
        pairs.append([tile, photo])
        notes.append([photo, "onerror javascript", TEXT])
    written(root / "pairs.csv", ["satellite", "drone"], pairs)
    written(root / "geo.csv", ["path", "latitude", "longitude"], positions)
    written(root / "metadata.csv", ["path", "weather", "it's &lt;b&gt;"], weather)
    written(root / "notes.csv", ["path", "tags", "note"], notes)
    steps = [{"shows": "", "caption": TEXT, "notes": name} for name in NAMES]
    (root / "stories.json").write_text(json.dumps([{"name": name, "steps": steps} for name in NAMES]))
    return root


def written(file: Path, header: list[str], rows: list[list[str]]) -> None:
    """Write a table."""
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])


@dataclass
class Walk:
    """What happens while a person walks through the screen."""

    screen: Screen
    asked: list[str] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)
    seen: str = ""

    def __post_init__(self) -> None:
        page = self.screen.page
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("websocket", lambda socket: self.asked.append(socket.url))
        page.on("dialog", lambda dialog: (self.alarms.append(dialog.message), dialog.dismiss()))
        page.on("pageerror", lambda error: self.alarms.append(str(error)))

    def look(self) -> None:
        """Note the texts in the page, and check that none has become an element."""
        page = self.screen.page
        self.seen += page.locator("body").inner_text()
        self.seen += "\n".join(page.locator("[aria-label]").evaluate_all("all => all.map((one) => one.ariaLabel)"))
        assert not page.locator(INJECTED).count()

    def panels(self) -> None:
        """Open each panel of the place, and wait for its content."""
        page = self.screen.page
        for name in PANELS:
            self.screen.open(f"?panel={name}")
            if page.locator("#panel").is_visible():
                expect(page.locator("#panel .content")).not_to_be_empty()
                self.look()

    def harmless(self) -> None:
        """Check that no script ran, and that requests went only to the server."""
        assert self.screen.page.evaluate("window.hurt") is None
        assert not self.alarms
        server = urlsplit(self.screen.url).netloc
        asked = {urlsplit(url) for url in self.asked}
        assert {url.netloc for url in asked if url.scheme not in ("data", "blob")} == {server}
        assert {url.scheme for url in asked} <= {"http", "ws", "data", "blob"}


@pytest.mark.slow
def test_names_and_texts_are_shown_as_text_and_none_of_them_runs(
    places: Path, model_file: Path, tmp_path: Path, contexts: Contexts
) -> None:
    with started(places, model_file, tmp_path / "cache") as running:
        walk = Walk(Screen(contexts().new_page(), running.url))
        screen, page = walk.screen.open(), walk.screen.page
        for number in range(len(NAMES)):
            expect(page.locator(f'#list [data-query="{number}"]')).to_have_attribute("aria-current", "true")
            screen.rest()
            walk.look()
            screen.key("n")
        walk.panels()
        screen.open()
        screen.key("/")
        page.keyboard.type(NAMES[1])
        walk.look()
        page.keyboard.press("Escape")
        own = tmp_path / f"{NAMES[0]}.png"
        small_worlds.write(own, small_worlds.place(77))
        page.set_input_files("#file", own)
        expect(screen.photo.locator(".picture")).to_have_attribute("aria-label", own.name)
        walk.look()
        page.set_input_files(
            "#file", {"name": NAMES[0], "mimeType": "image/png", "buffer": b"<svg onload=window.hurt=15>"}
        )
        expect(screen.headline.locator("h1")).to_contain_text("is a drawing (SVG), not a photo")
        walk.look()
        walk.harmless()
        assert all(name in walk.seen for name in NAMES)


@pytest.mark.slow
def test_a_flight_a_map_and_models_are_shown_as_text_too(
    flown: dict[str, Path], tmp_path: Path, contexts: Contexts
) -> None:
    named = [text for name, file in flown.items() if name != "flight" for text in (f"--{name}", str(file))]
    options = [str(flown["flight"]), "--no-register", *named]
    with started(Path(), Path(), tmp_path / "cache", default=True, options=options) as running:
        walk = Walk(Screen(contexts().new_page(), running.url))
        screen, page = walk.screen.open(), walk.screen.page
        for _ in NAMES:
            walk.look()
            screen.key("n")
            screen.rest()
        walk.panels()
        page.keyboard.press("Control+k")
        walk.look()
        walk.harmless()
        told = (f"{NAMES[3]}.onnx", f"{NAMES[4]}.onnx", *(f"{name}.jpg" for name in NAMES))
        assert all(text in walk.seen for text in told)


def hostile_model(file: Path) -> Path:
    """Write a tiny model whose own description is of scripts."""
    made = onnx.load_model_from_string(small_models.onnx_file(sealed=False))
    parts = (f"1 {NAMES[1]}", NAMES[4])
    described = Contract(
        NAMES[0],
        TEXT,
        ("satellite", "drone"),
        (32, 32),
        2,
        4,
        "exact, with held",
        NAMES[2],
        part_names={"satellite": parts},
    )
    del made.metadata_props[:]
    onnx.helper.set_model_props(made, to_metadata(described))
    file.write_bytes(made.SerializeToString())
    return file


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A map, a flight of photos from a camera, and models, whose names and descriptions are scripts."""
    folder = tmp_path_factory.mktemp("flown") / NAMES[0]
    folder.mkdir()
    write_map(folder / "town.tif", land()).close()
    place = MapPlace(NAMES[0], "spring", NAMES[2], f"https://x.org/{NAMES[1]}")
    town = build_map([folder / "town.tif"], folder / NAMES[1], place=place)
    camera = {ExifTags.Base.Make: NAMES[0], ExifTags.Base.Model: TEXT, ExifTags.Base.Software: TEXT}
    spots = [(20.0 * number - 60, 0.0) for number in range(len(NAMES))]
    for name, (latitude, longitude) in zip(NAMES, town.frame.degrees(spots).tolist(), strict=True):
        angles = {"GimbalYawDegree": 0, "GimbalPitchDegree": -90, "GimbalRollDegree": 0, "RelativeAltitude": 30}
        told = exif(latitude, longitude, camera)
        write_photo(folder / "photos" / f"{name}.jpg", told, dji_xmp(**angles), size=(96, 72))
    town.close()
    (folder / "photos").rename(folder / NAMES[2])
    model, other = (hostile_model(folder / f"{name}.onnx") for name in NAMES[3:5])
    return {"map": folder / NAMES[1], "flight": folder / NAMES[2], "model": model, "beside": other}


@pytest.mark.slow
def test_without_a_token_a_browser_is_asked_for_it_and_then_stays_signed_in(
    app: RunningApp, contexts: Contexts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LPN_TOKEN", raising=False)
    with started(app.data, app.model, tmp_path / "cache", options=["--ask-token"]) as running:
        plain, _, query = running.url.partition("?")
        context = contexts()
        page = context.new_page()
        page.goto(plain)
        expect(page.get_by_role("heading")).to_have_text("A token is needed")
        page.get_by_label("Token").fill("a wrong one given")
        page.get_by_role("button", name="Open").click()
        expect(page.get_by_role("heading")).to_have_text("Wrong token")
        Screen(page, running.url).open("&query=0008")
        expect(page).to_have_url(re.compile("query=0008"))
        assert "token" not in page.url
        assert query.partition("=")[2] not in page.content()
        assert "lpn-" not in page.evaluate("document.cookie"), "no script reads it"
        with elsewhere(tmp_path, f"<a href='{plain}?query=0009'>a link in somebody's message</a>") as site:
            other = context.new_page()
            other.goto(site)
            other.get_by_role("link").click()
            Screen(other, plain).rest()
            expect(other).to_have_url(re.compile("query=0009"))
            stranger = contexts().new_page()
            stranger.goto(site)
            stranger.get_by_role("link").click()
            expect(stranger.get_by_role("heading")).to_have_text("A token is needed")
            stranger.goto(site)
            stranger.evaluate(f"document.querySelector('a').href = {running.url!r}")
            stranger.get_by_role("link").click()
            Screen(stranger, plain).rest()


@contextmanager
def elsewhere(folder: Path, content: str) -> Iterator[str]:
    """The address of another site, with one page."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    (folder / "site").mkdir(exist_ok=True)
    (folder / "site" / "index.html").write_text(f"<!doctype html><body>{content}")
    handler = functools.partial(Quiet, directory=os.fspath(folder / "site"))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_address[1]}/"  # another host than 127.0.0.1, so another site
    finally:
        server.shutdown()
        server.server_close()
