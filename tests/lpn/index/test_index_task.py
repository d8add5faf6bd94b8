from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn import descriptors
from lpn.core.errors import InputError
from lpn.core.progress import listening
from lpn.datasets import open_dataset
from lpn.drawing import mosaic
from lpn.index import DescriptorKind, Index, create_index
from lpn.index import task as index_tasks
from lpn.index.queries import dataset_queries, picture_queries
from lpn.index.task import index_task
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from lpn.models.base import Model, normalise
from lpn.tasks.opening import describe_task
from lpn.tasks.task import Task
from tools.fixtures import layouts, small_worlds

PLACES = 30


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Places 2 to 31, each with one drone picture; every fourth shows another place, so that it is not found."""
    root = small_worlds.make_dataset(tmp_path_factory.mktemp("places") / "places", train=1, test=PLACES)
    for label in range(2, PLACES + 2, 4):
        shown = small_worlds.from_drone(small_worlds.place(label % PLACES + 3), label)
        small_worlds.write(root / "test" / "query_drone" / f"{label:04d}" / "image-01.png", shown)
    return small_worlds.map_dataset(root)


@pytest.fixture(scope="module")
def whole(places: Path, model: Model) -> Task:
    """The task in memory."""
    return describe_task(model, "model.onnx", open_dataset(places), "drone-to-satellite")


def _index(where: Path, whole: Task, engine: str = "exact", positions: bool = True, added: int = PLACES) -> Index:
    """An index of the gallery, backwards, as lpn describe of its folder and lpn index make it.

    Args:
        added: number of tiles that are added at once.
    """
    index = create_index(where, DescriptorKind(whole.model.fingerprint, 4, 512), engine)
    names = [tile.path.relative_to(whole.root / "test" / "gallery_satellite").as_posix() for tile in whole.gallery]
    degrees = np.array([(place.latitude, place.longitude) for place in whole.geometry.tiles])
    for start in range(0, len(names), added):
        some = slice(start, start + added)
        degrees_of = degrees[::-1][some] if positions else None
        index.add(names[::-1][some], whole.gallery_descriptors[::-1][some], degrees_of)
    return index


def _task(index: Index, root: Path, model: Model) -> Task:
    with index:
        return index_task(model, "model.onnx", index, dataset_queries(model, open_dataset(root), index))


def _names(task: Task, tiles: np.ndarray) -> list[str]:
    """Return the paths of tiles, "" for -1."""
    return ["" if i < 0 else task.gallery[i].path.as_posix() for i in tiles.tolist()]


def expect_equal(task: Task, whole: Task) -> None:
    """Compare outcomes, figures, gaps, and the table of an index with those of the same tiles as a data set's gallery."""
    found, wanted = task.outcomes, whole.outcomes
    np.testing.assert_array_equal(found.rank, wanted.rank)
    np.testing.assert_allclose(found.parts, wanted.parts, atol=1e-6)
    np.testing.assert_array_equal(found.deciding_part, wanted.deciding_part)
    for name in ("answer", "true", "false"):
        assert _names(task, getattr(found, name)) == _names(whole, getattr(wanted, name))
    assert task.metrics == whole.metrics
    ranked, expected = (one.retrieved for one in (task, whole))
    np.testing.assert_allclose(ranked.gap, expected.gap, atol=1e-6)
    for column, other in zip(task.table.columns.values(), whole.table.columns.values(), strict=True):
        assert column.name == other.name
        if column.kind == "number":
            np.testing.assert_allclose(column.values, other.values, atol=1e-5)
        else:
            assert column.values.tolist() == other.values.tolist()


@pytest.fixture(params=["exact", "exact, in segments", "faiss"])
def task(request: pytest.FixtureRequest, tmp_path: Path, whole: Task, model: Model) -> Task:
    if request.param == "faiss":
        pytest.importorskip("faiss")
    added = 13 if "segments" in request.param else PLACES
    index = _index(tmp_path / "index", whole, request.param.partition(",")[0], added=added)
    if added < PLACES:  # a tile that is replaced is one tile
        name = whole.gallery[3].path.relative_to(whole.root / "test" / "gallery_satellite").as_posix()
        read, degrees = index.read([name])
        index.add([name], read, degrees)
    return _task(index, whole.root, model)


def _analyser(model: Model) -> QueryAnalyser:
    return QueryAnalyser(model, lambda task, index: describe_tile(task, index, model))


