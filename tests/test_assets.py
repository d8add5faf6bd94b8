"""What ships is what it says it is."""

from __future__ import annotations

import numpy as np
import pytest

import lpn
from lpn import features, images
from lpn.cli import DEMO
from lpn.datasets import open_dataset
from lpn.geo import Positions


@pytest.mark.parametrize(("folder", "view"), [("query_drone", "drone"), ("gallery_satellite", "satellite")])
def test_the_demo_s_descriptors_are_its_model_s(folder: str, view: str) -> None:
    model, dataset = lpn.load(DEMO / "lpn.onnx"), open_dataset(DEMO)
    pictures = dataset.queries("drone") if view == "drone" else dataset.gallery("satellite")
    shipped = features.shipped_descriptors(model, pictures, view, DEMO / "descriptors" / folder)  # type: ignore[arg-type]
    assert shipped is not None
    some = range(0, len(pictures), max(1, len(pictures) // 6))
    prepared = np.stack([images.prepare(images.load_picture(pictures[i].path), model.input_size) for i in some])
    found = model.descriptors(prepared, view)  # type: ignore[arg-type]
    np.testing.assert_allclose(shipped[list(some)], found, atol=1e-3 * float(np.abs(found).max()))


def test_every_picture_of_the_demo_has_its_position() -> None:
    dataset, where = open_dataset(DEMO), Positions(DEMO)
    for pictures in (dataset.queries("drone"), dataset.gallery("satellite")):
        assert len(where.of(pictures)) == len(pictures) > 0
    assert sum(file.stat().st_size for file in DEMO.parent.rglob("*") if file.is_file()) < 40e6
