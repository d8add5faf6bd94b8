"""Changed tasks: what is described, when, and once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.progress import listening
from lpn.core.views import View
from lpn.datasets import Picture, open_dataset
from lpn.descriptors import cached_descriptors
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import Weather
from lpn.models.base import Model
from lpn.tasks.changes import averaged, by_csls, centred, changed, in_weather, turned, why_not, with_parts
from lpn.tasks.opening import lazy_task
from lpn.tasks.task import Task


@pytest.fixture
def described(task: Task) -> Task:
    """The task without what other tests have asked of it."""
    return replace(task, notes={})


def test_turned_queries_are_described_when_their_figures_are_asked_for_and_once(described: Task) -> None:
    assert turned(described, 0) is described
    counts: list[tuple[int, int]] = []
    with listening(lambda _, *count: counts.append(count)):
        around = turned(described, -90)
        assert around.change.rotate == 270
        assert not counts
        figures = around.metrics
        assert (counts[0], counts[-1]) == ((0, 14), (14, 14))
        counts.clear()
        assert turned(described, 270).metrics == figures
        assert not counts


def test_a_stopped_turn_goes_on_where_it_was(described: Task) -> None:
    def stop(_: str, done: int, __: int) -> None:
        if done:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"), listening(stop):
        _ = turned(described, 33).metrics
    counts: list[int] = []
    with listening(lambda _, done, __: counts.append(done)):
        _ = turned(described, 33).metrics
    assert counts[0] > 0


def test_descriptors_without_a_network_say_that_they_cannot_be_turned(described: Task) -> None:
    task = replace(described, model=None)
    assert "without their network" in why_not(task)
    with pytest.raises(InputError, match="cannot be turned"):
        turned(task, 45)


def test_pictures_are_described_when_they_are_needed_and_once(data: Path, model: Model) -> None:
    read: list[tuple[str, Change]] = []

    def reader(model: Model, pictures: Sequence[Picture], view: View, change: Change) -> Float32Array:
        read.append((view, change))
        return cached_descriptors(model, pictures, view, change)

    task = lazy_task(model, open_dataset(data), "drone-to-satellite", reader)
    moved = by_csls(with_parts(centred(turned(task, 90)), (1, 3)), 3)
    with pytest.raises(InputError, match="over 15 nearest queries, and there are 14"):
        by_csls(moved, 15).evaluate()
    assert not read
    found = moved.evaluate()
    assert [(view, change.rotate) for view, change in read] == [("drone", 90), ("satellite", 0)]
    assert (found.parts, found.neighbours, found.change.rotate) == ((1, 3), 3, 90)
    turned(task, 180).evaluate()
    assert [(view, change.rotate) for view, change in read[2:]] == [("drone", 180)], "one gallery serves all"
    assert replace(moved, notes={}).evaluate().recall == found.recall
    assert len(read) == 3


def test_each_change_adds_its_clause_and_another_turn_replaces_the_first(described: Task) -> None:
    foggy = turned(in_weather(turned(described, 90), "fog"), 30)
    assert foggy.change == Change(rotate=30, weather=Weather("fog"))
    assert foggy.evaluate().recall == changed(described, foggy.change).evaluate().recall
    assert changed(foggy, Change()).clauses == described.clauses
    said = averaged(with_parts(with_parts(foggy, (4, 2, 1)), (2, 3)))
    assert said.parts == (2, 1)
    assert said.clauses == (
        *described.clauses,
        "queries in fog, turned 30°, bicubic",
        "parts 4, 2, 1 of 4 only",
        "parts 2, 3 of 3 only",
        "the 14 query pictures averaged to one query per place",
    )
    assert said.part_names == [described.part_names[1], described.part_names[0]]
    with pytest.raises(InputError, match="so queries cannot be turned"):
        turned(said, 90)


def test_a_task_of_some_parts_has_a_table_and_ranks_one_query_as_all(described: Task) -> None:
    some = with_parts(described, (1, 3))
    assert some.part_names == [described.part_names[0], described.part_names[2]]
    assert some.table.columns["margin_2"].values.shape == (14,)
    ranks = [some.search(query).positive() for query in range(14)]
    assert [one.rank - 1 for one in ranks if one] == some.outcomes.rank.tolist()
    assert some.metrics["recall@1"] == replace(described, weights=(1, 0, 1, 0)).metrics["recall@1"]
