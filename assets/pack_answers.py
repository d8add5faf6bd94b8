"""Makes the answers of the demo's model for both flights of the demo: `python assets/pack_answers.py`.

They are computed as `lpn explore` computes them where no answers ship, in an empty cache. SIFT registers the photos, as it
needs no further package.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

import lpn
from explorer.opening import OFFERED_OVERLAP
from lpn.core.arrays import Float32Array
from lpn.core.demo import DEMO_ANSWERS, DEMO_FLIGHT, DEMO_MODEL, DEMO_PLACE
from lpn.core.errors import DataError
from lpn.core.files import write_atomic
from lpn.core.views import View
from lpn.descriptors import DescriptorKind, PartialStore, Precision, Row, write_store
from lpn.flight.files import Flight, open_flight
from lpn.flight.locate import shipped
from lpn.flight.locate.located import StageRecord
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.retrieval import describe_frames, described_windows, retrieve
from lpn.flight.locate.shipped import FRAMES, WINDOWS, ShippedRecord, frame_rows, identity, window_rows
from lpn.flight.maps import Map, open_map
from lpn.models.base import Model

DIGITS = 6
"""Significant digits of numbers in located.json: millimetres within a kilometre."""


def main() -> None:
    """Write the answers beside each flight."""
    for map_path, flight_path in (DEMO_PLACE, DEMO_FLIGHT):
        with TemporaryDirectory() as cache:
            os.environ["LPN_CACHE"] = cache
            pack(map_path, flight_path, map_path.with_name(DEMO_ANSWERS), Path(cache))


def pack(map_path: Path, flight_path: Path, out: Path, cache: Path) -> None:
    """Write the answers of one flight; its registrations are read from the cache, where no error of the map is in them yet."""
    model, basemap, flight = lpn.load(DEMO_MODEL), open_map(map_path), open_flight(flight_path)
    options = LocateOptions(overlap=OFFERED_OVERLAP, matcher="sift")
    found = retrieve(model, basemap, flight, overlap=OFFERED_OVERLAP)
    described = described_windows(model, basemap, found.gallery.windows)
    frames, _ = describe_frames(model, flight.frames, found.views, "drone")
    shutil.rmtree(out, ignore_errors=True)
    windows = window_rows(found.gallery.windows, found.pixels)
    write_descriptors(out, WINDOWS, model, "satellite", windows, described, "int8")
    rows = frame_rows(flight, found.views)
    write_descriptors(out, FRAMES, model, "drone", rows, frames, "int8")
    write_record(out, model, basemap, flight)
    located = locate(basemap, flight, model, options, shipped=out)
    (records,) = (cache / "locate" / "registration").glob("*.jsonl")
    lines = [line for line in records.read_bytes().splitlines() if line]
    answers = [msgspec.json.decode(line, type=tuple[str, StageRecord])[1] for line in lines]
    named = {frame.name: answer for frame, answer in zip(flight.frames, answers, strict=True)}
    sequence = {frame.frame.name: frame.stages["sequence"] for frame in located.frames}
    write_record(out, model, basemap, flight, named, sequence)
    size = sum(file.stat().st_size for file in out.rglob("*"))
    print(f"{out}: {len(windows)} windows, {len(rows)} squares of {len(flight.frames)} frames, {size:,} bytes.")


def write_descriptors(
    folder: Path,
    name: str,
    model: Model,
    view: View,
    rows: Sequence[Row],
    described: Float32Array,
    precision: Precision,
) -> None:
    """Write the descriptors (N, n, D) of WINDOWS or FRAMES, as the model made them.

    Raises:
        StoreError: if the folder cannot be written.
    """

    def fill(partial: PartialStore) -> None:
        partial.put(range(len(rows)), described)

    write_store(folder / name, DescriptorKind.of_model(model, view, precision=precision), rows, fill)


def write_record(
    folder: Path,
    model: Model,
    basemap: Map,
    flight: Flight,
    registration: Mapping[str, StageRecord] | None = None,
    sequence: Mapping[str, StageRecord] | None = None,
) -> None:
    """Write which model, map, and photos the answers are of, and the answers of the stages, see `ShippedAnswers`.

    Numbers are rounded to six significant digits, and unknown values are left out, as the file ships with each copy.

    Raises:
        DataError: if a photo cannot be read.
        OutputError: if the folder cannot be written.
    """
    try:
        made = identity(model, basemap, flight)
    except OSError as error:
        raise DataError(f"A file of the flight cannot be read ({error.strerror or error}); check it.") from error
    record = ShippedRecord(*made, dict(registration or {}), dict(sequence or {}))
    write_atomic(folder / shipped.NAME, msgspec.json.encode(_short(msgspec.to_builtins(record))) + b"\n")


def _short(value: object) -> object:
    """Return a value of JSON with rounded numbers and without unknown values."""
    match value:
        case float():
            return float(f"{value:.{DIGITS}g}")
        case dict():
            return {key: _short(item) for key, item in value.items() if item is not None}
        case list() | tuple():
            return [_short(item) for item in value]
    return value


if __name__ == "__main__":
    main()
