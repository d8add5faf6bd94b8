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
from lpn.training.recipes import RECIPES
from lpn.training.training_set import TrainingSet
from tools.fixtures import small_worlds

CPU = torch.device("cpu")
RECIPE = replace(RECIPES["world"], size=32, batch=4)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("loader") / "places", train=10, test=0)


def loader(data: Path, **options: Any) -> Loader:
    return Loader(TrainingSet(open_dataset(data), Console(quiet=True)), RECIPE, CPU, **options)


def same(one: TrainingBatch, two: TrainingBatch) -> bool:
    return all(torch.equal(one.labels[k], two.labels[k]) for k in one.labels) and all(
        torch.equal(one.sets[k], two.sets[k]) for k in one.sets
    )


def test_batches_do_not_depend_on_the_number_of_workers_or_on_where_a_run_begins(data: Path) -> None:
    one, many = (list(loader(data, workers=n).stream(0, 3)) for n in (1, 5))
    assert len(one) == 3 * (10 // 4)
    assert all(same(a, b) for a, b in zip(one, many, strict=True))
    resumed = list(loader(data, workers=2).stream(2, 3))
    assert all(same(a, b) for a, b in zip(one[-2:], resumed, strict=True))
    assert not same(one[0], one[2])


def test_processes_shares_make_the_batch(data: Path) -> None:
    whole = next(loader(data).stream(0, 1))
    first, second = (next(loader(data, share=rows).stream(0, 1)) for rows in (slice(0, 2), slice(2, 4)))
    for name, pictures in whole.sets.items():
        assert torch.equal(torch.cat([first.sets[name], second.sets[name]]), pictures)
        assert torch.equal(first.labels[name], whole.labels[name])


def test_pictures_are_normalised_as_everywhere_and_channels_last(data: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (8, 6, 3), np.uint8)
    given = loader(data)._network_input([picture, picture[::-1]])
    np.testing.assert_array_equal(given[0].numpy(), images.normalise(picture))
    assert given.is_contiguous(memory_format=torch.channels_last)


def test_a_picture_is_decoded_once(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[Path] = []
    load = images.load_picture
    monkeypatch.setattr(images, "load_picture", lambda path: (decoded.append(path), load(path))[1])
    assert len(list(loader(data, workers=1).stream(0, 6))) == 12
    assert len(decoded) == len(set(decoded)) == 20


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
    assert choose_workers(torch.device("cuda")) >= choose_workers(CPU) >= choose_workers(CPU, 1000) == 1
    assert loader(data, workers=7).workers == 7
    with pytest.raises(InputError, match="number of workers is -1"):
        loader(data, workers=-1)
