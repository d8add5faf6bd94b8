"""Models of one's own: an ONNX file with a contract, an entry point, and the class that docs/contract.md shows."""

from __future__ import annotations

import io
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import lpn
from lpn import explain, retrieval
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError, ModelFileError
from lpn.core.views import View
from lpn.models.base import Model
from lpn.models.contract_metadata import FORMAT, from_metadata, to_metadata
from lpn.models.onnx_engine import Engine
from lpn.models.partition import Partition
from lpn.models.trace import Trace
from tools.fixtures.small_contracts import REGIONS

PAGE = Path(__file__).parents[3] / "docs" / "contract.md"
METADATA = {
    "format": FORMAT, "method": "Colours", "views": "satellite drone", "resize": "linear", "mirror": "sum",
    "held": "the weights of each picture", "parts": "red, green", "mean": "0.5 0.5 0.5", "std": "0.5 0.5 0.5",
}  # fmt: skip


def graph(path: Path, batch: int | str = "batch", change: dict[str, str] | None = None, **kinds: Any) -> Path:
    """Write a graph whose two parts are means of a map of 2 x 2 cells, weighted by a softmax of one colour each.

    Args:
        change: entries of the metadata, empty ones removed.
        kinds: `outputs` to declare, by default all; `cells` "each" or "fixed"; `by_part` for a map for each part; `size` of the
            input to declare.
    """
    cells, by_part = kinds.get("cells", "each"), kinds.get("by_part", False)
    constants = {
        "head_weight": np.arange(2 * 4 * 3).reshape(2, 4, 3) / 10,
        "bias": np.arange(8).reshape(1, 2, 4) / 5,
        "fixed": np.full((2, 2, 2), 0.25),
    }
    sizes = {"to_flat": [0, 3, 4], "to_colours": [0, 2, 4], "to_cells": [0, 2, 2, 2], "first": [0], "two": [2],
             "colour": [1], "last": [3], "part": [1], "to_both": [1, 2, 1, 1, 1]}  # fmt: skip
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Slice", ["pooled", "first", "two", "colour"], ["colours"]),
        helper.make_node("Reshape", ["colours", "to_colours"], ["flat_colours"]),
        helper.make_node("Softmax", ["flat_colours"], ["soft"], axis=2),
        helper.make_node("Reshape", ["soft", "to_cells"], ["soft_cells"]),
        helper.make_node("Reshape", ["pooled", "to_flat"], ["flat"]),
        helper.make_node("Transpose", ["flat"], ["columns"], perm=[0, 2, 1]),
        helper.make_node("MatMul", ["soft" if cells == "each" else "quarter", "columns"], ["means"]),
        helper.make_node("Unsqueeze", ["means", "last"], ["column"]),
        helper.make_node("MatMul", ["head_weight", "column"], ["embedded"]),
        helper.make_node("Squeeze", ["embedded", "last"], ["raw"]),
        helper.make_node("Add", ["raw", "bias"], ["parts"]),
        helper.make_node("Sub", ["parts", "raw"], ["constants"]),
        helper.make_node("Unsqueeze", ["pooled", "part"], ["one_map"]),
        helper.make_node("Expand", ["one_map", "to_both"], ["two_maps"]),
        helper.make_node("Identity", ["two_maps" if by_part else "pooled"], ["features"]),
        helper.make_node("Identity", ["soft_cells" if cells == "each" else "fixed"], ["cells"]),
    ]
    weights = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()]
    weights.append(numpy_helper.from_array(np.full((1, 2, 4), 0.25, np.float32), "quarter"))
    weights += [numpy_helper.from_array(np.array(value), name) for name, value in sizes.items()]
    shapes = {
        "parts": [batch, 2, 4],
        "features": [batch, *([2] if by_part else []), 3, 2, 2],
        "cells": [batch, 2, 2, 2] if cells == "each" else [2, 2, 2],
        "constants": [batch, 2, 4],
        "head_weight": [2, 4, 3],
    }
    wanted = kinds.get("outputs", list(shapes))
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shapes[name]) for name in wanted]
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, *kinds.get("size", (16, 16))])
    proto = helper.make_model(
        helper.make_graph(nodes, "colours", [images], outputs, weights), opset_imports=[helper.make_opsetid("", 17)]
    )
    proto.ir_version = 8
    entries = {key: value for key, value in (METADATA | (change or {})).items() if value}
    helper.set_model_props(proto, entries)
    buffer = io.BytesIO()
    onnx.save_model(proto, buffer)
    path.write_bytes(buffer.getvalue())
    return path


