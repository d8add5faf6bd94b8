from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.errors import InputError, LPNError, StoreError
from lpn.index import Box, Index, Kind, MilvusIndex, Structure, create_index, open_index
from lpn.model import FloatArray
from tests.lpn.milvus_server import Server, indexed, milvus_python
from tests.lpn.test_index import (  # noqa: F401 - the contract, here with `make` of Milvus
    BOXES,
    COLLECTION,
    KIND,
    WEIGHTS,
    Client,
    Tiles,
    client,
    test_every_index_answers_as_brute_force_does,
    test_every_index_keeps_what_it_was_given,
    test_every_index_refuses_what_it_cannot_keep,
    test_names_of_all_kinds_come_back,
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with Server(milvus_python(), tmp_path_factory.mktemp("milvus") / "server") as running:
        yield running


@pytest.fixture
def make(server: Server, tmp_path: Path) -> Callable[[], Index]:
    """An empty index, or the same one once more."""
    url = f"{server.url}/contract_{abs(hash(tmp_path)):x}"
    return lambda: create_index(url, KIND)


def test_no_server_is_told_in_a_sentence() -> None:
    pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra milvus)")
    from lpn.index.milvus import MilvusIndex

    with pytest.raises(StoreError, match="does not answer, tried for 1 s") as told:
        MilvusIndex("milvus://someone:secret@127.0.0.1:9/tiles", patience=1)
    assert "secret" not in str(told.value)


def test_no_connection_is_left_open(client: type[Client]) -> None:
    with create_index(COLLECTION, KIND):
        assert [one.closed for one in client.clients] == [True, False]
    assert all(one.closed for one in client.clients)
    client.error = TypeError("not so")
    with pytest.raises(StoreError, match="refuses: not so"):
        open_index(COLLECTION)
    client.description = "a diary"
    for using in (lambda: open_index(COLLECTION), lambda: create_index(COLLECTION, KIND)):
        with pytest.raises(StoreError) as told:
            using()
        assert str(told.value) == (
            "milvus://127.0.0.1:9/tiles is a collection that lpn index did not make (lpn-milvus/1); choose another name."
        )
    assert len(client.clients) == 5
    assert all(one.closed for one in client.clients)


def test_a_collection_that_is_gone_is_told_at_once(client: type[Client], monkeypatch: pytest.MonkeyPatch) -> None:
    from pymilvus.exceptions import MilvusException

    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("it waited"))
    with open_index(COLLECTION) as index:
        client.error = MilvusException(100, "collection not found[collection=tiles]")
        with pytest.raises(StoreError, match="refuses: collection not found"):
            index.count()


def test_a_search_waits_for_what_was_just_written_and_for_nothing_later(
    client: type[Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    levels: list[str] = []
    monkeypatch.setattr(
        client, "search", lambda *_, consistency_level, **__: levels.append(consistency_level) or [[]], raising=False
    )
    monkeypatch.setattr(client, "upsert", lambda *_, **__: None, raising=False)
    now = time.monotonic()
    monkeypatch.setattr("lpn.index.milvus.time.monotonic", lambda: now)
    query = Tiles.draw(1).descriptors[0]
    with open_index(COLLECTION) as index:

        def searched_after(seconds: float) -> str:
            nonlocal now
            now += seconds
            index.search(query, None, 1)
            return levels[-1]

        assert [searched_after(1), searched_after(11)] == ["Strong", "Bounded"]
        index.add(["one"], query[None])
        assert [searched_after(1), searched_after(11)] == ["Strong", "Bounded"]
        index._let_go()  # type: ignore[attr-defined]
        assert [searched_after(1), searched_after(11)] == ["Strong", "Bounded"]


def test_a_milvus_index_sees_its_own_writes_and_soon_those_of_others(server: Server) -> None:
    tiles = Tiles.draw(400)
    with create_index(f"{server.url}/shared", KIND) as one, create_index(f"{server.url}/shared", KIND) as other:
        other._written = -1e9  # type: ignore[attr-defined]
        one.add(tiles.names[:200], tiles.descriptors[:200])
        assert len(one.search(tiles.descriptors[0], None, 400).ids) == 200
        deadline = time.monotonic() + 30
        while len(other.search(tiles.descriptors[0], None, 400).ids) < 200:
            assert time.monotonic() < deadline
            time.sleep(0.5)


@pytest.mark.parametrize("structure", ["ivf", "sq8", "hnsw"])
def test_a_milvus_collection_has_the_structure_asked_for(server: Server, structure: Structure) -> None:
    from pymilvus import MilvusClient

    tiles, url = Tiles.draw(300), f"{server.url}/of_{structure}"
    with create_index(url, KIND, structure=structure) as index:
        tiles.add_to(index)
        query = tiles.descriptors[7]
        tiles.check(index.search(query, None, 1), query, None, 1, None)
        client = MilvusClient(uri=f"http://{server.url.removeprefix('milvus://')}")
        built = client.describe_index(f"of_{structure}", "vector")["index_type"]
        assert built == {"ivf": "IVF_FLAT", "sq8": "IVF_SQ8", "hnsw": "HNSW"}[structure]
        client.drop_collection(f"of_{structure}")
        client.close()
        started = time.monotonic()
        with pytest.raises(StoreError, match="refuses"):
            index.count()
        assert time.monotonic() - started < 20


def test_a_milvus_server_killed_in_the_middle_of_an_insert_loses_nothing(server: Server) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from lpn.index.milvus import MilvusIndex

    kind = Kind("m", 4, 128)
    tiles = Tiles.draw(9000, kind=kind)
    with ThreadPoolExecutor(1) as pool:
        with MilvusIndex.create(f"{server.url}/killed", kind, patience=180) as index:  # a busy machine starts slowly
            index.add(tiles.names[:2000], tiles.descriptors[:2000], tiles.positions[:2000])
            sent: list[int] = []

            def add_the_rest() -> None:
                for start in range(2000, 9000, 200):
                    some = slice(start, start + 200)
                    sent.append(start)
                    index.add(tiles.names[some], tiles.descriptors[some], tiles.positions[some])

            adding = pool.submit(add_the_rest)
            while len(sent) < 10:
                time.sleep(0.001)
            server.kill()
            assert len(sent) < 35
            server.start()
            adding.result(timeout=240)
            assert index.count() == 9000
            assert index.holds(tiles.names).all()
            query = tiles.descriptors[8000]
            for weights, box in ((None, None), ([1, 0, 2, 1], BOXES[2])):
                tiles.check(index.search(query, weights, 9000, box), query, weights, 9000, box)
        with pytest.raises(StoreError, match="descriptors of model m, and this model is n"):
            open_index(f"{server.url}/killed", "n")
        with pytest.raises(LPNError, match="choose another collection"):
            create_index(f"{server.url}/killed", KIND)
