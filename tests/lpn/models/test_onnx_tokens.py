"""ONNX files that return tokens, pooled by name: opened, exported, quantized, and refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.datasets import open_dataset
from lpn.models.export import export
from lpn.models.onnx_tokens import pooled_file
from lpn.models.partition import Partition
from lpn.models.quantize import quantize
from lpn.models.token_pooling import TokenPooling
from lpn.models.trace import Trace
from tools.fixtures import seeded, small_worlds

PATCH, CHANNELS, SIZE = 8, 6, (32, 24)
GRID = (SIZE[0] // PATCH, SIZE[1] // PATCH)


def token_file(file: Path, size: tuple[Any, Any] = SIZE, front: int = 1, opset: int = 17, **properties: str) -> Path:
    """Write a graph that returns the patches of pictures as tokens behind `front` copies of the first two, doubled."""
    weight = np.random.default_rng(5).standard_normal((CHANNELS, 3, PATCH, PATCH)).astype(np.float32) / 14
    constants = {
        "w": weight,
        "shape": np.array([0, CHANNELS, -1]),
        "b": np.array([0]),
        "e": np.array([front]),
        "a": np.array([1]),
    }
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
    proto = helper.make_model(
        helper.make_graph(nodes, "tokens", [pictures], outputs, given),
        opset_imports=[helper.make_opsetid("", opset)],
        ir_version=8,
    )
    helper.set_model_props(proto, properties)
    onnx.save_model(proto, file)
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
    cells, first = tokens[:, front:], tokens[:, 0]
    rings = Partition("rings", 3).weights(*GRID).reshape(3, -1)
    expected = {
        "mean": cells.mean(1, keepdims=True),
        "gem": (np.maximum(cells, 1e-6) ** 3).mean(1, keepdims=True) ** (1 / 3),
        "cls": first[:, None],
        "cls+mean": np.concatenate([first, cells.mean(1)], 1)[:, None],
        "rings:3": np.einsum("nx,bxc->bnc", rings, cells),
    }
    for pooling, parts in expected.items():
        model = lpn.load(file, pooling=pooling)
        assert np.abs(model.part_embeddings(pictures, "drone") - parts).max() < 2e-6
        if pooling == "cls":
            assert model.contract.claim == "one vector"
            continue
        assert model.contract.level == ("exact" if pooling in ("mean", "rings:3") else "exact, with held")
        trace = Trace.from_pass(model, model.run(pictures[:1], "drone"), "drone")
        assert trace.size == GRID
        assert trace.errors().max() < 1e-5


def test_an_export_and_its_eight_bits_keep_the_account(tmp_path: Path) -> None:
    export(token_file(tmp_path / "tokens.onnx"), tmp_path / "rings.onnx", pooling="rings:2")
    dataset = open_dataset(small_worlds.make_dataset(tmp_path / "places", train=2, test=2))
    quantize(tmp_path / "rings.onnx", dataset, tmp_path / "int8.onnx", pictures=6)
    for name in ("rings.onnx", "int8.onnx"):
        model = lpn.load(tmp_path / name)
        assert model.contract.title == "tokens, rings:2, 32 x 24"
        trace = Trace.from_pass(model, model.run(seeded.pictures(51, 1, *SIZE), "drone"), "drone")
        assert trace.errors().max() < 1e-5
    assert model.precision == "int8"


def test_an_export_in_fewer_bits_keeps_the_account(tmp_path: Path) -> None:
    file, pictures = token_file(tmp_path / "tokens.onnx"), seeded.pictures(53, 1, *SIZE)
    expected = lpn.load(file, pooling="rings:2").part_embeddings(pictures, "drone")
    for storage in ("float16", "int8"):
        export(file, tmp_path / "small.onnx", storage, pooling="rings:2")
        model = lpn.load(tmp_path / "small.onnx")
        assert 0 < np.abs(model.part_embeddings(pictures, "drone") - expected).max() < 2e-2
        assert Trace.from_pass(model, model.run(pictures, "drone"), "drone").errors().max() < 1e-5


def test_the_cache_keeps_the_pooled_copies_that_were_used_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    file = token_file(tmp_path / "tokens.onnx")
    copies = [pooled_file(file, TokenPooling("gem", power)) for power in range(2, 10)]
    for used, copy in enumerate(copies):
        os.utime(copy, (used, used))
    assert pooled_file(file, TokenPooling("gem", 2)) == copies[0]
    added = pooled_file(file, TokenPooling("gem", 10))
    assert set(copies[0].parent.iterdir()) == {*copies, added} - {copies[1]}


def test_a_pooled_copy_that_another_process_removes_is_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    file, utime = token_file(tmp_path / "tokens.onnx"), os.utime
    copy = pooled_file(file, TokenPooling("mean"))
    graph = copy.read_bytes()

    def removed(path: Path, times: None = None) -> None:
        Path(path).unlink()
        utime(path, times)

    monkeypatch.setattr(os, "utime", removed)
    assert pooled_file(file, TokenPooling("mean")).read_bytes() == graph


def test_a_cache_that_cannot_be_written_still_gives_its_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    file = token_file(tmp_path / "tokens.onnx")
    copy = pooled_file(file, TokenPooling("mean"))

    def refused(*_: object, **__: object) -> None:
        raise PermissionError

    for function in ("utime", "open"):
        monkeypatch.setattr(os, function, refused)
    assert pooled_file(file, TokenPooling("mean")) == copy


def test_a_graph_of_any_size_takes_that_of_the_options(tmp_path: Path) -> None:
    file = token_file(tmp_path / "tokens.onnx", size=("height", "width"))
    assert lpn.load(file, pooling="mean").input_size == (224, 224)
    (tmp_path / "opts.yaml").write_text("h: 32\nw: 24\n")
    model, pictures = lpn.load(file, pooling="mean"), seeded.pictures(52, 1, *SIZE)
    assert np.abs(model.part_embeddings(pictures, "drone")[0, 0] - tokens_of(pictures)[0, 1:].mean(0)).max() < 2e-6


def test_what_does_not_fit_is_one_sentence(tmp_path: Path, model_file: Path) -> None:
    file = token_file(tmp_path / "tokens.onnx")
    with pytest.raises(ModelFileError, match="name the pooling of the tokens that it returns with --pooling"):
        lpn.load(file)
    with pytest.raises(InputError, match="says which parts it has; leave --pooling out"):
        lpn.load(model_file, pooling="mean")
    with pytest.raises(InputError, match="has no class token for the pooling cls"):
        lpn.load(token_file(tmp_path / "bare.onnx", front=0), pooling="cls")
    with pytest.raises(ModelFileError, match=r"opset 11; export it again with opset 13"):
        lpn.load(token_file(tmp_path / "old.onnx", opset=11), pooling="mean")
    with pytest.raises(
        ModelFileError, match=r"returns last_hidden_state .* whose number fits a map of the picture's 36 x 24"
    ):
        lpn.load(token_file(tmp_path / "odd.onnx", size=(36, 24)), pooling="mean")
    with pytest.raises(InputError, match="is exported already"):
        export(file, tmp_path / "out.onnx")
    with pytest.raises(InputError, match=r"tokens\.onnx is the model itself"):
        export(file, file, pooling="mean")


@pytest.mark.parametrize(
    ("size", "options", "told"), [(("h", "w"), "", True), (("h", "w"), "h: 32\nw: 24\n", False), (SIZE, "", False)]
)
def test_a_size_that_is_assumed_is_said(
    size: tuple[Any, Any], options: str, told: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = token_file(tmp_path / "tokens.onnx", size)
    if options:
        (tmp_path / "opts.yaml").write_text(options)
    model = lpn.load(file, pooling="mean")
    assert model.input_size == ((224, 224) if told else SIZE)
    assert ("so 224 x 224 pixels are assumed" in caplog.text) == told
