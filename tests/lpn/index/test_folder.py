"""An index as a folder: the files that it deletes and opens, and messages about unreadable ones."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import StoreError
from lpn.descriptors import open_store, write_store
from lpn.descriptors.store import Part, Row, Store
from lpn.doctor.verify import verify
from lpn.index import Index, WindowsRecord, create_index, open_index
from tests.lpn.index.test_index import KIND, Tiles

EACH = 16
"""Tiles of a part below."""


def regions(path: Path, count: int) -> tuple[Index, Tiles]:
    """An index of so many parts, each of a region two degrees wide, 10 degrees east of the one before."""
    tiles = Tiles.draw(EACH * count)
    rng = np.random.default_rng(2)
    corners = np.stack([np.full(count, 40.0), -170.0 + 10 * np.arange(count)], 1).repeat(EACH, 0)
    tiles.positions = corners + rng.uniform(0, 2, (len(corners), 2))
    index = create_index(path, KIND)
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
        f"{pictures} holds other files, such as 0000001, and no store.json; choose another folder for the index."
    )
    assert files_below(pictures) == before
    # A process that was killed before it wrote store.json leaves this.
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "store.json.12-34.part").touch()
    create_index(tmp_path / "killed", KIND).close()


def test_a_store_that_has_lost_its_manifest_is_left_as_it_is(tmp_path: Path) -> None:
    with create_index(tmp_path / "index", KIND) as index:
        Tiles.draw(50).add_to(index)
    (tmp_path / "index" / "store.json").unlink()
    before = files_below(tmp_path / "index")
    for using in (lambda: create_index(tmp_path / "index", KIND), lambda: open_index(tmp_path / "index")):
        with pytest.raises(StoreError, match=r"no store\.json"):
            using()
    assert files_below(tmp_path / "index") == before


def test_what_somebody_puts_into_an_index_is_never_deleted(tmp_path: Path) -> None:
    tiles, place = Tiles.draw(300), tmp_path / "index"
    with create_index(place, KIND) as index:
        index.add(tiles.names[:10], tiles.descriptors[:10], tiles.positions[:10])
        (first,) = place.glob("part-*")
        own = ["part-0000003-abcdef/photo.jpg", "part-0000004-abcdef/rows.json/photo.jpg", f"{first.name}/photo.jpg"]
        own += ["0000005/vectors.npy", "part-07-abcdef/vectors.npy", "store.json.mine.part", "notes.txt", "a.faiss"]
        for name in own:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(b"not ours")
        (place / "part-0000006-abcdef").symlink_to(place / "part-07-abcdef")
        (place / "part-0000007-abcdef").mkdir()
        (place / "part-0000007-abcdef" / "vectors.npy").symlink_to(place / "part-07-abcdef" / "vectors.npy")
        # This is the folder of an add that was killed.
        shutil.copytree(first, place / "part-0000009-abcdef", ignore=shutil.ignore_patterns("photo.jpg"))
        for start in range(10, 300, 10):
            some = slice(start, start + 10)
            index.add(tiles.names[some], tiles.descriptors[some], tiles.positions[some])
        index.add(tiles.names[:10], tiles.descriptors[:10], tiles.positions[:10])  # so that the first part is replaced
        query = tiles.descriptors[17]
        tiles.check(index.search(query, None, 300), query, None, 300, None)
    assert [name for name in own if (place / name).read_bytes() != b"not ours"] == []
    named = {entry["name"] for entry in json.loads((place / "store.json").read_text())["parts"]}
    assert first.name not in named
    left = {path.name for path in place.iterdir()} - named
    links = {"part-0000006-abcdef", "part-0000007-abcdef"}
    assert left == {"store.json", *links, *(name.partition("/")[0] for name in own)}


def test_an_add_opens_only_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index, tiles = regions(tmp_path / "index", 6)
    assert index.count() == 6 * EACH
    opened: list[str] = []
    original = Part.open
    monkeypatch.setattr(Part, "open", lambda place, *given: opened.append(place.name[:12]) or original(place, *given))
    with index, open_index(tmp_path / "index") as other:
        assert opened == [f"part-{i:07d}" for i in range(1, 7)]
        del opened[:]
        more = Tiles.draw(3 * EACH, seed=4)
        more.names = [f"more {name}" for name in more.names]
        more.add_to(index, EACH)
        assert index.count() == other.count() == 9 * EACH
        assert sorted(opened) == [f"part-{i:07d}" for i in (7, 7, 8, 8, 9, 9)]
        del opened[:]
        # A tile of the second part, which stays open.
        index.add(tiles.names[EACH : EACH + 1], more.descriptors[:1])
        assert index.search(more.descriptors[0], None, 1).scores[0] == pytest.approx(1, abs=1e-6)
        assert opened == ["part-0000010"]
        assert index.count() == other.count() == 9 * EACH


def test_an_index_made_anew_in_the_same_place_is_read_anew(tmp_path: Path) -> None:
    index, _ = regions(tmp_path / "index", 2)
    other = Tiles.draw(2 * EACH, seed=8)
    with index:
        shutil.rmtree(tmp_path / "index")
        with pytest.raises(StoreError, match=r"has no store\.json"):
            index.count()
        with create_index(tmp_path / "index", KIND) as again:
            other.add_to(again, EACH)
        other.check(index.search(other.descriptors[5], None, 7), other.descriptors[5], None, 7, None)


LIMITED = """
import resource, sys
from lpn.core.errors import StoreError
from lpn.index import open_index
resource.setrlimit(resource.RLIMIT_NOFILE, (35, 400))
with open_index(sys.argv[1]) as index:
    print(index.count())
