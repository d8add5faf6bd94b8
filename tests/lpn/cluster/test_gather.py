"""Shards that change while they are read: what is made of them is of one state of the pictures, or refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the extra cluster is not installed")

from lpn import descriptors
from lpn.cli import main
from lpn.cluster import gather
from lpn.cluster.gather import open_shards
from lpn.cluster.shards import (
    PLAN,
    FailedPicture,
    Plan,
    ShardItem,
    contents,
    read_notes,
    shard_name,
    write_shard,
)
from lpn.cluster.storage import Storage
from lpn.core.arrays import Float32Array
from lpn.core.errors import StoreError
from lpn.descriptors import Manifest, Row
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.writer import write_store
from lpn.index import open_index
from lpn.models.base import normalise

PARTITIONS = 3
PLANNED = Plan("f" * 16, "drone", 2, 4, "float32", PARTITIONS)
WAS = [ShardItem(Row(f"{i}.png", 10, 1), (46.0, 7.0)) for i in range(12)]
RUNS = {
    "removed": WAS[1:],
    "added": [*WAS, ShardItem(Row("new.png", 10, 1), (46.0, 7.0))],
    "changed": [ShardItem(Row(item.row.file, 11, 2), item.position) for item in WAS],
}
ANEW = "was written anew while it was read; run this again when lpn describe has ended"


def described(items: Sequence[ShardItem]) -> Float32Array:
    """Descriptors that tell pictures, and their states, apart: (B, 2, 4)."""
    raw = [np.random.default_rng([*item.row.file.encode(), item.row.size]).standard_normal((2, 4)) for item in items]
    return normalise(np.array(raw, np.float32).reshape(-1, 2, 4))


def begin(folder: Path, items: Sequence[ShardItem]) -> None:
    """Do the work of lpn describe until it writes its plan for the last time."""
    Storage(folder).write(PLAN, PLANNED.to_json())
    write(folder, PLANNED, items)


def write(folder: Path, plan: Plan, items: Sequence[ShardItem]) -> None:
    for partition in range(PARTITIONS):
        mine = [item for item in items if plan.partition(item.row.file) == partition]
        write_shard(Storage(folder), plan, partition, mine, described(mine))


def end(folder: Path) -> None:
    storage = Storage(folder)
    notes = [one for one in read_notes(storage, PLANNED, range(PARTITIONS)) if one is not None]
    storage.write(PLAN, replace(PLANNED, finished=True, contents=contents(notes)).to_json())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "shards").mkdir()
    begin(tmp_path / "shards", WAS)
    end(tmp_path / "shards")
    return tmp_path / "shards"


def changed(run: str) -> set[int]:
    """Partitions that a run writes otherwise than they were."""
    return {PLANNED.partition(item.row.file) for item in set(WAS) ^ set(RUNS[run])}


def begins_before(
    monkeypatch: pytest.MonkeyPatch, method: str, partition: int, folder: Path, items: Sequence[ShardItem]
) -> None:
    """A run begins before a method of `Shards` first reads a partition."""
    real, begun = getattr(gather.Shards, method), []

    def later(self: gather.Shards, at: int, *more: object) -> object:
        if at == partition and not begun:
            begun.append(at)
            begin(folder, items)
        return real(self, at, *more)

    monkeypatch.setattr(gather.Shards, method, later)


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(("method", "partition"), [("items", 0), *(("read", p) for p in range(PARTITIONS))])
def test_gather_makes_a_store_of_one_state_or_none(
    method: str,
    partition: int,
    run: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "store"
    given = ["describe", "--shards", str(folder), "--out", str(out)]

    def check(items: Sequence[ShardItem]) -> None:
        expected = sorted(items, key=lambda item: item.row.file)
        store = descriptors.open_store(out)
        assert list(store.manifest.rows) == [item.row for item in expected]
        np.testing.assert_array_equal(store.float32, described(expected))

    begins_before(monkeypatch, method, partition, folder, RUNS[run])
    status = main.main(given)
    # `items` reads several at once, so that the run may be late for some of them there.
    if method == "items" or any(p >= partition for p in changed(run)):
        assert status == 2
        assert ANEW in (said := capsys.readouterr().err)
        assert said.count("\n") == 1
        assert not (out / "manifest.json").exists()
    else:
        check(WAS)
    assert main.main(["describe", "--shards", str(folder), "--out", str(tmp_path / "other")]) == 2
    assert "has not ended" in capsys.readouterr().err
    end(folder)
    assert main.main(given) == 0
    check(RUNS[run])


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(("method", "partition"), [("tiles", 0), *(("descriptors", p) for p in range(PARTITIONS))])
def test_an_index_is_made_of_one_state_as_far_as_it_goes(
    method: str,
    partition: int,
    run: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("lpn.index.tiles._CHUNK_BYTES", 1)  # a chunk for each partition
    given = ["index", "--descriptors", str(folder), "--out", str(tmp_path / "index")]

    def check(items: Sequence[ShardItem]) -> None:
        with open_index(tmp_path / "index") as index:
            assert index.count() == len(items)
            for item, row in zip(items, described(items), strict=True):
                found = index.search(row, None, 1)
                assert found.ids == [item.row.file]
                np.testing.assert_array_equal(found.vectors[0], row)

    begins_before(monkeypatch, method, partition, folder, RUNS[run])
    status = main.main(given)
    if method == "tiles" or any(p >= partition for p in changed(run)):
        assert status == 2
        assert ANEW in (said := capsys.readouterr().err)
        assert said.count("\n") == 1
    else:
        check(WAS)
    end(folder)
    assert main.main([*given, "--replace"]) == 0
    gone = [item for item in WAS if item.row.file not in {one.row.file for one in RUNS[run]}]
    with open_index(tmp_path / "index") as index:
        there = [item for item in gone if index.holds([item.row.file])[0]]
    check([*RUNS[run], *there])


@pytest.mark.parametrize(("ends", "said"), [(False, "their run has not ended"), (True, ANEW)])
def test_a_run_that_begins_or_ends_while_shards_are_opened_is_seen(
    ends: bool, said: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = read_notes

    def meanwhile(storage: Storage, plan: Plan, partitions: Sequence[int]) -> object:
        """The first shard is looked at before a run begins, the others after it ended."""
        first = real(storage, plan, partitions[:1])
        begin(folder, RUNS["changed"])
        if ends:
            end(folder)
        return first + real(storage, plan, partitions[1:])

    monkeypatch.setattr(gather, "read_notes", meanwhile)
    with pytest.raises(StoreError, match=said):
        open_shards(folder)


@pytest.mark.parametrize("positions", [False, True])
def test_a_tile_that_broke_between_two_looks_at_its_shard_is_seen(
    positions: bool, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The digest of a shard is the same then: it is of what is settled."""
    (tmp_path / "geo.csv").write_text("path,latitude,longitude\n" + "".join(f"{i.row.file},1,2\n" for i in WAS))
    real, seen = gather.Shards.tiles, []

    def tiles(self: gather.Shards, partition: int) -> gather.ShardTiles:
        seen.append(partition)
        if seen.count(1) == 2:
            broke, *mine = [item for item in WAS if PLANNED.partition(item.row.file) == 1]
            write_shard(self.storage, PLANNED, 1, mine, described(mine), [FailedPicture(broke, "is damaged", True)])
        return real(self, partition)

    monkeypatch.setattr(gather.Shards, "tiles", tiles)
    given = ["index", "--descriptors", str(folder), "--out", str(tmp_path / "index")]
    assert main.main([*given, "--data", str(tmp_path)] if positions else given) == 2
    assert f"{shard_name(1)} in {folder} {ANEW}" in capsys.readouterr().err


def test_a_shard_of_other_pictures_is_refused(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two shards with the same picture would be taken for two tiles."""
    write_shard(Storage(folder), PLANNED, 1, WAS, described(WAS))
    end(folder)
    assert main.main(["index", "--descriptors", str(folder), "--out", str(tmp_path / "index")]) == 2
    assert f"{shard_name(1)} in {folder} holds pictures that belong in other shards" in capsys.readouterr().err
    assert not (tmp_path / "index").exists()


def test_a_store_with_rows_left_out_is_not_finished(tmp_path: Path) -> None:
    rows = tuple(item.row for item in WAS)
    manifest = Manifest("f" * 16, "drone", 0.0, 2, 4, rows)

    def fill(unfinished: PartialStore) -> None:
        missing = np.flatnonzero(~unfinished.good)[:7].tolist()
        unfinished.put(missing, described([WAS[i] for i in missing]))

    with pytest.raises(StoreError, match="5 of 12 rows of the store"):
        write_store(tmp_path, manifest, fill)
    assert not (tmp_path / "manifest.json").exists()
    np.testing.assert_array_equal(write_store(tmp_path, manifest, fill).float32, described(WAS))
