"""The Milvus index against a real server: the contract of every index, built structures, and a killed server."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import LPNError, StoreError
from lpn.index import DegreeBox, DescriptorKind, Index, create_index, open_index
from lpn.models.base import normalise
from tests.lpn.index.test_index import (  # noqa: F401 - the contract, with `make` of this module
    BOXES,
    KIND,
    WEIGHTS,
    Tiles,
    test_every_index_answers_as_brute_force_does,
    test_every_index_keeps_what_it_was_given,
    test_every_index_refuses_what_it_cannot_keep,
    test_names_of_all_kinds_come_back,
)
from tools.fixtures.milvus_server import MilvusServer, indexed, milvus_python

pytestmark = pytest.mark.slow
STRUCTURES = ("flat", "hnsw")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MilvusServer]:
    """A running Milvus server that demands passwords; skips where LPN_MILVUS_PYTHON is not set.

    It ends with this file: a server that has nothing to do takes a tenth of a core.
    """
    with MilvusServer(milvus_python(), tmp_path_factory.mktemp("milvus") / "server", passwords=True) as running:
        yield running


@pytest.fixture
def make(server: MilvusServer, tmp_path: Path) -> Callable[[], Index]:
    """An empty index, or the same one once more."""
    url = f"{server.url}/contract_{abs(hash(tmp_path)):x}"
    return lambda: create_index(url, KIND)


def test_a_milvus_index_sees_its_own_writes_and_soon_those_of_others(server: MilvusServer) -> None:
    tiles = Tiles.draw(400)
    with create_index(f"{server.url}/shared", KIND) as one, create_index(f"{server.url}/shared", KIND) as other:
        one.add(tiles.names[:200], tiles.descriptors[:200])
        assert len(one.search(tiles.descriptors[0], None, 400).ids) == 200
        deadline = time.monotonic() + 240
        while len(other.search(tiles.descriptors[0], None, 400).ids) < 200:
            assert time.monotonic() < deadline
            time.sleep(0.5)
    with pytest.raises(StoreError, match="descriptors of model 0123456789abcdef, and this model is n"):
        open_index(f"{server.url}/shared", "n")
    with pytest.raises(LPNError, match="choose another collection"):
        create_index(f"{server.url}/shared", DescriptorKind("m", 4, 128))


def test_after_a_server_was_killed_the_same_command_goes_on(server: MilvusServer) -> None:
    kind = DescriptorKind("m", 4, 128)
    tiles = Tiles.draw(6000, kind=kind)
    url = f"{server.url}/killed"
    with create_index(url, kind) as index:
        index.add(tiles.names[:3000], tiles.descriptors[:3000], tiles.positions[:3000])
        server.kill()
        with pytest.raises(StoreError, match=r"refuses or does not answer .*run this again"):
            index.add(tiles.names[3000:], tiles.descriptors[3000:], tiles.positions[3000:])
    server.start()
    for _ in range(60):  # a busy machine starts slowly
        with suppress(StoreError), create_index(url, kind) as index:
            index.add(tiles.names[2000:], tiles.descriptors[2000:], tiles.positions[2000:])
            assert index.count() == 6000
            assert index.holds(tiles.names).all()
            query = tiles.descriptors[5000]
            tiles.check(index.search(query, [1, 0, 2, 1], 6000, BOXES[2]), query, [1, 0, 2, 1], 6000, BOXES[2])
            break
        time.sleep(1)
    else:
        pytest.fail("the server does not answer again")


@pytest.fixture(scope="module")
def built(server: MilvusServer) -> dict[str, tuple[Index, Tiles]]:
    """A collection of each structure whose index is built, which begins at 1,024 tiles and at a flush."""

    def make(structure: str) -> tuple[Index, Tiles]:
        tiles = Tiles.draw(6000)
        ending = "" if structure == "flat" else f"?{structure}"
        index = create_index(f"{server.url}/built_{structure}{ending}", KIND)
        tiles.add_to(index, 3000)
        indexed(server.client(), f"built_{structure}", structure)
        return index, tiles

    with ThreadPoolExecutor(2) as pool:
        return dict(zip(STRUCTURES, pool.map(make, STRUCTURES), strict=True))


def _recall(index: Index, tiles: Tiles, k: int, box: DegreeBox | None, queries: int = 6) -> float:
    """Return the share of the true k that is found; assert that each tile returns as it was added."""
    rng, inside, hits, wanted = np.random.default_rng(2), tiles.inside(box), 0, 0
    rows_of = {name: row for row, name in enumerate(tiles.names)}
    noise = rng.standard_normal((queries, *tiles.descriptors.shape[1:])).astype(np.float32)
    for i, query in enumerate(normalise(tiles.descriptors[:queries] + 0.1 * noise)):
        weights = WEIGHTS[i % len(WEIGHTS)]
        scores = tiles.scores(query, weights)
        found = index.search(query, weights, k, box)
        rows = np.array([rows_of[name] for name in found.ids])
        assert len(set(found.ids)) == len(found) <= min(k, len(inside))
        assert set(rows) <= set(inside)
        np.testing.assert_array_equal(found.vectors, tiles.descriptors[rows])
        np.testing.assert_array_equal(found.positions, tiles.positions[rows])
        np.testing.assert_allclose(found.scores, scores[rows], rtol=0, atol=1e-12)
        assert (np.diff(found.scores) <= 0).all()
        hits += len(set(rows) & set(inside[np.argsort(-scores[inside])[:k]]))
        wanted += min(k, len(inside))
    return hits / wanted


@pytest.mark.parametrize("structure", STRUCTURES)
def test_a_built_index_finds_most_tiles_and_a_flat_one_all(
    built: dict[str, tuple[Index, Tiles]], structure: str
) -> None:
    index, tiles = built[structure]
    for k, box in ((10, None), (200, None), (10, BOXES[2])):
        assert _recall(index, tiles, k, box) >= (1 if structure == "flat" else 0.9)
    assert _recall(index, tiles, 3000, None) >= (1 if structure == "flat" else 0.5)


def test_who_may_not_is_told_at_once(server: MilvusServer) -> None:
    create_index(f"{server.url}/forbidden", KIND).close()
    server.client().create_user("bob", "Password1")
    for token in ("", "root:wrong", "bob:Password1"):
        with pytest.raises(StoreError, match=r"refuses or does not answer .*your rights") as told:
            open_index(f"{server.url_of(token)}/forbidden")
        assert "Password1" not in str(told.value)