def test_an_index_answers_as_the_gallery_of_its_data_set_does(task: Task, whole: Task, model: Model) -> None:
    assert (task.name, task.tiles, task.gallery_description) == (whole.name, PLACES, "30 tiles")
    by_index, in_memory = _analyser(model), _analyser(model)
    for query in range(0, PLACES, 8):
        for weights in (None, (0.0, 1.0, 0.5, 0.0)):
            request = QueryRequest(query, weights=weights)
            found, wanted = by_index.analyse(task, request, 10), in_memory.analyse(whole, request, 10)
            for one, other in zip((*found.matches, found.positive), (*wanted.matches, wanted.positive), strict=True):
                assert (one.rank, one.true) == (other.rank, other.true)
                assert task.gallery[one.index].path == whole.gallery[other.index].path
                np.testing.assert_allclose(one.contributions, other.contributions, atol=1e-6)
                assert one.contributions.sum() == pytest.approx(one.distance2, abs=1e-5)
            assert found.errors_m[found.chosen.index] == pytest.approx(wanted.errors_m[wanted.chosen.index], abs=0.01)


def test_the_figures_of_an_index_are_those_of_the_same_tiles_as_a_gallery(task: Task, whole: Task) -> None:
    assert 0 < whole.metrics["recall@1"] < 100
    expect_equal(task, whole)
    found, wanted = task.evaluate(), whole.evaluate()
    assert [vars(one) for one in found.galleries] == [vars(one) for one in wanted.galleries]
    assert found.sentence == wanted.sentence
    np.testing.assert_allclose(found.errors, wanted.errors, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "columns"),
    [(layouts.gta, {"overlap", "semi"}), (layouts.world_uav, set[str]())],
    ids=["overlaps", "regions"],
)
def test_the_true_tiles_that_a_data_set_lists_are_those_of_the_index(
    make: Callable[[Path], Path], columns: set[str], tmp_path: Path, model: Model
) -> None:
    data = make(tmp_path / "data")
    listed = describe_task(model, "model.onnx", open_dataset(data))
    assert columns or any(one.among is not None for one in listed.truth)
    index = create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512))
    names = [tile.path.relative_to(data).as_posix() for tile in listed.gallery]
    assert listed.geometry is None or len(listed.geometry.tiles) == len(names)
    places = None if listed.geometry is None else [(one.latitude, one.longitude) for one in listed.geometry.tiles][::-1]
    index.add(names[::-1], listed.gallery_descriptors[::-1], places)
    found = replace(_task(index, data, model), columns=listed.columns)
    assert columns <= set(found.table.columns)
    expect_equal(found, listed)


