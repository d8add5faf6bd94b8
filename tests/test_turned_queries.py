"""The two readings of a query that is described at several turns, measured by the program on small data."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.datasets import open_dataset
from lpn.descriptors import descriptor_reader
from lpn.descriptors.transforms import Change
from lpn.retrieval.calibration import calibrate
from tools.fixtures import small_worlds
from tools.fixtures.programs import run_program


def test_each_set_of_turns_is_averaged_and_searched(
    tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, out = small_worlds.make_dataset(tmp_path / "places", train=1, test=24), tmp_path / "turns.json"
    run_program(monkeypatch, "tools.turned_queries", data, model_file, "--out", out)
    found = json.loads(out.read_bytes())
    assert (found["queries"], found["data"], found["model"]) == (24, "places", str(model_file))
    # By hand, for the first set and for three turns.
    dataset, model = open_dataset(data), lpn.load(model_file)
    read = descriptor_reader(dataset.root)
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    calibration = calibrate(model, {"drone": [queries], "satellite": [gallery]}, read)
    tiles = calibration.read(model, gallery, "satellite", read)
    places = np.array([picture.label for picture in gallery])
    labels = np.array([picture.label for picture in queries])
    turned = [calibration.read(model, queries, "drone", read, Change(float(turn))) for turn in (-10, 0, 10)]
    for row, descriptors in zip(found["rows"], ([turned[1]], turned), strict=False):
        scores = np.array([np.einsum("qnd,gnd->qg", one, tiles) for one in descriptors])
        searched = places[scores.max(axis=0).argmax(axis=1)] == labels
        total = np.sum(descriptors, axis=0)
        total /= np.linalg.norm(total, axis=2, keepdims=True)
        averaged = places[np.einsum("qnd,gnd->qg", total, tiles).argmax(axis=1)] == labels
        assert row["search"] == pytest.approx(100 * searched.mean())
        assert row["average"] == pytest.approx(100 * averaged.mean())
        for name in ("average", "search"):
            gain = row[f"{name} gain"]
            assert gain["difference"] == pytest.approx(row[name] - found["rows"][0][name])
            assert gain["interval"][0] <= gain["difference"] <= gain["interval"][1]
    assert [row["turns"] for row in found["rows"][:2]] == [[0], [-10, 0, 10]]
