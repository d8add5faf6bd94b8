"""Published checkpoints of every kind give what `tests.published` works out from their entries alone."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import lpn
from lpn.export import export
from lpn.spec import ModelSpec
from tests import published, seeded
from tests.published import State

UNIVERSITY_OPTIONS = """\
DA: false
LPN: true
batchsize: 8
block: {n}
color_jitter: false
data_dir: /data/University-Release/train
droprate: 0.75
erasing_p: 0
extra_Google: true
fp16: true
gpu_ids: '0'
h: {size}
lr: 0.001
moving_avg: 1.0
name: three_view_long_share_d0.75_256_s1_google_lr0.001
nclasses: 7
pad: 10
pool: avg
resume: false
share: true
stride: {stride}
train_all: false
use_NAS: false
use_dense: false
views: 3
w: {size}
warm_epoch: 0
"""
CVUSA_OPTIONS = """\
LPN: true
batchsize: 16
block: {n}
data_dir: /data/CVUSA/train
droprate: 0.5
fp16: true
gpu_ids: '3'
h: 256
name: usa_noshare_warm5_8LPN-s-r
nclasses: 7
pool: avg
share: false
stride: {stride}
use_vgg16: {vgg}
views: 2
w: 256
warm_epoch: 5
"""


@cache
def backbone(name: str) -> State:
    return seeded.entries(published.backbone_shapes(name))


@cache
def street_backbone(name: str) -> State:
    """Another network of the same kind: the same numbers, each moved on by one place."""
    return {entry: tensor.roll(1) if tensor.ndim else tensor for entry, tensor in backbone(name).items()}


def state_dict(name: str, views: int, n: int, baseline: bool = False) -> State:
    """A checkpoint; satellite and drone share their weights, as one tensor each, and the street has its own."""
    state = {f"model_1.model.{k}": v for k, v in backbone(name).items()}
    state |= {f"model_2.model.{k}": v for k, v in street_backbone(name).items()}
    if views == 3:
        state |= {f"model_3.model.{k}": v for k, v in backbone(name).items()}
    channels = 2048 if name == "resnet50" else 512
    heads = ["classifier"] if baseline else [f"classifier{i}" for i in range(n)]
    return state | seeded.entries({k: v for head in heads for k, v in published.head_shapes(head, channels).items()})


@cache
def batch(size: int) -> Tensor:
    """A picture and its mirror."""
    picture = torch.from_numpy(seeded.pictures(7, 1, size, size))
    return torch.cat([picture, picture.flip(3)])


@cache
def feature_map(name: str, street: bool, size: int = 256, stride: int = 1) -> Tensor:
    """What the published backbone makes of a picture and its mirror; the heads of all n stand on it."""
    state = {f"model_1.model.{k}": v for k, v in (street_backbone if street else backbone)(name).items()}
    return published.feature_map(state, "model_1", batch(size), stride)


def agree(found: np.ndarray, expected: Tensor) -> None:
    assert found.shape == tuple(expected.shape)
    assert np.abs(found - expected.numpy()).max() <= 1e-4 * float(expected.abs().max())


@pytest.mark.parametrize("case", ["n4", "n1_baseline"])
def test_the_reference_answers_as_the_published_implementation(case: str) -> None:
    golden, state = np.load(seeded.DATA / f"parity_{case}.npz"), seeded.state_dict(case)
    pictures = torch.from_numpy(seeded.pictures(7, 2, 256, 256))
    raw, mirrored = (
        published.embeddings(state, "drone", published.feature_map(state, "model_3", images))
        for images in (pictures, pictures.flip(3))
    )
    # The published arrays are (B, D, n), parts last.
    agree(golden["raw"].reshape(2, 512, -1).transpose(0, 2, 1), raw)
    agree(golden["descriptor"].reshape(2, 512, -1).transpose(0, 2, 1), published.descriptor(raw, mirrored))


@pytest.mark.parametrize(
    ("n", "size", "stride", "view"),
    [
        (1, 256, 1, "drone"),
        (2, 256, 1, "satellite"),
        (4, 256, 1, "street"),
        (6, 256, 1, "drone"),
        (8, 256, 1, "satellite"),
        (10, 256, 1, "drone"),
        (4, 320, 1, "drone"),
        (8, 320, 1, "satellite"),
        (4, 384, 1, "satellite"),
        (6, 512, 1, "drone"),
        (6, 256, 2, "satellite"),
    ],
)
def test_three_view_checkpoints(n: int, size: int, stride: int, view: str, tmp_path: Path) -> None:
    state = state_dict("resnet50", 3, n)
    torch.save(state, tmp_path / "net_119.pth")
    if (size, stride) != (256, 1):
        (tmp_path / "opts.yaml").write_text(UNIVERSITY_OPTIONS.format(n=n, size=size, stride=stride))
    model = lpn.load(tmp_path / "net_119.pth")
    assert (model.views, model.n_parts, model.input_size) == (("satellite", "street", "drone"), n, (size, size))
    expected = published.embeddings(state, view, feature_map("resnet50", view == "street", size, stride))
    agree(model.part_embeddings(batch(size)[:1], view), expected[:1])  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [256, 320, 384, 512])
def test_parts_of_three_view_checkpoints_at_every_size(size: int) -> None:
    """Of a map of random numbers: the backbones, which take longer, know nothing of n."""
    side = size // 16
    features = torch.randn(1, 6, side, side, generator=torch.Generator().manual_seed(size))
    for n in (1, 2, 4, 6, 8, 10):
        cells = torch.from_numpy(ModelSpec(n_parts=n).partition("drone").weights(side, side))
        pooled = torch.einsum("nhw,bchw->bnc", cells, features)
        agree(pooled.numpy(), torch.stack(published.rings(features, n, align_corners=True), 1))


def test_three_view_baseline_and_descriptors(tmp_path: Path) -> None:
    state = {f"module.{k}": v for k, v in state_dict("resnet50", 3, 1, baseline=True).items()}
    torch.save(state, tmp_path / "net_last.pth")
    options = UNIVERSITY_OPTIONS.format(n=6, size=256, stride=1).replace("LPN: true", "LPN: false")
    (tmp_path / "opts.yaml").write_text(options)
    model = lpn.load(tmp_path / "net_last.pth")
    plain = {k.removeprefix("module."): v for k, v in state.items()}
    raw = published.embeddings(plain, "drone", feature_map("resnet50", street=False))
    agree(model.descriptors(batch(256)[:1], "drone"), published.descriptor(raw[:1], raw[1:]))


@pytest.mark.parametrize("n", [4, 8])
def test_three_view_vgg_resizes_its_map_to_the_corners(n: int, tmp_path: Path) -> None:
    state = state_dict("vgg16_bn", 3, n)
    torch.save(state, tmp_path / "net_119.pth")
    raw = published.embeddings(state, "satellite", feature_map("vgg16_bn", street=False))
    agree(lpn.load(tmp_path / "net_119.pth").part_embeddings(batch(256)[:1], "satellite"), raw[:1])


@pytest.mark.parametrize(
    ("name", "n", "stride"),
    [
        ("vgg16_bn", 1, None),
        ("vgg16_bn", 2, 2),
        ("vgg16_bn", 4, 2),
        ("vgg16_bn", 6, None),
        ("vgg16_bn", 8, 2),
        ("resnet50", 2, None),
        ("resnet50", 6, 1),
        ("resnet50", 8, 1),
        ("resnet50", 10, None),
        ("resnet50", 8, 2),
    ],
)
def test_two_view_checkpoints(name: str, n: int, stride: int | None, tmp_path: Path) -> None:
    """Stride 2 is what released VGG-16 runs are given, and make no use of."""
    state = state_dict(name, 2, n, baseline=n == 1)
    if name == "vgg16_bn":
        # torchvision's class layers are large and unused.
        unused = {"weight": torch.zeros(1).expand(4096, 25088), "bias": torch.zeros(4096)}
        state |= {f"model_{i}.model.classifier.0.{k}": v for i in (1, 2) for k, v in unused.items()}
    torch.save(state, tmp_path / "net_119.pth")
    if stride is not None:
        options = CVUSA_OPTIONS.format(n=n, stride=stride, vgg=str(name == "vgg16_bn").lower())
        (tmp_path / "opts.yaml").write_text(options)
    model = lpn.load(tmp_path / "net_119.pth")
    assert (model.views, model.n_parts) == (("satellite", "street"), n)
    for view in model.views:
        raw = published.embeddings(state, view, feature_map(name, view == "street", 256, stride or 1))
        agree(model.part_embeddings(batch(256)[:1], view), raw[:1])


def test_two_view_descriptors_also_when_exported(tmp_path: Path) -> None:
    state = state_dict("vgg16_bn", 2, 8)
    torch.save(state, tmp_path / "net_119.pth")
    (tmp_path / "opts.yaml").write_text(CVUSA_OPTIONS.format(n=8, stride=2, vgg="true"))
    export(tmp_path / "net_119.pth", tmp_path / "lpn.onnx")
    for file in ("net_119.pth", "lpn.onnx"):
        model = lpn.load(tmp_path / file)
        for view in model.views:
            raw = published.embeddings(state, view, feature_map("vgg16_bn", view == "street"))
            agree(model.descriptors(batch(256)[:1], view), published.descriptor(raw[:1], raw[1:]))
