"""Write a world: plan it, render what is not there yet, sector by sector."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lpn import city
from lpn.errors import InputError, OutputError
from lpn.files import check_writable, write_whole
from lpn.world import photo
from lpn.world.atlas import EDITION, SIGHT, Atlas, Sector, Settings, Shot, make_atlas
from lpn.world.cameras import TILE, Pose, Sweep, Tile
from lpn.world.model3d import city_model, test_window
from lpn.world.textures import hash_of

if TYPE_CHECKING:
    from lpn.world.render import Scene

_QUALITY = 88
_SPARE = 14.0  # metres around the tiles' ground, for their turn and offset


@dataclass(frozen=True)
class Part:
    """Which share of the sectors one process renders: the `number`-th of `count`, from 1."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Part:
        """Read `i/k`.

        Raises:
            InputError: when it is something else.
        """
        try:
            number, count = (int(item) for item in text.split("/"))
        except ValueError as error:
            raise InputError(f"The part is {text!r}; expected i/k, such as 1/4.") from error
        if not 1 <= number <= count:
            raise InputError(f"The part is {text!r}; expected i/k with i from 1 to k.")
        return cls(number, count)


@dataclass
class Tally:
    """Pictures made and seconds spent, by step."""

    scenes: int = 0
    scene_seconds: float = 0.0
    sweeps: int = 0
    sweep_seconds: float = 0.0
    frames: int = 0
    frame_seconds: float = 0.0

    def describe(self) -> str:
        """One sentence for the console."""
        if not self.frames and not self.sweeps:
            return "Every picture was there already."
        frame = f"{self.frame_seconds / self.frames:.2f} s a drone picture" if self.frames else "no drone pictures"
        sweep = f", {self.sweep_seconds / self.sweeps:.0f} s a satellite sector" if self.sweeps else ""
        scene = f"{self.scene_seconds / max(1, self.scenes):.0f} s a scene"
        return f"Made {self.frames} drone pictures and {self.sweeps} satellite sectors: {frame}{sweep}, {scene}."


def build_world(settings: Settings, out: Path, part: Part | None = None, threads: int = 0) -> Tally:
    """Render a world into University-1652's layout; pictures that are there are kept, so that a killed run goes on.

    Raises:
        InputError: when the settings make no world.
        OutputError: when `out` cannot be written, or holds a world made with other settings.
    """
    from lpn.world import render  # asks for bpy before anything is planned

    part = part or Part()
    _check(settings)
    check_folder(settings, out)
    check_writable(out / "world.json")
    atlas = make_atlas(settings)
    write_whole(out / "world.json", atlas.world_json())
    write_whole(out / "geo.csv", atlas.geo_csv())
    if part.number == 1:  # parts that run at the same time need not all make it
        write_whole(out / city.NAME, city_model(atlas.city, atlas.site, test_window(atlas)))
    mine = [sector for sector in atlas.sectors if sector.number % part.count == part.number - 1]
    tally = Tally()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        render.quiet() as stream,
        Progress(*columns, console=Console(file=stream)) as bar,
        render.workplace() as folder,
    ):
        total = sum(len(sector.tiles) + len(sector.frames) for sector in mine)
        task = bar.add_task("Rendering", total=total)
        for sector in mine:
            tiles = [shot for shot in sector.tiles if not _there(out, shot)]
            frames = [shot for shot in sector.frames if not _there(out, shot)]
            bar.advance(task, len(sector.tiles) + len(sector.frames) - len(tiles) - len(frames))

            def scene(look: photo.Look, reach: float, sector: Sector = sector) -> Scene:
                start = time.perf_counter()
                made = render.Scene(atlas.city, sector.x, sector.y, 2 * reach, look, settings.samples, folder, threads)
                tally.scenes += 1
                tally.scene_seconds += time.perf_counter() - start
                return made

            def done() -> None:
                bar.advance(task)

            if tiles:
                _tiles(atlas, sector, tiles, out, scene, tally, done)
            if frames:
                _frames(atlas, sector, frames, out, scene, tally, done)
    return tally


