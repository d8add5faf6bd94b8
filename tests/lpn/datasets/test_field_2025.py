"""World-UAV, UniV, and GeoText-1652, written small in their released forms."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.datasets.layouts.univ import UniV
from lpn.doctor.dataset_check import check_dataset
from lpn.tasks.opening import lazy_task
from tests.conftest import Refused
from tools.fixtures import layouts
from tools.fixtures.small_contracts import PartsModel, RegionModel


def test_world_uav_has_splits_regions_and_tiles_of_each_region(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = layouts.world_uav(tmp_path / "World-UAV")
    terrain, city, mix = (open_dataset(root / name) for name in ("terrain", "city", "mix"))
    assert open_dataset(root).queries("drone") == terrain.queries("drone")
    assert [line.getMessage() for line in caplog.records] == [
        f"World-UAV has three splits; this is terrain, and {root}/city, {root}/mix the others."
    ]
    assert {one.kind for one in (terrain, city, mix)} == {"World-UAV"}
    assert [len(one.queries("drone")) for one in (terrain, city, mix)] == [8, 12, 20]
    assert [len(one.train("drone")) for one in (terrain, city, mix)] == [8, 0, 26]
    assert all(one.tasks() == ["drone-to-satellite"] for one in (terrain, city, mix))
    queries, gallery, truth = mix.queries("drone"), mix.gallery("satellite"), mix.truth("drone-to-satellite")
    assert truth is not None
    names = [tile.name for tile in gallery]
    second = next(i for i, query in enumerate(queries) if query.name == "Country/Spain/b/height125_rot45_01")
    assert [names[tile] for tile in truth[0].good] == ["Terrain/Desert/a/0_0", "Terrain/Desert/a/1_0"]
    assert [names[tile] for tile in truth[second].good] == ["Country/Spain/b/2_0", "Country/Spain/b/3_0"]
    assert {names[tile].rpartition("/")[0] for tile in np.flatnonzero(truth[second].unranked(len(names)))} == {
        "Terrain/Desert/a"
    }
    assert names[queries[second].label] == "Country/Spain/b/2_0"
    assert {query.group for query in queries} == {"Terrain/Desert/a", "Country/Spain/b"}
    columns = {column.name: column.values[second] for column in mix.columns(queries)}
    assert columns == {"region": "Country/Spain/b", "height": 125, "rotation": 45}


def test_world_uav_is_ranked_within_each_region_and_averaged_over_regions(tmp_path: Path) -> None:
    root, model = layouts.world_uav(tmp_path / "World-UAV"), PartsModel(RegionModel())
    mix, alone = (
        lazy_task(model, open_dataset(root / name), "drone-to-satellite").evaluate() for name in ("mix", "city")
    )
    assert (mix.group_name, list(mix.groups)) == ("region", ["Country/Spain/b", "Terrain/Desert/a"])
    city = mix.groups["Country/Spain/b"][0]
    assert (city.queries, city.recall["1"]) == (12, alone.recall["1"])
    assert city.ap == pytest.approx(alone.ap)
    regions = [figures[0].recall["1"] for figures in mix.groups.values()]
    assert 0 < np.mean(regions) < 100
    assert mix.measures["region_recall@1"] == pytest.approx(np.mean(regions))
    assert mix.measures["region_recall@1"] != pytest.approx(mix.recall["1"])


def test_one_region_of_world_uav_has_all_its_flights_as_queries(tmp_path: Path) -> None:
    region = open_dataset(layouts.world_uav(tmp_path / "World-UAV") / "Country" / "Spain" / "b")
    assert (region.kind, region.group_name) == ("World-UAV", "flight")
    assert len(region.queries("drone")) == 18
    assert "height150_rot20" in {query.group for query in region.queries("drone")}
    truth = region.truth("drone-to-satellite")
    assert truth is not None
    assert not any(len(one.junk) for one in truth)


def test_a_key_of_world_uav_without_a_tile_is_no_query(tmp_path: Path) -> None:
    root = layouts.world_uav(tmp_path / "World-UAV")
    (root / "Terrain/Desert/a/positive.json").write_text(json.dumps({"00": ["0_0.png"], "01": []}))
    dataset = open_dataset(root / "terrain")
    assert [(item.file, item.why) for item in dataset.left_out] == [
        ("Terrain/Desert/a 01", "has none of its true tiles")
    ]
    assert len(dataset.queries("drone")) == 4


def test_a_list_that_univ_lacks_is_named_when_a_model_has_no_task(
    tmp_path: Path, model_file: Path, refused: Refused
) -> None:
    root = layouts.univ(tmp_path / "univ")
    shutil.rmtree(root / "45" / "2fps" / "test" / "query_satellite")
    said = refused("evaluate", root, "--model", model_file)
    assert "add the missing pictures (query_satellite, query_drone), or choose another data set" in said


def test_univ_has_videos_by_angle_and_rate_and_shares_tiles(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = layouts.univ(tmp_path / "UniV")
    low, high = open_dataset(root / "45" / "2fps"), open_dataset(root / "30" / "10fps")
    assert open_dataset(root).queries("drone") == low.queries("drone")
    assert [line.getMessage() for line in caplog.records] == [
        f"UniV has 6 splits; this is 45/2fps, and {root}/45/5fps, {root}/45/10fps, {root}/30/2fps, {root}/30/5fps, "
        f"{root}/30/10fps the others."
    ]
    for dataset, frames in ((low, 2), (high, 10)):
        assert dataset.kind == "UniV"
        assert dataset.tasks()[:3] == ["drone-to-satellite", "satellite-to-drone", "street-to-satellite"]
        assert [picture.label for picture in dataset.queries("drone")] == [1] * frames + [2] * frames
        assert len(dataset.gallery("drone")) == 3 * frames
        assert [picture.label for picture in dataset.gallery("satellite")] == [1, 2, 3]
        assert [picture.label for picture in dataset.train("satellite")] == [280, 281, 282]
    assert {picture.path.parents[3].name for picture in high.gallery("drone")} == {"10fps"}
    assert {picture.label for picture in low.train("drone")} == {280, 282}
    report, whole = check_dataset(low), check_dataset(high)
    assert report.healthy
    assert [(gap.name, gap.names) for gap in report.gaps if gap.name == "train/drone"] == [("train/drone", ("0281",))]
    assert not [gap for gap in whole.gaps if gap.name == "train/drone"]
    assert next(count for count in report.counts if count.name == "train/drone").full_places == 701


def test_univ_without_query_folders_says_how_to_make_them(tmp_path: Path) -> None:
    root = layouts.univ(tmp_path / "UniV", organized=False)
    dataset = open_dataset(root / "30" / "5fps")
    assert dataset.tasks() == []
    assert dataset.why_no_task() == (
        "has only test/gallery_drone and test/gallery_satellite and test/gallery_street; expected queries of one view and a "
        "gallery of another, as test/query_drone or 45/2fps/test/query_satellite, which its organize_univ.py makes from the "
        "galleries"
    )
    shutil.rmtree(root / "45" / "5fps")
    with pytest.raises(DataError, match=r"UniV has the lists of 45/2fps and 45/10fps and 30/2fps .*; expected 45/5fps"):
        UniV(root, "45/5fps")


@pytest.mark.parametrize(("images", "schematic", "drones"), [(True, False, 2), (False, True, 1)])
def test_geotext_has_views_by_name_and_distractors(tmp_path: Path, images: bool, schematic: bool, drones: int) -> None:
    dataset = open_dataset(layouts.geotext(tmp_path / "GeoText1652_Dataset", images, schematic))
    assert dataset.kind == "GeoText-1652"
    assert dataset.tasks()[:2] == ["drone-to-satellite", "satellite-to-drone"]
    assert [picture.label for picture in dataset.queries("drone")] == [1] * drones + [2] * drones
    assert [picture.label for picture in dataset.gallery("satellite")] == [1, 2, 3]
    assert [picture.label for picture in dataset.queries("street")] == [1]
    assert [picture.label for picture in dataset.train("street")] == [800, 801]
    report = check_dataset(dataset)
    assert report.healthy
    gaps = [(gap.name, len(gap.names)) for gap in report.gaps]
    assert gaps == [("satellite-to-street", 1), ("drone-to-street", drones)]
    assert all(name.startswith("0002/") for gap in report.gaps for name in gap.names)
