"""The commands export and quantize, which write a model for deployment."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from lpn.core.resources import ProviderName
from lpn.sources import KindOption, PoolingOption


@dataclass
class ExportCommand:
    """Write a .pth or .safetensors model as .onnx, which needs no torch."""

    model: Path
    """Trained LPN: .safetensors or .pth; with --pooling also an .onnx that returns tokens."""
    out: Path
    """File to write, ending in .onnx; views with weights of their own get files beside it."""
    kind: KindOption = None
    pooling: PoolingOption = None
    storage: Literal["float32", "float16", "int8"] = "float32"
    """Precision of the weights in the file: float16 halves it, int8 reduces it to about a third; all compute in float32."""

    def run(self) -> None:
        files = import_module("lpn.models.export").export(self.model, self.out, self.storage, self.kind, self.pooling)
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")


@dataclass
class QuantizeCommand:
    """Quantize an exported model to 8-bit integers, calibrated on real pictures."""

    model: Path
    """Model exported with --storage float32 (.onnx)."""
    data: Path
    """Data set whose pictures set the ranges of the 8-bit numbers, in any layout of docs/data.md."""
    out: Path
    """File to write, ending in .onnx; views with weights of their own get files beside it."""
    pictures: int = 128
    """Number of calibration pictures, spread evenly over the training split, or the test split if there is none."""
    provider: ProviderName = "auto"
    """Provider of the calibration: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or another of ONNX
    Runtime."""
    least_cosine: float = 0.98
    """Nothing is written if the mean cosine with the float32 descriptors of a view's pictures is below this."""

    def run(self) -> None:
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        quantize = import_module("lpn.models.quantize").quantize
        files, agreement = quantize(
            self.model, dataset, self.out, self.pictures, self.provider, least_cosine=self.least_cosine
        )
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")
        cosines = ", ".join(f"{view} {cosine:.4f}" for view, cosine in agreement.cosines.items())
        print(f"Mean cosine with the float32 descriptors of calibration pictures: {cosines}.")
        if agreement.same_first is not None:
            print(
                f"Both models rank the same of {agreement.gallery} pictures first for {100 * agreement.same_first:.1f} % of "
                f"{agreement.queries} queries among them."
            )
        print("Measure what it costs on your data: lpn evaluate with either model.")
