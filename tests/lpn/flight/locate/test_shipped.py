"""Answers that ship with a flight: the demo's are used, and answers of other data are not."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import lpn
from explorer.opening import OFFERED_OVERLAP
from lpn.core.demo import DEMO_ANSWERS, DEMO_BASELINE, DEMO_FLIGHT, DEMO_MODEL, DEMO_PLACE
from lpn.core.progress import listening
from lpn.flight.files import open_flight
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate, registered
from lpn.flight.locate.shipped import ShippedAnswers
from lpn.flight.maps import open_map

pytest.importorskip("rasterio")
OPTIONS = LocateOptions(overlap=OFFERED_OVERLAP, register=False)


@pytest.mark.parametrize(("place", "accepted"), [(DEMO_PLACE, 30), (DEMO_FLIGHT, 28)])
def test_nothing_of_the_demo_s_flights_is_computed_again(
    place: tuple[Path, Path], accepted: int, tmp_path: Path
) -> None:
    model, basemap, flight = lpn.load(DEMO_MODEL), open_map(place[0]), open_flight(place[1])
    shipped, described = place[0].with_name(DEMO_ANSWERS), []
    with listening(lambda stage, done, _: described.append((stage, done))):
        located = locate(basemap, flight, model, OPTIONS, shipped=shipped)
    whole = registered(located, model, OPTIONS)
    assert described == []
    lags = place is DEMO_PLACE
    assert (located.late_tags is not None, located.judge_of(0)) == (lags, "its details" if lags else "its GPS tag")
    assert whole.audit.has_lag == lags
    assert not lags or "or the camera looks 8.6 m ahead" in whole.audit.sentence
    assert whole.stages == ["retrieval", "sequence", "registration"]
    assert sum(frame.stages["registration"].accepted for frame in whole.frames) >= accepted
    assert list(tmp_path.rglob("*.npy")) == list(tmp_path.rglob("*.jsonl")) == []


def test_answers_of_another_model_map_or_flight_are_not_taken(tmp_path: Path) -> None:
    model, basemap, flight = lpn.load(DEMO_MODEL), open_map(DEMO_PLACE[0]), open_flight(DEMO_PLACE[1])
    folder = tmp_path / "answers"
    shutil.copytree(DEMO_PLACE[0].with_name(DEMO_ANSWERS), folder)
    answers = ShippedAnswers.open(folder, model, basemap, flight)
    assert set(answers.record.registration) == {frame.name for frame in flight.frames}
    assert ShippedAnswers.open(folder, lpn.load(DEMO_BASELINE), basemap, flight) is None
    assert ShippedAnswers.open(folder, model, open_map(DEMO_FLIGHT[0]), flight) is None
    fewer = replace(flight, frames=flight.frames[1:])
    assert ShippedAnswers.open(folder, model, basemap, fewer) is None
    windows = basemap.pyramid([40.0], 0.5)
    assert answers.windows(windows, max(model.input_size)) is None
    (folder / "located.json").write_text("{")
    assert ShippedAnswers.open(folder, model, basemap, flight) is None


def test_damaged_descriptors_are_computed_again(tmp_path: Path) -> None:
    model, basemap, flight = lpn.load(DEMO_MODEL), open_map(DEMO_PLACE[0]), open_flight(DEMO_PLACE[1])
    folder, described = tmp_path / "answers", []
    shutil.copytree(DEMO_PLACE[0].with_name(DEMO_ANSWERS), folder)
    (array,) = (folder / "windows").glob("*/vectors.npy")
    data = bytearray(array.read_bytes())
    data[-1] ^= 255
    array.write_bytes(data)

    class StopError(Exception):
        pass

    def stop(stage: str, *_: int) -> None:
        described.append(stage)
        raise StopError

    with pytest.raises(StopError), listening(stop):
        locate(basemap, flight, model, OPTIONS, shipped=folder)
    assert described == ["Describing windows"]
