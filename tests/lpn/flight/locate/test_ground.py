"""Features of a map's blocks, in memory and on disk."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core.arrays import UInt8Array
from lpn.flight.locate import ground
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.matchers import Features, SiftMatcher
from lpn.flight.maps import Map
from tests.lpn.flight.locate.scenery import land, write_map


class _CountingMatcher(SiftMatcher):
    """Describes each 32nd pixel by its colour, which is quick, and counts the pictures it describes."""

    described = 0

    def features(self, picture: UInt8Array, *_: object) -> Features:
        type(self).described += 1
        colours = picture[::32, ::32].astype(np.float32)
        rows, columns = np.indices(colours.shape[:2]).reshape(2, -1)
        return Features(32 * np.stack([columns, rows], axis=1).astype(np.float32), colours.reshape(-1, 3))


@pytest.fixture
def town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Map:
    monkeypatch.setattr(_CountingMatcher, "described", 0)
    ground.in_memory.clear()
    return write_map(tmp_path / "town.tif", cv2.resize(land(), (200, 200), interpolation=cv2.INTER_AREA))


def test_blocks_are_described_once_for_all_runs_and_a_damaged_file_is_made_anew(town: Map, tmp_path: Path) -> None:
    first = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    ground.in_memory.clear()
    again = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
    assert _CountingMatcher.described == 1
    assert len(first.points) > 50
    np.testing.assert_array_equal(again.points, first.points)
    np.testing.assert_array_equal(again.descriptors, first.descriptors)
    (file,) = (tmp_path / "cache").rglob("*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    ground.in_memory.clear()
    mended = MapFeatures(town, _CountingMatcher()).around(None, 0.0, 60.0)
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


def test_the_blocks_that_were_used_last_stay_in_memory(town: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground, "MAX_BLOCKS", 1)
    features = MapFeatures(town, _CountingMatcher())
    for width in (60.0, 1000.0, 60.0, 4000.0):  # one block each, of a resolution of its own
        assert features.around(None, 0.0, width) is not None
    levels = [level for _, level, *_ in ground.in_memory]
    assert len(levels) == 2
    assert levels[0] < 0 < levels[1], "the first was used again before the third came"


def test_blocks_follow_the_ground_width_and_too_many_are_refused(town: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    features = MapFeatures(town, _CountingMatcher())
    assert [features.resolution(width) / town.resolution for width in (60.0, 1000.0)] == [0.5, 2.0]
    middle = np.zeros((1, 2))
    monkeypatch.setattr(ground, "MAX_BLOCKS", 0)
    assert features.around(None, 0.0, 60.0) is None
    assert features.around(middle, 20.0, 60.0) is None
