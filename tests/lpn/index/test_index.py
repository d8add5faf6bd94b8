from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn import descriptors
from lpn.cli.main import main
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, StoreError
from lpn.index import DegreeBox, DescriptorKind, Index, SearchResult, create_index, open_index
from lpn.index.base import checked, rescaled, scores_of
from lpn.index.faiss import FaissIndex
from lpn.index.folder import FolderIndex, rounding_bound
from lpn.models.base import normalise
from lpn.retrieval import scoring
from tests.conftest import Refused
from tools.fixtures import small_worlds

KIND = DescriptorKind("0123456789abcdef", 4, 16)
WEIGHTS: list[list[float] | None] = [None, [1, 0, 0, 0], [0.5, 0.1, 0, 0.4]]
BOXES: list[DegreeBox | None] = [None, (-30, -60, 40, 70), (-80, 150, 80, -140), (10, 20, 11, 21), (-90, 180, 90, -180)]


@dataclass
class Tiles:
    """The rows that an index should hold, and its answers by brute force in float64."""

    names: list[str]
    descriptors: Float32Array
    positions: np.ndarray[Any, Any]

    @classmethod
    def draw(cls, count: int, seed: int = 0, spread: float = 0.5, kind: DescriptorKind = KIND) -> Tiles:
        """Draw descriptors about a few centres, like real tiles'; a tenth have no position."""
        rng = np.random.default_rng(seed)
        shape = (kind.n_parts, kind.embedding)
        centres = rng.standard_normal((max(1, count // 20), *shape))
        drawn = centres[rng.integers(0, len(centres), count)] + spread * rng.standard_normal((count, *shape))
        positions = rng.uniform((-90, -180), (90, 180), (count, 2))
        positions[::10] = np.nan
        return cls([f"{i % 7}/tile {i}.jpg" for i in range(count)], normalise(drawn.astype(np.float32)), positions)

    def add_to(self, index: Index, step: int = 1000) -> None:
        for i in range(0, len(self.names), step):
            some = slice(i, i + step)
            index.add(self.names[some], self.descriptors[some], self.positions[some])

    def scores(self, query: Float32Array, weights: list[float] | None) -> np.ndarray[Any, Any]:
        shares = scoring.part_weights(len(query), weights).astype(np.float64)
        cosines = len(query) * (self.descriptors.astype(np.float64) * query).sum(axis=2)
        return np.asarray(cosines @ shares)

    def inside(self, box: DegreeBox | None) -> np.ndarray[Any, Any]:
        if box is None:
            return np.arange(len(self.names))
        south, west, north, east = box
        latitude, longitude = self.positions.T
        # East of the western border by fewer degrees than the box is wide.
        return np.flatnonzero(
            (latitude >= south) & (latitude <= north) & ((longitude - west) % 360 <= (east - west) % 360)
        )

    def check(
        self, found: SearchResult, query: Float32Array, weights: list[float] | None, k: int, box: DegreeBox | None
    ) -> None:
        scores, inside = self.scores(query, weights), self.inside(box)
        order = inside[np.argsort(-scores[inside], kind="stable")][:k]
        rows = np.array([self.names.index(name) for name in found.ids], np.int64)
        assert len(found) == len(order) == len(set(found.ids))
        assert set(rows) <= set(inside)
        # Names may differ only where scores are equal to the last digits of float64.
        np.testing.assert_allclose(found.scores, scores[order], rtol=0, atol=1e-12)
        np.testing.assert_allclose(scores[rows], scores[order], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found.vectors, self.descriptors[rows])
        np.testing.assert_array_equal(found.positions, self.positions[rows])


def _faiss(path: Path, kind: DescriptorKind = KIND) -> Index:
    """An index of faiss that searches all lists, and learns codes early."""
    pytest.importorskip("faiss", reason="faiss is not installed (the extra search)")
    index = FaissIndex.create(path, kind)
    index.nprobe, index.depth, index.plain = 10_000, 50, 4096
    return index


MAKERS: dict[str, Callable[[Path], Index]] = {"exact": lambda path: create_index(path, KIND), "faiss": _faiss}


@pytest.fixture(params=[*MAKERS])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Index]:
    """Return a function that opens an engine's index, empty at first; Milvus's is in test_milvus.py."""
    return lambda: MAKERS[request.param](tmp_path / "index")


def test_every_index_answers_as_brute_force_does(make: Callable[[], Index]) -> None:
    tiles = Tiles.draw(6000)
    rng = np.random.default_rng(1)
    queries = normalise(tiles.descriptors[:3] + 0.1 * rng.standard_normal((3, 4, 16)).astype(np.float32))
    with make() as index:
        tiles.add_to(index, 2500)
        assert index.count() == 6000
        for query in queries:
            for weights in WEIGHTS:
                for box in BOXES:
                    tiles.check(index.search(query, weights, 10, box), query, weights, 10, box)


def test_every_index_keeps_what_it_was_given(make: Callable[[], Index]) -> None:
    tiles, query = Tiles.draw(120), Tiles.draw(1, seed=9).descriptors[0]
    with make() as index:
        assert index.count() == 0
        assert len(index.search(query, None, 5)) == 0
        assert index.search(query, None, 5, (0, 0, 1, 1)).vectors.shape == (0, 4, 16)
        index.add([], np.zeros((0, 4, 16), np.float32))
        assert not index.holds(tiles.names).any()
        tiles.add_to(index, 50)
    with make() as index:  # opened again
        assert index.kind == KIND
        assert index.holds([*tiles.names, "none"]).tolist() == [True] * 120 + [False]
        tiles.check(index.search(query, None, 1000), query, None, 1000, None)
        # Half of them are added again with other vectors and places: they are replaced, not repeated.
        other = Tiles.draw(120, seed=5)
        tiles.descriptors[30:90], tiles.positions[30:90] = other.descriptors[30:90], other.positions[30:90]
        index.add(tiles.names[30:90], tiles.descriptors[30:90], tiles.positions[30:90])
        assert index.count() == 120
        for box in (None, BOXES[1]):
            tiles.check(index.search(query, [1, 2, 3, 4], 1000, box), query, [1, 2, 3, 4], 1000, box)
        some = [100, 3, 40, 89]  # of several segments, some of them replaced
        vectors, positions = index.read([tiles.names[i] for i in some])
        np.testing.assert_array_equal(vectors, tiles.descriptors[some])
        np.testing.assert_array_equal(positions, tiles.positions[some])
        assert [len(found) for found in index.read([])] == [0, 0]
        with pytest.raises(InputError, match="has no tile none"):
            index.read([tiles.names[0], "none"])


def test_names_of_all_kinds_come_back(make: Callable[[], Index]) -> None:
    names = ["a'b", 'say "hi"\\', "naïve/街/😀.jpg", " ", "x" * 512, "%s {0} or 1 == 1"]
    tiles = Tiles.draw(len(names))
    tiles.names = names
    with make() as index:
        tiles.add_to(index)
        assert index.holds(names).all()
        assert sorted(index.search(tiles.descriptors[0], None, 10).ids) == sorted(names)


def test_every_index_refuses_what_it_cannot_keep(make: Callable[[], Index]) -> None:
    tiles = Tiles.draw(2)
    one = tiles.descriptors[:1]
    with make() as index:
        tiles.add_to(index)
        bad_adds: list[tuple[str, Callable[[], None]]] = [
            ("is given twice", lambda: index.add(["a", "a"], tiles.descriptors)),
            ("1 to 512 characters", lambda: index.add(["x" * 513], one)),
            ("1 to 512 characters", lambda: index.add([""], one)),
            ("not UTF-8", lambda: index.add(["a\udcff"], one)),
            ("2 names for 1", lambda: index.add(["a", "b"], one)),
            ("takes \\(B, 4, 16\\)", lambda: index.add(["a"], one[:, :3])),
            ("has norm", lambda: index.add(["a"], one * 2)),
            ("has norm", lambda: index.add(["a"], one * np.float32(np.nan))),
            ("latitude 91", lambda: index.add(["a"], one, [(91, 0)])),
            ("latitude nan", lambda: index.add(["a"], one, [(np.nan, 0)])),
            ("of shape \\(2,\\)", lambda: index.add(["a"], one, np.zeros(2))),
        ]
        for message, add in bad_adds:
            with pytest.raises(InputError, match=message):
                add()
        query = tiles.descriptors[0]
        bad_searches: list[tuple[str, Callable[[], SearchResult]]] = [
            ("The query is of shape", lambda: index.search(query[:3], None, 1)),
            ("The query is of shape", lambda: index.search(query * np.inf, None, 1)),
            ("part weights", lambda: index.search(query, [1, 2], 1)),
            ("part weights", lambda: index.search(query, [0, 0, 0, 0], 1)),
            ("asked for is 0", lambda: index.search(query, None, 0)),
            ("The box is", lambda: index.search(query, None, 1, (10, 0, 0, 10))),
            ("The box is", lambda: index.search(query, None, 1, (0, 0, 10, 190))),
            ("The box is", lambda: index.search(query, None, 1, (np.nan, 0, 10, 10))),
        ]
        for message, search in bad_searches:
            with pytest.raises(InputError, match=message):
                search()
        assert index.count() == 2


@pytest.mark.parametrize("spread", [1e-4, 0.02, 1.0])
def test_an_exact_index_orders_tiles_as_a_scan_in_float64_does(tmp_path: Path, spread: float) -> None:
    kind = DescriptorKind("f", 4, 64)
    tiles = Tiles.draw(1500, spread=spread, kind=kind)
    # Equal tiles tie exactly, and keep the order of insertion; others differ in the last bit.
    tiles.descriptors[700:710] = tiles.descriptors[5]
    tiles.descriptors[800:810] = np.nextafter(tiles.descriptors[5], np.float32(1))
    with create_index(tmp_path / "a", kind) as whole, create_index(tmp_path / "b", kind) as parted:
        tiles.add_to(whole, 1500)
        tiles.add_to(parted, 400)
        beyond_float32 = 1e60 * tiles.descriptors[1234].astype(np.float64)
        for query in (*tiles.descriptors[[5, 77]], beyond_float32):
            for weights in WEIGHTS:
                scores = scores_of(tiles.descriptors.reshape(1500, -1), rescaled(kind, query, weights))
                order = np.argsort(-scores, kind="stable")
                for k in (1, 12, 700):
                    for index in (whole, parted):
                        found = index.search(query, weights, k)
                        assert found.ids == [tiles.names[i] for i in order[:k]]
                        np.testing.assert_array_equal(found.scores, scores[order[:k]])
        found = parted.search(tiles.descriptors[5], [1, 0, 0, 0], 11)
        ties = [name for name, score in zip(found.ids, found.scores, strict=True) if score == found.scores[0]]
        assert ties == sorted(ties, key=tiles.names.index)


def test_replaced_tiles_are_cleared_away(tmp_path: Path) -> None:
    tiles = Tiles.draw(400)
    with create_index(tmp_path / "index", KIND) as index:
        tiles.add_to(index)
        for start in range(0, 400, 40):
            index.add(tiles.names[start : start + 40], tiles.descriptors[start : start + 40])
        held = json.loads((tmp_path / "index" / "store.json").read_text())["parts"]
        assert sum(entry["rows"] for entry in held) == 400  # a part whose tiles are all replaced is deleted
        assert len(list((tmp_path / "index").iterdir())) == 11
        assert index.count() == 400


class Killed(BaseException):
    """In place of the process's end."""


@pytest.mark.parametrize("engine", ["exact", "faiss"])
def test_an_add_killed_at_any_step_leaves_the_index_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    tiles, query = Tiles.draw(60), Tiles.draw(1, seed=3).descriptors[0]
    with MAKERS[engine](tmp_path / "index") as index:
        tiles.add_to(index, 40)
        before = index.search(query, None, 100)
        changed = np.roll(tiles.descriptors[20:31], 1, axis=0)
        steps = untouched = 0
        while True:
            left = steps

            def step(original: Callable[..., Any], *given: Any, **more: Any) -> Any:
                nonlocal left
                if left == 0:
                    raise Killed
                left -= 1
                return original(*given, **more)

            with monkeypatch.context() as patch:
                for owner, name in ((os, "replace"), (Path, "mkdir"), (Path, "open"), (Path, "write_bytes")):
                    original = getattr(owner, name)
                    patch.setattr(owner, name, lambda *a, _o=original, **b: step(_o, *a, **b))
                try:
                    index.add([*tiles.names[20:30], "new"], changed)
                    break
                except Killed:
                    pass
            steps += 1
            with MAKERS[engine](tmp_path / "index") as again:
                after = again.search(query, None, 100)
                if "new" in after.ids:  # if the manifest was written, all tiles are there
                    assert len(after) == 61
                    rows = [after.ids.index(name) for name in tiles.names[20:30]]
                    np.testing.assert_array_equal(after.vectors[rows], changed[:10])
                    continue
                assert after.ids == before.ids
                np.testing.assert_array_equal(after.vectors, before.vectors)
                untouched += 1
        assert untouched >= 8
        assert index.count() == 61
        assert index.search(changed[1], [0, 0, 0, 1], 1).scores[0] == pytest.approx(1, abs=1e-6)
        held = json.loads((tmp_path / "index" / "store.json").read_text())["parts"]
        assert sorted(file.name for file in (tmp_path / "index").iterdir()) == sorted(
            ["store.json", *(entry["name"] for entry in held)]
        )


def test_a_reader_finds_what_another_learns_while_it_searches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The codes are opened at the first search, and deleted between the read of the manifest and this search."""
    kind = DescriptorKind("f", 4, 9)  # codes of a byte for each number
    tiles, adder = Tiles.draw(9400, kind=kind), _faiss(tmp_path / "index", kind)
    adder.add(tiles.names[:4600], tiles.descriptors[:4600], tiles.positions[:4600])
    reader = _faiss(tmp_path / "index", kind)
    current, waiting = reader._current, [True]

    def added_meanwhile() -> Any:
        parts = current()
        if waiting:
            waiting.clear()
            adder.add(tiles.names[4600:], tiles.descriptors[4600:], tiles.positions[4600:])
            current()  # as another thread's search does
        return parts

    monkeypatch.setattr(reader, "_current", added_meanwhile)
    query = tiles.descriptors[5000]
    with adder, reader:
        tiles.check(reader.search(query, None, 10), query, None, 10, None)
    (codes,) = (tmp_path / "index").glob("*.faiss")
    for damage, said in (
        (lambda: codes.write_bytes(b"none"), "is damaged; describe"),
        (codes.unlink, "is missing; describe"),
        (codes.mkdir, r"cannot be read \(Is a directory\); check its permissions"),
    ):
        damage()
        with _faiss(tmp_path / "index", kind) as damaged, pytest.raises(StoreError, match=said):
            damaged.search(query, None, 10)


def test_an_index_of_another_model_or_kind_is_refused(tmp_path: Path) -> None:
    create_index(tmp_path / "index", KIND).close()
    open_index(tmp_path / "index", KIND.fingerprint).close()
    with pytest.raises(StoreError, match="descriptors of model 0123456789abcdef, and this model is fedc"):
        open_index(tmp_path / "index", "fedc")
    with pytest.raises(StoreError, match="choose another folder"):
        create_index(tmp_path / "index", DescriptorKind("fedc", 4, 16))
    with pytest.raises(InputError, match="does not fit this address"):
        create_index(tmp_path / "other", KIND, "milvus")
    with pytest.raises(InputError, match="no engine 'lance'; expected one of exact, faiss, milvus"):
        create_index("lance://elsewhere/tiles", KIND)


def test_what_is_no_index_is_told_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="not an index"):
        open_index(tmp_path)
    index = create_index(tmp_path / "index", KIND)
    Tiles.draw(50).add_to(index)
    part = next(path for path in (tmp_path / "index").iterdir() if path.is_dir())
    for file in sorted(part.iterdir()):
        whole = file.read_bytes()
        for spoilt in (whole[:-8], b"", None):
            file.unlink()
            if spoilt is not None:
                file.write_bytes(spoilt)
            with pytest.raises(StoreError, match="is missing; describe" if spoilt is None else "is damaged; describe"):
                open_index(tmp_path / "index").holds(["any"])
            file.write_bytes(whole)
    open_index(tmp_path / "index").close()
    shutil.rmtree(part)
    with pytest.raises(StoreError, match=f"or delete the folder {tmp_path / 'index'} and make the index again"):
        create_index(tmp_path / "index", KIND)
    for text in ("", "[]", '{"format": "lpn-store/1"}', '{"format": "lpn-index/2", "settings": {}}'):
        (tmp_path / "index" / "store.json").write_text(text)
        with pytest.raises(StoreError, match="not of the format lpn-store/1"):
            open_index(tmp_path / "index")


def test_a_full_disk_is_told_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiles = Tiles.draw(50)
    with create_index(tmp_path / "index", KIND) as index:
        tiles.add_to(index)

        def full(*_: Any) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(np.lib.format, "write_array_header_1_0", full)
            with pytest.raises(StoreError, match=r"cannot be written \(No space left on device\)"):
                index.add(["more"], tiles.descriptors[:1])
        index.add(["more"], tiles.descriptors[:1])
        assert index.count() == 51


TILE = "test/gallery_satellite/0011/0011.png"


@pytest.fixture(scope="module")
def places(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with positions, whose tiles lie described in its folder `store`."""
    root = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path_factory.mktemp("tiles") / "places"))
    of = _options(model=model_file, images=root / "test/gallery_satellite", view="satellite", out=root / "store")
    assert main(["describe", *of]) == 0
    return root


