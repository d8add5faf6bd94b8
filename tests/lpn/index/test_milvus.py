"""The Milvus index against a client that stands for pymilvus's."""

from __future__ import annotations

import pytest

from lpn.core.errors import InputError, StoreError
from lpn.index import create_index, open_index
from tests.lpn.index.test_index import KIND
from tools.fixtures.milvus_server import COLLECTION, FakeMilvusClient, pretend


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[FakeMilvusClient]:
    """The fake Milvus client of a test."""
    return pretend(monkeypatch, KIND)


@pytest.mark.parametrize(
    "url", ["milvus://host/tiles", "milvus://host:0x1/tiles", "milvus://host:1/", "milvus://host:1/a b"]
)
def test_an_address_is_of_a_collection(url: str) -> None:
    pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra cluster)")
    with pytest.raises(InputError, match="is not the address of a Milvus collection; expected milvus://host:port"):
        open_index(url)


def test_a_collection_is_exact_or_hnsw(client: type[FakeMilvusClient]) -> None:
    with pytest.raises(InputError, match=r"ends in \?hnws; expected \?hnsw, or nothing"):
        create_index(f"{COLLECTION}?hnws", KIND)
    with pytest.raises(StoreError, match=r"was made without \?hnsw; leave it out, or choose another collection"):
        create_index(f"{COLLECTION}?hnsw", KIND)
    client.structure = "HNSW"
    create_index(f"{COLLECTION}?hnsw", KIND).close()


def test_errors_are_one_sentence_and_no_connection_is_left_open(client: type[FakeMilvusClient]) -> None:
    from pymilvus.exceptions import MilvusException

    with create_index(COLLECTION, KIND) as index:
        assert [one.closed for one in client.clients] == [False]
        client.error = MilvusException(1401, "privilege not permitted\nat all")
        with pytest.raises(StoreError, match=r"does not answer \(privilege not permitted at all\); check the"):
            index.count()
    with pytest.raises(StoreError, match="privilege not permitted") as told:
        open_index(COLLECTION.replace("//", "//someone:secret@"))
    assert "secret" not in str(told.value)
    client.description = "a diary"
    for using in (lambda: open_index(COLLECTION), lambda: create_index(COLLECTION, KIND)):
        with pytest.raises(StoreError, match="is a collection that lpn index did not make; choose another name"):
            using()
    assert all(one.closed for one in client.clients)
