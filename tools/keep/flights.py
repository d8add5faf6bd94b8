"""Flights located anew: the shipped ones, forged tags, maps of other places, and single photos.

Registration runs without a model, over the whole map. Real flights lie in the folder that LPN_FLIGHTS names: each in a
folder with `photos/`, and `map.tif` or `map.jpg`.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tools.keep._resumable import keep_row, resumable, run_lpn
from tools.keep.measures import Bound, Figures, Measure, Value, at_least, at_most, data_folder, equal, reported, within

if TYPE_CHECKING:
    from lpn.flight.files import Flight
    from lpn.flight.locate.ground import MapFeatures
    from lpn.flight.maps import Map

# The stride of the photos of a flight that are located over maps of other places, and over its own map in other pixels.
WRONG_MAPS = {"brighton": (1, 1), "rendered": (1, 4), "caliterra": (4, 4), "seneca": (1, 4)}
PLACED = ("accepted", "contradicted")
# Metres to the east and north by which forged tags lie off.
MOVED = (60.0, 0.0)
# Metres from its true tag beyond which an accepted photo is false.
BEYOND = 50.0


def rendered_flight() -> Figures:
    """Locate the shipped rendered flight against its exact truth; about 3 minutes of processor time.

    Errors of the camera and of the ground at the photo's middle are in metres, and shares within 1, 2, and 3 radii in percent.
    """
    from lpn.core.demo import DEMO_FLIGHT

    basemap, flight = DEMO_FLIGHT
    with resumable("rendered") as folder:
        write_positions(basemap.with_name("truth.csv"), folder / "positions.csv")
        run_lpn(
            "locate", "--map", basemap, "--flight", flight, "--no-corrections",
            "--positions", folder / "positions.csv", "--json", folder / "errors.json",
        )  # fmt: skip
        return rendered_figures(json.loads((folder / "errors.json").read_bytes()))


def write_positions(truth: Path, out: Path) -> None:
    """Write the places of `truth.csv` as surveyed positions of the camera and of the ground at the photo's middle."""
    lines = ["photo,latitude,longitude,point"]
    for row in csv.DictReader(truth.read_text().splitlines()):
        lines.append(f"{row['file']},{row['latitude']},{row['longitude']},camera")
        lines.append(f"{row['file']},{row['middle_latitude']},{row['middle_longitude']},ground")
    out.write_text("\n".join(lines) + "\n")


def rendered_figures(measured: Mapping[str, Any]) -> Figures:
    """Reduce the JSON of `lpn locate` to figures."""
    (points,) = measured["surveyed"].values()
    figures: dict[str, Value] = {"photos": measured["frames"], "placed": points["camera"]["photos"]}
    for name, point in (("camera", "camera"), ("middle", "ground")):
        errors = points[point]
        figures |= {f"{name} {key} m": round(errors[key], 2) for key in ("median", "ce95", "largest")}
        figures |= {f"{name} within {k} radii": round(errors["within"][str(k)], 1) for k in (1, 2, 3)}
    return figures


def real_flight() -> Figures:
    """Locate the shipped real flight; about two minutes of processor time.

    `places` has the metres east and north of each of the `placed photos`, and `radii` its radius on this map.
    """
    from lpn.core.demo import DEMO_PLACE

    with resumable("real") as folder:
        return real_figures(_track(*DEMO_PLACE, folder / "track.csv"))


def real_figures(track: Sequence[Mapping[str, str]]) -> Figures:
    """Reduce the best track of `lpn locate` to figures."""
    placed = [row for row in track if row["state"] in PLACED]
    return {
        "photos": len(track),
        "placed": len(placed),
        "placed photos": " ".join(row["frame"] for row in placed),
        "places": [round(float(row[axis]), 2) for row in placed for axis in ("easting_m", "northing_m")],
        "radii": [round(float(row["radius_on_map_m"]), 2) for row in placed],
    }


def within_radii(radii: float) -> Bound:
    """Every place lies within this many of the baseline's radii of its place."""

    def error(_: str, value: Value, before: Figures) -> str:
        places, allowed = before["places"], before["radii"]
        assert isinstance(value, list)
        assert isinstance(places, list)
        assert isinstance(allowed, list)
        if len(value) != len(places):
            return f"found {len(value) // 2} places; the baseline has {len(places) // 2}"
        metres = [math.dist(value[i : i + 2], places[i : i + 2]) for i in range(0, len(value), 2)]
        off = [i for i, (one, radius) in enumerate(zip(metres, allowed, strict=True)) if not one <= radii * radius]
        return f"places {off} are {[round(metres[i], 1) for i in off]} m off" if off else ""

    return Bound(f"each within {radii:g} radii", error, relative=True)


