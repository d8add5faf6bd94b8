"""Makes the answers of the demo's model for both flights of the demo: `python assets/pack_answers.py`.

They are computed as `lpn explore` computes them where no answers ship, in an empty cache. SIFT registers the photos, as it
needs no further package.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

import lpn
from explorer.opening import OFFERED_OVERLAP
from lpn.core.demo import DEMO_ANSWERS, DEMO_FLIGHT, DEMO_MODEL, DEMO_PLACE
from lpn.flights import open_flight
from lpn.locate.located import LocatedFlight, StageRecord
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.locate.registered_stage import FORMAT
from lpn.locate.retrieval import retrieve
from lpn.locate.shipped import FRAMES, WINDOWS, frame_rows, window_rows, write_descriptors, write_record
from lpn.maps import open_map


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
    plain = retrieve(model, basemap, flight, overlap=OFFERED_OVERLAP, centre=False)
    shutil.rmtree(out, ignore_errors=True)
    frames = np.concatenate([described for described in plain.frames_described if described is not None])
    windows = window_rows(plain.windows, plain.pixels)
    write_descriptors(out, WINDOWS, model, "satellite", windows, plain.windows_described, "int8")
    rows = frame_rows(flight, plain.headings, plain.cut_shares)
    write_descriptors(out, FRAMES, model, "drone", rows, frames, "int8")
    write_record(out, FORMAT, model, basemap, flight)
    located = locate(basemap, flight, model, options, shipped=out)
    (records,) = (cache / "locate" / "registration").glob("*.jsonl")
    lines = [line for line in records.read_bytes().splitlines() if line]
    answers = [msgspec.json.decode(line, type=tuple[str, StageRecord])[1] for line in lines]
    named = {frame.name: answer for frame, answer in zip(flight.frames, answers, strict=True)}
    sequence = {frame.frame.name: frame.stages["sequence"] for frame in located.frames}
    write_record(out, FORMAT, model, basemap, flight, named, sequence, sequence_notes(located))
    size = sum(file.stat().st_size for file in out.rglob("*"))
    print(f"{out}: {len(windows)} windows, {len(rows)} squares of {len(flight.frames)} frames, {size:,} bytes.")


def sequence_notes(located: LocatedFlight) -> list[str]:
    """Return the sentences of a located flight that are about its sequence."""
    return [note for note in located.notes if note.startswith("The scores are more probable")]


if __name__ == "__main__":
    main()
