"""Time of a picture in models of other methods: `python -m tools.bench.published [NAME ...]`.

Each is exported from a checkpoint of its format with seeded weights, which changes no time, and quantized. Both files describe
one picture on one thread of the CPU, with its mirror where the method adds that. They take turns, and the table gives medians.
The peer is the float32 file. The model of Game4Loc has a branch for queries and one for the gallery.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from lpn.core.views import View
from lpn.datasets import open_dataset
from lpn.models.base import Model
from lpn.models.export import export
from lpn.models.onnx_engine import Engine
from lpn.models.quantize import quantize
from tools.bench.figures import Figure, show, take_turns
from tools.bench.pictures import make_train_split
from tools.fixtures import published_models, seeded
from tools.fixtures.published_models import State

ROUNDS = 5
# Pictures that calibrate: few, as they change no time.
CALIBRATION = 4


def golden(name: str) -> Callable[[], State]:
    """Return what makes the checkpoint of a golden."""
    return lambda: published_models.golden(name).state


MODELS: dict[str, tuple[Callable[[], State], int]] = {
    "FSRA ViT-S, k = 3": (golden("fsra_vits_b3"), 256),
    "MCCG ConvNeXt-T": (golden("mccg_tiny"), 256),
    "Sample4Geo ConvNeXt-T": (golden("sample4geo_tiny_256"), 256),
    "DenseUAV ViT-S": (golden("denseuav_vits_224"), 224),
    "Game4Loc ViT-M, two branches": (published_models.medium_game4loc, 256),
    "SDPL ResNet-50": (golden("sdpl_resnet50_512"), 256),
}


def figures(names: list[str]) -> list[Figure]:
    """Measure the models whose names begin with one of `names`, by default all."""
    found = []
    for name, (state, side) in MODELS.items():
        if not names or name.startswith(tuple(names)):
            print(f"Measuring {name} ...", file=sys.stderr, flush=True)
            with tempfile.TemporaryDirectory() as folder:
                found += _measured(name, state(), side, Path(folder))
    return found


def _measured(name: str, state: State, side: int, folder: Path) -> list[Figure]:
    torch.save(state, folder / "net.pth")
    (folder / "opts.yaml").write_text(f"h: {side}\nw: {side}\n")
    export(folder / "net.pth", folder / "float32.onnx")
    places = open_dataset(make_train_split(folder / "places", CALIBRATION))
    quantize(folder / "float32.onnx", places, folder / "int8.onnx", CALIBRATION, least_cosine=-1)
    engines = {kind: Engine(folder / f"{kind}.onnx", threads=1) for kind in ("float32", "int8")}
    batch = engines["float32"].with_mirror(seeded.pictures(0, 1, side, side)[0])
    # Branches of roles are one network each, so both views are measured; others describe both views with one.
    views: tuple[View, ...] = ("drone", "satellite") if len(engines["int8"].contract.groups) > 1 else ("drone",)
    return [_figure(name, engines, batch, view, side) for view in views]


def _figure(name: str, engines: dict[str, Engine], batch: object, view: View, side: int) -> Figure:
    def describe(model: Model) -> Callable[[], object]:
        return lambda: model.part_embeddings(batch, view)

    times = take_turns({kind: describe(model) for kind, model in engines.items()}, ROUNDS)
    ours, peer = (1000 * statistics.median(times[kind]) for kind in ("int8", "float32"))
    role = f", {engines['int8'].role(view)}" if engines["int8"].contract.roles == "role" else ""
    return Figure(f"{name}, {side} x {side}{role}, int8", ours, "ms", peer)


def main() -> None:
    """Measure and print."""
    show("One picture of models of other methods, one thread", figures(sys.argv[1:]))


if __name__ == "__main__":
    main()
