"""All pictures of a world before they are rendered, with path, camera, and place, and the files that describe them.

world.json   the plan, and the camera of each picture
geo.csv      the position that each picture shows, in the format of `lpn.datasets.geo`, with the drone's pose and the tile's
             width
cvusa/       panoramas and their tiles, with files of their own, see `lpn.world.cvusa`
"""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from lpn.core.formats import WORLD
from lpn.world import cvusa
from lpn.world.cameras import Panorama, Pose, Site, Tile, any_drone_poses, drone_poses, tile_around
from lpn.world.city import City, Target
from lpn.world.factors import Factor
from lpn.world.ground_level import GroundLevel, panoramas, street_poses
from lpn.world.ground_use import ground_csv
from lpn.world.plan import plan_city

EDITION = 2  # counts changes of the code that change the pictures of a seed
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
        streets: street-level pictures of each building.
        panoramas: panoramas near each building.
        vary: properties that are drawn at random, see `lpn.world.factors`; in the order of `FACTORS`.
    """

    seed: int
    buildings: int
    views: int
    pixels: int
    tile_pixels: int
    samples: int
    streets: int = 0
    panoramas: int = 0
    vary: tuple[Factor, ...] = ()


RenderedView = Literal["satellite", "drone", "street", "panorama"]


@dataclass(frozen=True)
class PlannedPicture:
    """A picture to be rendered; a test picture has two paths, as query and in the gallery."""

    paths: tuple[str, ...]
    target: int
    view: RenderedView
    camera: Pose | Tile | Panorama


@dataclass(frozen=True)
class Sector:
    """Neighbouring targets, rendered from one scene.

    Attributes:
        x, y: middle of the square around its targets.
        reach: half its side.
        district: determines the weather.
        tiles: satellite tiles, those of panoramas last.
        frames: drone pictures.
        walks: pictures from the ground.
    """

    number: int
    x: float
    y: float
    reach: float
    district: int
    tiles: tuple[PlannedPicture, ...]
    frames: tuple[PlannedPicture, ...]
    walks: tuple[PlannedPicture, ...]

    @property
    def shots(self) -> tuple[PlannedPicture, ...]:
        """All pictures of the sector."""
        return *self.tiles, *self.frames, *self.walks

    def covers(self, places: Float64Array) -> NDArray[np.bool_]:
        """Return for which places (n, 2) the satellite image contains a north-up tile around them."""
        return _covers(self.x, self.y, self.reach, places)


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
            "districts": [
                {
                    "number": d.number,
                    "name": d.name,
                    "character": d.character,
                    "split": d.split,
                    "polygon": _ring(d.polygon),
                }
                for d in city.districts
            ],
            "buildings": [self._building(target) for target in city.targets],
            "pictures": [self._picture(path, shot) for shot in self.shots for path in shot.paths],
        }
        return (json.dumps(values, indent=1) + "\n").encode()

    def geo_csv(self) -> bytes:
        """Encode geo.csv: the positions that pictures show."""
        return self._geo([(path, shot) for shot in self.shots if not _of_cvusa(shot) for path in shot.paths])

    def ground_csv(self) -> bytes:
        """Encode ground.csv: the uses of the ground in the tiles."""
        tiles = [(path, shot.camera) for shot in self.shots if not _of_cvusa(shot) for path in shot.paths]
        return ground_csv(self.city, [(path, tile) for path, tile in tiles if isinstance(tile, Tile)])

    def cvusa_files(self) -> dict[str, bytes]:
        """Return the text files of CVUSA's layout by path; none without panoramas."""
        shots = {shot.paths[0]: shot for shot in self.shots if _of_cvusa(shot)}
        if not shots:
            return {}
        pairs = [
            (target.split, cvusa.tile_path(target.number, i), cvusa.panorama_path(target.number, i))
            for target in self.city.targets
            for i in range(self.settings.panoramas)
        ]
        rows = [(path.removeprefix(f"{cvusa.FOLDER}/"), shots[path]) for _, *both in pairs for path in both]
        return {f"{cvusa.FOLDER}/geo.csv": self._geo(rows), **cvusa.splits(pairs)}

    def _geo(self, rows: list[tuple[str, PlannedPicture]]) -> bytes:
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["path", "latitude", "longitude", "altitude", "heading", "tilt", "fov", "width"])
        targets = {target.number: target for target in self.city.targets}
        for path, shot in rows:
            camera = shot.camera
            x, y, z = camera.x, camera.y, 0.0
            if isinstance(camera, Pose):
                x, y, z = _aim(self.city, targets[shot.target])
            if isinstance(camera, Tile):
                pose = ["", f"{camera.heading % 360:.1f}", "", "", f"{camera.size:g}"]
            elif isinstance(camera, Panorama):
                pose = ["", "0.0", "", "", ""]
            elif shot.view == "street":  # altitude and tilt are those of cameras that look down
                pose = ["", f"{camera.heading % 360:.1f}", "", f"{camera.fov:.1f}", ""]
            else:
                pose = [
                    f"{camera.z - z:.1f}",
                    f"{camera.heading % 360:.1f}",
                    f"{camera.tilt:.4g}",
                    f"{camera.fov:.4g}",
                    "",
                ]
            latitude, longitude = self.site.degrees(x, y)
            table.writerow([path, f"{latitude:.7f}", f"{longitude:.7f}", *pose])
        return text.getvalue().encode()

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
    city = plan_city(settings.seed, settings.buildings, "plan" in settings.vary)
    groups: dict[int, list[Target]] = defaultdict(list)
    for target in city.targets:
        groups[city.buildings[target.building].district].append(target)
    squares: dict[int, tuple[float, float, float]] = {}
    for district, members in groups.items():
        places = np.array([[city.buildings[t.building].x, city.buildings[t.building].y] for t in members])
        low, high = places.min(axis=0), places.max(axis=0)
        x, y = ((low + high) / 2).tolist()
        squares[district] = x, y, float((high - low).max() / 2)

    def covered(target: Target, places: Float64Array) -> NDArray[np.bool_]:
        return _covers(*squares[city.buildings[target.building].district], places)

    outdoors = GroundLevel(city)
    around = panoramas(outdoors, city, settings.panoramas, covered)
    sectors = []
    for number, district in enumerate(sorted(groups)):
        members = groups[district]
        centred = [_centred(target, i, at) for target in members for i, at in enumerate(around[target.number])]
        tiles = (*(_tile(city, target) for target in members), *centred)
        frames = tuple(shot for target in members for shot in _frames(city, target, settings))
        walks = tuple(
            shot
            for target in members
            for shot in (
                *_streets(outdoors, city, target, settings.streets),
                *_panoramas(target, around[target.number]),
            )
        )
        sectors.append(Sector(number, *squares[district], district, tiles, frames, walks))
    return Atlas(settings, Site(), city, tuple(sectors))


