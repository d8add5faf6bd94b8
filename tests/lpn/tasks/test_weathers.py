"""Retrieval in the ten weathers: weather falls on drone pictures, whichever side they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.cli import main
from lpn.core.errors import InputError
from lpn.datasets import labels_of, open_dataset
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import WEATHERS, Weather
from lpn.retrieval import describe_picture, metrics
from lpn.tasks.changes import changed, in_weather
from lpn.tasks.measure import measure
from lpn.tasks.opening import lazy_task
from lpn.tasks.weathers import measure_weathers


def test_weather_falls_on_the_drone_pictures_of_the_gallery(data: Path, model_file: Path) -> None:
    model, dataset = lpn.load(model_file), open_dataset(data)
    change = Change(weather=Weather("dark"))
    result = measure(changed(lazy_task(model, dataset, "satellite-to-drone"), change))
    tiles, photos = dataset.queries("satellite"), dataset.gallery("drone")
    expected = metrics.evaluate(
        np.stack([describe_picture(model, one.load(), "satellite").descriptor for one in tiles]),
        labels_of(tiles),
        np.stack([describe_picture(model, one.load(), "drone", change).descriptor for one in photos]),
        labels_of(photos),
    )
    assert [result.recall["1"], result.ap] == pytest.approx([expected["recall@1"], expected["ap"]])
    assert "gallery pictures in the dark" in result.sentence


@pytest.mark.slow
def test_all_weathers_print_the_leaderboards_table(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "weathers.json"
    command = ["evaluate", str(data), "--model", str(model_file), "--weather"]
    assert main.main([*command, "all", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    written = json.loads(out.read_text())
    assert list(written["weathers"]) == list(WEATHERS)
    for task in ("drone-to-satellite", "satellite-to-drone"):
        of_task = [results[task]["ap"] for results in written["weathers"].values()]
        assert written["mean"][task]["ap"] == pytest.approx(np.mean(of_task))
        assert len(set(of_task)) > 3
        assert task in printed
    assert f"{written['mean']['satellite-to-drone']['ap']:.2f}" in printed.split("mean")[1]
    assert main.main([*command, "rain", "--json", str(out)]) == 0
    rain = json.loads(out.read_text())
    assert rain["weather"] == {"name": "rain", "strength": 1.0, "seed": 0}
    assert rain["ap"] == written["weathers"]["rain"]["drone-to-satellite"]["ap"]


def test_tiles_have_no_weather(data: Path, model_file: Path) -> None:
    task = replace(
        lazy_task(lpn.load(model_file), open_dataset(data), "satellite-to-drone"), name="satellite-to-satellite"
    )
    with pytest.raises(InputError, match="satellite tiles on both sides"):
        measure_weathers([task])
    with pytest.raises(InputError, match="satellite tiles on both sides"):
        in_weather(task, "fog")
