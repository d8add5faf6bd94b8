"""The command world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lpn.core.errors import InputError
from lpn.world.factors import FACTORS, Factor

# Options of the pictures of places, and those of --flight.
_OF_PLACES = ("views", "pixels", "tile_pixels", "streets", "panoramas", "vary", "part")
_OF_FLIGHTS = ("frames", "width", "map_pixel", "oblique")


@dataclass
class WorldCommand:
    """Plan and render a fictional city as a data set with exact positions; resumable."""

    out: Path
    """Folder to write, in University-1652's layout, with world.json and geo.csv."""
    seed: int = 0
    """Random seed of the city; equal options give equal pictures."""
    buildings: int = 460
    """Number of places, about a third of them for testing."""
    views: int = 12
    """Drone pictures of each place, the last from straight above."""
    pixels: int = 256
    """Side of a drone picture."""
    tile_pixels: int = 512
    """Side of a satellite tile, which shows 160 m."""
    samples: int = 4
    """Light paths per pixel; more are slower and less noisy."""
    streets: int = 0
    """Street-level pictures of each place; can be increased in an existing world."""
    panoramas: int = 0
    """Panoramas near each place, in cvusa/ with a tile around each; can be increased in an existing world."""
    vary: tuple[Factor | Literal["all"], ...] = ()
    """Properties to draw at random, for training: days (two of the year for each district), cameras, poses (in place of
    University-1652's spiral), materials (roofs, walls, pavements), traffic, construction, snow, and plan (streets and blocks)."""
    part: str = "1/1"
    """Part i/k of the work: k processes with the same --out render one world."""
    threads: int = 0
    """Processor threads; 0 for all."""
    flight: bool = False
    """Render a flight over the city in place of the data set: photos, a video with .SRT, a map, and the truth."""
    frames: int = 150
    """Pictures of --flight."""
    width: int = 960
    """Width of a picture of --flight, whose proportions are 4:3."""
    map_pixel: float = 0.3
    """Metres a pixel of the map of --flight."""
    oblique: bool = False
    """Fly --flight at 60 to 200 m, with the gimbal at 0 to 45 degrees from straight down, in place of 80 to 120 m and 0 to 11."""

    def run(self) -> None:
        self._check_options()
        if self.flight:
            self._render_flight()
            return
        from lpn.world.atlas import Settings
        from lpn.world.build import RenderShare, build_world

        settings = Settings(
            self.seed,
            self.buildings,
            self.views,
            self.pixels,
            self.tile_pixels,
            self.samples,
            self.streets,
            self.panoramas,
            tuple(factor for factor in FACTORS if factor in self.vary or "all" in self.vary),
        )
        tally = build_world(settings, self.out, RenderShare.parse(self.part), self.threads)
        print(f"{tally.describe()} The world is in {self.out}.")

    def _check_options(self) -> None:
        """Raise InputError for an option that the chosen kind of pictures has no use for."""
        what, others = ("A flight", _OF_PLACES) if self.flight else ("A world without --flight", _OF_FLIGHTS)
        names = [name for name in others if getattr(self, name) != getattr(type(self), name)]
        if names:
            raise InputError(f"{what} takes no --{names[0].replace('_', '-')}; leave it out.")

    def _render_flight(self) -> None:
        from lpn.world.flight import FlightSettings, build_flight

        settings = FlightSettings(
            self.seed, self.buildings, self.frames, self.width, self.samples, self.map_pixel, self.oblique
        )
        print(f"{build_flight(settings, self.out, self.threads).describe()} The flight is in {self.out}.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"The pictures in {self.out} are kept; the same command goes on."
