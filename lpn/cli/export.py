"""The command export, which writes a model for deployment."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from lpn.core.errors import InputError
from lpn.sources import KindOption, PoolingOption

_PICTURES, _LEAST_COSINE = 128, 0.98


@dataclass
class ExportCommand:
    """Write a .pth or .safetensors model as .onnx, which needs no torch; with --compute int8 also an .onnx in 8 bits."""

    model: Path
    """Trained LPN: .safetensors or .pth; with --compute int8 also an .onnx that was exported with --storage float32."""
    out: Path
    """File to write, ending in .onnx; views with separate weights get files beside it."""
    kind: KindOption = None
    pooling: PoolingOption = None
    storage: Literal["float32", "float16", "int8"] = "float32"
    """Precision of the weights in the file: float16 halves the file, int8 leaves about a third; all compute in float32."""
    compute: Literal["float32", "int8"] = "float32"
    """Numbers that convolutions and linear layers compute in: int8 is the quickest on a CPU, and needs --data."""
    data: Path | None = None
    """With --compute int8: data set whose pictures set the ranges of the 8-bit numbers, in any layout of docs/data.md."""
    pictures: int = _PICTURES
    """With --compute int8: number of these pictures, spread evenly over the training split, else over the test split."""
    least_cosine: float = _LEAST_COSINE
    """With --compute int8: if a view's mean cosine with float32 descriptors is below this number, nothing is written."""

    def run(self) -> None:
        if self.compute == "int8":
            self._quantize()
            return
        if self.data or (self.pictures, self.least_cosine) != (_PICTURES, _LEAST_COSINE):
            raise InputError(
                "--data, --pictures, and --least-cosine belong to --compute int8; give it, or leave them out."
            )
        files = self._export(self.out)
        self._report(files)
        apart = import_module("lpn.models.export").difference(self.model, files[0], self.kind, self.pooling)
        print(f"Its descriptors of a picture of noise differ from the model's by at most {apart:.1e}.")

    def _export(self, out: Path) -> list[Path]:
        files: list[Path] = import_module("lpn.models.export").export(
            self.model, out, self.storage, self.kind, self.pooling
        )
        return files

    def _report(self, files: list[Path]) -> None:
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")

    def _quantize(self) -> None:
        from lpn.core.files import check_writable

        if self.data is None:
            raise InputError("--compute int8 takes the ranges of its numbers from pictures; give a data set as --data.")
        if self.storage != "float32":
            raise InputError("--compute int8 stores 8-bit numbers by itself; leave --storage out.")
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        quantize = import_module("lpn.models.quantize").quantize
        check_writable(self.out)
        exported = self.model.suffix == ".onnx" and self.pooling is None and self.kind is None
        with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
            model = self.model if exported else self._export(Path(folder) / self.out.name)[0]
            files, agreement = quantize(model, dataset, self.out, self.pictures, self.least_cosine)
        self._report(files)
        cosines = ", ".join(f"{view} {cosine:.4f}" for view, cosine in agreement.cosines.items())
        print(f"Mean cosine with the float32 descriptors of calibration pictures: {cosines}.")
        if agreement.same_first is not None:
            print(
                f"Both models rank the same of {agreement.gallery} pictures first for {100 * agreement.same_first:.1f} % of "
                f"{agreement.queries} queries among them."
            )
        print("Measure the loss on your data: run lpn evaluate with each of the two models.")
