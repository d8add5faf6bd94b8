from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.datasets import Truth
from lpn.models.base import normalise
from lpn.retrieval import metrics
from lpn.tasks import ranking_cache
from lpn.tasks.task import Task
from tools.fixtures.tasks import descriptor_task


@pytest.fixture
def task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Task:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_cache, "STEP", 4)
    rng = np.random.default_rng(0)
    asked, tiles = (normalise(rng.standard_normal((count, 2, 8)).astype(np.float32)) for count in (10, 7))
    return descriptor_task(asked, tiles, rng.integers(0, 4, 10), rng.integers(-1, 3, 7), identity="these")


def ranked(task: Task) -> metrics.Retrieval:
    return metrics.retrieve(
        task.query_descriptors, task.query_labels, task.gallery_descriptors, task.gallery_labels, task.truth
    )


def same(one: metrics.Retrieval, other: metrics.Retrieval) -> None:
    for name in ("first", "true", "false", "best", "precision", "gap"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    assert one.metrics() == other.metrics()


@pytest.mark.parametrize("listed", [False, True])
def test_a_ranking_that_was_stopped_goes_on_where_it_stood(task: Task, listed: bool) -> None:
    if listed:
        task = replace(task, truth=[Truth(np.array([i % 7]), np.array([(i + 3) % 7])) for i in range(10)])
    ranking, told = ranking_cache.ResumableRanking(task), []

    def stop(done: int, total: int) -> None:
        told.append((done, total))
        if done == 8:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        ranking.finish(stop)
    before = len(told)
    same(ranking.finish(lambda done, total: told.append((done, total))), ranked(task))
    assert told[before][0] >= 4
    assert told[-1] == (10, 10)


def test_what_is_kept_is_found_again(task: Task) -> None:
    assert ranking_cache.load(task) is None
    ranking_cache.save(task, ranked(task))
    found = ranking_cache.load(task)
    same(found, ranked(task))


def test_nothing_is_found_of_other_descriptors_labels_or_lists(task: Task) -> None:
    ranking_cache.save(task, ranked(task))
    labels = task.gallery_labels.copy()
    labels[0] += 1
    truth = [Truth(np.array([1]), np.array([2]))] * 10
    others = [
        replace(task, identity="others"),
        replace(task, gallery_labels=labels),
        replace(task, query_labels=task.query_labels[::-1]),
        replace(task, truth=truth),
    ]
    assert [ranking_cache.load(other) for other in others] == [None] * 4
    assert len({ranking_cache.cache_file(other) for other in (task, *others)}) == 5


def test_junk_is_not_taken_for_true_matches_in_what_is_kept(task: Task) -> None:
    lists = Truth(np.array([1, 2]), np.array([3])), Truth(np.array([1]), np.array([2, 3]))
    one, other = (ranking_cache.cache_file(replace(task, truth=[of] * 10)) for of in lists)
    assert one != other


def test_descriptors_that_nobody_can_name_leave_nothing_behind(task: Task, tmp_path: Path) -> None:
    nameless = replace(task, identity="")
    ranking_cache.save(nameless, ranked(nameless))
    assert ranking_cache.load(nameless) is None
    assert not (tmp_path / "cache").exists()


def test_a_damaged_file_is_as_good_as_none(task: Task) -> None:
    ranking_cache.save(task, ranked(task))
    file = ranking_cache.cache_file(task)
    whole = file.read_bytes()
    for spoilt in (
        b"",
        b"not a zip",
        whole[: len(whole) // 2],
        whole[:-40] + bytes(40),
        whole[:300] + b"?" + whole[301:],
    ):
        file.write_bytes(spoilt)
        assert ranking_cache.load(task) is None
    file.write_bytes(whole)
    good = dict(np.load(file))
    for change in (
        {"first": good["first"][:5]},
        {"first": good["first"] + 7},
        {"true": good["true"].astype(np.float64)},
        {"precision": good["precision"] * np.nan},
        {"gap": good["gap"] - 5},
        {"gallery": 8},
    ):
        np.savez(file, **(good | change))
        assert ranking_cache.load(task) is None


def test_a_cache_that_cannot_be_written_to_is_a_warning(
    task: Task, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file")
    ranking_cache.save(task, ranked(task))
    assert "could not be cached" in caplog.text
