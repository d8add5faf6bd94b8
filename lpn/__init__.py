"""LPN: the Local Pattern Network for cross-view geo-localization, and everything that can be computed with it.

`load` opens a trained model, `Partition` says how it cuts a feature map, `metrics` scores a retrieval, and the
`lpn` command does the rest. Nothing here knows a browser, and torch is imported only where it is needed. What needs
NumPy is imported when it is asked for, so that `lpn doctor` can say that it is missing or broken.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from lpn.core.errors import LPNError, MissingPackageError
from lpn.core.version import __version__

if TYPE_CHECKING:
    from lpn.core.views import View
    from lpn.models.base import Model
    from lpn.models.partition import Partition
    from lpn.models.spec import ModelSpec
    from lpn.retrieval import metrics

__all__ = ["LPNError", "Model", "ModelSpec", "Partition", "View", "__version__", "load", "metrics"]

_HOMES = {
    "Model": "lpn.models.base",
    "ModelSpec": "lpn.models.spec",
    "Partition": "lpn.models.partition",
    "View": "lpn.core.views",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name == "metrics":
            return import_module("lpn.retrieval.metrics")
        if name in _HOMES:
            return getattr(import_module(_HOMES[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def load(path: str | Path) -> Model:
    """Open a trained LPN: an exported `.onnx`, our `.safetensors`, or a published `.pth`.

    The `.onnx` runs without torch, on the CPU; the other two need the extra `train`, and use a GPU where there is one.

    Raises:
        ModelFileError: when the file is missing, is not a model, is truncated, or lacks entries.
        MissingPackageError: when torch is needed and not installed.
    """
    if Path(path).suffix == ".onnx":
        from lpn.models.onnx_engine import Engine

        return Engine(path)
    try:
        from lpn.models.checkpoints import best_device, load_torch
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"Opening {Path(path).name} needs the package {error.name}; "
            "pip install 'lpn-explorer[train]', or export the model to .onnx where torch is installed."
        ) from error
    return load_torch(path, best_device())
