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
from lpn.flight.files import Flight
from lpn.flight.locate import retrieval
from lpn.flight.locate.retrieval import retrieve
from lpn.flight.maps import Map, Window
from lpn.index import DescriptorKind, create_index, from_map
from lpn.index.folder import FolderIndex
from lpn.index.from_map import index_windows as fill_index
from lpn.index.from_map import window_describer, windows_kind
from lpn.models.base import Model
from tests.lpn.flight.locate.scenery import GridModel, land, photographed, write_map

KIND = DescriptorKind("grid", 2, 16)
FRAME = np.ones((1, 2, 16), np.float32)


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize("turns", [1, 2])
def test_an_index_that_is_still_being_filled_is_told(town: Map, monday: Flight, tmp_path: Path, turns: int) -> None:
    whole = turns * town.count_pyramid([40.0, 51.0])
    where = filled(tmp_path / "index", town, [40.0, 51.0], turns=turns, stop=16)
    found = retrieve(model(), town, monday, index=where)
    assert len(found.gallery.windows) == 16 // turns
    assert (None if found.gallery.turned is None else len(found.gallery.turned)) == (turns - 1 or None)
    assert found.notes[-1:] == [
        f"The index holds 16 of {whole} windows of the map, and no photo is found where it holds none; let lpn index --map go "
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
    assert any(f"were compared with the {len(found.gallery.windows)} of them" in note for note in found.notes)
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
