"""A flight as a task: the same answers as the retrieval, exact evidence, truth, and pictures cut when they are needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.flight.files import Flight
from lpn.flight.locate import retrieval
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.task import flight_task
from lpn.flight.maps import Map
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from lpn.models.base import Model
from lpn.tasks.task import Task
from tests.lpn.flight.locate.scenery import FLOWN_PLACES


@pytest.fixture(scope="module")
def model(model_file: Path) -> Model:
    return lpn.load(model_file)


@pytest.fixture(scope="module")
def located(town: Map, monday: Flight, model: Model) -> LocatedFlight:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(retrieval, "MIN_DISTINCT", 2)  # an untrained network's descriptors are much alike
        return locate(town, monday, model, LocateOptions(register=False, overlap=0.5, sizes=(51.0, 71.0)))


@pytest.fixture(scope="module")
def task(located: LocatedFlight, model: Model) -> Task:
    return flight_task(model, "a.onnx", located, located.flight.frames[0].file.parent)


def _analyser(task: Task) -> QueryAnalyser:
    return QueryAnalyser(task.model, lambda of, index: describe_tile(of, index, of.model))


@pytest.mark.parametrize("query", [1, 5])
def test_rankings_and_contributions_are_those_of_the_retrieval(task: Task, located: LocatedFlight, query: int) -> None:
    assert set(located.retrieval.means) == {"satellite", "drone"}  # so the descriptors are centred
    analysis = _analyser(task).analyse(task, QueryRequest(query, evidence=True), 5)
    first, best = located.retrieval.first(query, 5), located.retrieval.best(query, 1)[0]
    count = 1 if task.queries[query].note else 5  # below the best window, other headings may have won
    assert [match.index for match in analysis.matches[:count]] == first[:count].tolist()
    assert analysis.matches[0].score == pytest.approx(best.score, abs=1e-5)
    np.testing.assert_allclose(analysis.matches[0].contributions, best.contributions, atol=1e-5)
    assert bool(task.queries[query].note) == (query == 1)


def test_evidence_of_centred_descriptors_adds_up(task: Task) -> None:
    analysis = _analyser(task).analyse(task, QueryRequest(5, evidence=True), 3)
    np.testing.assert_allclose(analysis.query.descriptor, task.query_descriptors[5], atol=1e-5)
    np.testing.assert_allclose(analysis.tile.descriptor, task.gallery_descriptors[analysis.chosen.index], atol=1e-5)
    assert task.model.for_parallel_inference().means is task.model.means
    assert task.contract.claim.endswith("the length of the mean's term held")
    evidence = analysis.pair_evidence.evidence
    assert evidence.score == pytest.approx(analysis.chosen.score, abs=1e-5)
    for side in (evidence.query, evidence.tile):
        np.testing.assert_allclose(side.cells.sum(axis=(1, 2)) + side.constants, evidence.cosines, atol=1e-5)


def test_true_tiles_hold_the_tag_and_have_the_frame_s_own_size(task: Task, located: LocatedFlight) -> None:
    found = located.retrieval
    sizes, places = found.gallery.sizes, found.gallery.places
    assert len(set(sizes)) > 1
    for i in (5, len(FLOWN_PLACES)):
        tag, truth = located.frames[i].tag, task.truth[i]
        own = sizes == found.views[i].level
        holds = np.abs(places - tag).max(axis=1) <= sizes / 2
        assert len(truth.good)
        assert set(truth.good) == set(np.flatnonzero(own & holds))
        assert set(truth.junk) == set(np.flatnonzero(~own))
        ranking = _analyser(task).analyse(task, QueryRequest(i), 3).ranking
        assert set(ranking.order) == set(np.flatnonzero(own))


def test_frames_without_a_position_or_that_cannot_be_read_are_no_failures(task: Task) -> None:
    assert np.flatnonzero(~task.known).tolist() == [0, 2]
    assert not task.outcomes.failed[[0, 2]].any()
    assert task.metrics["queries"] == len(task.queries) - 2
    analysis = _analyser(task).analyse(task, QueryRequest(0), 3)
    assert analysis.matches[0].true is None
    assert analysis.positive is None
    assert analysis.errors_m is None


def test_errors_are_metres_from_the_tag(task: Task, located: LocatedFlight) -> None:
    analysis = _analyser(task).analyse(task, QueryRequest(5), 3)
    assert analysis.errors_m[analysis.matches[0].index] == pytest.approx(located.frames[5].error("retrieval"), abs=0.5)
    distance = task.table.columns["distance"]
    assert np.flatnonzero(~distance.known).tolist() == [0]
    assert distance.values[5] == pytest.approx(located.frames[5].error("retrieval"), abs=0.5)


def test_no_window_is_cut_before_it_is_shown(
    located: LocatedFlight, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    cuts = []
    read = Map.read
    monkeypatch.setattr(Map, "read", lambda town, window, pixels: cuts.append(window) or read(town, window, pixels))
    task = flight_task(model, "a.onnx", located, located.flight.frames[0].file.parent)
    assert task.outcomes.rank.shape == (len(task.queries),)
    assert not cuts
    assert task.gallery[7].load().shape == (*model.input_size, 3)
    assert cuts == [located.retrieval.gallery.windows[7]]
