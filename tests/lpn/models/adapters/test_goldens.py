"""Each published model answers as its released code does, and its account of every part adds up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

import lpn
from lpn.core import images
from lpn.models.adapters.methods.mccg import Mccg
from lpn.models.adapters.methods.sdpl import Sdpl
from lpn.models.adapters.network import MeanVector
from lpn.models.adapters.published import PublishedModel
from lpn.models.base import normalise
from lpn.models.trace import Trace
from tools.fixtures import published_models, seeded
from tools.fixtures.published_models import Golden, relative_by_part
from tools.fixtures.seeded import relative

TOLERANCE = 2e-5
CLOSURE = 1e-5


class Case:
    """A golden, the model that was loaded from its checkpoint, and the trunk's outputs of the last forward pass."""

    def __init__(self, name: str, folder: Path, prefix: str = "") -> None:
        self.golden: Golden = published_models.golden(name)
        torch.save({prefix + key: value for key, value in self.golden.state.items()}, folder / "net_119.pth")
        height, width = self.golden.size
        (folder / "opts.yaml").write_text(f"h: {height}\nw: {width}\n")
        self.model = cast(PublishedModel, lpn.load(folder / "net_119.pth", "cpu"))
        self.trunk = Tensor()
        trunk = self.model.network("drone").trunk
        getattr(trunk, "tokens", trunk).register_forward_hook(self._keep)

    def _keep(self, _module: torch.nn.Module, _inputs: object, output: Tensor) -> None:
        self.trunk = output

    def check(self, count: int) -> list[Trace]:
        """Compare raw parts of picture and mirror, and descriptors of the first pictures; return their traces."""
        golden, model = self.golden, self.model
        traces, raw, mirror = [], [], []
        for picture in golden.pictures[:count]:
            outputs = model.run(model.with_mirror(picture), "drone")
            raw.append(outputs.parts[0])
            mirror.append(outputs.parts[-1])
            traces.append(Trace.from_pass(model, outputs, "drone"))
            assert traces[-1].errors().max() < CLOSURE
        assert relative_by_part(np.stack(raw), golden.parts("raw", model.n_parts)[:count]) < TOLERANCE
        if "raw_mirror" in golden.arrays:
            assert relative_by_part(np.stack(mirror), golden.parts("raw_mirror", model.n_parts)[:count]) < TOLERANCE
        found = normalise(np.stack([trace.embedding for trace in traces]))
        assert relative_by_part(found, golden.parts("descriptor", model.n_parts)[:count]) < TOLERANCE
        return traces

    def trunk_agrees(self, name: str, step: int, axis: int) -> None:
        """Compare every `step`-th channel of what the trunk gave for the first picture."""
        found = self.trunk[:1].movedim(axis, 0)[::step].movedim(0, axis)
        assert relative(found.numpy(), self.golden.arrays[name][:1]) < TOLERANCE


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A folder that is emptied at once, as pytest keeps the last three."""
    yield tmp_path
    for file in tmp_path.iterdir():
        file.unlink()


@pytest.mark.slow
def test_fsra(folder: Path) -> None:
    case = Case("fsra_vits_b3", folder)
    assert case.model.contract.claim == "exact, with the regions of each picture held"
    (trace,) = case.check(1)
    regions = np.stack([case.golden.arrays["regions"][0], case.golden.arrays["regions_mirror"][0][:, ::-1]])
    np.testing.assert_array_equal(trace.cells[:, :3].argmax(1), regions)
    assert not trace.cells[:, 3].any()
    case.trunk_agrees("tokens", 32, 2)
    heat = case.trunk[:1, 1:].mean(2).unflatten(1, (16, 16)).numpy()
    assert relative(heat, case.golden.arrays["heat"][:1]) < TOLERANCE


@pytest.mark.slow
def test_mccg(folder: Path) -> None:
    case = Case("mccg_tiny", folder)
    assert case.model.describe() == "MCCG ConvNeXt-T, n = 3, 256 x 256"
    case.check(1)
    case.trunk_agrees("features", 16, 1)
    network, features = cast(Mccg, case.model.network("drone")), case.trunk[:1]
    by_columns, by_rows = (gated / features for gated in network.gated(features))
    assert relative(by_columns.mean(2)[:, ::16].numpy(), case.golden.arrays["gate_cw"]) < TOLERANCE
    assert relative(by_rows.mean(3)[:, ::16].transpose(1, 2).numpy(), case.golden.arrays["gate_hc"]) < TOLERANCE
    whole = network.norm(features.mean((2, 3)))
    assert relative(whole[:, ::4].numpy(), case.golden.arrays["global_feature"][:1]) < TOLERANCE


def test_sample4geo(folder: Path) -> None:
    case = Case("sample4geo_tiny_256", folder, prefix="module.")
    contract = case.model.contract
    assert (contract.resize, contract.mirror, contract.mean) == ("linear", "none", images.MEAN)
    case.check(1)
    case.trunk_agrees("features", 32, 1)


def test_denseuav(folder: Path) -> None:
    case = Case("denseuav_vits_224", folder)
    assert case.model.contract.level == "exact"
    case.check(1)
    case.trunk_agrees("tokens", 16, 2)


@pytest.mark.slow
def test_sdpl(folder: Path) -> None:
    case = Case("sdpl_resnet50_512", folder)
    (trace,) = case.check(1)
    assert trace.features.nbytes + trace.cells.nbytes < 50e6
    found = case.trunk[:1, :64:16].numpy()
    assert relative(found, case.golden.arrays["features_first64"]) < TOLERANCE
    network = cast(Sdpl, case.model.network("drone"))
    weights = network.shift_weights(case.trunk)
    assert relative(weights[:1].numpy(), case.golden.arrays["shift_weights"]) < TOLERANCE
    assert relative(weights[1:].numpy(), case.golden.arrays["shift_weights_mirror"]) < TOLERANCE
    pooled = network.pool(case.trunk[:1], weights[:1]).transpose(1, 2)[:, ::16]
    assert relative(pooled.numpy(), case.golden.arrays["pooled"]) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample4geo_base_384", "dac_base_384"])
def test_convnext_base(name: str, folder: Path) -> None:
    case = Case(name, folder)
    assert "ConvNeXt-B, 384 x 384" in case.model.describe()
    case.check(1)
    case.trunk_agrees("features", 32, 1)


@pytest.mark.slow
def test_game4loc(folder: Path) -> None:
    case = Case("game4loc_vitb_384", folder)
    assert case.model.contract.mean == case.model.contract.std == (0.5, 0.5, 0.5)
    case.check(1)
    tokens = case.trunk.flatten(2).transpose(1, 2)[:, :, :64:16].numpy()
    # The register token comes first in the released code, and is no cell.
    assert relative(tokens, case.golden.arrays["tokens_first64"][:, 1:]) < TOLERANCE
    pooled = case.trunk.mean((2, 3)).numpy()
    assert relative(pooled, case.golden.arrays["pooled"]) < TOLERANCE
    assert isinstance(case.model.network("drone"), MeanVector)


@pytest.mark.parametrize("case", range(4))
def test_resizes_are_those_of_the_released_code_bit_for_bit(case: int) -> None:
    with np.load(seeded.DATA / "published" / "preprocess.npz") as file:
        linear, bicubic = file[f"cv2_linear_exact_{case}"], file[f"pillow_bicubic_{case}"]
    size = ((64, 64), (64, 64), (37, 53), (30, 40))[case]
    picture = np.random.default_rng(7 + case).integers(0, 256, (*size, 3), np.uint8)
    np.testing.assert_array_equal(images.resize(picture, *linear.shape[:2], "linear"), linear)
    np.testing.assert_array_equal(images.resize(picture, *bicubic.shape[:2]), bicubic)
