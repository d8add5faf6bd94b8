"""Features carried over to landmarks as released, beside numbers of the released code; see `tools.fixtures.released_transfer`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core import images
from lpn.core.errors import InputError
from lpn.datasets import open_dataset
from lpn.models.base import Model
from lpn.models.checkpoints import load_torch, save
from lpn.tasks.changes import averaged, turned
from lpn.tasks.measure import measure
from lpn.tasks.opening import lazy_task
from tools.fixtures import layouts, released_transfer, small_worlds


def test_vectors_and_ap_are_the_released_ones() -> None:
    # Those of 1024 pixels are in docs/evaluation.md.
    found = released_transfer.differences(160)
    assert set(found) == {f"160.{name}" for name in ("map", "gallery", "queries", "scores")}
    assert max(found.values()) < 2e-5, found


def test_a_query_is_shrunk_by_the_factor_of_its_whole_picture() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (300, 2048, 3), np.uint8)
    assert images.shrink_to(picture, 1024).shape == (150, 1024, 3)
    assert images.shrink_to(picture, 1024, (10.4, 0.0, 410.4, 200.0)).shape == (100, 200, 3)
    # A small picture is never enlarged, and a box beyond the edge is filled with black.
    assert images.shrink_to(picture, 4096, (2000.0, 0.0, 2100.0, 300.0)).shape == (300, 100, 3)
    assert not images.shrink_to(picture, 4096, (2000.0, 0.0, 2100.0, 300.0))[:, 48:].any()


def test_the_released_protocol_is_measured_and_stated(tmp_path: Path) -> None:
    dataset, file = open_dataset(layouts.oxford(tmp_path / "oxford")), tmp_path / "lpn.safetensors"
    save(small_worlds.make_network(), file)
    model = load_torch(file)
    released = lazy_task(model, dataset, "street-to-street", branch="satellite", released=True)
    figures = measure(released).to_dict()
    assert "the mean over the last feature map, neither mirrored nor normalised, as released" in figures["protocol"]
    assert figures["protocol"].startswith("Protocol: pictures of at most 1024 pixels")
    assert figures["junk"] == "lists"
    result = measure(lazy_task(model, dataset, "street-to-street", branch="satellite"))
    assert "as released" not in result.sentence
    with pytest.raises(InputError, match="so queries cannot be turned"):
        turned(released, 90)
    with pytest.raises(InputError, match="only queries with labels can be averaged"):
        averaged(released)


def test_a_model_of_one_size_is_refused(model: Model, tmp_path: Path) -> None:
    root = layouts.oxford(tmp_path / "oxford")
    with pytest.raises(InputError, match=r"give one, or leave --protocol out"):
        measure(lazy_task(model, open_dataset(root), "street-to-street", branch="satellite", released=True))


def test_pictures_are_turned_to_the_nearest_pixel() -> None:
    picture = small_worlds.place(1)
    turned = images.rotate_nearest(picture, 45)
    # Only values of the picture, and black corners; bicubic makes new ones.
    known = {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()} | {(0, 0, 0)}
    assert {tuple(pixel) for pixel in turned.reshape(-1, 3).tolist()} <= known
    assert not {tuple(pixel) for pixel in images.rotate(picture, 45).reshape(-1, 3).tolist()} <= known
    assert not turned[0, 0].any()
    # Both turn counter-clockwise.
    assert np.array_equal(images.rotate_nearest(picture, 90), np.rot90(picture))
    assert np.abs(cv2.blur(turned, (5, 5)).astype(int) - cv2.blur(images.rotate(picture, 45), (5, 5))).mean() < 12


def test_turned_queries_have_descriptors_of_their_own_in_the_released_protocol(model: Model, tmp_path: Path) -> None:
    dataset = open_dataset(small_worlds.make_dataset(tmp_path / "places", train=0, test=4))
    tasks = [lazy_task(model, dataset, "satellite-to-drone", released=released) for released in (False, True)]
    said = [measure(turned(task, 45)).sentence for task in tasks]
    assert "queries turned 45°, bicubic" in said[0]
    assert "queries turned 45° (nearest pixel)" in said[1]
    assert "without their EXIF orientation" in said[1]
    assert "EXIF" not in said[0]
