"""The demo: a data set, a model, its baseline, and a flight over a map, in `assets` of a checkout."""

from __future__ import annotations

from pathlib import Path

DEMO = Path(__file__).parents[2] / "assets" / "demo"
# The model of one part, trained alike; the explorer offers to compare with it where the file is there.
DEMO_BASELINE = DEMO / "baseline.onnx"
# A map and a rendered flight over it; the explorer offers it beside the pairs where it is there.
DEMO_FLIGHT = DEMO.with_name("demo-flight") / "map-in-spring.tif", DEMO.with_name("demo-flight") / "flight-in-autumn"
# The query that the explorer shows first.
DEMO_QUERY = "0394/06"
