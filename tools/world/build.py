"""Building a world: plan it, then render missing pictures sector by sector."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.files import check_writable, write_atomic
from lpn.core.formats import WORLD
from lpn.core.texts import listed
from lpn.datasets.city_model import NAME as CITY_NAME
from lpn.datasets.rendered import PLAN, UNFINISHED
from tools.world import photo
from tools.world.atlas import SIGHT, SPARE, Atlas, PlannedPicture, Sector, Settings, make_atlas
from tools.world.cameras import TILE, Pose, SatelliteImage, Tile
from tools.world.jobs import check_folder, check_limits, progress
from tools.world.model3d import city_model, test_window
from tools.world.textures import hash_of

if TYPE_CHECKING:
    from tools.world.render import BlenderScene

log = logging.getLogger(__name__)

_QUALITY = 88
_LIMITS = {"views": (1, 54), "pixels": (32, 2048), "tile_pixels": (32, 2048), "samples": (1, 4096)}


@dataclass(frozen=True)
class RenderShare:
    """The share of the sectors that one process renders: the `number`-th of `count`, from 1."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> RenderShare:
        """Parse `i/k`.

        Raises:
            InputError: when the text is not of that form.
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
    """Numbers of pictures, and seconds of each step."""

    scenes: int = 0
    scene_seconds: float = 0.0
    sweeps: int = 0
    sweep_seconds: float = 0.0
    frames: int = 0
    frame_seconds: float = 0.0

    def describe(self) -> str:
        """One sentence for the console."""
        steps = (
            (self.frames, "drone pictures", self.frame_seconds, "s a drone picture"),
            (self.sweeps, "satellite sectors", self.sweep_seconds, "s a satellite sector"),
        )
        made = [step for step in steps if step[0]]
        if not made:
            return "Every picture was there already."
        counts = listed([f"{count} {name}" for count, name, _, _ in made])
        costs = ", ".join(
            f"{seconds / count:.{0 if seconds > 9 * count else 2}f} {per}" for count, _, seconds, per in made
        )
        return f"Made {counts}: {costs}, {self.scene_seconds / max(1, self.scenes):.0f} s a scene."


def build_world(settings: Settings, out: Path, part: RenderShare | None = None, threads: int = 0) -> Tally:
    """Render a world into University-1652's layout, skipping pictures that exist, so that an interrupted run can continue.

    Raises:
        InputError: when the settings are invalid.
        OutputError: when `out` cannot be written, or holds a world with other settings.
    """
    from tools.world import render  # asks for bpy before anything is planned

    part = part or RenderShare()
    check_limits(settings, _LIMITS)
    check_folder(settings, out / PLAN, "rendered world", WORLD)
    check_writable(out / PLAN)
    atlas = make_atlas(settings)
    if not _complete(atlas, out):
        write_atomic(out / UNFINISHED, b"Pictures are missing here; the same command goes on.\n")
    write_atomic(out / PLAN, atlas.world_json())
    write_atomic(out / "geo.csv", atlas.geo_csv())
    # Of parts that run at the same time, the first writes the 3-D model.
    if part.number == 1 and not (out / CITY_NAME).is_file():
        _write_city(atlas, out)
    mine = [sector for sector in atlas.sectors if sector.number % part.count == part.number - 1]
    tally = Tally()
    with progress(sum(len(sector.shots) for sector in mine)) as (folder, advance):
        renderer = _SectorRenderer(render.BlenderScene, atlas, out, folder, threads, tally, lambda: advance(1))
        for sector in mine:
            tiles, frames = (
                [shot for shot in shots if not _there(out, shot)] for shots in (sector.tiles, sector.frames)
            )
            advance(len(sector.shots) - len(tiles) - len(frames))
            if tiles:
                renderer.tiles(sector, tiles)
            if frames:
                renderer.frames(sector, frames)
    if _complete(atlas, out):  # of parts that run at the same time, the last to end removes the mark
        (out / UNFINISHED).unlink(missing_ok=True)
    return tally


def _write_city(atlas: Atlas, out: Path) -> None:
    """Write the 3-D model; a city too large for it is rendered without one."""
    try:
        write_atomic(out / CITY_NAME, city_model(atlas.city, atlas.site, test_window(atlas)))
    except InputError as error:
        log.warning("The world gets no %s: %s", CITY_NAME, error)


@dataclass(frozen=True)
class _SectorRenderer:
    """Renders a sector's pictures and writes them; calls `done` after each."""

    make: type[BlenderScene]
    atlas: Atlas
    out: Path
    folder: Path
    threads: int
    tally: Tally
    done: Callable[[], None]

    def tiles(self, sector: Sector, shots: list[PlannedPicture]) -> None:
        """Cut the satellite tiles from one image."""
        settings, city, x, y = self.atlas.settings, self.atlas.city, sector.x, sector.y
        look = photo.satellite_look(settings.seed, sector.district, settings.vary)
        rng = np.random.default_rng([settings.seed, 31, sector.number])
        reach = sector.reach + TILE / 2 + SPARE
        pixels = round(2 * reach * settings.tile_pixels / TILE)
        lean, bearing = float(rng.uniform(1, 7)), float(rng.uniform(0, 360))
        sweep = SatelliteImage(x, y, city.height(x, y), 2 * reach, pixels, lean, bearing)
        made = self._scene(x, y, look, reach + 40)
        start = time.perf_counter()
        light = made.sweep(sweep)
        self.tally.sweeps += 1
        self.tally.sweep_seconds += time.perf_counter() - start
        side = settings.tile_pixels
        corners = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32) - 0.5
        for shot in shots:
            assert isinstance(shot.camera, Tile)
            at = (sweep.corners(shot.camera) - 0.5).astype(np.float32)
            matrix = cv2.getPerspectiveTransform(at, corners)
            cut = cv2.warpPerspective(
                light, matrix, (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
            self._develop(shot, np.maximum(cut, 0).astype(np.float32), look)

    def frames(self, sector: Sector, shots: list[PlannedPicture]) -> None:
        """Render the drone pictures."""
        look = photo.drone_look(self.atlas.settings.seed, sector.district, self.atlas.settings.vary)
        made = self._scene(sector.x, sector.y, look, sector.reach + SIGHT)
        for shot in shots:
            assert isinstance(shot.camera, Pose)
            start = time.perf_counter()
            light = made.frame(shot.camera, self.atlas.settings.pixels)
            self._develop(shot, light, look, shot.camera)
            self.tally.frames += 1
            self.tally.frame_seconds += time.perf_counter() - start

    def _scene(self, x: float, y: float, look: photo.Look, reach: float) -> BlenderScene:
        start = time.perf_counter()
        samples = self.atlas.settings.samples
        made = self.make(self.atlas.city, x, y, 2 * reach, look, samples, self.folder, self.threads)
        self.tally.scenes += 1
        self.tally.scene_seconds += time.perf_counter() - start
        return made

    def _develop(self, shot: PlannedPicture, light: Float32Array, look: photo.Look, pose: Pose | None = None) -> None:
        """Develop a picture and write it; with the factor `cameras`, draw its camera and the quality of its JPEG."""
        settings, quality = self.atlas.settings, _QUALITY
        if "cameras" in settings.vary:
            rng = np.random.default_rng([settings.seed, 33, hash_of(shot.paths[0])])
            look, quality = photo.any_camera(look, rng), int(rng.integers(40, 93))
        noise = np.random.default_rng([settings.seed, 32, hash_of(shot.paths[0])])
        data = images.jpeg(photo.develop(light, look, noise, pose), quality)
        for path in shot.paths:
            write_atomic(self.out / path, data)
        self.done()


def _complete(atlas: Atlas, out: Path) -> bool:
    return all(_there(out, shot) for sector in atlas.sectors for shot in sector.shots)


def _there(out: Path, shot: PlannedPicture) -> bool:
    return all((out / path).is_file() for path in shot.paths)