MakeScene = Callable[[photo.Look, float], "Scene"]


def _tiles(atlas: Atlas, sector: Sector, shots: list[Shot], out: Path, scene: MakeScene, tally: Tally,
           done: Callable[[], None]) -> None:  # fmt: skip
    settings = atlas.settings
    look = photo.satellite_look(settings.seed, sector.district)
    reach = sector.reach + TILE / 2 + _SPARE
    pixels = round(2 * reach * settings.tile_pixels / TILE)
    rng = np.random.default_rng([settings.seed, 31, sector.number])
    height = atlas.city.height(sector.x, sector.y)
    sweep = Sweep(sector.x, sector.y, height, 2 * reach, pixels, float(rng.uniform(1, 7)), float(rng.uniform(0, 360)))
    made = scene(look, reach + 40)
    start = time.perf_counter()
    light = made.sweep(sweep)
    tally.sweeps += 1
    tally.sweep_seconds += time.perf_counter() - start
    side = settings.tile_pixels
    corners = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32) - 0.5
    for shot in shots:
        assert isinstance(shot.camera, Tile)
        at = (sweep.corners(shot.camera) - 0.5).astype(np.float32)
        matrix = cv2.getPerspectiveTransform(at, corners)
        cut = cv2.warpPerspective(light, matrix, (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        picture = photo.develop(np.maximum(cut, 0).astype(np.float32), look, _noise(settings, shot))
        _write(out, shot, photo.jpeg(picture, _QUALITY))
        done()


def _frames(atlas: Atlas, sector: Sector, shots: list[Shot], out: Path, scene: MakeScene, tally: Tally,
            done: Callable[[], None]) -> None:  # fmt: skip
    look = photo.drone_look(atlas.settings.seed, sector.district)
    made = scene(look, sector.reach + SIGHT)
    for shot in shots:
        assert isinstance(shot.camera, Pose)
        start = time.perf_counter()
        light = made.frame(shot.camera, atlas.settings.pixels)
        picture = photo.develop(light, look, _noise(atlas.settings, shot), shot.camera)
        _write(out, shot, photo.jpeg(picture, _QUALITY))
        tally.frames += 1
        tally.frame_seconds += time.perf_counter() - start
        done()


def _noise(settings: Settings, shot: Shot) -> np.random.Generator:
    return np.random.default_rng([settings.seed, 32, hash_of(shot.paths[0])])


def _there(out: Path, shot: Shot) -> bool:
    return all((out / path).is_file() for path in shot.paths)


def _write(out: Path, shot: Shot, data: bytes) -> None:
    for path in shot.paths:
        write_whole(out / path, data)


def _check(settings: Settings) -> None:
    for name, low, high in (("views", 1, 54), ("pixels", 32, 2048), ("tile_pixels", 32, 2048), ("samples", 1, 4096)):
        value = getattr(settings, name)
        if not low <= value <= high:
            raise InputError(f"The world's {name} are {value}; expected {low} to {high}.")


def check_folder(settings: Settings, out: Path) -> None:
    """Make sure that a folder holds no other world.

    Raises:
        OutputError: when it does.
    """
    file = out / "world.json"
    if not file.is_file():
        return
    try:
        held = json.loads(file.read_bytes())
        same = held["settings"] == asdict(settings)
        edition = held["edition"]
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{file} is not a world's; choose another folder.") from error
    if not same:
        raise OutputError(
            f"{out} holds a world made with other settings ({held['settings']}); choose another folder, or delete that one."
        )
    if edition != EDITION:
        raise OutputError(
            f"{out} holds a world made by edition {edition} of the program, and this is edition {EDITION}, whose pictures "
            "differ; choose another folder, or delete that one."
        )
