"""Published checkpoints: the differences of their answers from the released code's."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tools.keep.measures import Figures, Measure, NotMeasuredError, Value, at_least, at_most, reported

if TYPE_CHECKING:
    from tools.fixtures.parity import ParityCase

# Largest difference of LPN relative to the largest value of the array, and of other methods relative to that of each part. Single
# precision alone makes up to 1.9e-6 of the latter.
AGREEMENT, BY_PART = 1e-6, 3e-6
# The same on a GPU, and mixed precisions that are tried there without a limit.
ON_GPU, MIXED = 1e-4, ("float16", "bfloat16")
# Methods besides LPN by the names of their released code's arrays: those for every day, and those of large networks.
QUICK = ("fsra_vits_b3", "mccg_tiny", "sample4geo_tiny_256", "denseuav_vits_224")
LARGE = ("sdpl_resnet50_512", "sample4geo_base_384", "dac_base_384", "game4loc_vitb_384")


def lpn_configurations() -> Figures:
    """Compare the parts of published configurations of LPN with those of the released code.

    Two compare with its arrays, the others with `published_network`, which agrees with these arrays. The figure of a
    configuration is the largest difference over its views.
    """
    from tools.fixtures.parity import CASES

    differences = {str(case): of_case(case, "cpu")[""] for case in CASES}
    return {"agreeing": _agreeing(differences, AGREEMENT), **differences}


def on_gpu() -> Figures:
    """Compare the same on a GPU, in float32 and in mixed precision, and one exported by each of ONNX Runtime's providers."""
    import torch

    if not torch.cuda.is_available():
        raise NotMeasuredError(f"torch {torch.__version__} finds no GPU here")
    from tools.fixtures.parity import CASES

    figures: dict[str, Value] = {}
    for case in CASES:
        for precision, difference in of_case(case, "cuda", MIXED).items():
            figures[f"{case}{precision}"] = difference
    return figures | of_providers(CASES[3])


def of_case(case: ParityCase, device: str, mixed: Sequence[str] = ()) -> dict[str, float]:
    """Return a case's largest differences in float32, named "", and in mixed precisions, named as in ", float16"."""
    import torch

    from lpn.models.checkpoints import load_torch
    from tools.fixtures.seeded import relative

    with tempfile.TemporaryDirectory() as folder:
        model = load_torch(case.write(Path(folder)), device)
    found: dict[str, list[float]] = {}
    for view in case.compared:
        expected = case.expected(view)
        found.setdefault("", []).append(relative(model.part_embeddings(case.pictures(), view), expected))
        for precision in mixed:
            with torch.inference_mode(), torch.autocast(device, getattr(torch, precision)):
                outputs = model.network.embed(case.pictures().to(device), view)[0].float().cpu().numpy()
            found.setdefault(f", {precision}", []).append(relative(outputs, expected))
    return {precision: _rounded(*differences) for precision, differences in found.items()}


def of_providers(case: ParityCase) -> dict[str, Value]:
    """Export a case, and return its largest difference by each provider of ONNX Runtime that starts here."""
    from lpn.core.errors import LPNError
    from lpn.models.export import export
    from lpn.models.onnx_engine import Engine
    from lpn.models.providers import available
    from tools.fixtures.seeded import relative

    view, found = case.compared[0], dict[str, Value]()
    with tempfile.TemporaryDirectory() as folder:
        export(case.write(Path(folder)), file := Path(folder, "model.onnx"))
        for provider in available():
            try:
                outputs = Engine(file, provider=provider).part_embeddings(case.pictures(), view)
                found[f"exported, {provider}"] = _rounded(relative(outputs, case.expected(view)))
            except LPNError as error:
                print(f"{provider} was not run: {error}")
    return found


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
    Measure("gpu", on_gpu, {"*float16": reported(), "*": at_most(ON_GPU)}, slow=True),
)
