"""An exported model of another method answers on ONNX Runtime as it does in PyTorch, and tells its contract.

In 8 bits it answers nearly so, and its evidence stays exact.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.datasets import open_dataset
from lpn.models import timm_networks
from lpn.models.adapters.methods import sues
from lpn.models.base import Model
from lpn.models.export import export
from lpn.models.quantize import quantize
from lpn.models.trace import Trace
from tools.fixtures import seeded
from tools.fixtures.published_models import (
    State,
    account_error,
    distinct,
    relative_by_part,
    small_denseuav,
    small_fsra,
    small_mccg,
)
from tools.fixtures.seeded import relative


def exported(state: State, options: str, folder: Path, names: list[str]) -> tuple[Model, Model]:
    """Return a model of PyTorch, and the model of its export."""
    torch.save(state, folder / "net_119.pth")
    (folder / "opts.yaml").write_text(options)
    files = export(folder / "net_119.pth", folder / "model.onnx")
    assert [file.name for file in files] == names
    model, again = lpn.load(folder / "net_119.pth", "cpu"), lpn.load(files[0], "cpu")
    assert again.contract == model.contract
    return model, again


def answer_alike(model: Model, again: Model) -> None:
    pictures = seeded.pictures(12, 2, *model.input_size)
    for view in model.views:
        assert again.map_size(view) == model.map_size(view)
        assert relative_by_part(again.descriptors(pictures, view), model.descriptors(pictures, view)) < 2e-5
        if not model.contract.has_cells:
            continue
        found, own = (Trace.from_pass(one, one.run(one.with_mirror(pictures[1]), view), view) for one in (again, model))
        assert found.errors().max() < 1e-5
        np.testing.assert_allclose(found.cells, own.cells, atol=1e-7)
        assert relative(found.constants, own.constants) < 2e-5


@pytest.mark.slow
def test_regions_of_tokens_and_a_street_with_weights_of_its_own(tmp_path: Path) -> None:
    state = distinct(small_fsra(2, 2), "model_2.")
    answer_alike(*exported(state, "views: 3\n", tmp_path, ["model.onnx", "model.street.onnx"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "options"),
    [
        (small_mccg(2), "h: 64\nw: 96\n"),
        (small_mccg(2, resnet=True), "h: 64\nw: 96\n"),
        (small_denseuav(), "head_pool: global\n"),
    ],
    ids=["gates", "resnet", "class token"],
)
def test_a_branch_of_all_views(state: State, options: str, tmp_path: Path) -> None:
    answer_alike(*exported(state, options, tmp_path, ["model.onnx"]))


@pytest.mark.slow
def test_both_passes_of_a_baseline_of_sues_are_one_trunk(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = timm_networks.named_network("test_resnet", (64, 64)).state_dict()
    monkeypatch.setattr(sues, "NETWORKS", {"test_resnet": ("conv1.0.weight", tuple(network["conv1.0.weight"].shape))})
    shapes = {f"model_{branch}.{key}": list(value.shape) for branch in (1, 2) for key, value in network.items()}
    shapes |= {"classifier.add_block.0.weight": [512, 96], "classifier.add_block.0.bias": [512]}
    state = distinct(seeded.entries(shapes), "model_2.")
    model, again = exported(state, "h: 64\nw: 64\n", tmp_path, ["model.onnx", "model.drone.onnx"])
    answer_alike(model, again)
    files, agreement = quantize(tmp_path / "model.onnx", open_dataset(data), tmp_path / "small.onnx", 4)
    assert 0.98 < min(agreement.cosines.values()) < 0.999999
    assert [file.name for file in files] == ["small.onnx", "small.drone.onnx"]
    small, (picture,) = lpn.load(files[0], "cpu"), seeded.pictures(30, 1, 64, 64)
    assert max(account_error(small, picture, view) for view in model.views) < 1e-5
