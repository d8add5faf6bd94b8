"""An index as a folder: what it deletes, which files it opens, what it says of those it cannot read, and boxes of segments."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.core.errors import StoreError
from lpn.doctor.verify import verify
from lpn.index import DegreeBox, ExactIndex, WindowsRecord, create_index, folder, open_index, segments
from lpn.index.base import covers, overlaps, within
from tests.lpn.index.test_index import KIND, Tiles

EACH = 16
"""Tiles of a segment below."""


@pytest.fixture
def unmerged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every add keeps a segment of its own."""
    monkeypatch.setattr(ExactIndex, "max_segment_bytes", 1)


def regions(path: Path, count: int) -> tuple[ExactIndex, Tiles]:
    """An index of so many segments, each of a region two degrees wide, 10 degrees east of the one before."""
    tiles = Tiles.draw(EACH * count)
    rng = np.random.default_rng(2)
    corners = np.stack([np.full(count, 40.0), -170.0 + 10 * np.arange(count)], 1).repeat(EACH, 0)
    tiles.positions = corners + rng.uniform(0, 2, (len(corners), 2))
    index = ExactIndex.create(path, KIND)
    tiles.add_to(index, EACH)
    return index, tiles


def files_below(path: Path) -> list[str]:
    return sorted(str(file.relative_to(path)) for file in path.rglob("*"))


def test_a_folder_of_somebody_else_is_left_as_it_is(tmp_path: Path) -> None:
    pictures = tmp_path / "tiles"
    for name in ("0000001", "0000002"):
        (pictures / name).mkdir(parents=True)
        (pictures / name / "photo.jpg").write_bytes(b"a picture")
    before = files_below(pictures)
    with pytest.raises(StoreError) as told:
        create_index(pictures, KIND)
    assert str(told.value) == (
        f"{pictures} holds other files, such as 0000001, and no index.json; choose another folder for the index."
    )
    assert files_below(pictures) == before
    # So is an index that has lost its manifest.
    with ExactIndex.create(tmp_path / "index", KIND) as index:
        Tiles.draw(50).add_to(index)
    (tmp_path / "index" / "index.json").unlink()
    before = files_below(tmp_path / "index")
    for using in (lambda: create_index(tmp_path / "index", KIND), lambda: open_index(tmp_path / "index")):
        with pytest.raises(StoreError, match=r"no index\.json"):
            using()
    assert files_below(tmp_path / "index") == before
    # A kill while the manifest is written leaves a partial file, which is no hindrance.
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "index.json.4194303-12.part").write_bytes(b"{")
    with create_index(tmp_path / "new", KIND) as index:
        Tiles.draw(50).add_to(index)
    assert files_below(tmp_path / "new")[:2] == ["0000001", "0000001/checksums.json"]
    assert not list((tmp_path / "new").glob("*.part"))


def test_what_somebody_puts_into_an_index_is_never_deleted(tmp_path: Path) -> None:
    tiles, place = Tiles.draw(300), tmp_path / "index"
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "vectors.npy").write_bytes(b"not ours")
    with ExactIndex.create(place, KIND) as index:
        index.add(tiles.names[:10], tiles.descriptors[:10], tiles.positions[:10])
        own = ["0000003/photo.jpg", "0000004/keys.npy/photo.jpg", "0000001/photo.jpg", "0000001/dead-x.npy"]
        own += ["0000005", "00007/vectors.npy", "index.json.mine.part", "notes.txt"]
        for name in own:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(b"not ours")
        (place / "0000006").symlink_to(tmp_path / "elsewhere")
        (place / "0000007").mkdir()
        (place / "0000007" / "vectors.npy").symlink_to(tmp_path / "elsewhere" / "vectors.npy")
        # This is the folder of an add that was killed.
        shutil.copytree(place / "0000001", place / "0000009", ignore=shutil.ignore_patterns("photo.jpg", "dead-*"))
        (place / "0000009" / "checksums.json.4194303-12.part").write_bytes(b"{")
        for start in range(10, 300, 10):
            some = slice(start, start + 10)
            index.add(tiles.names[some], tiles.descriptors[some], tiles.positions[some])
        query = tiles.descriptors[17]
        tiles.check(index.search(query, None, 300), query, None, 300, None)
    assert [name for name in own if (place / name).read_bytes() != b"not ours"] == []
    assert all((place / name / "vectors.npy").read_bytes() == b"not ours" for name in ("0000006", "0000007"))
    named = {entry["name"] for entry in json.loads((place / "index.json").read_text())["segments"]}
    assert "0000001" not in named
    left = {path.name for path in place.iterdir()} - named
    assert left == {"index.json", "0000006", "0000007", *(name.partition("/")[0] for name in own)}


