"""Measure the error that maps tell of themselves: `python -m tools.bench.map_error own|legs|beside [FLIGHT ...]`.

`own` makes maps of all, the odd, and the even photos of each flight, as `lpn map --from-flight` does, and compares the middles of
the photos on them with registrations of the same photos on the flight's own map; the rendered flight's has exact places. FLIGHT
is brighton, caliterra, seneca, or rendered, and LPN_FLIGHTS the folder of the first three. `legs` draws flights whose tags err
alike along a leg. `beside` compares places of registered photos with the map, as the flight window does, for both flights of the
demo, and for photos that are laid where the one half a flight later belongs.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np
import rasterio.warp

import lpn
from explorer.opening import OFFERED_OVERLAP
from lpn.core import images
from lpn.core.arrays import Float64Array
from lpn.core.demo import DEMO_ANSWERS, DEMO_FLIGHT, DEMO_MODEL, DEMO_PLACE
from lpn.core.errors import LPNError
from lpn.flights import Flight, open_flight
from lpn.locate.agreement import MapAgreement, map_agreement
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.maps import Map, open_map
from lpn.maps.orthophoto import lay_photos, middles_and_tags, place_error
from tools.bench.wrong_maps import RENDERED, open_pair

FLIGHTS = ("brighton", "caliterra", RENDERED, "seneca")
PARTS = {"all": slice(None), "odd": slice(0, None, 2), "even": slice(1, None, 2)}
# Photos and legs of drawn flights, how many of each, and errors of tags in metres along each axis: of a leg, and of one tag.
_FLOWN = (30, 1), (30, 2), (30, 3), (30, 6), (5, 3), (7, 3), (9, 3)
_DRAWN, _OF_LEG, _OF_TAG = 400, 6.0, 1.0


def own(names: list[str]) -> None:
    """Print a row for each map of a flight's own photos."""
    for name in names:
        flight, exact = open_pair(name, Path(os.environ.get("LPN_FLIGHTS", ".")))
        registered = locate(exact, flight)
        places = {
            one.frame.file.name: one.middle(answer)
            for one in registered.frames
            if (answer := one.stages["registration"]).accepted and answer.homography is not None
        }
        for part, chosen in PARTS.items():
            try:
                print(f"{name}, {part}: {_own_row(flight, exact, places, chosen)}", flush=True)
            except LPNError as error:
                print(f"{name}, {part}: {error}", flush=True)


def _own_row(flight: Flight, exact: Map, places: dict[str, Float64Array], chosen: slice) -> str:
    frames = flight.frames[chosen]
    photos = [frame.file for frame in frames]
    tags = np.array([(frame.latitude, frame.longitude) for frame in frames], np.float64)
    with tempfile.TemporaryDirectory() as folder:
        report = lay_photos(photos, Path(folder) / "map.tif")
    middles, known = middles_and_tags(report, photos, tags)
    error = place_error(middles, known)
    laid = [photo.name for photo in photos if photo.name in report["cameras"]]
    longitudes, latitudes = rasterio.warp.transform(f"EPSG:{report['epsg']}", "EPSG:4326", *middles.T.tolist())
    on_exact = exact.frame.xy(latitudes, longitudes)
    off = np.array([on_exact[i] - places[name] for i, name in enumerate(laid) if name in places])
    metres = np.hypot(*off.T)
    shares = [
        ", ".join(f"{100 * (metres <= sigmas * radius).mean():.0f}" for sigmas in (1, 2, 3))
        for radius in (1.0, np.hypot(1.0, error or 0.0))
    ]
    told = "none" if error is None else f"{error:.1f} m"
    return (
        f"{len(laid)} photos, error that the map tells {told}, root mean square along an axis "
        f"{np.sqrt((metres**2).mean() / 2):.1f} m of {len(metres)}; within 1, 2, and 3 radii with 1 m alone {shares[0]} %, with "
        f"that error {shares[1]} %"
    )


def legs() -> None:
    """Print what drawn flights of some legs tell, and what the error of their maps is."""
    rng = np.random.default_rng(0)
    for photos, count in _FLOWN:
        leg = np.arange(photos) * count // photos
        step = np.arange(photos) - np.searchsorted(leg, leg)
        truth = np.stack([20.0 * np.where(leg % 2, np.bincount(leg)[leg] - 1 - step, step), 25.0 * leg], axis=1)
        wrong, told, silent = [], [], 0
        for _ in range(_DRAWN):
            shared = rng.normal(0, _OF_LEG, (count, 2))[leg]
            tags = truth + shared + rng.normal(0, _OF_TAG, truth.shape)
            placed = _placed(truth, tags)
            wrong.append(((placed - truth) ** 2).sum(axis=1).mean() / 2)
            error = place_error(placed, tags)
            silent += error is None
            told += [] if error is None else [error**2]
        says = f"{np.sqrt(np.mean(told)):.1f} m" if told else "none"
        print(
            f"{photos} photos of {count} leg{'s' * (count > 1)}: told {says}, by {_DRAWN - silent} of {_DRAWN}, the error is "
            f"{np.sqrt(np.mean(wrong)):.1f} m"
        )


def _placed(truth: Float64Array, tags: Float64Array) -> Float64Array:
    """Return places (N, 2) by the similarity that takes them to their tags."""
    z, w = truth @ (1, 1j), tags @ (1, 1j)
    turn = (np.conj(z - z.mean()) * (w - w.mean())).sum() / (np.abs(z - z.mean()) ** 2).sum()
    placed = w.mean() + turn * (z - z.mean())
    return np.stack([placed.real, placed.imag], axis=1)


def beside() -> None:
    """Print how far places of the demo's registered photos lie from where the map has them."""
    for paths in (DEMO_PLACE, DEMO_FLIGHT):
        basemap, flight = open_map(paths[0]), open_flight(paths[1])
        options = LocateOptions(overlap=OFFERED_OVERLAP, matcher="sift")  # of the answers that ship
        located = locate(basemap, flight, lpn.load(DEMO_MODEL), options, shipped=paths[1].with_name(DEMO_ANSWERS))
        laid = [
            (one.frame, np.array(answer.homography).reshape(3, 3))
            for one in located.frames
            if (answer := one.stages["registration"]).accepted and answer.homography is not None
        ]
        for what, offset in (("where they belong", 0), ("where the photo half a flight later belongs", len(laid) // 2)):
            agreements: list[MapAgreement] = []
            for i, (frame, _) in enumerate(laid):
                photo = frame.undistorted(images.load_picture(frame.file))
                matrix = laid[(i + offset) % len(laid)][1]
                agreements.append(map_agreement(basemap, photo, matrix, (frame.width, frame.height)))
            metres = np.concatenate([one.metres for one in agreements])
            having = [one for one in agreements if len(one.metres)]
            figures = f"median {np.median(metres):.1f} m, most {metres.max():.1f} m" if len(metres) else "none"
            reach = f"± {min(one.reach for one in agreements):.0f} to {max(one.reach for one in agreements):.0f} m"
            print(
                f"{flight.name}, {len(laid)} photos laid {what}: {len(metres)} places of {len(having)} photos, {figures}; looked "
                f"for within {reach}; photos with one in the last tenth of that: {sum(one.may_be_larger for one in having)}"
            )


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("own", "legs", "beside"))
    parser.add_argument("flights", nargs="*", default=FLIGHTS)
    given = parser.parse_args()
    {"own": lambda: own(list(given.flights)), "legs": legs, "beside": beside}[given.what]()


if __name__ == "__main__":
    main()
