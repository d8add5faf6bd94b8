"""Drivers that are killed, or two at once, in a place of shards: the real driver and worker, with neither Ray nor a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the extra cluster is not installed")

from lpn.cli import main
from lpn.cluster import driver
from lpn.cluster.driver import Summary
from lpn.cluster.gather import open_shards, to_store
from lpn.cluster.shards import PLAN, Plan, ShardItem, shard_name, write_shard
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker, PartitionTask, _UnreadError
from lpn.core.arrays import Float32Array
from lpn.core.errors import PictureError, StoreError
from lpn.descriptors import Row
from lpn.descriptors.parallel_inference import DescribedRow
from lpn.models.base import normalise

KIND = Plan("f" * 16, "drone", 2, 4, "float32", 1)
ANOTHER = "Another run of lpn describe wrote to .* meanwhile; run this again when it has ended"
NOT_ENDED = "their run has not ended"
NOT_ALL = "are not all those of the run that ended last, .* run lpn describe --engine ray again"


def pictures(count: int) -> list[ShardItem]:
    return [ShardItem(Row(f"{i:03d}.png", 10, 1), (46.0, 7.0)) for i in range(count)]


def described(items: Sequence[ShardItem]) -> Float32Array:
    """Descriptors that tell pictures, and their states, apart: (B, 2, 4)."""
    raw = [np.random.default_rng([*item.row.file.encode(), item.row.size]).standard_normal((2, 4)) for item in items]
    return normalise(np.array(raw, np.float32).reshape(-1, 2, 4))


class KilledError(Exception):
    """The driver is gone."""


class OneProcess:
    """The functions of Ray Data that the driver uses, run in this process in the order of the partitions.

    Args:
        before: told of each partition before it is begun, by its number and how many were begun by then.
    """

    def __init__(self, before: Callable[[int, int], None]) -> None:
        self.before, self.begun = before, 0
        self.ActorPoolStrategy = lambda **_: None

    def from_items(self, rows: list[dict[str, Any]], **_: object) -> OneProcess:
        self.rows = rows
        return self

    def map_batches(
        self, worker: Callable[..., DescribeWorker], fn_constructor_args: tuple[PartitionTask, Any], **_: object
    ) -> Any:
        ready = worker(*fn_constructor_args)

        def results() -> Iterator[Mapping[str, Any]]:
            for row in self.rows:
                self.before(row["partition"], self.begun)
                self.begun += 1
                made = ready({name: [value] for name, value in row.items()})
                yield {name: value[0] for name, value in made.items()}

        return SimpleNamespace(iter_rows=results)


class Place:
    """A place of shards as in object storage, where nothing keeps a second driver out.

    Attributes:
        computed: names of the pictures that were given to the model, of all runs.
        unread: names of pictures that cannot be read now.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir()
        self.folder, self.storage, self.monkeypatch = folder, Storage(folder), monkeypatch
        self.computed: list[str] = []
        self.unread: set[str] = set()
        monkeypatch.setattr("lpn.cluster.worker.describe_each", self._describe_each)

    def run(
        self,
        items: Sequence[ShardItem],
        shard: int | None = None,
        before: Callable[[int, int], None] = lambda *_: None,
    ) -> Summary:
        """Do the work of lpn describe --engine ray after it has listed the pictures."""

        @contextmanager
        def ray_session(*_: object) -> Iterator[tuple[OneProcess, int, Callable[[Any], Any]]]:
            yield OneProcess(before), 1, lambda files: files

        def worker(task: PartitionTask, _: object) -> DescribeWorker:
            made = DescribeWorker.__new__(DescribeWorker)
            made.task, made.images, made.out = task, Storage(task.images), Storage(task.out)
            made.model = SimpleNamespace()  # type: ignore[assignment]
            return made

        with self.monkeypatch.context() as patched:
            patched.setattr(driver, "ray_session", ray_session)
            return driver._run(
                self.storage,
                self.storage,
                list(items),
                replace(KIND, shard=shard),
                {},
                "m.onnx",
                None,
                1,
                1,
                lambda _: None,
                worker,  # type: ignore[arg-type]
            )

    def killed(self, items: Sequence[ShardItem], shard: int, after: int) -> bool:
        """A run whose driver is killed before the partition after so many; whether it came so far."""

        def before(_: int, begun: int) -> None:
            if begun == after:
                raise KilledError

        try:
            self.run(items, shard, before)
        except KilledError:
            return True
        return False

    def check(self, items: Sequence[ShardItem]) -> None:
        """Each picture is in the shards once, with its own descriptor."""
        shards = open_shards(self.folder)
        rows = {}
        for partition in range(shards.plan.partitions):
            read = shards.read(partition)
            assert shards.tiles(partition).names == [item.row.file for item in read.items]
            for item, row in zip(read.items, read.descriptors, strict=True):
                assert item not in rows
                rows[item] = row
        assert set(rows) == set(items)
        np.testing.assert_array_equal([rows[item] for item in items], described(items))

    def plan(self) -> Plan:
        held = Plan.read(self.storage)
        assert held is not None
        return held

    def states(self) -> dict[str, tuple[int, int]]:
        """Identify the version of each file, by its name."""
        return {path.name: (path.stat().st_mtime_ns, path.stat().st_ino) for path in self.folder.glob("*.*")}

    def _describe_each(self, _: object, items: Sequence[ShardItem], *__: object) -> Iterator[DescribedRow]:
        good = [i for i, item in enumerate(items) if item.row.file not in self.unread]
        self.computed += [items[i].row.file for i in good]
        unread = _UnreadError("cannot be read (nobody is there)")
        broken: list[tuple[int, PictureError]] = [(i, unread) for i in range(len(items)) if i not in good]
        yield DescribedRow(good, described([items[i] for i in good]), broken)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    return Place(tmp_path / "shards", monkeypatch)


