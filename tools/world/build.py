"""Building a world: plan it, then render missing pictures sector by sector."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.files import check_writable, write_atomic
from lpn.core.formats import WORLD
from lpn.datasets.rendered import PLAN, UNFINISHED
from tools.world import photo
from tools.world.atlas import SIGHT, SPARE, Atlas, PlannedPicture, Sector, Settings, make_atlas
from tools.world.cameras import TILE, Pose, SatelliteImage, Tile
from tools.world.jobs import check_folder, check_limits, progress
from tools.world.textures import hash_of

if TYPE_CHECKING:
    from tools.world.render import BlenderScene

log = logging.getLogger(__name__)

_QUALITY = 88
_LIMITS = {"views": (1, 54), "pixels": (32, 2048), "tile_pixels": (32, 2048), "samples": (1, 4096)}


def build_world(settings: Settings, out: Path, threads: int = 0) -> int:
    """Render the missing pictures of a world into University-1652's layout, and return their number.

    An interrupted run can be continued.

    Raises:
        InputError: when the settings are invalid.
        OutputError: when `out` cannot be written, or holds a world with other settings.
    """
    from tools.world import render  # asks for bpy before anything is planned

    check_limits(settings, _LIMITS)
    check_folder(settings, out / PLAN, WORLD)
    check_writable(out / PLAN)
    atlas = make_atlas(settings)
    missing = {shot for shot in atlas.shots if not all((out / path).is_file() for path in shot.paths)}
    if missing:
        write_atomic(out / UNFINISHED, b"Pictures are missing here; the same command goes on.\n")
    write_atomic(out / PLAN, atlas.world_json())
    write_atomic(out / "geo.csv", atlas.geo_csv())
    with progress(len(missing)) as (folder, advance):
        renderer = _SectorRenderer(render.BlenderScene, atlas, out, folder, threads, advance)
        for sector in atlas.sectors:
            if tiles := [shot for shot in sector.tiles if shot in missing]:
                renderer.tiles(sector, tiles)
            if frames := [shot for shot in sector.frames if shot in missing]:
                renderer.frames(sector, frames)
    (out / UNFINISHED).unlink(missing_ok=True)
    return len(missing)


@dataclass(frozen=True)
class _SectorRenderer:
    """Renders a sector's pictures and writes them; calls `done` after each."""

    make: type[BlenderScene]
    atlas: Atlas
    out: Path
    folder: Path
    threads: int
    done: Callable[[], None]

    def tiles(self, sector: Sector, shots: list[PlannedPicture]) -> None:
        settings, city, x, y = self.atlas.settings, self.atlas.city, sector.x, sector.y
        look = photo.satellite_look(settings.seed, sector.district)
        rng = np.random.default_rng([settings.seed, 31, sector.number])
        reach = sector.reach + TILE / 2 + SPARE
        pixels = round(2 * reach * settings.tile_pixels / TILE)
        lean, bearing = float(rng.uniform(1, 7)), float(rng.uniform(0, 360))
        sweep = SatelliteImage(x, y, city.height(x, y), 2 * reach, pixels, lean, bearing)
        made = self._scene(x, y, look, reach + 40)
        light = made.sweep(sweep)
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
        look = photo.drone_look(self.atlas.settings.seed, sector.district)
        made = self._scene(sector.x, sector.y, look, sector.reach + SIGHT)
        for shot in shots:
            assert isinstance(shot.camera, Pose)
            self._develop(shot, made.frame(shot.camera, self.atlas.settings.pixels), look, shot.camera)

    def _scene(self, x: float, y: float, look: photo.Look, reach: float) -> BlenderScene:
        samples = self.atlas.settings.samples
        return self.make(self.atlas.city, x, y, 2 * reach, look, samples, self.folder, self.threads)

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
