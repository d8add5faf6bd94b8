"""Points of a flight's track, and the command's summary of it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from lpn.flight.commands.locate import print_summary
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.registered_stage import with_map_error
from lpn.flight.locate.tracks import best_track, full_track
from lpn.flight.maps import LocalFrame, Map

# A degree east of the middle of UTM zone 15, whose grid is turned by 0.7 degrees there.
ORIGIN = LocalFrame(46.8, -92.0)
BASEMAP = cast(Map, SimpleNamespace(frame=ORIGIN, name="town", elevation=None))


def flight(**frames: LocatedFrame) -> LocatedFlight:
    of_flight = Flight("monday", tuple(one.frame for one in frames.values()))
    return LocatedFlight(of_flight, BASEMAP, list(frames.values()), None, [], None)


def photo(name: str, tag: tuple[float, float] | None, **others: object) -> LocatedFrame:
    answer = StageRecord("accepted", "It agrees.", 0.0, 1000.0, radius=1.0, width=50.0, **others)  # type: ignore[arg-type]
    return LocatedFrame(
        Frame(name, Path(name), 80, 60), None if tag is None else np.array(tag), {"registration": answer}
    )


def test_differences_from_the_tag_are_along_the_grid_of_the_eastings() -> None:
    located = flight(a=photo("a.jpg", (0.0, 0.0)))
    (point,) = full_track(located)
    (there,) = ORIGIN.utm([(0.0, 0.0)])
    off = (point["easting_m"] - there[0], point["northing_m"] - there[1])
    assert (point["east_from_tag_m"], point["north_from_tag_m"]) == off
    assert point["east_from_tag_m"] == pytest.approx(-12.7, abs=0.3), "the grid is turned against the map's frame"
    assert point["metres_from_tag"] == 1000.0


def test_a_track_says_which_photos_were_checked_beside_their_middle() -> None:
    def compared(rows: int, east: float) -> MapAgreement:
        return MapAgreement([(0.1, 0.1, east, 0.0)] * rows, 8.0)

    located = flight(
        a=photo("a.jpg", None, agreement=compared(3, 0.5)),
        b=photo("b.jpg", None, agreement=compared(2, 0.5)),
        c=photo("c.jpg", None, agreement=compared(3, 5.0)),
        d=photo("d.jpg", None),
        e=LocatedFrame(Frame("e.jpg", Path("e.jpg"), 80, 60), None, {"registration": StageRecord("refused", "No.")}),
    )
    for track in (full_track(located), best_track(located)):
        assert [point["checked_beside_middle"] for point in track] == ["yes", "no", "contradicted", "no", ""]


def test_a_track_says_if_the_tags_of_the_flight_confirm_its_radii() -> None:
    refused = LocatedFrame(Frame("c.jpg", Path("c.jpg"), 80, 60), None, {"registration": StageRecord("refused", "No.")})
    near, far = photo("a.jpg", (0.0, 999.0)), photo("b.jpg", (0.0, 0.0))
    for frames, told in (
        ((near, far, refused), ["no", "no", ""]),
        ((near, photo("b.jpg", None)), ["yes", "yes"]),
        ((photo("a.jpg", None),), [""]),
    ):
        located = flight(**{one.frame.name: one for one in frames})
        for track in (full_track(located), best_track(located)):
            assert [point.get("radius_confirmed_by_tags", "") for point in track] == told


def test_tags_that_the_search_used_refute_radii_and_confirm_none() -> None:
    near, far = photo("a.jpg", (0.0, 999.0)), photo("b.jpg", (0.0, 0.0))
    for frames, told in (((near,), [""]), ((near, far), ["no", "no"])):
        located = replace(flight(**{one.frame.name: one for one in frames}), prior=30.0)
        for track in (full_track(located), best_track(located)):
            assert [point.get("radius_confirmed_by_tags", "") for point in track] == told


def test_the_radius_of_the_middle_has_the_error_of_the_map() -> None:
    answer = photo("a.jpg", None, camera=True, middle_radius=0.3).stages["registration"]
    assert with_map_error(answer, 0.4, 0.0).middle_radius == pytest.approx(0.5)


def test_the_percentiles_of_errors_are_bounds_and_so_rounded_up() -> None:
    photos = {f"{i}": photo(f"{i}.jpg", (0.0, 999.0 - 0.101 * i)) for i in range(21)}
    print_summary(flight(**photos), Console(file=(written := io.StringIO()), width=140))
    (row,) = (line for line in written.getvalue().splitlines() if "registration" in line and "│" in line)
    # Errors are 1 m and more, in steps of 0.101 m: 2.01 m, 2.818 m, and 2.919 m.
    assert [cell.strip() for cell in row.split("│")[3:6]] == ["2.0", "2.9", "3.0"]
    assert "p90 and p95 are bounds, and so rounded up" in written.getvalue()


def test_where_tags_lag_the_errors_without_the_lag_come_first() -> None:
    late = flight(a=photo("a.jpg", (0.0, 990.0)), b=photo("b.jpg", (0.0, 990.0)))
    late.tags_without_lag = np.array([(0.0, 998.0), (np.nan, np.nan)])
    print_summary(late, Console(file=(written := io.StringIO()), width=140))
    rows = [
        [cell.strip() for cell in line.split("│")[1:4]] for line in written.getvalue().splitlines() if "tags" in line
    ]
    assert rows[:2] == [
        ["registration, tags without their lag", "2", "2.0"],
        ["registration, tags as told", "2", "10.0"],
    ]


def test_without_a_truth_no_share_is_told() -> None:
    print_summary(flight(a=photo("a.jpg", None)), Console(file=(written := io.StringIO()), width=140))
    (row,) = (line for line in written.getvalue().splitlines() if "registration" in line)
    assert [cell.strip() for cell in row.split("│")[2:-1]] == ["1", *["-"] * 7]
    assert "how far off the places are is not known" in written.getvalue()
