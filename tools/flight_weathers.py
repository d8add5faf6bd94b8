"""Retrieval of a flight's photos over its map in the weathers of University-WX, which fall on whole photos before they are cut.

python -m tools.flight_weathers MAP FLIGHT city-lpn --answers ANSWERS --out figures.json
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

import lpn
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import write_json
from lpn.descriptors.weather import WEATHERS, Weather, WeatherName
from lpn.flights import open_flight
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.locate.registered_stage import FORMAT
from lpn.locate.shipped import ShippedAnswers
from lpn.locate.task import flight_task
from lpn.maps import open_map


@dataclass
class FlightWeathersCommand:
    """Measure retrieval of a flight of photos in each weather: R@1, R@5, R@10, the first window's median error in metres, and the
    share of photos whose error is at most 50 m."""

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
    answers: Path | None = None
    """Answers that ship with the flight: where they show that its tags are late, photos are graded by the registrations."""
    out: Path | None = None
    """File to write the figures to, as JSON."""

    def run(self) -> None:
        basemap, model = open_map(self.map), lpn.load(self.model)
        options = LocateOptions(register=False, overlap=self.overlap)
        shipped = None
        if self.answers is not None:
            shipped = ShippedAnswers.open(self.answers, FORMAT, model, basemap, open_flight(self.flight))
            if shipped is None:
                raise InputError(f"{self.answers} has no answers of this model, map, and flight; leave --answers out.")
        figures: dict[str, dict[str, float]] = {}
        for name in self.weathers:
            with TemporaryDirectory() as folder:
                _copy(self.flight, Path(folder), Weather(name))
                located = locate(basemap, open_flight(folder), model, options, lambda *_: None)
                located = replace(located, shipped={} if shipped is None else shipped.registration)
                task = flight_task(model, self.model.name, located, Path(folder))
                assert task.geometry is not None
                errors = task.geometry.answer_errors_m(task.outcomes.answer)
                figures[name] = {
                    **{key: float(task.metrics[key]) for key in ("recall@1", "recall@5", "recall@10")},
                    "median error": float(np.median(errors)),
                    "within 50 m": 100 * float(np.mean(errors <= 50)),
                }
            print(name, " ".join(f"{key} {value:.1f}" for key, value in figures[name].items()), flush=True)
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