@pytest.mark.usefixtures("unmerged")
def test_an_add_opens_only_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index, tiles = regions(tmp_path / "index", 6)
    opened: list[str] = []
    original = folder.Segment

    def watched(place: Path, *given: Any) -> Any:
        opened.append(place.name)
        return original(place, *given)

    monkeypatch.setattr(folder, "Segment", watched)
    with index, ExactIndex(tmp_path / "index") as other:
        assert sorted(opened) == [f"{i:07d}" for i in range(1, 7)]
        del opened[:]
        more = Tiles.draw(3 * EACH, seed=4)
        more.names = [f"more {name}" for name in more.names]
        more.add_to(index, EACH)
        assert opened == ["0000007", "0000008", "0000009"]
        assert other.count() == 9 * EACH
        assert opened[3:] == ["0000007", "0000008", "0000009"]
        del opened[:]
        # A tile of the second segment, which has another list of replaced ones now.
        index.add(tiles.names[EACH : EACH + 1], more.descriptors[:1])
        assert sorted(set(opened)) == ["0000002", opened[-1]]
        assert len(opened) == 2
        assert index.search(more.descriptors[0], None, 1).scores[0] == pytest.approx(1, abs=1e-6)
        assert index.count() == other.count() == 9 * EACH


@pytest.mark.usefixtures("unmerged")
def test_an_index_made_anew_in_the_same_place_is_read_anew(tmp_path: Path) -> None:
    index, _ = regions(tmp_path / "index", 2)
    other = Tiles.draw(2 * EACH, seed=8)
    with index:
        shutil.rmtree(tmp_path / "index")
        with pytest.raises(StoreError, match=r"has no index\.json"):
            index.count()
        with ExactIndex.create(tmp_path / "index", KIND) as again:
            other.add_to(again, EACH)
        other.check(index.search(other.descriptors[5], None, 7), other.descriptors[5], None, 7, None)


LIMITED = """
import resource, sys
from lpn.core.checksums import crc_of_values
from lpn.core.errors import StoreError
from lpn.index import ExactIndex
resource.setrlimit(resource.RLIMIT_NOFILE, (60, 400))
with ExactIndex(sys.argv[1]) as index:
    print(index.count())
resource.setrlimit(resource.RLIMIT_NOFILE, (60, 60))
try:
    ExactIndex(sys.argv[1])
except StoreError as error:
    print(error)
"""


@pytest.mark.usefixtures("unmerged")
def test_more_files_than_may_be_open_are_allowed_or_told_as_that(tmp_path: Path) -> None:
    regions(tmp_path / "index", 12)[0].close()
    command = [sys.executable, "-c", LIMITED, str(tmp_path / "index")]
    count, said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    assert int(count) == 12 * EACH
    assert said.startswith(str(tmp_path / "index" / "00000"))
    assert said.endswith("cannot be read (Too many open files); let more files be open at once (ulimit -n).")


def test_a_limit_that_cannot_be_raised_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    from lpn.core import files

    asked: list[tuple[int, int]] = []

    def refused(_: int, limits: tuple[int, int]) -> None:
        asked.append(limits)
        if limits[0] > 10_240:
            raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr(resource, "setrlimit", refused)
    for limits, expected in (
        ((256, resource.RLIM_INFINITY), [(65_536, resource.RLIM_INFINITY), (10_240, resource.RLIM_INFINITY)]),  # macOS
        ((1024, 1 << 30), [(65_536, 1 << 30), (10_240, 1 << 30)]),
        ((256, 4096), [(4096, 4096)]),
        ((4096, 4096), []),
        ((1 << 20, 1 << 20), []),
        ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), []),
    ):
        del asked[:]
        monkeypatch.setattr(resource, "getrlimit", lambda _, limits=limits: limits)
        files.raise_open_file_limit()
        assert asked == expected


