"""faiss's own searches, which larger indexes have: in a box, among replaced tiles, and how many they miss."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.core.errors import StoreError
from lpn.index import DegreeBox
from lpn.index.faiss import FaissIndex
from lpn.models.base import normalise
from tests.lpn.index.test_index import KIND, Tiles

faiss = pytest.importorskip("faiss", reason="faiss is not installed (the extra search)")

COUNT = 12_000
WIDE: list[DegreeBox] = [(-70, -160, 80, 170), (-85, 60, 85, 20)]
"""Boxes that leave far more tiles than are compared one by one."""


@pytest.fixture(scope="module", autouse=True)
def from_few_tiles_on() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FaissIndex, "plain", 4096)
        yield


@pytest.fixture(scope="module")
def tiles() -> Tiles:
    return Tiles.draw(COUNT)


@pytest.fixture(scope="module")
def queries(tiles: Tiles) -> Any:
    noise = np.random.default_rng(1).standard_normal((40, 4, 16)).astype(np.float32)
    return normalise(tiles.descriptors[:40] + np.float32(0.1) * noise)


@pytest.fixture(scope="module")
def made(tiles: Tiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An index of one part."""
    folder = tmp_path_factory.mktemp("faiss") / "index"
    with FaissIndex.create(folder, KIND) as index:
        tiles.add_to(index, COUNT)
    return folder


def opened(folder: Path) -> FaissIndex:
    """An index that looks through all lists and scores most tiles."""
    index = FaissIndex(folder)
    index.nprobe, index.depth = 10_000, 300
    return index


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, int]]:
    """Record for each search by faiss if only some rows were allowed, and how many lists it looked through."""
    seen: list[tuple[bool, int]] = []
    original = faiss.SearchParametersIVF

    def watched(sel: Any, nprobe: int) -> Any:
        seen.append((sel is not None, nprobe))
        return original(sel=sel, nprobe=nprobe)

    monkeypatch.setattr(faiss, "SearchParametersIVF", watched)
    return seen


def test_a_box_that_leaves_many_tiles_is_searched_by_faiss(
    made: Path, tiles: Tiles, queries: Any, searched: list[tuple[bool, int]]
) -> None:
    with opened(made) as index:
        for box in WIDE:
            assert 4096 < len(tiles.inside(box)) < 0.9 * COUNT
            for query in queries[:3]:
                for weights in (None, [0.5, 0.1, 0, 0.4]):
                    tiles.check(index.search(query, weights, 10, box), query, weights, 10, box)
    assert len(searched) == 12
    assert all(some for some, _ in searched)


def test_replaced_tiles_that_have_codes_are_not_found(
    made: Path, tiles: Tiles, queries: Any, searched: list[tuple[bool, int]], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(made, tmp_path / "index"))
    # The queries are near to the first hundred, which are added again elsewhere with other vectors.
    now = replace(tiles, descriptors=tiles.descriptors.copy(), positions=tiles.positions.copy())
    now.descriptors[:100], now.positions[:100] = tiles.descriptors[5000:5100], (50, 60)
    with opened(folder) as index:
        index.add(now.names[:100], now.descriptors[:100], now.positions[:100])
        assert index.count() == COUNT
        # Those that were replaced lie last in the brute force's order, not first.
        order = np.r_[100:COUNT, :100]
        now = Tiles([now.names[i] for i in order], now.descriptors[order], now.positions[order])
        for query in queries[:3]:
            for box in (None, WIDE[0]):
                tiles_found = index.search(query, None, 10, box)
                now.check(tiles_found, query, None, 10, box)
        assert len(searched) == 6
        assert all(some for some, _ in searched)
        # All of them, which are then learnt anew, and nothing of the old part is left.
        index.add(now.names, now.descriptors, now.positions)
        index.add(["one more"], now.descriptors[:1], now.positions[:1])
        assert index.count() == COUNT + 1
    manifest = json.loads((folder / "store.json").read_text())
    named = [entry["name"] for entry in manifest["parts"]]
    assert {path.name for path in folder.iterdir()} == {"store.json", manifest["codes"]["name"], *named}
    assert not any(name.startswith("part-0000001") for name in named)


