"""Figures of a whole task with turned queries are those of `lpn evaluate --rotate`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import lpn
from lpn.cli import main
from lpn.core.errors import InputError
from lpn.core.progress import listening
from lpn.datasets import open_dataset
from lpn.tasks.opening import calibrated, describe_task
from lpn.tasks.turned import turned, why_not
from tools.fixtures import small_worlds


@pytest.mark.parametrize("options", [[], ["--calibrate"]])
def test_turned_queries_have_the_figures_of_evaluate(options: list[str], model_file: Path, tmp_path: Path) -> None:
    data, out = small_worlds.make_dataset(tmp_path / "places", train=1, test=24), tmp_path / "figures.json"
    model, dataset = lpn.load(model_file), open_dataset(data)
    task = describe_task(model, "lpn", dataset, calibration=calibrated(model, dataset) if options else None)
    upright = turned(task, 0)
    assert [upright.recall, upright.ap] == pytest.approx([task.metrics["recall@1"], task.metrics["ap"]])
    counts: list[tuple[int, int]] = []
    with listening(lambda _, *count: counts.append(count)):
        around = turned(task, -90)
    assert around.degrees == 270
    assert counts[0] == (0, 24)
    assert counts[-1] == (24, 24)
    common = ["evaluate", "--model", str(model_file), "--data", str(data), "--rotate", "270", "--json", str(out)]
    assert main.main([*common, *options]) == 0
    expected = json.loads(out.read_text())
    assert [around.recall, around.ap] == pytest.approx([expected["recall@1"], expected["ap"]])
    assert around.queries == expected["queries"]
    again: list[tuple[int, int]] = []
    with listening(lambda _, *count: again.append(count)):
        assert turned(task, 270) == around
    assert not again  # all descriptors are cached


def test_a_stopped_turn_goes_on_where_it_was(data: Path, model_file: Path) -> None:
    task = describe_task(lpn.load(model_file), "lpn", open_dataset(data))

    def stop(_: str, done: int, __: int) -> None:
        if done:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"), listening(stop):
        turned(task, 33)
    counts: list[int] = []
    with listening(lambda _, done, __: counts.append(done)):
        turned(task, 33)
    assert counts[0] > 0


def test_descriptors_without_a_network_say_that_they_cannot_be_turned(data: Path, model_file: Path) -> None:
    task = replace(describe_task(lpn.load(model_file), "lpn", open_dataset(data)), model=None)
    assert "without their network" in why_not(task)
    with pytest.raises(InputError, match="cannot be turned"):
        turned(task, 45)
