"""Parity on a GPU, see `tools.keep.published.on_gpu`: `python -m tools.bench.gpu`."""

from __future__ import annotations

import sys

from tools.keep.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["gpu"]))
