"""Pictures per second into descriptors: `python -m tools.bench describe`.

The peer is the published test loop: a DataLoader with worker processes decodes with Pillow, resizes bicubically, and
normalises; PyTorch in eager mode passes each batch of 32 and then its mirror, and the parts of the sum are normalised. Ours is
`lpn.descriptors.describe`, which checks the pictures and writes a store on disk, with the same network exported to ONNX, and with
the same network quantized. They take turns in one process, after a warm-up round; the table gives medians. The limit is ONNX
Runtime's bare forward passes, two for each picture, on as many threads as there are cores.

Pictures are synthetic JPEG files of 512 x 512 pixels, and weights are random, which changes no time.
"""

from __future__ import annotations

import io
import statistics
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.utils.data import DataLoader, Dataset

from lpn import descriptors
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.resources import usable_cores
from lpn.datasets import open_dataset
from lpn.models.base import Model
from lpn.models.checkpoints import TorchModel, load_torch, save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.quantize import quantize
from lpn.models.spec import ModelSpec
from tools.bench.figures import Figure, take_turns
from tools.bench.pictures import make_folder, make_train_split

PICTURES = 96
ROUNDS = 3
# The batch size of the published test script.
BATCH = 32
SPEC = ModelSpec("resnet50", views=("satellite", "drone"), classes=701)


class Files(Dataset[torch.Tensor]):
    """Picture files as the published loop prepares them."""

    def __init__(self, files: Sequence[Path], size: tuple[int, int]) -> None:
        self.files, self.size = files, size

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> torch.Tensor:
        with Image.open(self.files[index]) as file:
            picture = file.convert("RGB").resize(self.size[::-1], Image.Resampling.BICUBIC)
        return torch.from_numpy(images.normalise(np.asarray(picture)))


def published(network: TorchModel, files: Sequence[Path], workers: int) -> Float32Array:
    """Descriptors by the published loop, (N, n D)."""
    rows, spec = [], network.spec
    with torch.inference_mode():
        for pictures in DataLoader(Files(files, spec.input_size), BATCH, num_workers=workers):
            raw = torch.zeros(len(pictures), spec.n_parts, spec.embedding)
            for mirrored in (False, True):
                raw += network.network.embed(pictures.flip(3) if mirrored else pictures, "drone")[0]
            norms = raw.norm(dim=2, keepdim=True) * spec.n_parts**0.5
            rows.append((raw / norms).flatten(1))
    return torch.cat(rows).numpy()


def ours(model: Model, files: Sequence[Path], root: Path) -> Float32Array:
    """Descriptors from a new store, (N, n D)."""
    with tempfile.TemporaryDirectory() as out, redirect_stdout(io.StringIO()):
        store = descriptors.describe(model, files, "drone", out, root=root)
        return np.array(store.descriptors, np.float32).reshape(len(files), -1)


def bare(engine: Engine, passes: int) -> None:
    """Run forward passes alone, on all cores in turn; each uses one thread."""
    single = np.zeros((1, 3, *engine.input_size), np.float32)
    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(lambda _: engine.run(single, "drone"), range(passes)))


def agreement(a: Float32Array, b: Float32Array) -> float:
    """Mean cosine between descriptors of the same pictures."""
    return float((a * b).sum(1).mean())


def figures() -> list[Figure]:
    """Measure the pictures of a folder."""
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        root = make_folder(folder / "pictures", PICTURES)
        files = descriptors.pictures_below(root)
        save(LPN(SPEC), folder / "model.safetensors")
        export(folder / "model.safetensors", folder / "model.onnx")
        quantize(folder / "model.onnx", open_dataset(make_train_split(folder / "places")), folder / "int8.onnx", 32)
        network = load_torch(folder / "model.safetensors", "cpu")
        workers = max(1, usable_cores() // 2)
        tasks: dict[str, Callable[[], object]] = {"peer": lambda: published(network, files, workers)}
        for kind, file in (("float32", "model.onnx"), ("int8", "int8.onnx")):
            engine, single = Engine(folder / file), Engine(folder / file, threads=1)
            tasks[kind] = lambda engine=engine: ours(engine, files, root)  # type: ignore[misc]
            tasks[f"{kind} bare"] = lambda single=single: bare(single, 2 * len(files))  # type: ignore[misc]
        apart = 1 - agreement(published(network, files, workers), ours(Engine(folder / "model.onnx"), files, root))
        speed = {name: len(files) / statistics.median(values) for name, values in take_turns(tasks, ROUNDS).items()}
    what = f"ResNet-50, {len(files)} pictures of a folder to a store"
    peer = speed["peer"]
    return [
        *(
            Figure(f"{what}, {kind}", speed[kind], "pictures/s", peer, speed[f"{kind} bare"], more=True)
            for kind in ("int8", "float32")
        ),
        Figure("1 - mean cosine of the published descriptors and ours in float32", apart, ""),
    ]
