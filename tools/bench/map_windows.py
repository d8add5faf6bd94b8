"""Pairs of views that `lpn train --map` makes a second of processor time: `python -m tools.bench.map_windows MAP ...`.

One thread makes the pairs of the recipe `map`: from a map in memory, and from one that is read window by window.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2

from lpn.maps import open_map
from lpn.training.map_windows import MapWindows
from lpn.training.recipes import RECIPES


def pairs_a_second(windows: MapWindows, count: int) -> float:
    """Draw the first pairs of an epoch, and return how many are made a second."""
    begun = time.process_time()
    for place in range(count):
        windows.draw(place, 0)
    return count / (time.process_time() - begun)


def main() -> None:
    """Measure the maps that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--pairs", type=int, default=64)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    for path in given.maps:
        town = open_map(path)
        whole, parts = (MapWindows(town, RECIPES["map"], in_memory=pixels) for pixels in (1 << 20, 0))
        print(
            f"{path}: {pairs_a_second(whole, given.pairs):.0f} pairs a second in memory, "
            f"{pairs_a_second(parts, given.pairs):.0f} by windows."
        )


if __name__ == "__main__":
    main()
