"""Flights and maps for measures: real ones, the shipped rendered one, and maps and tags that do not belong to a flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lpn.core.arrays import BoolArray, UInt8Array
from lpn.core.demo import DEMO_FLIGHT
from lpn.flight.files import Flight, open_flight
from lpn.flight.maps import Map, Window, open_map

RENDERED = "rendered"
# Largest side of a map, in metres.
SIDE = 360.0
# Metres per pixel below which a map is read no finer.
_FINEST = 0.1


def open_pair(name: str, folder: Path) -> tuple[Flight, Map]:
    """Open a flight and its own map."""
    if name == RENDERED:
        return open_flight(DEMO_FLIGHT[1]), open_map(DEMO_FLIGHT[0])
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
