"""A county of 10^4 to 10^7 windows: describe, index, search, locate, and the explorer: `python -m tools.bench.county FOLDER`.

The county is a raster that a function draws where it is read, and that is never stored. Windows of 70, 100, and 140 m with three
quarters overlap are cut from it. The rate of describing them by the network is measured on a sample. To describe 10^7 takes
days, so the index is filled with descriptors of a seeded function, by the same code as `lpn index --map`: its searches take as
long, and what they find means nothing. The network is untrained, with 4 parts of 64 numbers.

FOLDER keeps indexes and figures. A run that was killed goes on: it fills the rest of its index, and measures what has no figure
yet. `--windows` are the sizes of the county, `--engine faiss` makes an approximate index, and `--no-page` leaves the explorer
out. `--chart FILE` writes the chart as SVG.
With `--rows docs/measured/county.json` it shows those figures, and nothing is measured.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader
from playwright.sync_api import sync_playwright

import lpn
from lpn.core.arrays import BoolArray, Float32Array, Int64Array, UInt8Array
from lpn.core.files import write_atomic
from lpn.core.progress import at_intervals
from lpn.flights import Flight, Frame
from lpn.index import DescriptorKind, IndexEngine, create_index, open_index
from lpn.index.from_map import index_windows, window_describer
from lpn.locate.index_windows import WindowIndex
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.maps import Map, Window
from lpn.maps.borders import PixelBox
from lpn.maps.sheet import Sheet
from lpn.models.base import Model, normalise
from tools.bench.figures import machine
from tools.bench.page import ServerProcess, page_seconds, pick_seconds
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

SIZES = (70.0, 100.0, 140.0)
OVERLAP = 0.75
PIXEL = 0.5
ORIGIN = (46.5, 7.5)
PARTS, NUMBERS = 4, 64
FRAMES, SAMPLE, SEARCHES = 24, 128, 20
# Windows that are added at once, many, as no network describes them.
BLOCK = 1 << 16
# Seconds between two sentences about the windows that are in the index.
SAID = 10.0
# The command line's program, with the county in place of a map's file.
SERVE = """
import sys
import lpn.maps
from tools.bench.county import county
basemap = county(int(sys.argv.pop(1)))
lpn.maps.open_map = lambda *_: basemap
from lpn.cli.main import main
sys.exit(main())
"""
_PRIMES = np.array([73_856_093, 19_349_663], np.int64)


class DrawnRaster:
    """Fields, roads, and houses, drawn for the rectangle that is read.

    Args:
        side: in pixels.
    """

    def __init__(self, side: int) -> None:
        self.path, self.width, self.height = Path("county"), side, side
        self.notes: list[str] = []

    @property
    def treatment(self) -> None:
        return None

    def files(self) -> list[Path]:
        return []

    def read(self, box: PixelBox, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """See `lpn.maps.raster.Raster`; a sample stands for the mean of its pixels."""
        x, y = (
            (first + (np.arange(count) + 0.5) * length / count) * PIXEL
            for first, length, count in zip(box[:2], box[2:], size, strict=True)
        )
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        for width, height, share in ((61.0, 43.0, 1.0), (13.0, 9.0, 0.15), (0.9, 0.9, 0.0)):
            columns, rows = (x // width).astype(np.int64), (y // height).astype(np.int64)
            drawn = _hashed(columns[None] * _PRIMES[0] ^ rows[:, None] * _PRIMES[1] ^ int(width * 1000))
            colours = np.stack([drawn >> shift & 255 for shift in (8, 16, 24)], axis=-1)
            if share:
                chosen = (drawn & 255) < 256 * share
                picture[chosen] = (60 + colours[chosen] * 0.55).astype(np.uint8)
            else:
                picture += (colours % 24).astype(np.uint8)
        picture[(np.abs(y % 430.0 - 4) < 4), :] = 150
        picture[:, np.abs(x % 370.0 - 4) < 4] = 150
        return picture, np.ones(picture.shape[:2], bool)

    def close(self) -> None:
        """Close nothing."""


def _hashed(values: Int64Array) -> Int64Array:
    mixed: Int64Array = (values ^ (values >> 13)) * 1_274_126_177 & 0xFFFFFFFFFF
    return mixed ^ (mixed >> 16)


def county(windows: int) -> Map:
    """Return a square county with about so many windows."""
    from rasterio.crs import CRS

    side = math.sqrt(windows / sum((size * (1 - OVERLAP)) ** -2 for size in SIZES)) + sum(SIZES) / len(SIZES) * OVERLAP
    pixels = round(side / PIXEL)
    crs = CRS.from_proj4(f"+proj=tmerc +lat_0={ORIGIN[0]} +lon_0={ORIGIN[1]} +datum=WGS84 +units=m")
    half = pixels * PIXEL / 2
    matrix = np.array([[PIXEL, 0, -half], [0, -PIXEL, half]])
    return Map("county", [Sheet("county", DrawnRaster(pixels), crs, matrix)])


def make_model(folder: Path) -> Path:
    """Export an untrained network of 4 parts of 64 numbers, unless it exists."""
    file = folder / "model.onnx"
    if not file.is_file():
        import torch

        from lpn.models.checkpoints import save
        from lpn.models.export import export
        from lpn.models.network import LPN
        from lpn.models.spec import ModelSpec

        torch.manual_seed(0)
        spec = ModelSpec(
            backbone="resnet18",
            last_layer="layer3",
            views=("satellite", "drone"),
            n_parts=PARTS,
            embedding=NUMBERS,
            classes=6,
            input_size=(256, 256),
        )
        folder.mkdir(parents=True, exist_ok=True)
        save(LPN(spec), folder / "model.safetensors")
        export(folder / "model.safetensors", file)
    return file


def drawn(windows: Sequence[Window]) -> Float32Array:
    """Return descriptors of windows by a seeded function in place of a network, (B, 4, 64)."""
    seed = [round(abs(windows[0].x)), round(abs(windows[0].y)), len(windows), round(windows[0].size)]
    values = np.random.default_rng(seed).standard_normal((len(windows), PARTS, NUMBERS), np.float32)
    return normalise(values + np.float32(0.5))


def photographed(basemap: Map, folder: Path, count: int = FRAMES) -> Flight:
    """Write photos that look straight down from 100 m along a line, with headings, and return the flight."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(count):
        x, y, width = 30.0 * (i - count / 2), 17.0, 160.0
        file = folder / f"{i:03d}.jpg"
        if not file.is_file():
            picture = basemap.read(Window(x, y, width), 800)[0][100:700]
            cv2.imwrite(str(file), np.ascontiguousarray(picture[..., ::-1]))
        latitude, longitude = (float(value) for value in basemap.frame.degrees([(x, y)])[0])
        frames.append(
            Frame(
                file.name,
                file,
                800,
                600,
                time=2.0 * i,
                latitude=latitude,
                longitude=longitude,
                height_above_ground=100.0,
                heading=0.0,
                heading_source="gimbal",
                pitch=-90.0,
                roll=0.0,
                fov=2 * math.degrees(math.atan(width / 200)),
            )
        )
    return Flight("line", tuple(frames))


