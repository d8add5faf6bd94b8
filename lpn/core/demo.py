"""The demo: a data set and a model in `assets/demo` of a checkout."""

from __future__ import annotations

from pathlib import Path

DEMO = Path(__file__).parents[2] / "assets" / "demo"
# The query that the explorer shows first.
DEMO_QUERY = "0394/06"
