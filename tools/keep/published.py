"""Published checkpoints: the differences of their answers from the released code's."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tools.keep.measures import Figures, Measure, Value, at_least, at_most

if TYPE_CHECKING:
    from tools.fixtures.parity import ParityCase

# Largest difference of LPN relative to the largest value of the array, and of other methods relative to that of each part. Single
# precision alone makes up to 1.9e-6 of the latter.
AGREEMENT, BY_PART = 1e-6, 3e-6
# Methods besides LPN by the names of their released code's arrays: those for every day, and those of large networks.
QUICK = ("fsra_vits_b3", "mccg_tiny", "sample4geo_tiny_256", "denseuav_vits_224")
LARGE = ("sdpl_resnet50_512", "sample4geo_base_384", "dac_base_384", "game4loc_vitb_384")


def lpn_configurations() -> Figures:
    """Compare the parts of published configurations of LPN with those of the released code.

    Two compare with its arrays, the others with `published_network`, which agrees with these arrays. The figure of a
    configuration is the largest difference over its views.
    """
    from tools.fixtures.parity import CASES

    differences = {str(case): _of_case(case) for case in CASES}
    return {"agreeing": _agreeing(differences, AGREEMENT), **differences}


def _of_case(case: ParityCase) -> float:
    import lpn
    from tools.fixtures.seeded import relative

    with tempfile.TemporaryDirectory() as folder:
        model = lpn.load(case.write(Path(folder)), "cpu")
        return _rounded(
            *(relative(model.part_embeddings(case.pictures(), view), case.expected(view)) for view in case.compared)
        )


def other_methods(names: Sequence[str]) -> Figures:
    """Compare raw parts and descriptors of other methods with those of the released code, for one picture each."""
    differences: dict[str, Value] = {name: _of_method(name) for name in names}
    return {"agreeing": _agreeing(differences, BY_PART), **differences}


def _of_method(name: str) -> float:
    import torch

    import lpn
    from tools.fixtures.published_models import golden, relative_by_part

    expected = golden(name)
    height, width = expected.size
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "net_119.pth")
        torch.save(expected.state, file)
        file.with_name("opts.yaml").write_text(f"h: {height}\nw: {width}\n")
        model = lpn.load(file, "cpu")
        pictures = expected.pictures[:1]
        pairs = [
            (model.part_embeddings(pictures, "drone"), expected.parts("raw", model.n_parts)[:1]),
            (model.descriptors(pictures, "drone"), expected.parts("descriptor", model.n_parts)[:1]),
        ]
    return _rounded(*(relative_by_part(*pair) for pair in pairs))


def _rounded(*differences: float) -> float:
    return float(f"{float(np.max(differences)):.2g}")  # NaN where one is


def _agreeing(differences: Mapping[str, Value], limit: float) -> int:
    return sum(isinstance(one, float) and one <= limit for one in differences.values())


MEASURES = (
    Measure("published", lpn_configurations, {"agreeing": at_least(13), "*": at_most(AGREEMENT)}),
    Measure("methods", partial(other_methods, QUICK), {"agreeing": at_least(len(QUICK)), "*": at_most(BY_PART)}),
    Measure(
        "large-methods",
        partial(other_methods, LARGE),
        {"agreeing": at_least(len(LARGE)), "*": at_most(BY_PART)},
        slow=True,
    ),
)
