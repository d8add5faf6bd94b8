"""A few hundred damaged files for every reader; `python -m tools.fuzz.readers` reads ten thousand, in processes of their own."""

from __future__ import annotations

import json
import warnings
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lpn import descriptors
from lpn.core.errors import LPNError
from lpn.datasets.geo import read_positions
from lpn.models.spec import ModelSpec
from tools.fuzz.readers import an_input, run
from tools.fuzz.targets import TARGETS, complaint, described, misbehaving

FEW = {"pth": 60, "safetensors": 60, "onnx": 100}
"""Of these, an input takes tens of milliseconds."""

QUIET = settings(
    max_examples=150,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_damage_is_one_sentence(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    if name == "shards":
        pytest.importorskip("pyarrow")
    cases = TARGETS[name](tmp_path)
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries, on what is damaged
        for number in range(FEW.get(name, 300)):
            case, data = an_input(name, cases, number, seed=1)
            if (error := complaint(case.read, data)) is not None:
                found.append(f"{number}: {described(error)}")
    assert not found


def test_whatever_a_reader_may_not_do_is_found(tmp_path: Path) -> None:
    """A process that ends, an input that comes to no end, and an error that is none of ours, each by the input that did it."""
    done, found = run("misbehaving", 8, stuck=1.0)
    expected = {}
    cases = misbehaving(tmp_path)
    for number in range(8):
        kind = zlib.crc32(an_input("misbehaving", cases, number)[1]) % 4
        if kind < 3:
            expected[number] = ("the process ended (6)", "came to no end in 1 s", "KeyError")[kind]
    assert done == 8
    assert {finding.number for finding in found} == set(expected)
    assert all(finding.said.startswith(expected[finding.number]) for finding in found)
    assert len({*expected.values()}) == 3


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


@QUIET
@given(key=st.sampled_from([*MANIFEST, "other"]), value=VALUES)
def test_a_manifest_with_any_value_is_read_or_refused(key: str, value: Any) -> None:
    try:
        read = descriptors.Manifest.from_json(json.dumps(MANIFEST | {key: value}).encode(), "manifest.json")
    except LPNError:
        return
    # What is accepted can be written and is the same again.
    assert descriptors.Manifest.from_json(read.to_json(), "manifest.json") == read


@QUIET
@given(key=st.sampled_from([*json.loads(ModelSpec().to_json()), "other"]), value=VALUES)
def test_a_description_with_any_value_is_read_or_refused(key: str, value: Any) -> None:
    try:
        read = ModelSpec.from_json(json.dumps(json.loads(ModelSpec().to_json()) | {key: value}))
    except LPNError:
        return
    assert ModelSpec.from_json(read.to_json()) == read
    assert read.describe()


CELLS = st.text(max_size=12) | st.floats().map(str) | st.integers(-200, 200).map(str)


@QUIET
@given(rows=st.lists(st.tuples(CELLS, CELLS, CELLS), max_size=4))
def test_positions_are_on_the_earth_or_refused(rows: list[tuple[str, str, str]]) -> None:
    text = "path,latitude,longitude\n" + "".join(",".join(row) + "\n" for row in rows)
    try:
        found = read_positions(text.encode("utf-8", "replace"))
    except LPNError:
        return
    assert all(abs(place.latitude) <= 90 and abs(place.longitude) <= 180 for place in found.values())
