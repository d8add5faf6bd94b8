from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn import images, metrics
from lpn.changes import Change
from lpn.datasets import Picture, open_dataset
from lpn.errors import InputError
from lpn.evaluate import evaluate
from lpn.model import FloatArray, Model
from lpn.protocol import Protocol


def described(model: Model, pictures: list[Picture], view: str, angle: float = 0.0) -> FloatArray:
    turned = [images.rotate(images.load_picture(picture.path), angle) for picture in pictures]
    return model.descriptors(np.stack([images.prepare(p, model.input_size) for p in turned]), view)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("task", "rotate", "parts"),
    [("drone-to-satellite", 0.0, None), ("satellite-to-drone", 30.0, [2]), ("drone-to-satellite", -90.0, [4, 1, 4])],
)
def test_figures_are_those_of_the_turned_queries_and_the_chosen_parts(
    data: Path, model_file: Path, task: str, rotate: float, parts: list[int] | None
) -> None:
    model, dataset = lpn.load(model_file), open_dataset(data)
    found = evaluate(model, dataset, task, Protocol(Change(rotate), None if parts is None else tuple(parts)))
    query_view, gallery_view = task.split("-to-")
    queries, gallery = dataset.queries(query_view), dataset.gallery(gallery_view)
    index = [part - 1 for part in dict.fromkeys(parts)] if parts else list(range(4))
    expected = metrics.evaluate(
        described(model, queries, query_view, rotate)[:, index],
        [picture.label for picture in queries],
        described(model, gallery, gallery_view)[:, index],
        [picture.label for picture in gallery],
    )
    for key in ("recall@1", "recall@5", "recall@10", "recall@1%", "ap"):
        assert found.to_dict()[key] == pytest.approx(expected[key])
    assert found.parts == tuple(i + 1 for i in index)


def test_figures_in_training_leave_nothing_in_the_cache(data: Path, model_file: Path) -> None:
    model, dataset = lpn.load(model_file), open_dataset(data)
    passing = evaluate(model, dataset, "drone-to-satellite", cached=False)
    assert not Path(os.environ["LPN_CACHE"]).exists()
    assert passing.recall == evaluate(model, dataset, "drone-to-satellite").recall


@pytest.mark.parametrize("parts", [(), (0,), (5,)])
def test_parts_that_do_not_exist_are_refused(data: Path, model_file: Path, parts: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="parts 1 to 4"):
        evaluate(lpn.load(model_file), open_dataset(data), "drone-to-satellite", Protocol(parts=parts))
