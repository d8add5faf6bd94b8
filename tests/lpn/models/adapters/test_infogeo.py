"""InfoGeo: its vector beside that of the released head over DINOv2's own code, its account, and its export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models.export import export
from lpn.models.onnx_engine import open_session
from lpn.models.trace import Trace
from tools.fixtures.published_models import golden, relative

TOLERANCE = 2e-5


def opened(folder: Path, side: int = 24) -> lpn.Model:
    torch.save(golden("infogeo_small").state, folder / "infogeo.pth")
    (folder / "opts.yaml").write_text(f"h: {side}\nw: {side}\nheads: 4\n")
    return lpn.load(folder / "infogeo.pth", "cpu")


def account_error(model: lpn.Model, pictures: np.ndarray) -> float:
    return float(Trace.from_pass(model, model.run(pictures[:1], "drone"), "drone").errors().max())


def test_the_vector_is_that_of_the_released_head_and_its_account_adds_up(tmp_path: Path) -> None:
    case, model = golden("infogeo_small"), opened(tmp_path)
    contract = model.contract
    assert (contract.method, contract.mirror, contract.resize) == ("InfoGeo", "none", "linear")
    assert (contract.n_parts, contract.embedding, model.map_size("drone")) == (1, 64, (6, 6))
    assert contract.held == "the LayerNorms' means and variances and the open ReLUs of the mixing"
    assert relative(model.descriptors(case.pictures, "drone")[:, 0], case.arrays["descriptor"]) < TOLERANCE
    assert account_error(model, case.pictures) < 1e-5
    with pytest.raises(ModelFileError, match="says 28 x 28 pixels, and its weights are for 24 x 24"):
        opened(tmp_path, 28)
    with pytest.raises(InputError, match=r"infogeo\.pth is a checkpoint of InfoGeo, which has its own parts"):
        lpn.load(tmp_path / "infogeo.pth", "cpu", pooling="mean")


def test_a_lost_token_is_told_and_one_that_serves_training_may_be_missing(tmp_path: Path) -> None:
    own, state = "model.backbone.dino_model.", golden("infogeo_small").state
    pictures = golden("infogeo_small").pictures
    expected = opened(tmp_path).descriptors(pictures, "drone")
    for lost, message in (("view_token", "one of"), ("cls_token", "lacks"), ("blocks.0.ls1.gamma", "lacks")):
        kept = {key: value for key, value in state.items() if key != own + lost}
        torch.save(kept, tmp_path / "infogeo.pth")
        with pytest.raises(ModelFileError, match=rf"{message} model\.backbone\.dino_model\."):
            lpn.load(tmp_path / "infogeo.pth", "cpu")
    # A prefix before all names does not make a plain vision transformer of a method that holds one.
    compiled = {f"_orig_mod.{key}": value for key, value in state.items() if key != own + "mask_token"}
    torch.save({"model": compiled}, tmp_path / "infogeo.pth")
    np.testing.assert_array_equal(lpn.load(tmp_path / "infogeo.pth", "cpu").descriptors(pictures, "drone"), expected)


def test_a_transformer_beside_entries_of_an_unknown_method_is_not_taken_for_a_plain_one(tmp_path: Path) -> None:
    state = {key: value for key, value in golden("infogeo_small").state.items() if "dino_model" in key}
    torch.save(state | {"head.prototypes": torch.zeros(8, 32)}, tmp_path / "unknown.pth")
    with pytest.raises(
        ModelFileError, match=r"under model\.backbone\.dino_model\. and other entries \(head\.prototypes\)"
    ):
        lpn.load(tmp_path / "unknown.pth", "cpu")


@pytest.mark.slow
def test_an_export_gives_the_same_vector_and_account(tmp_path: Path) -> None:
    case = golden("infogeo_small")
    opened(tmp_path)
    export(tmp_path / "infogeo.pth", tmp_path / "infogeo.onnx")
    exported = lpn.load(tmp_path / "infogeo.onnx")
    assert open_session(tmp_path / "infogeo.onnx").get_inputs()[0].shape[0] == "batch"
    assert relative(exported.descriptors(case.pictures, "drone")[:, 0], case.arrays["descriptor"]) < TOLERANCE
    assert account_error(exported, case.pictures) < 1e-5


@pytest.mark.slow
def test_a_smaller_file_has_an_account_that_adds_up(tmp_path: Path) -> None:
    case = golden("infogeo_small")
    opened(tmp_path)
    export(tmp_path / "infogeo.pth", tmp_path / "small.onnx", "int8")
    small = lpn.load(tmp_path / "small.onnx")
    assert 1e-4 < relative(small.descriptors(case.pictures, "drone")[:, 0], case.arrays["descriptor"]) < 0.02
    assert account_error(small, case.pictures) < 1e-5
