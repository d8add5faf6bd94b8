"""Retrieval of a flight's photos over its map in the weathers of University-WX, which fall on whole photos before they are cut.

python -m tools.flight_weathers MAP FLIGHT city-lpn --out figures.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

import lpn
from lpn.core.arrays import UInt8Array
from lpn.core.files import write_json
from lpn.descriptors.weather import WEATHERS, Weather, WeatherName
from lpn.flights import open_flight
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.locate.task import flight_task
from lpn.maps import open_map


@dataclass
class FlightWeathersCommand:
    """Measure retrieval of a flight of photos in each weather: R@1, R@5, and R@10 in percent of its frames."""

    map: Annotated[Path, tyro.conf.Positional]
    """Map under the flight: a folder of lpn map, or a georeferenced picture."""
    flight: Annotated[Path, tyro.conf.Positional]
    """Folder of photos."""
    model: Annotated[Path, tyro.conf.Positional]
    """Trained model, or a name of lpn models."""
    weathers: tuple[WeatherName, ...] = WEATHERS
    """The weathers."""
    overlap: float = 0.5
    """Share of a window's side that its neighbour covers, too."""
    out: Path | None = None
    """File to write the figures to, as JSON."""

    def run(self) -> None:
        basemap, model = open_map(self.map), lpn.load(self.model)
        options = LocateOptions(register=False, overlap=self.overlap)
        figures: dict[str, dict[str, float]] = {}
        for name in self.weathers:
            with TemporaryDirectory() as folder:
                _copy(self.flight, Path(folder), Weather(name))
                located = locate(basemap, open_flight(folder), model, options, lambda *_: None)
                figures[name] = dict(flight_task(model, self.model.name, located, Path(folder)).metrics)
            print(name, " ".join(f"{key} {figures[name][key]:.1f}" for key in ("recall@1", "recall@5", "recall@10")))
        if self.out is not None:
            write_json(self.out, figures)


def _copy(flight: Path, folder: Path, weather: Weather) -> None:
    """Write the photos of a flight with a weather and with their tags."""
    photos = [file for file in sorted(flight.iterdir()) if file.suffix.lower() in (".jpg", ".jpeg", ".webp")]
    for file in photos:
        with Image.open(file) as photo:
            pixels: UInt8Array = np.asarray(photo.convert("RGB"))
            tags = {name: photo.info[name] for name in ("exif", "xmp") if name in photo.info}
        kind = "JPEG" if file.suffix.lower() in (".jpg", ".jpeg") else "WEBP"
        Image.fromarray(weather.apply(pixels)).save(folder / file.name, kind, quality=95, **tags)


if __name__ == "__main__":
    tyro.cli(FlightWeathersCommand).run()
