from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.core.errors import InputError
from lpn.core.images import normalise
from lpn.models.checkpoints import TorchModel, WeightType, load_torch, save
from lpn.models.export import difference, export
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.spec import ModelSpec
from lpn.retrieval import describe_picture
from tools.fixtures import seeded, small_worlds


def close(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(
    "spec",
    [
        ModelSpec(
            "resnet18", "layer3", views=("satellite", "drone"), n_parts=4, activation="leaky_relu", input_size=(64, 64)
        ),
        pytest.param(
            ModelSpec(
                "vgg16_bn", views=("satellite", "street"), shared=False, n_parts=8, layout="cvusa", input_size=(64, 64)
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["leaky", "cvusa"],
)
def test_engine_equals_torch(spec: ModelSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(3)
    save(LPN(spec), tmp_path / "model.safetensors")
    replaced, replace = list[Path](), os.replace
    monkeypatch.setattr(os, "replace", lambda *paths: replaced.append(paths[1]) or replace(*paths))
    files = export(tmp_path / "model.safetensors", tmp_path / "model.onnx")
    assert len(files) == len(spec.groups())
    # A kill between two of them leaves no first file without the others.
    assert replaced[-1] == files[0] == tmp_path / "model.onnx"
    assert_equal(load_torch(tmp_path / "model.safetensors"), Engine(tmp_path / "model.onnx"), spec)


def test_engine_equals_torch_with_linear_heads_and_with_relu(model_file: Path, relu_file: Path) -> None:
    for file in (model_file, relu_file):
        model = load_torch(file.with_suffix(".safetensors"))
        assert_equal(model, Engine(file), model.spec)
        assert 0 < difference(file.with_suffix(".safetensors"), file) < 1e-5


def assert_equal(model: TorchModel, engine: Engine, spec: ModelSpec) -> None:
    """Check that both give the same parts, features, descriptors, and heads."""
    assert (engine.views, engine.n_parts, engine.input_size) == (model.views, model.n_parts, model.input_size)
    for batch in (1, 3):
        pictures = seeded.pictures(batch, batch, *spec.input_size)
        for view in spec.views:
            for found, expected in zip(engine.run(pictures, view)[:2], model.run(pictures, view)[:2], strict=True):
                close(found, expected)
            close(engine.descriptors(pictures, view), model.descriptors(pictures, view))
    for view in spec.views:
        found, expected = engine.heads(view), model.heads(view)
        close(found.weight, expected.weight)
        close(found.bias, expected.bias)
        close(found.cells, expected.cells)


@pytest.mark.parametrize(("storage", "share", "error"), [("float16", 0.5, 5e-3), ("int8", 0.29, 5e-2)])
def test_a_smaller_file_hardly_changes_the_answer(
    storage: WeightType, share: float, error: float, model_file: Path, int8_file: Path, tmp_path: Path
) -> None:
    file = int8_file
    if storage == "float16":
        (file,) = export(model_file.with_suffix(".safetensors"), tmp_path / "small.onnx", storage)
    assert share - 0.02 < file.stat().st_size / model_file.stat().st_size < share + 0.1
    small, whole = Engine(file), Engine(model_file)
    pictures = seeded.pictures(2, 2, *whole.input_size)
    found, expected = small.descriptors(pictures, "drone"), whole.descriptors(pictures, "drone")
    assert found.dtype == np.float32
    assert 0 < np.abs(found - expected).max() < error * np.abs(expected).max()
    # It still explains itself exactly: its heads are those it computes with.
    parts, features, *_ = small.run(pictures, "drone")
    heads = small.heads("drone")
    pooled = np.einsum("phw,bchw->bpc", heads.cells, features)
    close(np.einsum("pdc,bpc->bpd", heads.weight, pooled) + heads.bias, parts)


def test_an_exported_file_names_no_path_of_the_machine_that_made_it(model_file: Path) -> None:
    data = model_file.read_bytes()
    assert str(Path(lpn.__file__).parent).encode() not in data
    assert b"site-packages" not in data
    assert b"stack_trace" not in data


def test_mirrored_and_half_turned_symmetric_pictures_keep_their_descriptor(model_file: Path) -> None:
    engine = lpn.load(model_file)
    picture = small_worlds.place(5)[:64, :64]
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    both = engine.descriptors(np.stack([normalise(picture), normalise(mirrored)]), "drone")
    np.testing.assert_allclose(both[0], both[1], atol=1e-5)
    symmetric = np.concatenate([picture[:32], picture[:32][::-1, ::-1]])
    upright, turned = (describe_picture(engine, symmetric, "drone", angle).descriptor for angle in (0.0, 180.0))
    np.testing.assert_allclose(upright, turned, atol=1e-5)
    upright, turned = (describe_picture(engine, picture, "drone", angle).descriptor for angle in (0.0, 180.0))
    assert np.abs(upright - turned).max() > 1e-3


def test_wrong_input_is_refused_in_words(model_file: Path, tmp_path: Path) -> None:
    engine = lpn.load(model_file)
    good = seeded.pictures(0, 1, 64, 64)
    with pytest.raises(InputError, match="no 'street' view"):
        engine.descriptors(good, "street")
    with pytest.raises(InputError, match="32 x 64"):
        engine.descriptors(good[:, :, :32], "drone")
    with pytest.raises(InputError, match="expected float32"):
        engine.part_embeddings((good * 9).astype(np.uint8), "drone")
    with pytest.raises(InputError, match=r"\.onnx"):
        export(model_file.with_suffix(".safetensors"), tmp_path / "model.bin")
    assert engine.part_embeddings(good[:0], "drone").shape == (0, 4, 512)


@pytest.mark.parametrize("kind", ["float64", "bfloat16", "gradient", "reversed", "tensor"])
def test_pictures_come_as_any_array(model_file: Path, kind: str) -> None:
    plain = seeded.pictures(2, 2, 64, 64)
    given: object = {
        "float64": plain.astype(np.float64),
        "bfloat16": torch.from_numpy(plain).bfloat16(),
        "gradient": torch.from_numpy(plain).requires_grad_(),
        "reversed": plain[..., ::-1][..., ::-1],
        "tensor": torch.from_numpy(plain),
    }[kind]
    for model in (lpn.load(model_file), lpn.load(model_file.with_suffix(".safetensors"))):
        found, expected = model.part_embeddings(given, "drone"), model.part_embeddings(plain, "drone")
        assert np.abs(found - expected).max() <= (0.1 if kind == "bfloat16" else 1e-5) * np.abs(expected).max()
    view = lpn.load(model_file.with_suffix(".safetensors"))
    close(view.descriptors(plain[..., ::-1], "drone"), view.descriptors(plain, "drone"))
