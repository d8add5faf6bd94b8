"""Names and texts that are scripts, other web sites, and the token, in a real browser."""

from __future__ import annotations

import csv
import functools
import http.server
import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import onnx
import pytest
from explorer.stories import exported
from explorer.stories.story import Step, Story
from explorer.url_state import UrlState
from PIL import ExifTags, Image, PngImagePlugin
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect

import lpn
from explorer.opening import open_flight_over, open_model
from lpn.cli import main
from lpn.core.files import printable
from lpn.locate.tracks import TrackPoint, write_track
from lpn.maps import MapPlace
from lpn.maps.folder import build_map
from lpn.models.contract import Contract
from lpn.models.contract_metadata import to_metadata
from lpn.sources import ModelOptions
from tests.e2e.conftest import PATIENCE, ExplorerPage, RunningApp, empty_context, started
from tests.lpn.locate.scenery import land, write_map
from tools.fixtures import small_models, small_worlds
from tools.fixtures.chromium import returning
from tools.fixtures.photos import dji_xmp, exif, write_photo

# Elements that only a foreign text could have put into the page.
INJECTED = ", ".join(
    (
        "img[src='x']",
        "iframe",
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
    """The findings of a walk through all of the page."""

    page: Page
    url: str
    asked: list[str] = field(default_factory=list)
    sockets: list[str] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)
    seen: set[str] = field(default_factory=set)


@pytest.fixture(scope="module")
def walk(places: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Walk]:
    """Every room of the page visited: the pair, the map, the laboratory's tabs, the window of reasons, an upload."""
    folder = tmp_path_factory.mktemp("walk")
    with started(places, model_file, folder / "cache") as running:
        context = returning(browser, 1456, 835)
        context.set_default_timeout(1000 * PATIENCE)
        walked = Walk(context.new_page(), running.url)
        page = walked.page
        page.on("request", lambda request: walked.asked.append(request.url))
        page.on("websocket", lambda socket: walked.sockets.append(socket.url))
        page.on("dialog", lambda dialog: (walked.alarms.append(dialog.message), dialog.dismiss()))
        page.on("pageerror", lambda error: walked.alarms.append(str(error)))
        visit(walked, folder)
        yield walked
        context.close()


def visit(walk: Walk, folder: Path) -> None:
    """Go through the rooms, and note which of the texts each shows."""
    explorer, page = ExplorerPage(walk.page), walk.page

    def look() -> None:
        explorer.settle()
        shown = page.locator("body").inner_text()
        walk.seen |= {text for text in (*NAMES, TEXT[:40]) if text in shown}
        assert not page.locator(INJECTED).count()

    explorer.open(walk.url)
    look()
    for number in range(1, len(NAMES)):
        explorer.key("n")
        explorer.expect_status("query", str(number))
        look()
    explorer.key("m")
    look()
    explorer.key("m")
    explorer.key("b")
    rows = page.locator("#lpn-lab-table tbody tr")
    expect(rows.first).to_be_visible()
    look()
    for tab in page.locator(".lab-bar .seg a").all():
        tab.click()
        look()
    page.locator(".lab-bar .seg a").first.click()
    other = page.locator("#lpn-lab-table tr[data-row]:not(.chosen)").first
    row = other.get_attribute("data-row")
    other.click()
    expect(page.locator("#lpn-lab-table tr.chosen")).to_have_attribute("data-row", str(row))
    expect(page.locator(f".lab-note[data-row='{row}'] textarea")).to_have_value(
        TEXT
    )  # the former query has this note, too
    page.locator("#lpn-lab-tags").fill("onload night")
    page.locator("#lpn-lab-tags").blur()
    expect(page.locator("#lpn-lab-message")).to_contain_text("Saved")
    page.locator("#lpn-lab-tags").fill("<img/src=x/onerror=window.hurt=13>")
    page.locator("#lpn-lab-tags").blur()
    expect(page.locator("#lpn-lab-message")).to_contain_text("Not saved")
    page.locator("#lpn-lab-where").fill('note ~ "<img src=x onerror=window.hurt=14>"')
    page.locator("#lpn-lab-where").blur()
    look()
    explorer.key("b")
    explorer.key("y")
    for tab in ("Heatmaps", "True or wrong", "Turn, shift, zoom", "Search by a region"):
        explorer.tab(tab)
        look()
    explorer.key("y")
    own = folder / NAMES[0]
    small_worlds.write(own.with_suffix(".png"), small_worlds.place(77))
    explorer.upload(own.with_suffix(".png"))
    explorer.expect_status("name", own.with_suffix(".png").name)
    look()
    explorer.fill("Find name", NAMES[1])
    look()
    own.write_bytes(b"<svg onload=window.hurt=15>")
    explorer.upload(own)
    expect(page.get_by_text("is a drawing (SVG), not a photo")).to_be_visible()
    look()
    page.locator("#lpn-story-names a").nth(1).click()
    expect(page.locator("#lpn-told .caption")).to_have_text(TEXT)
    page.keyboard.press("n")
    expect(page.locator("#lpn-told .notes")).to_have_text(NAMES[0])
    page.keyboard.press("Escape")
    look()


@pytest.mark.slow
def test_names_and_texts_are_shown_as_text_and_none_of_them_runs(walk: Walk) -> None:
    assert walk.page.evaluate("window.hurt") is None
    assert not walk.alarms
    assert walk.seen >= set(NAMES)


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
def test_a_flight_a_map_and_models_are_shown_as_text_too(
    flown: dict[str, Path], tmp_path: Path, contexts: Callable[..., BrowserContext]
) -> None:
    named = [text for name, file in flown.items() if name != "flight" for text in (f"--{name}", str(file))]
    options = [str(flown["flight"]), "--no-register", *named]
    with started(Path(), Path(), tmp_path / "cache", default=True, options=options) as running:
        walked = Walk(contexts().new_page(), running.url)
        explorer, page = ExplorerPage(walked.page), walked.page
        page.on("dialog", lambda dialog: (walked.alarms.append(dialog.message), dialog.dismiss()))
        page.on("pageerror", lambda error: walked.alarms.append(str(error)))

        def look(room: Locator) -> None:
            expect(room).to_be_visible()
            explorer.settle()
            walked.seen.add(page.locator("body").inner_text())
            assert not page.locator(INJECTED).count()

        page.goto(running.url)
        expect(page.locator(".credit a")).to_have_attribute("href", f"https://x.org/{NAMES[1]}")
        look(page.locator(".place", has_text=NAMES[0]))
        explorer.open(f"{running.url}/?screen=all")
        for number in range(1, len(NAMES)):
            explorer.key("n")
            explorer.expect_status("query", str(number))
        look(page.locator("#lpn-matches"))
        for key, room in (("w", "#lpn-flight-verdict"), ("m", "#lpn-stage-map"), ("b", "#lpn-lab-table tr.chosen")):
            explorer.key(key)
            look(page.locator(room))
            explorer.key(key)
        explorer.key("y")
        expect(page.get_by_role("tab", name="Two models")).to_be_visible()
        for tab in page.get_by_role("tab").all():
            tab.click()
            look(tab)
        shown = "\n".join(walked.seen)
        told = (
            f"{NAMES[2]} over town",
            f"{NAMES[3]}.onnx",
            f"{NAMES[4]}.onnx",
            TEXT,
            f"with {NAMES[2]} held",
            NAMES[1],
        )
        assert all(text in shown for text in (*told, *(f"{name}.jpg" for name in NAMES)))
        assert page.evaluate("window.hurt") is None
        assert not walked.alarms


@pytest.fixture
def file_page(browser: Browser) -> Iterator[tuple[Page, list[str]]]:
    """A page for files, and what must not happen in it: requests for anything else, dialogs, and errors."""
    context = empty_context(browser)
    page, alarms = context.new_page(), list[str]()
    page.on(
        "request",
        lambda request: alarms.append(request.url) if not request.url.startswith(("file:", "data:")) else None,
    )
    page.on("dialog", lambda dialog: (alarms.append(dialog.message), dialog.dismiss()))
    page.on("pageerror", lambda error: alarms.append(str(error)))
    yield page, alarms
    context.close()


@pytest.mark.slow
def test_no_text_runs_in_the_files_that_leave(
    places: Path, flown: dict[str, Path], model_file: Path, tmp_path: Path, file_page: tuple[Page, list[str]]
) -> None:
    """The report, exported stories, and a notebook's cell as a browser shows them."""
    page, alarms = file_page
    report = [
        "report",
        str(places),
        "--model",
        str(model_file),
        "--out",
        str(tmp_path / "report.html"),
        "--where",
        "rank > 0",
    ]
    assert main.main(report) == 0
    shows = {"story": {"lab": "1", "columns": "weather,note"}, "flight": {"flight": "1"}}
    for name, windows in shows.items():
        workspace = open_model(places, model_file)
        if name == "flight":
            workspace = open_flight_over(
                flown["map"], flown["flight"], ModelOptions(model=flown["model"]), register=False
            )
        first = next(iter(workspace.tasks.values())).query_names[0]
        steps = [
            Step(urlencode({"query": first} | windows) if number else "", f"{TEXT} {text}")
            for number, text in enumerate(NAMES)
        ]
        _, story = exported.export(workspace, UrlState(workspace), Story(NAMES[0], tuple(steps)))
        (tmp_path / f"{name}.html").write_bytes(story)
    tiles = lpn.Gallery.of_folder(places / "tiles", flown["model"])
    answer = tiles.search(small_worlds.place(1), weights=[1, 0])
    (tmp_path / "notebook.html").write_text(f"<!doctype html><meta charset=utf-8>{answer._repr_html_()}")
    for name in ("report", "notebook", *shows):
        page.goto((tmp_path / f"{name}.html").as_uri())
        page.wait_for_load_state("networkidle")
        shown = page.locator("body").inner_text()
        if name not in shows:
            assert all(text in shown for text in (NAMES if name == "report" else (NAMES[1], NAMES[4])))
        else:
            expect(page.locator(".said .headline")).to_have_text([f"{TEXT} {text}" for text in NAMES])
            assert page.title() == NAMES[0]
        assert name == "notebook" or TEXT[:40] in page.locator("body").inner_text()
        page.evaluate("document.querySelectorAll('*').forEach(e => e.click && e.tagName !== 'A' && e.click())")
        assert page.evaluate("window.hurt") is None
        assert not page.locator(INJECTED).count()
    assert not alarms


@pytest.mark.slow
def test_a_browser_reads_tracks_of_such_names_and_runs_none(tmp_path: Path, file_page: tuple[Page, list[str]]) -> None:
    """KML and GPX by the browser's XML parser; a viewer shows the description of KML as HTML."""
    page, alarms = file_page
    names = [*NAMES, TEXT, "]]> & \x07 \ufffe \udce9 \u2028"]
    points = [TrackPoint(name, "retrieval", "accepted", name, None, 46.0, 7.0) for name in names]
    for suffix in (".kml", ".gpx"):
        write_track(tmp_path / f"track{suffix}", NAMES[0], points)
        entries = page.evaluate(
            """text => {
                const file = new DOMParser().parseFromString(text, "application/xml");
                if (file.querySelector("parsererror")) return file.querySelector("parsererror").textContent;
                return [...file.querySelectorAll("Placemark:has(Point), trkpt")].map(entry => {
                    const balloon = document.body.appendChild(document.createElement("div"));
                    balloon.innerHTML = entry.querySelector("description")?.textContent || "";
                    return [entry.querySelector("name").textContent, balloon.textContent];
                });
            }""",
            (tmp_path / f"track{suffix}").read_text("utf-8"),
        )
        assert [name for name, _ in entries] == [printable(name) for name in names]
        if suffix == ".kml":
            where = " The position is the middle of the picture on the ground."
            assert [text for _, text in entries] == [printable(name) + where for name in names]
    page.wait_for_timeout(300)
    assert page.evaluate("window.hurt") is None
    assert not alarms


@pytest.mark.slow
def test_the_browser_asks_nobody_but_the_server(walk: Walk) -> None:
    server = urlsplit(walk.url).netloc
    asked = {urlsplit(url) for url in walk.asked}
    assert {url.netloc for url in asked if url.scheme not in ("data", "blob")} == {server}
    assert {url.scheme for url in asked} <= {"http", "data", "blob"}
    assert {urlsplit(url).netloc for url in walk.sockets} == {server}


@pytest.mark.slow
def test_without_a_token_a_browser_is_asked_for_it_and_then_stays_signed_in(
    app: RunningApp, contexts: Callable[..., BrowserContext], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
        explorer = ExplorerPage(page)
        explorer.open(f"{running.url}&query=0008")
        explorer.expect_status("name", "0008")
        assert "token" not in page.url
        assert query.partition("=")[2] not in page.content()
        assert "lpn-" not in page.evaluate("document.cookie"), "no script reads it"
        with elsewhere(tmp_path, f"<a href='{plain}?query=0009'>a link in somebody's message</a>") as site:
            other = context.new_page()
            other.goto(site)
            other.get_by_role("link").click()
            ExplorerPage(other).expect_status("name", "0009")
            stranger = contexts().new_page()
            stranger.goto(site)
            stranger.get_by_role("link").click()
            expect(stranger.get_by_role("heading")).to_have_text("A token is needed")
            stranger.goto(site)
            stranger.evaluate(f"document.querySelector('a').href = {running.url!r}")
            stranger.get_by_role("link").click()
            ExplorerPage(stranger).expect_status("name", "0007")


def test_another_site_cannot_drive_a_server_on_this_machine(
    app: RunningApp, contexts: Callable[..., BrowserContext], tmp_path: Path
) -> None:
    page = contexts().new_page()
    with elsewhere(tmp_path, "<p>another site") as site:
        page.goto(site)
        said = page.evaluate(
            """url => new Promise(done => {
                const socket = new WebSocket(url.replace("http", "ws"), ["viser-v1.1.1"]);
                socket.onopen = () => done("open");
                socket.onerror = () => done("refused");
            })""",
            app.screen,
        )
        assert said == "refused"
        framed = page.evaluate(
            """url => new Promise(done => {
                const frame = document.body.appendChild(document.createElement("iframe"));
                frame.onload = () => setTimeout(() => done(frame.contentWindow.length), 500);
                frame.src = url;
            })""",
            app.screen,
        )
        assert framed == 0
        assert all("blocked" in frame.url or "chrome-error" in frame.url for frame in page.frames[1:])
        page.goto(f"{app.url}/?websocket={site.replace('http', 'ws')}")
        expect(page.get_by_role("heading")).to_have_text("This address leads elsewhere")


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
