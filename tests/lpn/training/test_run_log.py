from __future__ import annotations

import csv
from pathlib import Path

import pytest

from lpn.core.errors import InputError
from lpn.training.model_selection import EpochMetrics, best_epoch
from lpn.training.recipes import RECIPES
from lpn.training.run_folder import begin, read_run, save_log


def row(epoch: int, loss: float, **more: float) -> EpochMetrics:
    return {"epoch": epoch, "loss": loss, "lr": 1e-3, "seconds": 1.0, "images_per_second": 8.0, **more}


def test_the_log_has_each_epoch_once_and_columns_that_come_later(tmp_path: Path) -> None:
    history = [row(1, 4.0)]
    save_log(tmp_path, history)
    history.append(row(2, 3.0, **{"recall@1 drone-to-satellite": 25.0}))
    save_log(tmp_path, history)
    with (tmp_path / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [line["loss"] for line in rows] == ["4.0", "3.0"]
    assert [line["recall@1 drone-to-satellite"] for line in rows] == ["", "25.0"]


def test_run_json_is_read_again_and_a_damaged_one_refused(tmp_path: Path) -> None:
    assert read_run(tmp_path) is None
    made = begin(tmp_path, RECIPES["small"], {"data": "/home/a/places"})
    assert read_run(tmp_path) == made
    assert "/home" not in made.metadata()
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run\.json is damaged; start the run again without --resume"):
        read_run(tmp_path)


def test_the_best_epoch_is_the_first_of_the_highest() -> None:
    history = [row(1, 4.0, score=20.0), row(2, 3.0), row(3, 2.0, score=50.0), row(4, 1.0, score=50.0)]
    assert best_epoch(history, "score") == (3, 50.0)
    assert best_epoch(history, "other") is None
