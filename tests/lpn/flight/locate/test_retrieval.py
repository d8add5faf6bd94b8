"""Descriptors of windows and frames: centring, the cache, headings, and an index in place of the windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.consoles import Console
from lpn.core.errors import InputError, StoreError
from lpn.core.images import load_picture
from lpn.core.progress import listening
from lpn.flight.commands.locate import LocateCommand
from lpn.flight.files import Flight
from lpn.flight.files.cut import FrameReader, cut_size, cut_square
from lpn.flight.locate import retrieval
from lpn.flight.locate.retrieval import MapRetrieval, retrieve, whitening_of
from lpn.flight.maps import Map, Window
from lpn.index import DescriptorKind, create_index, from_map
from lpn.index.folder import FolderIndex
from lpn.index.from_map import index_windows as fill_index
from lpn.index.from_map import window_describer, windows_kind
from lpn.models.base import Model, normalise, whitened
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


KIND = DescriptorKind("grid", 2, 16)
FRAME = np.ones((1, 2, 16), np.float32)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(from_map, "BLOCK", 8)


def model() -> Model:
    return GridModel()  # type: ignore[return-value]


def filled(
    where: Path, town: Map, sizes: Sequence[float], overlap: float = 0.5, turns: int = 1, stop: int = 10**6
) -> str:
    """Fill an index; if a number is given, stop after so many windows."""
    describe = window_describer(model(), town)

    def described(windows: Sequence[Window]) -> Float32Array:
        nonlocal stop
        if stop <= 0:
            raise KeyboardInterrupt
        stop -= len(windows)
        return describe(windows)

    kind = windows_kind(model(), town, sizes, overlap, turns)
    with create_index(where, kind) as index, suppress(KeyboardInterrupt):
        fill_index(index, town, described)
    return str(where)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("centre", [False, True])
def test_windows_of_an_index_are_those_that_would_be_described(
    town: Map, monday: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, centre: bool
) -> None:
    monkeypatch.setattr(retrieval, "MIN_DISTINCT", 20 if centre else 100)
    plain = retrieve(model(), town, monday, [51.234567, 60.0], 0.5)
    where, counting = filled(tmp_path / "index", town, [60.0, 51.234567]), GridModel()
    found = retrieve(counting, town, monday, None, 0.9, where)  # type: ignore[arg-type]
    assert not counting.described, "frames are in the cache, and no window is described"
    assert found.gallery.overlap == 0.5
    assert found.notes == plain.notes
    assert found.gallery.windows == plain.gallery.windows
    assert len({float(found.scores(i).min()) for i in range(len(monday.frames))}) > 1
    for i in range(len(monday.frames)):
        # The windows of an index are cut where their names say, to a centimetre.
        np.testing.assert_allclose(found.scores(i), plain.scores(i), atol=5e-3)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("turns", [1, 2])
def test_an_index_that_is_still_being_filled_is_told(town: Map, monday: Flight, tmp_path: Path, turns: int) -> None:
    whole = turns * town.count_pyramid([40.0, 51.0])
    where = filled(tmp_path / "index", town, [40.0, 51.0], turns=turns, stop=16)
    found = retrieve(model(), town, monday, index=where)
    assert len(found.gallery.windows) == 16 // turns
    assert (None if found.gallery.turned is None else len(found.gallery.turned)) == (turns - 1 or None)
    assert found.notes[-1:] == [
        f"The index holds 16 of {whole} windows of the map, and photos of the others cannot be located; let lpn index --map go "
        "on to its end."
    ]
    filled(tmp_path / "index", town, [51.0, 40.0], turns=turns)
    assert not any("of the map, and" in note for note in retrieve(model(), town, monday, index=where).notes)


def test_an_index_holds_the_windows_that_it_was_made_for(town: Map, monday: Flight, tmp_path: Path) -> None:
    where = filled(tmp_path / "index", town, [51.0])
    for sizes, overlap, turns in (([40.0], 0.5, 1), ([51.0], 0.6, 1), ([51.0], 0.5, 2)):
        with pytest.raises(StoreError, match=r"of windows of 51 m with an overlap of 0.5 at 1 headings"):
            filled(tmp_path / "index", town, sizes, overlap, turns)
    elsewhere = write_map(tmp_path / "elsewhere.tif", cv2.resize(land(1), (400, 400), interpolation=cv2.INTER_AREA))
    with pytest.raises(InputError, match="holds windows of another map than elsewhere, or the map changed"):
        retrieve(model(), elsewhere, monday, index=where)
    with create_index(tmp_path / "tiles", KIND) as index:
        index.add(["tile.png"], FRAME / 4 / 2**0.5)
    with pytest.raises(InputError, match="does not say which windows of which map it holds"):
        retrieve(model(), town, monday, index=str(tmp_path / "tiles"))
    with pytest.raises(InputError, match="holds no window"):
        retrieve(model(), town, monday, index=filled(tmp_path / "empty", town, [51.0], stop=0))
    with create_index(tmp_path / "other", replace(KIND, fingerprint="another")):
        pass
    with pytest.raises(StoreError, match="holds descriptors of model another"):
        retrieve(model(), town, monday, index=str(tmp_path / "other"))


def test_of_an_index_too_large_to_return_all_the_nearest_windows_are_compared(
    town: Map, monday: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "MIN_DISTINCT", 100)  # the means are of other windows
    plain = retrieve(model(), town, monday, [51.0], 0.5)
    where = filled(tmp_path / "index", town, [51.0])
    monkeypatch.setattr(retrieval, "MOST", 3)
    monkeypatch.setattr(FolderIndex, "most", 3)
    found, count = retrieve(model(), town, monday, index=where), len(plain.gallery.windows)
    assert 3 < len(found.gallery.windows) < count
    assert any(f"were compared with the {len(found.gallery.windows)} most similar" in note for note in found.notes)
    for i in range(len(monday.frames)):
        # The three nearest of each are among them, and windows that resemble nothing score alike.
        np.testing.assert_allclose(np.sort(found.scores(i))[-3:], np.sort(plain.scores(i))[-3:], atol=5e-3)
    with pytest.raises(InputError, match="No photo of the flight can be read"):
        retrieve(model(), town, replace(monday, frames=monday.frames[2:3]), index=where)


def test_an_index_needs_a_model_and_takes_no_sizes(tmp_path: Path) -> None:
    for file, sizes in ((None, None), (tmp_path / "lpn.onnx", (60.0,))):
        with pytest.raises(InputError, match="give --index with --model and without --size"):
            LocateCommand(map=tmp_path, flight=tmp_path, model=file, size=sizes, index="index").located(Console())


@pytest.mark.parametrize(("told", "most", "turns"), [(None, None, 8), (90.0, None, 8), (None, 60, 8), (None, 60, 7)])
def test_of_turned_windows_a_photo_of_unknown_heading_is_described_once(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: float | None, most: int | None, turns: int
) -> None:
    middle = town.pyramid([60.0], 0.5)[14]
    place, heading = (middle.x, middle.y), 3 * 360 / turns
    flight, counting = photographed(tmp_path, town, [place], heading, (64, 64), 60.0, 90.0), GridModel()
    source = None if told is None else "course"
    flight = replace(flight, frames=(replace(flight.frames[0], heading=told, heading_source=source),))
    where = filled(tmp_path / "index", town, [60.0], turns=turns)
    if most is not None:
        monkeypatch.setattr(retrieval, "MOST", most)
    found = retrieve(counting, town, flight, index=where)  # type: ignore[arg-type]
    assert counting.described == 1
    assert len(found.views[0].headings) == turns
    (best,) = found.best(0, 1)
    assert best.heading == pytest.approx(heading)
    assert np.linalg.norm(np.array([best.x, best.y]) - place) < 1
    assert np.mean(best.cosines) == pytest.approx(best.score, abs=1e-5)
    if turns == 8:
        turned = retrieve(model(), town, flight, [60.0], 0.5)
        assert turned.views[0].headings == found.views[0].headings
        assert turned.scores(0).max() == pytest.approx(found.scores(0).max(), abs=0.1)
