from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.cli import main
from lpn.datasets import open_dataset
from lpn.doctor.dataset_check import check_dataset
from lpn.doctor.verify import verify
from lpn.index import DescriptorKind, create_index
from tests.conftest import Refused
from tools.fixtures import layouts, small_worlds


def doctor(root: Path, tmp_path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    out = tmp_path / "report.json"
    status = main.main(["doctor", "--data", str(root), "--json", str(out), *more])
    return status, json.loads(out.read_text())


def test_a_healthy_set_is_counted_against_the_full_one(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, found = doctor(data, tmp_path)
    assert (status, found["healthy"], found["kind"], found["decoded"]) == (0, True, "University-1652", True)
    counts = {count["name"]: count for count in found["counts"]}
    full = {"full_pictures": 37_854, "full_places": 701}
    assert counts["train/drone"] == {"name": "train/drone", "pictures": 6, "places": 6} | full
    said = capsys.readouterr().out
    assert "places is in University-1652's layout" in said
    assert "6 of 37,854" in said
    assert "68 of 68 pictures can be read (decoded)" in said
    assert "Nothing is broken." in said


def test_broken_and_missing_pictures_are_named_and_end_with_status_1(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "places"
    shutil.copytree(data, root)
    cut = root / "test" / "query_drone" / "0007" / "image-01.png"
    cut.write_bytes(cut.read_bytes()[:-200])
    shutil.rmtree(root / "train" / "drone" / "0002")
    shutil.rmtree(root / "test" / "gallery_satellite" / "0009")
    for more in ((), ("--quick",)):
        status, found = doctor(root, tmp_path, *more)
        assert (status, found["healthy"]) == (1, False)
        assert found["broken"] == [
            {"file": "test/query_drone/0007/image-01.png", "why": "is cut short or damaged", "published": False}
        ]
        assert [(item["name"], item["names"], item["of"]) for item in found["lacking"]] == [
            ("train/drone", ["0002"], 6),
            ("drone-to-satellite", ["0009"], 14),
        ]
    said = " ".join(capsys.readouterr().out.split())
    assert "1 cannot be read: test/query_drone/0007/image-01.png is cut short or damaged." in said
    assert "1 of 6 places have no picture in train/drone: 0002." in said
    assert "1 of 14 queries of drone-to-satellite have no true match: 0009." in said
    assert "Something is broken" in said


def test_positions_are_checked(tmp_path: Path) -> None:
    root = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=2, test=3))
    status, found = doctor(root, tmp_path)
    assert (status, found["positions"]) == (0, "Each of the 12 test pictures has a position, by geo.csv.")
    (root / "geo.csv").write_text((root / "geo.csv").read_text().rstrip().rpartition("\n")[0])
    status, found = doctor(root, tmp_path)
    assert (status, "no position for 1 of 12 pictures" in found["gap"]) == (1, True)


def test_equal_files_and_shared_places_are_found(tmp_path: Path) -> None:
    root = layouts.pairs(
        tmp_path / "mine", "satellite,drone,split,place\na.jpg,1.jpg,train,1\nb.jpg,2.jpg,test,1\nc.jpg,3.jpg,test,3\n"
    )
    shutil.copy(root / "b.jpg", root / "c.jpg")
    report = check_dataset(open_dataset(root))
    assert report.duplicates == (("b.jpg", "c.jpg"),)
    assert report.shared == (1,)
    assert not report.healthy


def test_files_named_and_not_there_are_damage_but_what_is_published_broken_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = layouts.cvusa(tmp_path / "pairs")
    (root / "bingmap" / "19" / "0000002.jpg").unlink()
    status, found = doctor(root, tmp_path)
    assert status == 1
    assert found["left_out"] == [{"file": "bingmap/19/0000002.jpg", "why": "is not there", "published": False}]
    assert "1 are left out: bingmap/19/0000002.jpg is not there." in capsys.readouterr().out
    photos = small_worlds.make_dataset(tmp_path / "photos", train=1, test=2)
    (photos / "test" / "query_drone" / "0002" / "photo.heic").write_bytes(b"")
    status, found = doctor(photos, tmp_path)
    assert (status, len(found["left_out"])) == (1, 1)
    text = " ".join(capsys.readouterr().out.split())
    assert "1 are left out: test/query_drone/0002/photo.heic is of a kind that is not read; save it as JPEG." in text
    status, found = doctor(layouts.paris(tmp_path / "paris"), tmp_path)
    assert (status, [item["published"] for item in found["left_out"]]) == (0, [True])
    assert "being broken in the published data set too" in " ".join(capsys.readouterr().out.split())


def test_the_gaps_of_the_published_release_are_named_and_are_no_damage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """layumi/University1652-Baseline issues 36 and 34: an empty train/google, and empty street folders of the test split."""
    root = layouts.university_gaps(tmp_path / "University-Release")
    status, found = doctor(root, tmp_path)
    assert (status, found["healthy"], found["lacking"], found["broken"]) == (0, True, [], [])
    assert [(gap["name"], gap["names"], gap["of"]) for gap in found["gaps"]] == [
        ("train/google", ["0001"], 3),
        ("satellite-to-street", ["0004"], 3),
        ("drone-to-street", ["0004"], 3),
    ]
    said = " ".join(capsys.readouterr().out.split())
    assert "Gaps, which are no damage: a place is used in the views that it has." in said
    assert "1 of 3 places have no picture in train/google: 0001." in said
    assert "1 of 3 queries of drone-to-street have no true match: 0004." in said
    assert "Nothing is broken." in said


@pytest.mark.parametrize(
    ("remove", "lacking"),
    [
        ("test/gallery_satellite/0003", [("drone-to-satellite", ["0003"]), ("street-to-satellite", ["0003"])]),
        ("test/gallery_drone/0003", [("satellite-to-drone", ["0003"]), ("street-to-drone", ["0003"])]),
        ("train/street/0001", []),
        ("train/drone/0001", []),
        ("train/satellite/0001", []),
        ("train/*/0001/image*", []),
        ("train/[ds][rt]*/0001", [("train/street", ["0001"]), ("train/drone", ["0001"])]),
    ],
)
def test_a_lost_view_is_damage_only_where_nothing_stands_in_for_it(
    tmp_path: Path, remove: str, lacking: list[tuple[str, list[str]]]
) -> None:
    root = layouts.university_gaps(tmp_path / "University-Release")
    for path in root.glob(remove):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    status, found = doctor(root, tmp_path)
    ordered = sorted((item["name"], item["names"]) for item in found["lacking"])
    assert (ordered, status) == (sorted(lacking), 1 if lacking else 0)


KIND = DescriptorKind("0123456789abcdef", 2, 8)
VECTORS = np.full((20, 2, 8), 0.25, np.float32)
NAMES = [f"tile {i}" for i in range(20)]


def said(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[int, str]:
    return main.main(["doctor", str(path)]), capsys.readouterr().out.strip()


def test_an_index_says_if_it_is_empty_whole_or_has_unfinished_parts_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "index"
    empty = "no tile was added; check that the disk has space, and add tiles again with lpn index."
    with create_index(place, KIND) as index:
        assert said(capsys, tmp_path) == (1, f"DAMAGED: {place}: is empty: {empty}")
        index.add(NAMES, VECTORS)
        assert said(capsys, place) == (0, f"{place} matches its checksums.")
        (part,) = place.glob("part-*")
        shutil.copytree(part, place / "part-0000002-abcdef")
        left = "an unfinished run has left parts beside it, so give its command again"
        assert said(capsys, place) == (0, f"{place} matches its checksums; {left}.")
    (place / "store.json").unlink()
    (verdict,) = verify(tmp_path)
    unfinished = "its description was not finished; give the same lpn describe command again, without --part."
    assert (verdict.healthy, verdict.flaw, verdict.message) == (False, "UNFINISHED", unfinished)


def test_files_are_compared_alone(tmp_path: Path, refused: Refused) -> None:
    for options in (["--data", tmp_path], ["--quick"], ["--json", tmp_path / "found.json"]):
        told = refused("doctor", tmp_path, *options)
        assert "is compared with its checksums alone; leave the options out" in told
    assert "There is nothing at" in refused("doctor", tmp_path / "none", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_can_be_neither_trained_nor_tested_on_is_no_data_set(
    data: Path, tmp_path: Path, refused: Refused
) -> None:
    (plain := tmp_path / "plain").mkdir()
    for picture in open_dataset(data).queries("drone")[:1]:
        shutil.copy(picture.path, plain)
    assert "is a folder of pictures, and nothing says which of them show the same place" in refused(
        "doctor", "--data", plain, "--json", tmp_path / "report.json"
    )
