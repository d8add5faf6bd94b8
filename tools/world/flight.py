"""Building a rendered flight: plan it, then render missing pictures and the map.

flight_world.json  settings, middle, errors of the tags
truth.csv          where each camera was
photos/            the pictures of both paths
map/map.tif        the map
map/elevation.tif  heights of the ground and of what stands on it, in metres of the plan
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lpn.core.errors import InputError, OutputError
from lpn.core.files import check_writable, write_atomic
from lpn.datasets.rendered import FLIGHT_PLAN, PLAN, TRUTH, UNFINISHED
from tools.world import flight_files, photo
from tools.world.cameras import SatelliteImage, Site
from tools.world.flight_plan import MAP_SIDE, TAG_ERRORS, FlightPicture, FlightPlan, plan_flight
from tools.world.jobs import EDITION, check_folder, check_limits, progress
from tools.world.plan import plan_city

if TYPE_CHECKING:
    from tools.world.city import City
    from tools.world.render import BlenderScene

FORMAT = "lpn-world-flight/1"
MAP, ELEVATION = Path("map/map.tif"), Path("map/elevation.tif")
_SPARE = 25.0  # metres around the map whose things may be seen, or throw shadows
_ELEVATION_PIXEL = 0.5  # metres
_LIMITS = {"frames": (2, 5000), "width": (64, 4096), "samples": (1, 4096), "map_pixel": (0.15, 2.0)}


@dataclass(frozen=True)
class FlightSettings:
    """The settings that determine a rendered flight.

    Attributes:
        seed, buildings: of the city, as for a world.
        frames: pictures of both paths.
        width: of a picture, in pixels; its height is three quarters of it.
        samples: light paths per pixel.
        map_pixel: metres a pixel of the map.
    """

    seed: int
    buildings: int
    frames: int
    width: int
    samples: int
    map_pixel: float


def build_flight(settings: FlightSettings, out: Path, threads: int = 0) -> int:
    """Render the missing photos and maps of a flight, and return their number.

    An interrupted run can be continued.

    Raises:
        InputError: when the settings are invalid.
        OutputError: when `out` cannot be written, or holds a world or a flight with other settings.
        ModuleNotFoundError: when Blender or rasterio is needed and missing.
    """
    import_module("rasterio")  # before an hour of rendering
    check_limits(settings, _LIMITS)
    if settings.width % 4:
        raise InputError(f"--width is {settings.width}; expected a multiple of 4, as pictures are 4:3.")
    if (out / PLAN).is_file():
        raise OutputError(f"{out} holds a world; choose another folder for the flight.")
    check_folder(settings, out / FLIGHT_PLAN, FORMAT)
    if not (out / FLIGHT_PLAN).is_file() or (out / UNFINISHED).is_file():
        import_module("tools.world.render")  # asks for bpy before anything is planned
    check_writable(out / FLIGHT_PLAN)
    city, site = plan_city(settings.seed, settings.buildings), Site()
    plan = plan_flight(city, site, settings.frames)
    missing = [i for i, picture in enumerate(plan.pictures) if not _photo(out, picture).is_file()]
    maps = [file for file in (MAP, ELEVATION) if not (out / file).is_file()]
    if missing or maps:
        write_atomic(out / UNFINISHED, b"Files are missing here; the same command goes on.\n")
    write_atomic(out / FLIGHT_PLAN, _settings_json(settings, plan, site))
    write_atomic(out / TRUTH, plan.truth_csv(city, site))
    if missing or maps:
        _render(settings, city, site, plan, missing, maps, out, threads)
    (out / UNFINISHED).unlink(missing_ok=True)
    return len(missing) + len(maps)


def _render(
    settings: FlightSettings, city: City, site: Site, plan: FlightPlan, missing: list[int], maps: list[Path],
    out: Path, threads: int,
) -> None:  # fmt: skip
    """Render the maps that are missing, then the photos of these numbers."""
    from tools.world import render

    with progress(len(missing) + len(maps)) as (folder, advance):

        def scene(look: photo.Look) -> BlenderScene:
            side = MAP_SIDE + 2 * _SPARE
            return render.BlenderScene(city, plan.x, plan.y, side, look, settings.samples, folder, threads)

        if maps:
            look = photo.map_look(settings.seed)
            made = scene(look)
            for file in maps:
                data = _map(settings, site, plan, made, look) if file == MAP else _elevation(site, plan, made)
                write_atomic(out / file, data)
                advance()
        if missing:
            day = photo.flight_look(settings.seed)
            made = scene(day)
            for number in missing:
                picture = plan.pictures[number]
                rng = np.random.default_rng([settings.seed, 73, number])
                look = replace(day, exposure=day.exposure * float(rng.normal(1, 0.03)))
                light = made.frame(picture.pose, settings.width, settings.width * 3 // 4)
                write_atomic(_photo(out, picture), flight_files.photo_bytes(picture, photo.develop(light, look, rng)))
                advance()


def _map(settings: FlightSettings, site: Site, plan: FlightPlan, scene: BlenderScene, look: photo.Look) -> bytes:
    """Render the map as an orthophoto: buildings stand upright, and roofs lie where they are."""
    grid = flight_files.MapGrid(site, plan.x, plan.y, MAP_SIDE, settings.map_pixel)
    sweep = _sweep(plan, settings.map_pixel)
    light = np.maximum(grid.cut(scene.sweep(sweep), sweep, cv2.INTER_CUBIC), 0)
    return grid.geotiff(photo.develop(light, look, np.random.default_rng([settings.seed, 72])))


def _elevation(site: Site, plan: FlightPlan, scene: BlenderScene) -> bytes:
    """Measure the heights of the map's day, with leaves and parked cars, on a grid of its own."""
    grid = flight_files.MapGrid(site, plan.x, plan.y, MAP_SIDE, _ELEVATION_PIXEL)
    sweep = _sweep(plan, _ELEVATION_PIXEL)
    heights = grid.cut(scene.heights(sweep)[..., None], sweep, cv2.INTER_LINEAR)
    return grid.elevation(heights[..., 0])


def _sweep(plan: FlightPlan, pixel: float) -> SatelliteImage:
    """Return the orthographic picture that holds the map; the zone's grid is turned by up to some degrees."""
    size = MAP_SIDE + 2 * _SPARE
    return SatelliteImage(plan.x, plan.y, plan.ground, size, round(size / pixel), 0.0, 0.0)


def _photo(out: Path, picture: FlightPicture) -> Path:
    return out / "photos" / picture.name


def _settings_json(settings: FlightSettings, plan: FlightPlan, site: Site) -> bytes:
    values = {
        "format": FORMAT, "edition": EDITION, "settings": asdict(settings), "site": asdict(site),
        "middle": {"x": round(plan.x, 3), "y": round(plan.y, 3), "ground": round(plan.ground, 3)},
        "tag errors": asdict(TAG_ERRORS),
    }  # fmt: skip
    return (json.dumps(values, indent=1) + "\n").encode()
