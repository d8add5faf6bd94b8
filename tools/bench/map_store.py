"""Processor time to describe windows of a map into a store: `python -m tools.bench.map_store MAP --model lpn.onnx`.

It describes the first `--windows` windows of a grid, as `lpn describe --map` does, and says what 10,000 would take. Processor
seconds count, as other work may run beside it: two cores take half as long as these seconds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import lpn
from lpn.descriptors.map_windows import describe_windows
from lpn.maps import open_map
from lpn.maps.named_window import WindowCut

_WHOLE = 10_000


def main() -> None:
    """Measure the map that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--windows", type=int, default=800)
    parser.add_argument("--size", type=float, default=70.0, help="side of the windows in metres")
    given = parser.parse_args()
    model, town = lpn.load(given.model), open_map(given.map)
    overlap = 0.5
    while len(windows := town.pyramid([given.size], overlap)) < given.windows:
        overlap += (1 - overlap) / 4
    chosen = windows[: given.windows]
    with tempfile.TemporaryDirectory() as folder:
        wall, processor = time.perf_counter(), time.process_time()
        describe_windows(model, town, chosen, Path(folder) / "store")
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
    begun = time.process_time()
    for window in chosen[:100]:
        WindowCut(town, window, max(model.input_size))()
    cut = (time.process_time() - begun) / len(chosen[:100])
    print(
        f"{given.map.name}: {len(chosen)} windows of {given.size:g} m took {processor:.1f} s of processor time ({wall:.1f} s on "
        f"the clock); {1000 * processor / len(chosen):.1f} ms a window, {1000 * cut:.1f} ms of them for cutting. {_WHOLE:,} "
        f"windows: {processor / len(chosen) * _WHOLE:.0f} s of processor time, {processor / len(chosen) * _WHOLE / 120:.1f} "
        "minutes of two cores."
    )


if __name__ == "__main__":
    main()
