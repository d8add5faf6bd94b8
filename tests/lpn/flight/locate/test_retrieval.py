"""Descriptors of windows and frames: centring, the cache, and headings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core.arrays import UInt8Array
from lpn.core.images import load_picture
from lpn.core.progress import listening
from lpn.flight.files import Flight
from lpn.flight.files.cut import FrameReader, cut_size, cut_square
from lpn.flight.locate import retrieval
from lpn.flight.locate.retrieval import MapRetrieval, retrieve, whitening_of
from lpn.flight.maps import Map
from lpn.models.base import normalise, whitened
from tests.lpn.flight.locate.scenery import FLOWN_PLACES, GridModel, land, photographed, write_map

Fly = Callable[..., Flight]
SIZE = (64, 64)
WIDTH = 60.0
# The middle of a window of the map.
HERE = (-38.25, 12.75)


@pytest.fixture
def fly(town: Map, tmp_path: Path) -> Fly:
    """A function that photographs the land at places."""

    def photos(places: Sequence[tuple[float, float]], heading: float = 0.0) -> Flight:
        return photographed(tmp_path, town, places, heading, SIZE, WIDTH, 90.0)

    return photos


def _retrieved(model: GridModel, town: Map, flight: Flight) -> MapRetrieval:
    return retrieve(model, town, flight, overlap=0.75)  # type: ignore[arg-type]


def _off(found: MapRetrieval, frame: int, place: tuple[float, float]) -> float:
    return float(np.linalg.norm(found.gallery.places[found.scores(frame).argmax()] - place))


def test_few_or_equal_frames_are_not_centred(town: Map, fly: Fly) -> None:
    found = _retrieved(GridModel(), town, fly([HERE] * 20))
    assert found.scores(0).max() > 0.8
    assert _off(found, 0, HERE) < 10
    assert "the flight has 1." in found.notes[0]
    far = [HERE, (30.0, -35.0)]
    found = _retrieved(GridModel(), town, fly(far))
    assert [_off(found, i, place) < 10 for i, place in enumerate(far)] == [True, True]
    assert "the flight has 2." in found.notes[0]


def test_windows_of_an_unfit_size_are_named(town: Map, fly: Fly) -> None:
    flight = fly([HERE, (30.0, -35.0)])
    shown = cut_size(flight.frames[0])
    for factor, named in ((1.35, False), (1.45, True), (1 / 1.45, True)):
        notes = retrieve(GridModel(), town, flight, [factor * shown], 0.5).notes[:-1]  # type: ignore[arg-type]
        compared = f"are compared with windows of {factor * shown:.0f} m, so"
        expected = f"2 of 2 photos show squares of {shown:.0f} m of ground and {compared}"
        assert len(notes) == named
        assert all(note.startswith(expected) for note in notes)


def test_many_distinct_frames_are_centred(town: Map, fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = fly(FLOWN_PLACES)
    found = _retrieved(GridModel(), town, flight)
    assert not found.notes
    described = np.concatenate([one for one in found.frames_described if one is not None])
    np.testing.assert_allclose(np.linalg.norm(described, axis=2), 1 / np.sqrt(2), rtol=1e-5)
    assert found.whitening.shape == (2, 16, 16)
    monkeypatch.setattr(retrieval, "MIN_DISTINCT", 21)
    plain = _retrieved(GridModel(), town, flight)
    expected = normalise(whitened(plain.gallery.described - found.means["satellite"], found.whitening))
    np.testing.assert_allclose(found.gallery.described, expected, atol=1e-6)


def test_whitening_evens_out_what_all_pictures_share() -> None:
    rng = np.random.default_rng(0)
    # One direction varies ten times as much as the others, and says nothing of the place.
    places = rng.normal(size=(300, 2, 32))
    tiles, queries = (places + 0.3 * rng.normal(size=places.shape) for _ in range(2))
    for view in (tiles, queries):
        view[:, :, 0] = 10 * rng.normal(size=(300, 2))
    matrices = whitening_of(tiles.astype(np.float32), queries.astype(np.float32))
    np.testing.assert_allclose(matrices, matrices.swapaxes(1, 2), atol=1e-6)

    def right(a: np.ndarray, b: np.ndarray) -> float:
        a, b = (normalise(view.astype(np.float32)).reshape(300, -1) for view in (a, b))
        return float(((a @ b.T).argmax(axis=1) == np.arange(300)).mean())

    assert right(queries, tiles) < 0.5
    assert right(whitened(queries, matrices), whitened(tiles, matrices)) > 0.9


def test_the_best_windows_of_places_apart(town: Map, fly: Fly) -> None:
    found = _retrieved(GridModel(), town, fly([HERE]))
    order = np.argsort(-found.scores(0), kind="stable")
    np.testing.assert_array_equal(found.first(0, 7), order[:7])
    expected: list[int] = []
    for i in order.tolist():
        off = np.abs(found.gallery.places[expected] - found.gallery.places[i]).max(axis=1, initial=0)
        if (off >= found.gallery.sizes[0] / 2).all():
            expected.append(i)
    best = [(one.x, one.y, one.score) for one in found.best(0, 4)]
    np.testing.assert_allclose(best, [(*found.gallery.places[i], found.scores(0)[i]) for i in expected[:4]])


def test_a_broken_frame_leaves_the_others_in_the_cache(town: Map, fly: Fly) -> None:
    flight = fly([HERE, (30.0, -35.0), (0.0, 0.0)])
    flight.frames[1].file.write_bytes(b"nothing")
    first = GridModel()
    found = _retrieved(first, town, flight)
    again = GridModel()
    second = _retrieved(again, town, flight)
    assert first.described == len(found.gallery.windows) + 2
    assert again.described == 0
    assert list(found.broken) == list(second.broken) == [1]
    assert second.broken[1]
    assert second.frames_described[1] is None
    np.testing.assert_array_equal(second.scores(2), found.scores(2))


def test_a_stopped_retrieval_goes_on_where_it_was(town: Map, fly: Fly, tmp_path: Path) -> None:
    flight = fly([HERE, (30.0, -35.0)])

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "Describing windows" and done > total / 2:
            raise KeyboardInterrupt

    first, second = GridModel(), GridModel()
    with pytest.raises(KeyboardInterrupt), listening(stop):
        retrieve(first, town, flight, overlap=0.75)  # type: ignore[arg-type]
    resumed = _retrieved(second, town, flight)
    windows = len(resumed.gallery.windows)
    assert windows / 2 < first.described < windows
    assert second.described < windows / 2 + len(flight.frames)
    other, third = write_map(tmp_path / "other.tif", land(1)), GridModel()
    assert len(_retrieved(third, other, flight).gallery.windows) == third.described, "another map's are others"
    np.testing.assert_array_equal(resumed.gallery.described[:8], _retrieved(second, town, flight).gallery.described[:8])
    assert (np.linalg.norm(resumed.gallery.described, axis=2) > 0.1).all()


def test_the_heading_of_an_aircraft_is_left_only_for_a_clearly_better_one(town: Map, fly: Fly) -> None:
    flight = fly([HERE])
    frame = replace(flight.frames[0], heading_source="aircraft")
    found = _retrieved(GridModel(), town, replace(flight, frames=(frame,)))
    flat = found.gallery.described.reshape(len(found.gallery.windows), -1)
    described = found.frames_described[0]
    scores = (flat @ described.reshape(12, -1).T).astype(np.float64)
    free = replace(found, views=[replace(found.views[0], aircraft=False)])
    np.testing.assert_allclose(free.scores(0), scores.max(axis=1))
    scores[:, 5:] -= 1.5 * scores.std()
    np.testing.assert_allclose(found.scores(0), scores.max(axis=1))
    assert found.scores(0).argmax() == free.scores(0).argmax()
    # An aircraft that drifts by 20 degrees costs nothing.
    drifting = _retrieved(GridModel(), town, replace(flight, frames=(replace(frame, heading=340.0),)))
    assert drifting.best(0, 1)[0].heading == 0
    np.testing.assert_allclose(drifting.scores(0).max(), found.scores(0).max())
    # Turned by 90 degrees, the picture is still found.
    turned = replace(frame, heading=270.0)
    found = _retrieved(GridModel(), town, replace(flight, frames=(turned,)))
    assert found.best(0, 1)[0].heading == 0
    assert _off(found, 0, HERE) < 10


def test_a_course_is_one_of_several_turns(town: Map, fly: Fly) -> None:
    flight = fly([HERE], heading=90.0)
    frame = replace(flight.frames[0], heading=0.0, heading_source="course")
    found = _retrieved(GridModel(), town, replace(flight, frames=(frame,)))
    assert found.best(0, 1)[0].heading == 90
    assert _off(found, 0, HERE) < 10


def test_a_frame_of_several_turns_is_read_once(town: Map, fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = fly([HERE, (30.0, -35.0), (0.0, 0.0)])
    frames = tuple(replace(frame, heading=None, heading_source=None) for frame in flight.frames)
    read: list[Path] = []

    def counted(file: Path) -> UInt8Array:
        read.append(file)
        return load_picture(file)

    monkeypatch.setattr("lpn.core.images.load_picture", counted)
    found = _retrieved(GridModel(), town, replace(flight, frames=frames))
    assert found.views[0].headings == [45 * k for k in range(8)]
    assert sorted(read) == sorted(frame.file for frame in frames)
    assert [len(views.headings) for views in found.views] == [8, 8, 8]
    assert found.best(1, 1)[0].heading == 0


def test_squares_of_reduced_pictures_are_those_of_whole_ones(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 256, (30, 45, 3), np.uint8), (333, 217), interpolation=cv2.INTER_CUBIC)
    file = tmp_path / "a.png"
    cv2.imwrite(str(file), picture[..., ::-1])
    for share, pixels in ((0.62, 32), (0.8, 64), (0.3, 128)):
        reader = FrameReader(pixels)
        for heading in (0.0, 45.0, 203.0):
            np.testing.assert_array_equal(reader(file, heading, share), cut_square(picture, heading, share, pixels))
