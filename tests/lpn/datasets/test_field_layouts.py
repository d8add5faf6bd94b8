"""SUES-200, DenseUAV, GTA-UAV, UAV-VisLoc, and VIGOR, and damage of these and World-UAV, written small in their real forms."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.datasets.integrity import check_test_split
from lpn.datasets.layouts.denseuav import DenseUAV
from lpn.doctor.dataset_check import check_dataset
from tools.fixtures import layouts, small_worlds


def test_sues_in_both_forms_has_places_heights_and_all_places_as_gallery(tmp_path: Path) -> None:
    split = open_dataset(layouts.sues(tmp_path / "split"))
    lower = open_dataset(layouts.sues(tmp_path / "lower", lower=True))
    raw = open_dataset(layouts.sues_raw(tmp_path / "raw"))
    assert {one.kind for one in (split, lower, raw)} == {"SUES-200"}
    for one in (split, lower):
        assert sorted({picture.label for picture in one.queries("drone")}) == [3, 4]
        assert [picture.label for picture in one.train("satellite")] == [1, 2]
    assert sorted({picture.label for picture in raw.queries("drone")}) == [2, 4]
    for one in (split, lower, raw):
        assert one.tasks() == ["drone-to-satellite", "satellite-to-drone"]
        assert [picture.label for picture in one.gallery("satellite")] == [1, 2, 3, 4]
        assert len(one.gallery("drone")) == 4 * 4 * 2
        assert len({picture.path for picture in one.gallery("drone")}) == 32
        groups = [picture.group for picture in one.queries("drone")]
        assert {group: groups.count(group) for group in layouts.HEIGHTS} == dict.fromkeys(layouts.HEIGHTS, 4)
        assert all(
            picture.path.parents[0 if one is raw else 2].name == picture.group for picture in one.queries("drone")
        )
        (column,) = one.columns(one.queries("drone"))
        assert (column.name, column.unit, column.values[0]) == ("height", "m", 150.0)


@pytest.mark.parametrize("folder", ["train/drone", "test/query_drone"])
def test_pictures_right_in_a_folder_of_places_are_not_read_as_denseuav_s(tmp_path: Path, folder: str) -> None:
    small_worlds.write(tmp_path / folder / "0001.jpg", small_worlds.place(1))
    assert not DenseUAV.recognises(tmp_path)
    assert open_dataset(tmp_path).kind == "University-1652"
    small_worlds.write(tmp_path / folder / "000002" / "H80.JPG", small_worlds.place(1))
    assert DenseUAV.recognises(tmp_path)


def test_denseuav_has_positions_of_its_folders_and_old_tiles(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.denseuav(tmp_path / "DenseUAV"))
    assert dataset.kind == "DenseUAV"
    lists = dataset.queries("drone"), dataset.gallery("satellite"), dataset.train("satellite")
    assert list(map(len, lists)) == [9, 30, 12]
    assert {picture.path.name for picture in dataset.gallery("satellite")} == {
        *("H80.tif", "H90.tif", "H100.tif", "H80_old.tif", "H90_old.tif", "H100_old.tif")
    }
    assert sorted({picture.group for picture in dataset.queries("drone")}) == ["100", "80", "90"]
    places = dataset.coordinates(dataset.gallery("satellite"))
    labels = np.array([picture.label for picture in dataset.gallery("satellite")])
    np.testing.assert_allclose(places, np.stack([np.full(30, 30.32), 120.38 + 0.0002 * labels], axis=1))
    report = check_dataset(dataset)
    assert report.healthy, report
    assert report.positions == "Each of the 72 test pictures has a position, by Dense_GPS_ALL.txt."
    (tmp_path / "DenseUAV" / "Dense_GPS_ALL.txt").unlink()
    assert open_dataset(tmp_path / "DenseUAV").coordinates(dataset.queries("drone")).shape == (9, 2)


def test_gta_uav_has_lists_of_true_and_half_true_tiles_with_overlaps(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.gta(tmp_path / "GTA"))
    assert (dataset.kind, dataset.measured_by) == ("GTA-UAV", "GTA-UAV")
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    assert [picture.path.name for picture in queries] == ["200_0001_0000000001.png", "200_0001_0000000002.png"]
    names = [picture.name for picture in gallery]
    truth = dataset.truth("drone-to-satellite")
    assert truth is not None
    assert [names[tile] for tile in truth[0].good] == ["4_0_0_0", "5_0_1_1"]
    assert [names[tile] for tile in truth[0].semi] == ["4_0_1_0"]
    assert not any(lists.trapezoid for lists in truth)
    overlaps = [truth[0].overlap(names.index(name)) for name in ("4_0_0_0", "5_0_1_1", "4_0_1_0", "4_0_1_1")]
    assert overlaps == [0.7, 0.45, 0.2, 0.0]
    assert names[queries[0].label] == "4_0_0_0"
    places = dict(zip(names, dataset.coordinates(gallery).tolist(), strict=True))
    side = 0.45 * 24576
    assert places["4_0_1_0"] == pytest.approx([side / 16 * 1.5, side / 16 * 0.5])
    assert places["5_128_1_1"] == pytest.approx([side / 32 * 2, side / 32 * 2])
    assert dataset.coordinates(queries).tolist() == [[300, 250], [700, 250]]
    back = dataset.truth("satellite-to-drone")
    tiles = dataset.queries("satellite")
    assert back is not None
    assert [(tile.name, lists.good.tolist()) for tile, lists in zip(tiles, back, strict=True)] == [
        *(("4_0_0_0", [0]), ("4_0_1_1", [1]), ("5_0_1_1", [0]))
    ]
    assert [picture.label for picture in dataset.train("drone")] == [
        picture.label for picture in dataset.train("satellite")
    ]
    assert dataset.positions() is None
    report = check_dataset(dataset, decode=False)
    assert report.healthy
    assert report.positions == "Each of the 8 test pictures has a position, by the lists and the tiles' names."


def test_the_published_example_of_a_tile_is_where_the_readme_says(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.gta(tmp_path / "GTA"))
    layouts.small_worlds.write(tmp_path / "GTA" / "satellite" / "4_0_6_13.png", layouts.small(1))
    dataset = open_dataset(tmp_path / "GTA")
    tile = next(picture for picture in dataset.gallery("satellite") if picture.name == "4_0_6_13")
    np.testing.assert_allclose(dataset.coordinates([tile]), [[4492.8, 9331.2]])


def test_visloc_in_gta_form_has_degrees(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.gta(tmp_path / "VisLoc", area="same", degrees=True))
    assert (dataset.kind, dataset.measured_by) == ("UAV-VisLoc", "UAV-VisLoc")
    np.testing.assert_allclose(dataset.coordinates(dataset.queries("drone")), [[32.35, 119.81], [32.349, 119.81]])
    tiles = {
        picture.name: place
        for picture, place in zip(
            dataset.gallery("satellite"), dataset.coordinates(dataset.gallery("satellite")).tolist(), strict=True
        )
    }
    # Map 03 has 24308 x 35092 pixels; zoom 7 of its 8 halves it once.
    top, left, bottom, right = 32.355491, 119.805926, 32.29029, 119.900052
    expected = [top - 1.5 * 256 / 12154 * (top - bottom), left + 0.5 * 256 / 17546 * (right - left)]
    assert math.ceil(math.log2(35092 / 256)) == 8
    assert tiles["03_7_000_001"] == pytest.approx(expected, abs=1e-12)
    positions = dataset.positions()
    assert positions is not None
    assert positions.of(dataset.queries("drone"))[1].latitude == pytest.approx(32.349)


@pytest.mark.parametrize("outer", [False, True])
def test_vigor_has_areas_cities_and_half_true_tiles(
    tmp_path: Path, outer: bool, caplog: pytest.LogCaptureFixture
) -> None:
    root = layouts.vigor(tmp_path / "VIGOR", outer=outer)
    same, cross = open_dataset(root), open_dataset(root / "cross-area")
    assert [line.getMessage() for line in caplog.records] == [
        f"VIGOR has two splits; this is same-area, and {root}/cross-area the other."
    ]
    assert open_dataset(root / "same-area").queries("street") == same.queries("street")
    assert (same.kind, same.tasks()) == ("VIGOR", ["street-to-satellite"])
    assert [len(one.queries("street")) for one in (same, cross)] == [8, 4]
    assert [len(one.gallery("satellite")) for one in (same, cross)] == [16, 8]
    assert {picture.group for picture in cross.queries("street")} == {"Chicago", "SanFrancisco"}
    assert {picture.group for picture in cross.train("street")} == {"NewYork", "Seattle"}
    for one in (same, cross):
        names = [picture.path.name for picture in one.gallery("satellite")]
        truth = one.truth("street-to-satellite")
        assert truth is not None
        for query, lists in zip(one.queries("street"), truth, strict=True):
            (good,), city = lists.good, query.group
            first = query.name.endswith("0")
            assert names[good].endswith(
                f"{1000 if first else 1002}_{query.path.name.split(',')[2].split('.')[0]}.5000.png"
            )
            assert len(lists.semi) == (1 if first else 0)
            assert one.gallery("satellite")[good].name.startswith(city)
            assert one.gallery("satellite")[good].label == query.label
        positions = one.positions()
        assert positions is not None
        assert positions.of(one.queries("street"))[0].longitude < -80
        assert all(picture.panorama for picture in one.queries("street"))


def spoil(path: str) -> Callable[[Path], None]:
    def remove(root: Path) -> None:
        for file in root.glob(path):
            shutil.rmtree(file) if file.is_dir() else file.unlink()

    return remove


def edit(path: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        (root / path).write_text(change((root / path).read_text()))

    return write


def with_text(text: str) -> str:
    entries = json.loads(text)
    entries[1]["pair_pos_sate_img_list"] = "4_0_1_1.png"
    return json.dumps(entries)


def without_key(text: str) -> str:
    entries = json.loads(text)
    del entries[1]["pair_pos_sate_img_list"]
    return json.dumps(entries)


@pytest.mark.parametrize(
    ("make", "harm", "message"),
    [
        (layouts.sues, spoil("Testing/200/gallery_satellite"), "Testing/200 of set has no folder gallery_satellite"),
        (layouts.sues, spoil("Training/*"), "Training of set has no folder 150, 200, 250, 300"),
        (layouts.sues_raw, spoil("indexs.yaml"), "SUES-200's satellite-view and not indexs.yaml"),
        (layouts.sues_raw, spoil("drone_view_512"), 'not a folder whose name contains "drone"'),
        (layouts.sues_raw, edit("indexs.yaml", lambda _: "index: []"), "indexs.yaml names no place"),
        (layouts.denseuav, spoil("Dense_GPS_*.txt"), "no Dense_GPS_ALL.txt; put that file"),
        (layouts.denseuav, edit("Dense_GPS_ALL.txt", lambda t: t.replace(" N30", " 30", 1)), "Line 1 of Dense_GPS_ALL.txt is"),
        (layouts.gta, spoil("satellite"), "the first file left out is satellite/4_0_0_1.png; expected"),
        (layouts.gta, spoil("cross-area-drone2sate-test.json"), "expected same-area-drone2sate-test.json"),
        (layouts.gta, edit("cross-area-drone2sate-test.json", lambda t: t[:-9]), "is not JSON"),
        (layouts.gta, edit("cross-area-drone2sate-test.json", without_key), "Object 2 of cross.*has no pair_pos_sate_img_list"),
        (layouts.gta, edit("cross-area-drone2sate-test.json", lambda t: t.replace("0.7, 0.45]", "0.7]", 1)), "1 weights"),
        (layouts.gta, edit("cross-area-drone2sate-test.json", with_text), "malformed: pair_pos_sate_img_list is no list"),
        (layouts.vigor, spoil("splits"), "has the lists of none; expected splits/Chicago/same_area_balanced_test.txt"),
        (layouts.vigor, spoil("splits/*/*.txt"), "has the lists of none"),
        (layouts.vigor, spoil("splits/Seattle/satellite_list.txt"), "splits/Seattle/satellite_list.txt cannot be read"),
        (layouts.vigor, edit("splits/Seattle/same_area_balanced_test.txt", lambda t: t.replace(" 0 0", " 0")), "Line 1 of spl"),
        (layouts.vigor, edit("splits/Seattle/satellite_list.txt", lambda t: t.replace("1002", "9")), "is not in satellite_list"),
        (layouts.world_uav, edit("Index/test.txt", lambda _: "../x\n"), "Line 1 of Index/test.txt names the file '../x'; exp"),
        (layouts.world_uav, edit("Terrain/Desert/a/positive.json", lambda _: "{"), "Terrain/Desert/a/positive.json is not JSON"),
        (layouts.world_uav, edit("Terrain/Desert/a/positive.json", lambda _: '{"00": "a.png"}'), "is not an object of lists"),
    ],
)  # fmt: skip
def test_an_incomplete_layout_is_told_in_one_sentence(
    tmp_path: Path, make: Callable[[Path], Path], harm: Callable[[Path], None], message: str
) -> None:
    root = make(tmp_path / "set")
    harm(root)
    with pytest.raises(DataError, match=message) as raised:
        open_dataset(root)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("make", "lost", "why"),
    [
        (layouts.gta, "drone/images/200_0001_0000000001.png", "is not there"),
        (layouts.gta, "satellite/4_0_1_0.png", "is not there"),
        (layouts.vigor, "Seattle/satellite/satellite_43.1001_-83.5000.png", "is not there"),
        (layouts.world_uav, "Terrain/Desert/a/DB/img/1_0.png", "is not there"),
        (
            *(layouts.world_uav, "Terrain/Desert/a/query/height100_rot45/footage/height100_rot45_01.jpeg"),
            "is not there",
        ),
        (layouts.world_uav, "Terrain/Lake/c/positive.json", "is not there"),
        (layouts.world_uav, "Terrain/Lake/c", "is not there"),
        (layouts.world_uav, "Terrain/Desert/a/query", "has no flights"),
    ],
)
def test_missing_files_are_left_out_and_named(
    tmp_path: Path, make: Callable[[Path], Path], lost: str, why: str
) -> None:
    root = make(tmp_path / "set")
    spoil(lost)(root)
    dataset = open_dataset(root)
    assert [(item.file, item.why) for item in dataset.left_out] == [(lost, why)]
    assert not check_dataset(dataset, decode=False).healthy


def test_a_query_whose_true_tiles_are_missing_is_left_out_and_named(tmp_path: Path) -> None:
    root = layouts.gta(tmp_path / "GTA")
    (root / "satellite" / "4_0_1_1.png").unlink()
    dataset = open_dataset(root)
    assert [(item.file, item.why) for item in dataset.left_out] == [
        ("satellite/4_0_1_1.png", "is not there"),
        ("drone/images/200_0001_0000000002.png", "has none of its true tiles"),
    ]
    assert [picture.path.name for picture in dataset.queries("drone")] == ["200_0001_0000000001.png"]


def test_a_tile_without_a_position_in_its_name_is_found_before_long_work(tmp_path: Path) -> None:
    for degrees in (False, True):
        root = layouts.gta(tmp_path / f"GTA {degrees}", degrees=degrees)
        layouts.small_worlds.write(root / "satellite" / "overview.png", layouts.small(9))
        dataset = open_dataset(root)
        with pytest.raises(DataError, match=r"overview.png has no position in its name"):
            check_test_split(dataset, ["drone-to-satellite"])
        report = check_dataset(dataset, decode=False)
        assert not report.healthy
        assert "overview.png has no position in its name" in (report.gap or "")


def test_an_area_that_is_not_there_is_refused(tmp_path: Path) -> None:
    root = layouts.gta(tmp_path / "GTA", area="same")
    with pytest.raises(DataError, match="has the lists of same-area; expected cross-area"):
        open_dataset(root / "cross-area")
    with pytest.raises(DataError, match="has no cross-area split"):
        open_dataset(layouts.sues(tmp_path / "SUES") / "cross-area")