def describe_seconds(model: Model, basemap: Map) -> float:
    """Return the processor seconds that the network takes to describe a window, cutting included."""
    windows = basemap.pyramid(SIZES[:1], 0.0)[:SAMPLE]
    describe = window_describer(model, basemap)
    describe(windows[:32])
    begun = time.process_time()
    describe(windows)
    return (time.process_time() - begun) / len(windows)


def filled(folder: Path, basemap: Map, model: Model, engine: IndexEngine) -> dict[str, float]:
    """Fill an index, exact ones in 8 bits; return the seconds since this call, the windows, and the bytes on disk."""
    kind = DescriptorKind(model.fingerprint, PARTS, NUMBERS)
    begun = time.perf_counter()

    def say(done: int, total: int) -> None:
        seconds = time.perf_counter() - begun
        print(f"{done:,} of {total:,} windows are in the index after {seconds:.0f} s", flush=True)

    with create_index(folder, kind, engine, "int8" if engine == "exact" else "float32") as index:
        index_windows(index, basemap, drawn, SIZES, OVERLAP, at_intervals(SAID, say), BLOCK)
    return {
        "index": time.perf_counter() - begun,
        "windows": basemap.count_pyramid(SIZES, OVERLAP),
        "bytes": sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()),
    }


def searched(folder: Path, model: Model) -> dict[str, float]:
    """Return the median seconds of searches of an index."""
    queries = drawn([Window(i, 0, SIZES[0]) for i in range(SEARCHES)])
    with open_index(folder, model.fingerprint) as index:
        clock, processor = median_seconds([partial(index.search, query, None, 100) for query in queries])
    return {"search": clock, "search, processor": processor}


def located(index: Path, basemap: Map, model: Model, photos: Path) -> dict[str, float]:
    """Return the seconds that a frame takes by the retrieval alone, the windows compared, and the memory in bytes."""
    flight = photographed(basemap, photos)
    begun = time.perf_counter()
    with (
        TemporaryDirectory() as cache,
        patch.dict(os.environ, LPN_CACHE=cache),
        # Windows of a drawn index resemble nothing, so they are not described again to be compared.
        patch.object(WindowIndex, "_check"),
    ):
        indexed = WindowIndex(str(index), model, basemap)
        answers = locate(basemap, flight, model, LocateOptions(sequence=False, register=False), indexed=indexed)
    assert answers.retrieval is not None
    return {
        "locate a frame": (time.perf_counter() - begun) / len(flight.frames),
        "windows compared": len(answers.retrieval.windows),
        "memory": 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }


