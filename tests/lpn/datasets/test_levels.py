"""What people give in place of a data set's folder, and the folder that the message names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from lpn.cli import main
from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.datasets.layouts.university import University
from lpn.training.training_set import TrainingSet
from tools.fixtures import layouts, small_worlds


def refusal(root: Path | str) -> str:
    with pytest.raises(DataError) as caught:
        open_dataset(root)
    return str(caught.value)


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (layouts.university_gaps, "test"),
        (layouts.university_gaps, "train"),
        (layouts.university_gaps, "test/query_drone/0004"),
        (layouts.sues, "Testing"),
        (layouts.sues, "Testing/150/query_drone"),
        (layouts.sues_raw, "drone_view_512"),
        (layouts.denseuav, "train/drone"),
        (layouts.cvusa, "streetview"),
        (layouts.vigor, "splits/Seattle"),
        (layouts.gta, "drone"),
        (layouts.univ, "45/2fps/test"),
    ],
)
def test_a_part_of_a_data_set_names_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], Path], part: str
) -> None:
    root = make(tmp_path / "release")
    assert refusal(root / part) == f"{root / part} is the part {part} of a data set; give {root}."
    monkeypatch.chdir(tmp_path)
    assert refusal(f"release/{part}") == f"release/{part} is the part {part} of a data set; give release."
    monkeypatch.chdir(root / part)
    assert refusal(".") == f". is the part {part} of a data set; give {root}."


@pytest.mark.parametrize("around", ["", "University-Release", "downloads/University-Release"])
def test_a_folder_around_a_data_set_names_the_one_inside(tmp_path: Path, around: str) -> None:
    top = tmp_path / "data"
    root = layouts.university_gaps(top / around / "University-Release")
    for folder, name in (("__MACOSX/University-Release/test/query_drone/0001", "._a.jpg"), ("empty", ".DS_Store")):
        (top / folder).mkdir(parents=True)
        (top / folder / name).write_bytes(b"\0")
    for name in ("Thumbs.db", "desktop.ini", "._University-Release", "readme.txt"):
        (top / name).write_bytes(b"\0")
    inside = root.relative_to(top).as_posix()
    assert refusal(top) == f"{top} holds folders of data sets: {inside}; give {root}."


def test_what_systems_leave_in_a_data_set_is_no_part_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = layouts.university_gaps(tmp_path / "University-Release")
    before = open_dataset(root).lists()
    for folder in (".", "train", "train/drone", "train/drone/0001", "test/gallery_street", "test/query_drone/0004"):
        for junk in ("__MACOSX", "@eaDir", "$RECYCLE.BIN", ".ipynb_checkpoints"):
            small_worlds.write(root / folder / junk / "a.jpg", layouts.small(1))
        for name in (".DS_Store", "Thumbs.db", "desktop.ini", "._image-01.jpg"):
            (root / folder / name).write_bytes(b"\0\5\26\7")
    (root / "extra").mkdir()
    assert open_dataset(root).lists() == before
    assert main.main(["doctor", "--data", str(root)]) == 0
    assert "Nothing is broken." in capsys.readouterr().out


def test_a_folder_of_pictures_is_no_training_set(tmp_path: Path) -> None:
    for view in ("drone", "satellite"):
        small_worlds.write(tmp_path / "alike" / view / "1.jpg", layouts.small(1))
    with pytest.raises(DataError, match="alike is a folder of pictures, and nothing says which of them show the same"):
        TrainingSet(open_dataset(tmp_path / "alike"), Console(quiet=True))


def test_a_folder_that_may_not_be_read_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(folder: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(folder))

    small_worlds.write(tmp_path / "drone" / "a" / "1.jpg", layouts.small(1))
    monkeypatch.setattr(University, "recognises", refused)
    assert open_dataset(tmp_path / "drone").kind == "folder"
    assert open_dataset(tmp_path).kind == "folder"


def test_a_file_and_an_absent_folder_are_told(tmp_path: Path) -> None:
    root = layouts.pairs(tmp_path / "mine", "satellite,drone\nb.jpg,1.jpg\n")
    assert (
        refusal(root / "pairs.csv") == f"{root / 'pairs.csv'} is a file; expected a data set's folder, so give {root}."
    )
    lone = tmp_path / "list.txt"
    lone.touch()
    assert refusal(lone) == f"{lone} is a file; expected a data set's folder, so check the path."
    absent = tmp_path / "University-Release"
    assert refusal(absent) == f"There is no data set folder at {absent}; check the path."


@pytest.mark.parametrize(
    ("name", "todo"),
    [
        ("University-Release.zip", "unpack it first, and give the folder that it makes"),
        ("DJI_0001.MP4", "make a flight of it with lpn flight, and give that with a --map"),
        ("net_119.pth", "give it as --model, beside a data set's folder"),
    ],
)
def test_an_archive_a_video_or_a_model_in_place_of_a_data_set_says_what_to_do(
    tmp_path: Path, name: str, todo: str
) -> None:
    (tmp_path / name).write_bytes(b"what it holds does not matter")
    assert refusal(tmp_path / name) == f"{tmp_path / name} is a file; expected a data set's folder, so {todo}."
    assert refusal(tmp_path) == f"{tmp_path} holds {name}; {todo}."
