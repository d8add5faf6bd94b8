"""The Local Pattern Network: partition, architecture, the contract of a loaded model, checkpoints, ONNX, and quantization.

It imports `core` and `datasets`. This module needs no torch; the modules `lpn`, `checkpoints`, and `export` do.
"""

from lpn.models.base import Model
from lpn.models.contract import Contract, ForwardPass, Heads
from lpn.models.partition import Partition
from lpn.models.spec import ModelSpec
from lpn.models.trace import Trace

__all__ = ["Contract", "ForwardPass", "Heads", "Model", "ModelSpec", "Partition", "Trace"]