def picture(seed: int = 0) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, (40, 60, 3)).astype(np.uint8)


def trace_of(model: Model, seed: int = 0) -> Trace:
    trace = retrieval.describe_picture(model, picture(seed), "drone").trace
    assert trace is not None
    return trace


@pytest.mark.parametrize("cells", ["each", "fixed"])
@pytest.mark.parametrize("by_part", [False, True])
def test_an_onnx_file_of_another_exporter_has_exact_evidence(cells: str, by_part: bool, tmp_path: Path) -> None:
    model = lpn.load(graph(tmp_path / "colours.onnx", cells=cells, by_part=by_part))
    contract = model.contract
    assert (contract.method, contract.names("drone"), contract.mirror) == ("Colours", ["red", "green"], "sum")
    assert contract.claim == "exact, with the weights of each picture held"
    assert (model.map_size("drone"), model.input_size, contract.title) == ((2, 2), (16, 16), "Colours, n = 2, 16 x 16")
    query, tile = trace_of(model), trace_of(model, 1)
    assert max(*query.errors(), *tile.errors()) < 1e-6
    found = explain.evidence(query, tile)
    np.testing.assert_allclose(found.query.cells.sum(axis=(1, 2)) + found.query.constants, found.cosines, atol=1e-6)
    assert np.abs(query.constants).max() > 0.1


def test_a_graph_of_a_fixed_batch_describes_any_number_of_pictures(tmp_path: Path) -> None:
    free, fixed = Engine(graph(tmp_path / "free.onnx")), Engine(graph(tmp_path / "fixed.onnx", batch=2))
    images = np.stack([free.prepare(picture(seed), "drone") for seed in range(5)])
    assert fixed.batch == 2
    for count in (0, 1, 2, 5):
        np.testing.assert_array_equal(
            fixed.descriptors(images[:count], "drone"), free.descriptors(images[:count], "drone")
        )
    np.testing.assert_array_equal(trace_of(fixed).cells, trace_of(free).cells)


def test_a_graph_of_parts_alone_has_no_trace(tmp_path: Path) -> None:
    parts = lpn.load(graph(tmp_path / "parts.onnx", change={"held": ""}, outputs=["parts"]))
    whole = lpn.load(graph(tmp_path / "whole.onnx"))
    assert parts.contract.level == "parts only"
    described, expected = (retrieval.describe_picture(one, picture(), "drone") for one in (parts, whole))
    assert described.trace is None
    np.testing.assert_array_equal(described.descriptor, expected.descriptor)


