"""The Milvus index against a client that stands for pymilvus's."""

from __future__ import annotations

import time

import pytest

from lpn.core.errors import StoreError
from lpn.index import MilvusIndex, create_index, open_index
from tests.lpn.index.test_index import KIND
from tools.fixtures.milvus_server import COLLECTION, FakeMilvusClient, pretend


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[FakeMilvusClient]:
    """The fake Milvus client of a test."""
    return pretend(monkeypatch, KIND)


def test_no_server_is_told_in_a_sentence() -> None:
    pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra cluster)")
    with pytest.raises(StoreError, match="does not answer after 1 s") as told:
        MilvusIndex("milvus://someone:secret@127.0.0.1:9/tiles", patience=1)
    assert "secret" not in str(told.value)


def test_no_connection_is_left_open(client: type[FakeMilvusClient]) -> None:
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


@pytest.mark.parametrize(
    ("code", "message", "said"),
    [
        (100, "collection not found[collection=tiles]", "refuses: collection not found"),
        *(
            (code, "privilege not permitted", r"denies access \(privilege not permitted\)")
            for code in (1400, 1401, 1800)
        ),
    ],
)
def test_what_no_retry_mends_is_told_at_once(
    client: type[FakeMilvusClient], monkeypatch: pytest.MonkeyPatch, code: int, message: str, said: str
) -> None:
    from pymilvus.exceptions import MilvusException

    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("it waited"))
    with open_index(COLLECTION) as index:
        client.error = MilvusException(code, message)
        with pytest.raises(StoreError, match=said):
            index.count()
