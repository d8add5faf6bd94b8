"""Manifests, model descriptions, and positions with any value are read or refused; `make fuzz` damages whole files."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from lpn import descriptors
from lpn.core.errors import LPNError
from lpn.datasets.geo import read_positions
from lpn.models.spec import ModelSpec

MANY = settings(max_examples=150)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)
MANIFEST: dict[str, Any] = {
    "fingerprint": "0" * 16,
    "view": "drone",
    "rotate": 0.0,
    "n_parts": 2,
    "embedding": 4,
    "rows": [{"file": "a.png", "size": 1, "time_ns": 2, "box": [0, 0, 9, 9]}],
    "precision": "float32",
    "shift": 0,
    "scale": 1.0,
    "format": descriptors.FORMAT,
    "checksums": {"block": 1024, "blocks": [1], "manifest": 2},
}


@MANY
@given(key=st.sampled_from([*MANIFEST, "other"]), value=VALUES)
def test_a_manifest_with_any_value_is_read_or_refused(key: str, value: Any) -> None:
    try:
        read = descriptors.Manifest.from_json(json.dumps(MANIFEST | {key: value}).encode(), "manifest.json")
    except LPNError:
        return
    # An accepted value survives a round trip through its file.
    assert descriptors.Manifest.from_json(read.to_json(), "manifest.json") == read


@MANY
@given(key=st.sampled_from([*json.loads(ModelSpec().to_json()), "other"]), value=VALUES)
def test_a_description_with_any_value_is_read_or_refused(key: str, value: Any) -> None:
    try:
        read = ModelSpec.from_json(json.dumps(json.loads(ModelSpec().to_json()) | {key: value}))
    except LPNError:
        return
    assert ModelSpec.from_json(read.to_json()) == read
    assert read.describe()


CELLS = st.text(max_size=12) | st.floats().map(str) | st.integers(-200, 200).map(str)


@MANY
@given(rows=st.lists(st.tuples(CELLS, CELLS, CELLS), max_size=4))
def test_positions_are_on_the_earth_or_refused(rows: list[tuple[str, str, str]]) -> None:
    text = "path,latitude,longitude\n" + "".join(",".join(row) + "\n" for row in rows)
    try:
        found = read_positions(text.encode("utf-8", "replace"))
    except LPNError:
        return
    assert all(abs(place.latitude) <= 90 and abs(place.longitude) <= 180 for place in found.values())
