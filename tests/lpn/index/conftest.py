"""Fixtures of the index tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tools.fixtures.milvus_server import MilvusServer, milvus_python


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MilvusServer]:
    """A running Milvus server that demands passwords; skips where LPN_MILVUS_PYTHON is not set."""
    with MilvusServer(milvus_python(), tmp_path_factory.mktemp("milvus") / "server", passwords=True) as running:
        yield running