def test_more_lists_are_looked_through_until_a_box_has_given_enough(
    tmp_path: Path, tiles: Tiles, searched: list[tuple[bool, int]]
) -> None:
    query = tiles.descriptors[0]
    # The tiles like the query lie in the south, so that the lists nearest to it hold next to none of the north.
    positions = np.where(tiles.scores(query, None) > np.median(tiles.scores(query, None)), -45.0, 45.0)
    places = np.stack([positions, np.zeros(COUNT)], 1)
    north: DegreeBox = (0, -10, 90, 10)
    with FaissIndex.create(tmp_path / "index", KIND) as index:
        index.nprobe = 1
        index.add(tiles.names, tiles.descriptors, places)
        found = index.search(query, None, 200, north)
        assert len(set(found.ids)) == 200
        assert (found.positions[:, 0] == 45).all()
        lists = [nprobe for _, nprobe in searched]
        assert lists[:3] == [1, 2, 4]
        # Any number of results, up to all tiles in the box.
        everything = index.search(query, None, COUNT // 2 - 1500, north)
        assert len(set(everything.ids)) == COUNT // 2 - 1500


@pytest.mark.parametrize(
    ("embedding", "spread", "floor"), [(9, 1.2, 0.9), (16, 0.6, 0.91)], ids=["a byte a number", "a byte for 32"]
)
def test_few_tiles_are_missed_by_default_and_more_with_less_effort(
    tmp_path: Path, embedding: int, spread: float, floor: float
) -> None:
    kind = replace(KIND, embedding=embedding)
    tiles = Tiles.draw(COUNT, spread=spread, kind=kind)
    noise = np.random.default_rng(1).standard_normal((40, 4, embedding)).astype(np.float32)
    queries = normalise(tiles.descriptors[:40] + np.float32(0.1) * noise)
    truth = [{tiles.names[i] for i in np.argsort(-tiles.scores(query, None))[:10]} for query in queries]
    with FaissIndex.create(tmp_path / "index", kind) as index:
        tiles.add_to(index, COUNT)

        def recall(nprobe: int, depth: int) -> float:
            index.nprobe, index.depth = nprobe, depth
            hits = sum(len(true & set(index.search(q, None, 10).ids)) for q, true in zip(queries, truth, strict=True))
            return hits / (10 * len(queries))

        assert recall(64, 16) >= floor  # the default
        assert recall(110, 300) >= 0.99
        assert recall(1, 16) < floor - 0.1


def test_a_full_disk_leaves_neither_half_codes_nor_a_part(
    tmp_path: Path, tiles: Tiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Any, file: str) -> None:
        Path(file).write_bytes(b"half")
        raise RuntimeError("write error")

    with FaissIndex.create(tmp_path / "index", KIND) as index:
        with monkeypatch.context() as patch:
            patch.setattr("faiss.write_index", full)
            with pytest.raises(StoreError, match=r"\.faiss cannot be written; free space"):
                tiles.add_to(index, COUNT)
        assert [path.name for path in (tmp_path / "index").iterdir()] == ["store.json"]


def test_many_small_adds_learn_once_in_many_tiles(tiles: Tiles, tmp_path: Path) -> None:
    learnt: list[str] = []
    with FaissIndex.create(tmp_path / "index", KIND) as index:
        index.nprobe, index.depth = 10_000, 300
        for start in range(0, COUNT, 500):
            some = slice(start, start + 500)
            index.add(tiles.names[some], tiles.descriptors[some], tiles.positions[some])
            learnt += [file.name for file in (tmp_path / "index").glob("*.faiss") if file.name not in learnt]
        assert len(learnt) == 2  # of 4,500 and of 9,500 tiles
        for box in (None, *WIDE):
            query = tiles.descriptors[-1]
            tiles.check(index.search(query, None, 10, box), query, None, 10, box)
