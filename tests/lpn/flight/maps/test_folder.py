from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lpn.cli.main import main
from lpn.core.errors import DataError, InputError, OutputError
from lpn.flight.maps import Map, MapOptions, Window, open_map
from lpn.flight.maps.folder import build_map
from tests.conftest import Refused
from tests.lpn.flight.maps.small_maps import EAST, NORTH, smooth, write_geotiff


def same(one: Map, other: Map, tolerance: float = 0) -> None:
    """Check that two maps show the same."""
    assert (one.name, one.frame, one.notes) == (other.name, other.frame, other.notes)
    np.testing.assert_allclose(one.bounds, other.bounds)
    for window, pixels in ((Window(3, 2, 20, 40), 64), (Window(0, 0, 4 * 20), 32)):
        found, expected = one.read(window, pixels), other.read(window, pixels)
        np.testing.assert_array_equal(found[1], expected[1])
        np.testing.assert_allclose(found[0].astype(int), expected[0], atol=tolerance)
    assert one.pyramid([20]) == other.pyramid([20])


def test_a_map_folder_holds_copies_of_its_sheets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import rasterio

    deep = smooth(300, 2100).astype(np.uint16) * 10 + 1000
    deep[:, :80] = 0
    (tmp_path / "data").mkdir()
    first = write_geotiff(tmp_path / "data" / "town.tif", deep)
    turned = (0.9, 0.1, EAST + 600, 0.1, -0.9, NORTH)
    second = write_geotiff(tmp_path / "data" / "next.tif", smooth(200, 200, 1), matrix=turned)
    out = tmp_path / "maps" / "town"
    files = open_map([first, second])
    assert main(["map", str(first), str(second), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "Copying town.tif into the map." in printed
    assert "uint16 numbers" in printed
    assert "from 2 sheets; the finest has 0.5 m per pixel." in printed
    assert sorted(path.name for path in out.rglob("*")) == ["01.tif", "02.tif", "coverage.png", "map.json", "sheets"]
    with rasterio.open(out / "sheets" / "02.tif") as copy:
        assert copy.overviews(1) == []
    with rasterio.open(out / "sheets" / "01.tif") as copy:
        assert (copy.count, copy.overviews(1)) == (4, [2, 4, 8])
        assert (copy.crs, copy.transform[:6]) == ("EPSG:32632", (0.5, 0, EAST, 0, -0.5, NORTH))
    same(open_map(out), files, 2)
    whole = (open_map(out).overview(400), files.overview(400))
    np.testing.assert_allclose(whole[0][0].astype(int), whole[1][0], atol=3)
    # The folder needs no other file, wherever it is.
    first.unlink()
    out.rename(tmp_path / "moved")
    assert open_map(tmp_path / "moved").read(Window(0, 0, 20), 16)[1].all()


def test_the_options_of_lpn_map_are_kept_in_its_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.fromarray(smooth(100, 160)).save(tmp_path / "a.png")
    command = ["map", str(tmp_path / "a.png"), "--out", str(tmp_path / "map"), "--bands", "2", "--keep-borders"]
    command += ["--corners", "48", "9", "47.9995", "9.0007", "--place", "A town"]
    for wrong, words in (
        (["--photographed", "2014-13-19"], "pictures is '2014-13-19'; expected a day such as 2014-10-19"),
        (["--photographed", "yesterday"], "pictures is 'yesterday'; expected a day"),
        (["--error", "0"], "expected more than 0, 1 sigma along each axis."),
    ):
        assert main([*command, *wrong]) == 2
        assert words in capsys.readouterr().err
        assert not (tmp_path / "map").exists()
    assert main([*command, "--photographed", "2014-10-19", "--error", "0.02"]) == 0
    assert "The surveyed error of its places is 0.02 m (1 sigma along each axis)." in capsys.readouterr().out
    kept = open_map(tmp_path / "map")
    options = MapOptions(corners=(48, 9, 47.9995, 9.0007), bands=(2,), keep_borders=True)
    same(kept, open_map(tmp_path / "a.png", options))
    assert (kept.place.name, kept.place.day) == ("A town", date(2014, 10, 19))
    assert kept.sides == pytest.approx((52.2, 55.6), abs=0.2)
    assert (kept.default_error, kept.place_error(None)) == (0.02, 0.02)
    assert (kept.total_error(0.02), kept.place_error(0.02)) == (0.02, 0.0)


def test_what_lpn_map_refuses_leaves_nothing_behind(tmp_path: Path, refused: Refused) -> None:
    many = [write_geotiff(tmp_path / f"{i:02}.tif", smooth(60, 60)) for i in range(12)]
    degrees = write_geotiff(tmp_path / "b.tif", smooth(60, 60), matrix=(7e-6, 0, 9.0, 0, -5e-6, 48.0))
    build_map(many, tmp_path / "many").close()
    for files, words in (
        ([tmp_path / "many"], "many is a map that lpn map wrote; give the files that it was made of: 00.tif, 01.tif"),
        ([tmp_path / "many"], "08.tif, 09.tif, and 2 more."),
        ([many[0], degrees], "look like degrees"),
    ):
        assert words in refused("map", *files, "--out", tmp_path / "map")
        assert not (tmp_path / "map").exists()


def test_a_folder_of_rasters_may_hold_the_map_json_of_another_program(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    write_geotiff(tmp_path / "other" / "a.tif", smooth(60, 60))
    (tmp_path / "other" / "map.json").write_text("{}")
    assert build_map([tmp_path / "other"], tmp_path / "map").name == "a"


def test_a_folder_appears_when_all_is_written_and_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = write_geotiff(tmp_path / "a.tif", smooth(60, 60))
    for taken in (tmp_path, good):
        with pytest.raises(OutputError, match="is there already"):
            build_map([good], taken)

    def killed(_: Map) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Map, "coverage", killed)
        with pytest.raises(KeyboardInterrupt):
            build_map([good], tmp_path / "map")
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    (tmp_path / "map").mkdir()  # an empty folder may be there
    build_map([good], tmp_path / "map")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tif", "map"]
    with pytest.raises(OutputError, match="is there already"):
        build_map([good], tmp_path / "map")
    assert open_map(tmp_path / "map").name == "a"


def test_a_damaged_map_folder_is_refused(tmp_path: Path) -> None:
    path = write_geotiff(tmp_path / "a.tif", smooth(60, 60))
    build_map([path], tmp_path / "map")
    manifest = tmp_path / "map" / "map.json"
    whole = manifest.read_text()
    with pytest.raises(InputError, match="open it alone"):
        open_map([tmp_path / "map", path])
    wrong = {"sheets": [], "latitude": 91, "surveyed_error": -1, "error": -1, "place": {"photographed": "2014-99-19"}}
    for text, words in (
        (whole.replace("lpn-map/2", "lpn-map/3"), "later version"),
        (whole.replace("lpn-map/2", "lpn-map/1"), "of an older version"),
        (whole[:50], "is damaged"),
        *((json.dumps(json.loads(whole) | {name: value}), "is damaged") for name, value in wrong.items()),
    ):
        manifest.write_text(text)
        with pytest.raises(DataError, match=words):
            open_map(tmp_path / "map")
    manifest.write_text(whole)
    (tmp_path / "map" / "sheets" / "01.tif").unlink()
    with pytest.raises(DataError, match="is not there"):
        open_map(tmp_path / "map")


_LARGE = """
import resource, sys
from pathlib import Path
import numpy as np
from lpn.flight.maps import Window, open_map
town = open_map(sys.argv[1])
assert town.bounds[2] - town.bounds[0] > 14_990
rng = np.random.default_rng(0)
seen = 0
for size in (100, 400, 3000):
    for x, y in rng.uniform(-7_000, 7_000, (20, 2)).tolist():
        seen += town.read(Window(x, y, size, 30), 224)[1].all()
assert seen == 0
picture, valid = town.read(Window(0, 0, 500), 1000)
assert valid.all() and abs(int(picture.mean()) - 100) <= 1, picture.mean()
picture, valid = town.read(Window(0, 0, 1500), 3000)
assert abs(valid.mean() - (1024 / 1500) ** 2) < 0.005, valid.mean()
windows = town.pyramid([1000])
assert 1 <= len(windows) <= 9, len(windows)
assert all(town.read(window, 100)[1].mean() > 0.47 for window in windows)
status = Path("/proc/self/status")
if status.exists():
    # Linux counts the parent's memory before exec in ru_maxrss.
    print(1024 * int(status.read_text().split("VmHWM:")[1].split()[0]))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024))
"""


@pytest.mark.slow
def test_a_map_of_2_7_gigabytes_is_read_in_less_than_half_a_gigabyte(tmp_path: Path) -> None:
    import rasterio
    from rasterio.windows import Window as Pixels

    path, side = tmp_path / "large.tif", 30_000
    profile = {"driver": "GTiff", "width": side, "height": side, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    matrix = rasterio.Affine(0.5, 0, EAST, 0, -0.5, NORTH)
    options = {"tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True, "bigtiff": "YES", "nodata": 0}
    with rasterio.open(path, "w", transform=matrix, **profile, **options) as file:
        file.write(
            np.full((3, 2048, 2048), 100, np.uint8), window=Pixels(side // 2 - 1024, side // 2 - 1024, 2048, 2048)
        )
    assert path.stat().st_size < 30e6
    command = [sys.executable, "-c", _LARGE, str(path)]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 0.5e9
