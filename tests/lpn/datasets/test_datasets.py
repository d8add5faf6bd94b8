from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from tools.fixtures import layouts, small_worlds


def test_several_pictures_of_a_place_are_told_apart(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.JPEG", "image-03.png", "notes.txt"):
        path = tmp_path / "test" / "query_drone" / "0012" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    pictures = open_dataset(tmp_path).queries("drone")
    assert [(p.name, p.label) for p in pictures] == [("0012/a", 12), ("0012/b", 12), ("0012/03", 12)]


def test_pictures_of_common_kinds_are_read_and_others_named(tmp_path: Path) -> None:
    folder = tmp_path / "test" / "query_drone" / "0001"
    names = ("a.bmp", "b.gif", "c.tif", "d.TIFF", "e.jpg")
    for name in (*names, ".f.png", "._e.jpg", ".hidden/x.jpg"):
        small_worlds.write(folder / name, small_worlds.place(1))
    (folder / "photo.HEIC").write_bytes(b"")
    for name in ("README", ".DS_Store", "notes.txt"):
        (folder / name).write_text("text")
    photos = shutil.copytree(folder, tmp_path.with_name(f"{tmp_path.name}-photos"))
    for root, where in ((tmp_path, "test/query_drone/0001"), (photos, ".")):
        dataset = open_dataset(root)
        found = next(iter(dataset.lists().values()))
        assert [picture.path.name for picture in found] == list(names)
        assert [(item.file, item.why) for item in dataset.unread()] == [
            ((Path(where) / "photo.HEIC").as_posix(), "is of a kind that is not read; save it as JPEG")
        ]


def test_a_folder_without_a_task_says_what_it_lacks(tmp_path: Path) -> None:
    for number in range(3):
        small_worlds.write(tmp_path / "photos" / f"{number}.png", small_worlds.place(number))
    (tmp_path / "empty" / "test").mkdir(parents=True)
    small_worlds.write(tmp_path / "half" / "test" / "query_drone" / "0001" / "a.png", small_worlds.place(1))
    for name, lack in (
        ("photos", "is a folder of pictures, and nothing says which of them show the same place; name the pairs"),
        ("empty", "has no pictures to test with; expected queries of one view and a gallery of another"),
        ("half", "has only test/query_drone; expected queries of one view and a gallery of another"),
    ):
        dataset = open_dataset(tmp_path / name)
        assert dataset.tasks() == []
        assert dataset.why_no_task().startswith(lack)


def test_a_folder_of_the_test_split_may_be_a_text_with_the_name_of_another(data: Path, tmp_path: Path) -> None:
    root = shutil.copytree(data, tmp_path / "places")
    shutil.rmtree(root / "test" / "gallery_drone")
    (root / "test" / "gallery_drone").write_text("query_drone\n")  # Git's stand-in for a link on Windows
    dataset = open_dataset(root)
    assert dataset.tasks() == ["drone-to-satellite", "satellite-to-drone"]
    assert dataset.gallery("drone") == dataset.queries("drone")
    for text in ("../../etc", "nowhere", ""):
        (root / "test" / "gallery_drone").write_text(text)
        assert open_dataset(root).tasks() == ["drone-to-satellite"]


def test_names_can_always_be_shown_and_sent(tmp_path: Path) -> None:
    folder = tmp_path / "test" / "query_drone" / "0001"
    folder.mkdir(parents=True)
    for name in (b"caf\xe9.png", b"two\nlines.png"):
        (folder / os.fsdecode(name)).write_bytes(b"")
    names = [picture.name for picture in open_dataset(tmp_path).queries("drone")]
    assert names == ["0001/caf?", "0001/two?lines"]


def test_what_is_wrong_with_a_folder_is_said_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no data set folder"):
        open_dataset(tmp_path / "absent")
    (tmp_path / "other").mkdir()
    with pytest.raises(DataError, match=r"holds other; expected a data set in a layout .*\(.*University-1652"):
        open_dataset(tmp_path)
    (tmp_path / "test" / "query_drone" / "0001").mkdir(parents=True)
    with pytest.raises(DataError, match="has no test queries of drone pictures; expected test/query_drone"):
        open_dataset(tmp_path).queries("drone")
    with pytest.raises(DataError, match=r"has no test gallery of satellite pictures; expected .*gallery_satellite"):
        open_dataset(tmp_path).gallery("satellite")
    small_worlds.write(tmp_path / "test" / "query_drone" / "castle" / "a.png", small_worlds.place(1))
    with pytest.raises(DataError, match="castle in test/query_drone is not a number"):
        open_dataset(tmp_path).queries("drone")


def test_a_world_is_told_from_university_1652(data: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data)
    assert (dataset.kind, dataset.panoramas) == ("University-1652", False)
    assert dataset.published_sizes["test/gallery_drone"].pictures == 51_355
    assert dataset.truth("drone-to-satellite") is None
    assert list(dataset.lists()) == [
        *("train/satellite", "train/drone", "test/query_drone", "test/query_satellite"),
        *("test/gallery_drone", "test/gallery_satellite"),
    ]
    small_worlds.make_dataset(tmp_path, train=1, test=1)
    (tmp_path / "world.json").write_text("{}")
    layouts.cvusa(tmp_path / "cvusa")
    assert (open_dataset(tmp_path).kind, open_dataset(tmp_path).published_sizes) == ("world", {})
    assert open_dataset(tmp_path / "cvusa").kind == "CVUSA"


def test_pairs_of_ones_own_are_read(tmp_path: Path) -> None:
    root = layouts.pairs(
        tmp_path,
        "satellite,drone,split,place\n"
        "tiles/a.jpg,drones/1.jpg,train,\n"
        "tiles/a.jpg,drones/2.jpg,train,\n"
        "\n"
        "tiles/b.jpg,drones/3.jpg,,9\n"
        "tiles/b.jpg,drones/4.jpg,test,\n"
        ",drones/5.jpg,test,\n"
        "tiles/c.jpg,drones/absent.jpg,test,\n",
    )
    dataset = open_dataset(root)
    assert (dataset.kind, dataset.panoramas) == ("pairs", False)
    assert dataset.tasks() == ["drone-to-satellite", "satellite-to-drone"]
    (tile,) = dataset.train("satellite")
    assert [p.label for p in dataset.train("drone")] == [tile.label, tile.label]
    drones = {p.name: p.label for p in dataset.queries("drone")}
    assert list(drones) == ["drones/3", "drones/4", "drones/5"]
    assert drones["drones/3"] == drones["drones/4"] == 9
    tiles = [p.label for p in dataset.gallery("satellite")]
    assert len(tiles) == 2
    assert len({*tiles, drones["drones/5"], tile.label}) == 4
    assert [item.file for item in dataset.left_out] == ["drones/absent.jpg"]


def test_pairs_without_satellites_go_by_their_first_view(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.pairs(tmp_path, "street,drone\na.jpg,1.jpg\na.jpg,2.jpg\nb.jpg,3.jpg\n"))
    assert dataset.tasks() == ["drone-to-street", "street-to-drone"]
    first, second, third = (p.label for p in dataset.queries("drone"))
    assert [p.label for p in dataset.gallery("street")] == [first, third]
    assert first == second != third


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"first line of pairs\.csv is empty; expected two or three of satellite, street, drone"),
        ("satellite\na.jpg\n", "first line"),
        ("satellite,satellite,street\n", "first line"),
        ("satellite,street\n", "no line after the first"),
        (
            "satellite,street\na.jpg,b.jpg\na.jpg\n",
            r"Line 3 of pairs\.csv should have 2 values, satellite,street, and has 1",
        ),
        ("satellite,street,split\na.jpg,b.jpg,val\n", "has the split 'val'; expected train or test"),
        ("satellite,street,place\na.jpg,b.jpg,-3\n", "has the place '-3'; expected a whole number"),
        (f"satellite,street,place\na.jpg,b.jpg,{'9' * 30}\n", "has the place"),
        ("satellite,street,split\n,,test\n", "names no picture"),
        ("satellite,street\n../a.jpg,b.jpg\n", r"Line 2 of pairs\.csv names the file '\.\./a\.jpg'"),
        ("satellite,street,place\na.jpg,b.jpg,1\na.jpg,c.jpg,2\n", r"Line 3 .* has a\.jpg at place 2, earlier at 1"),
        ("satellite,street\nabsent1.jpg,absent2.jpg\n", "the first file left out is absent1.jpg"),
    ],
)
def test_a_wrong_list_of_pairs_is_one_sentence(text: str, said: str, tmp_path: Path) -> None:
    root = layouts.pairs(tmp_path / "mine", text)
    with pytest.raises(DataError, match=said):
        open_dataset(root)
