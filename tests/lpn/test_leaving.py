"""Texts of other people in every file that leaves the program, read by a reader of the format, and by our own."""

from __future__ import annotations

import csv
import io
import re
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest

import lpn
from lpn.analysis.model_table import compare
from lpn.cli import main
from lpn.core.csv_cells import unescape
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.text_tables import markdown_page
from lpn.datasets import open_dataset
from lpn.flight.files import Flight, Frame, open_flight, write_flight
from lpn.flight.locate.corrections import Correction, read_corrections, set_correction
from lpn.flight.locate.tracks import write_track
from lpn.tasks import notes
from lpn.tasks.opening import lazy_task
from tools.fixtures import small_worlds
from tools.fixtures.html_page import Page

# Names that Linux allows, and notes.
TEXTS = [
    "<script>alert(1)<&script>",
    "<img src=x onerror=alert(1)>",
    "]]>",
    "Rock & Roll &amp; &#60;b&#62;",
    "\"both\" 'quotes'",
    "a,b;c",
    "=HYPERLINK(1)",
    "+41 79",
    "-2+3+cmd|' &C calc'!A0",
    "@SUM(1)",
    "'=1",
    "-5.5",
    "a;=1+1",
    "two\nlines",
    "two\r\nlines",
    "\r=1",
    "\t=1",
    "bell\x07 and escape\x1b[31m",
    "unit\x1cseparators\x0b\x0c\x85",
    "line\u2028and\u2029paragraph",
    "turned\u202egpj",
    "not UTF-8 \udce9",
    "\u753b\u50cf\u30001 at 10.15\u202fPM",
    "\ufffe\uffff",
]
GPX, KML = "{http://www.topografix.com/GPX/1/1}", "{http://www.opengis.net/kml/2.2}"


def _table(data: bytes) -> list[list[str]]:
    return list(csv.reader(io.StringIO(data.decode(), newline=""), strict=True))


def _no_formula(cells: list[str]) -> bool:
    number = re.compile(r"-?[0-9.]+(e-?[0-9]+)?")
    return not [cell for cell in cells if cell.startswith(tuple("=+-@\t\r")) and not number.fullmatch(cell)]


@pytest.mark.parametrize("text", TEXTS)
def test_a_track_is_read_by_a_reader_of_its_format(text: str, tmp_path: Path) -> None:
    point = {"frame": text, "stage": "retrieval", "state": "accepted", "point": "ground", "reason": text}
    point |= {"latitude": -1e-5, "longitude": 2e-5, "radius_on_map_m": float("nan")}
    for suffix in (".csv", ".geojson", ".kml"):
        write_track(tmp_path / f"track{suffix}", text, [point])
    utf8 = text.encode("utf-8", "replace").decode()
    header, row = _table((tmp_path / "track.csv").read_bytes())
    assert _no_formula(row)
    shown = printable(text, "\n\t")
    assert [unescape(row[header.index(name)]) for name in ("frame", "reason")] == [shown, shown]
    assert [float(row[header.index(name)]) for name in ("latitude", "longitude")] == [-1e-5, 2e-5]
    found = msgspec.json.decode((tmp_path / "track.geojson").read_bytes())  # stricter than Python's
    assert (found["name"], found["features"][0]["properties"]["frame"]) == (utf8, utf8)
    mark = ElementTree.parse(tmp_path / "track.kml").getroot().find(f".//{KML}Placemark")
    assert mark.findtext(f"{KML}name") == printable(text)
    assert mark.findtext(f".//{KML}coordinates") == "0.00002,-0.00001"
    # Viewers take a description for HTML.
    shown = Page(mark.findtext(f"{KML}description") or "")
    assert "".join(shown.texts) == f"{printable(text)} The position is the middle of the picture on the ground."
    assert not shown.tags


