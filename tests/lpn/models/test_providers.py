"""The choice of a network's provider. There is no GPU here: ONNX Runtime's list of providers is a stub, its CPU is real."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch

import lpn
from lpn.cli import main
from lpn.core.errors import InputError
from lpn.datasets import open_dataset
from lpn.models import providers
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.quantize import quantize
from lpn.models.spec import ModelSpec
from tests.conftest import Refused
from tools.fixtures import seeded

CUDA, TENSORRT, CPU = "CUDAExecutionProvider", "TensorrtExecutionProvider", "CPUExecutionProvider"
PICTURES = seeded.pictures(3, 2, 64, 64)


@pytest.fixture(autouse=True)
def _no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CPU])
    monkeypatch.delenv("LPN_PROVIDER", raising=False)


class FakeGpu:
    """Stands for a GPU: sessions compute on the CPU, and say that they have the provider that was asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, broken: tuple[str, ...] = ()) -> None:
        self.asked: list[tuple[Path, ort.SessionOptions, dict[str, dict[str, str]]]] = []
        self.computed: list[int] = []
        self.broken = broken
        monkeypatch.setattr(ort, "get_available_providers", lambda: [TENSORRT, CUDA, CPU])
        monkeypatch.setattr(providers, "_create", self.create)

    def create(self, path: Path, options: ort.SessionOptions, wanted: list[tuple[str, Any]]) -> FakeSession:
        self.asked.append((path, options, dict(wanted)))
        started = [name for name, _ in wanted if name not in self.broken]
        return FakeSession(ort.InferenceSession(str(path), providers=[CPU]), started, self.computed)


