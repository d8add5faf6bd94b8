"""QDFL: its parts beside a reference in double precision, and the account of each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

import lpn
from lpn.core.errors import ModelFileError
from lpn.models.export import export
from lpn.models.trace import Trace
from tools.fixtures import published_models, published_network, seeded
from tools.fixtures.published_models import State, relative_by_part
from tools.fixtures.published_network import head_shapes
from tools.fixtures.small_vits import HEADS, PATCH, SIDE, SMALL_VITS, WIDTH

INNER, QUERIES, SIZE = 16, 3, 6 * PATCH
TOLERANCE = 2e-5


def checkpoint() -> State:
    """A checkpoint with two blocks of width 32, and three queries of 16 numbers."""
    vit = SMALL_VITS["DINOv2 of torch.hub"]
    shapes: dict[str, list[int]] = {}
    for block in range(2):
        for adapter in ("adapter1", "adapter2"):
            name = f"backbone.model.blocks.{block}.{adapter}"
            shapes |= {f"{name}.D_fc1.weight": [WIDTH // 2, WIDTH], f"{name}.D_fc1.bias": [WIDTH // 2]}
            shapes |= {f"{name}.D_fc2.weight": [WIDTH, WIDTH // 2], f"{name}.D_fc2.bias": [WIDTH]}
    own = "components.AQEU."
    for name in ("coarse.self_attn0", "coarse.self_attn", "coarse.cross_attn", "cross_attn"):
        shapes |= {f"{own}{name}.in_proj_weight": [3 * INNER, INNER], f"{own}{name}.in_proj_bias": [3 * INNER]}
        shapes |= {f"{own}{name}.out_proj.weight": [INNER, INNER], f"{own}{name}.out_proj.bias": [INNER]}
    for name in ("coarse.norm_x", "coarse.norm_q", "coarse.norm_out", "norm_q", "norm_out"):
        shapes |= {f"{own}{name}.weight": [INNER], f"{own}{name}.bias": [INNER]}
    for name in ("FFU.cycle1", "FFU.cycle2"):
        shapes |= {f"{own}{name}.weight": [INNER, INNER, 1, 1], f"{own}{name}.bias": [INNER]}
    linear = {"FFU.reweight.fc1": [5, INNER], "FFU.reweight.fc2": [3 * INNER, 5], "query_remap": [2, QUERIES]}
    shapes |= {f"{own}{name}.weight": shape for name, shape in linear.items()}
    shapes |= {f"{own}{name}.bias": shape[:1] for name, shape in linear.items()}
    shapes |= {f"{own}coarse.queries": [1, QUERIES, INNER]}
    shapes |= {f"{own}fc.weight": [INNER, WIDTH, 1, 1], f"{own}fc.bias": [INNER]}
    for name in ("classifier0", "classifier1", "gem_feature_classifier"):
        shapes |= head_shapes(f"components.{name}", INNER)
    shapes |= head_shapes("components.token_classifier", WIDTH)
    trunk = {f"backbone.model.{key}": value for key, value in vit.rename(vit.tensors()).items()}
    return trunk | seeded.entries(shapes) | {"components.gem_fusion.p": torch.tensor([4.3])}


def adapted(state: State, block: int) -> Any:
    """The adapters of a block: what they add to its attention, and to its hidden layer."""

    def adapter(number: int, values: Tensor) -> Tensor:
        name = f"backbone.model.blocks.{block}.adapter{number}"
        hidden = F.relu(published_models.linear(state, f"{name}.D_fc1", values))
        return published_models.linear(state, f"{name}.D_fc2", hidden)

    return adapter


def trunk(state: State, pictures: Tensor) -> tuple[Tensor, Tensor]:
    """DINOv2 with adapters: the map (B, C, h, w) and the class token (B, C)."""
    vit = SMALL_VITS["DINOv2 of torch.hub"]
    own = {name: value.double() for name, value in vit.tensors().items()}
    patches = F.conv2d(pictures, own["patch.weight"], own["patch.bias"], stride=PATCH)
    grid = patches.shape[2:]
    square = own["positions"][:, 1:].transpose(1, 2).reshape(1, WIDTH, SIDE, SIDE)
    scale = [(side + 0.1) / SIDE for side in grid]  # as DINOv2's code on torch.hub
    positions = F.interpolate(square, scale_factor=scale, mode="bicubic", align_corners=False)
    cells = (patches + positions).flatten(2).transpose(1, 2)
    first = (own["class"] + own["positions"][:, :1]).expand(len(pictures), -1, -1)
    tokens = torch.cat([first, cells], 1)
    for block in range(2):
        adapter = adapted(state, block)
        normed = F.layer_norm(tokens, (WIDTH,), own[f"{block}.norm1.weight"], own[f"{block}.norm1.bias"], 1e-6)
        matrix = torch.cat([own[f"{block}.{name}.weight"] for name in "qkv"])
        bias = torch.cat([own[f"{block}.{name}.bias"] for name in "qkv"])
        out = {"weight": own[f"{block}.proj.weight"], "bias": own[f"{block}.proj.bias"]}
        values = attend(matrix, bias, out, normed, normed, HEADS)
        tokens = tokens + (values + adapter(1, values)) * own[f"{block}.scale1"]
        normed = F.layer_norm(tokens, (WIDTH,), own[f"{block}.norm2.weight"], own[f"{block}.norm2.bias"], 1e-6)
        hidden = F.gelu(F.linear(normed, own[f"{block}.fc1.weight"], own[f"{block}.fc1.bias"]))
        values = F.linear(hidden, own[f"{block}.fc2.weight"], own[f"{block}.fc2.bias"]) + 0.2 * adapter(2, normed)
        tokens = tokens + values * own[f"{block}.scale2"]
    tokens = F.layer_norm(tokens, (WIDTH,), own["norm.weight"], own["norm.bias"], 1e-6)
    return tokens[:, 1:].transpose(1, 2).reshape(len(pictures), WIDTH, *grid), tokens[:, 0]


def attend(matrix: Tensor, bias: Tensor, out: State, queries: Tensor, tokens: Tensor, heads: int) -> Tensor:
    """torch's own attention of several heads, batch first."""
    attention = torch.nn.MultiheadAttention(len(bias) // 3, heads, batch_first=True, dtype=torch.float64)
    attention.load_state_dict(
        {"in_proj_weight": matrix, "in_proj_bias": bias, "out_proj.weight": out["weight"], "out_proj.bias": out["bias"]}
    )
    result: Tensor = attention(queries, tokens, tokens, need_weights=False)[0].detach()
    return result


def one_pass(state: State, pictures: np.ndarray) -> Tensor:
    """The raw parts of one pass, (B, 4, 512)."""
    double = {key: value.double() for key, value in state.items()}
    own = published_models.under(state, "components.AQEU.")

    def norm(name: str, values: Tensor) -> Tensor:
        return F.layer_norm(values, (INNER,), own[f"{name}.weight"], own[f"{name}.bias"])

    def attention(name: str, queries: Tensor, tokens: Tensor) -> Tensor:
        out = {kind: own[f"{name}.out_proj.{kind}"] for kind in ("weight", "bias")}
        return attend(own[f"{name}.in_proj_weight"], own[f"{name}.in_proj_bias"], out, queries, tokens, 8)

    def cycle(name: str, values: Tensor, along: int) -> Tensor:
        seen = torch.zeros_like(values)
        for channel in range(INNER):
            step = (channel + 1) % 3 - 1
            moved = torch.roll(values[:, channel], -step, along - 1)
            if step:
                moved.select(along - 1, -1 if step > 0 else 0).zero_()
            seen[:, channel] = moved
        return F.conv2d(seen, own[f"{name}.weight"], own[f"{name}.bias"])

    features, token = trunk(double, torch.from_numpy(pictures).double())
    side = features.shape[2]
    tokens = F.conv2d(features, own["fc.weight"], own["fc.bias"]).flatten(2).transpose(1, 2)
    coarse = norm("coarse.norm_x", tokens + attention("coarse.self_attn0", tokens, tokens))
    queries = own["coarse.queries"].expand(len(tokens), -1, -1)
    queries = norm("coarse.norm_q", queries + attention("coarse.self_attn", queries, queries))
    queries = norm("norm_q", norm("coarse.norm_out", attention("coarse.cross_attn", queries, coarse)))
    plain = (coarse + tokens).transpose(1, 2).reshape(-1, INNER, side, side)
    rows, columns = cycle("FFU.cycle1", plain, 3), cycle("FFU.cycle2", plain.transpose(2, 3), 2)
    hidden = F.relu(published_models.linear(own, "FFU.reweight.fc1", (rows + columns + plain).mean((2, 3))))
    shares = published_models.linear(own, "FFU.reweight.fc2", hidden).reshape(-1, INNER, 3).softmax(2)[..., None, None]
    fine = rows * shares[:, :, 0] + columns * shares[:, :, 1] + plain * shares[:, :, 2] + plain
    cells = fine.flatten(2).transpose(1, 2)
    queries = norm("norm_out", queries + attention("cross_attn", queries, cells))
    remapped = published_models.linear(own, "query_remap", queries.transpose(1, 2))
    power = double["components.gem_fusion.p"]
    gem = F.normalize(fine.clamp(min=1e-7).pow(power).mean((2, 3)).pow(1 / power))
    pooled = {"classifier0": remapped[..., 0], "classifier1": remapped[..., 1], "token_classifier": token}
    pooled["gem_feature_classifier"] = gem
    return torch.stack([published_network.head(double, f"components.{name}", one) for name, one in pooled.items()], 1)


def opened(folder: Path, height: int, width: int) -> lpn.Model:
    (folder / "opts.yaml").write_text(f"h: {height}\nw: {width}\nheads: {HEADS}\n")
    torch.save({"state_dict": checkpoint(), "epoch": 3, "hyper_parameters": {"lr": 0.03}}, folder / "last.ckpt")
    return lpn.load(folder / "last.ckpt", "cpu")


def account_error(model: lpn.Model, pictures: np.ndarray) -> float:
    return float(Trace.from_pass(model, model.run(pictures[:1], "drone"), "drone").errors().max())


def test_parts_are_those_of_a_reference_and_their_accounts_add_up(tmp_path: Path) -> None:
    state, model = checkpoint(), opened(tmp_path, SIZE, SIZE)
    contract = model.contract
    assert (contract.method, contract.mirror, contract.n_parts) == ("QDFL", "none", 4)
    assert contract.names("street") == ["1 query", "2 query", "3 class token", "4 GeM"]
    assert contract.held == "the attention of the queries, their norms, and the power means and lengths of GeM"
    pictures = seeded.pictures(60, 2, SIZE, SIZE)
    expected = F.normalize(one_pass(state, pictures), dim=2) + one_pass(state, pictures[..., ::-1].copy())
    assert relative_by_part(model.part_embeddings(pictures, "drone"), expected.numpy()) < TOLERANCE
    assert account_error(model, pictures) < 1e-5
    with pytest.raises(ModelFileError, match="says 24 x 28 pixels; QDFL takes squares alone"):
        opened(tmp_path, SIZE, SIZE + PATCH)


@pytest.mark.slow
def test_an_export_gives_the_same_parts_and_account(tmp_path: Path) -> None:
    model, pictures = opened(tmp_path, SIZE, SIZE), seeded.pictures(61, 2, SIZE, SIZE)
    export(tmp_path / "last.ckpt", tmp_path / "qdfl.onnx")
    exported = lpn.load(tmp_path / "qdfl.onnx")
    own = model.part_embeddings(pictures, "drone")
    assert relative_by_part(exported.part_embeddings(pictures, "drone"), own) < TOLERANCE
    assert account_error(exported, pictures) < 1e-5
