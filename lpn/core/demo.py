"""The demo: a data set, a model, and its baseline in `assets/demo` of a checkout."""

from __future__ import annotations

from pathlib import Path

DEMO = Path(__file__).parents[2] / "assets" / "demo"
# The model of one part, trained alike; the explorer offers to compare with it where the file is there.
DEMO_BASELINE = DEMO / "baseline.onnx"
# The query that the explorer shows first.
DEMO_QUERY = "0394/06"
