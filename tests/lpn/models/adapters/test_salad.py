"""SALAD and MegaLoc: their vector beside a reference in double precision, and its account."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.core import images
from lpn.core.errors import ModelFileError
from lpn.models.export import export
from tools.fixtures import seeded
from tools.fixtures.published_models import State, account_error, opened
from tools.fixtures.seeded import relative

WIDTH, HEADS, PATCH, SIDE = 32, 2, 4, 4
HIDDEN, CLUSTERS, NUMBERS, TOKEN, OUT = 24, 5, 6, 7, 16
SIZE = (6 * PATCH, 4 * PATCH)
OPTIONS = f"h: {SIZE[0]}\nw: {SIZE[1]}\nheads: {HEADS}\n"
# The vectors of length 1, (2, D), of `seeded.pictures(40, 2, *SIZE)` and (41, ...), made in double precision by plain torch from
# the equations of DINOv2's and SALAD's own code; commits 05d1c693 and 9a316620 have that code.
VECTORS = seeded.arrays("published/salad")
METHODS = {"SALAD": ("backbone.model.", "aggregator."), "MegaLoc": ("backbone.", "aggregator.agg.")}


def dinov2() -> State:
    """A DINOv2 of two blocks under torch.hub's names, with positions of 4 x 4 patches."""
    shapes: dict[str, list[int]] = {"patch.weight": [WIDTH, 3, PATCH, PATCH], "patch.bias": [WIDTH]}
    shapes |= {"class": [1, 1, WIDTH], "positions": [1, SIDE * SIDE + 1, WIDTH]}
    shapes |= {"norm.weight": [WIDTH], "norm.bias": [WIDTH]}
    for block in "01":
        own = {f"{name}.weight": [WIDTH, WIDTH] for name in ("q", "k", "v", "proj")}
        own |= {f"{name}.{kind}": [WIDTH] for name in ("norm1", "norm2") for kind in ("weight", "bias")}
        own |= {f"{name}.bias": [WIDTH] for name in ("q", "v", "proj", "k")} | {"scale1": [WIDTH], "scale2": [WIDTH]}
        own |= {"fc1.weight": [48, WIDTH], "fc1.bias": [48], "fc2.weight": [WIDTH, 48], "fc2.bias": [WIDTH]}
        shapes |= {f"{block}.{name}": shape for name, shape in own.items()}
    given = seeded.entries(shapes)
    names = {"patch.": "patch_embed.proj.", "class": "cls_token", "positions": "pos_embed"}
    state = {"mask_token": torch.zeros(1, WIDTH)}
    for key, value in given.items():
        block, _, name = key.partition(".")
        if not block.isdigit():
            old = next((one for one in names if key.startswith(one)), "")
            state[key.replace(old, names[old], 1) if old else key] = value
        elif name[:2] not in ("q.", "k.", "v."):
            to = {"proj": "attn.proj", "fc1": "mlp.fc1", "fc2": "mlp.fc2", "scale1": "ls1.gamma", "scale2": "ls2.gamma"}
            layer, dot, kind = name.partition(".")
            state[f"blocks.{block}.{to.get(layer, layer)}{dot}{kind}"] = value
        else:
            kind = name[2:]
            state[f"blocks.{block}.attn.qkv.{kind}"] = torch.cat([given[f"{block}.{one}.{kind}"] for one in "qkv"])
    return state


def checkpoint(method: str) -> State:
    """A checkpoint of five clusters of six numbers; MegaLoc's linear layer gives 16 numbers."""
    trunk, own = METHODS[method]
    shapes: dict[str, list[int]] = {}
    for name, second, out, ones in (
        ("token_features", "2", TOKEN, []),
        ("cluster_features", "3", NUMBERS, [1, 1]),
        ("score", "3", CLUSTERS, [1, 1]),
    ):
        shapes |= {f"{own}{name}.0.weight": [HIDDEN, WIDTH, *ones], f"{own}{name}.0.bias": [HIDDEN]}
        shapes |= {f"{own}{name}.{second}.weight": [out, HIDDEN, *ones], f"{own}{name}.{second}.bias": [out]}
    if method == "MegaLoc":
        shapes |= {"aggregator.linear.weight": [OUT, TOKEN + NUMBERS * CLUSTERS], "aggregator.linear.bias": [OUT]}
    vit = {trunk + key: value for key, value in dinov2().items()}
    return vit | seeded.entries(shapes) | {f"{own}dust_bin": torch.tensor(0.7)}


@pytest.mark.parametrize("method", METHODS)
def test_the_vector_is_that_of_the_equations_and_its_account_adds_up(method: str, tmp_path: Path) -> None:
    model, pictures = opened(checkpoint(method), tmp_path, OPTIONS), seeded.pictures(40, 2, *SIZE)
    contract = model.contract
    assert (contract.method, contract.mirror, contract.resize) == (method, "none", "bilinear")
    assert contract.claim == "exact, with the clusters' shares of each cell, and the lengths of the clusters held"
    assert relative(model.descriptors(pictures, "drone")[:, 0], VECTORS[f"{method}.40"]) < 2e-5
    assert max(account_error(model, picture) for picture in pictures) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_an_export_gives_the_same_vector_and_account(method: str, tmp_path: Path) -> None:
    opened(checkpoint(method), tmp_path, OPTIONS)
    export(tmp_path / "net_119.pth", tmp_path / "model.onnx")
    exported, pictures = lpn.load(tmp_path / "model.onnx"), seeded.pictures(41, 2, *SIZE)
    assert exported.contract.resize == "bilinear"
    assert relative(exported.descriptors(pictures, "drone")[:, 0], VECTORS[f"{method}.41"]) < 2e-5
    assert account_error(exported, pictures[0]) < 1e-5


def test_pictures_need_more_cells_than_there_are_clusters(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match="has 5 clusters, and pictures of 8 x 8 have 4 cells; set h and w"):
        opened(checkpoint("SALAD"), tmp_path, f"h: 8\nw: 8\nheads: {HEADS}\n")


def test_the_resize_is_pillows_with_anti_aliasing() -> None:
    picture = np.zeros((4, 4, 3), np.uint8)
    picture[:, 0] = 240
    # Each new column weighs the three old ones around it by the triangle of twice the width.
    assert images.resize(picture, 2, 2, "bilinear")[0, :, 0].tolist() == [103, 0]
    assert images.resize(picture, 4, 4, "bilinear") is picture