resource.setrlimit(resource.RLIMIT_NOFILE, (35, 35))
try:
    open_index(sys.argv[1])
except StoreError as error:
    print(error)
"""


def test_more_files_than_may_be_open_are_allowed_or_told_as_that(tmp_path: Path) -> None:
    regions(tmp_path / "index", 35)[0].close()
    command = [sys.executable, "-c", LIMITED, str(tmp_path / "index")]
    count, said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    assert int(count) == 35 * EACH
    assert said.startswith(str(tmp_path / "index" / "part-00000"))
    assert said.endswith("cannot be read (Too many open files); let more files be open at once (ulimit -n).")


def test_some_rows_are_read_from_their_parts_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index, tiles = regions(tmp_path / "index", 3)
    index.add(tiles.names[5:40:7], tiles.descriptors[5:40:7])
    index.close()
    store = open_store(tmp_path / "index")
    rows = np.random.default_rng(0).permutation(len(store))
    expected = store.float32[rows]
    monkeypatch.setattr(Store, "descriptors", None)
    np.testing.assert_array_equal(store.some(rows), expected)
    assert store.some(rows[:0]).shape == (0, *expected.shape[1:])


def test_descriptors_never_replace_an_index(tmp_path: Path) -> None:
    with create_index(tmp_path / "index", KIND) as index:
        Tiles.draw(20).add_to(index)
    before = files_below(tmp_path / "index")
    with pytest.raises(StoreError, match="is an index, which descriptors would replace; choose another folder"):
        write_store(tmp_path / "index", KIND, [Row("a.jpg", 1, 1)], lambda _: None)
    assert files_below(tmp_path / "index") == before


def test_values_that_are_not_finite_are_told(tmp_path: Path) -> None:
    vectors = Tiles.draw(10).descriptors
    vectors[3] = np.nan
    rows = [Row(f"{i}.jpg", 1, 1) for i in range(10)]
    write_store(tmp_path / "store", KIND, rows, lambda partial: partial.put(range(10), vectors))
    assert "holds values that are not finite; delete that folder" in next(iter(verify(tmp_path / "store"))).message
    with open_index(tmp_path / "store") as index, pytest.raises(StoreError, match="values that are not finite"):
        index.search(vectors[0], None, 3)


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
    with create_index(tmp_path / "index", KIND) as index:
        Tiles.draw(50).add_to(index)
    (part,) = (path for path in (tmp_path / "index").iterdir() if path.is_dir())
    files = [*part.iterdir(), tmp_path / "index" / "store.json"]
    assert len(files) == 3
    for file in files:
        whole = file.read_bytes()
        file.unlink()
        file.mkdir()  # which nobody can read as a file, also where permissions do not bind
        sentence = f"{file} cannot be read (Is a directory); check its permissions and its disk."
        with pytest.raises(StoreError) as told:
            open_index(tmp_path / "index").holds(["any"])
        assert str(told.value) == sentence
        assert [verdict.message for verdict in verify(tmp_path / "index")] == [sentence]
        file.rmdir()
        file.write_bytes(whole)
    open_index(tmp_path / "index").close()


def test_the_windows_that_an_index_is_made_for_are_in_its_manifest_and_checksum(tmp_path: Path) -> None:
    kind = replace(KIND, windows=WindowsRecord("town", (40.0, 60.0), 0.25, 8, 1000))
    create_index(tmp_path / "index", kind).close()
    with create_index(tmp_path / "index", kind) as index:
        assert index.kind == kind
    for other in (KIND, replace(kind, windows=WindowsRecord("town", (40.0, 60.0), 0.5, 8, 1000))):
        with pytest.raises(StoreError, match=r"windows of 40, 60 m with an overlap of 0.25 at 8 headings, of the map"):
            create_index(tmp_path / "index", other)
    manifest = tmp_path / "index" / "store.json"
    manifest.write_text(manifest.read_text().replace("0.25", "0.75"))
    with pytest.raises(StoreError, match="is damaged"):
        open_index(tmp_path / "index")