def test_what_cannot_be_read_is_not_called_damaged(tmp_path: Path) -> None:
    with ExactIndex.create(tmp_path / "index", KIND) as index:
        Tiles.draw(50).add_to(index)
        index.add(["0/tile 0.jpg"], Tiles.draw(1).descriptors)
    (dead,) = (tmp_path / "index").glob("*/dead-*.npy")
    files = [*dead.parent.iterdir(), tmp_path / "index" / "index.json"]
    assert len(files) == 9
    for file in files:
        whole = file.read_bytes()
        file.unlink()
        file.mkdir()  # which nobody can read as a file, also where permissions do not bind
        sentence = f"{file} cannot be read (Is a directory); check its permissions and its disk."
        if file.name != "checksums.json":
            with pytest.raises(StoreError) as told:
                open_index(tmp_path / "index")
            # A folder's time is that of no file, so that it is only its array that is looked at.
            assert str(told.value) == sentence
        assert [verdict.message for verdict in verify(tmp_path / "index")] == [sentence]
        file.rmdir()
        file.write_bytes(whole)
    open_index(tmp_path / "index").close()


@pytest.mark.usefixtures("unmerged")
def test_a_box_reads_the_positions_of_segments_on_its_border_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index, tiles = regions(tmp_path / "index", 6)
    read: list[int] = []
    original = segments.within
    monkeypatch.setattr(segments, "within", lambda *given: read.append(1) or original(*given))
    query = tiles.descriptors[3]
    boxes: list[tuple[DegreeBox, int]] = [
        ((39, -171, 43, -147), 0),  # three whole segments
        ((41, -171, 43, -117), 6),  # half of each
        ((39, -161, 43, -149), 1),  # one whole, and part of the next
        ((50, -171, 60, -117), 0),
        ((39, 100, 43, -155), 0),  # across the antimeridian
        ((39, -130, 43, -149), 1),
        ((-90, -180, 90, 179), 0),
    ]
    with index:
        for box, count in boxes:
            del read[:]
            tiles.check(index.search(query, None, 40, box), query, None, 40, box)
            assert len(read) == count
        # One that has no position is in no box, and one that was replaced is not found where it was.
        index.add(["nowhere", "somewhere"], query[None].repeat(2, 0), [(np.nan, np.nan), (0, 100)])
        assert index.search(query, None, 200, (-1, 99, 1, 101)).ids == ["somewhere"]
        index.add(tiles.names[:1], tiles.descriptors[:1], [(0, 0)])
        tiles.positions[0] = 0
        for box, _ in boxes:
            if box[0] != -90:  # which has "somewhere" in it
                tiles.check(index.search(query, None, 200, box), query, None, 200, box)


def test_the_windows_that_an_index_is_made_for_are_in_its_manifest_and_checksum(tmp_path: Path) -> None:
    kind = replace(KIND, windows=WindowsRecord("town", (40.0, 60.0), 0.25, 8, 1000))
    create_index(tmp_path / "index", kind).close()
    with create_index(tmp_path / "index", kind) as index:
        assert index.kind == kind
    for other in (KIND, replace(kind, windows=WindowsRecord("town", (40.0, 60.0), 0.5, 8, 1000))):
        with pytest.raises(
            StoreError, match=r"windows of 40, 60 m with an overlap of 0.25 at 8 headings, of the map town"
        ):
            create_index(tmp_path / "index", other)
    manifest = tmp_path / "index" / "index.json"
    manifest.write_text(manifest.read_text().replace("0.25", "0.75"))
    with pytest.raises(StoreError, match="is damaged"):
        open_index(tmp_path / "index")


def test_smallest_boxes_meet_and_lie_in_boxes_as_their_corners_do() -> None:
    rng = np.random.default_rng(0)
    met, lay = 0, 0
    for _ in range(4000):
        # Whole degrees, so that borders often touch.
        south, north = np.sort(rng.integers(-4, 5, 2))
        west, east = rng.integers(-4, 5, 2)
        box: DegreeBox = (float(south), float(west), float(north), float(east))
        positions = rng.integers(-4, 5, (int(rng.integers(1, 4)), 2)).astype(np.float64)
        low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
        extent: DegreeBox = (*low, *high)
        inside = within(positions, box)
        assert overlaps(extent, box) or not inside.any()
        assert not covers(box, extent) or inside.all()
        met, lay = met + overlaps(extent, box), lay + covers(box, extent)
        if len(positions) == 1:
            assert overlaps(extent, box) == covers(box, extent) == bool(inside.all())
    assert 0.1 < lay / 4000 < met / 4000 < 0.9
    nowhere: DegreeBox = (np.nan, np.nan, np.nan, np.nan)
    assert not overlaps(nowhere, (-90, -180, 90, 180))
