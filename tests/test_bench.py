"""Benchmarks, tried on small data; the one of a machine with a GPU is tried without one."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from lpn.core.numbers import wrap_degrees
from tools.bench import gpu
from tools.bench.wrong_maps import RENDERED, cut_maps, forged, open_pair

pytestmark = pytest.mark.slow


def test_parity_at_tiny_size(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu", "--device", "cpu", "--tiny"])
    gpu.main()
    told = capsys.readouterr().out
    assert told.count(" met ") == 2  # a checkpoint, and one that is exported
    for words in ("vgg16_bn, 3 views, n = 1", "ONNX Runtime, cpu"):
        assert words in told


def test_a_map_is_cut_where_a_share_of_the_tags_stays(tmp_path: Path) -> None:
    flight, own = open_pair(RENDERED, Path())
    for name, part in cut_maps(flight, own, [0.5], ["north"], tmp_path):
        x, y = part.frame.xy(*flight.degrees.T).T
        west, south, east, north = part.bounds
        assert ((x > west - 1) & (x < east + 1) & (y > south - 1) & (y < north + 1)).sum() == 20, name
        assert north - south < 500
        assert east - west > 700


def test_forged_tags_are_those_of_the_flight_turned_and_moved() -> None:
    flight, own = open_pair(RENDERED, Path())
    moved = forged(flight, own, own, 3)
    before, after = own.frame.xy(*flight.degrees.T), own.frame.xy(*moved.degrees.T)
    steps, turned = np.diff(before, axis=0), np.diff(after, axis=0)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(steps, axis=1), atol=0.05)
    long = np.linalg.norm(steps, axis=1) > 5
    turns = wrap_degrees(np.degrees(np.arctan2(*turned.T) - np.arctan2(*steps.T)))[long]
    np.testing.assert_allclose(wrap_degrees(turns - turns[0]), 0, atol=0.5)
    headings = np.array([[frame.heading for frame in one.frames] for one in (moved, flight)], float)
    np.testing.assert_allclose(wrap_degrees(headings[0] - headings[1] - turns[0]), 0, atol=0.5)
    west, south, east, north = own.bounds
    assert ((after >= (west, south)) & (after <= (east, north))).all()
    assert np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) > 5
