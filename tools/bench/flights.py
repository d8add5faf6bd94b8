"""Real flights over their own maps, stage by stage: `python -m tools.bench.flights FOLDER [NAME ...]`.

FOLDER holds one folder a flight, each with `photos/` and `map.tif` or `map.jpg`; LPN_FLIGHTS is its default. Registration
searches the whole map, or with `--prior` that many metres around each tag. `--model` adds retrieval and sequence. Errors are
against the tags.
Shares of registrations within 1, 2, and 3 sigmas are told for tags as they are and without their lag, see `radius_rows`.
Nothing is taken from the user's cache, so figures and times are of the code that runs.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lpn
from lpn.core.consoles import Console
from lpn.flight.commands.locate import print_summary
from lpn.flight.files import open_flight
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.verdict import TAG_RADIUS, disagreements
from lpn.flight.maps import open_map

# Tangent of the 5 degrees by which an aircraft's camera may be tilted, as a share of the height.
_SWAY = float(np.tan(np.radians(5.0)))


def measure(folder: Path, options: LocateOptions, model: Path | None) -> None:
    """Locate one flight, and print its table."""
    town = open_map(next(path for path in (folder / "map.tif", folder / "map.jpg") if path.is_file()))
    flight = replace(open_flight(folder / "photos"), name=folder.name)
    begun = time.process_time()
    located = locate(town, flight, None if model is None else lpn.load(model), options)
    seconds = time.process_time() - begun
    print_summary(located, Console(width=140))
    print(f"{seconds / len(flight.frames):.2f} s of processor time a frame.")
    for row in radius_rows(located):
        print(row.sentence)


@dataclass(frozen=True)
class RadiusRow:
    """Shares of a flight's registrations within 1, 2, and 3 sigmas of their tags.

    Attributes:
        tags: "as they are", or "without their lag".
        frames: registrations with a tag.
        median: metres from the tags.
        own, with_tag, with_tilt: shares by the radius alone; with the tag's own error of 5 m; and with 5 degrees of
            tilt between camera and picture's middle, where the position is the middle's. Errors add up as squares.
        contradictions: of registration and tag, see `lpn.flight.locate.verdict.disagreements`.
    """

    tags: str
    frames: int
    median: float
    own: list[float]
    with_tag: list[float]
    with_tilt: list[float]
    contradictions: int

    @property
    def sentence(self) -> str:
        """One line of the table."""
        shares = (
            f"{name} {', '.join(f'{100 * share:.0f}' for share in row)} %"
            for name, row in (("radius", self.own), ("+ tag", self.with_tag), ("+ tilt", self.with_tilt))
        )
        return (
            f"Tags {self.tags}: {self.frames} frames, {self.median:.1f} m in the median; within 1, 2, 3 sigmas: "
            f"{'; '.join(shares)}; {self.contradictions} contradictions."
        )


def radius_rows(located: LocatedFlight) -> list[RadiusRow]:
    """Compare the errors of accepted registrations with their radii, for tags as they are and without their lag."""
    rows = []
    for name, seen in (("as they are", located), ("without their lag", located.without_lag())):
        if name != "as they are" and seen is located:
            continue
        kept = [
            (error, answer.radius, 0.0 if answer.camera else (frame.frame.flying_height or (answer.width or 0.0) / 2))
            for frame in seen.frames
            if (answer := frame.stages.get("registration")) is not None
            and answer.accepted
            and answer.radius is not None
            and (error := frame.error("registration")) is not None
        ]
        if not kept:
            continue
        error, radius, height = np.array(kept).T
        sigmas = radius, np.hypot(radius, TAG_RADIUS), np.hypot(np.hypot(radius, TAG_RADIUS), height * _SWAY)
        shares = [[float((error <= k * sigma).mean()) for k in (1, 2, 3)] for sigma in sigmas]
        against = sum(
            {one.one, one.other} == {"registration", "tag"} for frame in seen.frames for one in disagreements(frame)
        )
        rows.append(RadiusRow(name, len(kept), float(np.median(error)), shares[0], shares[1], shares[2], against))
    return rows


def main() -> None:
    """Measure the flights that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=os.environ.get("LPN_FLIGHTS"))
    parser.add_argument("names", nargs="*", default=["brighton", "caliterra", "seneca"])
    parser.add_argument("--prior", type=float)
    parser.add_argument("--model", type=Path)
    given = parser.parse_args()
    if given.folder is None:
        raise SystemExit("There is no folder of flights; give one, or set LPN_FLIGHTS.")
    options = LocateOptions(prior=given.prior)
    with tempfile.TemporaryDirectory() as cache:
        os.environ["LPN_CACHE"] = cache
        for name in given.names:
            measure(Path(given.folder) / name, options, given.model)


if __name__ == "__main__":
    main()
