"""One query, from the bytes of a JPEG to its descriptor: `python -m tools.bench query`.

The peer is the published pipeline: Pillow decodes and resizes, PyTorch in eager mode passes the picture and then its mirror.
Ours is `lpn.retrieval.describe_picture` on ONNX Runtime, in float32 and quantised. The limit of a pass is ONNX Runtime's bare
run of the same graph on the same batch. Weights are random and pictures synthetic, which changes no time.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnxruntime as ort
import torch
from PIL import Image

from lpn import retrieval
from lpn.core import images
from lpn.core.resources import usable_cores
from lpn.datasets import Dataset, open_dataset
from lpn.descriptors.transforms import Change
from lpn.models.base import normalise
from lpn.models.checkpoints import TorchModel, load_torch, save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.quantize import quantize
from lpn.models.spec import ModelSpec
from tools.bench.figures import Figure, medians
from tools.bench.pictures import make_train_split

SPECS = {
    "ResNet-50": ModelSpec("resnet50", views=("satellite", "drone"), classes=701),
    "ResNet-18 to layer3": ModelSpec("resnet18", "layer3", views=("satellite", "drone"), classes=701),
}
ANGLE = 30.0
_MEAN, _STD = (np.array(values, np.float32) for values in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))


class PublishedCode:
    """The published pipeline from a file's bytes to a descriptor."""

    def __init__(self, model: TorchModel) -> None:
        self._network, self._size = model, model.input_size

    def __call__(self, data: bytes) -> object:
        picture = Image.open(io.BytesIO(data)).convert("RGB").resize(self._size[::-1], Image.Resampling.BICUBIC)
        scaled = (np.asarray(picture, np.float32) / 255 - _MEAN) / _STD
        single = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]
        first = self._network.part_embeddings(single, "drone")
        return normalise(first + self._network.part_embeddings(torch.flip(single, [3]), "drone"))


def bare(file: Path) -> ort.InferenceSession:
    """Open a graph with ONNX Runtime alone."""
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads, options.log_severity_level = (
        torch.get_num_threads(),
        1,
        4,
    )
    return ort.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def describe(engine: Engine, data: bytes) -> object:
    return retrieval.describe_picture(engine, images.decode_picture(data, ""), "drone")


def measure(name: str, spec: ModelSpec, dataset: Dataset, folder: Path) -> list[Figure]:
    save(LPN(spec), folder / "model.safetensors")
    export(folder / "model.safetensors", folder / "model.onnx")
    quantize(folder / "model.onnx", dataset, folder / "int8.onnx", 32)
    published = PublishedCode(load_torch(folder / "model.safetensors"))
    engines = {kind: Engine(folder / file) for kind, file in (("float32", "model.onnx"), ("int8", "int8.onnx"))}
    sessions = {kind: bare(folder / file) for kind, file in (("float32", "model.onnx"), ("int8", "int8.onnx"))}
    data = dataset.train("satellite")[0].path.read_bytes()
    picture = images.decode_picture(data, "picture")
    single = images.prepare(picture, spec.input_size)
    both = np.stack([single, single[..., ::-1]])
    outputs = ["parts", "features"]
    tasks: dict[str, Callable[[], object]] = {"published": lambda: published(data)}
    for kind, engine in engines.items():
        tasks[kind] = partial(describe, engine, data)
        tasks[f"{kind} pass"] = partial(engine.run, both, "drone")
        tasks[f"{kind} bare"] = partial(sessions[kind].run, outputs, {"images": both})
    change = Change(rotate=ANGLE)
    tasks["prepare"] = lambda: np.stack(
        [ready := images.normalise(images.resize(change.apply(picture), *spec.input_size)), ready[..., ::-1]]
    )
    found = medians(tasks)
    side = f"{picture.shape[1]} px JPEG to descriptor with mirror"
    made = [
        Figure(f"{name}, {side}, {kind}", found[kind], "ms", found["published"], found[f"{kind} bare"])
        for kind in engines
    ]
    made += [
        Figure(f"{name}, forward pass of two, {kind}", found[f"{kind} pass"], "ms", limit=found[f"{kind} bare"])
        for kind in engines
    ]
    what = f"{name}, turn, resize, normalise, mirror a {picture.shape[1]} px picture"
    return [*made, Figure(what, found["prepare"], "ms")]


def figures() -> list[Figure]:
    """Measure both networks."""
    torch.set_num_threads(usable_cores())
    images.use_all_cores()  # as the explorer does
    torch.manual_seed(0)
    found: list[Figure] = []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        dataset = open_dataset(make_train_split(folder / "places"))
        for name, spec in SPECS.items():
            found += measure(name, spec, dataset, folder)
    return found
