from __future__ import annotations

import logging
from pathlib import Path

import pytest
from rich.console import Console

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.training.training_set import TrainingSet
from tools.fixtures import layouts, small_worlds


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


def test_pairs_that_lack_a_picture_are_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    layouts.cvusa(tmp_path)
    (tmp_path / "streetview" / "panos" / "0000006.jpg").unlink()
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(tmp_path)
    assert [p.label for p in dataset.queries("street")] == [p.label for p in dataset.gallery("satellite")] == [5, 7]
    assert [item.file for item in dataset.left_out] == ["streetview/panos/0000006.jpg"]
    assert len(caplog.messages) == 1
    assert "streetview/panos/0000006.jpg (is not there)" in caplog.text


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
        ("bingmap/19/0000005.jpg", r"Line 4 of splits/val-19zl\.csv has 1 values; expected a tile, a panorama"),
        ("a,b,c,d", "has 4 values"),
        ("../secret.jpg,streetview/panos/0000005.jpg,", r"Line 4 .* names the file '\.\./secret\.jpg'"),
        ("/etc/passwd,streetview/panos/0000005.jpg,", "expected a path below the data set's folder"),
        ("C:\\a.jpg,streetview/panos/0000005.jpg,", "expected a path below"),
        ("bingmap\\..\\..\\a.jpg,streetview/panos/0000005.jpg,", "expected a path below"),
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
    with pytest.raises(DataError, match=r"has no picture that can be used, for want of bingmap/19/0000001\.jpg"):
        open_dataset(root)