def median_seconds(tasks: Sequence[Callable[[], object]]) -> tuple[float, float]:
    """Return the median seconds of tasks, on the clock and of the processor, after the first has run once unmeasured."""
    tasks[0]()
    times = []
    for task in tasks:
        begun = time.perf_counter(), time.process_time()
        task()
        times.append((time.perf_counter() - begun[0], time.process_time() - begun[1]))
    clock, processor = (statistics.median(values) for values in zip(*times, strict=True))
    return clock, processor


def measure(
    windows: int, folder: Path, model_file: Path, with_page: bool, engine: IndexEngine = "exact"
) -> dict[str, Any]:
    """Measure a county of about so many windows, as far as it has no figures yet; times are seconds, and memory is in bytes."""
    basemap, model = county(windows), lpn.load(model_file)
    name = str(windows) if engine == "exact" else f"{windows}-{engine}"
    index, photos = folder / f"{name}.index", folder / f"{windows}.photos"
    record = index.with_suffix(".json")
    found: dict[str, Any] = json.loads(record.read_bytes()) if record.is_file() else {}
    steps: dict[str, Callable[[], dict[str, float]]] = {
        "index": lambda: filled(index, basemap, model, engine),
        "describe a window": lambda: {"describe a window": describe_seconds(model, basemap)},
        "search": lambda: searched(index, model),
        "locate a frame": lambda: located(index, basemap, model, photos),
    }
    if with_page:
        steps["picked"] = lambda: page_of(windows, index, model_file, photos)
    for name, step in steps.items():
        if name not in found:
            found |= step()
            print(f"{windows:,} windows, {name}: {found[name]:.4g} s", flush=True)
            write_atomic(record, json.dumps(found, indent=1).encode())
    return found


def page_of(windows: int, index: Path, model: Path, photos: Path) -> dict[str, float]:
    """Measure the explorer over an index: from the command to the address, and from a pick to the changed picture."""
    options = [
        "explore",
        "index",
        "--index",
        index,
        "--model",
        model,
        "--map",
        "county",
        "--pictures",
        photos,
        "--port",
    ]
    command = [sys.executable, "-c", SERVE, windows, *options, free_port()]
    with (
        TemporaryDirectory() as cache,
        ServerProcess([str(one) for one in command], {**os.environ, "LPN_CACHE": cache}) as app,
        sync_playwright() as playwright,
    ):
        browser = launch(playwright)
        page_seconds(browser, app.url)[1].context.close()  # the browser's own start is nobody's
        opened, page = page_seconds(browser, app.url)
        page.wait_for_timeout(5000)
        found = {"command to address": app.seconds, "address to page": opened, "picked": pick_seconds(page)}
        page.screenshot(path=str(index.with_suffix(".png")))
        browser.close()
    return found


def chart(rows: Sequence[dict[str, Any]]) -> str:
    """Return the chart of seconds over windows as SVG, both axes in powers of ten; what was not measured has no point."""
    lines = {
        "fill the index": [row.get("index") for row in rows],
        "locate a frame": [row.get("locate a frame") for row in rows],
        "picked to changed picture": [row.get("picked") for row in rows],
        "one search": [row.get("search") for row in rows],
        "describe all, two cores (extrapolated)": [
            row["windows"] * row.get("describe a window", 0) / 2 for row in rows
        ],
    }
    points = {
        name: [
            (60 + 150 * (math.log10(row["windows"]) - 4), 20 + 40 * (6 - math.log10(value)))
            for row, value in zip(rows, values, strict=True)
            if value
        ]
        for name, values in lines.items()
    }
    # Labels lie below each other where lines end together.
    labels: dict[str, float] = {}
    for name, line in sorted(points.items(), key=lambda one: one[1][-1][1] if one[1] else math.inf):
        if line:
            labels[name] = max(line[-1][1] + 4, max(labels.values(), default=-math.inf) + 16)
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True)
    return environment.get_template("county.svg.j2").render(points=points, labels=labels)


def main() -> None:
    """Measure the counties that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--windows", type=int, nargs="+", default=[10**4, 10**5, 10**6, 10**7])
    parser.add_argument("--engine", choices=("exact", "faiss"), default="exact")
    parser.add_argument("--no-page", action="store_true")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--chart", type=Path)
    given = parser.parse_args()
    if given.rows is not None:
        rows = json.loads(given.rows.read_bytes())
    elif given.folder is None:
        parser.error("give FOLDER, or --rows FILE of figures that were measured")
    else:
        model = make_model(given.folder)
        print(machine())
        rows = [measure(windows, given.folder, model, not given.no_page, given.engine) for windows in given.windows]
    print(json.dumps(rows, indent=1))
    if given.chart is not None:
        write_atomic(given.chart, chart(rows).encode())


if __name__ == "__main__":
    main()
