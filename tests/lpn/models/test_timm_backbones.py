"""Networks of timm as the backbone of an LPN: their maps, weights, checkpoints, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models.checkpoints import load_backbone, save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec
from lpn.models.timm_networks import TimmMap, import_timm
from lpn.training.learner import build_optimizer
from lpn.training.recipes import RECIPES
from tools.fixtures import seeded
from tools.fixtures.published_models import account_error
from tools.fixtures.seeded import relative

SPEC = ModelSpec("timm:test_vit", views=("satellite", "drone"), n_parts=2, embedding=8, input_size=(64, 96))


def network(spec: ModelSpec = SPEC) -> LPN:
    torch.manual_seed(3)
    return LPN(spec).eval()


def backbone(made: LPN) -> TimmMap:
    found = made.branch("satellite").model
    assert isinstance(found, TimmMap)
    return found


@torch.inference_mode()
def test_tokens_of_a_vision_transformer_lie_on_the_grid_of_their_patches() -> None:
    made, pictures = network(), seeded.pictures(5, 2, 64, 96)
    own = backbone(made)
    assert (own.channels, own.prefix) == (64, 1)
    tokens = own.network.forward_features(torch.from_numpy(pictures))
    found = made.features(torch.from_numpy(pictures), "drone").numpy()
    assert found.shape == (2, 64, 4, 6)
    # The class token comes first, then the patches row by row.
    expected = np.stack([[tokens[:, 1 + row * 6 + column].numpy() for column in range(6)] for row in range(4)])
    assert relative(found, expected.transpose(2, 3, 0, 1)) < 2e-5


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("convnext_tiny", (768, 3, 4)),
        ("resnet50", (2048, 3, 4)),
        ("vit_small_patch16_224", (384, 6, 8)),
        # Registers are left out, as class tokens are; Swin's channels come last.
        ("vit_base_patch16_rope_reg1_gap_256", (768, 6, 8)),
        pytest.param("swin_tiny_patch4_window7_224", (768, 3, 4), marks=pytest.mark.slow),
    ],
)
def test_maps_have_the_cells_of_the_last_stage(name: str, shape: tuple[int, ...]) -> None:
    with torch.device("meta"):
        made = TimmMap(name, (96, 128)).eval()
        assert made(torch.zeros(2, 3, 96, 128)).shape == (2, *shape)
    assert made.channels == shape[0]


def test_a_name_that_timm_lacks_is_told_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"has no network 'convnext_tinny'; the nearest are convnext_tiny, ") as said:
        network(replace(SPEC, backbone="timm:convnext_tinny"))
    assert "\n" not in str(said.value)
    with pytest.raises(InputError, match="no network 'qqqqqqqq'"):
        network(replace(SPEC, backbone="timm:qqqqqqqq"))
    for wrong in ("timm:", "timm:a b", "timm", "resnet101"):
        with pytest.raises(InputError, match=r"expected one of resnet18, .*vgg16_bn, timm:NAME\."):
            replace(SPEC, backbone=wrong)
        with pytest.raises(InputError, match=f"backbone = {wrong}; expected one of resnet18, .* or timm: and the name"):
            replace(RECIPES["small"], backbone=wrong)


def test_what_has_no_map_or_takes_no_such_pictures_is_refused() -> None:
    with torch.device("meta"):
        with pytest.raises(InputError, match=r"vit_small_patch14_dinov2 takes no pictures of 64 x 96 pixels \("):
            TimmMap("vit_small_patch14_dinov2", (64, 96))
        with pytest.raises(InputError, match="an array of 16 x 384 for a picture of 224 x 224 pixels, which is no map"):
            TimmMap("levit_128s", (224, 224))
    with pytest.raises(InputError, match="pooling = safa with timm:test_vit"):
        replace(RECIPES["safa-released"], backbone="timm:test_vit", backbone_dropout=0.0)


def test_weights_of_timm_fill_it_with_positions_resampled_to_its_size(tmp_path: Path) -> None:
    timm = import_timm()
    torch.manual_seed(7)
    source: nn.Module = timm.create_model("test_vit", pretrained=False, img_size=160)
    torch.save(source.state_dict(), tmp_path / "test_vit.pth")
    made = network()
    entries = len(backbone(made).state_dict())
    assert load_backbone(made, tmp_path / "test_vit.pth") == (entries, entries, [])
    filled, given = backbone(made).state_dict(), source.state_dict()
    for key, value in filled.items():
        if key != "network.pos_embed":
            assert torch.equal(value, given[key.removeprefix("network.")])
    expected: Tensor = timm.layers.resample_abs_pos_embed(given["pos_embed"], new_size=(4, 6), num_prefix_tokens=1)
    torch.testing.assert_close(filled["network.pos_embed"], expected)
    save(made, tmp_path / "whole.safetensors")
    again = network()
    assert load_backbone(again, tmp_path / "whole.safetensors") == (entries, entries, [])
    torch.save({"encoder.weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(ModelFileError, match=r"Nothing in other\.pth fits a timm:test_vit backbone; .* names of timm"):
        load_backbone(again, tmp_path / "other.pth")


def test_its_checkpoint_names_the_network_and_describes_alike(tmp_path: Path) -> None:
    made, pictures = network(), seeded.pictures(6, 1, 64, 96)
    save(made, tmp_path / "last.safetensors")
    torch.save(made.state_dict(), tmp_path / "net.pth")
    (tmp_path / "opts.yaml").write_text("backbone: timm:test_vit\nh: 64\nw: 96\n")
    models = [lpn.load(tmp_path / name, "cpu") for name in ("last.safetensors", "net.pth")]
    assert models[0].describe() == "LPN timm:test_vit, n = 2, 64 x 96"
    assert (models[0].map_size("drone"), models[0].contract.level) == ((4, 6), "exact")
    with torch.inference_mode():
        parts = made.embed(torch.from_numpy(pictures), "drone")[0].numpy()
    for model in models:
        outputs = model.run(pictures, "drone")
        assert relative(outputs.parts, parts) < 1e-6
        assert account_error(model, pictures[0]) < 1e-5


def test_it_learns_at_the_rate_of_the_backbone() -> None:
    made = network()
    groups = build_optimizer(made, replace(RECIPES["paper"], backbone="timm:test_vit")).param_groups
    assert [group["lr"] for group in groups] == pytest.approx([0.001, 0.01])
    assert {id(p) for p in groups[0]["params"]} == {id(p) for p in backbone(made).parameters()}
    assert len(groups[1]["params"]) == 2 * 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["test_vit", "test_convnext"])
def test_it_is_exported_with_the_same_answers(name: str, tmp_path: Path) -> None:
    save(network(replace(SPEC, backbone=f"timm:{name}")), tmp_path / "last.safetensors")
    (file,) = export(tmp_path / "last.safetensors", tmp_path / "model.onnx")
    before, after = lpn.load(tmp_path / "last.safetensors", "cpu"), lpn.load(file, "cpu")
    assert after.contract == before.contract
    pictures = seeded.pictures(7, 3, 64, 96)
    assert relative(after.descriptors(pictures, "drone"), before.descriptors(pictures, "drone")) < 2e-5