LATE = {"earlier": (12, 2, 2), "fewer pictures": (4, 4, 4), "old number of partitions": (20, 4, 2)}
"""Shards that another driver's worker writes last of all: of so many pictures, so many partitions, and the number noted."""


def late(place: Place, what: str, partition: int) -> None:
    count, split, noted = LATE[what]
    mine = [i for i in pictures(count) if replace(KIND, partitions=split).partition(i.row.file) == partition]
    write_shard(place.storage, replace(KIND, partitions=noted), partition, mine, described(mine))


@pytest.mark.parametrize("second", [1, 4, 7, 8])
def test_a_kill_at_any_shard_of_one_doubling_or_two_costs_nothing(
    second: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three pictures, then nine in four shards, then twenty in eight: both runs are killed, also in their first lots."""
    for first in (0, 1, 3, 4):
        place = Place(tmp_path / f"{first}", monkeypatch)
        place.run(pictures(3), 4)
        assert place.killed(pictures(9), 4, first) == (first < 4)
        assert place.plan().partitions == 4
        came = place.killed(pictures(20), 4, second)
        assert came == (second < 8)
        if came:
            with pytest.raises(StoreError, match=f"{NOT_ENDED}|missing or damaged"):
                open_shards(place.folder)
        place.run(pictures(20), 4)
        assert sorted(place.computed) == [item.row.file for item in pictures(20)]
        place.check(pictures(20))


@pytest.mark.parametrize("what", LATE)
def test_a_late_shard_of_another_driver_is_seen_before_a_run_is_finished(what: str, place: Place) -> None:
    place.run(pictures(12), 6)

    def before(partition: int, begun: int) -> None:
        if begun == 4 - 1:
            assert partition == 1
            late(place, what, 0)

    with pytest.raises(StoreError, match=ANOTHER):
        place.run(pictures(20), 6, before)
    with pytest.raises(StoreError, match=NOT_ENDED):
        open_shards(place.folder)
    place.run(pictures(20), 6)
    place.check(pictures(20))


@pytest.mark.parametrize("what", LATE)
def test_a_late_shard_of_an_ended_run_is_refused_until_a_run_mends_it(
    what: str, place: Place, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place.run(pictures(20), 6)
    mine = {item.row.file for item in pictures(20) if place.plan().partition(item.row.file) == 1}
    late(place, what, 1)
    for _ in range(2):
        assert main.main(["describe", "--shards", str(place.folder), "--out", str(tmp_path / "store")]) == 2
        said = capsys.readouterr().err
        assert "are not all those of the run that ended last" in said
        assert "run lpn describe --engine ray again" in said
        assert said.count("\n") == 1
    before, place.computed = place.states(), []
    place.run(pictures(20), 6)
    assert set(place.computed) < mine
    after = place.states()
    assert {name for name in after if after[name] != before[name]} == {shard_name(1), PLAN, "broken.csv"}
    place.check(pictures(20))
    assert main.main(["describe", "--shards", str(place.folder), "--out", str(tmp_path / "store")]) == 0


def test_a_plan_that_says_finished_over_shards_of_a_killed_run_is_refused_until_a_run_mends_it(place: Place) -> None:
    """Between the moment a run looks at the plan and the moment it writes it, another may begin."""
    place.run(pictures(12), 6)
    ended = place.storage.read(PLAN)
    assert place.killed(pictures(20), 6, 3)
    place.storage.write(PLAN, ended)
    with pytest.raises(StoreError, match=NOT_ALL):
        open_shards(place.folder)
    place.run(pictures(20), 6)
    place.check(pictures(20))


def test_pictures_of_a_shard_are_what_the_place_was_told(place: Place) -> None:
    place.run(pictures(20), 5)
    assert (place.plan().partitions, place.plan().shard) == (4, 5)
    before = place.states()
    place.run(pictures(20))
    after = place.states()
    assert {name for name in after if after[name] != before[name]} <= {"broken.csv"}
    place.run(pictures(21))
    assert (place.plan().partitions, place.plan().shard) == (8, 5)
    place.run(pictures(21), 100)
    assert (place.plan().partitions, place.plan().shard) == (8, 100)
    place.run(pictures(40))
    assert place.plan().partitions == 8
    place.run(pictures(40), 4)
    assert place.plan().partitions == 16
    assert len(place.computed) == 40
    place.check(pictures(40))


def test_shards_of_256_pictures_are_made_where_nobody_says_another_number(place: Place) -> None:
    place.run(pictures(257))
    assert (place.plan().partitions, place.plan().shard) == (2, 256)


def test_a_picture_that_could_not_be_read_is_tried_again_and_forgotten_when_it_is_gone(
    place: Place, tmp_path: Path
) -> None:
    place.unread = {"003.png"}
    assert [one.item.row.file for one in place.run(pictures(12), 6).broken] == ["003.png"]
    assert len(to_store(open_shards(place.folder), tmp_path / "store").manifest.rows) == 11
    assert len(place.run(pictures(12), 6).broken) == 1
    others = [item for item in pictures(12) if item.row.file != "003.png"]
    assert place.run(others, 6).broken == []
    place.check(others)
    place.unread = set()
    assert place.run(pictures(12), 6).broken == []
    place.check(pictures(12))
    assert sorted(place.computed) == [item.row.file for item in pictures(12)]
