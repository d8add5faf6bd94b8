"""The Local Pattern Network: its parts, the contract of a loaded model, checkpoints, ONNX, and quantization.

It imports `core` and `datasets`. Modules that need torch are imported only where a caller needs torch."""
