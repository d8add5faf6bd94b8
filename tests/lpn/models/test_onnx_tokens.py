"""ONNX files that return tokens, pooled by name, and ONNX Runtime's refusals in plain words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models.export import export
from lpn.models.onnx_engine import open_session
from lpn.models.trace import Trace
from tests.lpn.models.adapters.test_token_pooling import POOLINGS, pooled
from tools.fixtures import seeded

PATCH, CHANNELS, SIZE = 8, 6, (32, 24)
GRID = (SIZE[0] // PATCH, SIZE[1] // PATCH)


def token_file(file: Path, size: tuple[Any, Any] = SIZE, front: int = 1, opset: int = 17, **further: int) -> Path:
    """Write a graph that returns the patches of pictures as tokens behind `front` copies of the first two, doubled."""
    weight = np.random.default_rng(5).standard_normal((CHANNELS, 3, PATCH, PATCH)).astype(np.float32) / 14
    constants = {"w": weight, "shape": np.array([0, CHANNELS, -1])}
    constants |= {"b": np.array([0]), "e": np.array([front]), "a": np.array([1])}
    nodes = [
        helper.make_node("Conv", ["pixel_values", "w"], ["map"], kernel_shape=[PATCH] * 2, strides=[PATCH] * 2),
        helper.make_node("Reshape", ["map", "shape"], ["flat"]),
        helper.make_node("Transpose", ["flat"], ["cells"], perm=[0, 2, 1]),
        helper.make_node("Slice", ["cells", "b", "e", "a"], ["first"]),
        helper.make_node("Add", ["first", "first"], ["front"]),
        helper.make_node("Concat", ["front", "cells"], ["last_hidden_state"], axis=1),
    ]
    outputs = [helper.make_tensor_value_info("last_hidden_state", TensorProto.FLOAT, ["batch", None, CHANNELS])]
    pictures = helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, ["batch", 3, *size])
    given = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "tokens", [pictures], outputs, given)
    opsets = [helper.make_opsetid("", opset)]
    onnx.save_model(helper.make_model(graph, opset_imports=opsets, ir_version=further.get("ir", 8)), file)
    return file


def tokens_of(pictures: np.ndarray, front: int = 1) -> np.ndarray:
    weight = np.random.default_rng(5).standard_normal((CHANNELS, 3, PATCH, PATCH)).astype(np.float32) / 14
    patches = pictures.reshape(len(pictures), 3, GRID[0], PATCH, GRID[1], PATCH)
    cells = np.einsum("bchiwj,dcij->bhwd", patches, weight).reshape(len(pictures), -1, CHANNELS)
    return np.concatenate([2 * cells[:, :front], cells], 1)


@pytest.mark.parametrize("front", [1, 2])
def test_tokens_are_pooled_and_the_account_adds_up(front: int, tmp_path: Path) -> None:
    file, pictures = token_file(tmp_path / "tokens.onnx", front=front), seeded.pictures(50, 2, *SIZE)
    tokens = tokens_of(pictures, front)
    for pooling in POOLINGS:
        model, parts = lpn.load(file, pooling=pooling), pooled(pooling, tokens[:, front:], tokens[:, 0], GRID)
        for one in (model, model.for_parallel_inference()):
            assert np.abs(one.part_embeddings(pictures, "drone") - parts).max() < 2e-6
        if pooling == "cls":
            assert (model.contract.claim, model.map_size("drone")) == ("one vector", (1, 1))
            continue
        assert model.contract.level == ("exact" if pooling in ("mean", "rings:2") else "exact, with held")
        trace = Trace.from_pass(model, model.run(pictures[:1], "drone"), "drone")
        assert trace.size == model.map_size("drone") == GRID
        assert trace.errors().max() < 1e-5
    assert len({lpn.load(file, pooling=pooling).fingerprint for pooling in POOLINGS}) == len(POOLINGS)


@pytest.mark.parametrize(
    ("size", "options", "told"), [(("h", "w"), "", True), (("h", "w"), "h: 32\nw: 24\n", False), (SIZE, "", False)]
)
def test_the_size_is_the_graphs_else_that_of_the_options_else_assumed_and_said(
    size: tuple[Any, Any], options: str, told: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = token_file(tmp_path / "tokens.onnx", size)
    if options:
        (tmp_path / "opts.yaml").write_text(options)
    model = lpn.load(file, pooling="mean")
    assert model.input_size == ((224, 224) if told else SIZE)
    assert ("so 224 x 224 pixels are assumed" in caplog.text) == told


def test_what_does_not_fit_is_one_sentence(tmp_path: Path, model_file: Path) -> None:
    file = token_file(tmp_path / "tokens.onnx")
    with pytest.raises(ModelFileError, match="name the pooling of the tokens that it returns with --pooling"):
        lpn.load(file)
    with pytest.raises(InputError, match="says which parts it has; leave --pooling out"):
        lpn.load(model_file, pooling="mean")
    with pytest.raises(InputError, match="has no class token for the pooling cls"):
        lpn.load(token_file(tmp_path / "bare.onnx", front=0), pooling="cls")
    with pytest.raises(ModelFileError, match=r"last_hidden_state .* whose number fits a map of the picture's 36 x 24"):
        lpn.load(token_file(tmp_path / "odd.onnx", size=(36, 24)), pooling="mean")
    with pytest.raises(InputError, match="is exported already"):
        export(file, tmp_path / "out.onnx")


@pytest.mark.parametrize("newer", [{"ir": 99}, {"opset": 99}])
def test_a_file_that_is_newer_than_the_runtime_is_named_as_that(newer: dict[str, int], tmp_path: Path) -> None:
    file = token_file(tmp_path / "newer.onnx", **newer)
    with pytest.raises(
        ModelFileError, match=r"written for a newer ONNX Runtime than the installed .*99.*; upgrade"
    ) as caught:
        open_session(file)
    assert "\n" not in str(caught.value)


def test_weights_in_a_file_beside_open_and_are_named_where_they_are_missing(tmp_path: Path) -> None:
    whole, apart = token_file(tmp_path / "whole.onnx"), tmp_path / "apart" / "model.onnx"
    apart.parent.mkdir()
    options = {"save_as_external_data": True, "location": "model.onnx.data"}
    onnx.save_model(onnx.load_model(whole), apart, **options)
    pictures = seeded.pictures(54, 1, *SIZE)
    found, expected = (lpn.load(file, pooling="mean").part_embeddings(pictures, "drone") for file in (apart, whole))
    np.testing.assert_array_equal(found, expected)
    weights, before = apart.parent / "model.onnx.data", lpn.load(apart, pooling="mean").fingerprint
    weights.write_bytes(bytes(weights.stat().st_size))
    assert lpn.load(apart, pooling="mean").fingerprint != before
    weights.unlink()
    with pytest.raises(ModelFileError, match=r"takes weights from model\.onnx\.data, which is missing; copy that file"):
        lpn.load(apart, pooling="mean")