def _options(**values: object) -> list[str]:
    return [text for name, value in values.items() for text in (f"--{name}", str(value))]


def test_a_store_is_indexed_and_a_picture_found(
    places: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    making = ["index", *_options(descriptors=places / "store", data=places, out=tmp_path / "i")]
    there = "14 were there already and are left; give --replace where pictures or positions"
    for options, added in (([], 14), ([], 0), (["--replace"], 14)):
        assert main([*making, *options]) == 0
        said = capsys.readouterr().out
        assert f"holds 14 tiles, {added} of them added now" in said
        assert (there in said) == (not added)
    json_file = tmp_path / "found.json"
    given = _options(index=tmp_path / "i", model=model_file, picture=places / TILE, view="satellite", json=json_file)
    assert main(["search", *given, "--top", "3", "--weights", "1,1,0,2"]) == 0
    assert "0011/0011.png" in capsys.readouterr().out
    found = json.loads(json_file.read_text())
    assert [match["rank"] for match in found["matches"]] == [1, 2, 3]
    first = found["matches"][0]
    assert first["tile"] == "0011/0011.png"
    assert first["score"] == pytest.approx(1, abs=1e-5)
    assert (first["latitude"], first["longitude"]) == pytest.approx((46 - 2 * 0.0009, 7 + 3 * 0.0013))
    for match, following in pairwise(found["matches"]):
        assert sum(part["contribution"] for part in match["parts"]) == pytest.approx(match["distance2"], abs=1e-5)
        assert match["gap"] == pytest.approx(following["distance2"] - match["distance2"], abs=1e-9)
    # Without the tile's own place, another is the nearest.
    assert main(["search", *given, "--box", "40", "0", "45.9975", "20"]) == 0
    found = json.loads(json_file.read_text())
    assert found["box"] == [40, 0, 45.9975, 20]
    assert {match["latitude"] <= 45.9975 for match in found["matches"]} == {True}
    assert main(["search", *given, "--box", "0", "0", "1", "1"]) == 0
    assert "no tile to compare with" in capsys.readouterr().out


def test_names_are_checked_before_anything_is_added(
    places: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpn.index.tiles._CHUNK_BYTES", 1)  # a chunk for each tile
    kept = descriptors.open_store(places / "store")
    for name, said in (("\udcff.png", "is not UTF-8"), ("x" * 513, "1 to 512 characters")):
        store = tmp_path / f"store{len(name)}"
        rows = [*kept.rows[:-1], kept.rows[-1]._replace(file=name)]
        descriptors.write_store(store, kept.kind, rows, lambda partial: partial.put(range(14), kept.float32))
        assert said in refused("index", "--descriptors", store, "--out", tmp_path / "i")
        assert not (tmp_path / "i").exists()


def test_the_number_of_tiles_is_checked_first(
    places: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["index", *_options(descriptors=places / "store", out=tmp_path / "i")]) == 0
    monkeypatch.setattr(FolderIndex, "most", 3)
    asked: list[int] = []
    search = FolderIndex.search
    monkeypatch.setattr(FolderIndex, "search", lambda self, q, w, k, box: asked.append(k) or search(self, q, w, k, box))
    of = _options(index=tmp_path / "i", model=model_file, picture=places / TILE, view="satellite")
    searching = ["search", *of]
    for top in (0, -1):
        assert main([*searching, f"--top={top}"]) == 2
        assert f"asked for is {top}; expected 1 or more" in capsys.readouterr().err
    for top in (2, 3):
        assert main([*searching, f"--top={top}"]) == 0
    assert asked == [3, 3]


def test_what_cannot_be_indexed_is_told_in_a_sentence(places: Path, tmp_path: Path, refused: Refused) -> None:
    into, store, elsewhere = ["--out", tmp_path / "i"], places / "store", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "geo.csv").write_text("path,latitude,longitude\nother.png,1,2\n")
    for given, said in (
        (["index", "--descriptors", tmp_path, *into], "not a store of descriptors"),
        (["index", "--descriptors", store, "--data", elsewhere, *into], "no position for any of the 14 tiles"),
    ):
        assert said in refused(*given)
        assert not (tmp_path / "i").exists()


def test_no_float32_score_is_off_by_more_than_its_bound_which_is_small() -> None:
    kind = DescriptorKind("f", 4, 64)
    tiles = Tiles.draw(2000, kind=kind)
    vectors = checked(kind, tiles.descriptors).reshape(2000, -1)
    for weights in (*WEIGHTS, [0, 0, 0, 1]):
        wanted = rescaled(kind, tiles.descriptors[3] * 3 - tiles.descriptors[4], weights)
        scores = (vectors @ wanted.astype(np.float32)).astype(np.float64)
        bound = rounding_bound(wanted)
        off = scores - vectors.astype(np.float64) @ wanted
        assert (scores - bound <= scores - off).all()
        over = bound + off
        assert (over >= 0).all()
        assert over.max() < 1e-4 * np.linalg.norm(wanted)
