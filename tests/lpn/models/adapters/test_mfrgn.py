"""MFRGN: its vector beside that of the released code, its account, and its export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import lpn
from lpn.core.errors import ModelFileError
from lpn.datasets import open_dataset
from lpn.models.export import export
from lpn.models.onnx_engine import open_session
from lpn.models.quantize import quantize
from lpn.models.trace import Trace
from tools.fixtures.published_models import golden
from tools.fixtures.seeded import relative

TOLERANCE = 2e-5


def opened(folder: Path) -> lpn.Model:
    torch.save(golden("mfrgn_small").state, folder / "weights_U1652-D2S.pth")
    return lpn.load(folder / "weights_U1652-D2S.pth", "cpu")


def account_error(model: lpn.Model, pictures: np.ndarray) -> float:
    return float(Trace.from_pass(model, model.run(pictures[:1], "drone"), "drone").errors().max())


def test_the_vector_is_that_of_the_released_code_and_its_account_adds_up(tmp_path: Path) -> None:
    case, model = golden("mfrgn_small"), opened(tmp_path)
    contract = model.contract
    assert (contract.method, contract.mirror, contract.resize) == ("MFRGN", "none", "area")
    assert (contract.n_parts, contract.input_size, model.map_size("drone")) == (1, (96, 96), (6, 6))
    assert contract.claim == "exact, with the gates of each scale held"
    assert relative(model.descriptors(case.pictures, "drone")[:, 0], case.arrays["descriptor"]) < TOLERANCE
    assert account_error(model, case.pictures) < 1e-5
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\n")
    with pytest.raises(ModelFileError, match="says 64 x 64 pixels, and its weights are for 96 x 96"):
        opened(tmp_path)


def test_a_token_is_where_the_map_has_it(tmp_path: Path) -> None:
    model, pictures = opened(tmp_path), golden("mfrgn_small").pictures[:1]
    covered = pictures.copy()
    covered[..., 80:, 80:] = 0
    traces = [Trace.from_pass(model, model.run(one, "drone"), "drone") for one in (pictures, covered)]
    before, after = (trace.features * trace.cells[:, :, None] for trace in traces)
    changed = np.linalg.norm((after - before).reshape(-1, 6, 6), axis=0)
    assert changed.argmax() == 35


@pytest.mark.slow
def test_an_export_gives_the_same_vector_and_account_also_in_8_bits(data: Path, tmp_path: Path) -> None:
    case, model = golden("mfrgn_small"), opened(tmp_path)
    export(tmp_path / "weights_U1652-D2S.pth", tmp_path / "mfrgn.onnx")
    exported = lpn.load(tmp_path / "mfrgn.onnx")
    assert open_session(tmp_path / "mfrgn.onnx").get_inputs()[0].shape[0] == "batch"
    assert exported.contract == model.contract
    assert relative(exported.descriptors(case.pictures, "drone")[:, 0], case.arrays["descriptor"]) < TOLERANCE
    assert account_error(exported, case.pictures) < 1e-5
    (file,), agreement = quantize(tmp_path / "mfrgn.onnx", open_dataset(data), tmp_path / "small.onnx", 4)
    assert 0.98 < min(agreement.cosines.values()) < 0.999999
    assert account_error(lpn.load(file), case.pictures) < 1e-5
    nodes = onnx.load(file).graph.node
    # Each of the four stages has a convolution of its own; the head's stay in float32.
    in_8_bits = {name for node in nodes if node.op_type == "DequantizeLinear" for name in node.output}
    kernels = [node.input[1] for node in nodes if node.op_type == "Conv"]
    assert sum(name in in_8_bits for name in kernels) >= 4
    assert not all(name in in_8_bits for name in kernels)
