from __future__ import annotations

import shutil
import threading
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from lpn.core import images
from lpn.core.errors import InputError, PictureError
from lpn.datasets import open_dataset
from lpn.training.loader import Loader, TrainingBatch, choose_workers
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES
from lpn.training.training_set import TrainingSet
from tools.fixtures import small_worlds

CPU = torch.device("cpu")
RECIPE = replace(RECIPES["world"], size=32, batch=4)
# Pictures as they are, so that a batch tells which files it has.
INDEPENDENT = replace(RECIPES["released"], size=32, batch=4, padding=0, satellite_rotation=0.0, flip="none")
BOTH = pytest.mark.parametrize("recipe", [RECIPE, INDEPENDENT], ids=["places", "pictures"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("loader") / "places", train=10, test=0)


def loader(data: Path, recipe: Recipe = RECIPE, **options: Any) -> Loader:
    return Loader(TrainingSet(open_dataset(data), Console(quiet=True)), recipe, CPU, **options)


def same(one: TrainingBatch, two: TrainingBatch) -> bool:
    return all(torch.equal(one.labels[k], two.labels[k]) for k in one.labels) and all(
        torch.equal(one.sets[k], two.sets[k]) for k in one.sets
    )


@BOTH
def test_batches_do_not_depend_on_the_number_of_workers_or_on_where_a_run_begins(data: Path, recipe: Recipe) -> None:
    one, many = (list(loader(data, recipe, workers=n).stream(0, 3)) for n in (1, 5))
    assert len(one) == 3 * (10 // 4)
    assert all(same(a, b) for a, b in zip(one, many, strict=True))
    resumed = list(loader(data, recipe, workers=2).stream(2, 3))
    assert all(same(a, b) for a, b in zip(one[-2:], resumed, strict=True))
    assert not same(one[0], one[2])


def test_a_batch_larger_than_the_smallest_set_is_refused(data: Path) -> None:
    for recipe, what in ((RECIPE, "10 places"), (INDEPENDENT, "10 pictures in the smallest set, satellite,")):
        with pytest.raises(InputError, match=f"There are {what} and a batch of 12; set --batch to at most 10"):
            loader(data, replace(recipe, batch=12))


def test_an_error_in_a_worker_reaches_the_caller_and_the_workers_stop(data: Path, tmp_path: Path) -> None:
    shutil.copytree(data, tmp_path / "places")
    broken = tmp_path / "places" / "train" / "drone" / "0003" / "image-01.png"
    made = loader(tmp_path / "places", workers=3)
    broken.write_bytes(broken.read_bytes()[:300])  # after the check at the start
    with pytest.raises(PictureError, match=r"0003/image-01\.png"):
        list(made.stream(0, 2))
    stream: Any = loader(data, workers=3).stream(0, 1000)
    with closing(stream):
        assert len(list(islice(stream, 2))) == 2
        assert any(thread.name.startswith("lpn-loader") for thread in threading.enumerate())
    assert not any(thread.name.startswith("lpn-loader") for thread in threading.enumerate())


def test_workers_suit_the_machine_and_can_be_given(data: Path) -> None:
    assert choose_workers(CPU) >= 1
    assert choose_workers(torch.device("cuda")) >= choose_workers(CPU)
    assert loader(data, workers=7).workers == 7
    with pytest.raises(InputError, match="number of workers is -1"):
        loader(data, workers=-1)


def test_the_released_metric_losses_have_several_drone_pictures_of_each_place(tmp_path: Path) -> None:
    """A place gives that many different pictures, and repeats them only if it has fewer."""
    counts = {label: 6 if label < 5 else 2 for label in range(1, 7)}
    for label, count in counts.items():
        small_worlds.write(tmp_path / f"train/satellite/{label:04d}/a.png", small_worlds.place(label))
        for number in range(count):
            file = tmp_path / f"train/drone/{label:04d}/{number}.png"
            small_worlds.write(file, small_worlds.place(100 * label + number))
    recipe = replace(RECIPES["metric-released"], size=32, batch=6, flip="none")
    made = loader(tmp_path, recipe)
    known = {images.prepare(images.load_picture(f), (32, 32)).tobytes(): f for f in tmp_path.rglob("drone/*/*.png")}
    for batch in made.stream(0, 3):
        assert batch.labels["drone"].tolist() == batch.labels["satellite"].repeat_interleave(4).tolist()
        assert (batch.pictures, len(batch.sets["drone"])) == (6 + 24, 24)
        for place, of in zip(batch.labels["satellite"].tolist(), batch.sets["drone"].split(4), strict=True):
            files = [nearest(known, picture.numpy()) for picture in of]
            assert {file.parent.name for file in files} == {f"{place + 1:04d}"}
            assert len(set(files)) == min(4, counts[place + 1])


def nearest(known: dict[bytes, Path], picture: np.ndarray[Any, Any]) -> Path:
    """Return the file whose network input a picture is; normalising on the device rounds otherwise."""
    table = np.stack([np.frombuffer(data, np.float32) for data in known])
    return list(known.values())[int(np.abs(table - picture.reshape(-1)).max(axis=1).argmin())]
