from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import lpn
from lpn import descriptors
from lpn.core.errors import InputError, StoreError
from lpn.datasets import geo, open_dataset
from lpn.descriptors.transforms import Change
from lpn.index import DescriptorKind, IndexEngine, SearchResult, create_index, ground
from lpn.index.queries import dataset_queries, picture_queries
from lpn.index.ranking import IndexRanking
from lpn.index.shared import SharedIndex
from lpn.index.task import IndexTask, index_task
from lpn.index.tile_pictures import TilePlaceholder
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from lpn.models.base import Model, normalise
from lpn.tasks.gallery_task import GalleryTask
from lpn.tasks.opening import describe_task
from tools.fixtures import layouts, small_worlds

# More tiles than a search returns.
PLACES, DEPTH = 30, 12


@pytest.fixture(scope="module")
def model(model_file: Path) -> Model:
    return lpn.load(model_file)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Places 2 to 31, each with one drone picture; every fourth shows another place, so that it is not found."""
    root = small_worlds.make_dataset(tmp_path_factory.mktemp("places") / "places", train=1, test=PLACES)
    for label in range(2, PLACES + 2, 4):
        shown = small_worlds.from_drone(small_worlds.place(label % PLACES + 3), label)
        small_worlds.write(root / "test" / "query_drone" / f"{label:04d}" / "image-01.png", shown)
    return small_worlds.map_dataset(root)


@pytest.fixture(scope="module")
def whole(places: Path, model: Model) -> GalleryTask:
    """The task in memory."""
    return describe_task(model, "model.onnx", open_dataset(places), "drone-to-satellite")


def _index(where: Path, whole: GalleryTask, engine: IndexEngine = "exact", positions: bool = True) -> SharedIndex:
    """An index of the gallery, as lpn describe of its folder and lpn index make it."""
    index = create_index(where, DescriptorKind(whole.model.fingerprint, 4, 512), engine)  # type: ignore[union-attr]
    folder = whole.root / "test" / "gallery_satellite"
    names = [tile.path.relative_to(folder).as_posix() for tile in whole.gallery]
    assert whole.geometry is not None
    degrees = np.array([(place.latitude, place.longitude) for place in whole.geometry.tiles])
    index.add(names, whole.gallery_descriptors, degrees if positions else None)
    return SharedIndex(index)


@pytest.fixture(params=["exact", "faiss"])
def task(request: pytest.FixtureRequest, tmp_path: Path, whole: GalleryTask, model: Model) -> Iterator[IndexTask]:
    if request.param == "faiss":
        pytest.importorskip("faiss")
    index = _index(tmp_path / "index", whole, request.param)
    yield index_task(model, "model.onnx", index, dataset_queries(model, open_dataset(whole.root), index), DEPTH)
    index.close()


def _analyser(model: Model) -> QueryAnalyser:
    return QueryAnalyser(model, lambda task, index: describe_tile(task, index, model))


def test_an_index_answers_as_the_gallery_in_memory_does(task: IndexTask, whole: GalleryTask, model: Model) -> None:
    assert (task.name, task.tiles, task.depth) == (whole.name, PLACES, DEPTH)
    assert "to depth 12 of 30 tiles" in task.gallery_description
    by_index, in_memory = _analyser(model), _analyser(model)
    beyond = 0
    for query in range(0, PLACES, 8):
        for weights in (None, (0.0, 1.0, 0.5, 0.0)):
            request = QueryRequest(query, weights=weights)
            found, wanted = by_index.analyse(task, request, 10), in_memory.analyse(whole, request, 10)
            names = [task.gallery[match.index].name for match in found.matches]
            assert names == [whole.gallery[match.index].name for match in wanted.matches]
            for one, other in zip(found.matches, wanted.matches, strict=True):
                assert (one.rank, one.true, one.beyond) == (other.rank, other.true, False)
                np.testing.assert_allclose(one.contributions, other.contributions, atol=1e-5)
                assert one.contributions.sum() == pytest.approx(one.distance2, abs=1e-5)
            assert found.errors_m is not None
            assert wanted.errors_m is not None
            assert found.errors_m[found.chosen.index] == pytest.approx(wanted.errors_m[wanted.chosen.index], abs=0.01)
            positive, there = found.positive, wanted.positive
            assert positive is not None
            assert there is not None
            assert positive.distance2 == pytest.approx(there.distance2, abs=1e-5)
            beyond += positive.beyond
            assert positive.beyond == (there.rank > DEPTH)
            assert positive.rank_text == ("> 12" if there.rank > DEPTH else str(there.rank))
            assert positive.gap is None or not positive.beyond
    assert beyond


def test_the_outcomes_of_all_queries_are_exact_to_the_depth(task: IndexTask, whole: GalleryTask) -> None:
    found, wanted = task.outcomes, whole.outcomes
    np.testing.assert_array_equal(found.rank, np.minimum(wanted.rank, DEPTH))
    assert (wanted.rank > DEPTH).any()
    np.testing.assert_allclose(found.margin, wanted.margin, atol=1e-5)
    np.testing.assert_allclose(found.parts, wanted.parts, atol=1e-5)
    np.testing.assert_array_equal(found.deciding_part, wanted.deciding_part)
    now = task.current()
    for ours, theirs in ((found.answer, wanted.answer), (found.true, wanted.true), (found.false, wanted.false)):
        assert [now.gallery[i].name for i in ours] == [whole.gallery[i].name for i in theirs]
    for name in ("recall@1", "recall@5", "recall@10", "queries"):
        assert task.metrics[name] == whole.metrics[name]
    assert np.isnan(task.metrics["ap"])
    gap = IndexRanking(task).finish(lambda *_: None).gap
    np.testing.assert_allclose(gap, whole.ranking().finish(lambda *_: None).gap, atol=1e-5)
    table = now.tabulate(found, task.part_names)
    ranks = [table.columns["rank"].text(i) for i in range(PLACES)]
    assert ranks == ["> 12" if rank >= DEPTH else str(rank + 1) for rank in wanted.rank]
    expected = whole.tabulate(wanted, task.part_names).columns["distance"].values
    np.testing.assert_allclose(table.columns["distance"].values, expected, atol=0.01)


def test_a_tile_beyond_the_depth_can_be_compared_and_the_ranking_is_reused(
    task: IndexTask, whole: GalleryTask, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranking = whole.start_search(0, whole.query_descriptors[0])(whole.part_weights)
    far = whole.gallery[ranking.match(PLACES - 1).index]
    place = task.find_tile(far.path.relative_to(whole.root / "test" / "gallery_satellite").as_posix())
    assert place is not None
    assert task.find_tile("no/such.png") is None
    analyser = _analyser(model)
    first = analyser.analyse(task, QueryRequest(0), 10)
    searches = 0
    search = SharedIndex.search

    def counted(*given: object, **more: object) -> SearchResult:
        nonlocal searches
        searches += 1
        return search(*given, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(SharedIndex, "search", counted)
    again = analyser.analyse(task, QueryRequest(0, compare=first.matches[3].index), 10)
    assert again.ranking is first.ranking
    assert not searches
    compared = analyser.analyse(task, QueryRequest(0, compare=place), 10)
    assert compared.chosen.index == place
    assert compared.chosen.beyond
    assert compared.chosen.distance2 == pytest.approx(ranking.match(PLACES - 1).distance2, abs=1e-5)
    assert searches == 1


def test_a_query_is_ranked_alike_in_memory_and_in_an_index(task: IndexTask, whole: GalleryTask) -> None:
    for changes in ({}, {"weights": (0, 1, 1, 2)}, {"change": Change(rotate=90)}):
        expected, ranking = (of.search(1, **changes) for of in (whole, task))  # type: ignore[arg-type]
        assert [task.tile_name(i) for i in ranking.order[:5]] == [
            whole.gallery[i].path.relative_to(whole.root / "test" / "gallery_satellite").as_posix()
            for i in expected.order[:5]
        ]
        assert ranking.match(0).distance2 == pytest.approx(expected.match(0).distance2, abs=1e-5)
    with pytest.raises(InputError, match="no query 99"):
        whole.search(99)
    with pytest.raises(InputError, match="no network"):
        replace(whole, model=None).search(0, change=Change(rotate=90))


def test_positions_in_the_gallery_stay_valid_while_threads_search(task: IndexTask, whole: GalleryTask) -> None:
    seen: list[dict[str, int]] = []

    def run(start: int) -> None:
        mine: dict[str, int] = {}
        for query in range(start, PLACES, 3):
            ranking = task.search_index(query, whole.query_descriptors[query], task.part_weights, background=start == 0)
            for place in ranking.order.tolist():
                assert mine.setdefault(task.gallery.name_of(place), place) == place
        seen.append(mine)

    threads = [threading.Thread(target=run, args=(start,)) for start in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 3
    for mine in seen:
        for name, place in mine.items():
            assert task.gallery.find(name) == place
    assert len(set(range(len(task.gallery)))) == len({task.gallery.name_of(i) for i in range(len(task.gallery))})


def test_tiles_without_pictures_are_placeholders_with_exact_contributions(
    tmp_path: Path, whole: GalleryTask, model: Model, places: Path
) -> None:
    index = _index(tmp_path / "index", whole, positions=False)
    pictures = tmp_path / "mine"
    for i in range(3):
        small_worlds.write(pictures / f"{i}.png", small_worlds.place(40 + i))
    task = index_task(model, "model.onnx", index, picture_queries(model, pictures, index), DEPTH)
    assert "without a position" in task.no_map
    found = _analyser(model).analyse(task, QueryRequest(1, evidence=True), 10)
    assert (found.positive, found.ranking.relevant, found.errors_m, found.pair_evidence) == (None, None, None, None)
    assert "give the folder" in found.task.without_picture(found.chosen.index)
    assert found.tile.picture.shape == (256, 256, 3)
    plain = TilePlaceholder("0001.png", "", lambda: np.full(2, np.nan))
    placed = TilePlaceholder("0001.png", "", lambda: np.array([48.1, 9.2]))
    assert (plain() != placed()).any()
    np.testing.assert_allclose(found.tile.descriptor, index.read([found.task.gallery[found.chosen.index].name])[0][0])
    assert found.chosen.contributions.sum() == pytest.approx(found.chosen.distance2, abs=1e-5)
    assert not task.metrics["queries"]
    # With the folder that was described, the same tiles have pictures.
    folder = places / "test" / "gallery_satellite"
    task = index_task(model, "model.onnx", index, picture_queries(model, pictures, index, folder), DEPTH)
    found = _analyser(model).analyse(task, QueryRequest(1, evidence=True), 10)
    assert not found.task.without_picture(found.chosen.index)
    assert found.pair_evidence is not None
    described = descriptors.cached_descriptors(model, [task.gallery[found.chosen.index]], "satellite")[0]
    np.testing.assert_allclose(found.tile.descriptor, described, atol=1e-5)
    index.close()


def test_tiles_without_a_position_are_left_off_a_map_that_holds_all_others(
    tmp_path: Path, whole: GalleryTask, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert whole.geometry is not None
    degrees = np.array([(place.latitude, place.longitude) for place in whole.geometry.tiles])
    degrees[::3] = np.nan
    index = SharedIndex(create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512)))
    index.index.add([f"{i}.png" for i in range(PLACES)], whole.gallery_descriptors, degrees)
    monkeypatch.setattr(ground, "_PROBED", 4)  # so few that they lie in a corner of the map
    found = ground.probes(index, model)
    assert np.isnan(np.concatenate([one.positions for one in found])).any()
    laid, reason = ground.ground_of(found, index.extent(), [], None)
    assert laid is not None
    assert not reason
    west, south, east, north = laid.borders
    x, y = geo.degrees_on_plane(degrees[~np.isnan(degrees).any(axis=1)], laid.origin).T
    assert ((x > west) & (x < east) & (y > south) & (y < north)).all()
    index.close()


def test_names_in_an_index_are_never_paths_out_of_the_folder(tmp_path: Path, whole: GalleryTask, model: Model) -> None:
    index = create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512))
    small_worlds.write(tmp_path / "secret.png", small_worlds.place(1))
    names = ["../secret.png", str(tmp_path / "secret.png"), "a\nb.png"]
    index.add(names, whole.gallery_descriptors[:3])
    (tmp_path / "inside").mkdir()
    small_worlds.write(tmp_path / "inside" / "q.png", small_worlds.place(2))
    queries = picture_queries(model, tmp_path / "inside", SharedIndex(index), tmp_path / "inside")
    task = index_task(model, "m", SharedIndex(index), queries)
    ranking = task.start_search(0, task.query_descriptors[0])(task.part_weights)
    assert len(ranking.order) == 3
    assert all(task.without_picture(i) for i in range(3))
    index.close()


def test_mistakes_get_one_sentence(tmp_path: Path, whole: GalleryTask, model: Model) -> None:
    index = _index(tmp_path / "index", whole)
    queries = dataset_queries(model, open_dataset(whole.root), index)
    with pytest.raises(InputError, match="depth is 5; expected 10 or more"):
        index_task(model, "m", index, queries, 5)
    with pytest.raises(InputError, match="has no tile gone"):
        index.read(["0002/0002.png", "gone.png"])
    index.close()
    empty = SharedIndex(create_index(tmp_path / "empty", DescriptorKind(model.fingerprint, 4, 512)))
    with pytest.raises(InputError, match="holds no tiles"):
        index_task(model, "m", empty, queries)
    with pytest.raises(StoreError, match="holds descriptors of model"):
        index.index.check_model("another")


def test_an_index_of_other_tiles_leaves_the_places_unknown(tmp_path: Path, whole: GalleryTask, model: Model) -> None:
    index = create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512))
    index.add([f"other/{i}.png" for i in range(12)], whole.gallery_descriptors[:12])
    shared = SharedIndex(index)
    task = index_task(model, "m", shared, dataset_queries(model, open_dataset(whole.root), shared))
    assert not task.metrics["queries"]
    assert (task.outcomes.rank == -1).all()
    index.close()


def _ranks(task: IndexTask) -> npt.NDArray[np.object_]:
    table = task.current().tabulate(task.outcomes, task.part_names)
    told = np.array([table.columns["rank"].text(i) for i in range(len(table))], object)
    lines = table.to_csv(table.rows()).decode().splitlines()[1:]
    assert [line.split(",")[2] for line in lines] == told.tolist()
    return told


def test_the_described_folder_is_found_among_all_heights(tmp_path: Path, model: Model) -> None:
    dataset = open_dataset(layouts.sues(tmp_path / "sues", 0, 1, ("150", "200")))
    tiles = normalise(np.random.default_rng(0).standard_normal((3, 4, 512)).astype(np.float32))
    kind = DescriptorKind(model.fingerprint, 4, 512)
    index = SharedIndex(create_index(tmp_path / "index", kind))
    index.index.add(["0001/0.jpg", "0001/1.jpg"], tiles[:2])
    with pytest.raises(
        InputError, match="Testing/150/gallery_drone/ and those below Testing/200/gallery_drone/ equally"
    ):
        dataset_queries(model, dataset, index)
    small_worlds.write(dataset.root / "Testing" / "200" / "gallery_drone" / "0001" / "2.jpg", small_worlds.place(3))
    index.index.add(["0001/2.jpg"], tiles[2:])
    queries = dataset_queries(model, open_dataset(dataset.root), index)
    assert queries.true == [["0001/0.jpg", "0001/1.jpg", "0001/2.jpg"]]
    assert {tile.path.parts[-4] for tile in queries.tiles.values()} == {"200"}
    index.close()


def test_a_tile_that_an_approximate_search_misses_is_not_said_to_be_beyond_the_depth(
    tmp_path: Path, whole: GalleryTask, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = _index(tmp_path / "index", whole)
    search, lost = SharedIndex.search, 3

    def poor(self: SharedIndex, query: object, weights: object, k: int, background: bool = False) -> SearchResult:
        """Lose the nearest, as an approximate search could."""
        found = search(self, query, weights, k + lost, background)  # type: ignore[arg-type]
        return SearchResult(found.ids[lost:], found.scores[lost:], found.vectors[lost:], found.positions[lost:])

    monkeypatch.setattr(SharedIndex, "search", poor)
    monkeypatch.setattr(type(index.index), "exhaustive", False)
    task = index_task(model, "m", index, dataset_queries(model, open_dataset(whole.root), index), DEPTH)
    ranks = np.asarray(whole.outcomes.rank)
    expected = [
        "not returned" if rank < lost else "> 12" if rank >= DEPTH + lost else str(rank + 1 - lost) for rank in ranks
    ]
    assert {"not returned", "> 12"} < set(expected)
    assert _ranks(task).tolist() == expected
    for rank in (ranks.min(), ranks.max()):
        query = int(np.flatnonzero(ranks == rank)[0])
        positive = _analyser(model).analyse(task, QueryRequest(query), 10).positive
        assert positive is not None
        assert positive.rank_text == expected[query]
    index.close()


def test_a_search_that_returns_fewer_tiles_than_its_depth_invents_no_rank(
    tmp_path: Path, whole: GalleryTask, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = _index(tmp_path / "index", whole)
    task = index_task(model, "m", index, dataset_queries(model, open_dataset(whole.root), index), DEPTH)
    search = SharedIndex.search

    def poor(self: SharedIndex, query: object, weights: object, k: int, background: bool = False) -> SearchResult:
        """Return every second of the nearest, as an approximate search could."""
        found = search(self, query, weights, k, background)  # type: ignore[arg-type]
        return SearchResult(found.ids[1::2], found.scores[1::2], found.vectors[1::2], found.positions[1::2])

    monkeypatch.setattr(SharedIndex, "search", poor)
    monkeypatch.setattr(type(index.index), "exhaustive", False)
    ranks = np.asarray(whole.outcomes.rank)
    returned = (ranks < DEPTH) & (ranks % 2 == 1)
    assert returned.any()
    np.testing.assert_array_equal(task.outcomes.rank, np.where(returned, ranks // 2, DEPTH))
    # A row of the table cannot say that it is beyond twelve, as six are returned.
    assert not _ranks(task)[~returned].tolist().count("> 12")
    far = int(np.flatnonzero(ranks >= DEPTH)[0])
    analysis = _analyser(model).analyse(task, QueryRequest(far), 10)
    assert analysis.positive is not None
    assert analysis.positive.rank_text == "> 6"
    missed = int(np.flatnonzero(ranks == 0)[0])
    analysis = _analyser(model).analyse(task, QueryRequest(missed), 10)
    assert analysis.positive is not None
    assert analysis.positive.rank_text == "not returned"
    assert analysis.verdict.headline == "Missed: the search did not return the true tile"
    assert analysis.verdict.sentence.startswith("It would lead the answer by ")
    index.close()
