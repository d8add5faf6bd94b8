"""The two readings of a query that is described at several turns."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tools import turned_queries
from tools.fixtures import small_worlds
from tools.turned_queries import TURNS, averaged, searched


def test_a_turn_is_averaged_or_searched() -> None:
    noise = np.random.default_rng(0)
    tiles = averaged(noise.standard_normal((1, 6, 2, 8)).astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(tiles, axis=(1, 2)), 1.0, rtol=1e-5)
    other = averaged(noise.standard_normal((1, 6, 2, 8)).astype(np.float32))
    # At one of two turns each query is its tile.
    turned = np.stack([np.where(np.arange(6)[:, None, None] % 2 == turn, tiles, other) for turn in (0, 1)])
    np.testing.assert_array_equal(searched(turned, tiles), np.arange(6))
    by_hand = turned[0] + turned[1]
    np.testing.assert_allclose(
        averaged(turned), by_hand / np.linalg.norm(by_hand, axis=2, keepdims=True) / np.sqrt(2), rtol=1e-5
    )


def test_each_set_of_turns_is_measured(tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lpn.retrieval.calibration.MIN_PICTURES", 4)
    data = small_worlds.make_dataset(tmp_path / "places", train=1, test=6)
    out = tmp_path / "turns.json"
    monkeypatch.setattr(sys, "argv", ["turned_queries.py", str(data), str(model_file), "--out", str(out)])
    turned_queries.main()
    found = json.loads(out.read_bytes())
    assert [tuple(row["turns"]) for row in found["rows"]] == list(TURNS)

    assert found["queries"] == 6

    assert found["rows"][0]["average"] == pytest.approx(found["rows"][0]["search"])
