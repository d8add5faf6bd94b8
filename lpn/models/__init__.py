"""The Local Pattern Network: partition, architecture, the contract of a loaded model, checkpoints, ONNX, and quantization.

It imports `core` and `datasets`. This face needs no torch; `network`, `checkpoints`, and `export` do.
"""

from lpn.models.base import ForwardPass, Heads, Model
from lpn.models.partition import Partition
from lpn.models.spec import ModelSpec
from lpn.models.trace import Trace

__all__ = ["ForwardPass", "Heads", "Model", "ModelSpec", "Partition", "Trace"]
