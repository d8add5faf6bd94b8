"""What ships is what it says it is."""

from __future__ import annotations

import io
import json
from collections import Counter

import numpy as np
import pytest
import trimesh

import lpn
from lpn import descriptors
from lpn.core import images
from lpn.core.demo import DEMO, DEMO_QUERY
from lpn.datasets import open_dataset
from lpn.datasets.city_model import city_model
from lpn.datasets.geo import Positions, on_plane


@pytest.mark.parametrize(("folder", "view"), [("query_drone", "drone"), ("gallery_satellite", "satellite")])
def test_the_demo_s_descriptors_are_its_model_s(folder: str, view: str) -> None:
    model, dataset = lpn.load(DEMO / "lpn.onnx"), open_dataset(DEMO)
    pictures = dataset.queries("drone") if view == "drone" else dataset.gallery("satellite")
    shipped = descriptors.shipped_descriptors(model, pictures, view, DEMO / "descriptors" / folder)  # type: ignore[arg-type]
    assert shipped is not None
    some = range(0, len(pictures), max(1, len(pictures) // 6))
    prepared = np.stack([images.prepare(images.load_picture(pictures[i].path), model.input_size) for i in some])
    found = model.descriptors(prepared, view)  # type: ignore[arg-type]
    error = 1e-2 if view == "drone" else 1e-3  # 8 bits and 16
    np.testing.assert_allclose(shipped[list(some)], found, atol=error * float(np.abs(found).max()))


def test_the_demo_is_all_there() -> None:
    dataset, plan = open_dataset(DEMO), json.loads((DEMO / "world.json").read_bytes())
    views = Counter(picture.label for picture in dataset.queries("drone"))
    tiles = [picture.label for picture in dataset.gallery("satellite")]
    assert len(tiles) >= 150
    assert views == dict.fromkeys(tiles, 8)
    assert sorted(building["id"] for building in plan["buildings"]) == tiles
    files = {file.relative_to(DEMO).as_posix() for file in (DEMO / "test").rglob("*") if file.is_file()}
    assert {picture["path"] for picture in plan["pictures"]} == files
    assert DEMO_QUERY in [picture.name for picture in dataset.queries("drone")]


def test_the_demo_s_city_stands_where_its_tiles_are() -> None:
    city = city_model(DEMO)
    assert city is not None
    places = Positions(DEMO).of(open_dataset(DEMO).gallery("satellite"))
    model = trimesh.load(io.BytesIO(city.data), file_type="glb", force="scene")
    (west, _, south), (east, _, north) = model.bounds  # -z is north
    ground = on_plane(places, city.origin)
    assert (ground.min(axis=0) > (west, -north)).all()
    assert (ground.max(axis=0) < (east, -south)).all()


def test_every_picture_of_the_demo_has_its_position() -> None:
    dataset, where = open_dataset(DEMO), Positions(DEMO)
    for pictures in (dataset.queries("drone"), dataset.gallery("satellite")):
        assert len(where.of(pictures)) == len(pictures) > 0
    assert sum(file.stat().st_size for file in DEMO.parent.rglob("*") if file.is_file()) < 40e6
