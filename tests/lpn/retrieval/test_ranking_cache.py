from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.datasets import Truth
from lpn.models.base import normalise
from lpn.retrieval import metrics, ranking_cache
from lpn.retrieval.ranking_cache import Progressing, Sides


@pytest.fixture
def sides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sides:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_cache, "STEP", 4)
    rng = np.random.default_rng(0)
    asked, tiles = (normalise(rng.standard_normal((count, 2, 8)).astype(np.float32)) for count in (10, 7))
    return Sides(asked, tiles, rng.integers(0, 4, 10), rng.integers(-1, 3, 7), identity="these")


def ranked(sides: Sides) -> metrics.Retrieval:
    return metrics.retrieve(sides.asked, sides.query_labels, sides.tiles, sides.labels, sides.truth)


def same(one: metrics.Retrieval, other: metrics.Retrieval) -> None:
    for name in ("first", "true", "false", "best", "precision"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    assert one.figures() == other.figures()


@pytest.mark.parametrize("listed", [False, True])
def test_a_ranking_that_was_stopped_goes_on_where_it_stood(sides: Sides, listed: bool) -> None:
    if listed:
        sides = replace(sides, truth=[Truth(np.array([i % 7]), np.array([(i + 3) % 7])) for i in range(10)])
    ranking, told = Progressing(sides), []

    def stop(done: int, total: int) -> None:
        told.append((done, total))
        if done == 8:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        ranking.finish(stop)
    before = len(told)
    same(ranking.finish(lambda done, total: told.append((done, total))), ranked(sides))
    assert told[before][0] >= 4
    assert told[-1] == (10, 10)


def test_what_is_kept_is_found_again(sides: Sides) -> None:
    assert ranking_cache.kept(sides) is None
    ranking_cache.keep(sides, ranked(sides))
    found = ranking_cache.kept(sides)
    assert found is not None
    same(found, ranked(sides))


def test_nothing_is_found_of_other_descriptors_labels_or_lists(sides: Sides) -> None:
    ranking_cache.keep(sides, ranked(sides))
    labels = sides.labels.copy()
    labels[0] += 1
    truth = [Truth(np.array([1]), np.array([2]))] * 10
    others = [
        replace(sides, identity="others"),
        replace(sides, labels=labels),
        replace(sides, query_labels=sides.query_labels[::-1]),
        replace(sides, truth=truth),
    ]
    assert [ranking_cache.kept(other) for other in others] == [None] * 4
    assert len({other.file for other in (sides, *others)}) == 5


def test_junk_is_not_taken_for_true_matches_in_what_is_kept(sides: Sides) -> None:
    one, other = (replace(sides, truth=[Truth(*pair)] * 10) for pair in _pairs())
    assert one.file != other.file


def _pairs() -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    return (np.array([1, 2]), np.array([3])), (np.array([1]), np.array([2, 3]))


def test_descriptors_that_nobody_can_name_leave_nothing_behind(sides: Sides, tmp_path: Path) -> None:
    nameless = replace(sides, identity="")
    ranking_cache.keep(nameless, ranked(nameless))
    assert ranking_cache.kept(nameless) is None
    assert not (tmp_path / "cache").exists()


def test_a_damaged_file_is_as_good_as_none(sides: Sides) -> None:
    ranking_cache.keep(sides, ranked(sides))
    file = sides.file
    assert file is not None
    whole = file.read_bytes()
    for spoilt in (
        b"",
        b"not a zip",
        whole[: len(whole) // 2],
        whole[:-40] + bytes(40),
        whole[:300] + b"?" + whole[301:],
    ):
        file.write_bytes(spoilt)
        assert ranking_cache.kept(sides) is None
    good = dict(np.load(_written(file, whole)))
    for change in (
        {"first": good["first"][:5]},
        {"first": good["first"] + 7},
        {"true": good["true"].astype(np.float64)},
        {"precision": good["precision"] * np.nan},
        {"gallery": 8},
    ):
        np.savez(file, **(good | change))
        assert ranking_cache.kept(sides) is None


def _written(file: Path, data: bytes) -> Path:
    file.write_bytes(data)
    return file


def test_a_cache_that_cannot_be_written_to_is_a_warning(
    sides: Sides, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file")
    ranking_cache.keep(sides, ranked(sides))
    assert "is not kept for the next time" in caplog.text
