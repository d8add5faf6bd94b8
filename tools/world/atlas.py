"""All pictures of a world before they are rendered, with path, camera, and place, and the files that describe them.

world.json   the plan, and the camera of each picture
geo.csv      the position that each picture shows, in the format of `lpn.datasets.geo`, with the drone's pose and the tile's
             width
"""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from lpn.core.formats import WORLD
from tools.world.cameras import Factor, Pose, Site, Tile, any_drone_poses, drone_poses, tile_around
from tools.world.city import City, Target
from tools.world.jobs import EDITION
from tools.world.plan import plan_city

SIGHT = 312.0  # metres around a target that its drone can see, at most
SPARE = 14.0  # metres around the tiles' ground, for their turn and offset
_AIM = 0.4  # share of the building's height that the drone looks at


@dataclass(frozen=True)
class Settings:
    """The settings that determine every pixel of a world.

    Attributes:
        seed, buildings: of the plan.
        views: drone pictures of each building, the last of them from straight above.
        pixels, tile_pixels: side lengths of a drone picture and of a satellite tile.
        samples: light paths per pixel.
        vary: properties that are drawn at random, in alphabetic order.
    """

    seed: int
    buildings: int
    views: int
    pixels: int
    tile_pixels: int
    samples: int
    vary: tuple[Factor, ...] = ()


RenderedView = Literal["satellite", "drone"]


@dataclass(frozen=True)
class PlannedPicture:
    """A picture to be rendered; a test picture has two paths, as query and in the gallery."""

    paths: tuple[str, ...]
    target: int
    view: RenderedView
    camera: Pose | Tile


@dataclass(frozen=True)
class Sector:
    """Neighbouring targets, rendered from one scene.

    Attributes:
        x, y: middle of the square around its targets.
        reach: half its side.
        district: determines the weather.
        tiles: satellite tiles.
        frames: drone pictures.
    """

    number: int
    x: float
    y: float
    reach: float
    district: int
    tiles: tuple[PlannedPicture, ...]
    frames: tuple[PlannedPicture, ...]

    @property
    def shots(self) -> tuple[PlannedPicture, ...]:
        """All pictures of the sector."""
        return *self.tiles, *self.frames