@pytest.mark.parametrize("text", TEXTS)
def test_what_a_person_wrote_is_read_back(text: str, tmp_path: Path) -> None:
    corners = np.array([(-33.0, -70.001), (-33.0, -70.0), (-33.001, -70.0), (-33.001, -70.001)])
    set_correction(tmp_path / "corrections.csv", text, Correction(np.array([-33.0005, -70.0005]), corners))
    (stored,) = read_corrections(tmp_path / "corrections.csv").items()
    assert stored[0] == text
    np.testing.assert_array_equal(stored[1].corners, corners)
    cells = (tmp_path / "corrections.csv").read_bytes().decode("utf-8", "replace")
    assert all(_no_formula(row) for row in _table(cells.encode()))
    flight = Flight(text, (Frame(text, tmp_path / "photos" / text, 4, 3, roll=-1.5),), (text,))
    write_flight(flight, tmp_path / "flight")
    again = open_flight(tmp_path / "flight")
    assert again.frames == flight.frames
    utf8 = text.encode("utf-8", "replace").decode()
    assert (again.name, again.notes) == (utf8, (utf8,))
    written = (tmp_path / "flight" / "flight.csv").read_bytes().decode("utf-8", "replace").encode()
    assert all(_no_formula(row) for row in _table(written))
    file = tmp_path / "notes.csv"
    notes.set_note(file, "a.jpg", "night", f"{text}!")
    kept = notes.read_notes(file)["a.jpg"].text
    assert _no_formula(_table(file.read_bytes())[1])
    assert kept == notes.read_notes(file)["a.jpg"].text
    if printable(text) == text:
        assert kept == f"{text}!"
        notes.set_note(file, text, "", "a path of this name")
        assert notes.read_notes(file)[text].text == "a path of this name"
    else:
        with pytest.raises(InputError, match="so rename the file"):
            notes.set_note(file, text, "", "a path of this name")


def test_a_note_that_somebody_else_changed_is_not_replaced_unseen(tmp_path: Path) -> None:
    file = tmp_path / "notes.csv"
    notes.set_note(file, "a.jpg", "night", "mine")
    notes.set_note(file, "a.jpg", "", "theirs")
    with pytest.raises(notes.ChangedNoteError, match="it is now 'theirs'; save again to replace it") as refused:
        notes.set_note(file, "a.jpg", "night", "mine, too", notes.Note(("night",), "mine"))
    assert notes.read_notes(file)["a.jpg"].text == "theirs"
    notes.set_note(file, "a.jpg", "night", "mine, too", refused.value.stored)
    notes.set_note(file, "a.jpg", "night", "mine, too", notes.Note())  # saved twice, as after a lost answer
    assert notes.read_notes(file)["a.jpg"].text == "mine, too"


NAMES = [name for name in TEXTS if "\r" not in name][:20] + TEXTS[-3:]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set whose queries have the texts as names, with notes and metadata."""
    if sys.platform != "linux":
        pytest.skip("other systems allow few of these names")
    root = small_worlds.make_dataset(tmp_path_factory.mktemp("leaving") / "=places <b>", train=1, test=4)
    queries = sorted((root / "test" / "query_drone").rglob("*.png"))
    for number, query in enumerate(queries):
        query.rename(query.with_name(f"{TEXTS[number]}.png"))
    rest = queries[-1].with_name(f"{TEXTS[len(queries) - 1]}.png")
    for number, name in enumerate(NAMES):
        target = rest.with_name(f"{number} {name}.png")
        shutil.copy(rest, target)
    for query in (root / "test" / "query_drone").rglob("*.png"):
        path = query.relative_to(root).as_posix()
        if printable(path) == path:
            notes.set_note(root / "notes.csv", path, "night", TEXTS[6])
    return root


def test_tables_and_reports_of_such_names(places: Path, model_file: Path, tmp_path: Path) -> None:
    given = [str(places), "--model", str(model_file)]
    assert main.main(["failures", *given, "--csv", str(tmp_path / "a.csv")]) == 0
    rows = _table((tmp_path / "a.csv").read_bytes())
    assert {len(row) for row in rows} == {len(rows[0])}
    assert all(_no_formula(row) for row in rows)
    paths = {printable(query.relative_to(places).as_posix()) for query in places.glob("test/query_drone/*/*")}
    assert {unescape(row[0]) for row in rows[1:]} == paths
    assert {unescape(row[rows[0].index("note")]) for row in rows[1:]} == {"", TEXTS[6]}
    model = tmp_path / "=1+1 <b>|&.onnx"
    shutil.copy(model_file, model)
    assert main.main(["report", str(places), "--model", str(model), "--out", str(tmp_path / "a.html")]) == 0
    page = Page((tmp_path / "a.html").read_text("utf-8"))
    assert "script" not in page.tags
    assert not page.handlers
    assert TEXTS[6] in page.text
    figures = tmp_path / "a.json"
    assert main.main(["compare", str(places), "--model", str(model), str(model_file), "--json", str(figures)]) == 0
    assert msgspec.json.decode(figures.read_bytes())["models"][0]["name"] == model.name
    dataset = open_dataset(places)
    table = compare(
        [
            lazy_task(lpn.load(file), dataset, "drone-to-satellite", model_name=file.name).evaluate().ranked()
            for file in (model, model_file)
        ]
    )
    assert _table(table.to_csv())[1][0] == f"'{model.name}"
    assert "| =1+1 &lt;b&gt;\\|&amp;.onnx |" in markdown_page(table.printed)
