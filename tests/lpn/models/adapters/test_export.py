"""An exported model of another method answers on ONNX Runtime as it does in PyTorch, and tells its contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.models.base import Model
from lpn.models.export import export
from lpn.models.trace import Trace
from tools.fixtures import seeded
from tools.fixtures.published_models import State, distinct, relative, relative_by_part, small_fsra, small_mccg


def exported(state: State, options: str, folder: Path, names: list[str]) -> tuple[Model, Model]:
    """Return a model of PyTorch, and what is opened from its export."""
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
        found, own = (Trace.from_pass(one, one.run(one.with_mirror(pictures[1]), view), view) for one in (again, model))
        assert found.errors().max() < 1e-5
        np.testing.assert_allclose(found.cells, own.cells, atol=1e-7)
        assert relative(found.constants, own.constants) < 2e-5


@pytest.mark.slow
def test_regions_of_tokens_and_a_street_with_weights_of_its_own(tmp_path: Path) -> None:
    state = distinct(small_fsra(2, 2), "model_2.")
    answer_alike(*exported(state, "views: 3\n", tmp_path, ["model.onnx", "model.street.onnx"]))


@pytest.mark.slow
def test_maps_under_gates(tmp_path: Path) -> None:
    answer_alike(*exported(small_mccg(2), "h: 64\nw: 96\n", tmp_path, ["model.onnx"]))
