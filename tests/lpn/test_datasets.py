from __future__ import annotations

import os
from pathlib import Path

import pytest

from lpn.datasets import open_dataset
from lpn.errors import DataError
from tests import worlds


def test_the_layout_is_read_in_order_of_place_and_file(data: Path) -> None:
    dataset = open_dataset(data)
    assert dataset.tasks() == ["drone-to-satellite", "satellite-to-drone"]
    queries = dataset.queries("drone")
    assert [picture.label for picture in queries] == list(range(7, 21))
    assert [picture.name for picture in queries] == [f"{i:04d}" for i in range(7, 21)]
    assert [picture.label for picture in dataset.train("satellite")] == list(range(1, 7))
    assert dataset.train("google") == []


def test_several_pictures_of_a_place_are_told_apart(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.JPEG", "image-03.png", "notes.txt"):
        path = tmp_path / "test" / "query_drone" / "0012" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    pictures = open_dataset(tmp_path).queries("drone")
    assert [(p.name, p.label) for p in pictures] == [("0012/a", 12), ("0012/b", 12), ("0012/03", 12)]


def test_hidden_files_and_folders_are_not_places(tmp_path: Path) -> None:
    for name in (".ipynb_checkpoints/a.jpg", "0001/._a.jpg", "0001/a.jpg"):
        worlds.write(tmp_path / "test" / "query_drone" / name, worlds.place(1))
    assert [p.path.name for p in open_dataset(tmp_path).queries("drone")] == ["a.jpg"]


def test_names_can_always_be_shown_and_sent(tmp_path: Path) -> None:
    folder = tmp_path / "test" / "query_drone" / "0001"
    folder.mkdir(parents=True)
    for name in (b"caf\xe9.png", b"two\nlines.png"):
        (folder / os.fsdecode(name)).write_bytes(b"")
    names = [picture.name for picture in open_dataset(tmp_path).queries("drone")]
    assert names == ["0001/caf?", "0001/two?lines"]
    assert all(name.encode() for name in names)


def test_what_is_wrong_with_a_folder_is_said_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no data set folder"):
        open_dataset(tmp_path / "absent")
    (tmp_path / "other").mkdir()
    with pytest.raises(DataError, match="holds other; expected train and test as in University-1652"):
        open_dataset(tmp_path)
    (tmp_path / "test" / "query_drone" / "0001").mkdir(parents=True)
    with pytest.raises(DataError, match="no pictures in it at test/query_drone"):
        open_dataset(tmp_path).queries("drone")
    with pytest.raises(DataError, match="no such folder at test/gallery_satellite"):
        open_dataset(tmp_path).gallery("satellite")
    worlds.write(tmp_path / "test" / "query_drone" / "castle" / "a.png", worlds.place(1))
    with pytest.raises(DataError, match="castle in test/query_drone is not a number"):
        open_dataset(tmp_path).queries("drone")