def _covers(x: float, y: float, reach: float, places: Float64Array) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = np.abs(places - (x, y)).max(axis=1) < reach + SPARE - 1
    return inside


def _of_cvusa(shot: PlannedPicture) -> bool:
    return shot.paths[0].startswith(f"{cvusa.FOLDER}/")


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


def _streets(outdoors: GroundLevel, city: City, target: Target, count: int) -> list[PlannedPicture]:
    return [
        PlannedPicture(_paths(target, "street", f"image-{i + 1:02d}.jpg"), target.number, "street", pose)
        for i, pose in enumerate(street_poses(outdoors, city, target, count))
    ]


def _panoramas(target: Target, cameras: list[Panorama]) -> list[PlannedPicture]:
    return [
        PlannedPicture((cvusa.panorama_path(target.number, i),), target.number, "panorama", camera)
        for i, camera in enumerate(cameras)
    ]


def _centred(target: Target, number: int, at: Panorama) -> PlannedPicture:
    """Make the tile with a panorama's camera in its middle."""
    return PlannedPicture((cvusa.tile_path(target.number, number),), target.number, "satellite", Tile(at.x, at.y, 0.0))


def _aim(city: City, target: Target) -> tuple[float, float, float]:
    """Return the point on a building that its drone looks at."""
    b = city.buildings[target.building]
    return b.x, b.y, city.height(b.x, b.y) + _AIM * city.architectures[b.architecture].height