def swapped_map(name: str) -> Figures:
    """Locate a shipped flight, "rendered" or "real", over the other's map, and count the accepted photos.

    It takes about 4 minutes of processor time for the rendered one, and 12 for the real one.
    """
    from lpn.core.demo import DEMO_FLIGHT, DEMO_PLACE

    basemap, flight = {"rendered": (DEMO_PLACE[0], DEMO_FLIGHT[1]), "real": (DEMO_FLIGHT[0], DEMO_PLACE[1])}[name]
    with resumable(f"swapped-{name}") as folder:
        track = _track(basemap, flight, folder / "track.csv")
    return {"photos": len(track), "accepted": sum(row["state"] in PLACED for row in track)}


def _track(basemap: Path, flight: Path, out: Path) -> list[dict[str, str]]:
    """Locate a flight by `lpn locate`, and return the rows of its best track."""
    run_lpn("locate", "--map", basemap, "--flight", flight, "--out", out, "--best", "--no-corrections")
    return list(csv.DictReader(out.read_text().splitlines()))


def wrong_maps(name: str) -> Figures:
    """Locate a flight over the maps of other places, over its own map mirrored, and over its own map in other pixels.

    It takes about 4 minutes of processor time for brighton, 6 for rendered, 45 for caliterra, and 55 for seneca.
    """
    folder_of_flights = data_folder("LPN_FLIGHTS")
    from tools.keep._maps import SIDE, changed_maps, foreign_maps, open_pair

    with resumable(f"wrong-{name}") as folder:
        pairs = {other: open_pair(other, folder_of_flights) for other in WRONG_MAPS}
        flight, own = pairs[name]
        (maps := folder / "maps").mkdir(exist_ok=True)
        elsewhere = foreign_maps(name, {other: basemap for other, (_, basemap) in pairs.items()}, SIDE, maps)
        rows = []
        for every, tried in zip(WRONG_MAPS[name], (elsewhere, changed_maps(own, SIDE, maps)), strict=True):
            chosen = replace(flight, name=name, frames=flight.frames[::every])
            rows += [
                keep_row(folder / "rows.json", map_name, partial(_located_over, chosen, map_name, basemap))
                for map_name, basemap in tried
            ]
    return wrong_map_figures(rows)


def _located_over(flight: Flight, map_name: str, basemap: Map) -> dict[str, Any]:
    """Count the accepted photos of a flight over a map, and those of them that lie beyond 50 m of their tag or have none."""
    from lpn.flight.locate.pipeline import locate

    frames = locate(basemap, flight).frames
    accepted = [one for one in frames if one.stages["registration"].accepted]
    beyond = sum(one.tag is None or (one.error("registration") or 0.0) > BEYOND for one in accepted)
    return {"map": map_name, "photos": len(frames), "accepted": len(accepted), "beyond": beyond}


def wrong_map_figures(rows: Sequence[Mapping[str, Any]]) -> Figures:
    """Reduce rows of `_located_over` to figures; over the own map none should lie beyond 50 m of its tag."""
    figures: dict[str, Value] = {}
    for row in rows:
        own = row["map"].startswith("own, ")
        over = row["map"] if own else f"over {row['map']}"
        figures |= {f"{over} photos": row["photos"], f"{over} accepted": row["accepted"]}
        if own:
            figures[f"{over} beyond"] = row["beyond"]
    return figures


def shipped_photos() -> Figures:
    """Register the shipped real photos without their metadata on their map; about 10 minutes of processor time."""
    from lpn.core.demo import DEMO_PLACE

    return _single_photos("single-shipped", here={DEMO_PLACE[1]: 1})


def flights_photos() -> Figures:
    """Register 20 photos of the place, and 48 of other places; about 25 minutes of processor time."""
    flights = data_folder("LPN_FLIGHTS")
    return _single_photos(
        "single-flights",
        here={flights / "caliterra" / "photos": 3},
        elsewhere={flights / "brighton" / "photos": 1, flights / "seneca" / "photos": 2},
    )


def university_photos() -> Figures:
    """Register 20 drone pictures of University-1652, of other places; about 10 minutes of processor time."""
    data = data_folder("LPN_MINI_DATA")
    return _single_photos("single-university", elsewhere={data / "test" / "query_drone": 4})


def _single_photos(name: str, **sides: Mapping[Path, int]) -> Figures:
    """Register every n-th photo of folders on the shipped place's map, knowing their pixels alone."""
    from lpn.core.demo import DEMO_PLACE
    from lpn.flight.locate.ground import MapFeatures
    from lpn.flight.locate.matchers import open_matchers
    from lpn.flight.maps import open_map

    with resumable(name) as folder:
        basemap = open_map(DEMO_PLACE[0])
        features = [MapFeatures(basemap, matcher) for matcher in open_matchers()]
        figures: dict[str, Value] = {}
        for side, sources in sides.items():
            for source, every in sources.items():
                answers = [
                    keep_row(folder / "rows.json", str(file), partial(_accepted, basemap, features, file))
                    for file in photos_of(source, every)
                ]
                known = source.parent.name if source.name == "photos" else source.name
                figures |= {f"{known} {side} photos": len(answers), f"{known} {side} accepted": sum(answers)}
    return figures


