"""Each published model answers as its released code does, and its account of every part adds up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core import images
from lpn.models.base import normalise
from lpn.models.trace import Trace
from tools.fixtures import published_models, seeded
from tools.fixtures.published_models import opened, relative_by_part

# The title of each published model, and how its pictures are resized, which its golden pictures are not.
MODELS = {
    "sample4geo_tiny_256": ("Sample4Geo ConvNeXt-T, 256 x 256", "linear"),
    "denseuav_vits_224": ("DenseUAV ViT-S, n = 1, 224 x 224", "bicubic"),
    "fsra_vits_b3": ("FSRA ViT-S, n = 4, 256 x 256", "bicubic"),
    "mccg_tiny": ("MCCG ConvNeXt-T, n = 3, 256 x 256", "bicubic"),
    "sdpl_resnet50_512": ("SDPL ResNet-50, n = 10, 512 x 512", "bicubic"),
    "sample4geo_base_384": ("Sample4Geo ConvNeXt-B, 384 x 384", "linear"),
    "dac_base_384": ("DAC ConvNeXt-B, 384 x 384", "linear"),
    "game4loc_vitb_384": ("Game4Loc vit_base_patch16_rope_reg1_gap_256, 384 x 384", "linear"),
}
QUICK = ("sample4geo_tiny_256", "denseuav_vits_224")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in MODELS]
)
def test_a_model_answers_as_its_released_code_and_its_account_adds_up(name: str, tmp_path: Path) -> None:
    golden = published_models.golden(name)
    height, width = golden.size
    model = opened(golden.state, tmp_path, f"h: {height}\nw: {width}\n")
    (tmp_path / "net_119.pth").unlink()  # of several hundred megabytes
    assert (model.describe(), model.contract.resize) == MODELS[name]
    assert model.contract.mean == ((0.5,) * 3 if name.startswith("game4loc") else images.MEAN)
    outputs = model.run(model.with_mirror(golden.pictures[0]), "drone")
    trace = Trace.from_pass(model, outputs, "drone")
    assert trace.errors().max() < 1e-5
    found = {"raw": outputs.parts[:1], "raw_mirror": outputs.parts[-1:], "descriptor": normalise(trace.embedding[None])}
    for kind, parts in found.items():
        if kind in golden.arrays:
            assert relative_by_part(parts, golden.parts(kind, model.n_parts)[:1]) < 2e-5
    if "regions" in golden.arrays:
        regions = np.stack([golden.arrays["regions"][0], golden.arrays["regions_mirror"][0][:, ::-1]])
        np.testing.assert_array_equal(trace.cells[:, :3].argmax(1), regions)
        assert not trace.cells[:, 3].any()


@pytest.mark.parametrize("case", range(4))
def test_resizes_are_those_of_the_released_code_bit_for_bit(case: int) -> None:
    with np.load(seeded.DATA / "published" / "preprocess.npz") as file:
        linear, bicubic = file[f"cv2_linear_exact_{case}"], file[f"pillow_bicubic_{case}"]
    size = ((64, 64), (64, 64), (37, 53), (30, 40))[case]
    picture = np.random.default_rng(7 + case).integers(0, 256, (*size, 3), np.uint8)
    np.testing.assert_array_equal(images.resize(picture, *linear.shape[:2], "linear"), linear)
    np.testing.assert_array_equal(images.resize(picture, *bicubic.shape[:2]), bicubic)
