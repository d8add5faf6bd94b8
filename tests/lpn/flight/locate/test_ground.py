"""Features of a map's blocks, in memory and on disk."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.flight.locate import ground
from lpn.flight.locate.ground import GroundCache, MapFeatures
from lpn.flight.locate.matchers import SiftMatcher
from lpn.flight.locate.registration import Ground
from lpn.flight.maps import Map
from tests.lpn.flight.locate.scenery import land, write_map


class _CountingMatcher(SiftMatcher):
    """SIFT that counts the pictures it describes."""

    described = 0

    def features(self, *given):  # type: ignore[no-untyped-def]
        type(self).described += 1
        return super().features(*given)


@pytest.fixture
def town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Map:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(_CountingMatcher, "described", 0)
    ground.in_memory.clear()
    return write_map(tmp_path / "town.tif", cv2.resize(land(), (200, 200), interpolation=cv2.INTER_AREA))


def test_blocks_are_described_once_for_all_runs_and_a_damaged_file_is_made_anew(town: Map, tmp_path: Path) -> None:
    first = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    ground.in_memory.clear()
    again = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    assert first is not None
    assert again is not None
    assert _CountingMatcher.described == 1
    assert len(first.points) > 50
    np.testing.assert_array_equal(again.points, first.points)
    np.testing.assert_array_equal(again.descriptors, first.descriptors)
    (file,) = (tmp_path / "cache").rglob("*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    ground.in_memory.clear()
    mended = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    assert mended is not None
    np.testing.assert_array_equal(mended.points, first.points)
    ground.in_memory.clear()
    MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    assert _CountingMatcher.described == 2


@pytest.mark.parametrize("changed", ["map", "matcher"])
def test_another_map_or_matcher_has_features_of_its_own(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    if changed == "map":
        town = write_map(tmp_path / "town.tif", cv2.resize(land(1), (200, 200), interpolation=cv2.INTER_AREA))
    else:
        monkeypatch.setattr(_CountingMatcher, "version", "another")
    MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    assert _CountingMatcher.described == 2


def test_a_cache_that_cannot_be_written_is_said_once(
    town: Map, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_bytes(b"a file in place of the folder")
    features = MapFeatures(town, _CountingMatcher())
    with caplog.at_level(logging.WARNING):
        for width in (60.0, 400.0):
            assert features.around(None, 0.0, width) is not None
    assert [record.getMessage().partition(" are ")[0] for record in caplog.records] == ["Features of the map"]


def test_features_of_all_maps_together_take_a_limited_number_of_bytes() -> None:
    cache, made = GroundCache(8000), list[str]()

    def get(key: str, features: int = 40) -> None:
        def make() -> Ground:
            made.append(key)
            return Ground(np.zeros((features, 2)), np.zeros((features, 16), np.float32), 1.0)  # 80 bytes each

        cache.get(key, make)

    for key in "abaca":
        get(key)
    assert made == ["a", "b", "c"], "the one that was used last stays"
    get("b")
    get("d", 200)
    get("d")
    assert made == ["a", "b", "c", "b", "d"], "the newest is kept, whatever it takes"
    get("a")
    assert made[5:] == ["a"]
