"""CSLS against its definition, and its effect on a tile that is near to all queries."""

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.models.base import normalise
from lpn.retrieval import csls, metrics, scoring


@pytest.fixture
def sides() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    query, tiles = (normalise(rng.normal(size=(count, 3, 8)).astype(np.float32)) for count in (11, 7))
    return query, tiles


def test_scores_are_the_published_ones(sides: tuple[np.ndarray, np.ndarray]) -> None:
    query, tiles = sides
    cosines = query.reshape(11, -1).astype(float) @ tiles.reshape(7, -1).T.astype(float)
    near_tile = np.sort(cosines, axis=0)[-4:].mean(axis=0)
    near_query = np.sort(cosines, axis=1)[:, -4:].mean(axis=1)
    published = 2 * cosines - near_tile - near_query[:, None]
    moved_query, moved_tiles = csls.scaled(query, tiles, 4)
    scores = moved_query.reshape(11, -1) @ moved_tiles.reshape(7, -1).T
    assert np.allclose(2 * scores - near_query[:, None], published, atol=1e-6)


def test_contributions_add_up_to_the_squared_distance_by_the_published_score(
    sides: tuple[np.ndarray, np.ndarray],
) -> None:
    query, tiles = sides
    products = query.reshape(11, -1) @ tiles.reshape(7, -1).T
    near_tiles, near_query = np.sort(products, axis=0)[-4:].mean(axis=0), np.sort(products[0])[-4:].mean()
    cosines = scoring.part_cosines(query[0], tiles)
    terms = csls.CslsTerms.of_query(cosines, 3 * csls.hubness(query, tiles, 4), 4)
    shares = scoring.contributions(cosines, scoring.part_weights(3), terms=terms.query + terms.tiles)
    assert np.allclose(shares.sum(axis=1), 2 - (2 * products[0] - near_tiles - near_query), atol=1e-6)


def test_blocks_change_nothing(sides: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = csls.hubness(*sides, 3)
    monkeypatch.setattr(csls, "_BLOCK", 150)
    assert np.allclose(csls.hubness(*sides, 3), whole, atol=1e-7)


def test_a_hub_no_longer_takes_all_queries() -> None:
    places = normalise(np.eye(4, 5, dtype=np.float32)[:, None])
    # The last tile lies between all queries, nearer to each than its own tile, which lies a little aside.
    hub = normalise(np.array([[[1, 1, 1, 1, 0]]], np.float32))
    aside = normalise(places * 0.5 + np.array([0, 0, 0, 0, 1], np.float32))
    tiles, labels = np.concatenate([aside, hub]), np.array([0, 1, 2, 3, 9])
    recalls = {}
    for neighbours in (0, 2):
        query, moved = csls.scaled(places, tiles, neighbours) if neighbours else (places, tiles)
        recalls[neighbours] = metrics.retrieve(query, labels[:4], moved, labels).recall(1)
    assert recalls == {0: 0, 2: 100}


@pytest.mark.parametrize("neighbours", [0, 12])
def test_more_neighbours_than_queries_are_refused(sides: tuple[np.ndarray, np.ndarray], neighbours: int) -> None:
    with pytest.raises(InputError, match=f"{neighbours} nearest queries, and there are 11"):
        csls.hubness(*sides, neighbours)
