from __future__ import annotations

import csv
import json
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from explorer.flight import page
from explorer.flight.service import SharedFlight
from lpn.core.errors import InputError
from lpn.flight.locate import corrections
from lpn.flight.locate.corrections import NAME
from lpn.flight.locate.located import LocatedFlight
from tests.explorer.flight.conftest import shared_flight

ADDRESSES = {"tiles": [], "photo": "p/", "square": "s/", "ground": "g/"}
CORNERS = np.array([(0.0, 30.0), (40.0, 30.0), (40.0, 0.0), (0.0, 0.0)])


@pytest.fixture
def service(flight: LocatedFlight, tmp_path: Path) -> SharedFlight:
    return shared_flight(flight, tmp_path)


def test_the_view_is_derived_once_and_again_when_something_changes(service: SharedFlight) -> None:
    first = service.snapshot()
    assert service.snapshot() is first
    service.correct(2, CORNERS)
    assert service.snapshot() is not first


def test_a_correction_is_a_track_of_its_own_and_lays_the_photo(service: SharedFlight) -> None:
    assert service.snapshot().flight.frames[2].laid is None
    service.correct(2, CORNERS)
    view = service.snapshot()
    track = page.data(view, ADDRESSES)["tracks"]["corrected"]
    assert (track["x"][:2], track["x"][2]) == ([None, None], pytest.approx(20.0, abs=0.01))
    matrix = view.flight.frames[2].laid
    middle = matrix @ (39.5, 29.5, 1.0)
    np.testing.assert_allclose(middle[:2] / middle[2], (20.0, 15.0), atol=1e-3)
    card = page.card(view, 2)
    assert card["lines"][-1].startswith("✎ By hand: 47.")
    assert card["facts"][-1] == "10.0 m from its correction", "the answer of the sequence lies 10 m south of it"
    service.correct(0, CORNERS)
    registered = service.snapshot().flight.frames[0]
    np.testing.assert_allclose(registered.laid, matrix, atol=1e-6)
    for frame in (0, 2):
        service.correct(frame, None)
    assert service.snapshot().flight.frames[2].laid is None
    assert "corrected" not in page.data(service.snapshot(), ADDRESSES)["tracks"]


def test_positions_are_one_a_photo_and_hold_the_corrections(service: SharedFlight) -> None:
    def column(name: str) -> list[str]:
        rows = csv.DictReader(service.positions(".csv").decode("utf-8-sig").splitlines())
        return [row[name] for row in rows]

    assert column("stage") == ["registration", "registration", "sequence"]
    assert column("state") == ["accepted", "contradicted", "accepted"]
    assert column("doubt")[1] == "sequence, tag"
    service.correct(2, CORNERS)
    assert column("stage") == ["registration", "registration", "by hand"]
    assert json.loads(service.positions(".geojson"))["type"] == "FeatureCollection"


def test_a_position_has_its_radius_with_and_without_the_error_of_the_map_s_place(
    service: SharedFlight, flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = flight.frames[0].stages
    answer = msgspec.structs.replace(stages["registration"], radius=5.0, place_error=4.0)
    monkeypatch.setitem(stages, "registration", answer)
    first, second, _ = csv.DictReader(service.positions(".csv").decode("utf-8-sig").splitlines())
    assert (first["radius_on_map_m"], first["radius_on_earth_m"]) == ("3.0", "5.0")
    assert (second["radius_on_map_m"], second["radius_on_earth_m"]) == ("1.0", "")


def test_corrections_at_once_are_all_in_the_view(service: SharedFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, may_end = threading.Event(), threading.Event()
    write = corrections.set_correction

    def slow(file: Path, name: str, *given: Any) -> dict[str, Any]:
        found = write(file, name, *given)
        if not begun.is_set():  # the first has read and written, and is the last to assign unless others wait
            begun.set()
            may_end.wait(0.3)
        else:
            may_end.set()
        return found

    monkeypatch.setattr(corrections, "set_correction", slow)
    first = threading.Thread(target=service.correct, args=(0, CORNERS))
    first.start()
    assert begun.wait(60)
    service.correct(1, CORNERS)
    first.join(60)
    assert sorted(service.snapshot().corrections) == ["photo0.png", "photo1.png"]


def test_two_servers_that_correct_one_photo_lose_neither_correction(flight: LocatedFlight, tmp_path: Path) -> None:
    first, second = shared_flight(flight, tmp_path), shared_flight(flight, tmp_path)
    assert not first.snapshot().corrections
    assert not second.snapshot().corrections
    first.correct(0, CORNERS)
    second.correct(1, CORNERS)
    stored = (tmp_path / NAME).read_bytes()
    shown: list[bool] = []  # by the other browsers of the first server: the second one's correction
    first.watchers.watch(lambda: shown.append("photo1.png" in first.snapshot().corrections))
    with pytest.raises(InputError, match="Somebody else has corrected this photo meanwhile; save again to replace"):
        first.correct(1, CORNERS + 5)
    assert (tmp_path / NAME).read_bytes() == stored
    assert shown == [True]
    assert page.data(first.snapshot(), ADDRESSES)["tracks"]["corrected"]["x"] == [20.0, 20.0, None]
    first.correct(1, CORNERS + 5)
    with pytest.raises(InputError, match="Somebody else"):
        second.correct(1, None)
    second.correct(1, None)
    assert corrections.read_corrections(tmp_path / NAME).keys() == {"photo0.png"}


def test_a_damaged_file_of_corrections_is_left_out_with_a_note(service: SharedFlight, tmp_path: Path) -> None:
    (tmp_path / NAME).write_text("nonsense")
    assert service.snapshot().corrections == {}
    notes = page.data(service.snapshot(), ADDRESSES)["notes"]
    assert notes[-1].startswith("Corrections are left out: The first line")
