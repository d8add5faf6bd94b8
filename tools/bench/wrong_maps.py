"""Flights over maps of other places, where nothing may be accepted: `python -m tools.bench.wrong_maps FOLDER [NAME ...]`.

FOLDER holds real flights as for `tools.bench.flights`; the rendered flight in `assets` is added. Each flight is located over
the maps of the other flights, and over the mirror image of its own map, which has the right land and no right place.
The maps are cut to 360 m. `--every 3` takes every third photo, `--own` adds the flight's own map, and `--changed`
adds it at 1 and 2 m a pixel and with its channels swapped, so that vegetation is red as in near infrared. Descriptors and
registrations are kept in the user's cache, so a run that was killed goes on.

`--cut SHARES` cuts the flight's own map instead, so that it ends within the flight: along a line across which these shares of
the tags stay, on each of the four sides. A photo whose tag lies beyond has no place on what is left.

`--prior METRES --draws N` lays each map N times under the tags, which keep their distances and are turned and moved at random,
and searches about them alone.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lpn
from lpn.core.arrays import BoolArray, UInt8Array
from lpn.core.errors import LPNError
from lpn.flight.files import Flight, open_flight
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.maps import Map, Window, open_map

RENDERED = "rendered"
# Largest side of a map, in metres.
SIDE = 360.0
_ASSETS = Path(__file__).parents[2] / "assets" / "demo-flight"
# Sides of the map that stay: the axis, and the sign of its direction.
_SIDES = {"west": (0, -1), "east": (0, 1), "south": (1, -1), "north": (1, 1)}
# Metres from its tag beyond which an answer is false.
_FALSE = 50.0
# Metres per pixel below which a map is read no finer.
_FINEST = 0.1


@dataclass(frozen=True)
class WrongMapRow:
    """Answers for one flight over one map: photos, accepted ones by stage, and accepted ones beyond 50 m of the tag.

    Over the map of another place all accepted answers are false, and `beyond` counts them all.
    """

    flight: str
    map: str
    photos: int
    accepted: dict[str, int]
    beyond: dict[str, int]


def open_pair(name: str, folder: Path) -> tuple[Flight, Map]:
    """Open a flight and its own map."""
    if name == RENDERED:
        return open_flight(_ASSETS / "flight-in-autumn"), open_map(_ASSETS / "map-in-spring")
    maps = (folder / name / "map.tif", folder / name / "map.jpg")
    return open_flight(folder / name / "photos"), open_map(next(file for file in maps if file.is_file()))


def cut(basemap: Map, side: float, pixel: float = 0.0) -> tuple[UInt8Array, BoolArray, float]:
    """Return the middle of a map with its pixels with data, and its metres per pixel.

    Args:
        side: largest side in metres.
        pixel: metres per pixel; by default the map's own, and at least 0.1.
    """
    west, south, east, north = basemap.bounds
    metres = pixel or max(basemap.resolution, _FINEST)
    pixels = int(min(side, max(east - west, north - south)) / metres)
    window = Window((west + east) / 2, (south + north) / 2, pixels * metres)
    picture, valid = basemap.read(window, pixels)
    return picture, valid, metres


def write_map(file: Path, picture: UInt8Array, valid: BoolArray, metres: float, middle: tuple[float, float]) -> Map:
    """Write a north-up picture about a place (latitude, longitude) as a GeoTIFF, and open it."""
    import rasterio

    height, width = picture.shape[:2]
    crs = f"+proj=aeqd +lat_0={middle[0]} +lon_0={middle[1]} +datum=WGS84 +units=m"
    place = rasterio.Affine(metres, 0, -width * metres / 2, 0, -metres, height * metres / 2)
    bands = np.dstack([picture, np.where(valid, 255, 0).astype(np.uint8)]).transpose(2, 0, 1)
    with rasterio.open(
        file, "w", driver="GTiff", width=width, height=height, count=4, dtype="uint8", crs=crs, transform=place,
        compress="deflate", photometric="RGB", alpha="YES",
    ) as out:  # fmt: skip
        out.write(bands)
    return open_map(file)


def foreign_maps(own: str, maps: dict[str, Map], side: float, folder: Path) -> Iterator[tuple[str, Map]]:
    """Yield the maps of other places, and the mirror image of a flight's own one, with their names."""
    for i, (name, basemap) in enumerate(maps.items()):
        picture, valid, metres = cut(basemap, side)
        mirrored = name == own
        if mirrored:
            picture, valid = np.ascontiguousarray(picture[:, ::-1]), np.ascontiguousarray(valid[:, ::-1])
        label = f"{name}, mirrored" if mirrored else name
        # All lie elsewhere than the flights, whose positions are left out then.
        yield label, write_map(folder / f"{own}-over-{name}.tif", picture, valid, metres, (5.0 + i, 20.0))


def changed_maps(own: Map, side: float, folder: Path) -> Iterator[tuple[str, Map]]:
    """Yield a flight's own map at coarser resolutions, and with red, green, and blue as green, red, and blue."""
    west, south, east, north = own.bounds
    latitude, longitude = (float(value) for value in own.frame.degrees([((west + east) / 2, (south + north) / 2)])[0])
    for pixel in (1.0, 2.0):
        picture, valid, metres = cut(own, side, pixel)
        yield (
            f"own, {pixel:g} m a pixel",
            write_map(folder / f"coarse-{pixel:g}.tif", picture, valid, metres, (latitude, longitude)),
        )
    picture, valid, metres = cut(own, side)
    swapped = np.ascontiguousarray(picture[..., [1, 0, 2]])
    yield "own, channels swapped", write_map(folder / "swapped.tif", swapped, valid, metres, (latitude, longitude))