def photos_of(folder: Path, every: int) -> list[Path]:
    """Every n-th photo below a folder, in the order of names."""
    files = (file for file in folder.rglob("*") if file.suffix.lower() in (".jpg", ".jpeg", ".png", ".webp"))
    return sorted(files)[::every]


def _accepted(basemap: Map, features: Sequence[MapFeatures], file: Path) -> bool:
    """Register the pixels of a photo as a visitor's own picture, and return whether it is accepted."""
    from explorer import uploads
    from lpn.flight.locate.own_photo import register_own_photo

    picture = uploads.read(file.name, file.read_bytes()).picture
    photo = register_own_photo(basemap, features, picture, None, ())
    assert photo.whole_map
    return photo.answer.accepted


def forged_tags() -> Figures:
    """Locate the shipped flights with forged tags on their own maps; about ten minutes of processor time.

    `turned` tags and headings are turned and moved at random, and `moved` ones lie 60 m to the east of their places. A placed
    photo is told if the verdict says that the tag contradicts it, and false if it lies beyond 50 m of its true tag.
    """
    from lpn.core.demo import DEMO_FLIGHT, DEMO_PLACE

    figures: dict[str, Value] = {}
    with resumable("forged") as folder:
        for name, place in (("rendered", DEMO_FLIGHT), ("real", DEMO_PLACE)):
            for forgery in ("turned", "moved"):
                label = f"{name} {forgery}"
                row = keep_row(folder / "rows.json", label, partial(_located_forged, *place, forgery))
                figures |= {f"{label} {key}": value for key, value in row.items()}
    return figures


def _located_forged(map_path: Path, flight_path: Path, forgery: str) -> dict[str, int]:
    from lpn.flight.files import open_flight
    from lpn.flight.locate.pipeline import locate
    from lpn.flight.locate.verdict import judge
    from lpn.flight.maps import open_map
    from tools.keep._maps import forged

    basemap, flight = open_map(map_path), open_flight(flight_path)
    tags = basemap.frame.xy(*flight.degrees.T)
    if forgery == "turned":
        seen = forged(flight, basemap, basemap, 0)
    else:
        places = basemap.frame.degrees(tags + MOVED)
        frames = zip(flight.frames, places, strict=True)
        moved = (replace(frame, latitude=float(place[0]), longitude=float(place[1])) for frame, place in frames)
        seen = replace(flight, frames=tuple(moved))
    answers = [judge(located) for located in locate(basemap, seen).frames]
    placed = [(one, tag) for one, tag in zip(answers, tags, strict=True) if one.state in PLACED]
    return {
        "photos": len(answers),
        "placed": len(placed),
        "told": sum("tag" in one.doubt for one, _ in placed),
        "false": sum(
            math.dist((one.answer.x or math.inf, one.answer.y or math.inf), tag) > BEYOND for one, tag in placed
        ),
    }


MEASURES = (
    Measure(
        "rendered",
        rendered_flight,
        {
            "photos": equal(),
            "placed": at_least(34),
            "camera median m": at_most(1.05),
            "camera largest m": at_most(5),
            "* within 3 radii": at_least(100),
            # Two of 34 photos.
            "* within ? radii": within(6),
            "* m": reported(),
        },
        slow=True,
    ),
    Measure(
        "real",
        real_flight,
        {
            "photos": equal(),
            "placed": at_least(30),
            "placed photos": equal(),
            "places": within_radii(2),
            "radii": reported(),
        },
        slow=True,
    ),
    *(
        Measure(
            f"swapped-{name}",
            partial(swapped_map, name),
            {"photos": at_least(photos), "accepted": at_most(0)},
            slow=True,
        )
        for name, photos in (("rendered", 40), ("real", 30))
    ),
    Measure(
        "forged",
        forged_tags,
        {"* photos": equal(), "* placed": reported(), "* told": at_least(), "* false": at_most(0)},
        slow=True,
    ),
    *(
        Measure(
            f"wrong-{name}",
            partial(wrong_maps, name),
            {"* photos": equal(), "over * accepted": at_most(0), "own, * accepted": at_least(), "* beyond": at_most(0)},
            slow=True,
        )
        for name in WRONG_MAPS
    ),
    Measure(
        "single-shipped",
        shipped_photos,
        {"caliterra-even here photos": at_least(30), "caliterra-even here accepted": at_least(30)},
        slow=True,
    ),
    Measure(
        "single-flights",
        flights_photos,
        {
            "caliterra here photos": at_least(20),
            "caliterra here accepted": at_least(20),
            "brighton elsewhere photos": at_least(18),
            "seneca elsewhere photos": at_least(30),
            "* elsewhere accepted": at_most(0),
        },
        slow=True,
    ),
    Measure(
        "single-university",
        university_photos,
        {"query_drone elsewhere photos": at_least(20), "query_drone elsewhere accepted": at_most(0)},
        slow=True,
    ),
)
