"""An exported model of another method answers on ONNX Runtime as it does in PyTorch, and tells its contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.models.export import export
from lpn.models.trace import Trace
from tools.fixtures import seeded
from tools.fixtures.published_models import (
    State,
    distinct,
    relative,
    small_denseuav,
    small_fsra,
    small_mccg,
)

CASES: dict[str, tuple[State, str]] = {
    "fsra": (small_fsra(2), "h: 256\nw: 256\n"),
    "mccg": (small_mccg(2), "h: 64\nw: 96\n"),
    "denseuav": (small_denseuav(0), "head_pool: avg+max\n"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_an_exported_model_answers_alike(case: str, tmp_path: Path) -> None:
    state, options = CASES[case]
    torch.save(state, tmp_path / "net_119.pth")
    (tmp_path / "opts.yaml").write_text(options)
    (file,) = export(tmp_path / "net_119.pth", tmp_path / "model.onnx")
    model, exported = lpn.load(tmp_path / "net_119.pth", "cpu"), lpn.load(file, "cpu")
    assert exported.contract == model.contract
    assert exported.map_size("drone") == model.map_size("drone")
    pictures = seeded.pictures(12, 3, *model.input_size)
    expected = model.descriptors(pictures, "drone")
    assert relative(exported.descriptors(pictures, "drone"), expected) < 2e-5
    if model.contract.has_cells:
        found, own = (
            Trace.from_pass(one, one.run(one.with_mirror(pictures[1]), "satellite"), "satellite")
            for one in (exported, model)
        )
        assert found.errors().max() < 1e-5
        np.testing.assert_allclose(found.cells, own.cells, atol=1e-7)
        assert relative(found.constants, own.constants) < 2e-5


@pytest.mark.slow
def test_a_street_with_weights_of_its_own_gets_a_file_of_its_own(tmp_path: Path) -> None:
    torch.save(distinct(small_fsra(2, 2), "model_2."), tmp_path / "net_119.pth")
    files = export(tmp_path / "net_119.pth", tmp_path / "model.onnx", storage="float16")
    assert [file.name for file in files] == ["model.onnx", "model.street.onnx"]
    model, exported = lpn.load(tmp_path / "net_119.pth", "cpu"), lpn.load(files[0], "cpu")
    pictures = seeded.pictures(13, 1, 256, 256)
    for view in model.views:
        similarity = (model.descriptors(pictures, view) * exported.descriptors(pictures, view)).sum()
        assert similarity > 0.99
