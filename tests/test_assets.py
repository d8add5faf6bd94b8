"""Tests of the shipped files against their own descriptions."""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lpn
from lpn import descriptors
from lpn.core import images
from lpn.core.demo import DEMO, DEMO_BASELINE, DEMO_FLIGHT, DEMO_MODEL, DEMO_PHOTO, DEMO_PLACE, DEMO_QUERY
from lpn.core.files import cache_folder
from lpn.core.views import View
from lpn.datasets import open_dataset
from lpn.datasets.geo import Positions
from lpn.datasets.rendered import is_rendered_flight
from lpn.flight.files import open_flight
from lpn.flight.files.sources import make_flight
from lpn.flight.maps import open_map
from lpn.models.checkpoints import save
from tools.fixtures import painting, seeded, small_worlds
from tools.world.flight import FlightSettings, build_flight


def _program(name: str) -> ModuleType:
    """Import a program of the folder `assets`."""
    spec = spec_from_file_location(name, DEMO.parent / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


pack, pack_flight = _program("pack"), _program("pack_flight")


MODELS = [DEMO / "lpn.onnx", DEMO_BASELINE]


@pytest.mark.parametrize("file", MODELS, ids=["lpn", "baseline"])
@pytest.mark.parametrize("view", ["drone", "satellite"])
def test_the_demo_s_descriptors_are_its_models_(view: View, file: Path) -> None:
    model, dataset = lpn.load(file), open_dataset(DEMO)
    pictures = dataset.queries("drone") if view == "drone" else dataset.gallery("satellite")
    folder = DEMO / "descriptors" / ("" if file != DEMO_BASELINE else "baseline")
    store = folder / ("query_drone" if view == "drone" else "gallery_satellite")
    shipped = descriptors.shipped_descriptors(model, pictures, view, store)
    some = range(0, len(pictures), max(1, len(pictures) // 6))
    prepared = np.stack([images.prepare(images.load_picture(pictures[i].path), model.input_size) for i in some])
    found = model.descriptors(prepared, view)
    error = 1e-2 if view == "drone" else 1e-3  # 8 bits and 16
    np.testing.assert_allclose(shipped[list(some)], found, atol=error * float(np.abs(found).max()))


def test_the_demo_s_models_are_small_and_those_of_the_lpn_of_one_training() -> None:
    weights = DEMO_MODEL.with_suffix(".safetensors")
    assert all(file.stat().st_size < pack.LARGEST[file.suffix] for file in (*MODELS, weights))
    exported, trained, pictures = lpn.load(DEMO_MODEL), lpn.load(weights), seeded.pictures(0, 1, 256, 256)
    assert exported.n_parts == trained.n_parts == 4
    cosines = (exported.descriptors(pictures, "drone") * trained.descriptors(pictures, "drone")).sum((1, 2))
    assert cosines.min() > 0.99  # kernels are rounded to 8 bits, in the export after BatchNorm is folded into them


@pytest.mark.slow
def test_both_models_are_packed_with_descriptors_that_the_explorer_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = small_worlds.make_dataset(tmp_path / "world", train=1, test=3)
    for name, parts, stores in (("lpn", 4, root / "descriptors"), ("baseline", 1, root / "descriptors" / "baseline")):
        save(small_worlds.make_network(n_parts=parts), tmp_path / f"{name}.safetensors")
        pack.pack_model(tmp_path / f"{name}.safetensors", name, root, stores)
    assert [file.name for file in root.glob("*.safetensors")] == ["lpn.safetensors"]
    dataset = open_dataset(root)
    for name, parts in (("lpn", 4), ("baseline", 1)):
        model = lpn.load(root / f"{name}.onnx")
        assert model.n_parts == parts
        for role, view, side in (("query", "drone", dataset.queries), ("gallery", "satellite", dataset.gallery)):
            pictures = side(view)
            found = descriptors.shipped_or_cached(model, pictures, view, root, role)
            assert found.shape == (len(pictures), parts, 512)
    assert not cache_folder().exists()  # nothing was described again
    monkeypatch.setattr(pack, "LARGEST", {".onnx": 1_000})
    with pytest.raises(SystemExit, match="the demo's may have 1,000"):
        pack.pack_model(tmp_path / "lpn.safetensors", "other", root, tmp_path / "stores")


def test_the_demo_offers_both_directions_on_the_same_pictures_and_places() -> None:
    dataset, where = open_dataset(DEMO), Positions(DEMO)
    assert dataset.tasks() == ["drone-to-satellite", "satellite-to-drone"]
    model = lpn.load(DEMO / "lpn.onnx")
    views: tuple[View, View] = ("drone", "satellite")
    for view in views:
        queries, gallery = dataset.queries(view), dataset.gallery(view)
        assert [picture.path.resolve() for picture in queries] == [picture.path.resolve() for picture in gallery]
        assert where.of(queries) == where.of(gallery)
        of_queries, of_gallery = (
            descriptors.shipped_or_cached(model, pictures, view, DEMO, role)
            for role, pictures in (("query", queries), ("gallery", gallery))
        )
        np.testing.assert_array_equal(of_queries, of_gallery)
    assert not cache_folder().exists()  # nothing was described


def test_the_demo_is_all_there() -> None:
    dataset, plan = open_dataset(DEMO), json.loads((DEMO / "world.json").read_bytes())
    views = Counter(picture.label for picture in dataset.queries("drone"))
    tiles = [picture.label for picture in dataset.gallery("satellite")]
    assert len(tiles) >= 150
    assert views == dict.fromkeys(tiles, 8)
    assert sorted(building["id"] for building in plan["buildings"]) == tiles
    files = {file.relative_to(DEMO).as_posix() for file in (DEMO / "test").rglob("*.*")}
    assert {picture["path"] for picture in plan["pictures"]} == files
    assert DEMO_QUERY in [picture.name for picture in dataset.queries("drone")]
    assert sum(file.stat().st_size for file in DEMO.parent.rglob("*") if file.is_file()) < 48e6


def test_the_demo_s_flight_lies_on_its_map_and_near_the_truth() -> None:
    pytest.importorskip("rasterio")
    town, flight = open_map(DEMO_FLIGHT[0]), open_flight(DEMO_FLIGHT[1])
    assert len(flight.frames) == pack_flight.COUNT
    assert is_rendered_flight(DEMO_FLIGHT[1])
    for frame in flight.frames:
        assert None not in (frame.heading, frame.pitch, frame.roll, frame.fov, frame.height_above_takeoff, frame.time)
    west, south, east, north = town.bounds
    tags = town.frame.xy(*flight.degrees.T)
    assert ((tags > (west, south)) & (tags < (east, north))).all()
    with (DEMO_FLIGHT[0].parent / "truth.csv").open(newline="") as file:
        truth = {row["file"]: (float(row["latitude"]), float(row["longitude"])) for row in csv.DictReader(file)}
    places = town.frame.xy(*np.array([truth[frame.name] for frame in flight.frames]).T)
    errors = np.linalg.norm(tags - places, axis=1)
    assert 0.5 < np.median(errors) < 4  # a consumer receiver's
    assert errors.max() < 10


def test_the_demo_s_real_photos_lie_on_the_map_of_the_others() -> None:
    pytest.importorskip("rasterio")
    place, flight = open_map(DEMO_PLACE[0]), open_flight(DEMO_PLACE[1])
    assert [int(frame.file.stem[4:]) for frame in flight.frames] == sorted(
        int(f.stem[4:]) for f in DEMO_PLACE[1].iterdir()
    )
    assert DEMO_PHOTO in [frame.name for frame in flight.frames]
    assert not is_rendered_flight(DEMO_PLACE[1])
    assert "is made of 30 photos as if the ground were flat" in place.notes[0]
    assert (
        "Creative Commons" in (DEMO_PLACE[0].parent / "LICENSE.html").read_text()
        or "CC0" in (DEMO_PLACE[0].parent / "LICENSE.html").read_text()
    )
    west, south, east, north = place.bounds
    tags = place.frame.xy(*flight.degrees.T)
    assert ((tags > (west, south)) & (tags < (east, north))).all()


def test_a_packed_flight_keeps_its_metadata_and_its_map_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rasterio = pytest.importorskip("rasterio")
    monkeypatch.setitem(sys.modules, "tools.world.render", painting)
    made, packed = tmp_path / "made", tmp_path / "packed"
    build_flight(FlightSettings(seed=1, buildings=2, frames=9, width=64, samples=1, map_pixel=2.0), made)
    monkeypatch.setattr(pack_flight, "COUNT", 3)
    monkeypatch.setattr(sys, "argv", ["pack_flight.py", str(made), str(packed)])
    pack_flight.main()
    assert (packed / "flight_world.json").read_bytes() == (made / "flight_world.json").read_bytes()
    before = {frame.name: frame for frame in make_flight([made / "photos", made / "truth.csv"], tmp_path / "a").frames}
    after = make_flight([packed / DEMO_FLIGHT[1].name, packed / "truth.csv"], tmp_path / "b").frames
    assert [frame.name for frame in after] == [f"LPN_{number:04d}.webp" for number in (6, 7, 8)]
    for frame in after:
        original = before[frame.file.with_suffix(".JPG").name]
        assert replace(frame, name=original.name, file=original.file) == original
    with (
        rasterio.open(made / "map/map.tif") as large,
        rasterio.open(packed / DEMO_FLIGHT[0].name / "sheets/01.tif") as small,
    ):
        assert (large.crs, large.transform, large.shape) == (small.crs, small.transform, small.shape)
    (made / "unfinished.txt").touch()
    monkeypatch.setattr(sys, "argv", ["pack_flight.py", str(made), str(tmp_path / "other")])
    with pytest.raises(SystemExit, match="is not rendered to its end"):
        pack_flight.main()
