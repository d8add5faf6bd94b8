"""Exported models that tests of several rooms share; an export takes seconds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import lpn
from lpn.datasets import open_dataset
from lpn.descriptors import describe, pictures_below
from lpn.models.base import Model
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec
from lpn.tasks.opening import describe_task
from lpn.tasks.task import Task
from tests.conftest import MakeOnce


@pytest.fixture(scope="session")
def model(model_file: Path) -> Model:
    return lpn.load(model_file)


@pytest.fixture
def store(model: Model, data: Path, tmp_path: Path) -> Path:
    """The descriptors of the small data set's drone queries, in a store of a test's own."""
    files = pictures_below(data / "test" / "query_drone")
    describe(model, files, "drone", tmp_path / "store", root=data)
    return tmp_path / "store"


@pytest.fixture(scope="session")
def int8_file(make_once: MakeOnce, model_file: Path) -> Path:
    """The model of `model_file` with weights stored in 8 bits."""
    weights = model_file.with_suffix(".safetensors")
    return make_once("int8", lambda folder: export(weights, folder / "model.onnx", "int8")) / "model.onnx"


@pytest.fixture(scope="session")
def task(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Task:
    """The first task of the small data set under the small model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("cache")))
        return describe_task(lpn.load(model_file), "model.onnx", open_dataset(data))


@pytest.fixture(scope="session")
def relu_file(make_once: MakeOnce) -> Path:
    """An exported LPN whose heads have constants and end in a ReLU; `model.safetensors` lies beside it."""

    def fill(folder: Path) -> None:
        torch.manual_seed(3)
        network = LPN(
            ModelSpec("resnet18", "layer3", views=("satellite", "drone"), activation="relu", input_size=(64, 64))
        )
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm1d):  # untrained norms add nothing
                module.running_mean = 0.3 * torch.randn_like(module.weight)
                module.bias.data = 0.3 * torch.randn_like(module.weight)
        save(network, folder / "model.safetensors")
        export(folder / "model.safetensors", folder / "model.onnx")

    return make_once("relu", fill) / "model.onnx"
