"""An index of a map's windows in place of describing them, and the indexes that are refused."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core.arrays import Float32Array
from lpn.core.consoles import Console
from lpn.core.errors import InputError, StoreError
from lpn.flight.commands.locate import LocateCommand
from lpn.flight.files import Flight, Frame
from lpn.flight.files.base import HeadingSource
from lpn.flight.locate import index_windows
from lpn.flight.locate.index_windows import WindowIndex
from lpn.flight.locate.retrieval import retrieve
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.index import ExactIndex, create_index
from lpn.index import folder as index_folder
from lpn.index.base import DescriptorKind
from lpn.index.from_map import index_windows as fill_index
from lpn.index.from_map import window_describer
from tests.lpn.flight.locate.scenery import GridModel, ground_to_photo, land, photo_of, small_flight, write_map

KIND = DescriptorKind("grid", 2, 16)


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def town(tmp_path: Path) -> Map:
    return write_map(tmp_path / "town.tif", cv2.resize(land(), (400, 400), interpolation=cv2.INTER_AREA))


def _refused(folder: Path, town: Map, names: list[str], vectors: np.ndarray) -> str:
    with create_index(folder, KIND) as index:
        if names:
            index.add(names, vectors)
    with pytest.raises(InputError) as refusal:
        WindowIndex(str(folder), GridModel(), town)  # type: ignore[arg-type]
    return str(refusal.value)


def test_windows_of_an_index_are_those_that_would_be_described(town: Map, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    flight = small_flight(tmp_path / "photos", town)
    model = GridModel()
    for centre in (False, True):
        plain = retrieve(model, town, flight, [51.0], 0.6, centre)  # type: ignore[arg-type]
        if not centre:
            with create_index(tmp_path / "index", KIND) as index:
                named = [one.name for one in NamedWindow.all_of(plain.windows, town.frame)]
                index.add(named[::-1], plain.windows_described[::-1])
        model.described = 0
        indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
        assert model.described == 4
        found = retrieve(model, town, flight, None, 0.9, centre, indexed=indexed)  # type: ignore[arg-type]
        assert model.described == 4, "frames are in the cache, and no window is described"
        assert found.overlap == pytest.approx(0.6, abs=0.001)
        order = [int(np.linalg.norm(found.places - place, axis=1).argmin()) for place in plain.places]
        np.testing.assert_allclose(found.places[order], plain.places, atol=0.02)
        for i in range(len(flight.frames)):
            np.testing.assert_allclose(found.scores(i)[order], plain.scores(i), atol=1e-4)


def test_an_index_that_is_still_being_filled_is_told(town: Map, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    flight = small_flight(tmp_path / "photos", town)
    model = GridModel()
    plain = retrieve(model, town, flight, [51.0], 0.6, centre=False)  # type: ignore[arg-type]
    names = [one.name for one in NamedWindow.all_of(plain.windows, town.frame)]
    half = len(names) // 2
    with create_index(tmp_path / "index", KIND) as index:
        index.add(names[:half], plain.windows_described[:half])
    for held in (half, len(names)):
        indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
        notes = retrieve(model, town, flight, centre=False, indexed=indexed).notes  # type: ignore[arg-type]
        told = f"The index holds {half:,} of some {len(names):,} windows of the map"
        assert any(told in note for note in notes) == (held == half)
        with create_index(tmp_path / "index", KIND) as index:
            index.add(names[half:], plain.windows_described[half:])


FRAME = np.ones((1, 2, 16), np.float32)


def _fill(
    where: Path, town: Map, sizes: list[float], overlap: float = 0.5, stop: int | None = None, **how: int
) -> None:
    """Fill an index, and stop after some windows where that is told."""
    describe = window_describer(GridModel(), town)  # type: ignore[arg-type]
    left = stop or 10**6

    def described(windows: Sequence[Window]) -> Float32Array:
        nonlocal left
        if left <= 0:
            raise KeyboardInterrupt
        left -= len(windows)
        return describe(windows)

    with create_index(where, KIND) as index, suppress(KeyboardInterrupt):
        fill_index(index, town, described, sizes, overlap, **how)  # type: ignore[arg-type]


def _partial(where: Path, town: Map) -> list[str]:
    """Return what the notes tell of the number of windows."""
    notes = WindowIndex(str(where), GridModel(), town).near(FRAME).notes  # type: ignore[arg-type]
    return [note.split(" windows of the map,")[0] for note in notes if "windows of the map," in note]


def test_an_index_that_stopped_between_two_sizes_is_told_and_a_whole_one_is_not_written(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, sizes = tmp_path / "index", [40.0, 51.0, 102.0]
    held = town.count_pyramid(sizes[:1])
    _fill(where, town, sizes, stop=2 * held, turns=2)
    assert _partial(where, town) == [f"The index holds {held} of {town.count_pyramid(sizes)}"]
    with monkeypatch.context() as patch:
        _fill(tmp_path / "begun", town, [40.0], stop=8, block=8)
        patch.setattr(Map, "pyramid_blocks", lambda *_: pytest.fail("more windows are named than the index holds"))
        assert _partial(tmp_path / "begun", town) == [f"The index holds 8 of {held}"]
    _fill(where, town, sizes, turns=2)
    assert _partial(where, town) == []
    with monkeypatch.context() as patch:
        patch.setattr(index_folder, "exclusive_lock", lambda *_, **__: pytest.fail("a whole index is written again"))
        _fill(where, town, sizes, turns=2)


def test_windows_of_another_overlap_or_size_do_not_stand_for_those_that_lack(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = tmp_path / "overlaps"
    _fill(where, town, [60.0])
    _fill(where, town, [60.0], 0.6, stop=20, block=10)
    assert _partial(where, town)[0].endswith(" of 49")
    with monkeypatch.context() as patch:
        patch.setattr(index_windows, "MOST", 50)
        assert _partial(where, town)[0].endswith(" of some 85"), "of a large index, windows are counted alone"
        _fill(where, town, [60.0], 0.6)
        assert _partial(where, town) == []
    assert _partial(where, town) == []
    where = tmp_path / "sizes"
    windows = NamedWindow.all_of(town.pyramid([40.0], 0.5), town.frame)
    with create_index(where, KIND) as index:
        rounded = NamedWindow.all_on(windows, town.frame)
        index.add([one.name for one in windows], window_describer(GridModel(), town)(rounded))  # type: ignore[arg-type]
    _fill(where, town, [60.0], stop=8, block=8)
    assert _partial(where, town) == ["The index holds 89 of some 117"]
    monkeypatch.setattr(index_windows, "MOST", 80)
    (told,) = _partial(where, town)
    assert told.startswith("The index holds 89 of at least some ")
    _fill(where, town, [60.0])
    assert _partial(where, town) == []


def test_windows_that_lie_close_together_do_not_make_an_estimate_grow_without_end(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = NamedWindow.all_of([Window(0.1 * i, 0.0, 60.0) for i in range(5)], town.frame)
    with create_index(tmp_path / "index", KIND) as index:
        close = NamedWindow.all_on(named, town.frame)
        index.add([one.name for one in named], window_describer(GridModel(), town)(close))  # type: ignore[arg-type]
    monkeypatch.setattr(index_windows, "_MOST_ESTIMATED", 1000)
    (told,) = _partial(tmp_path / "index", town)
    assert 100 < int(told.removeprefix("The index holds 5 of some ").replace(",", "")) <= 1000


def test_indexes_that_do_not_hold_the_windows_of_a_map_are_refused(town: Map, tmp_path: Path) -> None:
    windows = town.pyramid([60.0], 0.5)
    names = [one.name for one in NamedWindow.all_of(windows, town.frame)]
    side = GridModel.input_size[0]
    model = GridModel()
    pictures = np.stack([model.prepare(town.read(window, side)[0], "satellite") for window in windows])
    vectors = model.descriptors(pictures, "satellite")
    with create_index(tmp_path / "other", replace(KIND, fingerprint="another")):
        pass
    with pytest.raises(StoreError, match="holds descriptors of model another"):
        WindowIndex(str(tmp_path / "other"), model, town)  # type: ignore[arg-type]
    assert "holds no window" in _refused(tmp_path / "empty", town, [], vectors)
    turned = f"{names[0]},30deg"
    assert turned in _refused(tmp_path / "turned", town, [turned, *names[1:]], vectors)
    assert "tile.png" in _refused(tmp_path / "tiles", town, ["tile.png"], vectors[:1])
    elsewhere = write_map(tmp_path / "elsewhere.tif", cv2.resize(land(1), (400, 400), interpolation=cv2.INTER_AREA))
    assert "it is of another map, or the map has changed" in _refused(tmp_path / "index", elsewhere, names, vectors)


def test_of_an_index_too_large_to_return_all_the_nearest_windows_are_compared(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photos").mkdir()
    flight = small_flight(tmp_path / "photos", town)
    model = GridModel()
    plain = retrieve(model, town, flight, [51.0], 0.6, centre=False)  # type: ignore[arg-type]
    with create_index(tmp_path / "index", KIND) as index:
        index.add([one.name for one in NamedWindow.all_of(plain.windows, town.frame)], plain.windows_described)
    monkeypatch.setattr(ExactIndex, "most", 3)
    indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
    assert indexed.sizes == [51.0]
    found = retrieve(model, town, flight, centre=False, indexed=indexed)  # type: ignore[arg-type]
    assert 3 < len(found.windows) < len(plain.windows)
    assert any(f"were compared with the {len(found.windows)} of them" in note for note in found.notes)
    for i in range(len(flight.frames)):
        # The three nearest of each are among them, and windows that resemble nothing score alike.
        np.testing.assert_allclose(np.sort(found.scores(i))[-3:], np.sort(plain.scores(i))[-3:], atol=1e-4)
    monkeypatch.setattr(index_windows, "MOST", 3)
    monkeypatch.setattr(ExactIndex, "most", None)
    with pytest.raises(InputError, match="No photo of the flight can be read"):
        WindowIndex(str(tmp_path / "index"), model, town).near(np.zeros((2, 2, 16), np.float32))  # type: ignore[arg-type]


def test_an_index_needs_a_model_and_takes_no_sizes(tmp_path: Path) -> None:
    for model, sizes in ((None, None), (tmp_path / "lpn.onnx", (60.0,))):
        with pytest.raises(InputError, match="give --index with --model and without --size"):
            LocateCommand(map=tmp_path, flight=tmp_path, model=model, size=sizes, index="index").located(Console())


@pytest.mark.parametrize(("told", "most"), [(None, None), (90.0, None), (None, 60)])
def test_of_turned_windows_a_photo_of_unknown_heading_is_described_once(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: float | None, most: int | None
) -> None:
    middle = town.pyramid([51.0], 0.6)[25]
    place, width, size = (middle.x, middle.y), 60.0, (64, 64)
    photo = photo_of(land(), ground_to_photo(place, 135.0, width, size), size)
    cv2.imwrite(str(tmp_path / "photo.png"), photo[..., ::-1])
    source: HeadingSource | None = None if told is None else "course"
    frame = Frame(
        "photo.png",
        tmp_path / "photo.png",
        *size,
        height_above_ground=30.0,
        heading=told,
        heading_source=source,
        fov=90.0,
    )
    model, flight = GridModel(), Flight("turned", (frame,))
    with create_index(tmp_path / "index", KIND) as index:
        fill_index(index, town, window_describer(model, town), [51.0], 0.6, turns=8)  # type: ignore[arg-type]
    monkeypatch.setattr(ExactIndex, "most", most)
    indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
    assert indexed.turns == [45 * k for k in range(8)]
    model.described = 0
    found = retrieve(model, town, flight, centre=False, indexed=indexed)  # type: ignore[arg-type]
    assert model.described == 1
    assert len(found.headings[0]) == 8
    top = found.top(0, 1)
    assert top.headings[0] == 135
    assert np.linalg.norm(found.places[top.indices[0]] - place) < 1
    assert top.cosines[0].mean() == pytest.approx(top.scores[0], abs=1e-5)
    turned = retrieve(model, town, flight, [51.0], 0.6, centre=False)  # type: ignore[arg-type]
    assert turned.headings == found.headings
    assert turned.scores(0).max() == pytest.approx(found.scores(0).max(), abs=0.1)


def test_headings_that_names_round_are_even_and_a_turn_that_is_missing_is_named(town: Map, tmp_path: Path) -> None:
    model = GridModel()
    describe = window_describer(model, town)  # type: ignore[arg-type]
    with create_index(tmp_path / "index", KIND) as index:
        fill_index(index, town, describe, [51.0], 0.6, turns=7)
        more = town.pyramid([40.0], 0.6)[:1]
        names = [one.name for one in NamedWindow.all_of(more, town.frame)]
        indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
        assert len(indexed.turns) == 7
        index.add(names, describe(more))
    indexed = WindowIndex(str(tmp_path / "index"), model, town)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="The index lacks 6 windows at some of its headings"):
        indexed.near(describe(more))