@pytest.mark.parametrize("groups", ["satellite, drone", "street, drone", "drone, street"])
def test_groups_have_files_of_their_own_and_roles_choose_among_them(groups: str, tmp_path: Path) -> None:
    other: View = "satellite" if "satellite" in groups else "street"
    change = {"groups": groups, "views": f"{other} drone", "roles": "role", "source": "1"}
    first_view, second_view = groups.split(", ")
    first, second = tmp_path / "both.onnx", tmp_path / f"both.{second_view}.onnx"
    graph(first, change=change | {"group": first_view})
    with pytest.raises(ModelFileError, match=second.name):
        Engine(first)
    graph(second, change=change | {"group": second_view}, cells="fixed")
    with pytest.raises(ModelFileError, match=f"the part of a model for {second_view}; open the file for {first_view}"):
        Engine(second)
    model = Engine(first)
    images = model.prepare(picture(), "drone")[None]
    as_query, as_gallery = model.run(images, "drone").parts, model.run(images, other).parts
    assert not np.allclose(as_query, as_gallery)
    forth, back = model.for_task("drone", other), model.for_task(other, "drone")
    assert forth.fingerprint == model.fingerprint != back.fingerprint
    np.testing.assert_array_equal(forth.run(images, "drone").parts, as_query)
    np.testing.assert_array_equal(back.run(images, "drone").parts, as_gallery)
    np.testing.assert_array_equal(back.run(images, other).parts, as_query)
    graph(second, change=change | {"group": second_view, "mirror": "none"})
    with pytest.raises(ModelFileError, match="exported from another model"):
        Engine(first)


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        ({"change": {"resize": ""}}, "no entry 'resize' in its metadata"),
        ({"change": {"mean": "0.5 0.5"}}, "says mean: 0.5 0.5; expected three numbers"),
        ({"change": {"mean": "1e39 0 0"}}, "contradict each other: The mean .* from -1000 to 1000"),
        ({"change": {"compute": "\x1b[31mint4"}}, r"say compute: [^\x1b]*int4; expected int8"),
        ({"change": {"format": "lpn-explorer-onnx/3"}}, "later version"),
        ({"change": {"format": ""}}, "has no contract in its metadata"),
        ({"size": (10**6, 16)}, "images of batch x 3 x 1000000 x 16; expected at most 4096 pixels on a side"),
        ({"batch": 10**9}, "images of 1000000000 x 3 x 16 x 16; .* and 67108864 in a batch"),
        ({"outputs": ["features", "cells"]}, "takes images and returns parts"),
        ({"outputs": ["parts", "features"]}, "no output cells"),
        ({"outputs": ["parts"]}, "name what is held with"),
    ],
)
def test_metadata_that_are_wrong_or_contradict_the_graph_are_refused(
    kinds: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelFileError, match=message):
        lpn.load(graph(tmp_path / "colours.onnx", **kinds))


def test_a_contract_survives_its_metadata() -> None:
    shapes = {"images": [1, 3, 64, 64], "parts": [1, 4, 5], "features": [1, 6, 8, 8], "cells": [1, 4, 8, 8]}
    shapes["head_weight"] = [4, 5, 6]
    contract = replace(REGIONS, partitions={"drone": Partition("rings", 4, "area")}, polar=("satellite",))
    assert from_metadata(to_metadata(contract), "a.onnx", shapes) == contract


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str, group: str, *points: str) -> None:
    """Put a package `own` with entry points of a group on the path."""
    (folder / "own.py").write_text(code)
    info = folder / "own-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *points]))
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "own", raising=False)


def test_an_entry_point_is_a_model_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = """
from tools.fixtures.small_contracts import RegionModel, REGIONS

def with_weights(path):
    return RegionModel(REGIONS, seed=int(path.read_text()))

def none():
    return None

def broken():
    raise KeyError("weights")
"""
    points = ["regions = own:RegionModel", "seeded = own:with_weights"]
    points += [f"{name} = own:{name}" for name in ("none", "broken", "absent")]
    install(tmp_path, monkeypatch, code, "lpn.models", *points)
    weights = tmp_path / "weights.txt"
    weights.write_text("3")
    plain, seeded = lpn.load("regions"), lpn.load(f"seeded:{weights}")
    assert plain.contract == seeded.contract == REGIONS
    assert plain.fingerprint != seeded.fingerprint
    for name, message in (
        ("none", "returns a NoneType; it must return an lpn.Model"),
        ("broken", r"cannot be opened \(KeyError: 'weights'\); it is registered as own:broken"),
        ("absent", "AttributeError"),
        ("seeded:missing.txt", "There is no file missing.txt for the model seeded"),
    ):
        with pytest.raises(ModelFileError, match=message):
            lpn.load(name)
    with pytest.raises(ModelFileError, match="There is no model file at unheard-of"):
        lpn.load("unheard-of")


def test_the_class_of_the_page_runs_and_its_account_adds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[0]
    body = code[code.index("class") : code.index("if __name__")].strip().splitlines()
    assert len([line for line in body if line]) <= 20
    opened: list[Any] = []
    monkeypatch.setattr(lpn, "explore", lambda *given: opened.extend(given) or Mock())
    exec(compile(code, str(PAGE), "exec"), {"__name__": "__main__"})
    model = opened[0]
    assert trace_of(model).errors().max() < 1e-6
    halves = trace_of(model).cells[0]
    assert (halves > 0).sum(axis=(1, 2)).tolist() == [128, 128]
    assert lpn.Contract is type(model.contract)
    with pytest.raises(InputError, match="no 'street' view"):
        model.heads("street")
