"""Flights that leave their map, which is cut so that it ends within them: `python -m tools.bench.cut_maps FOLDER [NAME ...]`.

FOLDER holds real flights as for `tools.bench.flights`; the rendered flight in `assets` is added. Each map is cut along a line
across which a share of the flight's tags stays, by default half, on each of the four sides. A photo whose tag
lies beyond has no place on what is left. `--whole` adds the whole map. Descriptors and registrations are kept in the user's
cache, so a run that was killed goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import lpn
from lpn.core.errors import LPNError
from lpn.core.files import write_atomic
from lpn.flights import Flight
from lpn.locate.located import LocatedFlight
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.maps import Map
from tools.bench.wrong_maps import RENDERED, cut, open_pair, write_map

# Sides of the map that stay: the axis, and the sign of its direction.
_SIDES = {"west": (0, -1), "east": (0, 1), "south": (1, -1), "north": (1, 1)}
# Metres from its tag beyond which an answer is false.
_FALSE = 50.0


@dataclass(frozen=True)
class CutMapRow:
    """Answers for one flight over a part of its map.

    Attributes:
        on, off: photos whose tags lie on the map and beyond its edge.
        accepted: photos that a stage places, on the map and beyond its edge.
        false: of these, those more than 50 m from their tags.
        notes: of the run.
    """

    flight: str
    map: str
    on: int
    off: int
    accepted: dict[str, tuple[int, int]]
    false: dict[str, tuple[int, int]]
    notes: list[str]


def cut_maps(
    flight: Flight, own: Map, shares: Sequence[float], sides: Sequence[str], folder: Path
) -> Iterator[tuple[str, Map]]:
    """Yield parts of a map on which these shares of the flight's tags lie, on each of these sides, with their names."""
    picture, valid, metres = cut(own, np.inf)
    west, south, east, north = own.bounds
    middle = np.array([west + east, south + north]) / 2
    west, south, east, north = np.array(own.bounds) - np.tile(middle, 2)
    half = len(picture) * metres / 2
    tags = own.frame.xy(*flight.degrees.T) - middle
    for share in shares:
        for side in sides:
            axis, sign = _SIDES[side]
            edge = float(np.nanquantile(sign * tags[:, axis], 1 - share)) * sign
            box = [west, south, east, north]
            box[axis if sign > 0 else axis + 2] = edge
            columns = slice(*(round((x + half) / metres) for x in (box[0], box[2])))
            rows = slice(*(round((half - y) / metres) for y in (box[3], box[1])))
            place = middle + np.array([box[0] + box[2], box[1] + box[3]]) / 2
            latitude, longitude = own.frame.degrees([place])[0].tolist()
            name = f"{side} {share:.2f}"
            file = folder / f"{side}-{share:.2f}.tif"
            yield name, write_map(file, picture[rows, columns], valid[rows, columns], metres, (latitude, longitude))


def row_of(located: LocatedFlight, map_name: str) -> CutMapRow:
    """Count the answers for a flight."""
    west, south, east, north = located.basemap.bounds
    tagged = [(frame, frame.tag) for frame in located.frames if frame.tag is not None]
    beyond = [not (west <= x <= east and south <= y <= north) for _, (x, y) in tagged]
    accepted, false = {}, {}
    for stage in ("sequence", "registration"):
        placed = [(off, frame) for off, (frame, _) in zip(beyond, tagged, strict=True)]
        placed = [(off, one) for off, one in placed if stage in one.stages and one.stages[stage].accepted]
        wrong = [off for off, frame in placed if (frame.error(stage) or 0.0) > _FALSE]
        offs = [off for off, _ in placed]
        accepted[stage] = len(offs) - sum(offs), sum(offs)
        false[stage] = len(wrong) - sum(wrong), sum(wrong)
    return CutMapRow(
        located.flight.name, map_name, len(beyond) - sum(beyond), sum(beyond), accepted, false, located.notes
    )


def sentence(row: CutMapRow) -> str:
    """Return one line of the table."""
    cells = (
        f"{stage} {on} + {off}, false {row.false[stage][0]} + {row.false[stage][1]}"
        for stage, (on, off) in row.accepted.items()
    )
    return f"{row.flight:10s} {row.map:10s} photos on the map {row.on} + {row.off} beyond; accepted: {'; '.join(cells)}"


def main() -> None:
    """Measure the flights that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=os.environ.get("LPN_FLIGHTS"))
    parser.add_argument("names", nargs="*", default=["brighton", "caliterra", "seneca", RENDERED])
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--shares", nargs="*", type=float, default=[0.5])
    parser.add_argument("--sides", nargs="*", choices=tuple(_SIDES), default=tuple(_SIDES))
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--no-register", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.folder is None:
        raise SystemExit("There is no folder of flights; give one, or set LPN_FLIGHTS.")
    model, options = lpn.load(given.model), LocateOptions(register=not given.no_register)
    rows: list[CutMapRow] = []
    for name in given.names:
        flight, own = open_pair(name, Path(given.folder))
        flight = replace(flight, name=name)
        with tempfile.TemporaryDirectory() as folder:
            whole = [("whole", own)] if given.whole else []
            for map_name, basemap in [*whole, *cut_maps(flight, own, given.shares, given.sides, Path(folder))]:
                try:
                    located = locate(basemap, flight, model, options)
                except LPNError as error:  # a map smaller than a window
                    print(f"{name:10s} {map_name:10s} {error}", flush=True)
                    continue
                rows.append(row_of(located, map_name))
                print(sentence(rows[-1]), flush=True)
                if given.json is not None:
                    write_atomic(given.json, (json.dumps([asdict(row) for row in rows], indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
