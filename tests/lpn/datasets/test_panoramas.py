"""CVUSA and CVACT, whose pairs are a tile and a panorama."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.io import savemat

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.training.training_set import TrainingSet
from tests.conftest import Refused
from tools.fixtures import layouts, small_worlds


@pytest.mark.parametrize(
    ("make", "lost", "labels"),
    [
        (layouts.cvusa, "streetview/panos/0000006.jpg", [5, 7]),
        (layouts.cvact, "satview_polish/_gAbCdEfGhIjKlMnOpQr-7_satView_polish.jpg", [5]),
    ],
)
def test_pairs_that_lack_a_picture_are_left_out_and_named(
    make: Callable[[Path], Path], lost: str, labels: list[int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (make(tmp_path) / lost).unlink()
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(tmp_path)
    assert [p.label for p in dataset.queries("street")] == [p.label for p in dataset.gallery("satellite")] == labels
    assert [item.file for item in dataset.left_out] == [lost]
    (message,) = caplog.messages
    assert f": 1 listed file, {lost} (is not there)" in message


def test_pairs_are_read_from_the_splits(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.cvusa(tmp_path))
    assert (dataset.kind, dataset.panoramas) == ("CVUSA", True)
    assert dataset.tasks() == ["street-to-satellite", "satellite-to-street"]
    assert [p.label for p in dataset.train("satellite")] == [p.label for p in dataset.train("street")] == [1, 2, 3, 4]
    assert [p.label for p in dataset.queries("street")] == [p.label for p in dataset.gallery("satellite")] == [5, 6, 7]
    assert dataset.queries("street")[0].path == tmp_path / "streetview" / "panos" / "0000005.jpg"
    assert dataset.gallery("satellite")[0].path == tmp_path / "bingmap" / "19" / "0000005.jpg"
    assert dataset.truth("street-to-satellite") is None
    assert list(dataset.lists()) == ["train/satellite", "train/street", "test/satellite", "test/street"]
    assert dataset.published_sizes["test/street"].pictures == 8884
    assert TrainingSet(dataset, Console()).views == ("satellite", "street")
    with pytest.raises(DataError, match="no test queries of drone pictures"):
        dataset.queries("drone")


def test_numbers_that_do_not_agree_give_way_to_the_rows(tmp_path: Path) -> None:
    layouts.cvusa(tmp_path)
    file = tmp_path / "splits" / "val-19zl.csv"
    file.write_text(file.read_text().replace("panos/0000006", "panos/0000099"))
    small_worlds.write(tmp_path / "streetview" / "panos" / "0000099.jpg", layouts.small(1))
    dataset = open_dataset(tmp_path)
    assert [p.label for p in dataset.train("street")] == [0, 1, 2, 3]
    assert [(p.label, p.name) for p in dataset.queries("street")] == [(4, "0000005"), (5, "0000099"), (6, "0000007")]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (
            "bingmap/19/0000005.jpg",
            r"Line 4 of splits/val-19zl\.csv has the wrong number of values, 1; expected a tile",
        ),
        ("a,b,c,d", "values, 4;"),
        ("../secret.jpg,streetview/panos/0000005.jpg,", r"Line 4 .* names the file '\.\./secret\.jpg'"),
        (",streetview/panos/0000005.jpg,", "names the file ''"),
    ],
)
def test_a_wrong_line_is_named(line: str, said: str, tmp_path: Path) -> None:
    layouts.cvusa(tmp_path)
    with (tmp_path / "splits" / "val-19zl.csv").open("a") as file:
        file.write(f"{line}\n")
    with pytest.raises(DataError, match=said):
        open_dataset(tmp_path)


def test_other_damage_is_said(tmp_path: Path) -> None:
    root = layouts.cvusa(tmp_path / "a")
    (root / "splits" / "train-19zl.csv").write_bytes(b"\xff\xfe\x00bing")
    with pytest.raises(DataError, match=r"splits/train-19zl\.csv is not text in UTF-8"):
        open_dataset(root)
    root = layouts.cvusa(tmp_path / "b")
    (root / "bingmap").rename(root / "bing")
    with pytest.raises(DataError, match=r"the first file left out is bingmap/19/0000001\.jpg"):
        open_dataset(root)


@pytest.mark.parametrize("inner", ["", "ANU_data_small"])
def test_pairs_are_read_from_the_matlab_file(inner: str, tmp_path: Path) -> None:
    dataset = open_dataset(layouts.cvact(tmp_path, inner))
    assert (dataset.kind, dataset.panoramas) == ("CVACT", True)
    assert dataset.tasks() == ["street-to-satellite", "satellite-to-street"]
    assert [p.label for p in dataset.train("satellite")] == [p.label for p in dataset.train("street")] == [2, 3, 4]
    queries, gallery = dataset.queries("street"), dataset.gallery("satellite")
    assert [p.label for p in queries] == [p.label for p in gallery] == [5, 7]
    name = "_eAbCdEfGhIjKlMnOpQr-5"
    assert queries[0].path == tmp_path / inner / "streetview" / f"{name}_grdView.jpg"
    assert gallery[0].path == tmp_path / inner / "satview_polish" / f"{name}_satView_polish.jpg"
    assert queries[0].name == name


def test_one_pair_a_split_is_enough(tmp_path: Path) -> None:
    layouts.cvact(tmp_path)
    ids = sorted(file.name.removesuffix("_grdView.jpg") for file in (tmp_path / "streetview").iterdir())
    layouts.save_act(tmp_path, ids, [1], [2])
    assert [p.label for p in open_dataset(tmp_path).train("street")] == [1]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"trainSet": None}, "has other variables inside than CVACT's; expected a MATLAB 5 file with panoIds"),
        ({"trainSet": 5.0}, "has other variables inside than CVACT's"),
        ({"valSet": {"valInd": np.array([[0.0]])}}, "test rows that are not whole numbers from 1 to 3"),
        ({"valSet": {"valInd": np.array([[4.0]])}}, "test rows that are not whole numbers from 1 to 3"),
        ({"valSet": {"valInd": np.array([[1.5]])}}, "test rows that are not whole numbers from 1 to 3"),
        ({"valSet": {"valInd": np.array([["x"]])}}, "test rows that are not whole numbers"),
        ({}, "the first file left out is"),
    ],
)
def test_what_is_wrong_with_the_matlab_file_is_said(values: dict[str, object], said: str, tmp_path: Path) -> None:
    whole = {"trainSet": {"trainInd": np.array([[1.0]])}, "valSet": {"valInd": np.array([[2.0]])}}
    whole["panoIds"] = np.array(["abc", "def", "ghi"])
    savemat(tmp_path / "ACT_data.mat", {name: of for name, of in (whole | values).items() if of is not None})
    with pytest.raises(DataError, match=said):
        open_dataset(tmp_path)


def test_without_scipy_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    root = layouts.cvact(tmp_path)
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert "lpn-explorer[train]" in refused("doctor", "--data", root)
