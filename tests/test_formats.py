"""Files of the first release's formats, in `tests/data/formats`: every later version reads them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import lpn
from explorer.screen.panels.stories.story import Step, Story, read_stories
from lpn.descriptors import open_store
from lpn.flight.files import open_flight
from lpn.flight.locate.corrections import read_corrections
from lpn.flight.maps import Window, open_map
from lpn.index import open_index
from lpn.retrieval import describe_picture
from lpn.tasks.notes import Note, read_notes
from lpn.training.recipe import Recipe
from lpn.training.run_folder import read_run
from tools.fixtures.small_worlds import place

FORMATS = Path(__file__).parent / "data" / "formats"
TILES = [f"{number:04d}.png" for number in range(4)]


@pytest.mark.parametrize(("precision", "error"), [("float32", 1e-6), ("float16", 1e-3), ("int8", 1e-2)])
def test_a_store_holds_what_its_model_describes_today(precision: str, error: float) -> None:
    store, model = open_store(FORMATS / f"store-{precision}"), lpn.load(FORMATS / "model.onnx")
    pictures = [cv2.imread(str(FORMATS / "tiles" / row.file))[..., ::-1] for row in store.rows]
    described = [describe_picture(model, picture, "satellite").descriptor for picture in pictures]
    assert [row.file for row in store.rows] == TILES
    assert store.kind.fingerprint == model.fingerprint
    np.testing.assert_allclose(store.float32, described, atol=error)


@pytest.mark.parametrize("engine", ["exact", "faiss"])
def test_an_index_finds_its_tiles_at_their_places(engine: str) -> None:
    index = open_index(FORMATS / f"index-{engine}")
    for number, vector in enumerate(open_store(FORMATS / "store-float32").float32):
        found = index.search(vector, None, 1)
        assert (found.ids, found.scores) == ([TILES[number]], pytest.approx([1]))
        np.testing.assert_allclose(found.positions, [(48 + 0.001 * number, 9)], atol=1e-6)
    assert index.count() == 4


def test_a_map_keeps_pixels_place_and_error() -> None:
    basemap = open_map(FORMATS / "map")
    picture, valid = basemap.read(Window(0, 0, 192), 192)
    np.testing.assert_array_equal(picture, np.tile(place(0), (2, 2, 1)))
    assert valid.all()
    assert basemap.bounds == pytest.approx((-96, -96, 96, 96), abs=0.01)
    assert (basemap.place.name, basemap.place.photographed, basemap.surveyed_error) == ("Nowhere", "2026-06-01", 2)


def test_an_index_names_the_windows_of_its_map() -> None:
    windows = open_index(FORMATS / "index-of-map").kind.windows
    assert (windows.map, windows.sizes, windows.count) == (open_map(FORMATS / "map").identity(), (96.0,), 9)


def test_a_flight_keeps_its_photos_and_a_persons_corrections() -> None:
    flight = open_flight(FORMATS / "flight")
    np.testing.assert_allclose(flight.degrees, [(48, 9), (48.0002, 9)])
    assert [(one.name, one.pitch, one.fov) for one in flight.frames] == [(f"DJI_000{i}.JPG", -90, 70) for i in (0, 1)]
    assert all(one.file.is_file() for one in flight.frames)
    ((name, correction),) = read_corrections(FORMATS / "flight" / "corrections.csv").items()
    assert name == "DJI_0000.JPG"
    np.testing.assert_allclose(correction.middle, (48, 9), atol=1e-7)


def test_notes_stories_and_the_settings_of_a_run() -> None:
    assert read_notes(FORMATS / "tiles" / "notes.csv") == {
        "0001.png": Note(("night", "blur"), "-10 degrees,\nlike its twin")
    }
    assert read_stories(FORMATS / "stories.json") == [Story("Night", (Step("query=0001", "It is dark."),))]
    run = read_run(FORMATS / "run")
    assert Recipe(**run.recipe).n_parts == 4
    assert run.given == {"data": "places"}
