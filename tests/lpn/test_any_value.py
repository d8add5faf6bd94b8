"""Manifests, model descriptions, and positions with any value are read or refused; `make fuzz` damages whole files."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpn import descriptors
from lpn.core.checksums import crc_of_values
from lpn.core.errors import LPNError
from lpn.datasets.geo import read_positions
from lpn.models.spec import ModelSpec

MANY = settings(max_examples=150)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)
ROW = descriptors.Row("a.png", 1, 2, (0.0, 0.0, 9.0, 9.0))
FILES = {
    "store.json": ("kind", "parts", "engine", "codes"),
    "rows.json": ("files", "sizes", "times", "boxes", "positions", "sum"),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> descriptors.Store:
    kind = descriptors.DescriptorKind("0" * 16, 2, 4, view="drone")
    folder = tmp_path_factory.mktemp("store")
    return descriptors.write_store(folder, kind, [ROW], lambda partial: partial.put([0], np.zeros((1, 2, 4))))


@MANY
@given(file=st.sampled_from([(name, key) for name, keys in FILES.items() for key in keys]), value=VALUES)
def test_a_store_with_any_value_is_read_or_refused(store: descriptors.Store, file: tuple[str, str], value: Any) -> None:
    name, key = file
    changed = store.folder / name if name == "store.json" else store.parts[0].folder / name
    whole = changed.read_bytes()
    values = json.loads(whole) | {key: value}
    if "checksum" in values:
        values["checksum"] = crc_of_values({one: values[one] for one in values if one != "checksum"})
    changed.write_text(json.dumps(values))
    try:
        read = descriptors.open_store(store.folder)
        assert len(read) == len(read.rows) == len(read.positions) == len(read.float32)
    except LPNError:
        pass
    finally:
        changed.write_bytes(whole)


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
        found = read_positions(text)
    except LPNError:
        return
    assert all(abs(place.latitude) <= 90 and abs(place.longitude) <= 180 for place in found.values())