class FakeSession:
    def __init__(self, real: ort.InferenceSession, started: list[str], computed: list[int]) -> None:
        self.real, self.started, self.computed = real, started, computed

    def get_providers(self) -> list[str]:
        return self.started

    def run(self, names: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        self.computed.append(len(inputs["images"]))
        if len(inputs["images"]) > providers.GPU_BATCH:
            raise RuntimeError("out of memory\nand a stack of C++")
        return self.real.run(names, inputs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)


@pytest.mark.parametrize(("wanted", "name"), [("cuda", CUDA), ("tensorrt", TENSORRT), ("gpu", "gpu")])
def test_a_provider_that_is_not_built_in_is_one_sentence(model_file: Path, wanted: str, name: str) -> None:
    with pytest.raises(InputError, match=f"has no {name}, but {CPU}; install .*onnxruntime-gpu") as caught:
        lpn.load(model_file, wanted)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith("or compute on the CPU (--provider cpu, or LPN_PROVIDER=cpu).")


def test_auto_takes_cuda_and_says_so(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Engine(model_file).descriptors(PICTURES, "drone")
    gpu = FakeGpu(monkeypatch)
    model = lpn.load(model_file)
    ((path, options, asked),) = gpu.asked
    assert path == model_file
    assert list(asked) == [CUDA, CPU]
    assert asked[CUDA]["use_tf32"] == "0"
    assert asked[CUDA]["arena_extend_strategy"] == "kSameAsRequested"
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)
    assert gpu.computed == [1]  # it was tried
    assert (model.device, model.batch, model.parallel) == ("cuda", providers.GPU_BATCH, False)
    assert model.for_parallel_inference() is model
    assert model.describe().endswith(", on cuda")
    np.testing.assert_array_equal(model.descriptors(PICTURES, "drone"), expected)
    assert gpu.computed == [1, 2, 2]


@pytest.mark.parametrize("name", ["tensorrt", "TensorRT", TENSORRT])
def test_another_provider_is_taken_by_its_name_only(
    model_file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    gpu = FakeGpu(monkeypatch)
    model = lpn.load(model_file, name)
    ((_, _, asked),) = gpu.asked
    assert asked == {TENSORRT: {}, CPU: {}}
    assert (model.device, model.parallel) == ("tensorrt", False)
    assert lpn.load(model_file, CPU).device == "cpu"
    assert len(gpu.asked) == 1


def test_a_variable_takes_the_place_of_auto(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    safetensors = model_file.with_suffix(".safetensors")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv("LPN_PROVIDER", "cuda")
    for file, reason in ((model_file, f"has no {CUDA}"), (safetensors, "finds no GPU")):
        with pytest.raises(InputError, match=reason):
            lpn.load(file)
        assert lpn.load(file, "cpu").device == "cpu"
    gpu = FakeGpu(monkeypatch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv("LPN_PROVIDER", "cpu")
    assert [lpn.load(file).device for file in (model_file, safetensors)] == ["cpu", "cpu"]
    assert not gpu.asked
    assert lpn.load(model_file, "cuda").device == "cuda"
    monkeypatch.setenv("LPN_PROVIDER", "gpu")
    for file, reason in (
        (model_file, "has no gpu, but "),
        (safetensors, "on cpu or cuda only, not on 'gpu'; .* LPN_PROVIDER"),
    ):
        with pytest.raises(InputError, match=reason):
            lpn.load(file)


def test_cuda_without_its_libraries_is_the_cpu_with_auto_and_an_error_by_name(
    model_file: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    FakeGpu(monkeypatch, broken=(CUDA, TENSORRT))
    with caplog.at_level(logging.WARNING):
        model = lpn.load(model_file)
    assert model.device == "cpu"
    (record,) = caplog.records
    assert f"{model_file.name} computes on the CPU: {CUDA} of ONNX Runtime" in record.getMessage()
    with pytest.raises(InputError, match=r"was not started.*libraries of CUDA and cuDNN, or compute on the CPU"):
        lpn.load(model_file, "cuda")


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_onnx_runtime_s_own_refusal_is_one_sentence(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A list that names CUDA, on an ONNX Runtime that cannot start it: here, one that was built without it."""
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CUDA, CPU])
    with pytest.raises(InputError, match=f"{CUDA} of ONNX Runtime .* does not work here") as caught:
        Engine(model_file, provider="cuda")
    assert "\n" not in str(caught.value)
    assert Engine(model_file, provider="auto").device == "cpu"


def test_a_gpu_that_fails_later_is_no_damaged_file(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeGpu(monkeypatch)
    model = lpn.load(model_file)
    with pytest.raises(InputError, match=r"cannot be computed on cuda \(out of memory\); compute on the CPU \("):
        model.run(seeded.pictures(0, providers.GPU_BATCH + 1, 64, 64), "drone")


@pytest.mark.slow
def test_each_group_of_views_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ModelSpec("resnet18", "layer3", views=("satellite", "street"), shared=False, n_parts=2, input_size=(64, 64))
    save(LPN(spec), tmp_path / "model.safetensors")
    files = export(tmp_path / "model.safetensors", tmp_path / "model.onnx")
    expected = Engine(files[0]).descriptors(PICTURES, "street")
    gpu = FakeGpu(monkeypatch)
    model = Engine(files[0], provider="cuda")
    assert [path for path, _, _ in gpu.asked] == files
    np.testing.assert_array_equal(model.descriptors(PICTURES, "street"), expected)
    assert gpu.computed == [1, 1, 2, 2]


def test_a_model_in_8_bits_stays_on_the_cpu_unless_a_provider_is_named(
    model_file: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (written,), _ = quantize(model_file, open_dataset(data), tmp_path / "int8.onnx", 4)
    FakeGpu(monkeypatch)
    assert Engine(written, provider="auto").device == "cpu"
    assert Engine(written, provider="cuda").device == "cuda"


def test_the_commands_pass_the_option_on(
    model_file: Path,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    refused: Refused,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pictures, out = data / "test" / "gallery_satellite", tmp_path / "store"
    describe = f"describe --model {model_file} --images {pictures} --view satellite --out {out} --provider".split()
    evaluate = ["evaluate", "--model", model_file, data, "--provider"]
    explore = ["explore", "--model", model_file, data, "--port", "0", "--provider"]
    for command in (describe, evaluate, explore):
        assert f"has no {CUDA}" in refused(*command, "cuda")
    assert not (tmp_path / "store").exists()
    FakeGpu(monkeypatch)
    assert main.main([*describe, "auto"]) == 0
    assert "Computed on cuda." in capsys.readouterr().out