@pytest.mark.parametrize("engine", ["exact", "faiss"])
def test_of_a_large_index_the_tiles_are_ranked_that_its_engine_proposes(
    engine: str, tmp_path: Path, whole: Task, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    if engine == "faiss":
        pytest.importorskip("faiss")
    monkeypatch.setattr(index_tasks, "MOST_TILES", PLACES - 1)
    monkeypatch.setattr(index_tasks, "PROPOSED", 2)
    index, said = _index(tmp_path / "index", whole, engine), []
    queries = dataset_queries(model, open_dataset(whole.root), index)
    some = {"places": queries.places[:10], "pictures": queries.pictures[:10], "descriptors": queries.descriptors[:10]}
    queries = replace(queries, **some)
    with listening(lambda _, *count: said.append(count)):
        task = index_task(model, "model.onnx", index, queries)
    assert said[0] == (0, 10)
    assert said[-1] == (10, 10)
    proposed = f"the 2 that its engine ({engine}) proposes for each query"
    sentence = f"of 30 in the index: {proposed}, and the true ones; ranks and AP are among these"
    assert 10 <= task.tiles < PLACES
    assert task.gallery_description == f"{task.tiles} tiles {sentence}"
    assert sentence in task.evaluate().sentence
    # The nearest tile is right as often as among all tiles, and no true tile has a worse rank.
    expected = whole.outcomes.rank[:10]
    np.testing.assert_array_equal(task.outcomes.rank == 0, expected == 0)
    assert (task.outcomes.rank <= expected).all()
    assert (task.outcomes.rank[expected >= 2] >= 2).all()
    monkeypatch.setattr(index_tasks, "MOST_TILES", 5)
    with pytest.raises(InputError, match=r"30 tiles is searched for 10 queries, which gives \d+ tiles .*expected 5"):
        index_task(model, "model.onnx", index, queries)
    index.close()


def test_tiles_without_pictures_are_placeholders_with_exact_contributions(
    tmp_path: Path, whole: Task, model: Model, places: Path
) -> None:
    index = _index(tmp_path / "index", whole, positions=False)
    pictures = tmp_path / "mine"
    for i in range(3):
        small_worlds.write(pictures / f"{i}.png", small_worlds.place(40 + i))
    task = index_task(model, "model.onnx", index, picture_queries(model, pictures, index))
    assert "without a position" in task.no_map
    found = _analyser(model).analyse(task, QueryRequest(1, evidence=True), 10)
    assert (found.positive, found.ranking.relevant, found.errors_m, found.pair_evidence) == (None, None, None, None)
    assert "give the folder" in task.gallery[found.chosen.index].missing
    assert found.tile.picture.shape == (256, 256, 3)
    placed = index_task(model, "m", _index(tmp_path / "placed", whole), picture_queries(model, pictures, index))
    assert (placed.gallery[0].load() != task.gallery[0].load()).any()
    np.testing.assert_allclose(found.tile.descriptor, index.read([task.gallery[found.chosen.index].name])[0][0])
    assert found.chosen.contributions.sum() == pytest.approx(found.chosen.distance2, abs=1e-5)
    assert not task.metrics["queries"]
    # With the folder that was described, the same tiles have pictures.
    folder = places / "test" / "gallery_satellite"
    task = index_task(model, "model.onnx", index, picture_queries(model, pictures, index, folder))
    found = _analyser(model).analyse(task, QueryRequest(1, evidence=True), 10)
    assert not task.gallery[found.chosen.index].missing
    assert found.pair_evidence is not None
    described = descriptors.cached_descriptors(model, [task.gallery[found.chosen.index]], "satellite")[0]
    np.testing.assert_allclose(found.tile.descriptor, described, atol=1e-5)
    index.close()


def test_tiles_without_a_position_are_left_off_a_map_that_holds_all_others(
    tmp_path: Path, whole: Task, model: Model
) -> None:
    index = _index(tmp_path / "index", whole)
    lost = [tile.path.relative_to(whole.root / "test" / "gallery_satellite").as_posix() for tile in whole.gallery[::3]]
    index.add(lost, index.read(lost)[0])
    task = _task(index, whole.root, model)
    assert not task.no_map
    known = np.flatnonzero(~np.isnan(task.geometry.ground).any(axis=1))
    assert len(known) == PLACES - len(lost)
    assert task.geometry.places.tolist() == known.tolist()
    west, south, east, north = task.geometry.bounds()
    x, y = task.geometry.ground[known].T
    assert ((x > west) & (x < east) & (y > south) & (y < north)).all()
    assert mosaic.draw(task.geometry, task.gallery).std() > 0


def test_names_in_an_index_are_never_paths_out_of_the_folder(tmp_path: Path, whole: Task, model: Model) -> None:
    index = create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512))
    small_worlds.write(tmp_path / "secret.png", small_worlds.place(1))
    names = ["../secret.png", str(tmp_path / "secret.png"), "a\nb.png"]
    index.add(names, whole.gallery_descriptors[:3])
    (tmp_path / "inside").mkdir()
    small_worlds.write(tmp_path / "inside" / "q.png", small_worlds.place(2))
    queries = picture_queries(model, tmp_path / "inside", index, tmp_path / "inside")
    task = index_task(model, "m", index, queries)
    ranking = task.start_search(0, task.query_descriptors[0])(task.part_weights)
    assert len(ranking.order) == 3
    assert all(tile.missing for tile in task.gallery)
    index.close()


def test_an_index_of_other_tiles_leaves_the_places_unknown(tmp_path: Path, whole: Task, model: Model) -> None:
    index = create_index(tmp_path / "index", DescriptorKind(model.fingerprint, 4, 512))
    with pytest.raises(InputError, match="holds no tiles"):
        index_task(model, "m", index, dataset_queries(model, open_dataset(whole.root), index))
    index.add([f"other/{i}.png" for i in range(12)], whole.gallery_descriptors[:12])
    task = index_task(model, "m", index, dataset_queries(model, open_dataset(whole.root), index))
    assert not task.metrics["queries"]
    assert (task.outcomes.rank == -1).all()
    index.close()


def test_the_described_folder_is_found_among_all_heights(tmp_path: Path, model: Model) -> None:
    dataset = open_dataset(layouts.sues(tmp_path / "sues", 0, 1, ("150", "200")))
    tiles = normalise(np.random.default_rng(0).standard_normal((3, 4, 512)).astype(np.float32))
    kind = DescriptorKind(model.fingerprint, 4, 512)
    index = create_index(tmp_path / "index", kind)
    index.add(["0001/0.jpg", "0001/1.jpg"], tiles[:2])
    with pytest.raises(InputError, match="150/gallery_drone/ and those below Testing/200/gallery_drone/ equally"):
        dataset_queries(model, dataset, index)
    small_worlds.write(dataset.root / "Testing" / "200" / "gallery_drone" / "0001" / "2.jpg", small_worlds.place(3))
    index.add(["0001/2.jpg"], tiles[2:])
    queries = dataset_queries(model, open_dataset(dataset.root), index)
    assert queries.true_tiles() == ["0001/0.jpg", "0001/1.jpg", "0001/2.jpg"]
    assert {tile.path.parts[-4] for _, tile in queries.listed.values()} == {"200"}
    index.close()
