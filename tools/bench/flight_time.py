"""Where the time of `lpn locate` goes: `python -m tools.bench.flight_time FOLDER NAME [--model lpn.onnx] [--limit N]`.

FOLDER is as for `tools.bench.flights`. The flight is located twice under cProfile: with nothing in the cache, and with what
the cache holds of the map, as for the next flight over it. Seconds are of the processor, all threads together, each step with
those of what it calls.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

import lpn
from lpn.descriptors import open_store
from lpn.flights import open_flight
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.maps import open_map
from tools.bench.figures import machine

# A step's label, and the file and the function that take it.
STEPS = (
    ("all", "pipeline.py", "locate"),
    ("retrieval", "retrieval.py", "retrieve"),
    ("  windows described", "map_windows.py", "describe_windows"),
    ("  frames described", "retrieval.py", "fill"),
    ("sequence", "ranked_stages.py", "enter_sequence"),
    ("registration", "registered_stage.py", "register_frames"),
    ("  features of the map", "ground.py", "_described"),
    ("  features of turned photos", "registration.py", "_described"),
    ("  matching", "matchers.py", "match"),
    ("  similarities of pairs of matches", "registration.py", "_hypotheses"),
    ("  their support", "registration.py", "_support"),
    ("  guided matching", "registration.py", "_guided"),
)


def seconds_of(profile: cProfile.Profile) -> dict[str, tuple[int, float]]:
    """Return calls and seconds of each step; (0, 0) for one that did not run."""
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    found = {label: (0, 0.0) for label, *_ in STEPS}
    labels = {(file, function): label for label, file, function in STEPS}
    for (file, _, function), (_, calls, _, seconds, _) in stats.items():
        if (label := labels.get((Path(file).name, function))) is not None and "lpn" in Path(file).parts:
            found[label] = found[label][0] + calls, found[label][1] + seconds
    return found


def forget(cache: Path) -> None:
    """Delete what the cache holds of the flight."""
    shutil.rmtree(cache / "registration")
    for folder in (cache / "descriptors").glob("*"):
        if open_store(folder).manifest.view != "satellite":
            shutil.rmtree(folder)


def main() -> None:
    """Measure the flight that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("name")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--limit", type=int)
    given = parser.parse_args()
    folder = given.folder / given.name
    town = open_map(next(path for path in (folder / "map.tif", folder / "map.jpg") if path.is_file()))
    flight = open_flight(folder / "photos")
    flight = replace(flight, frames=flight.frames[: given.limit])
    model = None if given.model is None else lpn.load(given.model)
    runs = []
    with tempfile.TemporaryDirectory() as cache:
        os.environ["LPN_CACHE"] = cache
        for _ in range(2):
            profile = cProfile.Profile(time.process_time)
            profile.runcall(locate, town, flight, model, LocateOptions())
            runs.append(seconds_of(profile))
            forget(Path(cache) / "locate")
    table = Table(title=f"{given.name}, {len(flight.frames)} photos; {machine()}, load {os.getloadavg()[0]:.1f}")
    for column in ("step", "calls", "seconds", "the next flight: calls", "seconds"):
        table.add_column(column, justify="left" if column == "step" else "right")
    for label, *_ in STEPS:
        cells = [cell for run in runs for cell in (f"{run[label][0]}", f"{run[label][1]:.1f}")]
        table.add_row(label, *cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
