"""The tests' own surroundings."""

from __future__ import annotations

from pathlib import Path

import pytest

from lpn.core.files import cache_folder


@pytest.fixture(scope="module")
def early() -> Path:
    """The cache when something is made for several tests."""
    return cache_folder()


def test_no_test_has_the_users_cache(early: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert early.is_relative_to(tmp_path_factory.getbasetemp())
    assert cache_folder() == tmp_path / "cache"
