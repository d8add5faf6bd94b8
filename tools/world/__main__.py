"""`python -m tools.world --out FOLDER`: renders a fictional city as a data set, or a flight over it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.core.requirements import missing_package
from tools.world.atlas import Settings
from tools.world.build import build_world
from tools.world.cameras import Factor
from tools.world.flight import FlightSettings, build_flight

# Options of the pictures of places, and those of --flight.
_OF_PLACES = ("views", "pixels", "tile_pixels", "vary")
_OF_FLIGHTS = ("frames", "width", "map_pixel")


@dataclass
class Rendering:
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
    vary: tuple[Factor, ...] = ()
    """Properties to draw at random, for training: cameras, and poses (in place of University-1652's spiral)."""
    threads: int = 0
    """Processor threads; 0 for all."""
    flight: bool = False
    """Render a flight over the city in place of the data set: photos, a map, and the truth."""
    frames: int = 150
    """Pictures of --flight."""
    width: int = 960
    """Width of a picture of --flight, whose proportions are 4:3."""
    map_pixel: float = 0.3
    """Metres a pixel of the map of --flight."""

    def run(self) -> None:
        """Render what is missing, and print a sentence about it."""
        what, others = ("A flight", _OF_PLACES) if self.flight else ("A world without --flight", _OF_FLIGHTS)
        for name in others:
            if getattr(self, name) != getattr(type(self), name):
                raise InputError(f"{what} takes no --{name.replace('_', '-')}; leave it out.")
        if self.flight:
            flight = FlightSettings(self.seed, self.buildings, self.frames, self.width, self.samples, self.map_pixel)
            made = build_flight(flight, self.out, self.threads)
        else:
            vary = tuple(sorted(set(self.vary)))
            world = Settings(self.seed, self.buildings, self.views, self.pixels, self.tile_pixels, self.samples, vary)
            made = build_world(world, self.out, self.threads)
        print(f"{made} pictures were missing, and {self.out} is complete.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return the exit status: 2 after an error of the user, 130 after Ctrl-C."""
    try:
        tyro.cli(Rendering, args=arguments, prog="python -m tools.world").run()
    except LPNError as error:
        print(printable(str(error)), file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if error.name == "bpy":
            print(
                "This needs the package bpy, which is not installed; pip install -e . 'bpy>=5.0,<5.1'.", file=sys.stderr
            )
        else:
            print(missing_package(error), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped. The pictures are kept; the same command goes on.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
