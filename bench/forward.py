"""One picture in, one descriptor out: `python -m bench.forward`.

The peer is the published pipeline: PyTorch in eager mode, one pass for the picture and one for its mirror. Ours is one
batch of two on ONNX Runtime. The limit is ONNX Runtime's bare run of one picture. All are measured in turn, in the
same process, and the table gives medians; weights are random, which changes no time.
"""

from __future__ import annotations

import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from lpn import images, retrieval
from lpn.checkpoints import load_torch, save
from lpn.engine import Engine
from lpn.export import export
from lpn.model import normalise
from lpn.network import LPN
from lpn.spec import ModelSpec

ROUNDS = 15
SPECS = {
    "ResNet-50": ModelSpec("resnet50", views=("satellite", "drone"), classes=701),
    "ResNet-18 to layer3": ModelSpec("resnet18", "layer3", views=("satellite", "drone"), classes=701),
}


def medians(tasks: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each task, the tasks taking turns so that a busy moment hits all alike."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for round_ in range(ROUNDS + 2):
        for name, task in tasks.items():
            started = time.perf_counter()
            task()
            if round_ >= 2:
                times[name].append(time.perf_counter() - started)
    return {name: statistics.median(values) for name, values in times.items()}


def measure(spec: ModelSpec, folder: Path) -> dict[str, float]:
    """Medians for one architecture."""
    save(LPN(spec), folder / "model.safetensors")
    export(folder / "model.safetensors", folder / "model.onnx")
    network, engine = load_torch(folder / "model.safetensors"), Engine(folder / "model.onnx")
    picture = np.random.default_rng(0).integers(0, 256, (512, 512, 3), np.uint8)
    single = images.prepare(picture, spec.input_size)[None]

    def published() -> object:
        prepared = images.prepare(picture, spec.input_size)[None]
        first = network.part_embeddings(prepared, "drone")
        return normalise(first + network.part_embeddings(np.ascontiguousarray(prepared[..., ::-1]), "drone"))

    return medians(
        {
            "published": published,
            "ours": lambda: retrieval.describe_picture(engine, picture, "drone", 0.0),
            "turned": lambda: retrieval.describe_picture(engine, picture, "drone", 30.0),
            "bare": lambda: engine.run(single, "drone"),
            "prepare": lambda: images.prepare(images.rotate(picture, 30.0), spec.input_size),
        }
    )


def main() -> None:
    """Measure and print."""
    table = Table(
        title=f"512 px picture to descriptor, {os.cpu_count()} cores, {platform.machine()}, medians of {ROUNDS}"
    )
    for column in (
        "network",
        "published, ms",
        "ours, ms",
        "ratio",
        "ours turned, ms",
        "bare pass x 1, ms",
        "turn + resize, ms",
    ):
        table.add_column(column, justify="right")
    torch.manual_seed(0)
    for name, spec in SPECS.items():
        with tempfile.TemporaryDirectory() as folder:
            result = measure(spec, Path(folder))
        cells = [result["published"], result["ours"], result["turned"], result["bare"], result["prepare"]]
        shown = [f"{1000 * value:.1f}" for value in cells]
        table.add_row(name, shown[0], shown[1], f"{cells[0] / cells[1]:.2f}", *shown[2:])
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