@dataclass(frozen=True)
class Atlas:
    """The plan of a world and all its pictures."""

    settings: Settings
    site: Site
    city: City
    sectors: tuple[Sector, ...]

    @property
    def shots(self) -> list[PlannedPicture]:
        """All pictures, in order of place."""
        shots = [shot for sector in self.sectors for shot in sector.shots]
        return sorted(shots, key=lambda shot: (shot.target, shot.paths))

    def world_json(self) -> bytes:
        """Encode world.json."""
        city, site = self.city, self.site
        values = {
            "format": WORLD,
            "edition": EDITION,
            "settings": asdict(self.settings),
            "site": {**asdict(site), "note": "A fictional place; the plan's metres are x east and y north of it."},
            "districts": [{**vars(d), "polygon": _ring(d.polygon)} for d in city.districts],
            "buildings": [self._building(target) for target in city.targets],
            "pictures": [self._picture(path, shot) for path, shot in self._by_path()],
        }
        return (json.dumps(values, indent=1) + "\n").encode()

    def geo_csv(self) -> bytes:
        """Encode geo.csv: the positions that pictures show."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["path", "latitude", "longitude", "altitude", "heading", "tilt", "fov", "width"])
        targets = {target.number: target for target in self.city.targets}
        for path, shot in self._by_path():
            camera = shot.camera
            if isinstance(camera, Tile):
                x, y = camera.x, camera.y
                pose = ["", f"{camera.heading % 360:.1f}", "", "", f"{camera.size:g}"]
            else:
                x, y, z = _aim(self.city, targets[shot.target])
                angles = [f"{camera.heading % 360:.1f}", f"{camera.tilt:.4g}", f"{camera.fov:.4g}"]
                pose = [f"{camera.z - z:.1f}", *angles, ""]
            latitude, longitude = self.site.degrees(x, y)
            table.writerow([path, f"{latitude:.7f}", f"{longitude:.7f}", *pose])
        return text.getvalue().encode()

    def _by_path(self) -> list[tuple[str, PlannedPicture]]:
        return [(path, shot) for shot in self.shots for path in shot.paths]

    def _building(self, target: Target) -> dict[str, Any]:
        city = self.city
        building = city.buildings[target.building]
        look = city.architectures[building.architecture]
        latitude, longitude = self.site.degrees(building.x, building.y)
        return {
            "id": target.number,
            "split": target.split,
            "district": building.district,
            "kind": look.kind,
            "twins": target.twins or None,
            "latitude": round(latitude, 7),
            "longitude": round(longitude, 7),
            "x": round(building.x, 2),
            "y": round(building.y, 2),
            "ground": round(city.height(building.x, building.y), 2),
            "height": round(look.height, 2),
            "footprint": _ring(city.footprint(building)),
        }

    def _picture(self, path: str, shot: PlannedPicture) -> dict[str, Any]:
        camera = shot.camera
        latitude, longitude = self.site.degrees(camera.x, camera.y)
        place = {"path": path, "id": shot.target, "latitude": round(latitude, 7), "longitude": round(longitude, 7)}
        pose = {key: round(value, 3) for key, value in asdict(camera).items()}
        return {**place, "view": shot.view, **pose}


def _ring(points: Any) -> list[list[float]]:
    return [[round(float(x), 2), round(float(y), 2)] for x, y in points]


def make_atlas(settings: Settings) -> Atlas:
    """Plan a world and all its pictures.

    Raises:
        InputError: when no city can be planned with these settings.
    """
    city = plan_city(settings.seed, settings.buildings)
    groups: dict[int, list[Target]] = defaultdict(list)
    for target in city.targets:
        groups[city.buildings[target.building].district].append(target)
    sectors = []
    for number, district in enumerate(sorted(groups)):
        members = groups[district]
        places = np.array([[city.buildings[t.building].x, city.buildings[t.building].y] for t in members])
        low, high = places.min(axis=0), places.max(axis=0)
        x, y = ((low + high) / 2).tolist()
        tiles = tuple(_tile(city, target) for target in members)
        frames = tuple(shot for target in members for shot in _frames(city, target, settings))
        sectors.append(Sector(number, x, y, float((high - low).max() / 2), district, tiles, frames))
    return Atlas(settings, Site(), city, tuple(sectors))


def _paths(target: Target, view: str, name: str) -> tuple[str, ...]:
    folders = [f"train/{view}"] if target.split == "train" else [f"test/query_{view}", f"test/gallery_{view}"]
    return tuple(f"{folder}/{target.number:04d}/{name}" for folder in folders)


def _tile(city: City, target: Target) -> PlannedPicture:
    b = city.buildings[target.building]
    rng = np.random.default_rng([city.seed, 22, target.number])
    paths = _paths(target, "satellite", f"{target.number:04d}.jpg")
    return PlannedPicture(paths, target.number, "satellite", tile_around(b.x, b.y, rng))


def _frames(city: City, target: Target, settings: Settings) -> list[PlannedPicture]:
    rng = np.random.default_rng([city.seed, 23, target.number])
    aim = _aim(city, target)
    poses = (
        any_drone_poses(aim, settings.views, SIGHT, rng)
        if "poses" in settings.vary
        else drone_poses(aim, settings.views, rng)
    )
    return [
        PlannedPicture(_paths(target, "drone", f"image-{i + 1:02d}.jpg"), target.number, "drone", pose)
        for i, pose in enumerate(poses)
    ]


def _aim(city: City, target: Target) -> tuple[float, float, float]:
    """Return the point on a building that its drone looks at."""
    b = city.buildings[target.building]
    return b.x, b.y, city.height(b.x, b.y) + _AIM * city.architectures[b.architecture].height