def forged(flight: Flight, own: Map, basemap: Map, seed: int) -> Flight:
    """Return a flight over its own map as if it had been flown over another one: positions and headings are turned and moved.

    The positions stay on the map where it is large enough.
    """
    generator = np.random.default_rng(seed)
    angle = float(generator.uniform(0, 360))
    places = own.frame.xy(*flight.degrees.T)
    places -= np.nanmean(places, axis=0)
    sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    places = places @ np.array([[cosine, -sine], [sine, cosine]])  # clockwise, as headings are
    west, south, east, north = basemap.bounds
    room = np.maximum(np.array([east - west, north - south]) / 2 - np.nanmax(np.abs(places), axis=0), 0)
    middle = np.array([west + east, south + north]) / 2 + generator.uniform(-room, room)
    frames = [
        replace(
            frame,
            latitude=float(latitude),
            longitude=float(longitude),
            heading=None if frame.heading is None else (frame.heading + angle) % 360,
        )
        for frame, (latitude, longitude) in zip(flight.frames, basemap.frame.degrees(places + middle), strict=True)
    ]
    return replace(flight, frames=tuple(frames))


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


def row_of(located: LocatedFlight, name: str, map_name: str, frames: Sequence[LocatedFrame]) -> WrongMapRow:
    """Count the accepted answers for some frames of a flight."""
    stages = [stage for stage in located.stages if stage != "retrieval"]
    answers = {stage: [one for one in frames if one.stages[stage].accepted] for stage in stages}
    beyond = {
        stage: sum(one.tag is None or (one.error(stage) or 0.0) > _FALSE for one in accepted)
        for stage, accepted in answers.items()
    }
    return WrongMapRow(name, map_name, len(frames), {stage: len(one) for stage, one in answers.items()}, beyond)


def by_side(located: LocatedFlight, map_name: str) -> dict[str, list[LocatedFrame]]:
    """Return the frames whose tags lie on the map, and those beyond its edge."""
    west, south, east, north = located.basemap.bounds
    sides: dict[str, list[LocatedFrame]] = {f"{map_name}, on it": [], f"{map_name}, beyond": []}
    on, off = sides.values()
    for frame in located.frames:
        if frame.tag is not None:
            x, y = frame.tag
            (on if west <= x <= east and south <= y <= north else off).append(frame)
    return sides


def sentence(row: WrongMapRow) -> str:
    """Return one line of the table."""
    cells = (f"{stage} {count} ({row.beyond[stage]} beyond 50 m)" for stage, count in row.accepted.items())
    return f"{row.flight:10s} over {row.map:24s} {row.photos:3d} photos, accepted: {', '.join(cells)}"


def tried_maps(
    name: str, flight: Flight, pairs: dict[str, tuple[Flight, Map]], given: argparse.Namespace, folder: Path
) -> Iterator[tuple[Flight, str, Map]]:
    """Yield a flight, forged with a prior, with each map to locate it over and the map's name."""
    own = pairs[name][1]
    tried: list[tuple[str, Map]] = [("its own", own)] if given.own else []
    if given.cut:
        tried += cut_maps(flight, own, given.cut, tuple(_SIDES), folder)
    else:
        below = {other: pairs[other][1] for other in given.over or pairs}
        tried = [*foreign_maps(name, below, SIDE, folder), *tried]
    if given.changed:
        tried += changed_maps(own, SIDE, folder)
    if given.prior is None:
        yield from ((flight, *one) for one in tried)
        return
    for seed in range(given.draws):
        for map_name, basemap in tried:
            yield forged(flight, own, basemap, seed), f"{map_name}, draw {seed}", basemap


def main() -> None:
    """Measure the flights that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=os.environ.get("LPN_FLIGHTS"))
    parser.add_argument("names", nargs="*", default=["brighton", "caliterra", "seneca", RENDERED])
    parser.add_argument("--over", nargs="*", help="maps to lay below, by their flights; all by default")
    parser.add_argument("--cut", nargs="*", type=float, help="shares of the tags that parts of the own map keep")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--own", action="store_true")
    parser.add_argument("--changed", action="store_true")
    parser.add_argument("--prior", type=float)
    parser.add_argument("--draws", type=int, default=10)
    given = parser.parse_args()
    if given.folder is None:
        raise SystemExit("There is no folder of flights; give one, or set LPN_FLIGHTS.")
    options = LocateOptions(prior=given.prior)
    model = None if given.model is None else lpn.load(given.model)
    others = [] if given.cut else given.over or ["brighton", "caliterra", "seneca", RENDERED]
    pairs = {name: open_pair(name, Path(given.folder)) for name in dict.fromkeys([*given.names, *others])}
    with tempfile.TemporaryDirectory() as temporary:
        for name in given.names:
            flight = pairs[name][0]
            flight = replace(flight, name=name, frames=flight.frames[:: given.every])
            folder = Path(temporary) / name
            folder.mkdir()
            for drawn, map_name, basemap in tried_maps(name, flight, pairs, given, folder):
                try:
                    located = locate(basemap, drawn, model, options)
                except LPNError as error:  # a map smaller than a window
                    print(f"{name:10s} over {map_name:24s} {error}", flush=True)
                    continue
                sides = by_side(located, map_name) if given.cut else {map_name: located.frames}
                for where, frames in sides.items():
                    print(sentence(row_of(located, name, where, frames)), flush=True)


if __name__ == "__main__":
    main()
